"""Candidate effects: every effect of the catalogue at every slot it may sit at, in a few finite sizes."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.effects import (
    Effect,
    EffectUse,
    Probe,
    SignalScales,
    admissible_sources,
    effects,
    joined_sources,
    probes,
    resistance_parameters,
    split_sources,
)
from hvdc_ident.errors import unknown_name
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel, insertion_point, is_white_box, reached

Signals = Mapping[str, tuple[Array, ...]]
"""By place: the signal in each fitted experiment."""

BOUND_MARGIN = 0.1
"""Share of a size that its bounds leave it, at least."""
EQUAL = 1e-9
"""Of their size: by how much two signals may differ that are one, as a source."""
MOTIONLESS = 1e-9


@dataclass(frozen=True)
class CandidateEffect:
    """One effect at one place, or at several that share its parameters. source: the signal it brings in, or, joined by
    commas, one for each place.

    named: parameters of the model that stand in for some of its own. still: whether its signal never moves.
    """

    effect: str
    at: tuple[str, ...]
    probes: tuple[Probe, ...]
    source: str = ""
    named: FrozenMap[str] = field(default_factory=FrozenMap)
    still: bool = False

    @property
    def label(self) -> str:
        """Name in tables: the effect, its slots, its source."""
        return f"{self.effect} at {', '.join(self.at)}" + (f" from {self.source}" if self.source else "")

    @property
    def sources(self) -> tuple[str, ...]:
        """By place the signal that is brought in there; () where none is."""
        return split_sources(self.source, self.at)

    def use(self, probe: Probe) -> EffectUse:
        """The effect as the model takes it."""
        return probe.use(self.at, self.source, self.named)

    def with_sizes(self, sizes: Iterable[Mapping[str, float]], like: Sequence[Probe] | None = None) -> CandidateEffect:
        """Return the candidate with further probes at these sizes, each well within its bounds.

        Each has the free sizes and bounds of the probe with the same equations among its own, or of those `like` which it is to be;
        one of other equations is left out, and so is one that is there.
        """
        entry, probes = effects()[self.effect], list(self.probes)
        known = {p.values for p in probes}
        for values in sizes:
            own = FrozenMap({n: values.get(n, v) for n, v in (like or self.probes)[0].values.items()})
            present = entry.present(own)
            model = next((p for p in like or self.probes if entry.present(p.values) == present), None)
            if model is None or own in known:
                continue
            known.add(own)
            free = {
                n: (min(low, own[n] - BOUND_MARGIN * abs(own[n])), max(high, own[n] + BOUND_MARGIN * abs(own[n])))
                for n, (low, high) in model.free.items()
            }
            probes.append(Probe(self.effect, own, FrozenMap(free)))
        return replace(self, probes=tuple(probes))


def entries(names: Iterable[str] | Literal["all"]) -> tuple[Effect, ...]:
    """The effects of the catalogue to try; forms that have to be found first are not among them. A name may be "all", too:
    those that a search for every effect tries, beside which others may be named."""
    catalogue = effects()
    sought = [n for n, e in catalogue.items() if e.tried_by_default]
    chosen: dict[str, None] = {}
    for name in ["all"] if names == "all" else names:
        if name != "all" and name not in catalogue:
            raise unknown_name("effect", name, catalogue)
        chosen |= dict.fromkeys(sought if name == "all" else [name])
    return tuple(catalogue[n] for n in chosen if not catalogue[n].needs_expression)


def candidates(
    model: AnyModel,
    signals: Signals,
    times: Sequence[Array],
    names: Iterable[str] | Literal["all"],
    places: Iterable[str | tuple[str, ...]] | None,
    tones: Iterable[float] = (),
) -> tuple[CandidateEffect, ...]:
    """Every candidate. signals: at the model's slots, those of measured outputs included; times: (K,) of each experiment."""
    live = [p for p in signals if _moves(model, p)]
    groups = places_of(model, live, places)
    about = {p: SignalScales.of(times, signals[p], tones) for p in live}
    brought = source_signals(model, signals)
    if not is_white_box(model):
        brought += tuple(p for p in live if kind_of(model, p) == "output")
    tried = entries(names)
    doubled, leaky = (any(e.name == n for e in tried) for n in ("coupling", "conductance"))
    found: list[CandidateEffect] = []
    for at in groups:
        joined = SignalScales.joined([about[p] for p in at])
        still = joined.high - joined.low <= MOTIONLESS * max(joined.peak, MOTIONLESS)
        kinds = {kind_of(model, p) for p in at}
        for effect in tried:
            if not kinds <= set(effect.insertion_kinds):
                continue
            usable = brought
            if effect.name == "droop" and doubled:
                # Without its deadband a droop is a negative coupling: where its name suits, it is tried in place of that.
                usable = tuple(b for b in brought if droops(model, at, b))
            if effect.name == "conductance":  # of the slot's own signal it is a gain, which is tried
                usable = tuple(b for b in brought if not proportional(signals[at[0]], signals[b]))
            more = _at(model, effect, at, joined, still, about, usable)
            found += [_no_conductance(c, about) for c in more] if effect.name == "loss" and leaky else more
    return tuple(found)


