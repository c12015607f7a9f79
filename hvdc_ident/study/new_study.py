"""A study from recordings and a model: columns mapped to signals, and what could not be mapped said with its candidates."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from hvdc_ident.data import (
    Array,
    Experiment,
    InputSignal,
    Trajectory,
    event_time,
    input_signal,
    scaled,
    without_bad_rows,
)
from hvdc_ident.data.three_phase import PHASE_QUANTITIES
from hvdc_ident.display import Shown
from hvdc_ident.errors import ComputationError, InputError, in_python, located
from hvdc_ident.files import write_text
from hvdc_ident.formats import read_waveforms
from hvdc_ident.model import AnyModel
from hvdc_ident.model.card import toml_key, toml_string
from hvdc_ident.models import is_shipped, load_model
from hvdc_ident.next_step import Door, NextStep, next_phrase
from hvdc_ident.plants import LEVELS
from hvdc_ident.study import schema
from hvdc_ident.study.column_matching import (
    Match,
    Matching,
    Target,
    columns_of,
    is_ambiguous,
    match_names,
    matching,
    targets_of,
    usable,
)
from hvdc_ident.study.json_schema import SCHEMA_LINE, write_schemas
from hvdc_ident.study.left_out import leave_out_line, spans_of
from hvdc_ident.study.phase_columns import of_use, phases_text, proposed_phases, ways_to_count, without_phases
from hvdc_ident.study.recordings import Recordings, level_before, read_experiments, smoothed, with_derived
from hvdc_ident.study.terminal_columns import Settled, Terminals, settled, steadied, terminals_of, unit_of_match
from hvdc_ident.summary.levels import NoiseNote
from hvdc_ident.text import listed, quantity

MOST_LISTED = 40
"""Parameters and columns that a comment lists."""
COLUMNS_SHOWN = 8
"""Columns that are not mapped, with their candidates, on the screen; the study has all of them."""


@dataclass(frozen=True)
class DyrOfStudy:
    """Where a study's unit comes from: a .dyr file, the bus and the machine; unknown: models of its that the unit lacks.

    candidates: parameters that are asked about first, with their bounds; offered: gains and time constants beside them. places:
    patterns of insertion points that are tried. bus_kv, mva, frequency (Hz): bases of the recorded voltage and of the machine, None
    where no file states them. notes: what the files state, used and not used, in sentences.
    """

    file: Path
    bus: int
    machine: str
    unknown: tuple[str, ...] = ()
    candidates: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    offered: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    places: tuple[str, ...] = ()
    bus_kv: float | None = None
    mva: float | None = None
    frequency: float | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Mapped:
    """One recording of a new study: its experiment's name, its file, its columns, and what was found in it as `check` finds it.

    levels: why the model's levels are not known; empty where they are. experiment: None where no output is mapped. phases: what
    columns made of three phases are made of. values: inputs constant at other than the model's value. notes: what was decided between
    columns. measured: inputs that move from row to row, as nobody sets them. leave_out: spans in s by input in which it is not recorded.
    """

    name: str
    source: Path
    data: str
    columns: Matching
    levels: str
    experiment: Experiment | None
    noise: Mapping[str, NoiseNote]
    phases: tuple[schema.PhasesTable, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    measured: tuple[str, ...] = ()
    leave_out: Mapping[str, list[tuple[float, float]]] = field(default_factory=dict)


@dataclass(frozen=True)
class Proposal:
    """A proposal of the signals of a model that a recording has.

    levels: why the model's are not known, "" where they are. Others as those of `Mapped`.
    """

    columns: Matching
    levels: str = ""
    phases: tuple[schema.PhasesTable, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, repr=False)
class NewStudy(Shown):
    """A study that was written. path: its file. model: of the study. recordings: one for each experiment. dyr: where its unit is from.

    door: where its screen is read.
    """

    path: Path
    model: AnyModel
    recordings: tuple[Mapped, ...]
    dyr: DyrOfStudy | None = None
    door: Door = "python"

    def to_dict(self) -> dict[str, Any]:
        """Return by experiment which column is which signal, the candidates of the others, and what is not used."""
        experiments = {}
        for r in self.recordings:
            e = r.experiment
            experiments[r.name] = {
                "data": r.data,
                "mapped": {m.target.name: _about(m) for m in r.columns.mapped},
                "proposed": [{"signal": m.target.name, **_about(m), "base": m.base} for m in r.columns.proposed],
                "missing": [t.name for t in r.columns.missing],
                "unused": list(r.columns.unused),
                "phases": [line.model_dump(exclude_none=True, exclude_defaults=True) for line in r.phases],
                "event": e.event if e else None,
                "noise": {o: n.std for o, n in r.noise.items()},
            }
        fields = {"schema": 1, "study": self.path.as_posix(), "model": self.model.name, "experiments": experiments}
        if self.dyr is None:
            return fields
        bases = {"bus_kv": self.dyr.bus_kv, "mva": self.dyr.mva, "frequency": self.dyr.frequency}
        return fields | {"unknown_models": list(self.dyr.unknown), "bases": bases, "notes": list(self.dyr.notes)}

    def _screen(self) -> Iterator[str]:
        number = len(self.recordings)
        yield f"{self.path} is written: model {self.model.name}, {number} experiment{'s' if number > 1 else ''}"
        if self.dyr is not None and self.dyr.notes:
            yield "\n".join(self.dyr.notes)
        for r in self.recordings:
            yield _found(r)
            used = [
                f"{m.target.kind} {m.target.name} = column {m.column.name}: {_unit_words(m)}" for m in r.columns.mapped
            ]
            yield "\n".join([*used, *_open_lines(r)])
        proposed = any(r.columns.proposed for r in self.recordings)
        first = f"take out the # before the candidates that are right in {self.path}, then " if proposed else ""
        yield f"Next: {first}{next_phrase(NextStep('check', str(self.path)), self.door)}."


@in_python
def new_study(
    folder: str | Path,
    recordings: str | Path | Sequence[str | Path],
    model: str | Path,
    *,
    trust: bool = False,
    limits: Mapping[str, float] | None = None,
    dyr: DyrOfStudy | None = None,
    terminals: Terminals | None = None,
) -> NewStudy:
    """Write a study of recordings and a model into a folder, and return what was mapped and what was not.

    Columns are mapped to inputs and outputs by name, exactly or but for case and punctuation, or as recorders name the quantity; units
    are converted. Where a signal and a column are each other's only candidates by unit, and the levels before the event agree, they are
    mapped too. Everything else is a comment in the study with its candidates.

    Parameters
    ----------
    folder : str or Path
        Where `study.toml` is written. The study refers to the files where they are.
    recordings : str, Path or list of these
        Files of any known waveform format, one experiment each.
    model : str or Path
        A shipped name, or the path of a card, an FMU or a Python file.
    trust : bool, default False
        Whether a model that is Python code may be run.
    limits : dict of float, default None
        Of an FMU's process: deadline and load in s, memory in MiB.
    dyr : DyrOfStudy, default None
        Where a unit of a .dyr file is from: the file, the bus, the machine, and what is asked about first.
    terminals : Terminals, default None
        What the unit's files state of its terminals: nominal frequency in Hz, bases in MVA and kV, P and Q in MW and Mvar. None: what the
        model's card states.

    Returns
    -------
    NewStudy
        `path`, the study's file; `recordings`, for each experiment the columns that are mapped, proposed, missing and unused.

    Raises
    ------
    InputError
        The folder holds a study, there is no recording, or a file or the model cannot be used.

    Examples
    --------
    >>> import tempfile, numpy as np, hvdc_ident as hi
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     data = Path(folder, "step.csv")
    ...     _ = data.write_text("time [s],PREF_2 [pu],P2 [pu],spare [kV]\\n0,0.4,0.4,1\\n0.1,0.5,0.42,1\\n0.2,0.5,0.45,1\\n")
    ...     new = hi.new_study(Path(folder, "study"), data, "vsc-hvdc-link")
    ...     study = hi.load_study(new.path)
    >>> [(m.target.name, m.column.name) for m in new.recordings[0].columns.mapped], study.experiments[0].outputs
    ([('P2', 'P2'), ('Pref2', 'PREF_2')], ('P2',))
    """
    path = Path(folder) / "study.toml"
    if path.exists():
        raise InputError("the folder already holds a study", where=str(path), hint="a new folder")
    files = [Path(recordings)] if isinstance(recordings, str | Path) else [Path(r) for r in recordings]
    if not files:
        raise InputError("no recording", where=str(folder), expected="at least one file of waveforms")
    with located("model"):
        plant = load_model(model, trust=trust, limits=dict(limits) if limits else None)
    names = _names(files)
    about = terminals or terminals_of(plant)
    mapped = tuple(_mapped(path.parent, file, name, plant, about) for file, name in zip(files, names, strict=True))
    source = str(model) if is_shipped(str(model)) else _relative(Path(model), path.parent)
    write_schemas(path.parent)
    write_text(path, "\n".join(_study_text(path, source, plant, mapped, dyr)) + "\n")
    return NewStudy(path, plant, mapped, dyr)


def proposal(record: Trajectory, model: AnyModel, name: str, about: Terminals | None = None) -> Proposal:
    """Return what a recording may be of a model: the columns by signal, those among them that are made of three phases, and of which.

    name: of the experiment. about: what files state of the plant's terminals, where the model is played back; left out, its card.
    """
    phases = proposed_phases(record)
    made = without_phases(with_derived(phases, (), record, name), phases)
    made = without_bad_rows(made, [n for n in made.names if n in record])
    proposed = _matched(made, model, phases, about or terminals_of(model))
    phases = of_use(phases, [m.column.name for m in (*proposed.columns.mapped, *proposed.columns.proposed)])
    unused = tuple(c for c in proposed.columns.unused if c in record)
    return replace(proposed, columns=replace(proposed.columns, unused=unused), phases=phases)


def _matched(
    record: Trajectory, model: AnyModel, phases: Sequence[schema.PhasesTable], about: Terminals | None
) -> Proposal:
    """Return the columns of a recording by signal of a model. Levels are those before the event that mapped inputs show."""
    ways = ways_to_count(phases)
    targets = targets_of(model, {})
    named = match_names(columns_of(record, None, ways), targets, about.bus if about else "")
    moved = [m for m in named.values() if m.target.kind == "input"]  # in whatever unit
    event = _event(record, moved, smoothed(phases), played=about is not None)
    columns = columns_of(record, event, ways)
    if about is not None:
        at_rest = {c.name: c for c in columns}
        named = {n: replace(m, column=at_rest[m.column.name]) for n, m in named.items()}
        own = settled(record, named, event, about)
    else:
        own = Settled(named)
    inputs = [m for m in own.matches.values() if m.target.kind == "input" and usable(m) and not is_ambiguous(m)]
    at = {m.target.name: float(_values(record, m)[1][0]) for m in inputs} | dict(own.values)
    for level, output in LEVELS.items():
        if about is not None and output in own.matches:
            at[level] = level_before(*_values(record, own.matches[output]), event)
    levels, why = _levels(model, at)
    by_names = {**own.matches, **{m.target.name: m for m in own.open}} if about is not None else None
    columns = tuple(c for c in columns if c.name not in own.compared)
    mapping = matching(columns, targets_of(model, levels), model.parameters, by_names)
    return Proposal(mapping, why, tuple(phases), own.values, own.notes)


def _event(record: Trajectory, moved: Sequence[Match], means: Mapping[str, float], *, played: bool) -> float | None:
    """Return the event that columns of inputs show, in s. played: an angle among them may turn before it, which is no event."""
    signals = {
        m.column.name: input_signal(*_values(record, m)) for m in moved if not (played and m.target.name == "theta")
    }
    for m in (m for m in moved if played and m.target.name == "theta"):
        values = steadied(record, m.column.name, unit_of_match(m)[0], event_time(signals, means))
        rows = np.isfinite(values)
        signals[m.column.name] = input_signal(record.time[rows], values[rows])
    return event_time(signals, means)


def _mapped(folder: Path, file: Path, name: str, model: AnyModel, about: Terminals | None) -> Mapped:
    record = read_waveforms(file)
    proposed = proposal(record, model, name, about)
    data = _relative(file, folder)
    by_kind = {
        kind: {m.target.name: m.column.name for m in proposed.columns.mapped if m.target.kind == kind}
        for kind in ("input", "output")
    }
    rest = (proposed.phases, proposed.values, proposed.notes)
    if not by_kind["output"]:
        return Mapped(name, file, data, proposed.columns, proposed.levels, None, {}, *rest)
    lines = {m.target.name: schema.ColumnTable(**m.line.keys) for m in proposed.columns.mapped if m.line.keys}
    lost = {s: record.own_rows(c) & np.isnan(record[c]) for s, c in by_kind["input"].items() if c in record}
    leave_out = {s: spans_of(rows, record.time) for s, rows in lost.items() if rows.any()}
    table = schema.ExperimentTable(
        name=name,
        data=file.name,
        inputs=by_kind["input"],
        outputs=by_kind["output"],
        columns=lines,
        values=dict(proposed.values),
        phases=list(proposed.phases),
        leave_out={s: [list(span) for span in spans] for s, spans in leave_out.items()} or None,
    )
    recordings = Recordings(file.parent)
    (experiment,), notes = read_experiments([table], model, recordings, str(file))
    measured = _measured_inputs(experiment, model, played=about is not None)
    if measured:
        table = table.model_copy(update={"interpolation": dict.fromkeys(measured, "linear")})
        (experiment,), notes = read_experiments([table], model, recordings, str(file))
    return Mapped(
        name, file, data, proposed.columns, proposed.levels, experiment, notes[name], *rest, measured, leave_out
    )


def _values(record: Trajectory, match: Match) -> tuple[Array, Array]:
    """The instants of a column in s, and its values in the signal's unit."""
    scale, offset = match.by or (1.0, 0.0)
    rows = np.isfinite(record[match.column.name])
    return record.time[rows], scaled(record[match.column.name][rows], scale) + offset


