"""The average-value link: the phasor link's plant and controls with currents, PLL, inner loops and dc inductance.

Balanced quantities in the frame of each station's PLL, per unit, time in s: current Ir - j Ii, voltage vd + j vq.
Station 1 controls dc voltage and reactive power, station 2 active and reactive power; positive power flows from a grid
into its converter. Names shared with the phasor link mean the same there. Facts (circuit, controls, numbers): Murad and
Vanfretti, Modelica Conference 2017; the gains follow the phasor link's rule.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

from hvdc_ident.errors import require_known
from hvdc_ident.expression import parse
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Algebraic, Delay, Model, Output, Parameterisation, Signal, State
from hvdc_ident.models import vsc_hvdc_link
from hvdc_ident.parameters import Input, Parameter

SUMMARY = "two-terminal VSC-HVDC link, average-value: currents, PLL, inner loops, dc inductance (a reference)"

Measured = Literal["P", "Q", "Vac", "Vdc"]
MEASURED = ("P", "Q", "Vac", "Vdc")
RATIO = math.sqrt(1.5)
"""Converter voltage in pu of the peak phase voltage, over modulation times dc voltage; also dc over ac current."""
BESSEL = math.sqrt((math.sqrt(5.0) - 1.0) * 1.5)
"""Angular frequency at which 3/(s^2 + 3 s + 3) is down 3 dB, rad/s."""
CRITICAL = math.sqrt(math.sqrt(2.0) - 1.0)
"""Share of its poles' frequency at which a critically damped second-order low-pass is down 3 dB."""
X_TRANSFORMER, R_TRANSFORMER, X_ARM = 0.18, 0.001, 0.075


@dataclass(frozen=True)
class Rating:
    """Parameters that differ between two ratings: MVA, power at the start in pu, gains in pu and pu/s, C in s, Zg, Rdc in pu."""

    base: float
    power: float
    KPVDC: float
    KIVDC: float
    C: float
    Zg: float
    Rdc: float


RATINGS = {
    "paper": Rating(100.0, 0.4, 24.0, 734.7, 0.2, 0.01, 1.0 / 4096),
    "authors": Rating(1000.0, 1.0, 9.6, 293.87755, 195.3e-6 * 409.6, 0.1, 1.022 / 409.6),
}


def inputs(rated: Rating) -> dict[str, Input]:
    """Return the inputs with their start values in pu."""
    return {
        "Vdcref1": Input(1.0, "pu", "dc voltage set-point of station 1"),
        "Qref1": Input(0.0, "pu", "reactive power set-point of station 1"),
        "Pref2": Input(rated.power, "pu", "active power set-point of station 2"),
        "Qref2": Input(0.0, "pu", "reactive power set-point of station 2"),
        "E1": Input(1.0, "pu", "grid voltage of station 1", settable=False),
        "E2": Input(1.0, "pu", "grid voltage of station 2", settable=False),
        "Iload1": Input(0.0, "pu", "dc current drawn from the capacitor of station 1", settable=False),
    }


def _parameter(value: float, unit: str, text: str) -> Parameter:
    return Parameter(value, unit, min=0.0, description=text)


def gains(rated: Rating) -> dict[str, Parameter]:
    """Return the outer controls' gains, named as in the phasor link."""
    return {
        "KPVDC": _parameter(rated.KPVDC, "pu", "proportional gain of the dc voltage control"),
        "KIVDC": _parameter(rated.KIVDC, "pu/s", "integral gain of the dc voltage control"),
        "KPQ": _parameter(0.0, "pu", "proportional gain of the reactive power control, station 1"),
        "KIQ": _parameter(30.0, "pu/s", "integral gain of the reactive power control, station 1"),
        "KPP": _parameter(0.0, "pu", "proportional gain of the active power control, station 2"),
        "KIP": _parameter(30.0, "pu/s", "integral gain of the active power control, station 2"),
        "KPQ2": _parameter(0.0, "pu", "proportional gain of the reactive power control, station 2"),
        "KIQ2": _parameter(30.0, "pu/s", "integral gain of the reactive power control, station 2"),
    }


