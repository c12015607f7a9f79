"""Heterogeneity, pair profiles, coverage: the numbers behind the verdicts."""

from __future__ import annotations

from math import sqrt

import numpy as np
import pytest
from scipy.optimize import brentq, lsq_linear, nnls
from scipy.stats import binom

from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.fit.profile import profile_pair, profiles
from hvdc_ident.fit.uncertainty import ONE_SIDED, TWO_SIDED
from hvdc_ident.identifiability import identifiability
from hvdc_ident.identifiability.likelihood_intervals import bootstrap_rise, thresholds
from hvdc_ident.identifiability.misspecification import heterogeneity
from hvdc_ident.identifiability.pilot_fit import LocalAnalysis, pilot_fit
from hvdc_ident.identifiability.structural import in_words
from hvdc_ident.next_step import NextStep
from hvdc_ident.parameters import Parameter
from tests.fit.simulators import LeastSquares, coloured, decay, line, recorded
from tests.identifiability.cases import T, closed, measured, saturating

LINE = closed(line, a=0.0, b=0.0)
FREE = (FitParameter("a", 0, -50, 50), FitParameter("b", 0, -50, 50))


def slopes(values, noise=0.05, seed=0):
    return [measured(LINE, {"a": 1, "b": b}, noise, seed + k, f"e{k}") for k, b in enumerate(values)]


def test_experiments_that_disagree_set_the_flag_with_their_spread() -> None:
    report = identifiability(LINE, slopes([2.0, 2.0, 2.5]), FREE, starts=1)
    assert report.misspecification.flag and report.misspecification.next == NextStep("diagnose")
    assert any("disagree on b" in s for s in report.misspecification.signs)
    h = report.misspecification.heterogeneity["b"]
    assert h.dof == 2 and h.p < 1e-6 and h.i2 > 0.9
    assert list(h.estimates.values()) == pytest.approx([2.0, 2.0, 2.5], abs=0.05)
    assert h.spread == pytest.approx(np.std([2.0, 2.0, 2.5]), rel=0.1)
    assert report.to_dict()["misspecified"] is True


def test_q_is_chi_square_where_they_agree() -> None:
    q = [
        heterogeneity(pilot_fit(Problem(LINE, tuple(slopes([2.0] * 4, seed=10 * s)), FREE), starts=1)[0])["b"]
        for s in range(60)
    ]
    assert all(h.dof == 3 for h in q)
    assert np.mean([h.q for h in q]) == pytest.approx(3.0, abs=4 * sqrt(6 / 60))


def test_a_pair_profile_of_a_quadratic_is_its_ellipse() -> None:
    a = np.array([[3.0, 1, 0.5], [1, 2, 0.2], [0, 0.3, 1], [1, 1, 1]])
    unknowns = tuple(FitParameter(n, 0, -9, 9) for n in "xyz")
    grid = np.linspace(-1, 1, 5)
    found = profile_pair(LeastSquares(unknowns, lambda t: (a @ t, a)), np.zeros(3), ("x", "y"), grid, grid, enough=1e-9)
    inverse = np.linalg.inv(np.linalg.inv(a.T @ a)[:2, :2])
    for i, x in enumerate(grid):
        for j, y in enumerate(grid):
            v = np.array([x, y])
            assert found.rises[i, j] == pytest.approx(0.5 * v @ inverse @ v, abs=1e-7)


@pytest.mark.parametrize(
    ("direction", "words"),
    [
        ([1, -1, -1], ("b*kp", "b*ki")),
        ([1, 1, 0], ("kp/b",)),
        ([2, -1, 0], ("kp*b^0.5",)),
        ([1, 0, -1 / 3], ("b + ki",)),  # of values 1 and 3
        ([0, 1, 2 / 3], ("ki - kp",)),
        ([0, 1, -0.8], ("ki*kp^0.8",)),
    ],
)
def test_null_directions_in_words(direction, words) -> None:
    assert in_words(np.array(direction, float), ["b", "kp", "ki"], [True] * 3, [1, 2, 3]) == words


def coverage(rho: float, given: bool, runs: int) -> dict[str, int]:
    """How often the profile's interval holds the truth; closed in every run."""
    plant = closed(decay, a=1.0, k=1.0)
    free = (FitParameter("a", 2, 0.1, 20), FitParameter("k", 3, 0.1, 30))
    truth = {"a": 2.0, "k": 3.0}
    hits = dict.fromkeys(truth, 0)
    for seed in range(runs):
        y = decay(T, truth)[0] + coloured(np.random.default_rng(seed), T.size, rho, 0.15)
        data = recorded("e", T, {"y": 0.15} if given else {}, y=y)
        optimum, _ = pilot_fit(Problem(plant, (data,), free), starts=1)
        found = profiles(optimum.problem, optimum.theta, threshold=thresholds(optimum))
        for n, v in truth.items():
            low, high = found.by_name[n].ci95
            assert low is not None and high is not None
            hits[n] += low <= v <= high
    return hits


@pytest.mark.parametrize("given", [True, False])
def test_profile_intervals_hold_the_truth_19_times_in_20(given) -> None:
    low, high = binom.ppf([0.0005, 0.9995], 200, 0.95)
    for hits in coverage(0.0, given, 200).values():
        assert low <= hits <= high


def test_profile_intervals_hold_the_truth_in_coloured_noise() -> None:
    low = binom.ppf(0.001, 120, 0.92)  # rho is estimated from 101 rows: a nominal 95 % may lose three points
    for hits in coverage(0.6, True, 120).values():
        assert hits >= low