def _levels(model: AnyModel, inputs: Mapping[str, float]) -> tuple[dict[str, float], str]:
    """The model's inputs and outputs in the steady state of these inputs, and why they are not known."""
    from hvdc_ident.linearize import find_operating_point

    try:
        point = find_operating_point(model, dict(inputs))
    except (InputError, ComputationError) as error:
        return dict(inputs), f"the model's levels before the event are not known: {error}"
    return {**point.inputs, **point.outputs}, ""


def _names(files: Sequence[Path]) -> list[str]:
    """Names of the experiments: those of the files, with what no file name takes left out, each once."""
    names: list[str] = []
    for file in files:
        stem = re.sub(r"[^\w .+-]", "-", file.stem).lstrip(" .+-")[:80] or "recording"
        name, number = stem, 2
        while name.lower() in (n.lower() for n in names):
            name, number = f"{stem}-{number}", number + 1
        names.append(name)
    return names


def _relative(file: Path, folder: Path) -> str:
    """The path of a file as seen from the study's folder; the absolute one where there is no way, as between drives."""
    try:
        return Path(os.path.relpath(file.resolve(), folder.resolve())).as_posix()
    except ValueError:
        return file.resolve().as_posix()


def _about(match: Match) -> dict[str, str]:
    return {"column": match.column.name, "kind": match.target.kind, "reason": match.reason}


