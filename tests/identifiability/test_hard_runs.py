"""Runs that overflow or cannot be made at a held value: a verdict all the same, never a crash of linear algebra."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import FitParameter
from hvdc_ident.identifiability import identifiability
from tests.fit.simulators import recorded
from tests.identifiability.cases import T, closed


def growing(t, p):
    """y = b exp(a t), which a large a takes out of floating-point range, squared at least."""
    e = np.exp(p["a"] * t)
    return p["b"] * e, {"a": p["b"] * t * e, "b": e}


def test_runs_that_overflow_when_squared_are_passed_over() -> None:
    y = 2.0 * np.exp(-3.0 * T) + 1e-3 * np.random.default_rng(0).normal(size=T.size)
    free = [FitParameter("a", -1.0, -10.0, 700.0), FitParameter("b", 1.0, 0.1, 10.0)]
    report = identifiability(closed(growing, a=-1.0, b=1.0), [recorded("e", T, {"y": 1e-3}, y=y)], free, starts=6)
    for name, truth in (("a", -3.0), ("b", 2.0)):
        verdict = report.parameters[name]
        assert verdict.verdict == "identifiable" and verdict.value == pytest.approx(truth, rel=5e-3)
    assert any("random points could not be simulated" in n for n in report.notes)


def narrow_pass(t, p):
    """y = a + b t + 1e-6 c t^2, where the run ends badly unless c < 8/b."""
    if p["b"] * p["c"] > 8.0:
        raise SimulationError("the loop is unstable")
    return p["a"] + p["b"] * t + 1e-6 * p["c"] * t**2, {"a": np.ones_like(t), "b": t, "c": 1e-6 * t**2}


def test_a_weak_parameter_is_held_at_another_value_where_its_given_one_cannot_be_run() -> None:
    """At its start, 4, the others cannot be at their optimum, b = 5."""
    y = 1.0 + 5.0 * T + 1e-2 * np.random.default_rng(0).normal(size=T.size)
    free = [FitParameter("a", 0.0, -5.0, 5.0), FitParameter("b", 1.0, 0.1, 20.0), FitParameter("c", 4.0, 0.01, 7.0)]
    report = identifiability(
        closed(narrow_pass, a=0.0, b=1.0, c=4.0), [recorded("e", T, {"y": 1e-2}, y=y)], free, starts=6
    )
    assert report.identifiable == ("a", "b")
    value, why = report.held["c"].value, report.held["c"].reason
    assert 0.01 <= value < 8.0 / 5.0 and report.parameters["c"].value == value
    assert "at its given value, 4, the model cannot be run" in why
    assert "at its given value, 4, the model cannot be run" in report.parameters["c"].reason
    assert report.parameters["b"].ci95[0] < 5.0 < report.parameters["b"].ci95[1]
