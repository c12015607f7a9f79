"""Components that andes lacks, or has otherwise than the standard, against equations of another form integrated by scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hvdc_ident as hi
from hvdc_ident.model import Model, parse_card
from hvdc_ident.plants import parts_of, unit_card
from hvdc_ident.plants.unit import shelf_model

TIMES = np.round(np.arange(0.0, 5.01, 0.1), 6)


def apart(run: hi.Simulation, output: str, expected: np.ndarray) -> float:
    """Return the largest difference of an output from what is expected, of the range of the latter."""
    return float(np.abs(run[output] - expected).max() / np.ptp(expected))


# --- GENSAL ---

GENSAL = [6.0, 0.04, 0.06, 4.0, 1.0, 1.1, 0.7, 0.3, 0.2, 0.12, 0.0, 0.0]


def salient(record: list[float]) -> Model:
    """Return a GENSAL at an infinite bus behind j0.3 pu, at 80 MW and 1.02 pu."""
    model = parse_card(unit_card(parts_of({"GENSAL": record}), f0=60.0, X=0.3))
    point = hi.find_operating_point(model, outputs={"P": 80.0, "Vt": 1.02}, free=["Efd", "Pm"])
    return model.with_values(point.inputs)


def test_gensal_is_the_circuit_of_its_reactances() -> None:
    """Without saturation: flux linkages and currents of the windings, from the circuit that has these reactances and time constants."""
    Tpdo, Tppdo, Tppqo, H, D, Xd, Xq, Xpd, Xpp, Xl, _, _ = GENSAL
    model = salient(GENSAL)
    w0 = 2 * np.pi * 60.0
    Xad, Xaq = Xd - Xl, Xq - Xl
    Xfd = Xad * (Xpd - Xl) / (Xad - (Xpd - Xl))
    X1d = 1 / (1 / (Xpp - Xl) - 1 / (Xpd - Xl))
    X1q = 1 / (1 / (Xpp - Xl) - 1 / Xaq)
    Rfd = (Xad + Xfd) / (w0 * Tpdo)
    R1d = (X1d + (Xpd - Xl)) / (w0 * Tppdo)
    R1q = (X1q + Xaq) / (w0 * Tppqo)
    inductances = np.zeros((5, 5))
    inductances[:3, :3] = [[-Xd, Xad, Xad], [-Xad, Xad + Xfd, Xad], [-Xad, Xad, Xad + X1d]]
    inductances[3:, 3:] = [[-Xq, Xaq], [-Xaq, Xaq + X1q]]
    Pm, Efd = model.inputs["Pm"].value, model.inputs["Efd"].value

    def currents(y: np.ndarray, E: float) -> np.ndarray:
        """Return [id, ifd, i1d, iq, i1q] of the rotor's fluxes; the stator is at the bus behind the line: psid = vq, psiq = -vd."""
        delta, _, psifd, psi1d, psi1q = y
        a = inductances.copy()
        a[0, 0] -= 0.3  # the voltage of the bus is that of the terminals less what falls over the line
        a[3, 3] -= 0.3
        return np.linalg.solve(a, [E * np.cos(delta), psifd, psi1d, -E * np.sin(delta), psi1q])

    def rates(t: float, y: np.ndarray, E: float) -> list[float]:
        i_d, ifd, i1d, i_q, i1q = currents(y, E)
        torque = E * (np.sin(y[0]) * i_d + np.cos(y[0]) * i_q)
        return [
            w0 * y[1],
            ((Pm - D * y[1]) / (1 + y[1]) - torque) / (2 * H),
            w0 * (Rfd * Efd / Xad - Rfd * ifd),
            -w0 * R1d * i1d,
            -w0 * R1q * i1q,
        ]

    start = hi.find_operating_point(model)
    psi = start.states["gen.Epq"] * (Xad + Xfd) / Xad
    y0 = [start.states["gen.delta"], 0.0, psi, start.states["gen.psikd"], -start.states["gen.Eppd"] * (X1q + Xaq) / Xaq]
    assert np.abs(rates(0.0, np.array(y0), 1.0)).max() < 1e-6
    found = solve_ivp(rates, (0, 5), y0, args=(0.95,), t_eval=TIMES, rtol=1e-9, atol=1e-11)
    flows = np.array([currents(y, 0.95) for y in found.y.T])
    power = 95.0 * (np.sin(found.y[0]) * flows[:, 0] + np.cos(found.y[0]) * flows[:, 3])
    run = hi.simulate(model, TIMES, inputs={"E": hi.step(1.0, 0.95, at=0.0)})
    assert apart(run, "dw", found.y[1]) < 1e-4
    assert np.abs(run["P"] - power)[1:].max() < 1e-4 * np.ptp(power)


@pytest.mark.parametrize(("E", "saturation"), [(1.0, 0.1), (1.2, 0.4)])
def test_gensal_saturates_as_its_record_says(E, saturation) -> None:
    """At no load E'q is the voltage: the field current is that of the air-gap line times 1 + S."""
    model = shelf_model("gensal").with_values({"S10": 0.1, "S12": 0.4, "Vr": E, "Pm": 0.0})
    point = hi.find_operating_point(model, outputs={"Q": 0.0}, free=["Efd"])
    assert point.inputs["Efd"] == pytest.approx(E * (1 + saturation), rel=1e-9)