def _found(r: Mapped) -> str:
    """The rows, event and noise of a recording, as `check` finds it."""
    e = r.experiment
    if e is None:
        return f"{r.name}: no output could be mapped; the study has the candidates as comments, and the experiment too"
    event = f"event at {e.event:g} s" if e.event is not None else "no event found"
    return f"{r.name}: {e.time.size} rows, {e.time[0]:g} to {e.time[-1]:g} s, {event}; noise {_noise(r)}"


def _noise(r: Mapped) -> str:
    units = {m.target.name: m.target.unit for m in r.columns.mapped}
    return ", ".join(
        f"{o} {quantity(n.std, units.get(o, ''), 3)} (before the event)"
        if n.source == "estimated"
        else f"{o} from the fit"
        for o, n in r.noise.items()
    )


def _open_lines(r: Mapped) -> Iterator[str]:
    """Lines on the columns and signals that are not mapped."""
    if r.experiment is not None and r.experiment.measured is not None:
        yield from (c.text for c in r.experiment.measured.origin.contradictions)
    if r.levels:
        yield r.levels
    yield from r.notes
    for line in r.phases:
        made = ", ".join(f"{name} ({PHASE_QUANTITIES[of]})" for name, of in line.gives.items())
        yield f"of the phases {', '.join((*line.voltage, *(line.current or ())))} at {line.frequency:g} Hz are made: {made}"
    open_ = _by_column(r.columns.proposed)
    for name, matches in list(open_.items())[:COLUMNS_SHOWN]:
        may_be = "; ".join(f"{m.target.kind} {m.target.name} ({m.reason}{_base_words(m)})" for m in matches)
        yield f"column {name} is not mapped; candidates: {may_be}"
    if len(open_) > COLUMNS_SHOWN:
        yield f"and {len(open_) - COLUMNS_SHOWN} more columns are not mapped; the study has their candidates"
    trim = _trim(r)
    if trim:
        yield f"levels before the event: {', '.join(f'{level} = that of {o}' for level, o in trim.items())}"
    inputs = [t for t in r.columns.missing if t.kind == "input" and t.name not in trim and t.name not in r.values]
    if inputs:
        yield f"inputs without a column keep their values: {', '.join(_value(t) for t in inputs)}"
    outputs = [t.name for t in r.columns.missing if t.kind == "output"]
    if outputs:
        yield f"outputs without a column: {', '.join(outputs[:MOST_LISTED])}{_more(outputs)}"
    if r.columns.unused:
        yield f"columns not used: {', '.join(r.columns.unused[:MOST_LISTED])}{_more(r.columns.unused)}"