def _no_conductance(loss: CandidateEffect, about: Mapping[str, SignalScales]) -> CandidateEffect:
    """Return a loss without the size of its magnitude alone, where the other signal keeps its sign: that is a conductance."""
    if not all(about[s].low > 0.0 or about[s].high < 0.0 for s in loss.sources):
        return loss
    entry = effects()[loss.effect]
    return replace(loss, probes=tuple(p for p in loss.probes if entry.present(p.values) != ("b",)))


def _at(
    model: AnyModel,
    effect: Effect,
    at: tuple[str, ...],
    signal: SignalScales,
    still: bool,
    about: Mapping[str, SignalScales],
    brought: Sequence[str],
) -> list[CandidateEffect]:
    if effect.resistance:
        found = list(resistance_parameters(model, at[0])) if len(at) == 1 and is_white_box(model) else []
        return [
            CandidateEffect(
                effect.name, at, probes(effect, signal, given={effect.resistance: model.parameters[n].value}),
                named=FrozenMap({effect.resistance: n}), still=still,
            )
            for n in found
        ]  # fmt: skip
    if not effect.needs_source:
        return [CandidateEffect(effect.name, at, probes(effect, signal), still=still and not additive(effect))]
    open_to = [_open_to(model, p, [*about]) for p in at]
    seen = {
        own: SignalScales.joined([about[s] for s in own])
        for own in own_sources(at, brought, about)
        if all(s in may for s, may in zip(own, open_to, strict=True))
    }
    return [
        CandidateEffect(effect.name, at, _probes_of(model, effect, at, own, signal, other), source=joined_sources(own))
        for own, other in seen.items()
        if not (still and other.high == other.low)
    ]


def _probes_of(
    model: AnyModel, effect: Effect, at: tuple[str, ...], own: Sequence[str], signal: SignalScales, other: SignalScales
) -> tuple[Probe, ...]:
    """Return the sizes of an effect with another signal; of a coupling that would be called a droop if negative the others."""
    found = _halved(probes(effect, signal, other))
    if effect.name != "coupling" or not all(droops(model, at, s) for s in own):
        return found
    return tuple(replace(p, free=FrozenMap({n: (0.0, high) for n, (_, high) in p.free.items()})) for p in found)


UNITS = {
    "voltage": ("V", "kV", "MV"), "current": ("A", "kA"), "power": ("W", "kW", "MW", "VA", "kVA", "MVA"),
    "reactive power": ("var", "kvar", "Mvar"), "frequency": ("Hz", "mHz", "rad/s"),
}  # fmt: skip
LETTERS = {"voltage": "VvUE", "current": "Ii", "power": "PS", "reactive power": "Q", "frequency": "fw"}


