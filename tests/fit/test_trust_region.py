"""The optimiser: bounds, failing regions, scaling."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hvdc_ident.errors import UnknownNameError
from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.fit.optimiser import OptimiserResult
from hvdc_ident.fit.optimisers import catalogue, optimiser
from hvdc_ident.fit.optimisers.trust_region import TrustRegion
from tests.fit.simulators import Closed, decay, line, parameters, recorded

T = np.linspace(0.0, 3.0, 31)


def problem(fails=lambda p: False, **bounds) -> Problem:
    """The decay 2 exp(-1.5 t) to be found, without noise."""
    simulator = Closed(parameters(a=1.0, k=1.0), {"y": decay}, fails)
    limits = {"a": (0.1, 10.0), "k": (0.0, 20.0)} | bounds
    free = (FitParameter("a", 1.0, *limits["a"]), FitParameter("k", 1.0, *limits["k"]))
    return Problem(simulator, (recorded("e", T, {"y": 0.1}, y=2 * np.exp(-1.5 * T)),), free)


def test_the_catalogue_names_every_file():
    assert "trust-region" in catalogue()
    assert all(m.SUMMARY and m.OPTIMISER().run for m in catalogue().values())
    assert optimiser("trust-region") == TrustRegion()
    with pytest.raises(UnknownNameError, match="did you mean 'trust-region'"):
        optimiser("trust-regon")


@pytest.mark.parametrize("start", [(1.0, 1.0), (10.0, 0.0), (0.1, 20.0), (0.1, 0.0)])
def test_it_recovers_exact_values_without_noise(start):
    run = TrustRegion().run(problem(), np.array(start))
    assert run.status == "converged", run.message
    assert run.theta == pytest.approx([2.0, 1.5], rel=1e-9)
    assert run.evaluations < 40


def test_an_optimum_outside_ends_on_the_bound_with_the_others_at_their_best():
    run = TrustRegion().run(problem(k=(0.0, 1.2)), np.array([1.0, 1.0]))
    assert run.status == "converged"
    assert run.theta[1] == 1.2
    e, y = np.exp(-1.2 * T), 2.0 * np.exp(-1.5 * T)
    assert run.theta[0] == pytest.approx(y @ e / (e @ e), rel=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_bounded_linear_problems_end_as_an_exhaustive_search_does(seed):
    from scipy.optimize import lsq_linear

    rng = np.random.default_rng(seed)
    p = 5
    matrix = rng.normal(size=(12, p)) @ (np.eye(p) + 0.8 * rng.normal(size=(p, p)))
    y = rng.normal(size=12)
    names = [f"b{i}" for i in range(p)]

    def product(t, values):
        return matrix @ [values[n] for n in names], {n: matrix[:, i] for i, n in enumerate(names)}

    simulator = Closed(parameters(**dict.fromkeys(names, 0.0)), {"y": product})
    free = tuple(FitParameter(n, 0.0, -0.1, 0.1) for n in names)
    one = Problem(simulator, (recorded("e", np.arange(12.0), {"y": 1.0}, y=y),), free)
    run = TrustRegion().run(one, one.start)
    best = lsq_linear(matrix, y, (-0.1, 0.1), method="bvls", tol=1e-14)
    assert run.status == "converged"
    assert run.theta == pytest.approx(best.x, abs=1e-7)


def test_it_walks_round_where_simulations_fail():
    run = TrustRegion().run(problem(fails=lambda p: p["k"] > 1.6), np.array([9.0, 0.01]))
    assert run.status == "converged"
    assert run.theta == pytest.approx([2.0, 1.5], rel=1e-8)


def test_an_optimum_behind_a_failing_region_is_a_failure_with_its_reason():
    run = TrustRegion().run(problem(fails=lambda p: p["k"] > 1.2), np.array([1.0, 1.0]))
    assert run.status == "failed"
    assert "every step down leads to where the simulation fails" in run.message
    assert "the run does not reach its end" in run.message
    assert run.cost is not None
    assert run.theta[1] <= 1.2


def test_a_start_that_fails_has_no_cost():
    run = TrustRegion().run(problem(fails=lambda p: True), np.array([1.0, 1.0]))
    assert (run.status, run.cost, run.evaluations) == ("failed", None, 1)
    assert run.message.startswith("the start cannot be simulated")


def test_it_stops_at_its_evaluations():
    run = TrustRegion(max_evaluations=3).run(problem(), np.array([0.1, 20.0]))
    assert (run.status, run.evaluations) == ("max-evaluations", 3)


def test_sensitivities_that_are_wrong_do_not_pass_as_an_optimum():
    def wrong(t, p):
        y, g = line(t, p)
        return y, {n: -v for n, v in g.items()}

    simulator = Closed(parameters(a=0.0, b=0.0), {"y": wrong})
    free = (FitParameter("a", 0.0, -5, 5), FitParameter("b", 0.0, -5, 5))
    one = Problem(simulator, (recorded("e", T, {"y": 1.0}, y=1 + T),), free)
    run = TrustRegion().run(one, one.start)
    assert run.status == "stalled"
    assert "the sensitivities promise a lower cost that no step reaches" in run.message
    assert fit(one).status == "not-converged"


def clipped(t, p):
    """y = clip(g (1 + t), -2, 2): flat in g beyond where every row is limited."""
    y = p["g"] * (1 + t)
    return np.clip(y, -2.0, 2.0), {"g": np.where(np.abs(y) < 2.0, 1 + t, 0.0)}


def limited(start: float, truth: float = 0.3) -> Problem:
    y = clipped(T, {"g": truth})[0] + 1e-3 * np.random.default_rng(1).standard_normal(T.size)
    simulator = Closed(parameters(g=start), {"y": clipped})
    return Problem(simulator, (recorded("e", T, {"y": 1e-3}, y=y),), (FitParameter("g", start, -100.0, 100.0),))


def test_a_start_on_a_plateau_did_not_converge_and_the_others_decide():
    run = TrustRegion().run(limited(50.0), np.array([50.0]))
    assert (run.status, run.evaluations) == ("flat", 1)
    result = fit(limited(50.0), starts=40)
    ends = [s.status for s in result.starts]
    assert result.status == "converged" and ends[0] == "flat" and ends.count("flat") > len(ends) / 2
    assert result.estimates["g"].value == pytest.approx(0.3, abs=4 * result.estimates["g"].std)
    assert "could not move" in result.message


def test_where_every_start_is_on_a_plateau_nothing_converged():
    result = fit(limited(50.0), starts=1)
    assert result.status == "not-converged"
    assert "did not move" in result.message
    assert result.estimates["g"].std is None


def jagged(t, p):
    """The decay with an error that jumps from one value of k to the next, as adaptive steps make it."""
    y, g = decay(t, p)
    seed = abs(hash((p["k"], p["a"]))) % 2**32
    return y + 2e-4 * np.random.default_rng(seed).standard_normal(), g


@pytest.mark.parametrize("sigma", [1e-3, 1e-4])
def test_a_cost_that_scatters_by_the_simulations_own_error_is_minimised_to_within_it(sigma):
    y = 2 * np.exp(-1.5 * T) + 0.1 * sigma * np.random.default_rng(3).standard_normal(T.size)
    simulator = Closed(parameters(a=1.0, k=1.0), {"y": jagged})
    free = (FitParameter("a", 1.0, 0.1, 10), FitParameter("k", 1.0, 0, 20))
    one = Problem(simulator, (recorded("e", T, {"y": sigma}, y=y),), free)
    run = TrustRegion().run(one, one.start)
    assert run.status == "converged", run.message
    assert run.theta == pytest.approx([2.0, 1.5], abs=2e-3)
    result = fit(one)
    assert result.status == "converged", result.message
    assert result.cost <= min(s.cost for s in result.starts if s.cost is not None)


class Mislabelled(TrustRegion):
    """Calls its optimum a stall, and a far worse point converged."""

    def run(self, problem, start):
        worse = np.array([1.0, 5.0])
        if start[1] > 10.0:
            return OptimiserResult(worse, problem.cost(worse), "converged", "so it says", 1)
        return replace(super().run(problem, start), status="stalled")


def test_the_lowest_cost_is_the_answer_whatever_stopped_the_run_that_reached_it():
    result = fit(problem(), optimiser=Mislabelled(), starts=8)
    assert {s.status for s in result.starts} == {"stalled", "converged"}
    assert result.cost == min(s.cost for s in result.starts)
    assert result.status == "converged"
    assert result.estimates["k"].value == pytest.approx(1.5, rel=1e-6)


def test_scaling_follows_the_bounds():
    assert FitParameter("a", 2.0, 1.0, 11.0).log
    assert not FitParameter("a", 2.0, 1.0, 9.0).log
    assert not FitParameter("a", 2.0, 0.0, 9.0).log
    assert FitParameter("a", 2.0, 0.0, 8.0).span == 8.0
    assert FitParameter("a", 2.0).span == 2.0
    assert FitParameter("a", 1.0, 0.01, 100.0).draw(0.5) == pytest.approx(1.0)
    assert FitParameter("a", 1.0, 0.0).drawn == (0.0, 11.0)


def test_a_point_whose_sensitivities_overflow_is_walked_round():
    def blowing(t, p):
        y, slopes = decay(t, p)
        return y, {n: s * (1e200 if p["k"] > 1.2 else 1.0) for n, s in slopes.items()}

    simulator = Closed(parameters(a=1.0, k=1.0), {"y": blowing})
    free = (FitParameter("a", 1.0, 0.1, 10.0), FitParameter("k", 1.0, 0.0, 20.0))
    found = Problem(simulator, (recorded("e", T, {"y": 0.1}, y=2 * np.exp(-1.5 * T)),), free)
    run = TrustRegion().run(found, np.array([1.0, 1.0]))
    assert run.status == "failed" and "grows beyond all bounds" in run.message
    assert run.theta[1] <= 1.2


def saturating(t, p):
    """y = b1 (1 - exp(-b2 t)): a full first step from small values lands where b2 shows nothing any more."""
    e = np.exp(-p["b2"] * t)
    return p["b1"] * (1 - e), {"b1": 1 - e, "b2": p["b1"] * t * e}


@pytest.mark.parametrize("start", [(1.0, 1.0), (0.01, 3.0), (-5.0, 0.2)])
def test_without_bounds_a_start_far_off_in_size_finds_the_optimum(start):
    t = np.array([1.0, 2.0, 3.0, 5.0, 7.0, 10.0])
    simulator = Closed(parameters(b1=start[0], b2=start[1]), {"y": saturating}, lambda p: p["b2"] < -30)
    y = saturating(t, {"b1": 214.0, "b2": 0.55})[0] + np.array([-5.0, 20.0, -20.0, 5.0, 3.0, -3.0])
    free = (FitParameter("b1", start[0]), FitParameter("b2", start[1]))
    result = fit(Problem(simulator, (recorded("e", t, y=y),), free))
    from scipy.optimize import curve_fit

    best, _ = curve_fit(lambda t, a, b: a * (1 - np.exp(-b * t)), t, y, (200.0, 0.5))
    assert result.status == "converged", result.message
    assert [result.values["b1"], result.values["b2"]] == pytest.approx(best, rel=1e-5)


def test_starts_without_bounds_spread_over_the_sizes():
    draws = [FitParameter("a", 2.0).draw(s) for s in np.linspace(0, 1, 41)]
    assert draws == sorted(draws) and min(draws) == pytest.approx(-18.0) and max(draws) == pytest.approx(22.0)
    sizes = np.abs(draws)
    assert (np.array(draws) > 0).mean() == pytest.approx(0.75, abs=0.03)
    assert (sizes < 0.2).sum() > 8 and (sizes > 2.0).sum() > 8
    assert all(v >= 0 for v in (FitParameter("a", 2.0, 0.0).draw(s) for s in (0.0, 0.5, 1.0)))
    assert all(v <= 0 for v in (FitParameter("a", -2.0, max=0.0).draw(s) for s in (0.0, 0.5, 1.0)))


def test_of_optima_that_differ_by_names_alone_the_one_next_to_the_start_is_told():
    def pair(t, p):
        a, b = np.exp(-p["k1"] * t), np.exp(-p["k2"] * t)
        return a + b, {"k1": -t * a, "k2": -t * b}

    simulator = Closed(parameters(k1=1.0, k2=1.0), {"y": pair})
    y = pair(T, {"k1": 0.5, "k2": 3.0})[0] + 0.01 * np.random.default_rng(1).standard_normal(T.size)
    for given in ({"y": 0.01}, {}):
        for start, first in (((0.4, 4.0), 0.5), ((4.0, 0.4), 3.0)):
            free = (FitParameter("k1", start[0], 0.01, 50), FitParameter("k2", start[1], 0.01, 50))
            result = fit(Problem(simulator, (recorded("e", T, given, y=y),), free), starts=12)
            assert result.status == "two-optima"
            assert result.values["k1"] == pytest.approx(first, rel=0.1)