def _more(names: Sequence[Any]) -> str:
    return f" and {len(names) - MOST_LISTED} more" if len(names) > MOST_LISTED else ""


def _value(target: Target) -> str:
    return f"{target.name} = {quantity(target.level or 0.0, target.unit)}"


def _by_column(matches: Iterable[Match]) -> dict[str, list[Match]]:
    groups: dict[str, list[Match]] = {}
    for m in matches:
        groups.setdefault(m.column.name, []).append(m)
    return groups


def _base_words(match: Match) -> str:
    return "" if match.base is None else f": base = {match.base:g} {match.column.unit}?"


def _study_text(
    path: Path, source: str, model: AnyModel, recordings: Sequence[Mapped], dyr: DyrOfStudy | None
) -> Iterator[str]:
    yield SCHEMA_LINE
    yield f"# A study of {listed(_comment(r.source.name) for r in recordings)}, written by `hvdc-ident new --from`."
    yield "# Read it from top to bottom, take out the # before what is right, then: hvdc-ident check study.toml"
    yield from ("schema = 1", f"name = {toml_string(path.parent.resolve().name or 'study')}", "")
    yield from ("[model]", f"source = {toml_string(source)}")
    if dyr is not None:
        file = toml_string(_relative(dyr.file, path.parent))
        yield f"dyr = {{file = {file}, bus = {dyr.bus}, machine = {toml_string(dyr.machine)}}}   # where `export --to FILE.dyr` writes to"
        yield from (f"# {_comment(note)}" for note in dyr.notes)
    yield ""
    yield "# What may be estimated: take out the # of some parameters, and narrow their bounds."
    yield "[parameters]"
    asked, offered = ({}, {}) if dyr is None else (dyr.candidates, dyr.offered)
    yield from (f"{toml_key(n)} = {{min = {low:g}, max = {high:g}}}" for n, (low, high) in asked.items())
    for name, (low, high) in offered.items():
        yield f"# {toml_key(name)} = {{min = {low:g}, max = {high:g}}}   # {_comment(model.parameters[name].about)}"
    listed_above = {*asked, *offered}
    for name, p in [(n, p) for n, p in model.parameters.items() if n not in listed_above][:MOST_LISTED]:
        bounds = "" if math.isinf(p.min) and math.isinf(p.max) else f"within [{p.min:g}, {p.max:g}]"
        about = ", ".join(t for t in (p.unit, bounds, p.about) if t)
        yield f"# {toml_key(name)} = {{start = {p.value!r}}}" + (f"   # {_comment(about)}" if about else "")
    more = len(model.parameters) - len(listed_above) - MOST_LISTED
    yield from [f"# and {more} more parameters of the model"] if more > 0 else []
    if settable := [n for n, i in model.inputs.items() if i.settable]:
        names = ", ".join(map(toml_string, settable))
        yield from ("", "# [inputs]", f"# settable = [{names}]   # those that a person can move for a recording")
    for r in recordings:
        yield from ("", *_experiment_text(r))
    yield ""
    yield "# The stages. A stage runs if its table is in this file; `simulate` always runs."
    mark = "" if asked and any(r.experiment is not None for r in recordings) else "# "
    yield from (f"{mark}[identifiability]", f"{mark}[fit]            # needs some [parameters]")
    yield f"{mark}[diagnose]       # what the model lacks"
    if dyr is not None and dyr.places:
        yield f"{mark}places = [{', '.join(map(toml_string, dyr.places))}]   # the controls, and what they act on"


