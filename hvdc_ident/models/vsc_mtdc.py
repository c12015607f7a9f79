"""A multi-terminal grid: n phasor stations along a chain of dc lines, 3 n states.

Station 1 controls the dc voltage, the others active power; every station controls reactive power. With n = 2 it is the
two-terminal link under other names. Dc lines are resistances between neighbours, positive from the higher number to the
lower. Gains of the dc voltage control follow the link's design rule for the grid's total capacitance, n x 0.2 s; power
alternates in sign along the chain, so that station 1 balances one station at most. Per unit on 100 MVA and 640 kV.
Equations: Vanfretti, Murad, Gomez Lopez 2017 (doi 10.1109/PESGM.2017.8274525), put together n times.
"""

from __future__ import annotations

import itertools
import re

from hvdc_ident.errors import ModelError
from hvdc_ident.expression import parse
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Algebraic, Model, Output, Signal, State
from hvdc_ident.models._phasor_station import control_p, control_q, control_vdc, grid_impedance, plant
from hvdc_ident.parameters import Input, Parameter

SUMMARY = "multi-terminal grid of phasor stations, 3 states each; vsc-mtdc-N for N terminals, 4 where none is given"

MOST = 400
_NAME = re.compile(r"vsc-mtdc-(\d{1,4})")


def model() -> Model:
    """Return the grid of four terminals."""
    return vsc_mtdc(4)


def family(name: str) -> Model | None:
    """Return the grid a name like `vsc-mtdc-12` asks for; None for another kind of name."""
    match = _NAME.fullmatch(name)
    return vsc_mtdc(int(match[1])) if match else None


def vsc_mtdc(terminals: int) -> Model:
    """Return the grid of so many terminals, 2 to 400; ModelError outside that."""
    if not 2 <= terminals <= MOST:
        raise ModelError(
            "a grid of so many terminals is not offered", expected=f"2 to {MOST} terminals", got=str(terminals)
        )
    stations = [str(i) for i in range(1, terminals + 1)]
    return Model(
        name=f"vsc-mtdc-{terminals}",
        description=f"Grid of {terminals} phasor stations along a chain of dc lines; pu of 100 MVA and 640 kV",
        parameters=FrozenMap(_parameters(stations)),
        inputs=FrozenMap(_inputs(stations)),
        states=FrozenMap(_states(stations)),
        signals=FrozenMap({name: Signal(parse(text), "pu") for name, text in _signals(stations).items()}),
        algebraic=FrozenMap(
            {f"I{axis}{i}": Algebraic(parse(f"I{axis}order{i}"), unit="pu") for i in stations for axis in "ri"}
        ),
        outputs=FrozenMap({name: Output(parse(name), "pu") for name in _outputs(stations)}),
    )


def _parameters(stations: list[str]) -> dict[str, Parameter]:
    def at_least_0(value: float, unit: str, text: str) -> Parameter:
        return Parameter(value, unit, min=0.0, description=text)

    share = len(stations) / 2  # of the link's two capacitances, which its gains are designed for
    found = {
        "KPVDC": at_least_0(24.0 * share, "pu", "proportional gain of the dc voltage control"),
        "KIVDC": at_least_0(734.7 * share, "pu/s", "integral gain of the dc voltage control"),
    }
    for i in stations[1:]:
        found[f"KPP{i}"] = at_least_0(0.0, "pu", f"proportional gain of the active power control, station {i}")
        found[f"KIP{i}"] = at_least_0(30.0, "pu/s", f"integral gain of the active power control, station {i}")
    for i in stations:
        found[f"KPQ{i}"] = at_least_0(0.0, "pu", f"proportional gain of the reactive power control, station {i}")
        found[f"KIQ{i}"] = at_least_0(30.0, "pu/s", f"integral gain of the reactive power control, station {i}")
        found[f"C{i}"] = at_least_0(0.2, "s", f"dc capacitance of station {i}")
    for a, b in _lines(stations):
        found[f"Rdc{a}_{b}"] = at_least_0(1 / 4096, "pu", f"dc line resistance between stations {a} and {b}, 1 ohm")
    found["Zg"] = at_least_0(0.01, "pu", "grid impedance of every station, 10 GVA")
    found["XR"] = at_least_0(10.0, "", "X/R of the grids")
    return found


def _inputs(stations: list[str]) -> dict[str, Input]:
    found = {"Vdcref1": Input(1.0, "pu", "dc voltage set-point of station 1")}
    for i in stations[1:]:
        sign = 1.0 if int(i) % 2 == 0 else -1.0
        found[f"Pref{i}"] = Input(0.4 * sign, "pu", f"active power set-point of station {i}")
    for i in stations:
        found[f"Qref{i}"] = Input(0.0, "pu", f"reactive power set-point of station {i}")
        found[f"E{i}"] = Input(1.0, "pu", f"grid voltage of station {i}")
        found[f"Iload{i}"] = Input(0.0, "pu", f"dc current drawn at node {i}")
    return found


def _states(stations: list[str]) -> dict[str, State]:
    lines = _lines(stations)
    found = {}
    for i in stations:
        into = "".join(f" + Idc{a}_{b}" if a == i else f" - Idc{a}_{b}" for a, b in lines if i in (a, b))
        found[f"Vdc{i}"] = State(parse(f"(Pdc{i}/Vdc{i}{into} - Iload{i}) / C{i}"), guess=1.0, unit="pu")
    found["xv"] = State(parse("KIVDC * (ev + yv - yv_u)"), guess=0.0, unit="pu")
    for i in stations[1:]:
        found[f"xp{i}"] = State(parse(f"KIP{i} * (ep{i} + yp{i} - yp{i}_u)"), guess=0.0, unit="pu")
    for i in stations:
        found[f"xq{i}"] = State(parse(f"KIQ{i} * (eq{i} + yq{i} - yq{i}_u)"), guess=0.0, unit="pu")
    return found


def _signals(stations: list[str]) -> dict[str, str]:
    found = grid_impedance() | control_vdc("1")
    for i in stations:
        found |= plant(i) | control_q(i, f"KPQ{i}", f"KIQ{i}")
    for i in stations[1:]:
        found |= control_p(i, i)
    return found | {f"Idc{a}_{b}": f"(Vdc{b} - Vdc{a}) / Rdc{a}_{b}" for a, b in _lines(stations)}


def _outputs(stations: list[str]) -> list[str]:
    kinds = ("Irorder", "Iiorder", "Vdc", "P", "Q", "Vac")
    return [f"{kind}{i}" for kind in kinds for i in stations] + [f"Idc{a}_{b}" for a, b in _lines(stations)]


def _lines(stations: list[str]) -> list[tuple[str, str]]:
    return list(itertools.pairwise(stations))