def test_two_on_their_bounds_together_get_limits_that_cover() -> None:
    """y = a + b t with a, b >= 0 and both 0: the limit of b, from a bootstrap, holds 0 always and is not too wide."""
    plant = closed(line, a=Parameter(0.1, min=0.0), b=Parameter(0.1, min=0.0))
    free = [FitParameter("a", 0.1, 0.0, 9.0), FitParameter("b", 0.1, 0.0, 9.0)]
    for seed in range(40):
        report = identifiability(plant, [measured(plant, {"a": -0.02, "b": -0.02}, 0.05, seed)], free, starts=1)
        if all(v.verdict == "at-bound" for v in report.parameters.values()):
            break
    else:
        raise AssertionError("no sample has both on their bounds")
    assert report.identifiable == () and set(report.held) == {"a", "b"}
    alone = identifiability(
        plant, [measured(plant, {"a": -0.02, "b": -0.02}, 0.05, seed)], free[:1], starts=1, held={"b": 0.0}
    )
    assert 0 < report.parameters["a"].ci95[1] < 2.5 * alone.parameters["a"].ci95[1]
    # The rise at the limit of a: the 95 % quantile by SciPy's non-negative least squares of noise on top of that limit.
    found = report.parameters["a"]
    columns, random = np.column_stack([np.ones(T.size), T]) / 0.05, np.random.default_rng(5)
    rises = []
    for noise in random.standard_normal((3000, T.size)):
        y = columns[:, 0] * found.ci95[1] + noise
        (best, _), left = nnls(columns, y)
        _, beside = nnls(columns[:, 1:], noise)
        rises.append(0.5 * (beside**2 - left**2) if best < found.ci95[1] else 0.0)
    rise = found.profile.threshold / report.thresholds["a"] * TWO_SIDED
    # It was asked at the limit for one alone, which lies farther out, where the bound of a takes less of the scatter.
    assert np.quantile(rises, 0.95) < rise < 0.75 * ONE_SIDED


def test_the_bootstrap_of_one_on_its_bound_is_the_known_quantile() -> None:
    plant = closed(line, a=0.0, b=Parameter(0.1, min=0.0))
    free = (FitParameter("a", 0.0, -9, 9), FitParameter("b", 0.1, 0.0, 9.0))
    optimum, _ = pilot_fit(Problem(plant, (measured(plant, {"a": 1, "b": 0.0}, 0.05),), free), starts=1)
    assert bootstrap_rise(optimum, "b", 5.0) == pytest.approx(1.353, rel=0.15)


def plateau(t, p):
    """y = a (1 - exp(-k t)) + c t."""
    e = np.exp(-p["k"] * t)
    return p["a"] * (1 - e) + p["c"] * t, {"a": 1 - e, "k": p["a"] * t * e, "c": t}


def test_a_limit_far_from_its_bound_is_not_read_at_the_bound_where_several_are_on_bounds() -> None:
    """A rate that has no upper limit, over eight decades, beside a slope below its bound: scipy profiles the same cost."""
    physical = {"k": Parameter(10.0, min=1e-3, max=1e5), "c": Parameter(0.1, min=0.0)}
    t = np.linspace(0.05, 1.0, 60)
    y = 2.0 - 0.02 * t + 0.02 * np.random.default_rng(5).normal(size=t.size)
    y[:3] += 0.02  # no slower than a step
    data = recorded("e", t, {"y": 0.02}, y=y)
    free = [FitParameter("a", 1, 0.1, 10), FitParameter("k", 1e5, 1e-3, 1e5), FitParameter("c", 0.1, 0.0, 5.0)]
    report = identifiability(closed(plateau, a=1.0, **physical), [data], free, starts=4)
    assert {n for n, v in report.parameters.items() if v.verdict == "at-bound"} == {"k", "c"}

    def cost(k):
        columns = np.column_stack([1 - np.exp(-k * t), t]) / 0.02
        return lsq_linear(columns, y / 0.02, ([0.1, 0.0], [10.0, 5.0])).cost

    least = cost(1e5)
    low, high = (brentq(lambda k, rise=rise: cost(k) - least - rise, 5, 5000) for rise in (2.7, 0.7))
    limit = report.parameters["k"].ci95[0]
    assert low < limit < high < 1000


@pytest.mark.parametrize("tone, flagged", [(0.0, False), (1.3, False), (6.0, True)])
def test_identify_and_fit_call_the_same_misfit_larger_than_the_noise(tone, flagged):
    """A tone of so many standard deviations is in the record and not in the model; below half the power it is left alone."""
    simulator = closed(saturating, a=2.0, k=3.0)
    record = measured(simulator, {"a": 2.0, "k": 3.0}, 0.01)
    y = record.measured["y"] + 0.01 * tone * np.sin(2 * np.pi * 7.0 * record.time)
    record = recorded("e", record.time, {"y": 0.01}, y=y)
    problem = Problem(simulator, (record,), (FitParameter("a", 2.0, 0.1, 10.0), FitParameter("k", 3.0, 0.1, 20.0)))
    result = fit(problem, starts=1)
    at = LocalAnalysis(problem, np.array([result.values["a"], result.values["k"]]))
    assert at.excess == pytest.approx(result.adequacy.widening)
    assert (at.excess > 1.0) == flagged
