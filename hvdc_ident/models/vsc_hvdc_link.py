"""The phasor link: two VSC stations as current injectors behind their grids, with high-level controls, 6 states.

Per unit on 100 MVA and 640 kV, time in s. Station 1 controls dc voltage and reactive power, station 2 active and
reactive power; positive power flows from a grid into its converter. Equations: Vanfretti, Murad, Gomez Lopez 2017
(doi 10.1109/PESGM.2017.8274525), limits and anti-windup after the authors' average-value model.
"""

from __future__ import annotations

from hvdc_ident.expression import parse
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.model.definition import Algebraic, Model, Output, Parameterisation, Signal, State
from hvdc_ident.parameters import Input, Parameter

SUMMARY = "two-terminal VSC-HVDC link in phasors, 6 states (the model under calibration)"

DAMPING = 0.7


def model() -> Model:
    """The link in the paper's case: 40 MW from station 2 to station 1, gains of Table I."""
    return Model(
        name="vsc-hvdc-link",
        description="Two-terminal VSC-HVDC link in phasors; pu of 100 MVA and 640 kV",
        parameters=FrozenMap(_gains() | _plant()),
        inputs=FrozenMap(
            {
                "Vdcref1": Input(1.0, "pu", "dc voltage set-point of station 1"),
                "Qref1": Input(0.0, "pu", "reactive power set-point of station 1"),
                "Pref2": Input(0.4, "pu", "active power set-point of station 2"),
                "Qref2": Input(0.0, "pu", "reactive power set-point of station 2"),
                "E1": Input(1.0, "pu", "grid voltage of station 1"),
                "E2": Input(1.0, "pu", "grid voltage of station 2"),
                "Iload1": Input(0.0, "pu", "dc current drawn at node 1"),
            }
        ),
        states=FrozenMap(
            {
                "Vdc1": State(parse("(Pdc1/Vdc1 + Idc - Iload1) / C1"), guess=1.0, unit="pu"),
                "Vdc2": State(parse("(Pdc2/Vdc2 - Idc) / C2"), guess=1.0, unit="pu"),
                "xv": State(parse("KIVDC * (ev + yv - yv_u)"), guess=0.0, unit="pu"),
                "xp": State(parse("KIP * (ep + yp - yp_u)"), guess=0.0, unit="pu"),
                "xq1": State(parse("KIQ * (eq1 + yq1 - yq1_u)"), guess=0.0, unit="pu"),
                "xq2": State(parse("KIQ2 * (eq2 + yq2 - yq2_u)"), guess=0.0, unit="pu"),
            }
        ),
        signals=FrozenMap({n: Signal(parse(e), "pu") for n, e in _signals().items()}),
        algebraic=FrozenMap(
            {
                "Ir1": Algebraic(parse("Irorder1"), unit="pu"),
                "Ii1": Algebraic(parse("Iiorder1"), unit="pu"),
                "Ir2": Algebraic(parse("Irorder2"), unit="pu"),
                "Ii2": Algebraic(parse("Iiorder2"), unit="pu"),
            }
        ),
        outputs=FrozenMap({n: Output(parse(n), "pu") for n in _OUTPUTS}),
        parameterisations=FrozenMap(
            {"gains": Parameterisation(FrozenMap(), FrozenMap(), "the controllers' gains"), "physical": physical()}
        ),
    )


_OUTPUTS = (
    "Irorder1",
    "Iiorder1",
    "Irorder2",
    "Iiorder2",
    "Vdc1",
    "Vdc2",
    "P1",
    "Q1",
    "P2",
    "Q2",
    "Vac1",
    "Vac2",
    "Idc",
)


def _gains() -> dict[str, Parameter]:
    def gain(value: float, unit: str, text: str) -> Parameter:
        return Parameter(value, unit, min=0.0, description=text)

    return {
        "KPVDC": gain(24.0, "pu", "proportional gain of the dc voltage control"),
        "KIVDC": gain(734.7, "pu/s", "integral gain of the dc voltage control"),
        "KPQ": gain(0.0, "pu", "proportional gain of the reactive power control, station 1"),
        "KIQ": gain(30.0, "pu/s", "integral gain of the reactive power control, station 1"),
        "KPP": gain(0.0, "pu", "proportional gain of the active power control, station 2"),
        "KIP": gain(30.0, "pu/s", "integral gain of the active power control, station 2"),
        "KPQ2": gain(0.0, "pu", "proportional gain of the reactive power control, station 2"),
        "KIQ2": gain(30.0, "pu/s", "integral gain of the reactive power control, station 2"),
    }


