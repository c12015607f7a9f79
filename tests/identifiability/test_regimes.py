"""Structure in the regimes that the records visit: limiters that act, switches of time; the records are worked out here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hvdc_ident.data import InputSignal
from hvdc_ident.fit import FitParameter
from hvdc_ident.identifiability import identifiability
from hvdc_ident.model import Model, State
from hvdc_ident.parameters import Parameter
from tests.fit.simulators import recorded

TIME = np.linspace(0.0, 3.0, 151)
RATE = InputSignal.corners([(0.5, 0.0), (0.5, 2.0), (2.5, 2.0), (2.5, 0.0)])
U = np.interp(TIME, [0.5, 2.5], [0.0, 4.0])
"""The integral of that rate."""
NOISE = 1e-3


def record(y, **inputs):
    """An experiment that recorded y, (151,), with noise."""
    seen = np.asarray(y) + NOISE * np.random.default_rng(3).standard_normal(TIME.size)
    return recorded("e", TIME, {"y": NOISE}, y=seen).with_(inputs=inputs)


def behind_an_integrator(name, output, **values):
    """A model of y = output(u, parameters), u the integral of the input."""
    states = {"u": State("rate", start=0.0)}
    return Model(name=name, parameters=values, inputs={"rate": 0.0}, states=states, outputs={"y": output})


def judged(model, data, **ranges):
    """The report on candidates with (start, min, max)."""
    return identifiability(model, [data], [FitParameter(n, *r) for n, r in ranges.items()], starts=4)


def test_a_level_that_the_record_shows_as_a_flat_top_is_told() -> None:
    model = behind_an_integrator("flat-top", "min(k*u, top)", k=2.0, top=5.0)
    report = judged(model, record(np.minimum(1.5 * U, 3.0), rate=RATE), k=(2.0, 0.5, 4.0), top=(5.0, 1.0, 20.0))
    assert report.structure.combinations == ()
    for name, truth in (("k", 1.5), ("top", 3.0)):
        verdict = report.parameters[name]
        assert verdict.verdict == "identifiable"
        assert verdict.ci95[0] < truth < verdict.ci95[1]


def test_a_combination_at_rest_that_a_limiter_takes_apart_is_told_apart() -> None:
    """Before the limiter acts only g*k shows; on it, g alone."""
    model = behind_an_integrator("stage", "g*clip(k*u, -1, 1)", k=2.0, g=2.0)
    whole = judged(model, record(1.5 * np.clip(0.8 * U, -1, 1), rate=RATE), k=(2.0, 0.4, 4.0), g=(2.0, 0.5, 4.0))
    assert {v.verdict for v in whole.parameters.values()} == {"identifiable"}
    assert any("would not tell k, g apart" in n for n in whole.notes)
    small = replace(RATE, values=RATE.values / 20)
    part = judged(model, record(1.2 * U / 20, rate=small), k=(2.0, 0.4, 4.0), g=(2.0, 0.5, 4.0))
    assert {v.verdict for v in part.parameters.values()} == {"structurally-unidentifiable"}


def test_a_source_switched_by_time_is_told() -> None:
    """x' = -x/T + (a from 1 s on), from 0: x = a T (1 - exp(-(t - 1)/T))."""
    model = Model(
        name="late",
        parameters={"T": 0.4, "a": 1.0},
        inputs={},
        states={"x": "where(time < 1, 0, a) - x/T"},
        outputs={"y": "x"},
    )
    late = np.clip(TIME - 1.0, 0.0, None)
    report = judged(model, record(2.0 * 0.3 * (1 - np.exp(-late / 0.3))), T=(0.4, 0.05, 2.0), a=(1.0, 0.2, 5.0))
    for name, truth in (("T", 0.3), ("a", 2.0)):
        verdict = report.parameters[name]
        assert verdict.verdict == "identifiable"
        assert verdict.ci95[0] < truth < verdict.ci95[1]


@pytest.mark.parametrize("high", [6.0, 40.0])
def test_a_level_that_no_record_reaches_is_left_to_the_data(high) -> None:
    """Nothing is proved of it: another record would show it."""
    model = behind_an_integrator("far", "min(k*u, top)", k=1.0, top=5.5)
    report = judged(model, record(1.2 * U, rate=RATE), k=(1.0, 0.5, 1.24), top=(5.5, 5.0, high))
    assert report.parameters["top"].verdict == "insensitive"
    assert "However good" not in report.parameters["top"].reason
    assert report.structure.unidentifiable == ()


def test_a_regime_far_from_the_start_counts() -> None:
    """The limiter acts for the largest fifth of k alone, where the record lies; elsewhere only g*k shows."""
    model = behind_an_integrator("stage", "g*clip(k*u, -8, 8)", k=0.2, g=1.0)
    data = record(0.3 * np.clip(3.2 * U, -8, 8), rate=RATE)
    report = judged(model, data, k=(0.2, 0.1, 4.0), g=(4.0, 0.25, 4.0))
    assert {n: v.verdict for n, v in report.parameters.items()} == {"k": "identifiable", "g": "identifiable"}
    assert report.parameters["k"].value == pytest.approx(3.2, rel=5e-3)


def test_a_level_above_all_that_the_records_reach_is_held_and_its_one_sided_limit_told() -> None:
    """Any level above the largest k*u, 3, is as good: where a search left it is no estimate."""
    values = {"k": 2.0, "top": Parameter(8.0, min=1.0, max=20.0)}
    model = behind_an_integrator("never-reached", "min(k*u, top)", **values)
    data = record(0.75 * U, rate=RATE)
    for given in (8.0, 15.0):
        report = judged(model, data, k=(2.0, 0.5, 4.0), top=(given, 1.0, 20.0))
        top = report.parameters["top"]
        assert top.verdict == "practically-unidentifiable" and "from above" in top.reason
        assert report.identifiable == ("k",) and report.held["top"].value == given
        assert top.ci95[0] == pytest.approx(3.0, rel=2e-3)
        assert "with 95 % confidence it is above " in top.reason
