"""Which column of a recording is which signal of a model: by name, else by unit and level before the event.

A name matches exactly, or but for case and punctuation, or where both names say one quantity (`data.quantities`), each the only one:
`EASTFIELD12 V1 Mag` is V. A column is never taken for a signal of another quantity. What is left is compared by unit and level, and
only where a signal and a column are each other's only candidates is one mapped for that reason, which is told: many signals of a
per-unit model rest at 1 or at 0, so a level alone is no evidence, and a wrong column gives a wrong fit without a word. All else is
proposed.
A column whose unit can be converted only with a rated base is proposed with the base that the levels suggest, and not mapped.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from hvdc_ident.data import FEWEST_QUIET, Array, Trajectory, before_event, conversion, noise_estimate
from hvdc_ident.data.quantities import Quantity, Reading, compatible, read_columns
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel
from hvdc_ident.parameters import Parameter
from hvdc_ident.plants import LEVELS
from hvdc_ident.study.conversions import Evidence, scale_between, suggest_conversion
from hvdc_ident.text import quantity

Kind = Literal["input", "output"]
AT_TERMINALS: tuple[Quantity, ...] = ("voltage", "angle", "frequency", "active power", "reactive power")
"""Quantities that a name alone tells."""
SHOWN = 3
"""Signals that are proposed for one column, those of the nearest level."""
NEAR = math.sqrt(2.0)
"""Largest factor between two levels of one quantity: the smallest between two ways of counting it, peak and rms."""
CERTAIN = 3.0
"""Standard deviations of the noise within which two levels are the same."""


@dataclass(frozen=True)
class Target:
    """A signal of the model that a column may be: its unit, and its level before the event, None where it is not known."""

    name: str
    kind: Kind
    unit: str
    level: float | None

    @property
    def reading(self) -> Reading:
        """The signal as its name and unit say it."""
        return read_columns((self.name,), (self.unit,))[0]


@dataclass(frozen=True)
class Column:
    """A column of a recording: its unit, its level before the event and the noise about it, in that unit.

    quiet: whether the level is a mean of rows before an event, not the first row. counted: in
    which of several ways it is counted, as a peak or rms, in words; "" where there is only one. reading: as its name and unit say it.
    """

    name: str
    unit: str
    level: float | None
    noise: float
    quiet: bool = True
    counted: str = ""
    reading: Reading = field(default_factory=Reading)

    @property
    def stem(self) -> str:
        """The name without its unit, as in `P_MW`."""
        return self.name.removesuffix(f"_{self.unit}") if self.unit else self.name

    @property
    def place(self) -> str:
        """Where the level is read, in words."""
        return "before the event" if self.quiet else "in the first row"

    def converted(self, unit: str) -> tuple[float, float] | None:
        """Return scale and offset to another unit, None where there is no conversion; the same where a unit is not stated."""
        return conversion(self.unit, unit) if self.unit and unit else (1.0, 0.0)


@dataclass(frozen=True)
class ColumnLine:
    """How the values of a column become the model's: keys of a line of the study's `columns`, None for what is not stated."""

    unit: str | None = None
    base: float | None = None
    scale: float | None = None
    offset: float | None = None
    turn: float | None = None

    @property
    def keys(self) -> dict[str, Any]:
        """The keys that are stated, with their values."""
        return {k: v for k, v in vars(self).items() if v is not None}


@dataclass(frozen=True)
class Match:
    """A column that is taken for a signal, or may be: the reason in words. base: rated base to be stated, in the column's unit.

    line: what gives the model's unit, beside what the file states. is_open: no unit or base is known that the values allow.
    """

    target: Target
    column: Column
    reason: str
    base: float | None = None
    line: ColumnLine = field(default_factory=ColumnLine)
    is_open: bool = False

    @property
    def by(self) -> tuple[float, float] | None:
        """Scale and offset to the model's unit; None where a base is needed and none is stated."""
        line, offset = self.line, self.line.offset or 0.0
        if line.scale is not None or line.base is not None:
            return line.scale if line.scale is not None else 1.0 / (line.base or 1.0), offset
        column = replace(self.column, unit=line.unit or self.column.unit)
        by = column.converted(self.target.unit)
        return None if by is None else (by[0], by[1] + offset)


@dataclass(frozen=True)
class Matching:
    """The columns of a recording by signal. mapped: what is used. proposed: candidates for other signals, the nearest first.

    unused: names of columns that are neither. missing: signals for which there is not even a candidate.
    """

    mapped: tuple[Match, ...]
    proposed: tuple[Match, ...]
    unused: tuple[str, ...]
    missing: tuple[Target, ...]


