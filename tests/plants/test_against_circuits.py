"""Components of networks and converters against circuits in complex numbers, and controls against steps of 10 us of their block diagram."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest
from scipy import signal

import hvdc_ident as hi
from hvdc_ident.data import Array, InputSignal
from hvdc_ident.plants.unit import shelf_model


def at(card: str, parameters: dict[str, float] | None = None, **inputs: float) -> dict[str, float]:
    """Return the outputs of a component at constant inputs."""
    run = hi.simulate(shelf_model(card), [0.0, 1.0], parameters or {}, inputs=inputs)
    return {o: float(values[-1]) for o, values in run.items()}


def phasor(found: dict[str, float], name: str) -> complex:
    return complex(found[f"{name}r"], found[f"{name}i"])


def test_infinite_bus_is_a_phasor() -> None:
    assert phasor(at("infinite-bus", V=1.03, theta=0.7), "V") == pytest.approx(cmath.rect(1.03, 0.7))


def test_line_is_the_voltage_over_its_impedance() -> None:
    far, current, Z = 0.98 - 0.1j, 0.6 + 0.25j, 0.02 + 0.13j
    ends = {"Vr_far": far.real, "Vi_far": far.imag, "Ir": current.real, "Ii": current.imag}
    found = at("line", {"R": Z.real, "X": Z.imag}, **ends)
    assert phasor(found, "V") == pytest.approx(far + Z * current)


def test_transformer_changes_voltage_and_current_and_no_power_but_its_losses() -> None:
    far, current, Z, ratio = 0.97 + 0.05j, 0.5 - 0.2j, (0.004 + 0.11j) * 100.0 / 250.0, cmath.rect(1.05, 0.3)
    ends = {"Vr_far": far.real, "Vi_far": far.imag, "Ir": current.real, "Ii": current.imag}
    found = at("transformer", {"R": 0.004, "X": 0.11, "tap": 1.05, "shift": 0.3, "Sn": 250.0}, **ends)
    behind = current * ratio.conjugate()
    assert complex(found["Ir_far"], found["Ii_far"]) == pytest.approx(behind)
    assert phasor(found, "V") == pytest.approx(ratio * (far + Z * behind))
    lost = phasor(found, "V") * current.conjugate() - far * behind.conjugate()
    assert lost == pytest.approx(Z * abs(behind) ** 2)


@pytest.mark.parametrize(("short_circuit", "ratio"), [(100.0, 10.0), (3.0, 0.5), (20.0, 0.0)])
def test_grid_impedance_has_its_short_circuit_power_and_its_ratio(short_circuit: float, ratio: float) -> None:
    found = at("grid-impedance", {"Zg": 1.0 / short_circuit, "XR": ratio})
    Z = complex(found["R"], found["X"])
    assert 1.0 / abs(Z) == pytest.approx(short_circuit) and Z.imag == pytest.approx(ratio * Z.real)


def test_dc_line_loses_the_power_that_one_end_gives_and_the_other_does_not_take() -> None:
    R, far, near = 0.002, 1.01, 0.99
    current = at("dc-line", {"R": R}, V=near, V_far=far)["I"]
    assert current > 0.0, "from the far end to the near one"
    assert far * current - near * current == pytest.approx(R * current**2)


@pytest.mark.parametrize("V", [1.0, 0.9, 0.75])
def test_load_is_an_admittance_a_current_and_a_power_in_parallel(V: float) -> None:
    """40 % impedance, 30 % current of the angle of the voltage, 30 % power: three currents that add up."""
    shares = {
        "P0": 80.0,
        "Q0": 20.0,
        "pz": 0.4,
        "pc": 0.3,
        "qz": 0.4,
        "qc": 0.3,
        "kpf": 2.0,
        "kqf": -1.5,
        "Vbrk": 0.7,
        "Sb": 100.0,
    }
    voltage = cmath.rect(V, -0.4)
    power = complex(0.8 * 1.02, 0.2 * 0.985)  # pu, drawn at 1 pu and 1 % above the nominal frequency
    found = at("load", shares, Vr=voltage.real, Vi=voltage.imag, dwn=0.01)
    into = (0.4 * voltage + 0.3 * voltage / V) * power.conjugate() + 0.3 * (power / voltage).conjugate()
    assert complex(found["Ir"], found["Ii"]) == pytest.approx(-into), "it counts into the network"
    assert complex(found["P"], found["Q"]) == pytest.approx(100.0 * voltage * into.conjugate())


def test_bus_frequency_is_the_derivative_of_the_angle_behind_its_lag() -> None:
    f0, T, swing = 60.0, 0.05, 3.0
    times = np.arange(0.0, 4.0, 1e-3)
    angle = 0.2 * np.sin(swing * times)
    run = hi.simulate(
        shelf_model("bus-frequency"),
        times,
        {"T": T, "f0": f0},
        inputs={"theta": InputSignal(times, angle, np.array([])), "f": 60.3},
    )
    _, lagged, _ = signal.lsim(([1.0, 0.0], [T, 1.0]), angle, times)  # the transfer function s/(1 + sT)
    np.testing.assert_allclose(run["dwn"], 0.3 / f0 + lagged / (2.0 * math.pi * f0), atol=2e-6)


@pytest.mark.parametrize("order", [0.8 - 0.3j, -0.5 + 0.2j])
def test_vsc_phasor_stands_behind_the_impedance_of_its_grid(order: complex) -> None:
    """The grid's voltage is the terminal's and the drop of the current that flows from the grid into the converter."""
    R, X, E = 0.02, 0.15, 1.05
    found = at("vsc-phasor", {"R": R, "X": X}, E=E, Irorder=order.real, Iiorder=order.imag)
    V = found["Vac"]
    drawn = order.conjugate()  # powers are V (Ir + j Ii), and power is voltage times the conjugate of the current
    assert abs(V + complex(R, X) * drawn) == pytest.approx(E)
    assert complex(found["P"], found["Q"]) == pytest.approx(V * drawn.conjugate())
    grid = (V + complex(R, X) * drawn) * drawn.conjugate()
    assert grid.real - found["Pdc"] == pytest.approx(R * abs(order) ** 2), "it has no losses of its own"


TIMES = np.arange(0.0, 1.2, 1e-5)


def limited(error: Array, KP: float, KI: float, limit: float) -> Array:
    """Return a PI's output within limits; its integrator takes back what the limits cut off, in explicit steps."""
    x, out, step = 0.0, np.empty(error.size), float(TIMES[1])
    for k, e in enumerate(error):
        whole = KP * e + x
        out[k] = min(max(whole, -limit), limit)
        x += step * KI * (e + out[k] - whole)
    return out


