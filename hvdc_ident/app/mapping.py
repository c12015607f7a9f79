"""A recording mapped to a model, as values: which column is which signal, in what unit, with event and window.

Everything is asked of the package: its matching of columns proposes, its reader of studies makes the experiment, its `check` judges.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import hvdc_ident as hi
from hvdc_ident.app.study_folder import Seen, write_study
from hvdc_ident.app.study_text import with_experiment
from hvdc_ident.data import Experiment, Trajectory
from hvdc_ident.errors import StudyError
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel
from hvdc_ident.study import schema
from hvdc_ident.study.assemble import study_of
from hvdc_ident.study.column_matching import Kind, Matching
from hvdc_ident.study.new_study import proposal
from hvdc_ident.study.parse import checked
from hvdc_ident.study.recordings import Recordings, read_experiments, with_derived
from hvdc_ident.study.study import with_nuisances
from hvdc_ident.study.summary import Summary
from hvdc_ident.summary.levels import NoiseNote

WRITTEN = ("name", "data", "role", "inputs", "outputs", "columns", "event", "window")
"""Keys of an experiment that a mapping states; all others are kept."""
CONVERSION = ("unit", "base", "scale", "offset", "turn")


@dataclass(frozen=True)
class SignalLine:
    """A signal of the model and the column that holds it.

    model = scale x recorded + offset, or recorded / base + offset; what is None is left to the file's unit. turn: Hz, taken out of an
    angle. why: the column was proposed for it, in words.
    """

    signal: str
    kind: Kind
    column: str
    unit: str | None = None
    base: float | None = None
    scale: float | None = None
    offset: float | None = None
    turn: float | None = None
    why: str = ""

    @property
    def conversion(self) -> dict[str, Any]:
        """Unit, base, scale, offset and turn that are stated, by key."""
        return {k: v for k in CONVERSION if (v := getattr(self, k)) is not None}


@dataclass(frozen=True)
class RecordingMap:
    """One experiment of a study. kept: its other keys, as the file has them. event, window: s; None for what is found."""

    name: str
    data: str
    lines: tuple[SignalLine, ...] = ()
    role: str = "fit"
    event: float | None = None
    window: tuple[float, float] | None = None
    kept: FrozenMap[Any] = field(default_factory=FrozenMap)

    @classmethod
    def of(cls, table: schema.ExperimentTable) -> RecordingMap:
        """Return the mapping that an experiment of a study states."""
        stated = table.model_dump(by_alias=True, exclude_unset=True)
        lines = []
        columns = dict(table.columns)
        sides: tuple[tuple[Kind, Mapping[str, str]], ...] = (("input", table.inputs), ("output", table.outputs))
        for kind, side in sides:
            for signal, column in side.items():
                line = columns.pop(signal, None) or schema.ColumnTable()
                how = {k: getattr(line, k) for k in CONVERSION}
                lines.append(SignalLine(signal, kind, line.name or column, **how))
        kept = {k: v for k, v in stated.items() if k not in WRITTEN}
        if columns:
            kept["columns"] = {n: c.model_dump(by_alias=True, exclude_unset=True) for n, c in columns.items()}
        window = None if table.window is None else (table.window[0], table.window[1])
        return cls(table.name, table.data, tuple(lines), table.role, table.event, window, FrozenMap(kept))

    @property
    def keys(self) -> dict[str, Any]:
        """The keys as the study file has them; None for those that are not stated."""
        sides = {
            f"{kind}s": {line.signal: line.column for line in self.lines if line.kind == kind}
            for kind in ("input", "output")
        }
        own = {line.signal: how for line in self.lines if (how := line.conversion)}
        return {
            "name": self.name,
            "data": self.data,
            "role": self.role if self.role != "fit" else None,
            **sides,
            "columns": {**self.kept.get("columns", {}), **own},
            "phases": self.kept.get("phases"),
            "event": self.event,
            "window": None if self.window is None else list(self.window),
        }

    def table(self, where: str) -> schema.ExperimentTable:
        """Return the checked table of the experiment. Raises StudyError as the reader of studies does."""
        doubled = [s for s in (line.signal for line in self.lines) if [n.signal for n in self.lines].count(s) > 1]
        if doubled:
            columns = " and ".join(repr(line.column) for line in self.lines if line.signal == doubled[0])
            raise StudyError(
                f"two columns for '{doubled[0]}'",
                where=f"{where}, experiment '{self.name}'",
                expected="one",
                got=columns,
            )
        keys = {k: v for k, v in {**self.kept, **self.keys}.items() if v is not None}
        return checked({"schema": 1, "model": {"source": "-"}, "experiment": [keys]}, where).experiment[0]

    def of_column(self, column: str) -> tuple[SignalLine, ...]:
        """Return the lines of a column; it may serve as an input and as an output."""
        return tuple(line for line in self.lines if line.column == column)

    def assigned(self, column: str, signal: str, kind: Kind) -> RecordingMap:
        """Return the mapping in which a column is a signal, which no other column is then; "" for none."""
        others = [n for n in self.lines if n.column != column and (n.signal, n.kind) != (signal, kind)]
        new = [SignalLine(signal, kind, column)] if signal else []
        return replace(self, lines=_ordered([*others, *new]))

    def stated(self, signal: str, key: str, value: Any) -> RecordingMap:
        """Return the mapping with another unit, base, scale or offset of a signal; base and scale exclude each other."""
        other = {"base": {"scale": None}, "scale": {"base": None}}.get(key, {}) if value is not None else {}
        changed: dict[str, Any] = {key: value, **other}
        return replace(self, lines=tuple(replace(n, **changed) if n.signal == signal else n for n in self.lines))


def _ordered(lines: Sequence[SignalLine]) -> tuple[SignalLine, ...]:
    """Return the lines with the inputs first, as a study has them."""
    return tuple(sorted(lines, key=lambda line: line.kind != "input"))


class LoadedRecording(Recordings):
    """A recording as it was read, as the reader of experiments asks for it: a file of a million rows is read once."""

    def __init__(self, record: Trajectory) -> None:
        super().__init__(Path())
        self._record = record

    def load(self, columns: Mapping[str, Mapping[str, Sequence[str]]]) -> None:
        """Raise UnknownNameError for a column that the recording lacks."""
        for wanted in columns.values():
            for names in wanted.values():
                for name in names:
                    self._record[name]

    def __getitem__(self, name: str) -> Trajectory:
        return self._record


@dataclass(frozen=True)
class Draft:
    """A mapping as an experiment, with where its noise comes from and what `check` says of the study."""

    experiment: Experiment
    noise: FrozenMap[NoiseNote]
    summary: Summary


def proposed(record: Trajectory, model: AnyModel, name: str, data: str) -> tuple[RecordingMap, Matching]:
    """Return the mapping that `new` proposes too, with what three phases give, and the matching behind it, with candidates for the rest."""
    suggested = proposal(record, model, name)
    lines = [
        SignalLine(m.target.name, m.target.kind, m.column.name, why=m.reason, **m.line.keys)
        for m in suggested.columns.mapped
    ]
    stated = [line.model_dump(exclude_none=True, exclude_defaults=True) for line in suggested.phases]
    kept = {"phases": stated, "values": dict(suggested.values)}
    return RecordingMap(
        name, data, _ordered(lines), kept=FrozenMap({k: v for k, v in kept.items() if v})
    ), suggested.columns


def columns_with_derived(mapping: RecordingMap, record: Trajectory, where: str) -> Trajectory:
    """Return the recording with the columns that the experiment's phases and phasors give."""
    if not mapping.kept.get("phases") and not mapping.kept.get("phasors"):
        return record
    table = mapping.table(where)
    return with_derived(table.phases, table.phasors, record, where)


