"""Experiments from the study's tables and the data files they name."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import (
    Array,
    Experiment,
    InputSignal,
    NoiseEstimate,
    Origin,
    Trajectory,
    before_event,
    conversion,
    event_time,
    input_noise,
    input_signal,
    noise_before,
    noise_floor,
    same_unit,
    scaled,
    seconds_of,
)
from hvdc_ident.data.three_phase import (
    PhaseFilter,
    PhasorColumns,
    PhasorSettings,
    frequency_noise,
    phase_quantities,
    phasor_quantities,
    unwrapped,
)
from hvdc_ident.data.turning import unwrapped_words, whole_turns
from hvdc_ident.data.window_noise import window_rows
from hvdc_ident.errors import InputError, StudyError, located, require_known
from hvdc_ident.files import digest
from hvdc_ident.formats import files_of, read_waveforms
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel
from hvdc_ident.model.card import toml_table
from hvdc_ident.study import schema
from hvdc_ident.study.left_out import RowsLeftOut
from hvdc_ident.summary.levels import NoiseNote
from hvdc_ident.toml_tables import check_names

TIME_SHIFT = "time-shift"
SETTLED = 3.0
"""Time constants after which a low pass has forgotten 95 %."""


@dataclass
class Recordings:
    """The data files of a study, each read once. digests: sha256 of every file behind them, by its path from the study."""

    folder: Path
    digests: dict[str, str] = field(default_factory=dict)
    _read: dict[str, Trajectory] = field(default_factory=dict)

    def load(self, columns: Mapping[str, Mapping[str, Sequence[str]]]) -> None:
        """Read the files, but for those whose columns are there. columns: by file, by experiment, the columns wanted."""
        for name, wanted in columns.items():
            path = self.folder / name
            asked = tuple(dict.fromkeys(c for cs in wanted.values() for c in cs))
            if name in self._read and self._read[name].names == asked:
                continue
            try:
                self._read[name] = read_waveforms(path, asked)
            except InputError as e:
                raise self._placed(e, path, wanted) from None
            for file in files_of(path):
                beside = name if file == path else (Path(name).parent / file.name).as_posix()
                self.digests[beside] = digest(file.read_bytes())

    def __getitem__(self, name: str) -> Trajectory:
        """The columns read from a file."""
        return self._read[name]

    def _placed(self, error: InputError, path: Path, wanted: Mapping[str, Sequence[str]]) -> InputError:
        """The error with the first experiment that meets it."""
        for experiment, columns in wanted.items():
            try:
                read_waveforms(path, columns)
            except InputError as e:
                placed = e.at(f"experiment '{experiment}'")
                return placed if isinstance(placed, InputError) else error
        return error


def read_experiments(
    tables: Sequence[schema.ExperimentTable], model: AnyModel, recordings: Recordings, where: str
) -> tuple[tuple[Experiment, ...], FrozenMap[FrozenMap[NoiseNote]]]:
    """The experiments, and where the noise of each output comes from."""
    wanted: dict[str, dict[str, list[str]]] = {}
    seen: set[str] = set()
    for table in tables:
        place = f"{where}, experiment '{table.name}'"
        if table.name.lower() in seen:
            raise StudyError(
                "two experiments of one name", where=place, expected="a name of its own, for files are named after it"
            )
        seen.add(table.name.lower())
        _check_names(table, model, place)
        columns = raw_columns(table, [*(c for _, c in _channels(table)), *_noise_columns(table).values()])
        wanted.setdefault(table.data, {})[table.name] = list(dict.fromkeys(columns))
    with located(where):
        recordings.load(wanted)
    experiments, notes = [], {}
    for table in tables:
        place = f"{where}, experiment '{table.name}'"
        try:
            experiment, notes[table.name] = _experiment(table, model, recordings[table.data], place)
        except InputError as e:
            raise (e if place in e.where else e.at(place)) from None
        experiments.append(experiment)
    return tuple(experiments), FrozenMap(notes)


def with_noise(
    experiment: Experiment, stated: Mapping[str, float] | None = None, means: Mapping[str, float] = FrozenMap()
) -> tuple[Experiment, FrozenMap[NoiseNote]]:
    """Return the experiment with its event and the noise of its outputs where they are not stated, and their sources.

    stated: standard deviations by output, 0 allowed; left out, the experiment's. The noise is estimated before the event,
    and where there is none the fit's residual tells. means: by output the length in s of a mean that smoothed it, whose rows tell
    of noise only where they are so far apart.
    """
    e = experiment
    stated = e.noise if stated is None else stated
    event = e.event if e.event is not None else event_time(e.inputs)
    if e.measured is None:
        return e.with_(event=event), FrozenMap()
    table = e.measured
    notes, dof, told_by = {}, {}, {}
    for o in e.outputs:
        recorded = np.flatnonzero(np.isfinite(table[o]))
        rows = recorded[_apart(e.time[recorded], means.get(o, 0.0))]
        estimate = NoiseEstimate() if o in stated else noise_before(e.time[rows], table[o][rows], event)
        notes[o] = _noise(stated.get(o), estimate, noise_floor(table[o]), by_row=o in e.noise_profile and o in stated)
        if notes[o].source == "estimated":
            dof[o], told_by[o] = max(1.0, estimate.freedom), estimate.source
    noise = {o: n.std for o, n in notes.items() if n.source in ("given", "estimated")}
    profile = {o: v for o, v in e.noise_profile.items() if o in noise}
    known = {"noise_dof": e.noise_dof | dof, "noise_from": e.noise_from | told_by}
    return e.with_(event=event, noise=noise, **known, noise_profile=profile), FrozenMap(notes)


def _apart(time: Array, length: float) -> NDArray[np.intp]:
    """The rows that are so far apart, in s, the first so far from the start; all of them for 0."""
    if not length:
        return np.arange(time.size)
    ends = np.arange(time[0] + length, time[-1], length)
    return np.unique(np.searchsorted(time, ends))


def _check_names(table: schema.ExperimentTable, model: AnyModel, place: str) -> None:
    """Raises where the table names what the model does not have."""
    if any(n in model.parameters and n not in model.inputs for n in table.values):
        raise StudyError(
            "a parameter among the inputs held constant",
            where=f"{place}.values",
            expected="inputs",
            hint="[model.values] for parameters",
        )
    known: dict[str, Collection[str]] = {
        "input": model.inputs,
        "output": model.outputs,
        "insertion point": model.insertion_points,
        "measured output": table.outputs,
        "signal of the experiment": ["time", *table.inputs, *table.outputs, *table.drive],
        "nuisance": [TIME_SHIFT, *model.inputs, *table.drive, *model.states],
    }
    check_names(table, known, f"{place}.")
    require_known("measured output", table.trim.values(), table.outputs, f"{place}.trim")
    if isinstance(table.interpolation, dict):
        require_known("input", table.interpolation, [*table.inputs, *table.drive], f"{place}.interpolation")
    for kind, names in (("values", table.values), ("drive", table.drive), ("trim", table.trim)):
        if both := [n for n in names if n in table.inputs]:
            raise StudyError(f"'{both[0]}' stands in inputs and in {kind}", where=place, expected="one of them")


def _channels(table: schema.ExperimentTable) -> list[tuple[str, str]]:
    """Signal of the model and recorded column, for inputs, driven insertion points and outputs; a column may serve twice."""
    pairs = []
    for signal, column in (*table.inputs.items(), *table.drive.items(), *table.outputs.items()):
        line = table.columns.get(signal)
        other = line.name if line else None
        if other is not None and column not in (signal, other):
            raise StudyError(
                f"two columns for '{signal}'",
                where=f"experiment '{table.name}'",
                expected="one of them",
                got=f"'{column}' and '{other}'",
            )
        pairs.append((signal, other or column))
    return pairs


def _experiment(
    table: schema.ExperimentTable, model: AnyModel, data: Trajectory, place: str
) -> tuple[Experiment, FrozenMap[NoiseNote]]:
    columns = dict(_channels(table))
    recorded = data.names
    data = with_derived(table.phases, table.phasors, data, place)
    data = _within_inputs(data, [columns[s] for s in (*table.inputs, *table.drive)], place)
    time = _time(table, data, place)
    mappings = {s: _mapping(table, model, s, c, data, place) for s, c in columns.items()}
    mapped = {s: scaled(data[c], mappings[s][0]) for s, c in columns.items()}
    mapped |= {s: mapped[s] + offset for s, (_, offset) in mappings.items() if offset != 0.0}
    mapped |= {s: _in_frame(table, s, time, mapped[s], place) for s in columns if same_unit(_unit(model, s), "rad")}
    # What is computed from phases has no digits of its own, and repeats itself where they are periodic: it is not judged.
    raw = {s: data[c] if c in recorded else np.full(time.size, np.nan) for s, c in columns.items()}
    played = (*table.inputs, *table.drive)
    own = {s: data.own_rows(columns[s]) for s in played}
    unrecorded = {s: rows for s in played if 0 < (rows := own[s] & np.isnan(mapped[s])).sum() < own[s].sum()}
    out = RowsLeftOut(table, time, raw, _turns(model, mappings), own, unrecorded)
    for s, rows in out.unrecorded.items():
        raise StudyError(
            f"column '{columns[s]}' is not recorded in {rows.sum()} of {own[s].sum()} rows, the first at {time[rows][0]:g} s",
            where=f"{place}, {table.data}",
            expected=f"a number in every row: the model needs its '{s}' all along",
            hint=f"to bridge them by a line, and to compare no output there, write: {out.write}",
        )
    mapped = {s: out.without(s, time, v, bridged=s not in table.outputs) for s, v in mapped.items()}
    inputs = {}
    for s in played:
        inputs[s] = _input(table, s, columns[s], time[own[s]], mapped[s][own[s]], place)
    outputs = tuple(table.outputs)
    if empty := [o for o in outputs if np.isnan(mapped[o]).all()]:
        raise StudyError(
            f"column '{columns[empty[0]]}' of output '{empty[0]}' is not recorded in any row",
            where=f"{place}, {table.data}",
            expected="numbers",
            hint="take it out of outputs",
        )
    deviations = {
        o: _deviations(data, c, columns[o], mappings[o], f"{place}, {table.data}")
        for o, c in _noise_columns(table).items()
    }
    stated = {o: n for o, n in table.noise.items() if isinstance(n, float | int)}
    stated |= {o: float(np.sqrt(np.nanmean(d**2))) for o, d in deviations.items()}
    lengths = smoothed(table.phases, table.phasors)
    means = {s: lengths[c] for s, c in columns.items() if c in lengths}
    units = tuple(model.outputs[o].unit for o in outputs)
    converted = tuple(_conversion_words(table, model, s, c, data, mappings[s]) for s, c in columns.items())
    jumps = {s: whole_turns(mappings[s][0] * data[c]) for s, c in columns.items() if same_unit(_unit(model, s), "rad")}
    converted += tuple(f"{s}: {unwrapped_words(n)}" for s, n in jumps.items() if n)
    origin = replace(
        data.origin,
        time_unit=_time_unit(table, data.origin),
        converted=(*data.origin.converted, *(line for line in converted if line)),
        records=tuple(tuple(s for s, c in columns.items() if c in record) for record in data.origin.records),
        contradictions=out.contradictions,
    )
    measured = Trajectory(time, np.column_stack([mapped[o] for o in outputs]), outputs, units, origin)
    instrument = {o: line.model_dump(by_alias=True, exclude_none=True) for o, line in table.instrument.items()}
    experiment = Experiment(
        time,
        table.name,
        inputs=inputs,
        values=table.values,
        measured=measured,
        # 1 where nothing is recorded, which nobody looks at
        noise_profile={o: np.where(np.isnan(d), 1.0, d / stated[o]) for o, d in deviations.items()},
        event=_event(table, time, inputs, means, place),
        window=_window(table, time, place),
        role=table.role,
        drive=tuple(table.drive),
        instrument=instrument,
        nuisance=tuple(dict.fromkeys(table.nuisance)),
    )
    experiment, notes = with_noise(experiment, stated, means)
    if table.trim:
        experiment = _trimmed(experiment, table, mapped)
    if windows := _windows(experiment, [o for o in outputs if columns[o] in recorded]):
        said = replace(measured, origin=replace(origin, notes=(*origin.notes, windows)))
        experiment = experiment.with_(measured=said)
    return experiment, notes


def _windows(experiment: Experiment, outputs: Sequence[str]) -> str:
    """Return the sentence on outputs whose noise shows that they are means over a window which the study does not state; "" for none."""
    assert experiment.measured is not None
    time, lengths = experiment.time, {}
    for o in (o for o in outputs if o not in experiment.instrument):
        if (rows := window_rows(time, experiment.measured[o], experiment.event)) is not None:
            lengths[o] = float(f"{rows * float(np.median(np.diff(time))):.4g}")
    if not lengths:
        return ""
    seen = ", ".join(f"{o} over {length:g} s" for o, length in lengths.items())
    stated = {**experiment.instrument, **{o: {"window-mean": length} for o, length in lengths.items()}}
    return f"the noise before the event is that of means, {seen}; to take them of the model too write: instrument = {toml_table(stated)}"


def _within_inputs(data: Trajectory, columns: Sequence[str], place: str) -> Trajectory:
    """The rows within the records of all inputs, where those have several rates: outside, an input is not known."""
    if not data.origin.records or not columns:
        return data
    spans = [data.time[data.own_rows(column)][[0, -1]] for column in columns]
    low, high = max(span[0] for span in spans), min(span[1] for span in spans)
    inside = (data.time >= low) & (data.time <= high)
    if int(inside.sum()) < 2:
        raise StudyError(
            "the records of the inputs share no time",
            where=place,
            expected="records that overlap",
            got=", ".join(f"{c} {a:g} to {b:g} s" for c, (a, b) in zip(columns, spans, strict=True)),
            hint="take inputs of one record",
        )
    dropped = data.origin.dropped + int(np.count_nonzero(~inside))
    return replace(data.rows(inside), origin=replace(data.origin, dropped=dropped))


def _trimmed(experiment: Experiment, table: schema.ExperimentTable, mapped: Mapping[str, Array]) -> Experiment:
    """Return the experiment whose start stands at the levels before the event, of the outputs to be met and of the inputs played in.

    One row of a noisy input would put the references off by its noise, which a voltage control multiplies.
    """
    levels = {n: level_before(experiment.time, v, experiment.event) for n, v in mapped.items()}
    inputs = {n: i.begun_at(levels[n]) for n, i in experiment.inputs.items()}
    values = {n: levels[o] for n, o in table.trim.items()}
    known = {n: k for n in inputs if (k := np.isfinite(mapped[n])).any() and np.ptp(mapped[n][k]) > 0.0}
    noise = {n: input_noise(experiment.time[k], mapped[n][k], experiment.event) for n, k in known.items()}
    return experiment.with_(
        inputs=inputs,
        values=experiment.values | values,
        input_noise={n: own for n, own in noise.items() if own.any},
        levels=tuple(dict.fromkeys(table.trim.values())),
    )


def level_before(time: Array, values: Array, event: float | None) -> float:
    """Return the mean of the rows before the event, the first recorded row where there is none, in the values' unit."""
    rows = before_event(time, values, event)
    return float(values[rows].mean() if rows.any() else values[np.isfinite(values)][0])