def course(card: str, parameters: dict[str, float], output: str, **inputs: Array | float) -> Array:
    """Return an output of a control at the instants of TIMES, from an integrator at 0."""
    model = shelf_model(card)
    text = {n: InputSignal(TIMES, v, np.array([])) if isinstance(v, np.ndarray) else v for n, v in inputs.items()}
    return np.asarray(hi.simulate(model, TIMES, parameters, inputs=text)[output])


SWING = 0.08 * np.sin(9.0 * TIMES) * (TIMES > 0.0)


def test_vsc_vdc_control_is_a_limited_pi_of_the_voltage() -> None:
    found = course("vsc-vdc-control", {"KP": 24.0, "KI": 734.7}, "Irorder", Vdcref=1.0, Vdc=1.0 - SWING)
    expected = np.clip(limited(SWING, 24.0, 734.7, 1.2), -1.1, 1.1)
    assert np.ptp(expected) == pytest.approx(2.2), "both limits are reached"
    np.testing.assert_allclose(found, expected, atol=3e-3)


@pytest.mark.parametrize("Vac", [1.0, 0.8])
def test_vsc_p_control_is_a_limited_pi_of_the_power_over_the_voltage(Vac: float) -> None:
    found = course("vsc-p-control", {"KP": 2.0, "KI": 30.0}, "Irorder", Pref=0.0, P=-10.0 * SWING, Vac=Vac)
    expected = np.clip(limited(10.0 * SWING, 2.0, 30.0, 1.2) / Vac, -1.1, 1.1)
    np.testing.assert_allclose(found, expected, atol=3e-3)


@pytest.mark.parametrize("Irorder", [0.0, 1.05])
def test_vsc_q_control_leaves_the_current_to_the_active_one(Irorder: float) -> None:
    found = course(
        "vsc-q-control", {"KP": 1.0, "KI": 30.0}, "Iiorder", Qref=0.0, Q=-10.0 * SWING, Vac=1.0, Irorder=Irorder
    )
    room = min(0.5, math.sqrt(1.1**2 - Irorder**2))
    expected = np.clip(limited(10.0 * SWING, 1.0, 30.0, 0.5), -room, room)
    np.testing.assert_allclose(found, expected, atol=3e-3)
    assert np.abs(found).max() == pytest.approx(room, rel=1e-6)