def plant(rated: Rating) -> dict[str, Parameter]:
    """Grids, transformers, arms and dc side."""
    return {
        "C1": _parameter(rated.C, "s", "dc capacitance of station 1"),
        "C2": _parameter(rated.C, "s", "dc capacitance of station 2"),
        "Rdc": _parameter(rated.Rdc, "pu", "dc line resistance"),
        "Zg": _parameter(rated.Zg, "pu", "grid impedance of either station, 10 GVA"),
        "XR": _parameter(10.0, "", "X/R of the grids"),
        "XT": _parameter(X_TRANSFORMER, "pu", "transformer reactance"),
        "RT": _parameter(R_TRANSFORMER, "pu", "transformer resistance"),
        "XA": _parameter(X_ARM, "pu", "arm reactance as the ac side sees it: half of 0.15"),
        "Rs": _parameter(2 / 3 * 0.4 / 409.6, "pu", "dc-side resistance of a station: 2/3 of 400 modules of 1 mohm"),
        "Ls": _parameter(2 / 3 * 0.15 / 4 / (100 * math.pi), "s", "dc-side inductance of a station: 2/3 of an arm's"),
        "F0": _parameter(50.0, "Hz", "grid frequency"),
    }


def inside(filtered: bool) -> dict[str, Parameter]:
    """Parameters that the phasor link lacks: current control, PLL, feed-forward and filters."""
    filter_ = {"FM": _parameter(140.0, "Hz", "-3 dB frequency of the measurement filters")} if filtered else {}
    return {
        "KPI": _parameter(0.4870141, "pu", "proportional gain of the current control"),
        "KII": _parameter(149.085957, "pu/s", "integral gain of the current control"),
        "KX": _parameter(X_TRANSFORMER + X_ARM, "pu", "reactance that the current control decouples"),
        "FF": _parameter(11.0, "Hz", "-3 dB frequency of the voltage feed-forward"),
        "FV": _parameter(16.0, "Hz", "-3 dB frequency of the Bessel filter on the ac voltage"),
        "KPPLL": _parameter(80.0, "rad/s", "proportional gain of the PLL"),
        "KIPLL": _parameter(1600.0, "rad/s^2", "integral gain of the PLL"),
        "Tpll": _parameter(0.02, "s", "window of the PLL's mean, one cycle"),
    } | filter_


def model(
    filters: Iterable[Measured] = ("P", "Q", "Vdc"),
    rating: Literal["paper", "authors"] = "paper",
    priority: Literal["d", "q"] = "d",
    name: str = "vsc-hvdc-avm",
) -> Model:
    """Return the link in the paper's case (100 MVA, Table I) or the authors' (1000 MVA, 1 pu from station 2 to station 1).

    filters: measurements that pass a critically damped second-order low-pass, -3 dB at FM (140 Hz); P and Q unfiltered
    make a circle through their proportional gains, so that they are unknowns then. priority: the axis whose order is
    limited first. Sampling, computation delay and noise of the controller: effects at Vdc1_m, P2_m, Q1_m,
    Q2_m, Irorder1 and so on.
    """
    chosen = frozenset(filters)
    for given, known in ((chosen, MEASURED), ({rating}, RATINGS), ({priority}, ("d", "q"))):
        require_known("option", given, known, "the average-value link")
    rated = RATINGS[rating]
    starts = _guesses(rated)
    derivatives = _dc_derivatives() | _control_derivatives()
    signals = {
        "w0": "2*pi*F0",
        "R": "Zg / sqrt(1 + XR**2)",
        "X": "XR * R",
        "Xall": "X + XT + XA",
        "Rall": "R + RT",
        "kx": "X/Xall",
    }
    signals |= _dc() | _control_vdc() | _control_p() | _orders(priority)
    for i in (1, 2):
        derivatives |= _station_derivatives(i)
        signals |= _circuit(i) | _inner(i) | _control_q(i)
    unknowns = {}
    for measured, kind in _MEASUREMENTS.items():
        if kind in chosen:
            derivatives |= {
                f"{measured}_f": f"wm * ({measured[:-2]} - {measured}_f)",
                f"{measured}_g": f"wm * ({measured}_f - {measured}_g)",
            }
            signals |= {"wm": f"2*pi*FM / {CRITICAL!r}", measured: f"{measured}_g"}
        elif kind in ("P", "Q"):
            unknowns[measured] = Algebraic(parse(measured[:-2]), start=starts[f"{measured}_g"], unit="pu")
        else:
            signals[measured] = measured[:-2]
    states = {n: State(parse(e), guess=starts[n], unit=_unit(n), description=_part(n)) for n, e in derivatives.items()}
    for i in (1, 2):
        mean = parse(f"(vq{i} - vq{i}_before) / Tpll")
        states[f"vqa{i}"] = State(mean, guess=0.0, rest=parse(f"vq{i}"), unit="pu", description=f"PLL {i}")
    return Model(
        name=name,
        description=f"Two-terminal VSC-HVDC link, average-value; pu of {rated.base:g} MVA and 640 kV",
        parameters=FrozenMap(gains(rated) | plant(rated) | inside(bool(chosen))),
        inputs=FrozenMap(inputs(rated)),
        states=FrozenMap(states),
        signals=FrozenMap({n: Signal(parse(e), _unit(n)) for n, e in signals.items()}),
        algebraic=FrozenMap(unknowns),
        outputs=FrozenMap({n: Output(parse(n), "pu") for n in OUTPUTS}),
        delays=FrozenMap({f"vq{i}_before": Delay(parse(f"vq{i}"), parse("Tpll")) for i in (1, 2)}),
        parameterisations=FrozenMap({"physical": _physical()} if rating == "paper" else {}),
    )