def columns_of(record: Trajectory, event: float | None, counted: Mapping[str, str] = FrozenMap()) -> tuple[Column, ...]:
    """Return the columns of a recording that hold numbers. event: s; without one the first row tells the level. counted: by name."""
    columns = []
    readings = read_columns(record.names, record.units)
    for name, unit, reading in zip(record.names, record.units, readings, strict=True):
        values = record[name]
        if not np.isnan(values).all():
            level, noise, quiet = _rest(record.time, values, event)
            columns.append(Column(name, unit, level, noise, quiet, counted.get(name, ""), reading))
    return tuple(columns)


def targets_of(model: AnyModel, levels: Mapping[str, float]) -> tuple[Target, ...]:
    """Return the inputs and outputs of a model. levels: before the event, by name, as far as they are known."""
    inputs = [Target(n, "input", i.unit, levels.get(n, i.value)) for n, i in model.inputs.items()]
    return (*inputs, *(Target(n, "output", o.unit, levels.get(n)) for n, o in model.outputs.items()))


def match_names(columns: Sequence[Column], targets: Sequence[Target], place: str = "") -> dict[str, Match]:
    """Return by signal the column of its name, exactly, else but for case and punctuation where only one has it, else the only one whose
    name says the same quantity. place: where the signals are, which tells columns of several places apart.

    Where the units need a base there is a match too: `usable` tells.
    """
    matches: dict[str, Match] = {}
    by_name = {c.name: c for c in columns}
    for target in targets:
        if target.name in by_name:
            matches[target.name] = Match(target, by_name[target.name], "the same name")
    taken = {m.column.name for m in matches.values()}
    for target in (t for t in targets if t.name not in matches):
        alike = [c for c in columns if c.name not in taken and _bare(target.name) in (_bare(c.name), _bare(c.stem))]
        others = [t for t in targets if t.name not in matches and _bare(t.name) == _bare(target.name)]
        if len(alike) == 1 and len(others) == 1:
            matches[target.name] = Match(target, alike[0], "the same name but for case and punctuation")
    for target in (t for t in targets if t.name not in matches and t.name not in LEVELS):
        said = target.reading.measured if not target.reading.place else ""
        taken = {m.column.name for m in matches.values()}
        alike = [c for c in columns if c.reading.measured == said and not c.counted]
        here = [c for c in alike if _bare(place) and _bare(place) in _bare(c.name)]
        alike = here if len(here) == 1 else alike
        if said in AT_TERMINALS and len(alike) == 1 and alike[0].name not in taken:
            matches[target.name] = Match(target, alike[0], f"its name says {_article(said)}")
    return matches


def matching(
    columns: Sequence[Column],
    targets: Sequence[Target],
    parameters: Mapping[str, Parameter] = FrozenMap(),
    named: Mapping[str, Match] | None = None,
) -> Matching:
    """Return the columns by signal. The targets' levels are those of the model at the inputs that names map.

    parameters: of the model, among which rated bases are. named: by names, as far as that is decided already.
    """
    by_names = match_names(columns, targets) if named is None else named
    named = {n: m for n, m in by_names.items() if not is_ambiguous(m)}
    mapped = [_questioned(m) for m in named.values() if usable(m)]
    proposed = [_with_base(m, parameters) for m in named.values() if not usable(m)]
    taken = {m.column.name for m in named.values()}
    free = [c for c in columns if c.name not in taken]
    pairs = {c.name: [m for t in targets if t.name not in named and (m := _candidate(t, c))] for c in free}
    wanted = [m.target.name for matches in pairs.values() for m in matches]
    for matches in pairs.values():
        only = len(matches) == 1 and not matches[0].column.counted and wanted.count(matches[0].target.name) == 1
        sure = only and not (matches[0].target.reading.measured and not matches[0].column.reading.measured)
        if sure and matches[0].column.unit and matches[0].target.unit and _is_near(matches[0]):
            mapped.append(matches[0])
        else:
            proposed += [_questioned(m) for m in sorted(matches, key=_far)[:SHOWN]]
    named_columns = {m.column.name for m in (*mapped, *proposed)}
    known = {m.target.name for m in (*mapped, *proposed)}
    return Matching(
        tuple(mapped),
        tuple(proposed),
        tuple(c.name for c in columns if c.name not in named_columns),
        tuple(t for t in targets if t.name not in known),
    )


def usable(match: Match) -> bool:
    """Return whether a column can be used as it is: its unit converts to the signal's."""
    return match.by is not None and not match.is_open


def is_ambiguous(match: Match) -> bool:
    """Return whether a name says nothing: of a column that is counted in one of several ways, in a unit that converts."""
    return bool(match.column.counted) and match.column.converted(match.target.unit) is not None


def _article(said: str) -> str:
    return f"an {said}" if said[0] in "aeiou" else f"a {said}"


