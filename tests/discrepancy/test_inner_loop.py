"""An inner loop that a model takes for ideal is named, from records that scipy integrates; a lag is not taken for one."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hvdc_ident import InputSignal
from hvdc_ident.data import Array
from hvdc_ident.discrepancy import DiagnosisOptions, diagnose
from hvdc_ident.discrepancy.candidates import entries
from tests.discrepancy.cases import FREE, TIME, TRUE, experiments, model
from tests.discrepancy.meters import records

WN, ZETA = 60.0, 0.6


def looped(inputs: dict[str, InputSignal]) -> Array:
    """Speed and torque where a loop with integral action, WN and ZETA, brings the torque to its order."""
    ref = inputs.get("ref") or (lambda t: 1.0)
    load = inputs.get("load") or (lambda t: 0.0)

    def slopes(t: float, s: Array) -> list[float]:
        w, x, torque, integral = s
        err = float(ref(t)) - w
        missing = TRUE["Kp"] * err + x - torque
        return [
            (torque - TRUE["b"] * w - float(load(t))) / TRUE["J"],
            TRUE["Ki"] * err,
            WN * (integral + 2.0 * ZETA * missing),
            WN * missing,
        ]

    state = np.array([1.0, TRUE["b"], TRUE["b"], 0.0])
    rows = np.zeros((TIME.size, 2))
    jumps = sorted({float(b) for i in inputs.values() for b in i.breaks if 0 < b < TIME[-1]})
    for a, b in pairwise([0.0, *jumps, float(TIME[-1]) + 1e-6]):
        inner = (a <= TIME) & (b > TIME)
        done = solve_ivp(slopes, (a, b - 1e-12), state, t_eval=[*TIME[inner], b - 1e-12], rtol=1e-9, atol=1e-11)
        rows[inner], state = done.y[[0, 2], :-1].T, done.y[:, -1]
    return rows


def test_a_loop_is_named() -> None:
    """At the torque, or at the error behind which a linear controller passes it on."""
    found = diagnose(model(), records(looped), FREE, options=DiagnosisOptions(bootstraps=100))
    assert found.verdict == "named" and found.remaining["adequate"]
    (told,) = found.findings
    assert told.probability > 0.95 and sum(p.probability for p in told.places) == pytest.approx(1.0)
    (alike,) = found.ambiguity
    assert {(r.effect, r.at) for r in alike} == {("inner-loop", ("torque",)), ("inner-loop", ("err",))}
    sizes = found.effects[0].parameters
    assert sizes["wn"].value == pytest.approx(WN, rel=0.02) and sizes["zeta"].value == pytest.approx(ZETA, rel=0.05)
    assert found.parameters_after["Ki"] == pytest.approx(TRUE["Ki"], rel=0.02)


def test_a_lag_is_no_loop() -> None:
    """A heavily damped loop is nearly one: its damping ends before that."""
    found = diagnose(
        model(), experiments(lag=0.03), FREE, effects=["lag", "inner-loop"], options=DiagnosisOptions(bootstraps=100)
    )
    told = {e.effect for e in found.effects} | {r.effect for group in found.ambiguity for r in group}
    assert found.verdict in ("named", "ambiguous") and told == {"lag"}


def test_all_may_stand_beside_others() -> None:
    every = [e.name for e in entries("all")]
    assert "inner-loop" in every and "filter" not in every
    assert [e.name for e in entries(["all", "lag", "filter"])] == [*every, "filter"]
    assert [e.name for e in entries(["lag", "filter"])] == ["lag", "filter"]
