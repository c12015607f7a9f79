"""A multi-terminal grid: n phasor stations along a chain of dc lines, 3 n states.

Station 1 controls the dc voltage, the others active power; every station controls reactive power. With n = 2 it is the
two-terminal link under other names. Dc lines are resistances between neighbours, positive from the higher number to the
lower. Gains of the dc voltage control follow the link's design rule for the grid's total capacitance, n x 0.2 s; power
alternates in sign along the chain, so that station 1 balances one station at most. Per unit on 100 MVA and 640 kV.
Made of components of the shelf, whose equations are those of Vanfretti, Murad, Gomez Lopez 2017 (doi
10.1109/PESGM.2017.8274525).
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import sympy as sp

from hvdc_ident.errors import ModelError
from hvdc_ident.expression import symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, Output, State
from hvdc_ident.model.components import Component, assembled
from hvdc_ident.parameters import Input, Parameter
from hvdc_ident.plants import shelf_model

SUMMARY = "multi-terminal grid of phasor stations, 3 states each; vsc-mtdc-N for N terminals, 4 where none is given"

STATIONS = 400
_NAME = re.compile(r"vsc-mtdc-(\d{1,4})")
_STATES = ("Vdc", "xv", "xp", "xq")
"""The order of the states, by their names without the stations' numbers."""


def model() -> Model:
    """Return the grid of four terminals."""
    return vsc_mtdc(4)


def family(name: str) -> Model | None:
    """Return the grid a name like `vsc-mtdc-12` asks for; None for another kind of name."""
    match = _NAME.fullmatch(name)
    return vsc_mtdc(int(match[1])) if match else None


def vsc_mtdc(terminals: int) -> Model:
    """Return the grid of so many terminals, 2 to 400; ModelError outside that."""
    if not 2 <= terminals <= STATIONS:
        raise ModelError(
            "a grid of so many terminals is not offered", expected=f"2 to {STATIONS} terminals", got=str(terminals)
        )
    stations = [str(i) for i in range(1, terminals + 1)]
    own: dict[str, Mapping[str, Any]] = {
        "parameters": _parameters(stations),
        "inputs": _inputs(stations),
        "states": _nodes(stations),
        "outputs": {name: Output(symbol(name), "pu") for name in _outputs(stations)},
    }
    grid = assembled(
        own,
        _components(stations),
        {},
        name=f"vsc-mtdc-{terminals}",
        description=f"Grid of {terminals} phasor stations along a chain of dc lines; pu of 100 MVA and 640 kV",
    )
    states = sorted(grid.states.items(), key=lambda item: _STATES.index(item[0].rstrip("0123456789")))
    return replace(grid, states=FrozenMap(states))


def _parameters(stations: list[str]) -> dict[str, Parameter]:
    def at_least_0(value: float, unit: str, text: str) -> Parameter:
        return Parameter(value, unit, min=0.0, description=text)

    share = len(stations) / 2  # of the link's two capacitances, which its gains are designed for
    parameters = {
        "KPVDC": at_least_0(24.0 * share, "pu", "proportional gain of the dc voltage control"),
        "KIVDC": at_least_0(734.7 * share, "pu/s", "integral gain of the dc voltage control"),
    }
    for i in stations[1:]:
        parameters[f"KPP{i}"] = at_least_0(0.0, "pu", f"proportional gain of the active power control, station {i}")
        parameters[f"KIP{i}"] = at_least_0(30.0, "pu/s", f"integral gain of the active power control, station {i}")
    for i in stations:
        parameters[f"KPQ{i}"] = at_least_0(0.0, "pu", f"proportional gain of the reactive power control, station {i}")
        parameters[f"KIQ{i}"] = at_least_0(30.0, "pu/s", f"integral gain of the reactive power control, station {i}")
        parameters[f"C{i}"] = at_least_0(0.2, "s", f"dc capacitance of station {i}")
    for a, b in _lines(stations):
        parameters[f"Rdc{a}_{b}"] = at_least_0(
            1 / 4096, "pu", f"dc line resistance between stations {a} and {b}, 1 ohm"
        )
    parameters["Zg"] = at_least_0(0.01, "pu", "grid impedance of every station, 10 GVA")
    parameters["XR"] = at_least_0(10.0, "", "X/R of the grids")
    return parameters