def _bare(name: str) -> str:
    return re.sub(r"[\W_]+", "", name.casefold())


def _rest(time: Array, values: Array, event: float | None) -> tuple[float | None, float, bool]:
    """The mean before the event, the noise about it, and True; without quiet rows the first value, no noise, and False."""
    known = np.isfinite(values)
    before = before_event(time, values, event)
    if int(before.sum()) < FEWEST_QUIET:
        return (float(values[known][0]) if known.any() else None), 0.0, False
    return float(values[before].mean()), noise_estimate(time[known], values[known], event).std, True


def _candidate(target: Target, column: Column) -> Match | None:
    """A column that may be a signal: of a unit that converts to the signal's, or of no stated unit and at the signal's level."""
    by = column.converted(target.unit)
    if by is None or target.name in LEVELS:
        return None
    if not compatible(target.reading.quantity, column.reading.quantity):
        return None
    stated = bool(column.unit and target.unit)
    reason = f"its unit {column.unit}" if stated else "its level, for no unit is stated"
    if stated and column.unit != target.unit:
        reason += f", converted to {target.unit}"
    if column.counted:
        reason += f"; it is the {column.counted}"
    match = Match(target, column, reason)
    match = replace(match, reason=f"{reason}{_levels(match)}")
    return match if stated or _is_near(match) else None


def _evidence(match: Match) -> Evidence | None:
    """Return the recorded level against the model's, in the model's unit; None where one is not known."""
    by = match.by
    if by is None or match.column.level is None or match.target.level is None:
        return None
    return Evidence(by[0] * match.column.level + by[1], (match.target.level,), abs(by[0]) * match.column.noise)


def _is_near(match: Match) -> bool:
    """Return whether both levels are known and those of one quantity: within the noise, or by less than a way of counting."""
    evidence = _evidence(match)
    if evidence is None or evidence.recorded is None:
        return False
    same = abs(evidence.recorded - evidence.levels[0]) <= CERTAIN * evidence.error
    return same or evidence.level_mismatch() < math.log(NEAR)


def _far(match: Match) -> float:
    """Return the difference of the levels over the larger one; infinite where one is not known."""
    evidence = _evidence(match)
    if evidence is None or evidence.recorded is None:
        return math.inf
    size = max(abs(evidence.recorded), abs(evidence.levels[0]))
    return abs(evidence.recorded - evidence.levels[0]) / size if size else 0.0


def _questioned(match: Match) -> Match:
    """Return a match with the conversion that its levels suggest where they are far apart."""
    evidence = _evidence(match)
    suggested = (
        suggest_conversion([evidence], match.target.unit) if evidence is not None and not _is_near(match) else None
    )
    if evidence is None or suggested is None:
        return match
    return replace(match, reason=f"{match.reason}{_levels(match)}: {suggested.reason}")


def _levels(match: Match) -> str:
    """The levels of column and model, in words; "" where one is not known, or the reason has them."""
    evidence = _evidence(match)
    if evidence is None or evidence.recorded is None or "; it reads " in match.reason:
        return ""
    unit = match.target.unit
    return f"; it reads {quantity(evidence.recorded, unit)} {match.column.place}, the model is at {quantity(evidence.levels[0], unit)}"


def _base_meant(match: Match, parameters: Mapping[str, Parameter]) -> tuple[float, str] | None:
    """The base in the column's unit that the level tells by one of the model's bases, and how, in words; None where it fits none."""
    column, target = match.column, match.target
    for name, p in parameters.items():
        scale = scale_between(column.unit, p.unit)
        if scale is None or column.level is None or target.level is None:
            continue
        evidence = Evidence(scale * column.level, (target.level,), scale * column.noise)
        suggestion = suggest_conversion([evidence], target.unit, {name: p})
        if suggestion is not None and f"of the base {name} =" in suggestion.conversion.name:
            return float(f"{suggestion.conversion.factor / scale:.6g}"), suggestion.reason
    return None


def _with_base(match: Match, parameters: Mapping[str, Parameter]) -> Match:
    """Return a match of names that cannot be used, with the reason, and the base that its levels suggest."""
    column, target = match.column, match.target
    if match.is_open:
        return match
    reason = f"{match.reason}, but in {column.unit}, which converts to {target.unit} only with a rated base"
    if column.level is None or not target.level or column.level * target.level <= 0.0:
        return replace(match, reason=reason)
    base = float(f"{column.level / target.level:.3g}")
    levels = f"{quantity(column.level, column.unit)} {column.place}, {quantity(target.level, target.unit)} in the model"
    if (meant := _base_meant(match, parameters)) is not None:
        base, why = meant
        levels = f"{levels}, {why}"
    return replace(match, reason=f"{reason}: {levels}", base=base)
