"""A dead band before an integrator leaves open where the loop rests: each record begins where it was left. Records: scipy."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hvdc_ident import Experiment, InputSignal, Trajectory
from hvdc_ident.data import Array
from hvdc_ident.discrepancy import DiagnosisOptions, diagnose
from hvdc_ident.discrepancy.hypothesis import refitted
from hvdc_ident.immutable import FrozenMap
from tests.discrepancy.cases import EVENT, FREE, RUNS, SIGMA, TIME, TRUE, corners, model
from tests.discrepancy.refits import beside, plain

WIDTH = 0.08
LEFT_AT = {"fit-1": 0.9, "fit-2": -0.7, "held": 0.5}
"""By record, where in the band the speed's error rested before, in half widths."""


@pytest.fixture(scope="module")
def records() -> tuple[Experiment, ...]:
    random, found = np.random.default_rng(4), []
    for name, (role, moves) in RUNS.items():
        inputs = {n: InputSignal.corners(corners({"ref": 1.0, "load": 0.0}[n], m)) for n, m in moves.items()}
        clean = _rested(inputs, 1.0 - LEFT_AT[name] * WIDTH)
        y = clean + random.standard_normal(clean.shape) * list(SIGMA.values())
        measured = Trajectory(TIME, y, tuple(SIGMA), ("", ""))
        found.append(
            Experiment(
                TIME, name, inputs=FrozenMap(inputs), measured=measured, noise=FrozenMap(SIGMA), event=EVENT, role=role
            )
        )
    return tuple(found)


def _rested(inputs: dict[str, InputSignal], speed: float) -> Array:
    """(n, 2) speed and torque of the drive with the band at its error, from a rest at this speed."""

    def given(name: str, t: float) -> float:
        return float(inputs[name](t)) if name in inputs else {"ref": 1.0, "load": 0.0}[name]

    def passed(error: float) -> float:
        return error - float(np.clip(error, -WIDTH, WIDTH))

    def slopes(t: float, s: Array) -> list[float]:
        err = passed(given("ref", t) - s[0])
        torque = TRUE["Kp"] * err + s[1]
        return [(torque - TRUE["b"] * s[0] - given("load", t)) / TRUE["J"], TRUE["Ki"] * err]

    state = np.array([speed, TRUE["b"] * speed])
    jumps = sorted({float(b) for i in inputs.values() for b in i.breaks if 0 < b < TIME[-1]})
    rows = np.zeros((TIME.size, 2))
    for a, b in pairwise([0.0, *jumps, float(TIME[-1]) + 1e-6]):
        inner = (a <= TIME) & (b > TIME)
        done = solve_ivp(
            slopes, (a, b - 1e-9), state, t_eval=[*TIME[inner], b - 1e-9], rtol=1e-8, atol=1e-10, max_step=2e-3
        )
        err = np.array([passed(given("ref", t) - w) for t, w in zip(TIME[inner], done.y[0, :-1], strict=True)])
        rows[inner] = np.column_stack([done.y[0, :-1], TRUE["Kp"] * err + done.y[1, :-1]])
        state = done.y[:, -1]
    return rows


def test_the_start_is_free_where_the_band_leaves_the_rest_open_and_nowhere_else(
    records: tuple[Experiment, ...],
) -> None:
    first, bounds = plain(records), {"width": (1e-3, 0.5)}
    job = beside(first, "deadband", "err", {"width": 0.05}, bounds)
    assert job.problem.free_initial_states
    # The torque acts through no integrator that it could hold, and a bend passes small changes on.
    assert not beside(first, "deadband", "load", {"width": 0.05}, bounds).problem.free_initial_states
    assert not beside(first, "saturation", "err", {"level": 1.0}, {"level": (0.1, 9.0)}).problem.free_initial_states
    found = refitted(job)
    assert found.values["deadband_err_width"] == pytest.approx(WIDTH, rel=0.02)
    assert found.chi2 / found.rows == pytest.approx(1.0, abs=0.1) and found.holdout == pytest.approx(1.0, abs=0.1)
    at_rest = refitted(replace(job, problem=replace(job.problem, free_initial_states=False)))
    assert at_rest.chi2 > 2.0 * found.chi2


def test_a_dead_band_is_named_though_no_record_begins_at_its_middle(records: tuple[Experiment, ...]) -> None:
    found = diagnose(
        model(), records, FREE, effects=["deadband", "backlash", "offset", "gain", "loss", "lag"],
        options=DiagnosisOptions(fallback=False),
    )  # fmt: skip
    assert found.verdict == "named", found.text
    assert [(e.effect, e.at) for e in found.effects] == [("deadband", ("err",))], found.text
    assert found.effects[0].parameters["width"].value == pytest.approx(WIDTH, rel=0.02)