def _physical() -> Parameterisation:
    """Return the phasor link's rule for the gains from capacitance and settling time."""
    return vsc_hvdc_link.model().parameterisations["physical"]


VARIANTS: dict[str, tuple[str, Callable[[], Model]]] = {
    "vsc-hvdc-avm-unfiltered": (
        "the average-value link without its 140 Hz measurement filters",
        lambda: model((), name="vsc-hvdc-avm-unfiltered"),
    ),
    "vsc-hvdc-avm-authors": (
        "the average-value link as its authors published it: 1000 MVA, no measurement filters, q axis first",
        lambda: model((), "authors", "q", "vsc-hvdc-avm-authors"),
    ),
}


OUTPUTS = (
    *("Irorder1", "Iiorder1", "Irorder2", "Iiorder2", "Vdc1", "Vdc2", "P1", "Q1", "P2", "Q2", "Vac1", "Vac2", "Idc"),
    *("Ir1", "Ii1", "Ir2", "Ii2"),
)


_MEASUREMENTS = {
    "Vdc1_m": "Vdc",
    "Vdc2_m": "Vdc",
    "P2_m": "P",
    "Q1_m": "Q",
    "Q2_m": "Q",
    "Vac1_m": "Vac",
    "Vac2_m": "Vac",
}


_PARTS = {
    "Ir": "current control",
    "Ii": "current control",
    "xd": "current control",
    "xqi": "current control",
    "psi": "PLL",
    "xpll": "PLL",
    "fd": "voltage feed-forward",
    "fq": "voltage feed-forward",
    "Vf": "ac voltage filter",
    "Vac": "ac voltage filter",
    "Vc": "dc link",
    "Idc": "dc link",
    "Vdc": "dc voltage measurement",
    "P": "active power measurement",
    "Q": "reactive power measurement",
    "xv": "dc voltage control",
    "xp": "active power control",
    "xq": "reactive power control",
}


def _part(state: str) -> str:
    """Return the part of the plant that a state belongs to, with its station's number where it has one."""
    prefix = max((p for p in _PARTS if state.startswith(p)), key=len)
    station = next((c for c in state if c.isdigit()), "")
    return _PARTS[prefix] if prefix in ("Vc", "Idc", "xv", "xp") else f"{_PARTS[prefix]} {station}"


def _unit(name: str) -> str:
    if name.startswith("psi"):
        return "rad"
    return {
        "w0": "rad/s",
        "wpll1": "rad/s",
        "wpll2": "rad/s",
        "wm": "1/s",
        "wb": "1/s",
        "xpll1": "pu s",
        "xpll2": "pu s",
    }.get(name, "pu")


