"""Coverage of the 95 % intervals by Monte Carlo, and the modes that make several fits."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from hvdc_ident.errors import InputError
from hvdc_ident.fit import FitParameter, Group, Problem, fit, fit_each, fit_individually
from tests.fit.simulators import Closed, coloured, decay, line, parameters, recorded

pytestmark = pytest.mark.nightly

T = np.linspace(0.0, 1.0, 200)
FREE = (FitParameter("a", 0.0, -50, 50), FitParameter("b", 0.0, -50, 50))
LINE = Closed(parameters(a=0.0, b=0.0), {"y": line})


def covered(rho: float, given: bool, t: np.ndarray, fits: int = 200) -> dict[str, int]:
    """How often the interval of each parameter holds its true value."""
    hits = {"a": 0, "b": 0}
    for seed in range(fits):
        y = 1.0 + 2.0 * t + coloured(np.random.default_rng(seed), t.size, rho, 0.3)
        result = fit(Problem(LINE, (recorded("e", t, {"y": 0.3} if given else {}, y=y),), FREE), starts=1, assess=False)
        for name, truth in (("a", 1.0), ("b", 2.0)):
            low, high = result.estimates[name].ci95
            hits[name] += low <= truth <= high
    return hits


@pytest.mark.parametrize("given", [True, False])
@pytest.mark.parametrize("n", [12, 200])
def test_intervals_hold_the_truth_19_times_in_20_in_white_noise(given, n):
    fits = 200
    low, high = binom.ppf([0.001, 0.9995], fits, 0.95)
    for hits in covered(0.0, given, np.linspace(0, 1, n), fits).values():
        assert low <= hits <= high


@pytest.mark.parametrize("given", [True, False])
@pytest.mark.parametrize("rho", [0.5, 0.9])
def test_intervals_hold_the_truth_in_coloured_noise(rho, given):
    fits = 200
    low = binom.ppf(0.001, fits, 0.93)  # rho is estimated from 200 rows: a nominal 95 % may lose two points
    for hits in covered(rho, given, T, fits).values():
        assert hits >= low


def test_whitening_with_the_right_coefficient_covers_too():
    hits = 0
    for seed in range(300):
        y = 1.0 + 2.0 * T + coloured(np.random.default_rng(seed), T.size, 0.9, 0.3)
        problem = Problem(LINE, (recorded("e", T, {"y": 0.3}, y=y),), FREE, rho={"y": 0.9})
        low, high = fit(problem, starts=1, assess=False).estimates["b"].ci95
        hits += low <= 2.0 <= high
    assert binom.ppf(0.001, 300, 0.95) <= hits <= binom.ppf(0.9995, 300, 0.95)


def pair() -> Problem:
    """Two outputs, each with parameters of its own, in two experiments."""

    def first(t, p):
        y, g = decay(t, p)
        return y, {**g, "b": 0 * t, "c": 0 * t}

    def second(t, p):
        return p["b"] + p["c"] * t, {"a": 0 * t, "k": 0 * t, "b": 1 + 0 * t, "c": t}

    simulator = Closed(parameters(a=1.0, k=1.0, b=0.0, c=0.0), {"y": first, "z": second})
    truth = {"a": 2.0, "k": 1.5, "b": 0.3, "c": -0.7}
    runs = []
    for i in range(2):
        rng = np.random.default_rng(i)
        data = {n: f(T, truth)[0] + 0.01 * rng.normal(size=T.size) for n, f in (("y", first), ("z", second))}
        runs.append(recorded(f"e{i}", T, {"y": 0.01, "z": 0.01}, **data))
    free = (
        FitParameter("a", 1, 0.1, 10),
        FitParameter("k", 1, 0, 5),
        FitParameter("b", 0, -3, 3),
        FitParameter("c", 0, -3, 3),
    )
    return Problem(simulator, tuple(runs), free)


def test_groups_are_fitted_one_after_the_other():
    groups = (Group(("a", "k"), ("y",)), Group(("b", "c"), ("z",), ("e1",)))
    result = fit_individually(pair(), groups, starts=2)
    whole = fit(pair(), starts=2)
    assert result.status == "converged", result.message
    assert result.fitted == ("a", "k", "b", "c")
    for name in ("a", "k"):
        assert result.estimates[name].value == pytest.approx(whole.estimates[name].value, rel=1e-6)
        assert result.estimates[name].conditional_on == ("b", "c")
    assert result.estimates["b"].value != whole.estimates["b"].value
    assert result.estimates["b"].value == pytest.approx(0.3, abs=0.01)
    assert result.cost == pytest.approx(whole.cost, rel=0.05)
    assert {s.group for s in result.starts} == {0, 1}
    assert set(result.residual_tests["z"]) == {"e0", "e1"}
    assert result.held == {}


@pytest.mark.parametrize(
    ("groups", "message"),
    [
        ((Group(("a", "k")),), "every free parameter once"),
        ((Group(("a", "k", "b", "c"), ("w",)),), "no measured output 'w'"),
        ((Group(("a", "k", "b", "d")),), "no free parameter 'd'"),
        ((Group(("a", "k", "b", "c"), (), ("e7",)),), "no fitted experiment 'e7'"),
    ],
)
def test_groups_that_do_not_fit_are_refused(groups, message):
    with pytest.raises(InputError, match=message):
        fit_individually(pair(), groups)


def test_fits_to_single_experiments_make_a_spread():
    table = fit_each(pair())
    assert table["k"]["n"] == 2
    assert set(table["k"]["experiments"]) == {"e0", "e1"}
    low, high = table["k"]["ci95_of_mean"]
    assert low < table["k"]["mean"] < high
    values = [e["value"] for e in table["k"]["experiments"].values()]
    assert high - low == pytest.approx(2 * 12.7062047 * np.std(values, ddof=1) / np.sqrt(2), rel=1e-6)
