"""Components that andes lacks, or has otherwise than the standard, against equations of another form integrated by scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hvdc_ident as hi
from hvdc_ident.model import Model, parse_card, shelf_model
from hvdc_ident.plants import UnitPart, parts_of, unit_card

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


# --- converters ---

REGCA1 = [0, 0.02, 10.0, 0.9, 0.4, 1.22, 1.2, 0.8, 0.4, -1.3, 0.02, 0.7, 99.0, -99.0, 0.7]
LOOPS = {"Kqp": 0.2, "Kqi": 2.0, "Kvp": 1.0, "Kvi": 20.0, "Trv": 0.02, "Tpord": 0.05, "Tpfilt": 0.0, "Imax": 1.3}
LOOPS |= {"QMax": 0.4, "QMin": -0.4, "VMAX": 1.1, "VMIN": 0.9, "Vdip": 0.85, "PQFLAG": 1.0}


@pytest.mark.parametrize(
    ("source", "VFLAG", "E"), [("reeca1", 1, 0.97), ("reecb1", 1, 0.97), ("reecb1", 0, 0.97), ("reeca1", 1, 0.7)]
)
def test_loops_of_reactive_power_and_voltage(source, VFLAG, E) -> None:
    """A converter behind j0.3 pu, where V = E cos(a) + 0.3 Iq with sin(a) = 0.3 Ip/E. E = 0.7: a dip that freezes the states."""
    table = {f"I{k}{i}": 1.3 for k in "qp" for i in range(1, 5)} if source == "reeca1" else {}
    values = {**LOOPS, **table, "VFLAG": VFLAG, "QFLAG": 1.0, "Kqv": 0.0 if source == "reecb1" else 2.0, "Vref0": 1.02}
    values |= {} if VFLAG else {"QMax": 1.2}  # which limit the voltage reference, too
    parts = parts_of({"REGCA1": REGCA1}) | {"elec": UnitPart(source, values)}
    model = parse_card(unit_card(parts, f0=60.0, X=0.3)).with_values({"Qext": 0.1 if VFLAG else 1.02})
    point = hi.find_operating_point(model, outputs={"P": 80.0, "Vt": 1.02}, free=["Pref", "Qext"])
    model, reference = model.with_values(point.inputs), point.inputs["Qext"]
    p = {n.removeprefix("elec."): v for n, v in model.values.items()}

    def voltage(y: np.ndarray, bus: float) -> tuple[float, float, float]:
        """Return V and the currents into the network."""
        V = y[5]
        for _ in range(50):  # the low-voltage management of the active current depends on V
            i_p = y[4] * float(np.clip((V - 0.4) / 0.4, 0.0, 1.0))
            V = bus * np.sqrt(1 - (0.3 * i_p / bus) ** 2) + 0.3 * y[6]
        return V, i_p, y[6]

    def rates(t: float, y: np.ndarray, bus: float) -> list[float]:
        Vm, xq, xv, Pord, Ip, _, Iq = y
        V, _, i_q = voltage(y, bus)
        dip = not p["Vdip"] <= V <= p["Vup"]
        err_q = min(max(reference, p["QMin"]), p["QMax"]) - V * i_q
        wanted = p["Kqp"] * err_q + xq if VFLAG else reference
        err_v = min(max(wanted, p["VMIN"]), p["VMAX"]) - Vm
        active = min(Pord / Vm, p["Imax"])
        limit = np.sqrt(p["Imax"] ** 2 - active**2)
        error = 1.02 - Vm
        injected = p["Kqv"] * (error - np.clip(error, p["dbd1"], p["dbd2"])) if dip or source == "reecb1" else 0.0
        reactive = np.clip(np.clip(p["Kvp"] * err_v + xv, -limit, limit) + injected, -limit, limit)
        free = 0.0 if dip else 1.0
        return [
            (V - Vm) / p["Trv"],
            free * p["Kqi"] * err_q * VFLAG,
            free * p["Kvi"] * err_v,
            free * (point.inputs["Pref"] - Pord) / p["Tpord"],
            min((active - Ip) / 0.02, 10.0),
            0.0,
            (reactive - Iq) / 0.02,
        ]

    start = point.states
    y0 = [
        start["elec.Vmeas"],
        start.get("elec.xq", 0.0),
        *(start[f"elec.{n}"] for n in ("xv", "Pord")),
        start["gen.Ip"],
        1.02,
        start["gen.Iq"],
    ]
    assert np.abs(rates(0.0, np.array(y0), 1.0)).max() < 1e-6
    found = solve_ivp(rates, (0, 5), y0, args=(E,), t_eval=TIMES, rtol=1e-8, atol=1e-10, max_step=0.01)
    V = np.array([voltage(y, E)[0] for y in found.y.T])
    run = hi.simulate(model, TIMES, inputs={"E": hi.step(1.0, E, at=0.0)})
    assert np.abs(run["Vt"] - V)[1:].max() < 1e-3 * np.ptp(V)


# --- wind turbines ---


def test_the_drive_train_swings_at_its_frequency() -> None:
    """Two free masses with a shaft: the torsional mode is at Freq1, damped by Dshaft (1/(2 Ht) + 1/(2 Hg))/2; one mass has none."""
    values = {"H": 5.0, "Htfrac": 0.8, "Freq1": 2.0, "Dshaft": 1.0, "DAMP": 0.5, "Pe": 0.0}
    modes = np.linalg.eigvals(hi.linearize(shelf_model("wtdta1").with_values(values)).A)
    mode = modes[modes.imag > 0][0]
    assert abs(mode) == pytest.approx(2 * np.pi * 2.0, rel=2e-3)
    assert -mode.real == pytest.approx((1.0 / 8 + 1.0 / 2 + 0.5 / 2 * 0.8) / 2, rel=0.01)
    single = hi.linearize(shelf_model("wtdta1").with_values({**values, "Htfrac": 0.0})).A
    assert single == pytest.approx(np.array([[-0.5 / 10]]))


def test_pitch_control_follows_its_block_diagram() -> None:
    """The speed rises and falls: the pitch leaves its lowest angle, comes to its highest rate and back."""
    model = shelf_model("wtpta1").with_values({"wt": 0.98, "Pref0": 0.9, "TetaMax": 8.0, "Kcc": 0.1})
    p = model.values
    speed = [(0.0, 0.98), (0.5, 0.98), (1.5, 1.06), (2.5, 1.06), (3.5, 0.99), (5.0, 0.99)]

    def rates(t: float, y: np.ndarray) -> list[float]:
        xw, xc, theta = y
        err_c = 0.8 - 0.9
        err_w = np.interp(t, *zip(*speed, strict=True)) + p["Kcc"] * err_c - 1.0

        def held(rate: float, x: float) -> float:
            return max(rate, 0.0) if x <= p["TetaMin"] else min(rate, 0.0) if x >= p["TetaMax"] else rate

        demand = np.clip(p["Kpw"] * err_w + xw, 0.0, 8.0) + np.clip(p["Kpc"] * err_c + xc, 0.0, 8.0)
        rate = float(np.clip((demand - theta) / p["Tp"], p["RTetaMin"], p["RTetaMax"]))
        return [held(p["Kiw"] * err_w, xw), held(p["Kic"] * err_c, xc), held(rate, theta)]

    found = solve_ivp(rates, (0, 5), [0.0, 0.0, 0.0], t_eval=TIMES, rtol=1e-7, atol=1e-9, max_step=2e-3)
    wt = hi.InputSignal.corners(speed)
    run = hi.simulate(model, TIMES, inputs={"wt": wt})
    assert apart(run, "theta", found.y[2]) < 2e-3


TORQUE = """
schema = 1
name = "torque"
[inputs]
wg = {value = 0.9, unit = "pu"}
Vt = {value = 1.0, unit = "pu"}
Pref0 = {value = 0.65, unit = "pu"}
[states]
Pe = {derivative = "(torque.Pref - Pe)/0.1", guess = 0.65, unit = "pu"}
[components.torque]
source = "wttqa1"
parameters = {Twref = 5.0}
[connections]
"torque.Pe" = "Pe"
"torque.wg" = "wg"
"torque.Vt" = "Vt"
"torque.Pref0" = "Pref0"
[outputs]
Pe = "Pe"
wref = "torque.wref"
"""


@pytest.mark.parametrize("Vt", [1.0, 0.5])
def test_torque_control_follows_its_block_diagram(Vt) -> None:
    """The speed steps; in a dip the integral of the torque stays."""
    p = shelf_model("wttqa1").values
    points = [p[f"p{k}"] for k in range(1, 5)], [p[f"spd{k}"] for k in range(1, 5)]
    power = float(np.interp(0.9, points[1], points[0]))

    def rates(t: float, y: np.ndarray) -> list[float]:
        Pe, measured, wref, xt = y
        err = 0.92 - wref
        torque = min(max(p["Kpp"] * err + xt, p["Temin"]), p["Temax"])
        speed = np.interp(measured, *points)
        return [
            (0.92 * torque - Pe) / 0.1,
            (Pe - measured) / p["Tp"],
            (speed - wref) / 5.0,
            p["Kip"] * err if Vt > p["Vdip"] else 0.0,
        ]

    found = solve_ivp(rates, (0, 5), [power, power, 0.9, power / 0.9], t_eval=TIMES, rtol=1e-8, atol=1e-10)
    steps = {"wg": hi.step(0.9, 0.92, at=0.0), "Vt": hi.step(1.0, Vt, at=0.0)}
    run = hi.simulate(parse_card(TORQUE).with_values({"Pref0": power}), TIMES, inputs=steps)
    assert apart(run, "Pe", found.y[0]) < 1e-4
    assert apart(run, "wref", found.y[2]) < 1e-4


def test_aerodynamics_fall_with_the_pitch() -> None:
    model = shelf_model("wtara1").with_values({"theta0": 2.0, "theta": 5.0})
    assert hi.find_operating_point(model).outputs["dPm"] == pytest.approx(-0.007 * 5.0 * 3.0)


# --- network ---


@pytest.mark.parametrize(
    ("V", "P", "Q"),
    [(1.1, 0.4 * 1.21 + 0.3 * 1.1 + 0.3, 1.21), (0.35, 0.4 * 0.1225 + 0.3 * 0.175 + 0.3 * 0.25, 0.1225)],
)
def test_a_load_takes_its_shares(V, P, Q) -> None:
    """S = V conj(I) of the current that it gives is minus what it takes; at half of Vbrk current and power are at 1/2 and 1/4."""
    model = shelf_model("load").with_values({"P0": 1.0, "Q0": 1.0, "Vr": 0.6 * V, "Vi": 0.8 * V, "Sb": 1.0})
    found = hi.find_operating_point(model).outputs
    power = -complex(0.6 * V, 0.8 * V) * complex(found["Ir"], -found["Ii"])
    assert (found["P"], found["Q"]) == pytest.approx((P, Q))
    assert power == pytest.approx(complex(P, Q))


def test_a_transformer_loses_what_its_impedance_takes() -> None:
    """The complex powers of both ends differ by Z |I|^2 of the far side; without current the ratio is that of the taps."""
    values = {
        "R": 0.01,
        "X": 0.1,
        "tap": 1.05,
        "shift": 0.3,
        "Sn": 50.0,
        "Vr_far": 0.9,
        "Vi_far": -0.2,
        "Ir": 0.5,
        "Ii": -0.3,
    }
    found = hi.find_operating_point(shelf_model("transformer").with_values(values)).outputs
    near, far = complex(found["Vr"], found["Vi"]) * complex(0.5, 0.3), complex(found["Ir_far"], found["Ii_far"])
    loss = near - complex(0.9, -0.2) * far.conjugate()
    assert loss == pytest.approx(complex(0.02, 0.2) * abs(far) ** 2)
    idle = hi.find_operating_point(shelf_model("transformer").with_values({**values, "Ir": 0.0, "Ii": 0.0})).outputs
    ratio = complex(idle["Vr"], idle["Vi"]) / complex(0.9, -0.2)
    assert ratio == pytest.approx(1.05 * np.exp(0.3j))