def _circuit(i: int) -> dict[str, str]:
    """Terminal voltage, di/dt eliminated from it (kx: the grid's share of the reactance), and powers."""
    return {
        f"Ed{i}": f"E{i}*cos(psi{i})",
        f"Eq{i}": f"-E{i}*sin(psi{i})",
        f"vd{i}": f"Ed{i} + kx*(vcd{i} - Ed{i}) - (R - kx*Rall)*Ir{i}",
        f"vq{i}": f"Eq{i} + kx*(vcq{i} - Eq{i}) + (R - kx*Rall)*Ii{i}",
        f"Vac{i}": f"sqrt(vd{i}**2 + vq{i}**2)",
        f"P{i}": f"vd{i}*Ir{i} - vq{i}*Ii{i}",
        f"Q{i}": f"vq{i}*Ir{i} + vd{i}*Ii{i}",
        f"Pdc{i}": f"vcd{i}*Ir{i} - vcq{i}*Ii{i}",
    }


def _inner(i: int) -> dict[str, str]:
    """Current control with anti-windup, decoupling and feed-forward; the modulation's magnitude is limited to 1.5."""
    return {
        f"ed{i}": f"Irorder{i} - Ir{i}",
        f"pd{i}_u": f"KPI*ed{i} + xd{i}",
        f"pd{i}": f"clip(pd{i}_u, -0.6, 0.6)",
        f"eqi{i}": f"Ii{i} - Iiorder{i}",
        f"pq{i}_u": f"KPI*eqi{i} + xqi{i}",
        f"pq{i}": f"clip(pq{i}_u, -0.6, 0.6)",
        f"vsd{i}": f"fd{i} - pd{i} - KX*Ii{i}",
        f"vsq{i}": f"fq{i} - pq{i} - KX*Ir{i}",
        f"mod{i}": f"{RATIO!r} * min(1, 1.5*Vdc{i} / sqrt(vsd{i}**2 + vsq{i}**2))",
        f"vcd{i}": f"mod{i}*vsd{i}",
        f"vcq{i}": f"mod{i}*vsq{i}",
        f"wpll{i}": f"clip(KIPLL*xpll{i} + KPPLL*vqa{i}, 0.75*w0, 1.25*w0)",
    }


def _station_derivatives(i: int) -> dict[str, str]:
    return {
        f"Ir{i}": f"w0/Xall * (Ed{i} - vcd{i} - Rall*Ir{i}) - wpll{i}*Ii{i}",
        f"Ii{i}": f"w0/Xall * (vcq{i} - Eq{i} - Rall*Ii{i}) + wpll{i}*Ir{i}",
        f"psi{i}": f"wpll{i} - w0",
        f"xpll{i}": f"vqa{i}",
        f"xd{i}": f"KII * (ed{i} + pd{i} - pd{i}_u)",
        f"xqi{i}": f"KII * (eqi{i} + pq{i} - pq{i}_u)",
        f"fd{i}": f"2*pi*FF * (vd{i} - fd{i})",
        f"fq{i}": f"2*pi*FF * (vq{i} - fq{i})",
        f"Vf{i}": f"wb * Vf{i}_s",
        f"Vf{i}_s": f"3*wb * (Vac{i}_m - Vf{i} - Vf{i}_s)",
    }


def _dc() -> dict[str, str]:
    return {
        "wb": f"2*pi*FV / {BESSEL!r}",
        "vL": "(Vc2 - Vc1 - (2*Rs + Rdc)*Idc) / 2",
        "Vdc1": "Vc1 + Rs*Idc + vL",
        "Vdc2": "Vc2 - Rs*Idc - vL",
    }


def _dc_derivatives() -> dict[str, str]:
    return {
        "Vc1": "(Pdc1/Vdc1 + Idc - Iload1) / C1",
        "Vc2": "(Pdc2/Vdc2 - Idc) / C2",
        "Idc": "vL / Ls",
    }


def _control_vdc() -> dict[str, str]:
    return {"ev": "Vdcref1 - Vdc1_m", "yv_u": "KPVDC*ev + xv", "yv": "clip(yv_u, -1.2, 1.2)"}