def _time(table: schema.ExperimentTable, data: Trajectory, place: str) -> Array:
    """The rows' instants in s."""
    line = table.columns.get("time")
    if line is None:
        return data.time
    if line.name is not None or line.base is not None or line.offset is not None:
        raise StudyError(
            "the file says where its time stands", where=f"{place}.columns.time", expected="unit or scale alone"
        )
    stated = data.origin.time_unit
    if stated and (line.scale is not None or seconds_of(stated) != seconds_of(line.unit or "s")):
        raise StudyError(
            "the unit of the time contradicts the file's",
            where=f"{place}.columns.time",
            expected=f"nothing: {table.data} says '{stated}', and its times are converted from that",
            got=f"{line.unit or line.scale}",
        )
    if stated:
        return data.time
    scale = line.scale if line.scale is not None else seconds_of(line.unit or "s")
    if scale is None or scale <= 0:
        raise StudyError(
            "no unit of time",
            where=f"{place}.columns.time",
            expected="s, ms, us, min, h, or a scale above 0",
            got=f"{line.unit or line.scale}",
        )
    return scaled(data.time, scale)


def _mapping(
    table: schema.ExperimentTable, model: AnyModel, signal: str, column: str, data: Trajectory, place: str
) -> tuple[float, float]:
    """Scale and offset: the value in the model's unit = scale x recorded + offset.

    Units of one kind are converted. Raises where the units contradict each other and neither scale nor base is given.
    """
    line = table.columns.get(signal) or schema.ColumnTable()
    recorded = line.unit if line.unit is not None else data.unit(column)
    offset = line.offset or 0.0
    if line.unit is not None and data.unit(column) and not same_unit(line.unit, data.unit(column)):
        raise StudyError(
            f"the unit of column '{column}' contradicts the file's",
            where=f"{place}.columns.{signal}",
            expected=f"'{data.unit(column)}' as in {table.data}",
            got=f"'{line.unit}'",
        )
    if line.scale is not None:
        if line.scale == 0:
            raise StudyError(
                "a scale of 0 leaves nothing", where=f"{place}.columns.{signal}", expected="a number that is not 0"
            )
        return line.scale, offset
    if line.base is not None:
        return 1.0 / line.base, offset
    unit = _unit(model, signal)
    if not recorded or not unit or same_unit(recorded, unit):
        return 1.0, offset
    by = conversion(recorded, unit)
    if by is None:
        raise StudyError(
            f"column '{column}' is in another unit than the model's '{signal}'",
            where=f"{place}.columns.{signal}" if line.unit is not None else f"{place}, {table.data}",
            expected=f"'{unit}'",
            got=f"'{recorded}'",
            hint=f'columns = {{{signal} = {{unit = "{recorded}", scale = ...}}}}, value in the model = scale x recorded',
        )
    return by[0], by[1] + offset


