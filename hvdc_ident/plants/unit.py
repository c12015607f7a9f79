"""The card of one unit: a machine or converter with its controls, at an infinite bus or played back."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Literal

import sympy as sp

from hvdc_ident.errors import ModelError, unknown_name
from hvdc_ident.expression import at_values, symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, parse_card, reached, shelf_model
from hvdc_ident.model.card import toml_key, toml_string
from hvdc_ident.model.transform import without_vanished
from hvdc_ident.parameters import Input
from hvdc_ident.shelf import components, outputs_of, record_of, source_of

UNCONNECTED = FrozenMap(
    {"Vs": "0", "Voel": "0", "Vuel": "0", "Voel_gate": "1000", "Vuel_gate": "-1000", "dwn": "0", "Paux": "0"}
    | {"wg": "1", "wt": "1", "wref": "1", "theta": "0", "theta_start": "0", "dPm": "0"}
)
"""Values of inputs that no other component gives: no stabiliser, no limiter (a gate stays open), nominal frequency and speed, no
turbine and no pitch."""
AHEAD = FrozenMap({"Pref0": "Pref"})
"""Inputs that follow a signal of another name, ahead of the part that takes it and gives it on changed: the torque controller of a wind
turbine makes of the plant's power reference the one that the electrical controller follows, the pitch controller takes the former."""
REFERENCES = (
    ("P0", "P", "MW", ("Plant_pref", "Pref", "nref", "Pm")),
    ("Q0", "Q", "Mvar", ("Vref", "Qref", "Qext", "PFaref", "Efd")),
)
"""Of a unit that is played back: the input with the recorded level before the event, its output and unit, and the reference that is
found from it, the first that the unit has and that its flags let act."""
SET_POINTS = ("Plant_pref", "Pref", "nref", "Vref", "Qref", "Qext", "PFaref")
"""References that a person or another plant's control gives, where no part does."""
LEVELS = FrozenMap({level: output for level, output, _, _ in REFERENCES})
"""By input with a level the output that has it."""
LOADED = 0.8
"""Share of its base that a unit delivers where its level is not known."""
VOLTAGE = Input(1.0, "pu", "voltage of the infinite bus", settable=False)
SHOWN = FrozenMap({"P": "MW", "Q": "Mvar", "Vt": "pu", "dw": "pu", "Efd": "pu", "Pm": "pu", "wt": "pu", "wg": "pu"})
"""Outputs of a unit, where one of its components has them, with their units."""


METER = "freq.dwn"
"""Signal that controls take as the frequency of the network where the unit is played back: of a recorded angle, its rate counts. A
machine, which has a speed of its own in the frame, takes that of the frame."""
MACHINE = "gen"
STEP_UP = "step_up"
"""Name of the transformer between the machine and the bus, where a unit has one of its own."""
NAMES = FrozenMap(
    {"Ir": MACHINE, "wg": "drive", "dPm": "aero", "theta": "pitch", "wref": "torque"}
    | {"Efd": "avr", "Pm": "gov", "Vs": "pss", "Ipcmd": "elec", "Qext": "plant"}
)
"""Name of a part in a unit by the output that it gives; another goes by the name of its component."""


@dataclass(frozen=True)
class UnitPart:
    """A component of a unit. source: its name on the shelf; values: parameters that differ from its card's."""

    source: str
    values: Mapping[str, float] = field(default_factory=FrozenMap)


def unit_card(
    parts: Mapping[str, UnitPart],
    *,
    name: str = "unit",
    network: Literal["infinite-bus", "playback"] = "infinite-bus",
    R: float = 0.0,
    X: float = 0.2,
    f0: float = 50.0,
    levels: Mapping[str, float] = FrozenMap(),
) -> str:
    """Return the text of the card of a unit.

    parts: by name, among them one with a current into the network. An input of a part follows the output of its name that another part
    has; one that none has is an input of the unit with that name (a reference), or what `UNCONNECTED` says. A transformer named
    `STEP_UP` lies between machine and bus; P and Q are those at the bus.
    network: an infinite bus behind the impedance R + jX (pu of the system base), or the recorded voltage at the terminals and its angle
    or frequency.
    f0: nominal frequency, Hz. levels: of inputs before the event, from which the search for a start sets out. Raises ModelError where
    no part or several give a current.
    """
    models = {n: shelf_model(p.source) for n, p in parts.items()}
    machine = _one_that_gives(models, "Ir")
    played = network == "playback"
    powers = _powers(machine, "bus" if played else "line", STEP_UP in parts)
    connections, references = _wired(models, _network(machine, played, STEP_UP in parts), played)
    inputs: dict[str, Input] = {**(shelf_model("playback").inputs if played else {"E": VOLTAGE}), **references}
    grid = (
        {"bus": UnitPart("playback", {"f0": f0})}
        if played
        else {"grid": UnitPart("infinite-bus"), "line": UnitPart("line", {"R": R, "X": X})}
    )
    if METER in connections.values():
        connections |= {"freq.theta": "theta", "freq.f": "f"}
        grid["freq"] = UnitPart("bus-frequency", {"f0": f0})
    shared = {n: {"f0": f0} if "f0" in m.parameters else {} for n, m in models.items()}
    components = {n: replace(p, values=shared[n] | dict(p.values)) for n, p in parts.items()} | grid

    def card(references: Mapping[str, tuple[str, str, Input]], known: Mapping[str, float] = FrozenMap()) -> str:
        lines = [
            "schema = 1",
            f"name = {toml_string(name)}",
            "",
            "[inputs]",
            *(_input_line(n, replace(i, value=known.get(n, i.value))) for n, i in inputs.items()),
            *(line for n, p in components.items() for line in _component_lines(n, p)),
            "",
            "[connections]",
            *(f"{toml_key(n)} = {e if e.startswith('{') else toml_string(e)}" for n, e in connections.items()),
            *(line for n, about in references.items() for line in _reference_lines(n, machine, powers, *about)),
            "",
            "[outputs]",
            *_output_lines(models, powers),
        ]
        return "\n".join(lines) + "\n"

    return card(_references(inputs, parts[machine], _uses(card({}))) if played else {}, {"f": f0} | dict(levels))


