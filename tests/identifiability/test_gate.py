"""The gated fit: what is held, what is stated, what --force does."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from typer.testing import CliRunner

from hvdc_ident.cli import app
from hvdc_ident.errors import UnknownNameError
from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.fit.descent import descend
from hvdc_ident.fit.uncertainty import TWO_SIDED
from hvdc_ident.identifiability import gate, gated_fit, identifiability
from hvdc_ident.parameters import Parameter
from tests.fit.simulators import line, recorded
from tests.identifiability.cases import closed, line_and_nothing, measured, product, saturating


def both(plant, data, free, force=()):
    report = identifiability(plant, data, free, starts=2)
    return report, gated_fit(Problem(plant, tuple(data), tuple(free)), report, partial(fit, starts=2), force=force)


def test_members_of_a_combination_are_conditional_on_the_held() -> None:
    plant = closed(product, a=2.0, b=3.0, c=1.0)
    free = [FitParameter("a", 2, 0.1, 20), FitParameter("b", 3, 0.1, 20), FitParameter("c", 1, -5, 5)]
    _, found = both(plant, [measured(plant, {"a": 2.5}, 0.01)], free)
    assert found.fitted == ("a", "c") and found.status == "converged"
    assert "structurally-unidentifiable, held at 3" in found.held["b"]
    assert found.estimates["a"].conditional_on == ("b",) and found.estimates["c"].conditional_on == ()
    assert found.estimates["a"].value == pytest.approx(2.5, abs=0.02) and found.values["b"] == 3.0


def test_weak_ones_have_an_interval_and_no_std() -> None:
    plant = closed(line, a=1.0, b=1.0)
    free = [FitParameter("a", 1, 0.1, 50), FitParameter("b", 1, 0.01, 50)]
    report, found = both(plant, [measured(plant, {"a": 5, "b": 1.5}, 2.0, t=np.linspace(0, 1, 80))], free)
    b = found.estimates["b"]
    assert b.std is None and b.std_raw is None and b.method == "profile" and b.reason.startswith("weak")
    assert b.ci95 == report.parameters["b"].ci95 and b.ci95[0] <= b.value <= b.ci95[1]
    assert found.estimates["a"].std is not None


def test_what_a_fit_elsewhere_than_the_report_may_state() -> None:
    """y = a^2 t + b with a of either sign, or a report of other records: no interval of the report stands about another value."""
    plant = closed(lambda t, p: (p["a"] ** 2 * t + p["b"], {"a": 2 * p["a"] * t, "b": np.ones_like(t)}), a=1.0, b=0.0)
    free = (FitParameter("a", 1.0, -5, 5), FitParameter("b", 0.0, -5, 5))
    data = [measured(plant, {"a": 1.5, "b": 0.5}, 0.05)]
    report, here = both(plant, data, free)
    line = report.parameters["a"]
    assert line.verdict == "locally-identifiable" and here.estimates["a"].method == "profile"
    # The fit begins and ends at the other sign; of b it finds what the report does.
    problem = Problem(plant, tuple(data), (FitParameter("a", -line.value, -5, 5), free[1]))
    there = gated_fit(problem, report, partial(fit, starts=1))
    a, b = there.estimates["a"], there.estimates["b"]
    assert a.value == pytest.approx(-line.value, rel=1e-3) and a.reason.startswith(
        "at another optimum than the report's"
    )
    assert a.ci95[0] < a.value < a.ci95[1] and a.method == "covariance"
    assert b.ci95 == report.parameters["b"].ci95 and b.method == "profile"
    # Of records with another offset b is not where the report has it: a known one keeps the fit's own interval, a weak one none.
    moved = Problem(plant, (measured(plant, {"a": 1.5, "b": 3.0}, 0.05),), free)
    assert gated_fit(moved, report, partial(fit, starts=1)).estimates["b"].method == "covariance"
    weak = replace(report, parameters=report.parameters | {"b": replace(report.parameters["b"], verdict="weak")})
    b = gated_fit(moved, weak, partial(fit, starts=1)).estimates["b"]
    assert (b.method, b.ci95, b.std) == ("none", None, None) and "disagree" in b.reason


def test_where_the_fit_leaves_more_than_noise_no_interval_of_the_report_stands() -> None:
    """The report is of a record that a line follows; the record that is fitted has a wave on it, ten times the noise."""
    plant = closed(line, a=1.0, b=1.0)
    free = (FitParameter("a", 1, -5, 5), FitParameter("b", 1, -5, 5))
    straight = measured(plant, {"a": 1, "b": 2}, 0.01)
    report = identifiability(plant, [straight], free, starts=1)
    assert all(line.ci95 is not None for line in report.parameters.values())
    y = straight.measured["y"] + 0.1 * np.sin(40.0 * straight.time)
    wavy = recorded("e", straight.time, {"y": 0.01}, y=y)
    for e in gated_fit(Problem(plant, (wavy,), free), report, partial(fit, starts=1)).estimates.values():
        assert (e.method, e.ci95, e.std) == ("none", None, None) and "lacks something" in e.reason


def test_one_at_a_bound_stands_there_with_its_limit() -> None:
    plant = closed(line, a=Parameter(1.0), b=Parameter(0.5, min=0.0))
    free = [FitParameter("a", 1, -5, 5), FitParameter("b", 0.5, 0.0, 5.0)]
    _, found = both(plant, [measured(plant, {"a": 1, "b": -0.05}, 0.05)], free)
    assert found.fitted == ("a",) and "b" in found.held
    b = found.estimates["b"]
    assert b.value == 0.0 and b.std is None and b.method == "one-sided" and b.ci95[0] == 0.0 < b.ci95[1]


def test_forced_ones_are_fitted_and_marked() -> None:
    plant = closed(line_and_nothing, a=1.0, b=1.0, c=0.0)
    free = [FitParameter("a", 0, -5, 5), FitParameter("b", 0, -5, 5), FitParameter("c", 1.0, -100, 100)]
    data = [measured(plant, {"a": 1, "b": 2}, 0.01)]
    report, found = both(plant, data, free, force=("c",))
    assert set(found.fitted) == {"a", "b", "c"} and "forced" in found.estimates["c"].reason
    assert gate(report, ("c", "a")).forced == ("c",)
    with pytest.raises(UnknownNameError, match="no candidate 'd'"):
        gate(report, ("d",))


def two_decays(t, p):
    """y = a1 exp(-t/t1) + a2 exp(-t/t2)."""
    e1, e2 = np.exp(-t / p["t1"]), np.exp(-t / p["t2"])
    slopes = {"a1": e1, "a2": e2, "t1": p["a1"] * e1 * t / p["t1"] ** 2, "t2": p["a2"] * e2 * t / p["t2"] ** 2}
    return p["a1"] * e1 + p["a2"] * e2, slopes


def test_the_interval_of_a_forced_one_is_that_of_its_profile() -> None:
    """Two decays that hide each other, all forced: at every end the cost, the others fitted inside their bounds, has risen by 1.92."""
    truth = {"a1": 3.0, "a2": -5.0, "t1": 2.0, "t2": 10.0}
    plant = closed(two_decays, **truth)
    free = [
        FitParameter("a1", 3, 0.01, 50), FitParameter("a2", -5, -50, -0.01),
        FitParameter("t1", 2, 0.05, 20), FitParameter("t2", 10, 0.5, 100),
    ]  # fmt: skip
    data = [measured(plant, {}, 0.2, seed=3, t=np.linspace(0.3, 10.0, 100))]
    report, found = both(plant, data, free, force=tuple(truth))
    problem, k = Problem(plant, tuple(data), tuple(free)), 0
    assert report.parameters["a1"].verdict == "practically-unidentifiable"
    theta = np.array([found.values[n] for n in problem.names])
    for i, name in enumerate(problem.names):
        e = found.estimates[name]
        forced = name not in report.identifiable
        assert e.method == "profile" and e.reason.startswith("forced") == forced and not (forced and e.std)
        for end in (v for v in e.ci95 if v is not None and problem.unknowns[i].min < v < problem.unknowns[i].max):
            begin = theta.copy()
            begin[i] = end
            rise = descend(problem, begin, np.arange(4) == i, enough=1e-6).at.cost - found.cost
            assert rise == pytest.approx(TWO_SIDED, rel=0.01), (name, end)
            k += 1
    assert k >= 4
    # Of a fit in other terms than the report's no profile is walked, and a forced one has no interval.
    other = gated_fit(problem, report, partial(fit, starts=2), force=tuple(truth), whole=False).estimates["a1"]
    assert (other.method, other.ci95, other.std) == ("none", None, None) and "no profile" in other.reason


def test_an_interval_beside_a_held_one_holds_wherever_that_one_may_be() -> None:
    """A line a t + b, b <= 0, which these data leave open at its bound: it is held, two standard deviations off.

    The interval of a is that over every b within the bounds, though its value is that beside b as it is held.
    """
    t = np.linspace(0.0, 1.0, 30)
    y = 2.0 * t - 0.017 + 0.1 * np.random.default_rng(3).standard_normal(30)
    plant = closed(lambda t, p: (p["a"] * t + p["b"], {"a": t, "b": np.ones_like(t)}), a=1.5, b=-0.1)
    free = [FitParameter("a", 1.5, 0.0, 5.0), FitParameter("b", -0.1, -1.0, 0.0)]
    report, found = both(plant, [recorded("e", t, {"y": 0.1}, y=y)], free)
    a = found.estimates["a"]
    assert found.values["b"] == -0.1 and a.conditional_on == () and report.parameters["a"].verdict == "identifiable"
    grid = np.linspace(1.0, 3.0, 20_001)
    b = np.clip(np.mean(y) - grid * np.mean(t), -1.0, 0.0)
    cost = 0.5 * np.sum((y - np.outer(grid, t) - b[:, None]) ** 2, axis=1) / 0.1**2
    inside = grid[cost <= cost.min() + TWO_SIDED]
    assert a.ci95 == pytest.approx((inside[0], inside[-1]), abs=2e-4)
    assert a.value == pytest.approx(float(t @ (y + 0.1) / (t @ t)), rel=1e-6)


def test_an_interval_that_the_records_give_only_beside_a_held_one_is_marked() -> None:
    """Of a rise the record shows neither the rate nor the end: beside the held rate the end is known."""
    rise = closed(saturating, a=1.0, k=1.0)
    free = [FitParameter("a", 1.0, 0.1, 100.0), FitParameter("k", 1.0, 0.001, 20.0)]
    report, found = both(rise, [measured(rise, {"a": 2.0, "k": 0.7}, 0.1, t=np.linspace(0, 1, 50))], free)
    a = report.parameters["a"]
    assert found.fitted == ("a",) and found.estimates["a"].conditional_on == a.conditional_on == ("k",)
    assert a.verdict == "practically-unidentifiable" and "With k held" in a.reason


def test_nothing_identifiable_is_no_success() -> None:
    plant = closed(line_and_nothing, a=1.0, b=1.0, c=0.0)
    free = [FitParameter("c", 1.0, -100, 100)]
    _, found = both(plant, [measured(plant, {}, 0.01)], free)
    assert found.status == "failed" and found.fitted == () and "insensitive" in found.held["c"]


CARD = """schema = 1
name = "two"
[parameters]
k = {value = 5.0, min = 0.1, max = 50}
flat = {value = 1.0, min = 0.0, max = 10}
[inputs]
u = {value = 0.0}
[states]
x = {derivative = "k*(u - x)"}
z = {derivative = "flat*(0*u - z)"}
[outputs]
y = "x"
"""
STUDY = """schema = 1
name = "two"
[model]
source = "two.toml"
[parameters]
k = {start = 3}
flat = {start = 2}
[fit]
starts = 2
[[experiment]]
name = "step"
data = "step.csv"
inputs = ["u"]
outputs = ["y"]
noise = {y = 0.01}
"""


@pytest.fixture
def study(tmp_path):
    t = np.linspace(0, 2, 201)
    u = np.where(t >= 0.2, 1.0, 0.0)
    y = np.where(t >= 0.2, 1 - np.exp(-5 * (t - 0.2)), 0) + 0.01 * np.random.default_rng(0).normal(size=t.size)
    rows = "\n".join(f"{a:.6g},{b:g},{c:.8g}" for a, b, c in zip(t, u, y, strict=True))
    (tmp_path / "step.csv").write_text(f"time,u,y\n{rows}\n")
    (tmp_path / "two.toml").write_text(CARD)
    path = tmp_path / "study.toml"
    path.write_text(STUDY)
    return path


def call(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_the_commands(study) -> None:
    result = call("identify", study)
    assert result.exit_code == 0, result.output
    said = result.stdout.splitlines()
    assert said[0].startswith("k     identifiable: It is known to ±") and said[1].startswith("flat  ")
    assert any("none narrows the interval of flat further" in line for line in said) and said[-1].startswith(
        "identify: done"
    )
    folder = study.parent / "study-results"
    report = json.loads((folder / "identifiability.json").read_text())
    assert {"schema", "study", "model", "software", "seed"} <= set(report)
    assert report["identifiable"] == ["k"]
    assert report["parameters"]["flat"]["verdict"] in ("insensitive", "structurally-unidentifiable")
    result = call("fit", study, "--quiet")
    assert result.exit_code == 0, result.output
    found = json.loads((folder / "fit.json").read_text())
    assert found["fitted"] == ["k"] and "flat" in found["held"] and found["forced"] == []
    assert abs(found["estimates"]["k"]["value"] - 5) < 0.1 and found["estimates"]["k"]["method"] == "profile"
    result = call("fit", study, "--force", "flat", "--json")
    assert json.loads(result.stdout)["forced"] == ["flat"]
    result = call("report", study)
    page = (folder / "report.html").read_text()
    assert "What the recordings determine" in page and "What to record next" in page
    study.write_text(study.read_text().replace("[fit]", '[identifiability]\npair = ["k", "flat"]\n[fit]'))
    assert call("identify", study, "--quiet").exit_code == 0
    notes = json.loads((folder / "identifiability.json").read_text())["notes"]
    assert any("No common profile of k and flat" in n for n in notes)
    result = call("fit", study, "--force", "nothing")
    assert result.exit_code == 2 and "no candidate 'nothing'" in result.output
