"""Contradictions in the columns at a plant's terminals: a unit, base or sign that the levels, the turn of the voltage or the movement
after the event speak against, with what to write.

A level or a turn that no network has speaks for itself. Signs, and units of what has no level of its own, show in the first second after
the event: there the model at its given values moves as the plant does, whatever its controls are, where the columns are right.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Contradiction, Experiment, InputSignal, Trajectory, before_event, conversion
from hvdc_ident.data.quantities import Reading, read_columns
from hvdc_ident.data.turning import Agreement, agreement, scatter
from hvdc_ident.formats import read_waveforms
from hvdc_ident.model.card import toml_table
from hvdc_ident.plants import LEVELS
from hvdc_ident.simulate import ModelSimulator
from hvdc_ident.study import schema
from hvdc_ident.study.apparent_power import ApparentPower, exchanged
from hvdc_ident.study.conversions import STRONG
from hvdc_ident.study.initial_values import outputs_of
from hvdc_ident.study.recordings import TIME_SHIFT
from hvdc_ident.study.terminal_columns import (
    DEGREE,
    FASTEST,
    LOADS,
    NORMAL,
    Terminals,
    Way,
    agreement_words,
    fastest,
    frequency_way,
    rounded,
    terminals_of,
)
from hvdc_ident.text import quantity

if TYPE_CHECKING:
    from hvdc_ident.study.study import Study

FOLLOWS = 0.5
"""Share of the square of the recorded movement that a model of the plant leaves at most, whose gains may be wrong. A mistake is told where
without it the model leaves no more than this, and by odds of `STRONG` less than with it: so a model that leaves a tenth of this as the
record is written is asked for none."""
SOON = 1.0
"""Time in s after the event in which network, machine and its inertia tell the movement, before most controls do."""
SEEN = 5.0
"""Times its noise by which a movement is one."""
ROOT = math.sqrt(3.0)
RESTS = (0.9, 1.1)
"""Voltage in pu at which a plant stays for longer than a disturbance: limits of operation in an emergency."""
PEAK = math.sqrt(2.0 / 3.0)
"""Peak of the voltage of a phase to ground over the rms value from line to line: near enough to 1 to pass for a low voltage."""


def column_contradictions(study: Study) -> tuple[Contradiction, ...]:
    """Return what contradicts itself in the recordings of a plant that is played back; nothing for another model.

    One finding a cause: where a level is wrong, what follows from it is not told too.
    """
    about = terminals_of(study.model)
    if about is None:
        return ()
    contradictions: list[Contradiction] = []
    tables = {t.name: t for t in study.settings.experiment}
    for e in (e for e in study.experiments if e.name in tables and e.measured is not None):
        case = _Case(study, e, tables[e.name], about)
        by_level = [*case.voltage(), *case.frequency(), *case.turns_twice(), *case.power(), *case.current()]
        by_turn = [] if by_level else [*case.angles(), *case.turn()]
        contradictions += by_level or by_turn or [*case.movement()]
    return tuple(contradictions)


@dataclass(frozen=True)
class _Mistake:
    """A mistake of a record: what is right is a factor times the column. kind, words: of the finding. sources: by output the one in
    whose column it is; late: s by which the outputs' clock is; write: the line that mends it, "" where the factors say it."""

    kind: str = ""
    words: str = ""
    factors: Mapping[str, float] = field(default_factory=dict)
    sources: Mapping[str, str] = field(default_factory=dict)
    late: float = 0.0
    write: str = ""

    def of(self, signal: str) -> float:
        """Return the factor of a signal."""
        return self.factors.get(signal, 1.0)

    def source(self, output: str) -> str:
        """Return the output in whose column another one is."""
        return self.sources.get(output, output)

    @property
    def columns(self) -> tuple[str, ...]:
        """The signals it is about."""
        return tuple(self.factors)

    @property
    def ways(self) -> dict[str, Way]:
        """The ways in which the columns are to be written."""
        return {n: Way(k) for n, k in self.factors.items()}


