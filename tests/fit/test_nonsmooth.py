"""Fits of simulators whose runs jump from one parameter value to the next."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.stats import binom

from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.fit.nonsmooth import SLIGHT, roughness, trend_of
from hvdc_ident.fit.uncertainty import TWO_SIDED
from hvdc_ident.identifiability.assess import identifiability
from hvdc_ident.study.plausibility import violations
from tests.fit.simulators import Closed, decay, parameters, recorded

T = np.linspace(0.0, 3.0, 31)
SIGMA = 0.02
TRUTH = {"a": 2.0, "k": 1.5}
FREE = (FitParameter("a", 1.0, 0.1, 10.0), FitParameter("k", 1.0, 0.1, 20.0))


@dataclass
class Rough(Closed):
    """Its derivatives are the trend's, as differences over wide steps are."""

    sensitivity_error: float = 1e-3


def saw(size: float):
    """The decay, each row with a saw of its own in both parameters, even in [-size, size], with teeth 1e-4 wide."""

    def jumping(t, p):
        y, g = decay(t, p)
        share = (np.sqrt(2.0) * np.arange(1, t.size + 1)) % 1.0
        phase = 1e4 * (p["k"] / (1.0 + share) + 0.37 * p["a"] / (1.0 + share[::-1])) + 10.0 * share
        return y + size * (2.0 * (phase % 1.0) - 1.0), g

    return jumping


def late(size: float):
    """The decay with a rate that jumps as that of a run whose event is found anew at each value: all rows together."""

    def jumping(t, p):
        rate = p["k"] + size * (2.0 * ((1e4 * p["k"] + 3.7e3 * p["a"]) % 1.0) - 1.0)
        return decay(t, {**p, "k": rate})

    return jumping


def problem(seed: int, formula, kind: type[Closed] = Rough) -> Problem:
    y = decay(T, TRUTH)[0] + SIGMA * np.random.default_rng(seed).standard_normal(T.size)
    return Problem(kind(parameters(a=1.0, k=1.0), {"y": formula}), (recorded("e", T, {"y": SIGMA}, y=y),), FREE)


@pytest.mark.parametrize("size", [1e-3, 4e-3, 1e-2])
def test_the_roughness_is_what_the_cost_scatters_by(size):
    one = problem(0, saw(size))
    found = roughness(one, np.array([2.0, 1.5]))
    smooth = problem(0, decay)
    values = np.array([2.0, 1.5]) + 1e-3 * np.random.default_rng(1).uniform(-1, 1, (400, 2))
    apart = [one.cost(v) - smooth.cost(v) for v in values]
    assert found == pytest.approx(np.std(apart) + abs(np.mean(apart)), rel=0.5)


def test_exact_sensitivities_leave_every_figure_as_it_is():
    exact, told = (fit(problem(3, decay, kind), starts=2) for kind in (Closed, Rough))
    assert exact.to_dict() == told.to_dict()
    assert exact.roughness == {}
    assert roughness(problem(3, saw(1e-2), Closed), np.array([2.0, 1.5])) == 0.0


def test_a_roughness_that_moves_no_end_leaves_the_optimum_where_it_was_found():
    one = problem(3, saw(1e-4))
    theta = np.array(list(fit(one, starts=1).values.values()))
    assert 0.0 < roughness(one, theta) < SLIGHT * TWO_SIDED
    assert trend_of(one, theta) is None


@pytest.mark.parametrize(("formula", "fits"), [(saw(1e-2), 100), (late(0.03), 50)], ids=["rows apart", "rows together"])
def test_intervals_of_a_rough_cost_hold_the_truth_19_times_in_20(formula, fits):
    hits = dict.fromkeys(TRUTH, 0)
    for seed in range(fits):
        result = fit(problem(seed, formula), starts=1, assess=False)
        assert result.status == "converged", result.message
        assert result.roughness["delta_chi2"] > 2.0 * SLIGHT * TWO_SIDED
        for name, truth in TRUTH.items():
            low, high = result.estimates[name].ci95
            hits[name] += low <= truth <= high
    low, high = binom.ppf([0.001, 0.9995], fits, 0.95)
    assert all(low <= h <= high for h in hits.values()), hits


