"""Bad rows of a record: rows that no plant and no meter makes, found from the columns alone, with what they are.

Most of them are told by the noise that a column shows elsewhere: the chance that noise of a standard deviation s, written in steps
of q, repeats a value is q/(sqrt(2 pi) s), the peak of its density, so a stretch that repeats one for long, follows a line to the
last digit, or is exactly zero, has no noise and is no measurement. A column whose noise is below a step of its digits, or that shows
none, as a simulation, a reference or a coarse meter does, is told nothing of by that.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data.noise import ENOUGH, FEWEST_QUIET, noise_estimate, row_scatter
from hvdc_ident.data.signals import HOLD_SHARE, row_noise
from hvdc_ident.data.trajectory import Array, Trajectory

ALARMS = 1e-6
"""Records in which noise alone makes a bad row; the noise's shape is only known about, so that it is far below one in a thousand."""
APART = 8.0
"""Times the largest change from row to row about it that a spike, or a step of an angle, has to be: of normal noise such a row is more
than ten standard deviations off. Of 10 000 rows whose noise has the tails of Student's t with 3 degrees of freedom, one is that far off."""
STILL = 3.0
"""Times its largest change about them that a column may change in rows in which it does not move: of 20 rows of normal noise the next
is larger by that once in a million."""
NEAR = 10
"""Rows on either side by which a change is judged."""
FEWEST = 2 * NEAR
"""Rows of the shortest record that is judged."""
WIDEST = 3
"""Rows of the longest spike: a longer excursion may be a fault that clears."""
MISSED = 4.0
"""Times the longest step of time about it that a gap has to be: one or two lost rows are joined by lines without harm, and of instants
that are random (exponentially distributed) none is that far off in a million."""
_NOISE_ROWS = 5000  # rows from which a column's noise is told
_FEWEST_REPEATED = 3  # steps in a row that are equal, from which a stretch is looked at


@dataclass(frozen=True)
class BadRows:
    """A stretch of rows that cannot be right. kind: "mark", "zeros", "stuck", "saturated", "filled", "repeated", "spike", "angle step",
    "gap" or "constant". columns: those it is about. first, last: indices of rows. what: a sentence without rows and full stop.
    """

    kind: str
    columns: tuple[str, ...]
    first: int
    last: int
    what: str

    @property
    def cuts(self) -> bool:
        """True where nothing that follows the rows belongs to what was before."""
        return self.kind in ("angle step", "gap")

    @property
    def can_be_left_out(self) -> bool:
        """True where the rows alone are wrong: the others are right without them."""
        return not self.cuts and self.kind != "constant"


@dataclass(frozen=True, eq=False)
class _Column:
    """A column of a record. chance: that noise repeats a value, 1 where the column shows no noise above a step of its digits."""

    name: str
    values: Array
    step: float
    noise: float
    same: NDArray[np.bool_] = field(repr=False)

    @classmethod
    def of(cls, name: str, time: Array, values: Array, event: float | None) -> _Column:
        same = np.append(values[1:] == values[:-1], False)
        changes = np.abs(np.diff(values[np.isfinite(values)]))
        changes = changes[changes > 16.0 * np.finfo(float).eps * np.nanmax(np.abs(values), initial=0.0)]
        step = float(changes.min()) if changes.size else 0.0
        return cls(name, values, step, _noise(time, values, same, event) if changes.size else 0.0, same)

    @property
    def chance(self) -> float:
        if not self.step or self.noise < self.step:
            return 1.0
        return self.step / (math.sqrt(2.0 * math.pi) * self.noise)

    @property
    def shows_noise(self) -> bool:
        return self.chance < 1.0

    @property
    def holds(self) -> bool:
        """True of a staircase, as references and positions of taps are, and of a column that does not move."""
        return float(np.mean(self.same[:-1])) >= HOLD_SHARE if self.same.size > 1 else True


