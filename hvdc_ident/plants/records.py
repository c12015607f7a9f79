"""Units of .dyr files: the records of one machine as the parts of a unit, and a unit's values back in its records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from hvdc_ident.errors import ModelError
from hvdc_ident.next_step import NextStep
from hvdc_ident.plants.unit import UnitPart, part_name, parts_of, shelf_model
from hvdc_ident.psse import DyrFile, DyrRecord
from hvdc_ident.shelf import components, record_of, source_of
from hvdc_ident.text import listed


@dataclass(frozen=True)
class RecordedUnit:
    """A unit as a .dyr file states it. parts: by name; unknown: names of models that are not on the shelf."""

    parts: Mapping[str, UnitPart]
    unknown: tuple[str, ...]


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


def recorded_unit(records: Sequence[DyrRecord], base: float) -> RecordedUnit:
    """Return the unit of a machine's records. base: MVA of the machine.

    Raises ModelError where no record is that of a machine or converter on the shelf, or a record has another number of values.
    """
    known = {r.model: _numbers(r) for r in records if source_of(r.model) is not None}
    unknown = tuple(r.model for r in records if r.model not in known)
    if not known:
        raise ModelError(
            "none of the machine's models is on the shelf",
            expected=f"one of {listed([c.upper() for c in components() if record_of(c)])}",
            got=listed(list(unknown)) or "no record",
        )
    parts = parts_of(known)
    return RecordedUnit({n: _on_base(p, base) for n, p in parts.items()}, unknown)


def _numbers(record: DyrRecord) -> list[float]:
    bad = [v for v in record.values if not isinstance(v, float)]
    if bad:
        raise ModelError(
            f"a value of {record.model} is no number", where=f"line {record.line}", expected="numbers", got=repr(bad[0])
        )
    return [v for v in record.values if isinstance(v, float)]


def _on_base(part: UnitPart, base: float) -> UnitPart:
    has_base = "Sn" in shelf_model(part.source).parameters
    return replace(part, values={**part.values, "Sn": base}) if has_base else part


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