def _wired(
    models: Mapping[str, Model], connections: Mapping[str, str], played: bool
) -> tuple[dict[str, str], FrozenMap[Input]]:
    """Return what each input of the parts follows, and the inputs of the unit that are left. connections: those with the network."""
    follows, inputs = dict(connections), dict[str, Input]()
    targets = [
        (n, u, quantity) for n, m in models.items() for u, quantity in m.inputs.items() if f"{n}.{u}" not in follows
    ]
    for part, u, quantity in targets:
        sources = _sources(models, part, u)
        if len(sources) > 1:
            raise ModelError(f"'{part}.{u}' may follow several parts", expected="one", got=", ".join(sources))
        if sources:
            follows[f"{part}.{u}"] = f"{sources[0]}.{AHEAD.get(u, u)}"
        elif played and u == "dwn":
            follows[f"{part}.{u}"] = "bus.dwn" if "dw" in models[part].outputs else METER
        else:
            signal = AHEAD.get(u, u)
            follows[f"{part}.{u}"] = UNCONNECTED.get(signal, signal)
            if signal not in UNCONNECTED:
                inputs.setdefault(signal, quantity)
    return follows, FrozenMap(inputs)


def _sources(models: Mapping[str, Model], part: str, u: str) -> list[str]:
    """Return the parts that an input of a part may follow: of those that give its signal, where one takes it from the others and gives
    it on changed, that one, or for an input ahead of it the others."""
    signal = AHEAD.get(u, u)
    givers = [n for n, m in models.items() if n != part and signal in m.outputs]
    changing = [n for n in givers if any(AHEAD.get(v) == signal for v in models[n].inputs)]
    return [n for n in givers if (n in changing) == (u == signal)] if changing else givers


def _component_lines(name: str, part: UnitPart) -> Iterator[str]:
    yield from ("", f"[components.{name}]", f"source = {toml_string(part.source)}")
    if part.values:
        yield f"parameters = {{{', '.join(f'{toml_key(n)} = {float(v)!r}' for n, v in part.values.items())}}}"


def _reference_lines(
    name: str, machine: str, powers: Mapping[str, str], level: str, output: str, quantity: Input
) -> Iterator[str]:
    """Yield the state of a reference: it never moves, and where it stands follows from the level of the output."""
    rest = f"{name} + ({level} - {powers[output]})/{machine}.Sn"
    yield from ("", f"[states.{toml_key(name)}]", 'derivative = "0"', f"rest = {toml_string(rest)}")
    yield from (f"guess = {quantity.value!r}", f"unit = {toml_string(quantity.unit)}")
    yield f"description = {toml_string(quantity.description)}"


def _output_lines(models: Mapping[str, Model], powers: Mapping[str, str]) -> Iterator[str]:
    for n, unit in SHOWN.items():
        source = next((part for part, model in models.items() if n in model.outputs), None)
        if source is not None:
            yield f'{n} = {{value = "{powers.get(n, f"{source}.{n}")}", unit = "{unit}"}}'


def _powers(machine: str, end: str, step_up: bool) -> dict[str, str]:
    """Return the expressions of P (MW) and Q (Mvar) into the network. end: the component that has the voltage of the bus."""
    if not step_up:
        return {"P": f"{machine}.P", "Q": f"{machine}.Q"}
    base, Ir, Ii = f"{machine}.Sb", f"{STEP_UP}.Ir_far", f"{STEP_UP}.Ii_far"
    return {"P": f"{base}*({end}.Vr*{Ir} + {end}.Vi*{Ii})", "Q": f"{base}*({end}.Vi*{Ir} - {end}.Vr*{Ii})"}


