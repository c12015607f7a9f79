"""Searches that meet values at which nothing can be simulated, or many optima."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import gammaln

import hvdc_ident as hi
from hvdc_ident.errors import SteadyStateError
from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.fit.search import MOST_STARTS, UNVISITED, unvisited
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, parse_card
from hvdc_ident.simulate import ModelSimulator

pytestmark = pytest.mark.nightly

LATE = """
schema = 1
name = "late"
[parameters]
T = {value = 0.02, unit = "s"}
k = {value = 0.8}
[inputs]
u = {value = 0.0}
[states]
x = {derivative = "2*(k*late - x)"}
[delays]
late = {of = "u", time = "T"}
[outputs]
x = "x"
"""
TIME = np.linspace(0.0, 4.0, 401)
STEP = hi.step(0.0, 1.0, at=0.5)

TANK = """
schema = 1
name = "tank"
[parameters]
k = {value = 0.2, min = 0.05, max = 3.0}
area = {value = 1.0, min = 0.2, max = 4.0}
[inputs]
q = {value = 0.3}
[states]
h = {derivative = "(q - k*h/(1 + h))/area", guess = 0.5}
[outputs]
h = "h"
"""
"""The level rests only where the outflow can become as large as the inflow: k > q."""
TANK_STUDY = """
schema = 1
[model]
source = "tank.toml"
[parameters]
k = {}
area = {}
[[experiment]]
name = "more"
data = "more.csv"
inputs = ["q"]
outputs = ["h"]
noise = {h = 1e-3}
[fit]
"""

WAVE = """
schema = 1
name = "wave"
[parameters]
f = {value = 7.1, unit = "Hz", min = 1.0, max = 60.0}
a = {value = 1.0, min = 0.2, max = 3.0}
[states]
x = {derivative = "0", start = 0}
[outputs]
y = "a*sin(2*pi*f*time) + x"
"""


def late_record(true: float) -> hi.Experiment:
    """x of a first-order lag of 0.5 s behind the delay, in closed form, with noise."""
    since = np.maximum(TIME - 0.5 - true, 0.0)
    y = 0.8 * (1.0 - np.exp(-2.0 * since)) + 1e-3 * np.random.default_rng(4).standard_normal(TIME.size)
    return hi.Experiment(TIME, inputs={"u": STEP}, outputs={"x": y}, noise={"x": 1e-3}, role="fit")


@pytest.mark.parametrize("bounds", [{"T": (0.0, 1.0), "k": (0.2, 3.0)}, {"T": {}, "k": (0.2, 3.0)}])
def test_a_delay_is_estimated_though_its_range_reaches_0(bounds):
    found = hi.fit(parse_card(LATE), late_record(0.3), bounds, starts=3)
    low, high = found.estimates["T"].ci95
    assert low < 0.3 < high and high - low < 0.01


def test_a_search_for_a_delay_may_begin_at_0():
    found = hi.fit(
        parse_card(LATE.replace("0.02", "0.0")), late_record(0.3), {"T": (0.0, 1.0), "k": (0.2, 3.0)}, starts=1
    )
    low, high = found.estimates["T"].ci95
    assert low < 0.3 < high and high - low < 0.01


def test_a_delay_that_is_not_there_is_found_at_its_bound_with_an_upper_limit():
    report = hi.identify(parse_card(LATE), late_record(0.0), {"T": (0.0, 1.0), "k": (0.2, 3.0)})
    verdict = report.parameters["T"]
    low, high = verdict.ci95
    # The one-sided limit of a parabola from the closed form, whose minimum by this noise lies somewhat below 0.
    since = np.maximum(TIME - 0.5, 0.0)
    columns = np.column_stack([-1.6 * np.exp(-2.0 * since) * (since > 0), 1.0 - np.exp(-2.0 * since)]) / 1e-3
    std = float(np.sqrt(np.linalg.inv(columns.T @ columns)[0, 0]))
    assert verdict.verdict == "at-bound" and verdict.value == 0.0
    assert low == 0.0 and 0.2 * std < high < 1.645 * std


def tank(folder: Path, card: str = TANK) -> Path:
    """A study whose given values have no steady state; the plant has k = 0.9 and area = 0.7."""
    time = np.linspace(0.0, 20.0, 401)
    flow = np.where(time < 2.0, 0.3, 0.4)
    rest = 0.3 / (0.9 - 0.3)
    found = solve_ivp(
        lambda t, h: (0.4 - 0.9 * h / (1.0 + h)) / 0.7,
        (2.0, 20.0),
        [rest],
        t_eval=time[time >= 2.0],
        rtol=1e-10,
        atol=1e-12,
    )
    level = np.concatenate([np.full((time < 2.0).sum(), rest), found.y[0]])
    level += 1e-3 * np.random.default_rng(5).standard_normal(time.size)
    rows = np.column_stack([time, flow, level])
    np.savetxt(folder / "more.csv", rows, delimiter=",", header="time,q,h", comments="", fmt="%.9g")
    (folder / "tank.toml").write_text(card, encoding="utf-8")
    (folder / "study.toml").write_text(TANK_STUDY, encoding="utf-8")
    return folder / "study.toml"


def test_a_first_start_without_a_steady_state_is_one_failed_start(tmp_path, capsys):
    from typer.testing import CliRunner

    from hvdc_ident.cli import app

    outcome = CliRunner().invoke(app, ["run", str(tank(tmp_path)), "--quiet"])
    assert outcome.exit_code == 1, outcome.output  # the given values cannot be simulated, and the rest is done
    results = tmp_path / "study-results"
    fitted = json.loads((results / "fit.json").read_text(encoding="utf-8"))
    assert fitted["starts"][0]["status"] == "failed" and "no steady state" in fitted["starts"][0]["message"]
    for name, true in (("k", 0.9), ("area", 0.7)):
        low, high = fitted["estimates"][name]["ci95"]
        assert low - 0.3 * (high - low) < true < high + 0.3 * (high - low)
    simulated = json.loads((results / "simulation.json").read_text(encoding="utf-8"))
    assert "at the given values no steady state" in simulated["experiments"]["more"]["reason"]


def test_a_model_without_a_steady_state_in_all_of_its_ranges_is_wrong_input(tmp_path):
    path = tank(tmp_path, TANK.replace("max = 3.0", "max = 0.25"))
    with pytest.raises(SteadyStateError, match="no steady state"):
        hi.fit(str(path))


def wave_record(begin: float = 0.0) -> hi.Experiment:
    """3 s of a sine: begun late, no part of it is short of an optimum in every band of the frequency."""
    time = begin + np.linspace(0.0, 3.0, 1501)
    y = np.sin(2.0 * np.pi * 7.0 * time) + 0.01 * np.random.default_rng(6).standard_normal(time.size)
    return hi.Experiment(time, outputs={"y": y}, noise={"y": 0.01}, role="fit")


def test_an_optimum_that_one_start_alone_reached_is_told_with_doubt():
    """The cost over a frequency has an optimum in every band of 1/3 Hz: of eight starts the nearest alone finds the lowest."""
    found = hi.fit(parse_card(WAVE), wave_record(2.0), ["f", "a"], starts=8)
    assert found.estimates["f"].value == pytest.approx(7.0, abs=0.01)
    costs = sorted(s.cost for s in found.starts)
    assert costs[1] > 10.0 * costs[0]  # the others did end elsewhere
    assert found.search_doubt.startswith("one start of 8 alone reached the lowest cost")
    assert found.message.startswith(found.search_doubt) and " ".join(str(found).split()).startswith(
        "Fit: converged. One start of 8 alone"
    )


def test_where_one_start_alone_reached_the_lowest_cost_more_follow_by_themselves():
    problem = wave_problem(2.0)
    found = fit(problem, assess=False)
    assert found.search_doubt == "" and found.values["f"] == pytest.approx(7.0, abs=0.01)
    lowest = min(s.cost for s in found.starts)
    assert sum(s.cost < 1.01 * lowest for s in found.starts) > 1
    eight = fit(problem, starts=8, assess=False)
    assert [s.start for s in found.starts[:8]] == [s.start for s in eight.starts]  # the others come on top
    assert len(eight.starts) == 8 < len(found.starts) <= 64


def test_a_misfit_calls_for_further_starts_unless_it_is_expected():
    """Of eight starts over three bands of the frequency more than one finds the lowest; no model without an offset comes to the noise.

    With so few optima further starts end where hardly one is expected to lead elsewhere, whether or not the noise is stated.
    """
    record = wave_record()
    lifted = record.with_(measured=replace(record.measured, values=record.measured.values + 0.3))
    problem = replace(
        wave_problem(), experiments=(lifted,), free=(FitParameter("f", 7.1, 6.5, 7.5), FitParameter("a", 1.0, 0.2, 3.0))
    )
    asked, expected = fit(problem, assess=False), fit(problem, assess=False, misfit_expected=True)
    lowest = min(s.cost for s in expected.starts)
    assert 1 < sum(s.cost < 1.01 * lowest for s in expected.starts) < len(expected.starts) == 8
    silent = replace(problem, experiments=(replace(lifted, noise=FrozenMap()),))
    for found in (asked, fit(silent, assess=False)):
        levels = len({round(np.log(s.cost), 5) for s in found.starts})
        assert 8 < len(found.starts) < MOST_STARTS and found.values["f"] == pytest.approx(
            expected.values["f"], rel=1e-6
        )
        assert unvisited(levels, len(found.starts)) <= UNVISITED < unvisited(levels, len(found.starts) // 2)


def test_starts_go_on_while_the_lowest_cost_leaves_a_smooth_course_of_unknown_noise():
    """Of eight starts none finds the frequency of a sine; several end at one optimum, whose residual is another sine."""
    time = np.linspace(0.0, 10.0, 200)
    model = Model(
        "tone",
        parameters={"A": 0.9, "w": 2.0, "ph": 0.01},
        states={"z": {"derivative": "0", "start": "0"}},
        outputs={"y": "A*sin(w*time + ph)"},
    )
    free = (FitParameter("A", 0.9, 0, 5), FitParameter("w", 2.0, 0.5, 6), FitParameter("ph", 0.01, 0, 2 * np.pi))
    for noise, phase in ((0.0, 0.05), (0.01, 1.5)):
        y = 1.3 * np.sin(2.9 * time + phase) + noise * np.random.default_rng(0).standard_normal(time.size)
        problem = Problem(ModelSimulator(model), (hi.Experiment(time, outputs={"y": y}),), free)
        eight = fit(problem, starts=8, assess=False)
        assert min(abs(s.end["w"] - 2.9) for s in eight.starts if s.end["A"] > 0.1) > 0.2
        found = fit(problem, assess=False)
        assert found.values == pytest.approx({"A": 1.3, "w": 2.9, "ph": phase}, abs=0.5 * noise + 1e-6)


def test_the_expected_share_of_unvisited_starts_is_that_of_its_posterior():
    """One optimum after n searches: a uniform prior of the number of optima and of their shares, summed over the numbers."""
    n = 8
    numbers = np.arange(1, 20_000)
    # Likelihood of all n in one of k optima: k * E[share^n] = k * n! (k-1)!/(n+k-1)!; the next is elsewhere: 1 - (n+1)/(n+k).
    likelihood = numbers * np.exp(gammaln(n + 1) + gammaln(numbers) - gammaln(n + numbers))
    elsewhere = float(likelihood @ (1.0 - (n + 1.0) / (n + numbers)) / likelihood.sum())
    assert unvisited(1, n) == pytest.approx(elsewhere, rel=1e-3)


def test_a_search_is_taken_up_from_where_its_runs_ended():
    problem = wave_problem()
    first = fit(problem, starts=8, assess=False)
    again = fit(problem, starts=8, assess=False, begun=first.starts)
    assert [s.start for s in again.starts] == [s.start for s in first.starts]
    assert again.cost == pytest.approx(first.cost, rel=1e-9) and again.search_doubt == first.search_doubt
    spent, before = (sum(s.evaluations for s in r.starts) for r in (again, first))
    assert spent - before < 0.2 * before


def test_identify_and_fit_of_one_run_stand_at_one_optimum():
    names = ["f", "a"]
    report = hi.identify(parse_card(WAVE), wave_record(), names)
    found = hi.fit(parse_card(WAVE), wave_record(), names, report=report)
    assert found.values["f"] == pytest.approx(report.parameters["f"].value, rel=1e-6)
    assert [dict(s.start) for s in found.starts] == [dict(s.start) for s in report.pilot.ends]


def test_starts_that_agree_leave_no_doubt():
    near = hi.fit(parse_card(WAVE), wave_record(), {"f": (6.9, 7.1), "a": (0.2, 3.0)})
    assert near.search_doubt == ""
    alone = fit(wave_problem(), starts=1, assess=False)
    assert alone.search_doubt == ""  # one start was asked for


def wave_problem(begin: float = 0.0) -> Problem:
    free = (FitParameter("f", 7.1, 1.0, 60.0), FitParameter("a", 1.0, 0.2, 3.0))
    return Problem(ModelSimulator(parse_card(WAVE)), (wave_record(begin),), free)


def test_starts_along_a_valley_agree():
    """Only f*g enters: the starts end at other places with the same cost."""
    card = WAVE.replace("a*sin(2*pi*f*time)", "a*sin(2*pi*f*g*time)").replace(
        "[states]", "g = {value = 1.0, min = 0.99, max = 1.01}\n[states]"
    )
    model = parse_card(card)
    free = [FitParameter("f", 7.0, 6.95, 7.05), FitParameter("g", 1.0, 0.99, 1.01)]
    found = fit(Problem(ModelSimulator(model), (wave_record(),), tuple(free)), starts=5, assess=False)
    assert len({round(s.end["g"], 4) for s in found.starts}) > 1
    assert found.search_doubt == ""