def _measured_inputs(experiment: Experiment, model: AnyModel, *, played: bool) -> tuple[str, ...]:
    """Return the inputs that are recorded as they were measured: nobody sets them, and they move from row to row.

    played: whether they are a unit's terminals, which no record holds from row to row, however still it is most of the time.
    """
    moving = {n: s for n, s in experiment.inputs.items() if not model.inputs[n].settable}
    return tuple(n for n, s in moving.items() if played or not (s.is_constant or _is_staircase(s)))


def _is_staircase(signal: InputSignal) -> bool:
    """Return whether a signal holds its values between jumps."""
    changes = np.diff(signal.values) != 0.0
    return bool((np.diff(signal.times)[changes] == 0.0).all())


def _experiment_text(r: Mapped) -> Iterator[str]:
    """The lines of one experiment; all of them comments where no output is mapped, as none may be without."""
    mark = "" if r.experiment is not None else "# "
    yield f"# {_comment(_found(r))}"
    yield f"{mark}[[experiment]]"
    yield f"{mark}name = {toml_string(r.name)}"
    yield f"{mark}data = {toml_string(r.data)}"
    inputs = [m.target.name for m in r.columns.mapped if m.target.kind == "input"]
    if r.measured:
        by_input = ", ".join(f'{toml_key(n)} = "linear"' for n in r.measured)
        how = '"linear"' if set(r.measured) == set(inputs) else f"{{{by_input}}}"
        yield f"{mark}interpolation = {how}   # what is measured moves from row to row, and does not jump at the later one"
    yield '# role = "holdout"   # not fitted: validates the estimates'
    if r.experiment is not None and r.experiment.event is not None:
        yield f"# event = {r.experiment.event!r}   # s, as found from the inputs"
    if r.leave_out:
        yield f"{mark}{leave_out_line(r.leave_out)}   # not recorded there: bridged by a line, and no output compared"
    if r.levels:
        yield f"# {_comment(r.levels)}"
    trim = _trim(r)
    if trim:
        yield f"{mark}trim = {{{', '.join(f'{level} = {toml_string(o)}' for level, o in trim.items())}}}   # the level before the event"
    if r.values:
        yield f"{mark}values = {{{', '.join(f'{toml_key(n)} = {v!r}' for n, v in r.values.items())}}}   # as recorded before the event"
    yield from (f"# {_comment(note)}" for note in r.notes)
    if r.phases:
        made = any(m.column.name in line.gives for m in r.columns.mapped for line in r.phases)
        lines = ", ".join(map(phases_text, r.phases))
        yield f"{mark if made else '# '}phases = [{lines}]   # the columns that they give, as if recorded"
    bases: list[Match] = []
    for kind in ("input", "output"):
        mapped = [m for m in r.columns.mapped if m.target.kind == kind]
        proposed = [m for m in r.columns.proposed if m.target.kind == kind]
        missing = [t for t in r.columns.missing if t.kind == kind]
        yield from (
            "",
            f"{mark if mapped or kind == 'output' else '# '}[experiment.{kind}s]   # signal of the model = column",
        )
        for m in mapped:
            yield f"{mark}{toml_key(m.target.name)} = {toml_string(m.column.name)}   # {_comment(_unit_words(m))}"
        for m in proposed:
            yield f"# {toml_key(m.target.name)} = {toml_string(m.column.name)}   # {_comment(m.reason)}"
        if missing:
            shown = ", ".join(_value(t) if kind == "input" else t.name for t in missing[:MOST_LISTED])
            at = ", at the model's values" if kind == "input" else ""
            yield f"# without a column{at}: {_comment(shown)}{_more(missing)}"
        bases += [m for m in proposed if m.by is None or m.is_open]
    stated = [m for m in r.columns.mapped if m.line.keys]
    if stated or bases:
        opened = mark if stated else "# "
        yield from (
            "",
            f"{opened}[experiment.columns]   # with the lines above: scale x recorded, or recorded / base = value in the model",
        )
        for m in stated:
            yield f"{mark}{toml_key(m.target.name)} = {{{_line_text(m.line.keys)}}}"
        for m in bases:
            base = "..." if m.base is None else repr(m.base)
            unit = m.column.unit or m.column.reading.unit
            yield f"# {toml_key(m.target.name)} = {{unit = {toml_string(unit)}, base = {base}}}"
    if r.columns.unused:
        yield f"# columns not used: {_comment(', '.join(r.columns.unused[:MOST_LISTED]))}{_more(r.columns.unused)}"


def _line_text(line: Mapping[str, Any]) -> str:
    return ", ".join(f"{key} = {toml_string(v) if isinstance(v, str) else repr(v)}" for key, v in line.items())


def _trim(r: Mapped) -> dict[str, str]:
    """Return by input with a level of a unit that is played back its output, where that is mapped."""
    inputs = {t.name for t in r.columns.missing if t.kind == "input"}
    outputs = {m.target.name for m in r.columns.mapped if m.target.kind == "output"}
    return {level: output for level, output in LEVELS.items() if level in inputs and output in outputs}


def _unit_words(match: Match) -> str:
    """The reason of a mapping, and what becomes of the unit."""
    unit, wanted = match.column.unit, match.target.unit
    if match.line.keys or "taken as" in match.reason:
        return match.reason
    if not unit:
        return f"{match.reason}; the file states no unit: taken as {wanted}" if wanted else match.reason
    return (
        match.reason
        if unit == wanted or not wanted or "converted" in match.reason
        else f"{match.reason}; {unit} is converted to {wanted}"
    )


def _comment(text: str) -> str:
    """Text that stays on the line of a comment, without control characters."""
    return "".join(c if c.isprintable() else " " for c in text)