def parts_of(records: Mapping[str, Sequence[float]]) -> dict[str, UnitPart]:
    """Return the parts of a unit by name. records: by model (GENROU, SEXS), the values of its .dyr record in their order."""
    parts = {}
    for model, values in records.items():
        source = source_of(model)
        if source is None:
            raise unknown_name("model on the shelf", model, [c.upper() for c in components() if record_of(c)])
        names = record_of(source)
        if len(values) != len(names):
            raise ModelError(
                f"the record of {model} has another number of values",
                expected=f"{len(names)}: {', '.join(names)}",
                got=str(len(values)),
            )
        parts[part_name(source)] = UnitPart(
            source, {n: float(v) for n, v in zip(names, values, strict=True) if n != "-"}
        )
    return parts


def idle_parts(parts: Mapping[str, UnitPart]) -> list[str]:
    """Return the parts beside the machine that no other part follows: a stabiliser without its exciter."""
    models = {n: shelf_model(p.source) for n, p in parts.items() if n != STEP_UP}
    taken = {n: {AHEAD.get(u, u) for other, m in models.items() if other != n for u in m.inputs} for n in models}
    return [n for n, m in models.items() if n != MACHINE and taken[n].isdisjoint(m.outputs)]


def part_name(source: str) -> str:
    """Return the name of a component in a unit."""
    outputs = outputs_of(source)
    return next((n for o, n in NAMES.items() if o in outputs), source)


def _references(
    inputs: dict[str, Input], machine: UnitPart, used: Mapping[str, Set[str]]
) -> dict[str, tuple[str, str, Input]]:
    """Return by reference its level's name, its output and what it was; the levels take the places of the references among the inputs.

    used: by name what it uses, of the unit with the references as inputs.
    """
    references = {}
    for level, output, unit_of_level, names in REFERENCES:
        acting = set(reached([output], lambda name: used.get(name, ())))
        reference = next((n for n in names if n in inputs and n in acting), None)
        if reference is not None:
            references[reference] = (level, output, inputs.pop(reference))
            base = machine.values.get("Sn", shelf_model(machine.source).values.get("Sn", 100.0))
            value = LOADED * base if output == "P" else 0.0
            inputs[level] = Input(value, unit_of_level, f"{output} before the event", settable=False)
    return references


@lru_cache(maxsize=16)
def _uses(card: str) -> FrozenMap[Set[str]]:
    """Return `uses` of a unit.

    Its card is written twice, before and after the levels of its inputs are known, which do not matter here.
    """
    return uses(without_vanished(parse_card(card)))


def uses(model: Model, free: Collection[str] = ()) -> FrozenMap[Set[str]]:
    """Return by variable the names that its expressions have at the values of the parameters: flags decide which branch counts.

    free: parameters that are not at their values.
    """
    at = {symbol(n): sp.Float(p.value) for n, p in model.parameters.items() if n not in free}
    expressions = {n: [s.derivative, s.rest or sp.S.Zero] for n, s in model.states.items()}
    expressions |= {n: [s.value] for n, s in model.signals.items()}
    expressions |= {n: [a.equation] for n, a in model.algebraic.items()}
    expressions |= {n: [d.of] for n, d in model.delays.items()}
    expressions |= {n: [s.value] for n, s in model.sampled.items()}
    expressions |= {n: [o.value] for n, o in model.outputs.items() if n not in expressions}
    return FrozenMap({n: {s.name for e in of for s in at_values(e, at).free_symbols} for n, of in expressions.items()})


def _network(machine: str, played: bool, step_up: bool) -> dict[str, str]:
    """Return the connections of the machine with the network, over its step-up transformer where it has one."""
    end = "bus" if played else "line"
    terminal = STEP_UP if step_up else end
    # Without a network between them the recorded voltage is that of the machine; else voltage and current are a circle of unknowns.
    circle = step_up or not played
    machine_ends = {
        f"{machine}.{v}": f'{{value = "{terminal}.{v}", start = {start}}}' if circle else f"{terminal}.{v}"
        for v, start in (("Vr", 1.0), ("Vi", 0.2))
    }
    over = {f"{STEP_UP}.{v}_far": f"{end}.{v}" for v in ("Vr", "Vi")} | {
        f"{STEP_UP}.{i}": f"{machine}.{i}" for i in ("Ir", "Ii")
    }
    through = over if step_up else {}
    if played:
        return {"bus.V": "V", "bus.theta": "theta", "bus.f": "f"} | through | machine_ends
    into = {f"line.{i}": f"{STEP_UP}.{i}_far" if step_up else f"{machine}.{i}" for i in ("Ir", "Ii")}
    far = {"grid.V": "E", "grid.theta": "0", "line.Vr_far": "grid.Vr", "line.Vi_far": "grid.Vi"}
    return far | into | through | machine_ends


def _one_that_gives(models: Mapping[str, Model], output: str) -> str:
    giving = [n for n, m in models.items() if output in m.outputs]
    if len(giving) != 1:
        got = ", ".join(giving) or "none"
        raise ModelError(
            "a unit has one part with a current into the network", expected="one machine or converter", got=got
        )
    return giving[0]


def _input_line(name: str, quantity: Input) -> str:
    settable = "" if quantity.settable else ", settable = false"
    return (
        f"{toml_key(name)} = {{value = {quantity.value!r}, unit = {toml_string(quantity.unit)}, "
        f"description = {toml_string(quantity.description)}{settable}}}"
    )
