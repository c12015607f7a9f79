"""Contradictions in the columns at a plant's terminals: a unit, base or sign that the levels, the turn of the voltage or the movement
after the event speak against, with what to write.

A level or a turn that no network has speaks for itself. Signs, and units of what has no level of its own, show in the first second after
the event: there the model at its given values moves as the plant does, whatever its controls are, where the columns are right.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Contradiction, Experiment, InputSignal, Trajectory, before_event, conversion
from hvdc_ident.data.quantities import read_columns
from hvdc_ident.data.turning import Agreement, agreement, scatter
from hvdc_ident.formats import read_waveforms
from hvdc_ident.model.card import toml_key, toml_string
from hvdc_ident.plants import LEVELS
from hvdc_ident.simulate import ModelSimulator
from hvdc_ident.study import schema
from hvdc_ident.study.conversions import STRONG
from hvdc_ident.study.initial_values import outputs_of
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
    terminals_of,
)
from hvdc_ident.text import quantity

if TYPE_CHECKING:
    from hvdc_ident.study.study import Study

FOLLOWS = 0.5
"""Share of the square of the recorded movement that a model of the plant leaves at most, whose gains may be wrong; one that plays in a
voltage with the wrong sign or unit leaves more than all of it."""
SOON = 1.0
"""Time in s after the event in which network, machine and its inertia tell the movement, before most controls do."""
SEEN = 5.0
"""Times its noise by which a movement is one."""
ROOT = math.sqrt(3.0)


def column_contradictions(study: Study) -> tuple[Contradiction, ...]:
    """Return what contradicts itself in the recordings of a plant that is played back; nothing for another model.

    One finding a cause: where a level is wrong, what follows from it is not told too.
    """
    about = terminals_of(study.model)
    if about is None:
        return ()
    found: list[Contradiction] = []
    tables = {t.name: t for t in study.settings.experiment}
    for e in (e for e in study.experiments if e.name in tables and e.measured is not None):
        case = _Case(study, e, tables[e.name], about)
        by_level = [*case.voltage(), *case.frequency(), *case.turns_twice(), *case.power()]
        by_turn = [] if by_level else [*case.turn()]
        found += by_level or by_turn or [*case.movement()]
    return tuple(found)


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
        if level is None or NORMAL[0] <= level <= NORMAL[1]:
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
            write = ", ".join(f"{toml_key(n)} = {toml_string(c)}" for n, c in inputs.items())
            what = "theta and f are both recorded and both played in, so that the voltage turns twice"
            yield self._finding("turns twice", ("theta", "f"), what, f"inputs = {{{write}}}")

    def power(self) -> Iterator[Contradiction]:
        """Yield a power beyond what the machine delivers."""
        levels = [self._output_level(o) for o in LEVELS.values() if o in self.experiment.outputs]
        size = math.hypot(*(v for v in levels if v is not None))
        if self.about.mva is None or size <= 2.0 * LOADS[1] * self.about.mva:
            return
        near = [(k, u) for k, u in ((1e-3, "k"), (1e-6, "")) if LOADS[0] <= k * size / self.about.mva <= LOADS[1]]
        what = f"P and Q are {quantity(size, 'MVA')} {self._when}, of a machine of {self.about.mva:g} MVA"
        if len(near) == 1:
            k, prefix = near[0]
            ways = {o: Way(k) for o in LEVELS.values() if o in self.experiment.outputs}
            yield self._finding(
                "unit", tuple(ways), f"{what}: they are in {prefix}W and {prefix}var", self._columns(ways)
            )
        else:
            yield self._finding("unit", ("P", "Q"), f"{what}: what is their unit?")

    def turn(self) -> Iterator[Contradiction]:
        """Yield an angle that turns otherwise than the recorded frequency of the same voltage, or as no network does."""
        if "theta" not in self.experiment.inputs:
            return
        signal = self.experiment.inputs["theta"]
        found = self._beside_frequency()
        if found is not None and not found.holds and found.factor is not None:
            factors = [
                (-1.0, "its sign is the other one"),
                (DEGREE, "it is in degrees"),
                (-DEGREE, "it is in degrees, with the other sign"),
            ]
            fits = [(k, words) for k, words in factors if replace(found, factor=k * found.factor).turns_alike]
            words = f": {fits[0][1]}" if fits else ""
            write = self._columns({"theta": Way(fits[0][0])}) if fits else ""
            yield self._finding(
                "turn", ("theta",), f"theta and the recorded frequency: {agreement_words(found)}{words}", write
            )
            return
        rate, limit = fastest(signal.times, signal.values), FASTEST * self.about.frequency
        if rate > limit:
            degrees = fastest(signal.times, DEGREE * signal.values) <= limit
            what = f"theta turns by up to {rate:.3g} Hz over a tenth of a second, as no network does"
            write = self._columns({"theta": Way(DEGREE)}) if degrees else ""
            yield self._finding("unit", ("theta",), what + (": it is in degrees" if degrees else ""), write)

    def movement(self) -> Iterator[Contradiction]:
        """Yield the sign or unit that the model needs to move as the record does, where as it is it does not."""
        rows = self._soon()
        if rows is None or (own := self._misfit(rows)) <= FOLLOWS:
            return
        mva = self.about.mva
        tried: list[tuple[float, float, str, str]] = [
            (1.0, -1.0, "sign", "P and Q have the other sign: the model counts what the plant delivers as positive"),
            (
                -1.0,
                1.0,
                "sign",
                "theta has the other sign: an angle grows where the frequency is above that of the frame",
            ),
            (DEGREE, 1.0, "unit", "theta is in degrees"),
            (1.0 / DEGREE, 1.0, "unit", "theta is in rad, and not in degrees"),
            (1.0, 1e-3, "unit", "P and Q are in kW and kvar"),
            (1.0, 1e3, "unit", "P and Q are in GW and Gvar"),
        ]
        tried += [(1.0, mva, "base", f"P and Q are in pu of the machine's {mva:g} MVA")] if mva else []
        tried = [t for t in tried if t[0] == 1.0 or "theta" in self.experiment.inputs]
        left = [(self._misfit(rows, turn, power), turn, power, kind, words) for turn, power, kind, words in tried]
        misfit, turn, power, kind, words = min(left)
        if misfit > FOLLOWS or own < STRONG * misfit:
            return
        powers = {o: Way(power) for o in LEVELS.values() if o in self.experiment.outputs and power != 1.0}
        ways = {**powers, **({"theta": Way(turn)} if turn != 1.0 else {})}
        now = "as it is it cannot start" if math.isinf(own) else f"as it is {100 * own:.3g} %"
        what = f"{words}: so the model leaves {100 * misfit:.2g} % of the square of what they move within {SOON:g} s of the event, {now}"
        yield self._finding(kind, tuple(ways), what, self._columns(ways))

    # --- levels and movements ---

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
        data: Trajectory = read_waveforms(self.study.path.parent / self.table.data)
        if column not in data or self.table.phases or self.table.phasors:
            return None
        readings = dict(zip(data.names, read_columns(data.names, data.units), strict=True))
        others = [n for n, r in readings.items() if r.measured == "frequency"]
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

    def _soon(self) -> Experiment | None:
        """Return the experiment to shortly after its event; None where it has none, or its outputs do not move by more than noise."""
        e = self.experiment
        if e.event is None or e.measured is None or not set(LEVELS.values()) & set(e.outputs) or e.drive:
            return None
        rows = e.time <= e.event + SOON
        short = e.with_(time=e.time[rows], measured=e.measured.rows(rows), noise_profile={}, window=None)
        assert short.measured is not None
        moved = noise = 0.0
        for o in (o for o in LEVELS.values() if o in e.outputs):
            known = np.isfinite(short.measured[o])
            values = short.measured[o][known]
            if values.size < 4:
                return None
            moved += float(np.ptp(values)) ** 2
            noise += scatter(short.time[known], values) ** 2
        return (
            short
            if moved > SEEN**2 * noise and before_event(short.time, short.measured.values[:, 0], e.event).sum() > 1
            else None
        )

    def _misfit(self, e: Experiment, turn: float = 1.0, power: float = 1.0) -> float:
        """Return the share of the square of the movement of P and Q that the model leaves, with angle and powers times these factors;
        infinite where it cannot run."""
        inputs = dict(e.inputs)
        if turn != 1.0:
            s = inputs["theta"]
            inputs["theta"] = InputSignal(s.times, turn * s.values, s.breaks)
        values = {n: v * power if n in LEVELS else v for n, v in e.values.items()}
        run = outputs_of(ModelSimulator(self.study.model), e.with_(inputs=inputs, values=values), self.study.given)
        if isinstance(run, str):
            return math.inf
        assert e.measured is not None
        left = moved = 0.0
        for o in (o for o in LEVELS.values() if o in e.outputs):
            recorded = power * e.measured[o]
            known = np.isfinite(recorded)
            before = before_event(e.time, recorded, e.event)
            own, other = (_from_rest(v, before)[known] for v in (recorded, run[o]))
            left, moved = left + float(np.sum((own - other) ** 2)), moved + float(np.sum(own**2))
        return left / moved if moved and math.isfinite(left) else math.inf

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
                line |= {"base": float(f"{was['base'] / way.scale:.9g}")}
            elif name == "theta" and way.scale == DEGREE and scale == 1.0:
                line |= {"unit": "deg"}
            else:
                line |= {"scale": float(f"{way.scale * scale:.9g}")}
            if moved := way.scale * offset + way.offset:
                line |= {"offset": float(f"{moved:.9g}")}
            lines[name] = line
        shown = ", ".join(
            f"{toml_key(n)} = {{{', '.join(f'{k} = {toml_string(v) if isinstance(v, str) else repr(v)}' for k, v in line.items())}}}"
            for n, line in lines.items()
        )
        return f"columns = {{{shown}}}"

    def _now(self, signal: str) -> tuple[float, float]:
        """Return scale and offset with which the experiment was read."""
        line = self.table.columns.get(signal) or schema.ColumnTable()
        offset = line.offset or 0.0
        if line.scale is not None or line.base is not None:
            return (line.scale if line.scale is not None else 1.0 / (line.base or 1.0)), offset
        data = read_waveforms(self.study.path.parent / self.table.data)
        model = self.study.model
        recorded = line.unit or (data.unit(self._column(signal)) if self._column(signal) in data else "")
        wanted = model.inputs[signal].unit if signal in model.inputs else model.outputs[signal].unit
        by = conversion(recorded, wanted) if recorded else None
        return (1.0, offset) if by is None else (by[0], by[1] + offset)

    def _finding(self, kind: str, columns: tuple[str, ...], what: str, write: str = "") -> Contradiction:
        return Contradiction(kind, f"experiment {self.experiment.name}", what, columns, write=write)


def _from_rest(values: Array, before: NDArray[np.bool_]) -> Array:
    return np.asarray(values - values[before].mean())