def _in_frame(table: schema.ExperimentTable, signal: str, time: Array, angle: Array, place: str) -> Array:
    """Return an angle in rad without its jumps by whole turns, and without the course with which the frame of the model turns."""
    line = table.columns.get(signal)
    turn = line.turn if line is not None else None
    return unwrapped(angle) if turn is None else unwrapped(angle) - 2.0 * np.pi * turn * (time - time[0])


def _turns(model: AnyModel, mappings: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    """Return a whole turn of each signal that is an angle, in the unit of its column."""
    return {s: 2.0 * np.pi / abs(m[0]) for s, m in mappings.items() if same_unit(_unit(model, s), "rad")}


def _conversion_words(
    table: schema.ExperimentTable,
    model: AnyModel,
    signal: str,
    column: str,
    data: Trajectory,
    mapping: tuple[float, float],
) -> str:
    """Return what was done to a column beyond what the study states: the conversion of its unit; "" where nothing was."""
    line = table.columns.get(signal) or schema.ColumnTable()
    if line.scale is not None or line.base is not None or mapping == (1.0, line.offset or 0.0):
        return ""
    return f"{signal}: from {line.unit or data.unit(column)} to {_unit(model, signal)}"


def _unit(model: AnyModel, signal: str) -> str:
    for table in (model.inputs, model.outputs, model.signals, model.states, model.algebraic):
        if signal in table:
            return str(table[signal].unit)
    return ""


def _input(
    table: schema.ExperimentTable, signal: str, column: str, time: Array, values: Array, place: str
) -> InputSignal:
    kind = table.interpolation
    interpolation = kind.get(signal) if isinstance(kind, dict) else kind
    if np.isnan(values).all():
        raise StudyError(
            f"column '{column}' of input '{signal}' is not recorded in any row",
            where=f"{place}, {table.data}",
            expected="numbers",
            hint="take it out of inputs",
        )
    with located(f"{place}, signal '{signal}'"):
        return input_signal(time, values, interpolation)


def _time_unit(table: schema.ExperimentTable, origin: Origin) -> str:
    """The unit of the time as the file or the study says it, "" where neither does."""
    line = table.columns.get("time")
    if origin.time_unit or line is None:
        return origin.time_unit
    return line.unit or (f"{line.scale:g} s" if line.scale is not None else "")


def _event(
    table: schema.ExperimentTable,
    time: Array,
    inputs: Mapping[str, InputSignal],
    means: Mapping[str, float],
    place: str,
) -> float | None:
    """The event as stated, or of inputs that are made of phases or phasors; None where the inputs themselves show it."""
    if table.event is not None and not time[0] <= table.event <= time[-1]:
        raise StudyError(
            "the event lies outside the record",
            where=f"{place}.event",
            expected=f"{time[0]:g} to {time[-1]:g} s",
            got=f"{table.event:g} s",
        )
    return table.event if table.event is not None or not means.keys() & inputs.keys() else event_time(inputs, means)


def smoothed(phases: Sequence[schema.PhasesTable], phasors: Sequence[schema.PhasorsTable] = ()) -> dict[str, float]:
    """Return by column that is made of phases or phasors the time in s within which its noise is the same: of one that is not filtered
    a cycle, within which it ripples."""
    lengths: dict[str, float] = {}
    for line in phases:
        kept = {"mean": _window_of(line), "lowpass": SETTLED * _window_of(line), "none": 1.0 / line.frequency}
        lengths |= dict.fromkeys(line.gives, kept[line.filter])
    for phasor in phasors:
        lengths |= {name: phasor.window for name, quantity in phasor.gives.items() if quantity == "f"}
    return {name: length for name, length in lengths.items() if length > 0.0}


def _window_of(line: schema.PhasesTable) -> float:
    """The length of the filter in s: one cycle where it is not stated."""
    return line.window if line.window is not None else 1.0 / line.frequency


def _window(table: schema.ExperimentTable, time: Array, place: str) -> tuple[float, float] | None:
    if table.window is None:
        return None
    low, high = table.window
    if int(((time >= low) & (time <= high)).sum()) < 2:
        raise StudyError(
            "the window holds fewer than two rows",
            where=f"{place}.window",
            expected=f"a part of {time[0]:g} to {time[-1]:g} s",
            got=f"[{low:g}, {high:g}]",
        )
    return low, high


def _noise_columns(table: schema.ExperimentTable) -> dict[str, str]:
    """Return the column of the standard deviations of each output that names one."""
    return {o: n.column for o, n in table.noise.items() if isinstance(n, schema.NoiseTable)}


def _deviations(data: Trajectory, column: str, of: str, mapping: tuple[float, float], place: str) -> Array:
    """(n,) standard deviations in the model's unit, NaN where the output is not recorded.

    Raises StudyError where one is missing or not above 0, or in another unit than the output's column.
    """
    unit = data.unit(column)
    by = conversion(unit, data.unit(of)) if unit and data.unit(of) else (1.0, 0.0)
    if by is None:
        raise StudyError(
            f"the standard deviations in column '{column}' are in another unit than what they belong to",
            where=place,
            expected=f"'{data.unit(of)}', as column '{of}'",
            got=f"'{unit}'",
        )
    deviations = data[column] * by[0] * abs(mapping[0])
    recorded = ~np.isnan(data[of])
    bad = np.flatnonzero(recorded & ~(deviations > 0))
    if bad.size:
        raise StudyError(
            f"no standard deviation in column '{column}' at {data.time[bad[0]]:g} s",
            where=place,
            expected=f"a number above 0 wherever '{of}' is recorded",
            got=f"{data[column][bad[0]]:g}",
        )
    return np.where(recorded, deviations, np.nan)


def _noise(given: float | None, estimate: NoiseEstimate, floor: float, *, by_row: bool) -> NoiseNote:
    """The larger of what is given, else found before the event, and the floor; where that acts the data show no noise."""
    if given is None and not estimate.source:
        return NoiseNote(floor, "residual")
    std = given if given is not None else estimate.std
    if std <= floor:
        return NoiseNote(floor, "floor")
    return NoiseNote(std, "given" if given is not None else "estimated", by_row)


def raw_columns(table: schema.ExperimentTable, columns: Sequence[str]) -> list[str]:
    """The columns to be read from the file where these are wanted, some of them made of phases or phasors."""
    made = {*(n for line in table.phases for n in line.gives), *(n for line in table.phasors for n in line.gives)}
    phases = [name for line in table.phases for name in (*line.voltage, *(line.current or ()))]
    phasors = [n for line in table.phasors for p in (line.voltage, line.current) if p for n in (*p.magnitude, *p.angle)]
    references = [line.reference for line in table.phasors if line.reference not in (None, "start")]
    return list(dict.fromkeys([*(c for c in columns if c not in made), *phases, *phasors, *map(str, references)]))


def with_derived(
    phases: Sequence[schema.PhasesTable], phasors: Sequence[schema.PhasorsTable], data: Trajectory, place: str
) -> Trajectory:
    """The recording with the columns that phases and phasors give; the same object where none are asked for."""
    recording = data
    for number, line in enumerate(phases, 1):
        recording = _added(
            recording, line.gives, _of_phases(line, data, f"{place}.phases, line {number}"), line.voltage[0]
        )
    for number, phasor in enumerate(phasors, 1):
        recording = _added(
            recording,
            phasor.gives,
            _of_phasors(phasor, data, f"{place}.phasors, line {number}"),
            phasor.voltage.magnitude[0],
        )
    return recording


def _of_phases(line: schema.PhasesTable, whole: Trajectory, where: str) -> Trajectory:
    _check_new(line.gives, whole, where)
    data = whole.rows(whole.own_rows(line.voltage[0]))
    with located(where):
        return phase_quantities(
            data,
            line.voltage,
            line.current,
            list(line.gives.values()),
            frequency=line.frequency,
            smoothing=PhaseFilter(line.filter, _window_of(line)),
        )


def _of_phasors(line: schema.PhasorsTable, whole: Trajectory, where: str) -> Trajectory:
    _check_new(line.gives, whole, where)
    data = whole.rows(whole.own_rows(line.voltage.magnitude[0]))
    how = PhasorSettings(line.frequency, line.window, line.magnitudes or "", line.reference or "")
    current = _columns(line.current) if line.current is not None else None
    with located(where):
        made = phasor_quantities(data, _columns(line.voltage), current, list(line.gives.values()), how)
    converted = tuple(
        f"{name}: mean frequency over the last {line.window:g} s, from the angle; noise of 1 deg in it is "
        f"{frequency_noise(np.pi / 180.0, line.window):.3g} Hz here"
        for name, quantity in line.gives.items()
        if quantity == "f"
    )
    return replace(made, origin=replace(made.origin, converted=converted))


def _columns(phasor: schema.PhasorTable) -> PhasorColumns:
    return PhasorColumns(tuple(phasor.magnitude), tuple(phasor.angle), phasor.unit or "")


def _check_new(gives: Mapping[str, str], data: Trajectory, where: str) -> None:
    taken = [name for name in gives if name in data]
    if taken:
        raise StudyError(f"a column '{taken[0]}' is already there", where=where, expected="a new name in gives")


def _added(recording: Trajectory, gives: Mapping[str, str], made: Trajectory, of: str) -> Trajectory:
    """The recording with columns made of the one called `of`, at the rows of its record."""
    values = np.full((len(recording), len(gives)), np.nan)
    values[recording.own_rows(of)] = made.values
    records = tuple((*r, *gives) if of in r else r for r in recording.origin.records)
    return Trajectory(
        recording.time,
        np.column_stack([recording.values, values]),
        (*recording.names, *gives),
        (*recording.units, *made.units),
        replace(recording.origin, converted=(*recording.origin.converted, *made.origin.converted), records=records),
    )
