"""What the files of a unit state, in sentences: what its study uses of them, what it does not, and what it has for models it lacks."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from hvdc_ident.errors import nearest
from hvdc_ident.plants import AHEAD, SET_POINTS, STEP_UP, UNCONNECTED, RecordedUnit, idle_parts, shelf_model
from hvdc_ident.psse import Bus, DyrRecord, Generator, RawFile
from hvdc_ident.shelf import components, outputs_of, power_flow_of, record_of, source_of
from hvdc_ident.text import listed, quantity

BUS_TYPES = {
    1: "a load bus (IDE 1) in {}, where PSS/E takes its machines as out of service",
    3: "the swing bus of {} (IDE 3), which is no infinite bus here: its recorded voltage counts",
    4: "disconnected in {} (IDE 4)",
}
"""What is said of a bus that is not one of a generator."""


@dataclass(frozen=True)
class InPowerFlow:
    """A machine in a power flow, with its bus."""

    raw: RawFile
    bus: Bus
    generator: Generator

    @property
    def name(self) -> str:
        """Name of the file."""
        return Path(self.raw.path).name


def unit_notes(
    unit: RecordedUnit,
    records: Sequence[DyrRecord],
    grid: InPowerFlow | None,
    base: float,
    frequency: tuple[float, str],
    asked: Collection[str],
) -> tuple[str, ...]:
    """Return the sentences.

    records: of the machine. base: that counts, MVA. frequency: that counts in Hz, and where it is from. asked: names of the
    parameters that the study asks about.
    """
    return (
        *([] if grid is None else _of_power_flow(unit, grid, base, frequency[0])),
        *([f"{frequency[0]:g} Hz: {frequency[1]}"] if frequency[1] else []),
        *([_of_shelf(unit)] if grid is None and _of_shelf(unit) else []),
        *_unused_values(records),
        *_left_out(unit, asked),
    )


def _of_power_flow(unit: RecordedUnit, grid: InPowerFlow, base: float, frequency: float) -> Iterator[str]:
    """Yield what a power flow states: used, not used, and at odds with what is done here."""
    g, raw = grid.generator, grid.raw
    used = [f"{raw.sbase:g} MVA of the system (SBASE)"]
    unused = [f"PG {g.pg:g} MW, QG {g.qg:g} Mvar, set points and limits (the recordings have their own levels)"]
    for stated, counts, text in (
        (g.mbase, base, f"{g.mbase:g} MVA of the machine (MBASE)"),
        (raw.frequency, frequency, f"{raw.frequency or 0.0:g} Hz (BASFRQ)"),
    ):
        if stated is not None:
            (used if stated == counts else unused).append(
                text + ("" if stated == counts else f": {counts:g} is asked for")
            )
    used += [f"{grid.bus.base_kv:g} kV (BASKV)"] if grid.bus.base_kv > 0.0 else []
    named = set[str]()
    for name, part in unit.parts.items():
        for parameter, field in power_flow_of(part.source).items():
            value = getattr(g, field.lower())
            named.add(field)
            if parameter not in record_of(part.source):
                unit_ = shelf_model(part.source).parameters[parameter].unit
                used.append(f"{name}.{parameter} = {quantity(value, unit_)} ({field})")
            elif value != part.values[parameter]:
                own = (
                    f"{part.source.upper()} has {parameter} {part.values[parameter]:g} itself, and PSS/E wants the same"
                )
                unused.append(f"{field} {value:g} pu ({own})")
    unused += [f"{f} {getattr(g, f.lower()):g} pu" for f in ("ZR", "ZX") if f not in named]
    yield f"{grid.name} states, and is used: {listed(used)}"
    yield f"{grid.name} states, and is not used: {listed(unused)}; loads, lines and transformers"
    where = f"machine {g.id} of bus {g.bus}"
    if STEP_UP in unit.parts:
        yield (
            f"{where} has its step-up transformer in {grid.name} (RT {g.rt:g}, XT {g.xt:g}, GTAP {g.gtap:g}): it lies between machine "
            f"and bus, and V, P and Q are those of bus {g.bus}; where they are recorded at the machine's side, take RT, XT out of a copy"
        )
    elif g.gtap != 1.0:
        yield f"{where} has GTAP {g.gtap:g} in {grid.name}, which is not used: RT and XT are 0"
    if g.stat != 1:
        yield f"{where} is out of service in {grid.name} (STAT {g.stat}, line {g.line}): is it the one that is recorded?"
    if grid.bus.kind in BUS_TYPES:
        yield f"bus {g.bus} is {BUS_TYPES[grid.bus.kind].format(grid.name)}"


def _of_shelf(unit: RecordedUnit) -> str:
    """Return what stands at values of the shelf because only a power flow states it; "" where nothing does."""
    on_shelf = [
        f"{name}.{parameter} = {quantity(p.value, p.unit)} ({field})"
        for name, part in unit.parts.items()
        for parameter, field in power_flow_of(part.source).items()
        if parameter not in record_of(part.source) and (p := shelf_model(part.source).parameters[parameter])
    ]
    if not on_shelf:
        return ""
    return f"no power flow (a .raw file) is given, which has these: {listed(on_shelf)}, as on the shelf"


def _unused_values(records: Sequence[DyrRecord]) -> Iterator[str]:
    """Yield the values of the records that the components do not use, but for zeros, which ask for nothing."""
    unused = [
        f"value {k + 1} of {r.model} ({v:g})" if isinstance(v, float) else f"value {k + 1} of {r.model} ('{v}')"
        for r in records
        if (source := source_of(r.model)) is not None
        for k, (name, v) in enumerate(zip(record_of(source), r.values, strict=True))
        if name == "-" and v is not None and v != 0.0 and v != ""
    ]
    if unused:
        yield f"not used of the records, as a remote bus or branch: {listed(unused)}"


def _left_out(unit: RecordedUnit, asked: Collection[str]) -> Iterator[str]:
    """Yield what becomes of the models that are not on the shelf."""
    open_ = _open(unit)
    missing = _needed(open_)
    for record in unit.unknown:
        near = _near(record, missing.values(), open_.values())
        yield f"{record.model} (line {record.line} of the .dyr) is not on the shelf and is left out{near}"
    if not unit.unknown:
        return
    fixed = list(_without(unit, missing))
    idle = [unit.parts[n].source.upper() for n in idle_parts(unit.parts)]
    lines = [f"no part gives {listed(fixed)}" if fixed else "", f"{listed(idle)} then acts on nothing" if idle else ""]
    lines += [
        f"what the left-out models do is not in the model, and is not fitted; asked about: {listed(list(asked)) or 'nothing'}"
    ]
    yield "; ".join(filter(None, lines))


def _open(unit: RecordedUnit) -> dict[tuple[str, str], str]:
    """Return by part and input the signal that no other part gives, though components of .dyr files do."""
    models = {n: shelf_model(p.source) for n, p in unit.parts.items()}
    signals = {}
    for name, model in models.items():
        others = {o for n, m in models.items() if n != name for o in m.outputs}
        for u in model.inputs:
            signal = AHEAD.get(u, u)
            if signal not in others and _giving([signal]):
                signals[name, u] = signal
    return signals


def _needed(open_: Mapping[tuple[str, str], str]) -> dict[tuple[str, str], str]:
    """Return the signals that a unit does not go without; where there are none, the others, and last the references."""
    no_references = {place: s for place, s in open_.items() if s not in SET_POINTS}
    return {place: s for place, s in no_references.items() if s not in UNCONNECTED} or no_references or dict(open_)


def _without(unit: RecordedUnit, missing: Mapping[tuple[str, str], str]) -> Iterator[str]:
    """Yield each missing signal once, with what it is and where it then stands."""
    places = {signal: place for place, signal in reversed([*missing.items()])}
    for signal, (part, u) in places.items():
        about = shelf_model(unit.parts[part].source).inputs[u].description
        value = UNCONNECTED.get(signal)
        stays = "stays as before the event" if value is None else f"is {value}"
        yield f"{signal} ({about.split(';')[0].split(',')[0]}), which {stays}"


def _giving(signals: Collection[str]) -> list[str]:
    """Return the components of .dyr files that give one of the signals."""
    return [c for c in components() if record_of(c) and not outputs_of(c).isdisjoint(signals)]


def _near(record: DyrRecord, missing: Collection[str], open_: Collection[str]) -> str:
    """Return in words the components that a model may be: by its name, else by its number of values.

    open_: signals that no part gives; missing: those of them that are needed, for which the number of values alone may speak.
    """
    lacking = [c.upper() for c in _giving(missing)]
    number = len(record.values)
    alike = nearest(record.model, [c.upper() for c in _giving(open_)])
    as_long = [c for c in lacking if len(record_of(c.lower())) == number]
    likely = [c for c in alike if c in as_long] or alike or as_long
    if not likely:
        return f"; {listed(lacking)} give what is missing" if lacking else ""
    why = ", by name" if likely[0] in alike else f", with {number} values as well"
    return f"; nearest on the shelf: {listed(likely)}{why}: where it is that model, name it so in a copy of the .dyr"