def quantity(model: AnyModel, place: str) -> str:
    """Return what a signal is, by its unit, or in per unit by the letter that its name begins with; empty where neither says."""
    kind, name = kind_of(model, place), place.removeprefix("outputs.")
    sections: Any = {
        "input": "inputs",
        "output": "outputs",
        "state": "states",
        "signal": "signals",
        "algebraic": "algebraic",
    }
    known = getattr(model, sections[kind], {}).get(name)
    unit = getattr(known, "unit", "")
    by_unit = next((q for q, units in UNITS.items() if unit in units), "")
    return by_unit or next((q for q, letters in LETTERS.items() if name[:1] in letters and name[:1]), "")


def droops(model: AnyModel, at: Sequence[str], source: str) -> bool:
    """Return True where what is taken away in proportion to a signal is called a droop: a power, current or frequency acts on
    another quantity."""
    brought = quantity(model, source)
    return brought not in ("", "voltage") and all(quantity(model, p) != brought for p in at)


def leaks(model: AnyModel, at: Sequence[str], source: str) -> bool:
    """Return True where what is taken away in proportion to a signal is called a conductance: of a voltage, a current or power."""
    return quantity(model, source) == "voltage" and all(quantity(model, p) in ("current", "power", "") for p in at)


def own_sources(at: Sequence[str], brought: Sequence[str], known: Collection[str]) -> list[tuple[str, ...]]:
    """By place what an effect brings in: any signal at one place; at one slot of each of several stations, distinguished by a number
    in its name, the same signal of each station. known: signals there are, of which some are not worth bringing in alone.
    """
    if len(at) == 1:
        return [(s,) for s in brought]
    numbers = [re.findall(r"\d+", p) for p in at]
    alike = len({re.sub(r"\d+", "#", p) for p in at}) == 1
    if not alike or any(len(n) != 1 for n in numbers) or len({n for (n,) in numbers}) < len(at):
        return []
    stations = [n for (n,) in numbers]
    families = {
        tuple(re.sub(r"\d+", n, s) for n in stations): None for s in brought if re.findall(r"\d+", s) in numbers
    }
    return [own for own in families if all(s in known for s in own)]


def proportional(a: Sequence[Array], b: Sequence[Array]) -> bool:
    """Return True where one signal is the other times a number, in all experiments."""
    u, v = np.concatenate(a), np.concatenate(b)
    across = u * float(np.linalg.norm(v)) - float(np.sign(u @ v)) * v * float(np.linalg.norm(u))
    return bool(np.linalg.norm(across) <= MOTIONLESS * max(float(np.linalg.norm(u) * np.linalg.norm(v)), MOTIONLESS))


def additive(effect: Effect) -> bool:
    """Return True where the effect acts on a signal that never moves, too."""
    return effect.name in ("offset", "gain", "disturbance")


def _halved(found: tuple[Probe, ...]) -> tuple[Probe, ...]:
    """Of sizes that differ in sign alone the positive ones: the answer to the others is the same, reversed."""
    kept: list[Probe] = []
    for p in sorted(found, key=lambda p: sum(v < 0.0 for v in p.values.values())):
        mirrored = {n: -v for n, v in p.values.items()}
        if not any(dict(q.values) == mirrored for q in kept):
            kept.append(p)
    return tuple(kept)


def kind_of(model: AnyModel, place: str) -> str:
    """The kind of a slot: input, signal, algebraic, state or output; a closed model has inputs and outputs only.

    Raises UnknownNameError for a place that is no slot.
    """
    if is_white_box(model):
        return insertion_point(model, place)[0]
    if place in model.inputs:
        return "input"
    if place.removeprefix("outputs.") in model.outputs:
        return "output"
    raise unknown_name(
        "insertion point", place, model.insertion_points, where=f"model '{model.name}', which is closed inside"
    )


def _open_to(model: AnyModel, place: str, brought: Sequence[str]) -> set[str]:
    """Signals that an effect at a place may bring in: none that would close a circle. At an end of a closed model signals of its
    own side: an output at an input would close a loop around it, and what comes out does not see what goes in."""
    if is_white_box(model):
        return {*admissible_sources(model, place)} - {place}
    return {s for s in brought if s != place and kind_of(model, s) == kind_of(model, place)}