def bad_rows(
    time: Array, columns: Mapping[str, Array], event: float | None = None, angles: Mapping[str, float] | None = None
) -> tuple[BadRows, ...]:
    """Return the bad rows of a record, in the order of rows; of no row and column twice.

    time: (n,) s. columns: (n,) each, as recorded, NaN where nothing is or where rows are not asked. event: instant of the first
    disturbance, s. angles: names of those among them that are angles, and a whole turn in their units.
    """
    if time.size < FEWEST:
        return ()
    values = {n: np.array(v, dtype=float) for n, v in columns.items()}
    bad: list[BadRows] = []

    def take(stretches: Iterator[BadRows]) -> None:
        for stretch in stretches:
            bad.append(stretch)
            for name in stretch.columns:
                values[name][stretch.first : stretch.last + 1] = np.nan

    take(_marks(values))
    known = [_Column.of(n, time, v, event) for n, v in values.items() if np.isfinite(v).any()]
    bad += _constant(known, time.size)
    if not has_clock(time):  # a simulation of variable steps may repeat a row as often as it likes
        return tuple(bad)
    noisy = [c for c in known if c.shows_noise]
    for kind in (_zeros, _stuck, _repeated, _filled):
        take(kind([_still(c, values[c.name]) for c in noisy], time.size))
    # A column of a slower rate than its neighbours has no two rows in a row: its changes are not known.
    moving = {c.name: v for c in known if not c.holds and np.isfinite(np.diff(v := values[c.name])).any()}
    take(_spikes(time, moving))
    bad += _angle_steps(moving, {n: turn for n, turn in (angles or {}).items() if n in moving})
    return tuple(sorted(bad, key=lambda b: (b.first, b.last, b.kind)))


def without_bad_rows(record: Trajectory, judged: Iterable[str]) -> Trajectory:
    """Return a record with NaN in place of the rows that cannot be right, as far as the others are right without them.

    judged: names of the columns that were recorded; what is computed has no digits and no noise of its own to be judged by.
    """
    values = record.values.copy()
    for b in bad_rows(record.time, {n: record[n] for n in judged}):
        for name in b.columns if b.can_be_left_out else ():
            values[b.first : b.last + 1, record.names.index(name)] = np.nan
    return replace(record, values=values)


def gaps(time: Array) -> tuple[BadRows, ...]:
    """Return the steps of time that are longer than any about them by far: rows are missing, or the clock jumped."""
    steps = np.diff(time)
    long_steps: list[BadRows] = []
    for k in np.flatnonzero(steps > MISSED * np.median(steps)) if steps.size >= FEWEST else ():
        around = np.concatenate([steps[max(k - NEAR, 0) : k], steps[k + 1 : k + 1 + NEAR]])
        if steps[k] > MISSED * around.max():
            what = f"no rows in {steps[k]:.4g} s, {steps[k] / np.median(around):.3g} steps of time: some are missing, or the clock jumped"
            long_steps.append(BadRows("gap", (), int(k), int(k) + 1, what))
    return tuple(long_steps)


def has_clock(time: Array) -> bool:
    """Return whether rows come at the even steps of a recorder, of which it may miss some: nine of ten are the median's to a tenth."""
    steps = np.diff(time)
    return bool(np.mean(np.abs(steps - np.median(steps)) <= 0.1 * np.median(steps)) > 0.9)


def is_mark(number: float) -> bool:
    """Return whether a number stands for "not recorded": all nines, 999 at least, an end of 16 or 32 bits, or 1e20 and more."""
    digits = f"{abs(number):.10g}".replace(".", "")
    return (len(digits) >= 3 and set(digits) == {"9"}) or abs(number) in _ENDS or abs(number) >= 1e20


_ENDS = {
    2.0**15,
    2.0**15 - 1.0,
    2.0**16 - 1.0,
    2.0**31,
    2.0**31 - 1.0,
    2.0**32 - 1.0,
    999.25,
    9999.25,
    327.67,
    3276.7,
    655.35,
    6553.5,
}


def _still(column: _Column, values: Array) -> _Column:
    """Return the column without the rows that were found, with the noise that it had."""
    return _Column(column.name, values, column.step, column.noise, np.append(values[1:] == values[:-1], False))