def _inputs(stations: list[str]) -> dict[str, Input]:
    inputs = {"Vdcref1": Input(1.0, "pu", "dc voltage set-point of station 1")}
    for i in stations[1:]:
        sign = 1.0 if int(i) % 2 == 0 else -1.0
        inputs[f"Pref{i}"] = Input(0.4 * sign, "pu", f"active power set-point of station {i}")
    for i in stations:
        inputs[f"Qref{i}"] = Input(0.0, "pu", f"reactive power set-point of station {i}")
        inputs[f"E{i}"] = Input(1.0, "pu", f"grid voltage of station {i}", settable=False)
        inputs[f"Iload{i}"] = Input(0.0, "pu", f"dc current drawn at node {i}", settable=False)
    return inputs


def _nodes(stations: list[str]) -> dict[str, State]:
    """Return the dc voltages of the stations' capacitors."""
    nodes = {}
    for i in stations:
        drawn = sp.Add(*(symbol(f"Idc{a}_{b}") * (1 if b == i else -1) for a, b in _lines(stations) if i in (a, b)))
        voltage = symbol(f"Vdc{i}")
        balance = symbol(f"Pdc{i}") / voltage - drawn - symbol(f"Iload{i}")
        nodes[voltage.name] = State(balance / symbol(f"C{i}"), guess=1.0, unit="pu")
    return nodes


def _components(stations: list[str]) -> dict[str, Component]:
    """Return the components of the grid: variables that go by one name in several of them are one."""
    first = {"*": "*", "Vdcref": "Vdcref1", "Vdc": "Vdc1", "Vdc_m": "Vdc1_m", "Irorder": "Irorder1"}
    components = {
        "grid": _component("grid-impedance", {"*": "*"}, Zg="Zg", XR="XR"),
        "voltage1": _component("vsc-vdc-control", first, KP="KPVDC", KI="KIVDC"),
    }
    for i in stations:
        components[f"converter{i}"] = _component("vsc-phasor", _numbered(i), R="R", X="X")
        components[f"reactive{i}"] = _component("vsc-q-control", _numbered(i), KP=f"KPQ{i}", KI=f"KIQ{i}")
    for i in stations[1:]:
        components[f"power{i}"] = _component("vsc-p-control", _numbered(i), KP=f"KPP{i}", KI=f"KIP{i}")
    for a, b in _lines(stations):
        ends = {"V": f"Vdc{a}", "V_far": f"Vdc{b}", "I": f"Idc{a}_{b}"}
        components[f"line{a}_{b}"] = _component("dc-line", ends, R=f"Rdc{a}_{b}")
    return components


def _component(source: str, names: Mapping[str, str], **parameters: str) -> Component:
    """Return a component of the shelf under names in the grid, with parameters of the grid for its own."""
    values = {n: symbol(of_grid) for n, of_grid in parameters.items()}
    return Component(shelf_model(source), FrozenMap(values), FrozenMap(names))


def _numbered(i: str) -> dict[str, str]:
    """Return the pattern of names that have the station's number, before _m and _u where they end so."""
    return {"*": f"*{i}", "*_m": f"*{i}_m", "*_u": f"*{i}_u"}


def _outputs(stations: list[str]) -> list[str]:
    kinds = ("Irorder", "Iiorder", "Vdc", "P", "Q", "Vac")
    return [f"{kind}{i}" for kind in kinds for i in stations] + [f"Idc{a}_{b}" for a, b in _lines(stations)]


def _lines(stations: list[str]) -> list[tuple[str, str]]:
    return list(itertools.pairwise(stations))