# --- GGOV1 ---

GGOV1 = {"Tpelec": 0.5, "Kdgov": 0.5, "Tdgov": 0.2, "Tc": 0.05, "Dm": 0.1, "Ldref": 0.9, "Ropen": 0.3, "Rclose": -0.3}


def ggov1(t: np.ndarray, p: dict[str, float], Pref: float, extra, dw) -> np.ndarray:
    """Return Pm of the block diagram by Euler's rule with 0.2 ms.

    Integrators of controllers that do not have the lowest demand follow it; the acceleration limiter acts on the demand of one
    DELT ago. The electrical power is the mechanical one and `extra`.
    """
    h, steps = 2e-4, round(t[-1] / 2e-4)
    flow = 0.8 / p["Kturb"] + p["Wfnl"]
    pe, xi, xl, valve, exhaust, texm, heat, xd, xa = 0.8, flow, flow, flow, flow, flow, 0.8, 0.0, 0.0
    before = [flow] * round(p["DELT"] / h)
    powers = []
    for k in range(steps + 1):
        now = k * h
        feedback = {1: pe, 0: 0.0, -1: valve, -2: before[0]}[int(p["Rselect"])]
        err = Pref - dw(now) - p["R"] * feedback
        if p["db"]:
            err = np.sign(err) * max(abs(err) - p["db"], 0.0)
        err = min(max(err, p["minerr"]), p["maxerr"])
        derivative = p["Kdgov"] * (err - xd) / p["Tdgov"]
        fsrn = p["Kpgov"] * err + xi + derivative
        load = p["Ldref"] / p["Kturb"] + p["Wfnl"] - texm
        fsrt = min(xl + p["Kpload"] * load, 1.0)
        fsra = before[0] + p["Ka"] * p["DELT"] * (p["Aset"] - (dw(now) - xa) / p["Ta"])
        fsr = min(fsrn, fsrt, fsra)
        power = p["Kturb"] * (valve - p["Wfnl"])
        turbine = heat + p["Tc"] / p["Tb"] * (power - heat)
        powers.append(turbine - max(p["Dm"], 0.0) * dw(now))
        shield = exhaust + p["Tsa"] / p["Tsb"] * (valve - exhaust)
        xi += h * (p["Kigov"] * err if fsr == fsrn else p["Kigov"] / p["Kpgov"] * (fsr - derivative - xi))
        xl += h * (p["Kiload"] * load if fsr == fsrt < 1.0 else p["Kiload"] / p["Kpload"] * (fsr - xl))
        xd += h * (err - xd) / p["Tdgov"]
        xa += h * (dw(now) - xa) / p["Ta"]
        texm += h * (shield - texm) / p["Tfload"]
        exhaust += h * (valve - exhaust) / p["Tsb"]
        heat += h * (power - heat) / p["Tb"]
        pe += h * (powers[-1] + extra(now) - pe) / p["Tpelec"]
        valve = min(max(valve + h * min(max((fsr - valve) / p["Tact"], p["Rclose"]), p["Ropen"]), p["VMIN"]), p["VMAX"])
        before = [*before[1:], fsr]
    return np.interp(t, np.arange(steps + 1) * h, powers)


GOVERNED = """
schema = 1
name = "governed"
[inputs]
dw = {value = 0.0, unit = "pu"}
extra = {value = 0.0, unit = "pu"}
Pref = {value = 0.032, unit = "pu"}
[components.gov]
source = "ggov1"
parameters = {PARAMETERS}
[connections]
"gov.dw" = "dw"
"gov.Pe" = "gov.Pm + extra"
"gov.Pref" = "Pref"
"gov.Pmwset" = "0.8"
[outputs]
Pm = "gov.Pm"
"""


@pytest.mark.parametrize("Rselect", [1.0, -1.0, -2.0])
@pytest.mark.parametrize("case", ["small", "load limiter", "acceleration"])
def test_ggov1_follows_its_block_diagram(Rselect, case) -> None:
    values = ", ".join(f"{n} = {v}" for n, v in {**GGOV1, "Rselect": Rselect}.items())
    model = parse_card(GOVERNED.replace("PARAMETERS", values))
    p = {n.removeprefix("gov."): v for n, v in model.values.items()}
    Pref = p["R"] * (0.8 if Rselect == 1.0 else 0.8 / p["Kturb"] + p["Wfnl"])
    slope, length = {"small": (0.002, 1.0), "load limiter": (-0.01, 2.0), "acceleration": (0.15, 0.15)}[case]

    def dw(t: float) -> float:
        return slope * float(np.clip(t - 0.5, 0.0, length))

    run = hi.simulate(
        model.with_values({"Pref": Pref}),
        TIMES,
        inputs={
            "dw": hi.ramp(0.0, slope * length, start=0.5, end=0.5 + length),
            "extra": hi.step(0.0, 0.01, at=1.0),
        },
    )
    expected = ggov1(TIMES, p, Pref, lambda t: 0.0 if t < 1.0 else 0.01, dw)
    assert apart(run, "Pm", expected) < 2e-3