def experiment_of(
    mapping: RecordingMap, record: Trajectory, model: AnyModel, where: str
) -> tuple[Experiment, FrozenMap[NoiseNote]]:
    """Return the experiment and where its noise comes from. Raises InputError as `hi.load_study` does."""
    (experiment,), notes = read_experiments([mapping.table(where)], model, LoadedRecording(record), where)
    return experiment, notes[experiment.name]


def drafted(
    mapping: RecordingMap, record: Trajectory, model: AnyModel, study: hi.Study | None, was: str, where: str
) -> Draft:
    """Return what a mapping makes of the study, unwritten, in place of the experiment called `was`, or beside the others.

    Raises InputError or ComputationError as `hi.check` does.
    """
    experiment, noise = experiment_of(mapping, record, model, where)
    base = study or replace(study_of(model), path=Path(where))
    before = [e for e in base.experiments if e.name not in (was, experiment.name)]
    (experiment,) = with_nuisances(base.settings, base.model, [experiment], tuple(base.candidates), where)
    notes = {n: v for n, v in base.noise.items() if n in {e.name for e in before}}
    whole = replace(base, experiments=(*before, experiment), noise=FrozenMap({**notes, experiment.name: noise}))
    return Draft(experiment, noise, hi.check(whole))


def write_mapping(seen: Seen, mapping: RecordingMap, was: str, source: str, *, trust: bool = False) -> Seen:
    """Write a mapping into the study file that was seen, in place of the experiment called `was`, and return the file.

    source: of the model, where the study is new: a shipped name or a path. The new file is what `hvdc-ident new` writes, with the
    mapping in place of its proposal. Raises StudyError where the file was changed since, and InputError as `hi.new_study` does.
    """
    table = mapping.table(seen.path.name)
    if not table.outputs:
        raise StudyError("no output is assigned", where=seen.path.name, expected="at least one recorded output")
    if seen.text is None:
        new = hi.new_study(seen.path.parent, (seen.path.parent / mapping.data).resolve(), source, trust=trust)
        seen, was = Seen.now(new.path), new.recordings[0].name
    text = with_experiment(seen.text or "", was, mapping.keys, seen.path.name)
    return write_study(seen, text)


def experiments_in(settings: schema.StudyFile) -> dict[str, RecordingMap]:
    """Return the mappings of a study by the names of its experiments."""
    return {t.name: RecordingMap.of(t) for t in settings.experiment}
