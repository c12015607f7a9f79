"""The phasor link: two VSC stations as current injectors behind their grids, with high-level controls, 6 states.

Per unit on 100 MVA and 640 kV, time in s. Station 1 controls dc voltage and reactive power, station 2 active and
reactive power; positive power flows from a grid into its converter. Equations: Vanfretti, Murad, Gomez Lopez 2017
(doi 10.1109/PESGM.2017.8274525), limits and anti-windup after the authors' average-value model.
"""

from __future__ import annotations

from hvdc_ident.expression import parse
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Algebraic, Model, Output, Parameterisation, Signal, State
from hvdc_ident.models._phasor_station import control_p, control_q, control_vdc, grid_impedance, plant
from hvdc_ident.parameters import Input, Parameter

SUMMARY = "two-terminal VSC-HVDC link in phasors, 6 states (the model under calibration)"

DAMPING = 0.7


def model() -> Model:
    """Return the link in the paper's case: 40 MW from station 2 to station 1, gains of Table I."""
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
    return (
        grid_impedance()
        | plant("1")
        | plant("2")
        | control_vdc("1")
        | control_p("2")
        | control_q("1", "KPQ", "KIQ")
        | control_q("2", "KPQ2", "KIQ2")
        | _line()
    )


def _line() -> dict[str, str]:
    return {"Idc": "(Vdc2 - Vdc1) / Rdc"}


def physical() -> Parameterisation:
    """Return the gains from total capacitance J and settling time Ts: wn = 3/(z Ts), Kp = 2 z wn J, Ki = wn^2 J, else 3/Ts.

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