def _moves(model: AnyModel, place: str) -> bool:
    """Return True where a slot's signal depends on states or inputs; what is made of parameters alone is no signal."""
    kind, name = kind_of(model, place), place
    if kind in ("input", "state", "output", "algebraic") or not is_white_box(model):
        return True
    signals = model.signals
    found = reached([name], lambda n: [s.name for s in signals[n].value.free_symbols] if n in signals else [])
    return any(n not in signals and n not in model.parameters for n in found)


def source_signals(model: AnyModel, signals: Signals) -> tuple[str, ...]:
    """Signals worth bringing in: those that move, of several that move alike the first; inputs, states, then the rest."""
    kinds = {p: kind_of(model, p) for p in signals if _moves(model, p)}
    order = sorted(
        (p for p in kinds if kinds[p] != "output"),
        key=lambda p: ("input", "state", "algebraic", "signal").index(kinds[p]),
    )
    named_out = set(model.outputs)
    order = [p for p in order if kinds[p] in ("input", "state") or p in named_out]
    kept: list[str] = []
    shapes: list[Array] = []
    for p in order:
        whole = np.concatenate([v - v[0] for v in signals[p]])
        size = float(np.linalg.norm(whole))
        if size <= MOTIONLESS * max(1.0, float(np.abs(np.concatenate(signals[p])).max())):
            continue
        shape = whole / size
        if any(np.linalg.norm(shape - np.sign(shape @ s) * s) < EQUAL for s in shapes):
            continue
        kept.append(p)
        shapes.append(shape)
    return tuple(kept)


def places_of(
    model: AnyModel, live: Sequence[str], given: Iterable[str | tuple[str, ...]] | None
) -> tuple[tuple[str, ...], ...]:
    """The places to try: those given, or every slot and every family of slots that are named alike.

    A family: slots of one kind whose names differ in digits, or, those left out, in one letter (Ir1, Ii1, Ir2, Ii2);
    the part of it that belongs to one station, with one digit; and all names of one ending (Vdc1_m, P2_m, Q1_m).
    """
    if given is not None:
        listed = [(g,) if isinstance(g, str) else tuple(g) for g in given]
        for p in {p for at in listed for p in at}:
            kind_of(model, p)
        return tuple(at for at in listed if all(p in live for p in at))
    families = [f for kind in ("input", "signal", "algebraic", "state", "output") for f in _families(model, live, kind)]
    return (*((p,) for p in live), *dict.fromkeys(families))


def _families(model: AnyModel, live: Sequence[str], kind: str) -> list[tuple[str, ...]]:
    names = [p for p in live if kind_of(model, p) == kind]
    # A digit marks one of several stations; "P1" and "Q1" are alike, "x" and "v" are not.
    stems = {p: re.sub(r"\d+", "#", p.removeprefix("outputs.")) for p in names}
    found: list[tuple[str, ...]] = []
    left = list(names)
    while left:
        family = [left.pop(0)]
        for p in family:
            near = [q for q in left if _alike(stems[p], stems[q])]
            family += near
            left = [q for q in left if q not in near]
        ordered = tuple(p for p in names if p in family)
        if len(ordered) > 1:
            found.append(ordered)
        for digits in dict.fromkeys(tuple(re.findall(r"\d+", p)) for p in ordered):
            part = tuple(p for p in ordered if tuple(re.findall(r"\d+", p)) == digits)
            if 1 < len(part) < len(ordered):
                found.append(part)
        for stem in dict.fromkeys(stems[p] for p in ordered):
            part = tuple(p for p in ordered if stems[p] == stem)
            if 1 < len(part) < len(ordered):
                found.append(part)
    endings = {p: p.rpartition("_")[2] for p in names if p.rpartition("_")[0]}
    alike = [tuple(p for p in endings if endings[p] == end) for end in dict.fromkeys(endings.values())]
    return found + [f for f in alike if len(f) > 1]


def _alike(a: str, b: str) -> bool:
    """Return True where two names without their digits differ in one letter at most, and are more than that letter."""
    if len(a) != len(b) or a.isupper() != b.isupper():
        return False
    return sum(x != y for x, y in zip(a, b, strict=True)) <= min(1, len(a) - 1)