def _plant() -> dict[str, Parameter]:
    def size(value: float, unit: str, text: str) -> Parameter:
        return Parameter(value, unit, min=0.0, description=text)

    return {
        "C1": size(0.2, "s", "dc capacitance of station 1"),
        "C2": size(0.2, "s", "dc capacitance of station 2"),
        "Rdc": size(1 / 4096, "pu", "dc line resistance, 1 ohm"),
        "Zg": size(0.01, "pu", "grid impedance of either station, 10 GVA"),
        "XR": size(10.0, "", "X/R of the grids"),
    }


def _signals() -> dict[str, str]:
    common = {"R": "Zg / sqrt(1 + XR**2)", "X": "XR * R"}
    return (
        common
        | _station(1)
        | _station(2)
        | _control_vdc()
        | _control_p()
        | _control_q("1", "KPQ", "KIQ")
        | _control_q("2", "KPQ2", "KIQ2")
        | _line()
    )


def _station(i: int) -> dict[str, str]:
    return {
        f"Vac{i}": f"sqrt(E{i}**2 - (X*Ir{i} - R*Ii{i})**2) - (R*Ir{i} + X*Ii{i})",
        f"P{i}": f"Vac{i} * Ir{i}",
        f"Q{i}": f"Vac{i} * Ii{i}",
        f"Pdc{i}": f"P{i}",
    }


def _control_vdc() -> dict[str, str]:
    return {
        "Vdc1_m": "Vdc1",
        "ev": "Vdcref1 - Vdc1_m",
        "yv_u": "KPVDC*ev + xv",
        "yv": "clip(yv_u, -1.2, 1.2)",
        "Irorder1": "clip(yv, -1.1, 1.1)",
    }


def _control_p() -> dict[str, str]:
    return {
        "P2_m": "P2",
        "ep": "Pref2 - P2_m",
        "yp_u": "KPP*ep + xp",
        "yp": "clip(yp_u, -1.2, 1.2)",
        "Irorder2": "clip(yp / clip(Vac2, 0.01, 2), -1.1, 1.1)",
    }


def _control_q(i: str, kp: str, ki: str) -> dict[str, str]:
    return {
        f"Q{i}_m": f"Q{i}",
        f"eq{i}": f"Qref{i} - Q{i}_m",
        f"yq{i}_u": f"{kp}*eq{i} + xq{i}",
        f"yq{i}": f"clip(yq{i}_u, -0.5, 0.5)",
        f"m{i}": f"min(0.5, sqrt(max(0, 1.1**2 - Irorder{i}**2)))",
        f"Iiorder{i}": f"clip(yq{i} / clip(Vac{i}, 0.01, 2), -m{i}, m{i})",
    }


def _line() -> dict[str, str]:
    return {"Idc": "(Vdc2 - Vdc1) / Rdc"}


def physical() -> Parameterisation:
    """The gains from total capacitance J and settling time Ts: wn = 3/(z Ts), Kp = 2 z wn J, Ki = wn^2 J, else 3/Ts.

    The rule is reconstructed from Table I's numbers, which it gives digit for digit; it is not quoted from a manual.
    """
    wn = f"3/({DAMPING}*Ts)"
    integral = "3/Ts"
    replaces = {
        "KPVDC": f"2*{DAMPING}*{wn}*J",
        "KIVDC": f"({wn})**2*J",
        "KIP": integral,
        "KIQ": integral,
        "KIQ2": integral,
    }
    parameters = {
        "J": Parameter(0.4, "s", min=1e-6, description="total dc capacitance the controller is designed for"),
        "Ts": Parameter(0.1, "s", min=1e-6, description="settling time the controllers are designed for"),
    }
    return Parameterisation(
        FrozenMap(parameters),
        FrozenMap({n: parse(e) for n, e in replaces.items()}),
        "design values: capacitance J and settling time Ts",
    )
