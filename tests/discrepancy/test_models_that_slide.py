"""A diagnosis of a model that slides along its own limit; the records come from small steps of Euler's method."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident import Experiment, InputSignal
from hvdc_ident.data import Array
from hvdc_ident.discrepancy import diagnose
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import FitParameter
from hvdc_ident.model import parse_card
from hvdc_ident.simulate import Tolerance, simulate

CLAMPED = """
schema = 1
name = "clamped"
[parameters]
Kp = {value = 2.0, min = 0.1}
Ki = {value = 8.0, min = 0.1}
[inputs]
r = {value = 0.0}
[states]
p = {derivative = "(clip(sum, -1.2, 1.2) - p)/0.5"}
z = {derivative = "where(sum > 1.2, min(Ki*e, 0), where(sum < -1.2, max(Ki*e, 0), Ki*e))"}
[signals]
e = "r - p"
sum = "Kp*e + z"
[outputs]
p = "p"
z = "z"
"""
NOISE = 0.001


def reference(t: float, height: float) -> float:
    return height if t >= 0.1 else 0.0


def plant(time: Array, height: float, late: float) -> Array:
    """Return p and z, (n, 2), of the loop whose error passes a lag, s."""
    h, per_row = 5e-5, round((time[1] - time[0]) / 5e-5)
    p, z, e, rows = 0.0, 0.0, 0.0, []
    for k in range(per_row * time.size):
        if k % per_row == 0:
            rows.append((p, z))
        total = 2.0 * e + z
        rise = 8.0 * e
        rise = min(rise, 0.0) if total > 1.2 else max(rise, 0.0) if total < -1.2 else rise
        error = reference(k * h, height) - p
        p, z, e = p + h * (min(max(total, -1.2), 1.2) - p) / 0.5, z + h * rise, e + h * (error - e) / late
    return np.array(rows)


def test_effects_are_looked_for_in_a_model_that_slides() -> None:
    model, time = parse_card(CLAMPED), np.round(np.arange(400) * 0.005, 9)
    random, records = np.random.default_rng(5), []
    for height in (1.0, 0.7, -1.0):
        seen = plant(time, height, 0.03) + NOISE * random.standard_normal((time.size, 2))
        inputs, outputs = {"r": InputSignal.step(0.1, 0.0, height)}, {"p": seen[:, 0], "z": seen[:, 1]}
        noise = {"p": NOISE, "z": NOISE}
        records.append(Experiment(time, name=f"{height:g}", inputs=inputs, outputs=outputs, noise=noise))
    with pytest.raises(SimulationError, match="chatter"):
        simulate(model, records[0].with_(measured=None), tolerance=Tolerance(slides=False))
    free = [FitParameter("Kp", 2.0, 0.5, 8.0, given=2.0), FitParameter("Ki", 8.0, 2.0, 32.0, given=8.0)]
    found = diagnose(model, records, free, effects=["lag", "gain"], places=["e"], seed=1)
    assert found.verdict == "named"
    (one,) = found.effects
    assert (one.effect, one.at) == ("lag", ("e",))
    assert one.parameters["T"].value == pytest.approx(0.03, rel=0.03)
