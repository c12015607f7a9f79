"""Units of .dyr files: the records of one machine as the parts of a unit, and a unit's values back in its records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from hvdc_ident.errors import ModelError
from hvdc_ident.model import shelf_model
from hvdc_ident.next_step import NextStep
from hvdc_ident.plants.unit import STEP_UP, UnitPart, part_name, parts_of
from hvdc_ident.psse import DyrFile, DyrRecord, Generator
from hvdc_ident.shelf import components, outputs_of, power_flow_of, record_of, source_of
from hvdc_ident.text import listed


@dataclass(frozen=True)
class RecordedUnit:
    """A unit as a .dyr file and a power flow state it. parts: by name; unknown: records of models that are not on the shelf."""

    parts: Mapping[str, UnitPart]
    unknown: tuple[DyrRecord, ...]


def machine_records(file: DyrFile, bus: int, machine: str | None) -> tuple[DyrRecord, ...]:
    """Return the records of one machine at a bus. Raises ModelError where there is none, or several and none is named."""
    records = file.at(bus, machine)
    machines = list(dict.fromkeys(r.machine for r in records))
    if len(machines) > 1:
        raise ModelError(
            f"bus {bus} has several machines",
            where=file.path,
            expected=f"one of {listed(machines)}",
            next=(NextStep("option", f"machine = {machines[0]}", "takes one of them"),),
        )
    return records


def recorded_unit(
    file: DyrFile,
    records: Sequence[DyrRecord],
    base: float,
    generator: Generator | None = None,
    system_base: float = 100.0,
) -> RecordedUnit:
    """Return the unit of a machine's records in a file, with what the power flow states of it.

    base: of the machine, system_base: of the power flow, MVA. generator: the machine in the power flow, whose source impedance (ZR, ZX)
    the components take that name it, and whose step-up transformer (RT, XT, GTAP), where it has one, lies between machine and bus.
    Raises ModelError, with file and line, where no record is that of a machine or converter on the shelf, where two are those of one
    part, and where a record has another number of values or one that is no number.
    """
    known = [r for r in records if source_of(r.model) is not None]
    unknown = tuple(r for r in records if source_of(r.model) is None)
    parts: dict[str, UnitPart] = {}
    lines: dict[str, DyrRecord] = {}
    for record in known:
        for name, part in parts_of({record.model: _numbers(file, record)}).items():
            if name in lines:
                raise ModelError(
                    f"two records of one part: {lines[name].model} and {record.model} are both '{name}' of the unit",
                    where=f"{file.path}:{record.line}",
                    expected=f"one beside that of line {lines[name].line}",
                    hint="make one of them a comment, with // before it on each of its lines",
                )
            parts[name], lines[name] = part, record
    if not any("Ir" in outputs_of(p.source) for p in parts.values()):
        machines = [c.upper() for c in components() if record_of(c) and "Ir" in outputs_of(c)]
        raise ModelError(
            "no record of a machine or converter that is on the shelf",
            where=f"{file.path}:{records[0].line}",
            expected=f"one of {listed(machines)}",
            got=listed([r.model for r in records]),
            hint=f"name the record that of the nearest of them, {listed(machines)}, in a copy of the file",
        )
    stated = {n: _with_bases(p, base, system_base, generator) for n, p in parts.items()}
    return RecordedUnit(stated | _step_up(base, system_base, generator), unknown)


def _numbers(file: DyrFile, record: DyrRecord) -> list[float]:
    """Return the values of a record by the place; 0 for those that its component does not use.

    Raises ModelError where there are more or fewer than the component's record has, or one that it uses is no number.
    """
    names = record_of(source_of(record.model) or "")
    where, values = f"{file.path}:{record.line}", record.values
    if len(values) != len(names):
        pairs = [f"{n} {_shown(v)}" for n, v in zip(names, values, strict=False) if n != "-"]
        more = [_shown(v) for v in values[len(names) :]]
        missing = [n for n in names[len(values) :] if n != "-"]
        rest = f", and then {', '.join(more)}" if more else f", and no {', '.join(missing)}" if missing else ""
        raise ModelError(
            f"the record of {record.model} has {len(values)} values",
            where=where,
            expected=f"{len(names)}: {', '.join(names)}",
            got=", ".join(pairs) + rest,
            hint=_decimal_comma(file, record, len(names)),
        )
    for name, value in zip(names, values, strict=True):
        if name != "-" and not isinstance(value, float):
            raise ModelError(
                f"{name} of {record.model} has no number",
                where=where,
                expected="a number, for dynamic data have no defaults",
                got=_shown(value),
            )
    return [v if isinstance(v, float) else 0.0 for v in values]


def _shown(value: float | str | None) -> str:
    return "nothing between two commas" if value is None else f"'{value}'" if isinstance(value, str) else f"{value:g}"


def _decimal_comma(file: DyrFile, record: DyrRecord, number: int) -> str:
    """Return the hint that numbers are written with a comma, where as many values are too many as commas join two whole numbers."""
    ends = list(zip(record.spans, record.spans[1:], strict=False))
    joined = [
        file.content[a[0] : b[1]].decode("latin-1")
        for a, b in ends
        if file.content[a[1] : b[0]] == b"," and file.content[b[0] : b[1]].isdigit()
    ]
    if len(joined) != len(record.values) - number or not joined:
        return ""
    return "decimal points: " + ", ".join(f"{text.replace(',', '.')} for {text}" for text in joined)


def _with_bases(part: UnitPart, base: float, system_base: float, generator: Generator | None) -> UnitPart:
    """Return a part with its bases and with what the power flow states of it and its own record does not."""
    model = shelf_model(part.source)
    bases = {n: v for n, v in (("Sn", base), ("Sb", system_base)) if n in model.parameters}
    fields = {} if generator is None else power_flow_of(part.source)
    stated = {n: float(getattr(generator, f.lower())) for n, f in fields.items() if n not in record_of(part.source)}
    return replace(part, values={**part.values, **stated, **bases})


def _step_up(base: float, system_base: float, generator: Generator | None) -> dict[str, UnitPart]:
    """Return the step-up transformer that the power flow has as part of the machine; none where its impedance is 0."""
    if generator is None or generator.rt == generator.xt == 0.0:
        return {}
    # PSS/E's ratio is that of the bus's winding, its impedance on the machine's side; the component's stand the other way round.
    ratio = generator.gtap
    impedance = {"R": generator.rt * ratio**2, "X": generator.xt * ratio**2}
    return {STEP_UP: UnitPart("transformer", {**impedance, "tap": 1.0 / ratio, "Sn": base, "Sb": system_base})}


def with_unit_values(
    file: DyrFile, records: Sequence[DyrRecord], values: Mapping[str, float]
) -> tuple[DyrFile, tuple[str, ...]]:
    """Return the file with a unit's values in its records, and the names that no record has.

    values: by name in the plant (gen.H); only what differs from the record is written, to the byte.
    """
    left = dict(values)
    for record in records:
        source = source_of(record.model)
        if source is None:
            continue
        name = part_name(source)
        changed: dict[int, float] = {}
        for k, parameter in enumerate(record_of(source)):
            value = left.pop(f"{name}.{parameter}", None)
            if value is not None and value != record.values[k]:
                changed[k] = float(f"{value:.7g}")  # PSS/E's numbers are of single precision
        if changed:
            file = file.with_values(record, changed)
    return file, tuple(left)