def _noise(time: Array, values: Array, same: NDArray[np.bool_], event: float | None) -> float:
    """Return the standard deviation of the noise from row to row, of rows that do not stand still; 0 where none is seen."""
    standing = np.zeros(values.size, dtype=bool)
    for first, last in stretches(same):
        if last - first >= _FEWEST_REPEATED:
            standing[first : last + 2] = True
    rows = np.flatnonzero(np.isfinite(values) & ~standing)[:_NOISE_ROWS]
    if rows.size < FEWEST_QUIET:
        return 0.0
    t, v = time[rows], values[rows]
    scatter = row_scatter(t, v) if rows.size >= ENOUGH else None
    if scatter is not None:
        return scatter
    # Of a record whose event is not known the first rows are asked, which tell of noise only where they are at rest.
    ends = event if event is not None else float(time[min(max(ENOUGH, time.size // 10), time.size - 1)])
    if not noise_estimate(t, v, ends).std:
        return 0.0
    before = t < ends
    return row_noise(t[before], v[before])


def stretches(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first and the last index of each run in which a mask holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _enough(evidence: float, rows: int) -> bool:
    """Return whether a stretch is no chance. evidence: the negative logarithm of that chance at one place; rows: places where it may be."""
    return evidence > math.log(rows / ALARMS)


def _marks(values: Mapping[str, Array]) -> Iterator[BadRows]:
    """Yield the rows with a mark in place of a value, that lies further off the others than they are spread."""
    for name, v in values.items():
        finite = v[np.isfinite(v)]
        marks = [m for m in np.unique(finite).tolist() if is_mark(m)] if finite.size else []
        others = finite[~np.isin(finite, marks)]
        for m in marks:
            if others.size and float(np.abs(others - m).min()) > float(np.ptp(others)):
                for first, last in stretches(np.equal(v, m)):
                    yield BadRows("mark", (name,), first, last, f"{name} is {m:.10g}, a mark of what was not recorded")


def _constant(columns: Sequence[_Column], rows: int) -> list[BadRows]:
    """Return the columns that do not move in any row, to the last of the digits in which another shows noise."""
    digits = [_decimals(c.values) for c in columns if c.shows_noise]
    constant = []
    for c in columns:
        known = c.values[np.isfinite(c.values)]
        if digits and known.size and np.ptp(known) == 0.0 and (known[0] == 0.0 or _decimals(known) >= min(digits)):
            what = f"{c.name} does not move in these {known.size} rows: stuck, or not this unit's"
            constant.append(BadRows("constant", (c.name,), 0, rows - 1, what))
    return constant


def _decimals(values: Array) -> int:
    """Return how many decimals the values are written with."""
    known = values[np.isfinite(values)][:100]
    return max((len(f"{v:.12g}".partition(".")[2]) for v in known.tolist()), default=0)


def _zeros(columns: Sequence[_Column], rows: int) -> Iterator[BadRows]:
    """Yield the rows in which columns with noise are exactly zero."""
    zero = [np.equal(c.values, 0.0) for c in columns]
    some = np.zeros(rows, dtype=bool)
    for z in zero:
        some |= z
    for first, last in stretches(some):
        evidence = {
            c.name: -math.log(c.chance) * float(z[first : last + 1].sum()) for c, z in zip(columns, zero, strict=True)
        }
        names = tuple(n for n, e in evidence.items() if e > 0.0)
        if _enough(sum(evidence.values()), rows):
            yield BadRows(
                "zeros", names, first, last, f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} exactly zero"
            )


def _stuck(columns: Sequence[_Column], rows: int) -> Iterator[BadRows]:
    """Yield the stretches in which columns repeat their value: all of them at once, then each by itself."""
    groups = [columns] if len(columns) > 1 else []
    taken = np.zeros(rows, dtype=bool)
    for group in (*groups, *([c] for c in columns)):
        weight = sum(-math.log(c.chance) for c in group)
        same = np.logical_and.reduce([c.same for c in group]) & ~taken
        for first, last in stretches(same):
            if not _enough(weight * (last - first + 1), rows):
                continue
            names = tuple(c.name for c in group)
            if len(group) > 1:
                taken[first : last + 1] = True
                yield BadRows(
                    "stuck",
                    names,
                    first + 1,
                    last + 1,
                    f"{', '.join(names)} repeat the row before to the last digit: the recorder stands still",
                )
                continue
            yield _standing(group[0], first, last + 1)


def _standing(c: _Column, first: int, last: int) -> BadRows:
    """Return the stretch of one column that repeats its value, saturated where that is the end of its range."""
    value, known = float(c.values[first]), c.values[np.isfinite(c.values)]
    end = "largest" if value >= known.max() else "smallest" if value <= known.min() else ""
    if end:
        return BadRows(
            "saturated",
            (c.name,),
            first,
            last,
            f"{c.name} stands at {value:.6g}, its {end} value, without its noise: a range that is exceeded, or stuck",
        )
    return BadRows(
        "stuck", (c.name,), first, last, f"{c.name} stands at {value:.6g} to the last digit, without its noise: stuck"
    )


def _repeated(columns: Sequence[_Column], rows: int) -> Iterator[BadRows]:
    """Yield the stretches whose rows are those of an earlier stretch, to the last digit."""
    if not columns:
        return
    table = np.column_stack([c.values for c in columns])
    known = np.flatnonzero(np.isfinite(table).all(axis=1))
    if known.size < 2:
        return
    _, inverse = np.unique(table[known], axis=0, return_inverse=True)
    order = np.argsort(inverse.ravel(), kind="stable")
    ranked = inverse.ravel()[order]
    again = np.flatnonzero(ranked[1:] == ranked[:-1])
    back = np.zeros(rows, dtype=int)  # rows back to the last equal one, 0 where there is none
    back[known[order[again + 1]]] = known[order[again + 1]] - known[order[again]]
    weight = sum(-math.log(c.chance) for c in columns)
    names = tuple(c.name for c in columns)
    for distance in np.unique(back[back > 1]).tolist():
        for first, last in stretches(back == distance):
            if _enough(weight * (last - first + 1), rows * rows):
                what = f"these rows are rows {first - distance + 1} to {last - distance + 1} again, to the last digit"
                yield BadRows("repeated", names, first, last, what)


def _filled(columns: Sequence[_Column], rows: int) -> Iterator[BadRows]:
    """Yield the stretches that follow a line within a step of the digits: a gap that was filled."""
    for c in columns:
        off = np.abs(np.diff(c.values, 2))
        chance = min(1.0, 3.0 * c.chance)  # of the three steps about the line
        straight = np.concatenate([[False], off <= 1.01 * c.step, [False]])
        for first, last in stretches(straight) if chance < 1.0 else ():
            if _enough(-math.log(chance) * (last - first + 1), rows):
                yield BadRows(
                    "filled",
                    (c.name,),
                    first,
                    last,
                    f"{c.name} follows a line to the last digit, without its noise: a gap that was filled",
                )


def _about(changes: Array, first: int, last: int) -> float:
    """Return the largest of the changes near some, these left out; 0 where there is none."""
    near = np.concatenate([changes[max(first - NEAR, 0) : first], changes[last + 1 : last + 1 + NEAR]])
    near = near[np.isfinite(near)]
    return float(near.max()) if near.size >= NEAR else math.inf


def _digit(values: Array) -> float:
    changes = np.abs(np.diff(values))
    changes = changes[changes > 0.0]
    return float(changes.min()) if changes.size else 0.0


def _others_still(moving: Mapping[str, Array], name: str, first: int, last: int) -> bool:
    """Return whether another column stays as it is from one change to another, and none moves. first, last: indices of changes."""
    others = [np.abs(np.diff(v)) for n, v in moving.items() if n != name]
    seen = [
        (np.nanmax(c[first : last + 1]), _about(c, first, last))
        for c in others
        if np.isfinite(c[first : last + 1]).all()
    ]
    told = [(change, near) for change, near in seen if math.isfinite(near) and near > 0.0]
    return bool(told) and all(change <= STILL * near for change, near in told)


def _spikes(time: Array, moving: Mapping[str, Array]) -> Iterator[BadRows]:
    """Yield the few rows in which one column alone leaves its course and comes back to it at once."""
    for name, v in moving.items():
        changes, digit, end = np.abs(np.diff(v)), _digit(v), -1
        tall = np.flatnonzero(changes > APART * max(digit, float(np.nanmedian(changes))))
        for k in tall.tolist():  # the change into the spike
            for width in range(1, WIDEST + 1):
                after = k + width + 1
                if k + 1 <= end or after >= v.size or not np.isfinite(v[k : after + 1]).all():
                    continue
                line = np.interp(time[k + 1 : after], time[[k, after]], v[[k, after]])
                off = v[k + 1 : after] - line
                least = float(np.abs(off).min())
                alike = bool((np.sign(off) == np.sign(off[0])).all())
                comes_back = abs(v[after] - v[k]) <= least / STILL
                if (
                    alike
                    and comes_back
                    and least > APART * max(_about(changes, k, after - 1), digit)
                    and _others_still(moving, name, k, after - 1)
                ):
                    end = after - 1
                    many = "its course for one row" if width == 1 else f"its course for {width} rows"
                    yield BadRows(
                        "spike",
                        (name,),
                        k + 1,
                        after - 1,
                        f"{name} leaves {many}, by {off[0]:.4g}, while the other columns do not move: a spike",
                    )


def _angle_steps(moving: Mapping[str, Array], angles: Mapping[str, float]) -> list[BadRows]:
    """Return the rows at which an angle steps while no other column moves. A step by a whole turn is none: a reader takes it out."""
    steps = []
    for name, turn in angles.items():
        v = moving[name]
        slope = float(np.nanmedian(np.diff(v)))
        signed = np.diff(v) - slope
        changes = np.abs(signed)
        limit = APART * max(_digit(v), float(np.nanmedian(changes)))
        for k in np.flatnonzero(changes > limit).tolist():
            off_turn = abs(signed[k] - turn * round(signed[k] / turn))
            if (
                changes[k] > APART * _about(changes, k, k)
                and off_turn > 0.02 * turn
                and _others_still(moving, name, k, min(k + 1, changes.size - 1))
            ):
                what = f"{name} steps by {signed[k]:.4g} while no other column moves: a step of the clock or of its reference"
                steps.append(BadRows("angle step", (name,), k, k + 1, what))
    return steps