@dataclass(frozen=True)
class _Case:
    """One experiment of a plant that is played back."""

    study: Study
    experiment: Experiment
    table: schema.ExperimentTable
    about: Terminals

    def voltage(self) -> Iterator[Contradiction]:
        """Yield a voltage that is not near 1 pu before the event."""
        level = self._level("V")
        if level is None:
            return
        if NORMAL[0] <= level <= NORMAL[1]:
            if level < RESTS[0] and RESTS[0] <= level / PEAK <= RESTS[1]:
                what = f"V is at {level:.4g} pu {self._when}, below where a plant stays: it is the peak of the voltage of a phase"
                yield self._finding("base", ("V",), what, self._columns({"V": Way(1.0 / PEAK)}))
            return
        ways = [(ROOT, "it is the voltage from phase to ground"), (1.0 / ROOT, "the base is that of a phase")]
        ways += [(k, words) for k, words in ((1e3, "a k is missing"), (1e-3, "a k is too much"))]
        near = [(k, words) for k, words in ways if NORMAL[0] <= k * level <= NORMAL[1]]
        what = f"V is at {level:.4g} pu {self._when}, where no plant runs"
        if len(near) == 1:
            (k, words) = near[0]
            yield self._finding("base", ("V",), f"{what}: {words}", self._columns({"V": Way(k)}))
        else:
            yield self._finding("base", ("V",), f"{what}: what is its base, line to line in the column's unit?")

    def frequency(self) -> Iterator[Contradiction]:
        """Yield a frequency that is not near the nominal one before the event."""
        level = self._level("f")
        if level is None or 0.9 <= level / self.about.frequency <= 1.1:
            return
        largest = float(np.abs(self.experiment.inputs["f"].values).max())
        way = frequency_way("", False, level, largest, self.about)
        what = f"f is at {level:.6g} Hz {self._when}, of nominally {self.about.frequency:g} Hz"
        words = f": it is {way.words.removesuffix(', taken as Hz')}" if way is not None else ": what is its unit?"
        yield self._finding("unit", ("f",), what + words, self._columns({"f": way}) if way is not None else "")

    def turns_twice(self) -> Iterator[Contradiction]:
        """Yield an angle and a frequency that both move: the voltage turns by one and, in its frame, by the other."""
        moving = [
            n for n in ("theta", "f") if n in self.experiment.inputs and not self.experiment.inputs[n].is_constant
        ]
        if len(moving) == 2:
            inputs = {n: c for n, c in self.table.inputs.items() if n != "f"}
            what = "theta and f are both recorded and both played in, so that the voltage turns twice"
            yield self._finding("turns twice", ("theta", "f"), what, f"inputs = {toml_table(inputs)}")

    def power(self) -> Iterator[Contradiction]:
        """Yield a power beyond what the machine delivers."""
        size, _ = self._loads(_Mistake())
        if self.about.mva is None or size <= 2.0 * LOADS[1] * self.about.mva:
            return
        what = f"P and Q are {quantity(size, 'MVA')} {self._when}, of a machine of {self.about.mva:g} MVA"
        near = [
            m for m in self._smaller_units() if all(LOADS[0] <= v / self.about.mva <= LOADS[1] for v in self._loads(m))
        ]
        rows = self._soon()
        if len(near) > 1 and rows is not None:  # the level does not tell whether a small one is right as it is
            near.sort(key=lambda m: self._misfit(rows, m))
        if near:
            yield self._finding("unit", near[0].columns, f"{what}: {near[0].words}", self._columns(near[0].ways))
        else:
            yield self._finding("unit", ("P", "Q"), f"{what}: what is their unit?")

    def _smaller_units(self) -> Iterator[_Mistake]:
        """Yield the ways in which P and Q, or one of them, are in a smaller unit than the model's: both first."""
        for group in self._groups():
            for k, prefix in ((1e-3, "k"), (1e-6, "")):
                units = " and ".join(self.study.model.outputs[o].unit.replace("M", prefix) for o in group)
                are = "they are" if len(group) > 1 else f"{group[0]} is"
                yield _Mistake("unit", f"{are} in {units}", dict.fromkeys(group, k))

    def _groups(self) -> list[list[str]]:
        """Return the recorded powers: both, and each of them."""
        powers = [o for o in LEVELS.values() if o in self.experiment.outputs]
        return [powers, *([o] for o in powers if len(powers) > 1)]

    def _loads(self, mistake: _Mistake) -> tuple[float, float]:
        """Return the apparent power before the event without a mistake of the record, and that of the columns it is about, MVA."""
        levels = {o: mistake.of(o) * (self._output_level(o) or 0.0) for o in self._groups()[0]}
        return math.hypot(*levels.values()), math.hypot(*(levels[o] for o in mistake.columns))

    def current(self) -> Iterator[Contradiction]:
        """Yield a power that is another one than the recorded voltage and current make."""
        power = self._beside_current()
        if power is None or power.holds:
            return
        what = f"P and Q are {power.words} before the event"
        if power.level_holds:
            what = f"P and Q move otherwise than {power.named}: these leave {100 * power.left:.3g} % of the square of the movement"
            yield self._finding("current", ("P", "Q"), f"{what}; one of them is another plant's")
            return
        ways = [(3.0, "phase", "they are those of one phase")]
        ways += [(k, "unit", f"they are in {u}W and {u}var") for k, u in ((1e-3, "k"), (1e-6, ""), (1e3, "G"))]
        near = [w for w in ways if power.times(w[0]).level_holds]
        if len(near) == 1:
            ((k, kind, words),) = near
            powers = {o: Way(k) for o in LEVELS.values() if o in self.experiment.outputs}
            yield self._finding(kind, tuple(powers), f"{what}: {words}", self._columns(powers))
        else:
            yield self._finding("current", ("P", "Q"), f"{what}: which of them is in another unit, or another plant's?")

    def angles(self) -> Iterator[Contradiction]:
        """Yield an angle that is the current's, where the file's only angle of a current is that of the voltage."""
        e, outputs = self.experiment, list(LEVELS.values())
        if "theta" not in e.inputs or not set(outputs) <= set(e.outputs):
            return
        column, data = self._column("theta"), self._file
        readings = self._readings
        currents = self._columns_of("current angle")
        if column not in data or len(currents) != 1:
            return
        (current,) = currents
        line = self.table.columns.get("theta")
        played = (line.unit if line and line.unit else "") or data.unit(column) or readings[column].unit or "rad"
        units = [played, data.unit(current) or readings[current].unit]
        by = [conversion(u, "rad") if u else None for u in units]
        if by[0] is None or by[1] is None or data.time.size != e.time.size or e.measured is None:
            return
        power = e.measured[outputs[0]] + 1j * e.measured[outputs[1]]
        rows = before_event(e.time, np.abs(power), e.event)
        if exchanged(power[rows], (by[0][0] * data[column] - by[1][0] * data[current])[rows]):
            what = f"{column} and {current} are exchanged, or Q has the other sign: they turn the power the other way"
            yield self._finding(
                "exchanged", ("theta",), what, f"inputs = {toml_table(self.table.inputs | {'theta': current})}"
            )

    def turn(self) -> Iterator[Contradiction]:
        """Yield an angle that turns otherwise than the recorded frequency of the same voltage, or as no network does."""
        if "theta" not in self.experiment.inputs:
            return
        signal = self.experiment.inputs["theta"]
        agreed = self._beside_frequency()
        if agreed is not None and not agreed.holds:
            factors = [
                (-1.0, "its sign is the other one"),
                (DEGREE, "it is in degrees"),
                (-DEGREE, "it is in degrees, with the other sign"),
            ]
            times = agreed.factor or 0.0
            fits = [(k, words) for k, words in factors if replace(agreed, factor=k * times).turns_alike]
            words = f": {fits[0][1]}" if fits else ""
            write = self._columns({"theta": Way(fits[0][0])}) if fits else ""
            yield self._finding(
                "turn", ("theta",), f"theta and the recorded frequency: {agreement_words(agreed)}{words}", write
            )
            return
        rate, limit = fastest(signal.times, signal.values), FASTEST * self.about.frequency
        if rate > limit:
            degrees = fastest(signal.times, DEGREE * signal.values) <= limit
            what = f"theta turns by up to {rate:.3g} Hz over a tenth of a second, as no network does"
            write = self._columns({"theta": Way(DEGREE)}) if degrees else ""
            yield self._finding("unit", ("theta",), what + (": it is in degrees" if degrees else ""), write)

    def movement(self) -> Iterator[Contradiction]:
        """Yield the mistake without which the model moves as the record does, where as it is it does not."""
        rows = self._soon()
        if rows is None:
            return
        if TIME_SHIFT in self.experiment.nuisance:  # a fit finds their clock
            rows = self._on_time(rows, self._late() or 0.0)
        if (own := self._misfit(rows, _Mistake())) * STRONG <= FOLLOWS:
            return
        righted = [(self._on_time(rows, m.late), m) for m in self._mistakes()]
        tried = [(self._misfit(e, m), m) for e, m in righted if _moves(e)]
        misfit, mistake = min(tried, key=lambda t: t[0], default=(math.inf, _Mistake()))
        if misfit > FOLLOWS or own < STRONG * misfit:
            return
        now = "as it is it cannot start" if math.isinf(own) else f"as it is {100 * own:.3g} %"
        left = f"so the model leaves {100 * misfit:.2g} % of the square of what they move within {SOON:g} s of the event, {now}"
        yield self._finding(
            mistake.kind, mistake.columns, f"{mistake.words}: {left}", mistake.write or self._columns(mistake.ways)
        )

    def _mistakes(self) -> Iterator[_Mistake]:
        """Yield the mistakes of a record that are tried."""
        e, mva = self.experiment, self.about.mva
        powers = [o for o in LEVELS.values() if o in e.outputs]
        if "theta" in e.inputs:
            turns = [
                (-1.0, "sign", "has the other sign: an angle grows where the frequency is above that of the frame"),
                (DEGREE, "unit", "is in degrees"),
                (1.0 / DEGREE, "unit", "is in rad, and not in degrees"),
                (2.0 * math.pi, "unit", "is in whole turns"),
            ]
            yield from (_Mistake(kind, f"theta {words}", {"theta": k}) for k, kind, words in turns)
        for group in self._groups():
            units = [self.study.model.outputs[o].unit for o in group]
            have, are = ("have", "are") if len(group) > 1 else ("has", "is")
            factors = [
                (-1.0, "sign", f"{have} the other sign: the model counts what the plant delivers as positive"),
                (1e-3, "unit", f"{are} in {' and '.join(u.replace('M', 'k') for u in units)}"),
                (1e3, "unit", f"{are} in {' and '.join(u.replace('M', 'G') for u in units)}"),
                (3.0, "phase", f"{are} that of one phase"),
            ]
            factors += [(mva, "base", f"{are} in pu of the machine's {mva:g} MVA")] if mva else []
            yield from (
                _Mistake(k, f"{' and '.join(group)} {words}", dict.fromkeys(group, f)) for f, k, words in factors
            )
        if len(powers) == 2:
            one, other = powers
            named = self.table.outputs | {one: self._column(other), other: self._column(one)}
            write = f"outputs = {toml_table(named)}"
            yield _Mistake(
                "exchanged",
                f"{one} and {other} are exchanged",
                dict.fromkeys(powers, 1.0),
                {one: other, other: one},
                write=write,
            )
        if TIME_SHIFT not in e.nuisance and (late := self._late()) is not None:
            when = f"{abs(late):.4g} s {'later' if late > 0.0 else 'earlier'} than the voltage"
            words = f"{' and '.join(powers)} come {when}, by another clock"
            write = 'nuisance = ["time-shift"]'
            yield _Mistake("clock", words, dict.fromkeys(powers, 1.0), late=late, write=write)

    # --- levels and movements ---

    @cached_property
    def _file(self) -> Trajectory:
        """The recording as its file has it."""
        return read_waveforms(self.study.path.parent / self.table.data)

    @cached_property
    def _readings(self) -> dict[str, Reading]:
        """The readings of the file's columns, by name."""
        names = self._file.names
        return dict(zip(names, read_columns(names, self._file.units), strict=True))

    def _columns_of(self, quantity: str) -> list[str]:
        """Return the columns of the file whose names say a quantity."""
        return [n for n, r in self._readings.items() if r.measured == quantity]

    @property
    def _when(self) -> str:
        return "before the event" if self.experiment.event is not None else "in the first row"

    def _level(self, name: str) -> float | None:
        """Return where an input begins, in the model's unit; None where it is not recorded."""
        signal = self.experiment.inputs.get(name)
        return None if signal is None else float(signal.values[0])

    def _output_level(self, name: str) -> float | None:
        e = self.experiment
        assert e.measured is not None
        values = e.measured[name]
        rows = before_event(e.time, values, e.event)
        known = values[rows] if rows.any() else values[np.isfinite(values)][:1]
        return float(known.mean()) if known.size else None

    def _beside_frequency(self) -> Agreement | None:
        """Return how the angle agrees with the only other column of the file that is a frequency; None where there is none."""
        column = self._column("theta")
        data = self._file
        if column not in data or self.table.phases or self.table.phasors:
            return None
        readings = self._readings
        others = self._columns_of("frequency")
        if len(others) != 1:
            return None
        (other,) = others
        values, unit = data[other], data.unit(other) or readings[other].unit
        level = float(np.nanmean(values))
        way = frequency_way(unit, bool(data.unit(other)), level, float(np.nanmax(np.abs(values))), self.about)
        if way is None:
            return None
        signal = self.experiment.inputs["theta"]
        time = self.experiment.time
        rows = np.isin(data.time, time) if data.time.size != time.size else np.ones(time.size, dtype=bool)
        return agreement(
            data.time[rows], signal(data.time[rows]), way.scale * values[rows] + way.offset, self.about.frequency
        )

    def _beside_current(self) -> ApparentPower | None:
        """Return the recorded power beside that of the recorded voltage and the only current of the file; None where they are not all
        recorded, in units that are known, or the event is not."""
        e, outputs = self.experiment, list(LEVELS.values())
        if "V" not in e.inputs or not set(outputs) <= set(e.outputs) or self.table.phases or self.table.phasors:
            return None
        data = self._file
        column = self._column("V")
        readings = self._readings
        currents = self._columns_of("current")
        if column not in data or len(currents) != 1 or data.time.size != e.time.size:
            return None
        line = self.table.columns.get("V")
        units = [
            (line.unit if line and line.unit else "") or data.unit(column) or readings[column].unit,
            readings[currents[0]].unit,
        ]
        by = [conversion(u, wanted) if u else None for u, wanted in zip(units, ("kV", "kA"), strict=True)]
        if by[0] is None or by[1] is None:
            return None
        assert e.measured is not None
        power = np.hypot(*(e.measured[o] for o in outputs))
        product = by[0][0] * data[column] * by[1][0] * data[currents[0]]
        return ApparentPower.of(e.time, power, product, e.event, f"{column} and {currents[0]}")

    def _soon(self) -> Experiment | None:
        """Return the experiment to shortly after its event; None where it has none, or P and Q are not recorded."""
        e = self.experiment
        if e.event is None or e.measured is None or not set(LEVELS.values()) & set(e.outputs) or e.drive:
            return None
        rows = e.time <= e.event + SOON
        short = e.with_(time=e.time[rows], measured=e.measured.rows(rows), noise_profile={}, window=None)
        assert short.measured is not None
        return short if before_event(short.time, short.measured.values[:, 0], e.event).sum() > 1 else None

    def _misfit(self, e: Experiment, mistake: _Mistake) -> float:
        """Return the share of the square of the movement of P and Q that the model leaves without a mistake of the record; infinite
        where it cannot run."""
        inputs = dict(e.inputs)
        if (turn := mistake.factors.get("theta", 1.0)) != 1.0:
            s = inputs["theta"]
            inputs["theta"] = InputSignal(s.times, turn * s.values, s.breaks)
        level = {o: n for n, o in LEVELS.items() if n in e.values}
        values = {n: mistake.of(o) * e.values[level.get(mistake.source(o), n)] for o, n in level.items()}
        run = outputs_of(
            ModelSimulator(self.study.model), e.with_(inputs=inputs, values={**e.values, **values}), self.study.given
        )
        if isinstance(run, str):
            return math.inf
        assert e.measured is not None
        left = moved = 0.0
        for o in (o for o in LEVELS.values() if o in e.outputs):
            recorded = mistake.of(o) * e.measured[mistake.source(o)]
            known = np.isfinite(recorded)
            before = before_event(e.time, recorded, e.event)
            own, other = (_from_rest(v, before)[known] for v in (recorded, run[o]))
            left, moved = left + float(np.sum((own - other) ** 2)), moved + float(np.sum(own**2))
        return left / moved if moved and math.isfinite(left) else math.inf

    def _late(self) -> float | None:
        """Return by how many s P and Q come later than the model's, whose movement is then theirs as nearly as it can be; None where
        they move at the same time, or the model cannot run."""
        e = self.experiment
        run = outputs_of(ModelSimulator(self.study.model), e, self.study.given)
        if isinstance(run, str) or e.measured is None:
            return None
        step = float(np.median(np.diff(e.time)))
        grid = np.arange(e.time[0], e.time[-1], step)
        summed: Array = np.zeros(2 * grid.size - 1)
        for o in (o for o in LEVELS.values() if o in e.outputs):
            known = np.isfinite(e.measured[o])
            before = before_event(e.time, e.measured[o], e.event)
            own, other = (np.interp(grid, e.time[known], _from_rest(v, before)[known]) for v in (e.measured[o], run[o]))
            summed = summed + _correlated(own, other)
        late = step * (int(np.argmax(summed)) - (grid.size - 1))
        return late if abs(late) > step else None

    def _on_time(self, rows: Experiment, late: float) -> Experiment:
        """Return some rows of the experiment with the outputs at the time at which they were, whose clock is off by some s."""
        e = self.experiment
        if not late:
            return rows
        assert e.measured is not None and rows.measured is not None
        moved = np.column_stack(
            [np.interp(rows.time + late, e.time[k := np.isfinite(v)], v[k]) for v in e.measured.values.T]
        )
        return rows.with_(measured=replace(rows.measured, values=moved))

    # --- what to write ---

    def _column(self, signal: str) -> str:
        line = self.table.columns.get(signal)
        named = {**self.table.inputs, **self.table.outputs}
        return line.name if line is not None and line.name else named[signal]

    def _columns(self, ways: Mapping[str, Way]) -> str:
        """Return the experiment's `columns` in which the signals are written otherwise: model = scale x what it is now + offset."""
        lines = {n: line.model_dump(by_alias=True, exclude_none=True) for n, line in self.table.columns.items()}
        for name, way in ways.items():
            was = lines.get(name, {})
            line = {k: v for k, v in was.items() if k in ("name", "unit", "turn")}
            scale, offset = self._now(name)
            if "base" in was:
                line |= {"base": rounded(was["base"] / way.scale)}
            elif name == "theta" and way.scale == DEGREE and scale == 1.0:
                line |= {"unit": "deg"}
            else:
                line |= {"scale": rounded(way.scale * scale)}
            if moved := way.scale * offset + way.offset:
                line |= {"offset": rounded(moved)}
            lines[name] = line
        return f"columns = {toml_table(lines)}"

    def _now(self, signal: str) -> tuple[float, float]:
        """Return scale and offset with which the experiment was read."""
        line = self.table.columns.get(signal) or schema.ColumnTable()
        offset = line.offset or 0.0
        if line.scale is not None or line.base is not None:
            return (line.scale if line.scale is not None else 1.0 / (line.base or 1.0)), offset
        data, model = self._file, self.study.model
        recorded = line.unit or (data.unit(self._column(signal)) if self._column(signal) in data else "")
        wanted = model.inputs[signal].unit if signal in model.inputs else model.outputs[signal].unit
        by = conversion(recorded, wanted) if recorded else None
        return (1.0, offset) if by is None else (by[0], by[1] + offset)

    def _finding(self, kind: str, columns: tuple[str, ...], what: str, write: str = "") -> Contradiction:
        return Contradiction(kind, f"experiment {self.experiment.name}", what, columns, write=write)


def _moves(e: Experiment) -> bool:
    """Return whether P and Q move by more than their noise."""
    moved = noise = 0.0
    for o in (o for o in LEVELS.values() if o in e.outputs):
        assert e.measured is not None
        known = np.isfinite(e.measured[o])
        values = e.measured[o][known]
        if values.size < 4:
            return False
        moved += float(np.ptp(values)) ** 2
        noise += scatter(e.time[known], values) ** 2
    return moved > SEEN**2 * noise


def _correlated(a: Array, b: Array) -> Array:
    """Return the correlation of two signals of n rows at the lags -(n - 1) to n - 1 of a behind b; scipy.signal takes 0.3 s to import."""
    count = 2 * a.size - 1
    size = 1 << (count - 1).bit_length()
    return np.asarray(np.fft.irfft(np.fft.rfft(a, size) * np.fft.rfft(b[::-1], size), size)[:count])


def _from_rest(values: Array, before: NDArray[np.bool_]) -> Array:
    return np.asarray(values - values[before].mean())