def test_the_starts_of_a_rough_cost_end_on_teeth_of_one_optimum():
    result = fit(problem(5, saw(1e-2)), starts=6)
    assert result.status == "converged"
    assert "no step reaches" not in "".join(s.message for s in result.starts)
    assert "jump from one parameter value to the next" in str(result)


@pytest.mark.parametrize(("formula", "seed"), [(saw(1e-2), 0), (late(0.1), 2)], ids=["rows apart", "rows together"])
def test_the_trends_estimate_is_plausible_though_a_start_ended_lower(formula, seed):
    """The interval of the trend holds the truth; the lowest local minimum that a start found is no better answer."""
    result = fit(problem(seed, formula), starts=6)
    told = result.to_dict()
    assert result.status == "converged" and all(low <= TRUTH[n] <= high for n, (low, high) in intervals(told).items())
    assert min(s.cost for s in result.starts) < result.cost - TWO_SIDED
    assert violations("fit", told) == []
    far = copy.deepcopy(told)  # beyond what luck explains, and not within the intervals
    far["starts"][1] |= {"cost": told["cost"] - 10.0 * told["roughness"]["delta_chi2"], "end": {"a": 3.0, "k": 1.5}}
    assert len(violations("fit", far)) == 1
    assert len(violations("fit", told | {"roughness": {}})) == 1  # of a smooth cost the lowest point is the optimum


def intervals(told):
    return {n: e["ci95"] for n, e in told["estimates"].items()}


def test_the_profile_of_a_rough_cost_is_its_trends():
    one, smooth = problem(5, saw(1e-2)), problem(5, decay)
    rough, plain = (identifiability(p.simulator, p.experiments, FREE, starts=2) for p in (one, smooth))
    assert rough.identifiable == plain.identifiable == ("a", "k")
    assert not rough.optima
    assert any("jump from one parameter value to the next" in n for n in rough.notes)
    for name, truth in TRUTH.items():
        low, high = rough.parameters[name].ci95
        width = np.subtract(*plain.parameters[name].ci95[::-1])
        assert low <= truth <= high
        assert high - low == pytest.approx(width, rel=0.2)


def in_steps(width: float):
    """The decay with a rate in steps, as of a simulator that acts at the instants of a fixed step only."""

    def jumping(t, p):
        return decay(t, {**p, "k": width * (np.floor(p["k"] / width) + 0.5)})

    return jumping


def test_where_nothing_changes_over_more_than_the_interval_all_of_it_is_in_the_interval():
    """Steps of 0.25 at a standard deviation of about 0.03: a short step finds no fall, and the linear interval is a tenth of one."""
    width, told = 0.25, 0
    for seed in range(20):
        truth = {"a": 2.0, "k": 1.5 + width * np.random.default_rng(seed).random()}
        y = in_steps(width)(T, truth)[0] + SIGMA * np.random.default_rng(100 + seed).standard_normal(T.size)
        simulator = Rough(parameters(a=1.0, k=1.0), {"y": in_steps(width)})
        found = fit(Problem(simulator, (recorded("e", T, {"y": SIGMA}, y=y),), FREE), starts=1)
        low, high = found.estimates["k"].ci95
        assert found.status == "converged"
        assert low - 0.01 <= 1.5 < 1.75 <= high + 0.01 or "answer in jumps" not in found.roughness["text"]
        assert high - low < 1.5 * width
        told += "answer in jumps" in found.roughness["text"] and low - 0.01 <= truth["k"] <= high + 0.01
    assert told >= 17  # elsewhere the run ended beside a jump, and the trend's optimum is given


def test_a_smooth_simulator_has_no_plateau():
    simulator = Rough(parameters(a=1.0, k=1.0), {"y": decay})
    y = decay(T, TRUTH)[0] + SIGMA * np.random.default_rng(1).standard_normal(T.size)
    smooth = Problem(simulator, (recorded("e", T, {"y": SIGMA}, y=y),), FREE)
    found = fit(smooth, starts=1)
    assert trend_of(smooth, np.array([found.values["a"], found.values["k"]])) is None