def _control_p() -> dict[str, str]:
    """Return active power control with a droop of 10 outside 0.95 to 1.05 pu of dc voltage."""
    return {
        "ep": "Pref2 - P2_m",
        "yp_u": "KPP*ep + xp",
        "yp": "clip(yp_u, -1.2, 1.2)",
        "db2": "10*(clip(Vdc2_m, 0.95, 1.05) - Vdc2_m)",
    }


def _control_q(i: int) -> dict[str, str]:
    kp = "KPQ" if i == 1 else "KPQ2"
    return {
        f"eq{i}": f"Qref{i} - Q{i}_m",
        f"yq{i}_u": f"{kp}*eq{i} + xq{i}",
        f"yq{i}": f"clip(yq{i}_u, -0.5, 0.5)",
    }


def _orders(priority: str) -> dict[str, str]:
    """Return the orders with their limits: the first axis has its own, the other what is left of 1.1."""
    wanted = {"1": "yv", "2": "(yp + db2) / clip(Vf2, 0.01, 2)"}
    orders: dict[str, str] = {}
    for i, d in wanted.items():
        q = f"yq{i} / clip(Vf{i}, 0.01, 2)"
        if priority == "d":
            orders |= {
                f"Irorder{i}": f"clip({d}, -1.1, 1.1)",
                f"m{i}": f"min(0.5, sqrt(max(0, 1.1**2 - Irorder{i}**2)))",
                f"Iiorder{i}": f"clip({q}, -m{i}, m{i})",
            }
        else:
            orders |= {
                f"Iiorder{i}": f"clip({q}, -0.5, 0.5)",
                f"m{i}": f"sqrt(1.1**2 - Iiorder{i}**2)",
                f"Irorder{i}": f"clip({d}, -m{i}, m{i})",
            }
    return orders


def _control_derivatives() -> dict[str, str]:
    return {
        "xv": "KIVDC * (ev + yv - yv_u)",
        "xp": "KIP * (ep + yp - yp_u)",
        "xq1": "KIQ * (eq1 + yq1 - yq1_u)",
        "xq2": "KIQ2 * (eq2 + yq2 - yq2_u)",
    }


def _guesses(rated: Rating) -> dict[str, float]:
    """Every state near the steady state of the start values: powers known, dc voltages 1, no reactive power."""
    guesses = {"Vc1": 1.0, "Vc2": 1.0, "Idc": rated.power, "xq1": 0.0, "xq2": 0.0, "Vdc1_m_g": 1.0, "Vdc2_m_g": 1.0}
    x = 10.0 * rated.Zg / math.sqrt(101.0)
    grid = complex(x / 10.0, x)
    for i, power in ((1, -rated.power), (2, rated.power)):
        i_grid = complex(power, 0.0)
        for _ in range(20):  # current so that P is the power and Q is 0 at the terminal
            v = 1.0 - grid * i_grid
            i_grid = (power / v).conjugate()
        psi = cmath.phase(v)
        i_dq, turn = i_grid * cmath.exp(-1j * psi), cmath.exp(-1j * psi)
        v_star = (v - complex(R_TRANSFORMER, X_TRANSFORMER + X_ARM) * i_grid) * turn / RATIO
        inner = abs(v) - v_star - 1j * (X_TRANSFORMER + X_ARM) * i_dq
        guesses |= {f"Ir{i}": i_dq.real, f"Ii{i}": -i_dq.imag, f"psi{i}": psi, f"xpll{i}": math.pi / 16.0}
        guesses |= {f"xd{i}": inner.real, f"xqi{i}": inner.imag, f"fd{i}": abs(v), f"fq{i}": 0.0}
        guesses |= {f"Vf{i}": abs(v), f"Vf{i}_s": 0.0, f"Vac{i}_m_g": abs(v), f"Q{i}_m_g": 0.0}
        guesses |= {"xv": i_dq.real} if i == 1 else {"xp": power, "P2_m_g": power}
    return guesses | {n[:-1] + "f": v for n, v in guesses.items() if n.endswith("_m_g")}
