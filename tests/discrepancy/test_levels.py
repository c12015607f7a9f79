"""Levels of a quantiser in a loop, whose step has to be met: against records computed by scipy."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hvdc_ident import Experiment, InputSignal, Trajectory
from hvdc_ident.data import Array
from hvdc_ident.discrepancy import DiagnosisOptions, diagnose
from hvdc_ident.effects import SignalScales, effects, size_grid
from hvdc_ident.immutable import FrozenMap
from tests.discrepancy.cases import EVENT, FREE, RUNS, SIGMA, TIME, TRUE, corners, model

STEP = 0.11


@pytest.fixture(scope="module")
def levels() -> tuple[Experiment, ...]:
    """Records of the drive whose torque acts in levels of STEP.

    A loop between two levels turns about their edge: the edges have a width here, as they have in the package.
    """
    random = np.random.default_rng(0)
    found = []
    for name, (role, moves) in RUNS.items():
        inputs = {n: InputSignal.corners(corners({"ref": 1.0, "load": 0.0}[n], m)) for n, m in moves.items()}
        y = _rounded(inputs)
        y[:, 1] = [_level(u) for u in y[:, 1]]
        seen = y + random.standard_normal(y.shape) * list(SIGMA.values())
        measured = Trajectory(TIME, seen, tuple(SIGMA), ("", ""))
        found.append(
            Experiment(
                TIME, name, inputs=FrozenMap(inputs), measured=measured, noise=FrozenMap(SIGMA), event=EVENT, role=role
            )
        )
    return tuple(found)


def _level(u: float) -> float:
    whole = np.floor(u / STEP)
    return float(STEP * (whole + np.clip((u / STEP - whole - 0.5) / 2e-3 + 0.5, 0.0, 1.0)))


def _rounded(inputs: dict[str, InputSignal]) -> Array:
    """(n, 2) speed and torque, from a start that was waited for."""

    def given(name: str, t: float) -> float:
        return float(inputs[name](t)) if name in inputs else {"ref": 1.0, "load": 0.0}[name]

    def slopes(t: float, s: Array, at: float | None = None) -> list[float]:
        err = given("ref", t if at is None else at) - s[0]
        torque = _level(TRUE["Kp"] * err + s[1])
        return [
            (torque - TRUE["b"] * s[0] - given("load", t if at is None else at)) / TRUE["J"],
            TRUE["Ki"] * err,
        ]

    settings = {"method": "LSODA", "rtol": 1e-7, "atol": 1e-9, "max_step": 2e-3}
    state = solve_ivp(lambda t, s: slopes(t, s, 0.0), (0.0, 20.0), [1.0, TRUE["b"]], method="Radau", rtol=1e-8).y[:, -1]
    jumps = sorted({float(b) for i in inputs.values() for b in i.breaks if 0 < b < TIME[-1]})
    rows = np.zeros((TIME.size, 2))
    for a, b in pairwise([0.0, *jumps, float(TIME[-1]) + 1e-6]):
        inner = (a <= TIME) & (b > TIME)
        done = solve_ivp(slopes, (a, b - 1e-9), state, t_eval=[*TIME[inner], b - 1e-9], **settings)
        err = np.array([given("ref", t) for t in TIME[inner]]) - done.y[0, :-1]
        rows[inner] = np.column_stack([done.y[0, :-1], TRUE["Kp"] * err + done.y[1, :-1]])
        state = done.y[:, -1]
    return rows


@pytest.mark.nightly
def test_a_step_is_met_among_hundreds(levels: tuple[Experiment, ...]) -> None:
    found = diagnose(
        model(), levels, FREE, effects=["quantisation", "deadband", "backlash", "lag", "gain"], seed=0,
        options=DiagnosisOptions(fallback=False),
    )  # fmt: skip
    assert found.verdict == "named", found.text
    assert (found.effects[0].effect, found.effects[0].at) == ("quantisation", ("torque",))
    assert found.effects[0].parameters["step"].value == pytest.approx(STEP, rel=2e-3)


@pytest.mark.parametrize("middle", [0.0, 1.0, 10.0])
def test_of_the_levels_of_a_closer_look_one_puts_its_marks_where_any_step_does(middle: float) -> None:
    time = np.linspace(0.0, 1.0, 101)
    signal = SignalScales.of([time], [middle + 0.5 * np.sin(7 * time)])
    scan = effects()["quantisation"].parameters["step"].grid
    assert scan is not None
    steps = signal.peak / np.array(scan(signal))
    assert 0.5 * signal.range < steps.max() < 2.0 * signal.range and steps.min() < signal.range / 35
    assert steps.size < 5000
    u = np.linspace(signal.low, signal.high, 50)[:, None]
    for step in signal.range / np.random.default_rng(0).uniform(2.0, 35.0, 40):
        apart = u / step - u / steps
        # Levels may be counted otherwise: what shows is where the marks lie.
        apart -= np.round(apart[-1:])
        assert np.abs(apart).max(axis=0).min() < 0.13


@pytest.mark.parametrize("effect", ["quantisation", "sample-hold"])
def test_every_size_of_a_closer_look_lies_within_the_bounds_of_its_probe(effect: str) -> None:
    time = np.linspace(0.0, 1.0, 301)
    signal = SignalScales.of([time], [1.0 + 0.5 * np.sin(7 * time)])
    probe, sizes = size_grid(effects()[effect], signal)
    name = next(n for n, q in effects()[effect].parameters.items() if q.grid is not None)
    low, high = probe.free[name]
    assert sizes.size > 500 and low <= sizes.min() and sizes.max() <= high
    assert probe.values[name] == sizes[0]
