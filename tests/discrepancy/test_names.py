"""What takes away in proportion to another signal has the name that suits the signals: of a droop, or of a conductance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hvdc_ident import Experiment, InputSignal, Trajectory
from hvdc_ident.discrepancy import diagnose
from hvdc_ident.discrepancy.candidates import droops, leaks, quantity
from hvdc_ident.fit import FitParameter
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, Output, parse_card

PLANT = """
schema = 1
name = "terminal"
[parameters]
K = {value = 30.0, min = 0.1}
X = {value = 0.4, min = 0.01}
T = {value = 0.08, min = 0.001}
[inputs]
Vref = {value = 1.0}
E = {value = 1.0}
[states]
xv = {derivative = "er"}
V = {derivative = "(1.0 + K*xv - V)/T", guess = 1.0}
[signals]
er = "Vref - V"
Q = "V*(V - E)/X"
[outputs]
V = "V"
Q = "Q"
"""
TIME = np.linspace(0.0, 2.0, 401)


def records(droop: float) -> tuple[Experiment, ...]:
    """Records of a voltage control that reactive power lowers, by an implicit Runge-Kutta method."""
    random, found = np.random.default_rng(1), []
    for name, role, moves in (
        ("set-point", "fit", {"Vref": 0.03}), ("grid", "fit", {"E": -0.04}), ("both", "holdout", {"Vref": -0.02, "E": 0.03}),
    ):  # fmt: skip
        inputs = {n: InputSignal.step(0.3, 1.0, 1.0 + moves.get(n, 0.0)) for n in ("Vref", "E")}

        def slopes(t: float, s: np.ndarray, inputs: dict[str, InputSignal] = inputs) -> list[float]:
            x, v = s
            q = v * (v - float(inputs["E"](t))) / 0.4
            return [float(inputs["Vref"](t)) - v - droop * q, (1.0 + 30.0 * x - v) / 0.08]

        run = solve_ivp(slopes, (0.0, 2.0), [0.0, 1.0], "Radau", t_eval=TIME, rtol=1e-8, atol=1e-10, max_step=0.02)
        q = run.y[1] * (run.y[1] - np.array([float(inputs["E"](t)) for t in TIME])) / 0.4
        seen = np.column_stack([run.y[1], q]) + random.standard_normal((TIME.size, 2)) * [1e-4, 3e-4]
        found.append(
            Experiment(
                TIME, name, inputs=FrozenMap(inputs), measured=Trajectory(TIME, seen, ("V", "Q"), ("pu", "pu")),
                noise=FrozenMap({"V": 1e-4, "Q": 3e-4}), event=0.3, role=role,
            )
        )  # fmt: skip
    return tuple(found)


def test_reactive_power_that_lowers_a_voltage_is_a_droop() -> None:
    free = (FitParameter("K", 25.0, 1.0, 200.0), FitParameter("T", 0.1, 0.01, 1.0))
    found = diagnose(parse_card(PLANT), records(0.06), free)
    assert found.verdict in ("named", "ambiguous")
    first = found.findings[0]
    # What is taken off the set-point is taken off the error.
    assert first.effect == "droop" and {p.at for p in first.places} == {("er",), ("Vref",)}
    assert first.places[0].source == "Q" and first.parameters["k"].value == pytest.approx(0.06, rel=0.03)
    assert first.text.startswith(f"{first.places[0].at[0]} droops by 0.06")


def test_reactive_power_that_raises_a_voltage_is_a_coupling() -> None:
    free = (FitParameter("K", 25.0, 1.0, 200.0), FitParameter("T", 0.1, 0.01, 1.0))
    found = diagnose(parse_card(PLANT), records(-0.06), free)
    first = found.findings[0]
    # What is added to the set-point is added to the error.
    assert first.effect == "coupling" and {p.at for p in first.places} <= {("er",), ("Vref",)}
    assert first.places[0].source == "Q" and first.parameters["k"].value == pytest.approx(0.06, rel=0.03)


def test_a_signal_is_told_by_its_unit_or_its_letter() -> None:
    plant = parse_card(PLANT)
    names = {p: quantity(plant, p) for p in ("Vref", "E", "V", "Q", "er", "outputs.Q")}
    assert names == {
        "Vref": "voltage", "E": "voltage", "V": "voltage", "Q": "reactive power", "er": "", "outputs.Q": "reactive power",
    }  # fmt: skip
    in_units: Model = replace(plant, outputs=plant.outputs | {"V": Output(plant.outputs["V"].value, "MW")})
    assert quantity(in_units, "outputs.V") == "power"
    assert droops(plant, ["er"], "Q") and not leaks(plant, ["er"], "Q")
    assert leaks(plant, ["Q"], "V") is False and leaks(plant, ["er"], "V") and not droops(plant, ["er"], "V")
