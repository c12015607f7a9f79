"""Input signals: piecewise linear with jumps, and the ones that tests are made of."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hvdc_ident.data.trajectory import Array
from hvdc_ident.errors import WaveformError
from hvdc_ident.immutable import FrozenMap

Interpolation = Literal["hold", "linear"]

HOLD_SHARE = 0.9
"""Share of successive equal rows from which a signal is taken to hold its value between rows."""
JUMP_RATIO = 20.0
"""A change over so many times the median nonzero change is a jump."""
MERGE_TOLERANCE = 1e-9
"""Rows this close to the line through their neighbours, as a share of the range, are merged into it."""
CORNER_TOLERANCE = 1e-4
"""A corner is marked where leaving it out moves the signal by more than this share of its range."""
MAX_CORNERS = 64
"""With more marked corners the signal is curved or noisy, and none of them is a break."""

MAD_TO_STD = 1.482602218505602
"""Standard deviation over median absolute deviation, of a normal distribution."""
FEWEST_MEANS = 3
"""Means from which their scatter is known, if poorly."""
RARE = 1e-4
"""Chance that noise is taken for a change, of a mean."""
DEPARTURE = 6.0
"""A noisy input has left its level when it is so many times its scatter off."""


@dataclass(frozen=True, eq=False)
class InputSignal:
    """A piecewise linear signal with jumps.

    times: (n,) in s, non-decreasing; a time that stands twice is a jump. values: (n,).
    Before the first and after the last point the signal is constant.
    breaks: instants at which an integrator has to stop: jumps and the corners that matter.
    """

    times: Array
    values: Array
    breaks: Array

    def __post_init__(self) -> None:
        for name in ("times", "values", "breaks"):
            array = np.ascontiguousarray(getattr(self, name), dtype=float)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        t = self.times
        if t.ndim != 1 or t.size == 0 or t.shape != self.values.shape:
            raise WaveformError(
                "an input signal's times and values do not fit",
                expected="two vectors of one length, at least 1",
                got=f"shapes {t.shape} and {self.values.shape}",
            )
        if not (np.isfinite(t).all() and np.isfinite(self.values).all()):
            raise WaveformError("an input signal has a time or value that is not finite")
        if (np.diff(t) < 0).any():
            raise WaveformError("an input signal's times go back", expected="non-decreasing times")
        if t.size > 2 and (t[2:] == t[:-2]).any():
            raise WaveformError(
                "an input signal has one time more than twice",
                expected="at most two values at one instant: before and after a jump",
            )

    @classmethod
    def constant(cls, value: float) -> InputSignal:
        """Return a signal that never changes."""
        return cls(np.zeros(1), np.array([float(value)]), np.empty(0))

    @classmethod
    def corners(cls, points: Iterable[tuple[float, float]]) -> InputSignal:
        """Return the signal through (time, value) points joined by lines; two points at one time are a jump. Every point is a break."""
        t, v = np.array(list(points), dtype=float).T
        return cls(t, v, np.unique(t))

    @classmethod
    def step(cls, time: float, before: float, after: float) -> InputSignal:
        """Return a jump from one value to another."""
        return cls.corners([(time, before), (time, after)])

    @classmethod
    def ramp(cls, start: float, before: float, end: float, after: float) -> InputSignal:
        """Return a ramp between two constant values."""
        return cls.corners([(start, before), (end, after)])

    def __call__(self, t: float | Array) -> Array:
        """Return the value at t, after the jump where there is one."""
        return self.at(t)

    def at(self, t: float | Array, *, before_jump: bool = False) -> Array:
        """Return the value at t, before the jump or after it where there is one."""
        t = np.asarray(t, dtype=float)
        index = np.searchsorted(self.times, t, side="left" if before_jump else "right")
        i, j = np.clip(index - 1, 0, None), np.clip(index, None, self.times.size - 1)
        t0, t1 = self.times[i], self.times[j]
        share = np.where(t1 > t0, np.clip((t - t0) / np.where(t1 > t0, t1 - t0, 1.0), 0.0, 1.0), 0.0)
        return np.where(index == 0, self.values[0], self.values[i] + share * (self.values[j] - self.values[i]))

    def stepped(self, by: float, at: float) -> InputSignal:
        """Return the signal with a step added to it at an instant, s."""
        i, j = np.searchsorted(self.times, at, side="left"), np.searchsorted(self.times, at, side="right")
        ends = [self.at(at, before_jump=True), self.at(at) + by]
        times = np.concatenate([self.times[:i], [at, at], self.times[j:]])
        values = np.concatenate([self.values[:i], ends, self.values[j:] + by])
        return InputSignal(times, values, np.union1d(self.breaks, [at]))

    def begun_at(self, level: float) -> InputSignal:
        """Return the signal with another first value: that until its first jump where it holds it, else at its first instant alone."""
        if self.times.size == 1:
            return self
        held = self.times.size > 2 and self.times[1] == self.times[2] and self.values[0] == self.values[1]
        first = 2 if held else 1
        return replace(self, values=np.concatenate([np.full(first, level), self.values[first:]]))

    @property
    def jumps(self) -> Array:
        """(k,) instants at which the value changes at once, s."""
        return np.asarray(self.times[1:][(np.diff(self.times) == 0) & (np.diff(self.values) != 0)])

    @property
    def stops(self) -> Array:
        """(k,) instants at which a step of an integrator has to end, s: the breaks, and every point of a noisy signal.

        A step across corners sees the signal at a few instants between them, and its error is told by those. A signal is noisy where
        its bends change from point to point by more than they are; those of a curve change by less from 6 points in a
        period on.
        """
        bends = off_line(self.times, self.values)
        noisy = bends.size > 2 and np.median(np.abs(np.diff(bends, 2))) > np.median(np.abs(bends))
        return np.unique(np.concatenate([self.breaks, self.times[bends.nonzero()[0] + 1]])) if noisy else self.breaks

    @property
    def is_constant(self) -> bool:
        """True where the signal never changes."""
        return bool((self.values == self.values[0]).all())


def step(before: float, after: float, *, at: float) -> InputSignal:
    """Return the signal that jumps from one value to another at an instant.

    Parameters
    ----------
    before : float
        The value until then, in the input's unit.
    after : float
        The value from then on, in the input's unit.
    at : float
        The instant, s.

    Returns
    -------
    InputSignal
        The signal; called with times in s it gives its values, at the jump the one after it.

    Raises
    ------
    WaveformError
        A number is not finite.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> hi.step(1.0, 1.019, at=0.1)([0.0, 0.1, 0.2]).tolist()
    [1.0, 1.019, 1.019]
    """
    return InputSignal.step(float(at), float(before), float(after))


def ramp(before: float, after: float, *, start: float, end: float) -> InputSignal:
    """Return the signal that moves along a line from one value to another between two instants.

    Parameters
    ----------
    before : float
        The value until `start`, in the input's unit.
    after : float
        The value from `end` on, in the input's unit.
    start : float
        Where the line begins, s.
    end : float
        Where it ends, s; later than `start`.

    Returns
    -------
    InputSignal
        The signal; called with times in s it gives its values.

    Raises
    ------
    WaveformError
        The end is not after the start, or a number is not finite.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> hi.ramp(0.0, 1.0, start=1.0, end=3.0)([0.0, 2.0, 4.0]).tolist()
    [0.0, 0.5, 1.0]
    """
    if not end > start:
        raise WaveformError(
            "a ramp ends before it starts", expected="start < end, in s", got=f"start {start:g}, end {end:g}"
        )
    return InputSignal.ramp(float(start), float(before), float(end), float(after))


def multisine(
    level: float,
    amplitude: float,
    frequencies: Sequence[float] | float,
    *,
    start: float,
    end: float,
    samples: int = 40,
) -> InputSignal:
    """Return sines of one amplitude around a level, from one instant to another; the level before and after.

    Phases are Schroeder's, -pi k (k - 1) / n, which keep the peak of n sines low (Schroeder 1970); the sum is shifted to begin at the
    level.

    Parameters
    ----------
    level : float
        The value around which the sines move, in the input's unit.
    amplitude : float
        Of every sine, in the input's unit.
    frequencies : float or list of float
        Of the sines, in Hz; above 0.
    start : float
        Where they begin, s.
    end : float
        Where they end, s; later than `start`.
    samples : int, default 40
        Points joined by lines in a period of the fastest sine; 40 follow it to 0.3 % of its amplitude.

    Returns
    -------
    InputSignal
        The signal; called with times in s it gives its values.

    Raises
    ------
    WaveformError
        There is no frequency, one is not above 0, or the end is not after the start.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> u = hi.multisine(1.0, 0.01, [2.0, 5.0], start=0.5, end=1.5)
    >>> float(u(0.4)), bool(abs(u(1.0) - 1.0) < 0.04)
    (1.0, True)
    """
    f = np.atleast_1d(np.asarray(frequencies, dtype=float))
    if f.ndim != 1 or not f.size or not (np.isfinite(f) & (f > 0)).all():
        raise WaveformError(
            "a multisine needs frequencies", expected="one or more numbers above 0, in Hz", got=f"{frequencies!r}"
        )
    if not end > start:
        raise WaveformError(
            "a multisine ends before it starts", expected="start < end, in s", got=f"start {start:g}, end {end:g}"
        )
    k = np.arange(1, f.size + 1)
    phase = -np.pi * k * (k - 1) / f.size
    t = np.linspace(start, end, int(np.ceil((end - start) * f.max() * samples)) + 2)
    wave = np.sin(2 * np.pi * f[:, None] * (t - start) + phase[:, None]).sum(axis=0)
    v = level + amplitude * (wave - wave[0])
    points = [(start, level), *zip(t.tolist(), v.tolist(), strict=True), (end, level)]
    # Only where it begins and ends does the signal have a corner that an integrator must not step over.
    times, values = np.array(points).T
    keep = np.concatenate([[True], (np.diff(times) > 0) | (np.diff(values) != 0)])
    return InputSignal(times[keep], values[keep], np.array([start, end], dtype=float))


def input_signal(time: ArrayLike, values: ArrayLike, interpolation: Interpolation | None = None) -> InputSignal:
    """Return the signal recorded by rows, as a piecewise linear one with jumps.

    time: (n,) in s, non-decreasing; two rows at one time are a jump. values: (n,), any unit.
    interpolation: "hold": a value holds from its row until the next, so that a step lies at the first row that shows
    the new value. "linear": joined by lines. None: hold where at least 90 % of successive rows are equal; else linear,
    where a change of over 20 times the median nonzero change is a jump at the new row.
    Rows on one line are merged. Breaks are the jumps and, where they are few, the corners.
    Raises WaveformError for rows that are not finite, go back in time or stand more than twice at one time.
    """
    whole = InputSignal(np.array(time, dtype=float), np.array(values, dtype=float), np.empty(0))
    t, v = whole.times, whole.values
    if interpolation not in (None, "hold", "linear"):
        raise WaveformError("no such interpolation", expected="'hold' or 'linear'", got=f"{interpolation!r}")
    if interpolation == "hold" or (interpolation is None and _holds(v)):
        return _held(t, v)
    jumps = _large_changes(v) if interpolation is None else np.zeros(v.size, dtype=bool)
    return _joined(*_with_jumps(t, v, jumps))


def _holds(v: Array) -> bool:
    return v.size < 2 or float(np.mean(np.diff(v) == 0)) >= HOLD_SHARE


def _held(t: Array, v: Array) -> InputSignal:
    """Return the staircase through the rows; of two rows at one time the second holds."""
    last = np.append(np.diff(t) > 0, True)
    times, after = t[last], v[last]
    before = np.concatenate([v[:1], after[:-1]])
    steps = after != before
    at = times[steps]
    corner_times = np.concatenate([t[:1], np.repeat(at, 2)])
    corner_values = np.concatenate([v[:1], np.column_stack([before[steps], after[steps]]).ravel()])
    if at.size and at[0] == t[0]:  # a jump at the very first row: the start and its own "before" are one point
        corner_times, corner_values = corner_times[1:], corner_values[1:]
    return InputSignal(corner_times, corner_values, at)


def _large_changes(v: Array) -> NDArray[np.bool_]:
    """Return (n,) the rows that show a change of over 20 times the median nonzero one."""
    change = np.abs(np.diff(v, prepend=v[:1]))
    nonzero = change[change > 0]
    return change > (JUMP_RATIO * np.median(nonzero) if nonzero.size else np.inf)


def _with_jumps(t: Array, v: Array, jumps: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return the rows with the value before each jump put in at its instant; no instant more than twice, no row twice."""
    at = np.flatnonzero(jumps)
    t, v = np.insert(t, at, t[at]), np.insert(v, at, v[at - 1])
    new = np.diff(t) > 0
    keep = np.append(True, new) | np.append(new, True)  # first and last row of each instant
    t, v = t[keep], v[keep]
    keep = np.append(True, (np.diff(t) > 0) | (np.diff(v) != 0))
    return t[keep], v[keep]


def _joined(t: Array, v: Array) -> InputSignal:
    """Return the polygon through the rows, rows on one line merged."""
    scale = float(np.ptp(v))
    if scale == 0.0:
        return InputSignal(t[:1], v[:1], np.empty(0))
    double = np.append(np.diff(t) == 0, False)
    fixed = double | np.append(False, double[:-1])
    fixed[[0, -1]] = True
    bent = fixed.copy()
    bent[1:-1] |= np.abs(off_line(t, v)) > MERGE_TOLERANCE * scale
    kept = _simplified(t, v, bent, MERGE_TOLERANCE * scale, t.size)
    marked = _simplified(t, v, fixed, CORNER_TOLERANCE * scale, int(fixed.sum()) + MAX_CORNERS)
    corners = marked & ~fixed
    breaks = t[double] if corners.sum() > MAX_CORNERS else t[double | corners]
    return InputSignal(t[kept], v[kept], np.unique(breaks))


def event_time(inputs: Mapping[str, InputSignal], means: Mapping[str, float] = FrozenMap()) -> float | None:
    """Return the instant of the first change of any input in s; None where none changes.

    Noise of a recorded input is no change: without a break in it, the signal has to leave its first level by six times
    the scatter from point to point. means: by name the length in s of the mean that an input was smoothed by, as what is made of
    phases is: its noise is the same from point to point, and only values so far apart tell how large it is.
    """
    changes = [_mean_leaves(s, means[n]) if n in means else _first_change(s) for n, s in inputs.items()]
    instants = [t for t in changes if t is not None]
    return min(instants) if instants else None


def _mean_leaves(signal: InputSignal, window: float) -> float | None:
    """Return the instant at which a smoothed signal leaves the level it has had, by more than noise does once in ten thousand windows.

    Each mean is held against those before it: a quantile of Student's t, for the noise is known from these few. A mean answers what
    happens with a ramp: the line through once and twice the limit leads back to its begin.
    """
    from scipy.special import stdtrit

    ends = np.arange(signal.times[0] + window, signal.times[-1], window)
    means, floor = signal(ends), MERGE_TOLERANCE * float(np.ptp(signal.values))
    for k in range(FEWEST_MEANS, ends.size):
        level, scatter = float(means[:k].mean()), max(float(means[:k].std(ddof=1)), floor)
        limit = scatter * float(stdtrit(k - 1.0, 1.0 - 0.5 * RARE)) * np.sqrt(1.0 + 1.0 / k)
        if abs(means[k] - level) > limit:
            once, twice = (_first_beyond(signal, level, m * limit, ends[k - 1], window) for m in (1.0, 2.0))
            return once if twice is None or once is None else max(2.0 * once - twice, float(ends[k - 1] - window))
    return None


def _first_beyond(signal: InputSignal, level: float, limit: float, start: float, window: float) -> float | None:
    """The instant within two windows from the start at which a signal is so far from a level; None where it is not."""
    inside = signal.times[(signal.times > start) & (signal.times < start + 2.0 * window)]
    t = np.concatenate([[start], inside, [start + 2.0 * window]])
    off = np.abs(signal(t) - level)
    k = int(np.argmax(off >= limit))
    if off[k] < limit:
        return None
    share = (limit - off[k - 1]) / (off[k] - off[k - 1]) if k and off[k] > off[k - 1] else 1.0
    return float(t[max(k - 1, 0)] + min(max(share, 0.0), 1.0) * (t[k] - t[max(k - 1, 0)]))


def _first_change(signal: InputSignal) -> float | None:
    t, v = signal.times, signal.values
    if signal.is_constant:
        return None
    at_break = np.flatnonzero((np.diff(v) != 0) & np.isin(t[:-1], signal.breaks))
    end = int(at_break[0]) + 1 if at_break.size else t.size
    # Up to the first break a smooth course, a noisy one, or both: what moves there is not quiet because a break follows.
    x = v[:end]
    scatter = robust_std(off_line(*distinct(t[:end], x)))
    level = float(np.median(x[: max(1, min(20, x.size // 10))]))
    away = np.abs(x - level) > max(DEPARTURE * scatter, MERGE_TOLERANCE * float(np.ptp(v)))
    if away.any():
        return float(t[max(0, int(np.argmax(away)) - 1)])
    return float(t[at_break[0]]) if at_break.size else None


def distinct(t: Array, v: Array) -> tuple[Array, Array]:
    """Return the rows with the first of two at one time left out."""
    keep = np.append(np.diff(t) > 0, True)
    return t[keep], v[keep]


def robust_std(x: Array) -> float:
    """Return the standard deviation, from the median absolute deviation where that says anything: not where half the values are equal."""
    if x.size == 0:
        return 0.0
    middle = float(np.median(x))
    by_median = MAD_TO_STD * float(np.median(np.abs(x - middle)))
    return by_median if by_median > 0 else float(np.std(x))


def off_line(t: Array, v: Array) -> Array:
    """Return (n - 2,) how far each inner row lies off the line through its neighbours; 0 beside a jump."""
    width = t[2:] - t[:-2]
    share = (t[1:-1] - t[:-2]) / np.where(width > 0, width, 1.0)
    return np.where(width > 0, v[1:-1] - v[:-2] - share * (v[2:] - v[:-2]), 0.0)


def row_noise(t: Array, v: Array) -> float:
    """Return the standard deviation of a row's white noise, from how far rows lie off the line through their neighbours."""
    return robust_std(off_line(t, v)) / math.sqrt(1.5)


def _simplified(t: Array, v: Array, kept: NDArray[np.bool_], tolerance: float, most: int) -> NDArray[np.bool_]:
    """Return (n,) the rows through which the polygon stays within the tolerance of all rows.

    Starts from `kept` and adds the farthest row of every stretch that is off (Douglas and Peucker 1973), all stretches
    at once; stops when more than `most` rows are kept.
    """
    kept = kept.copy()
    while kept.sum() <= most:
        corners = np.flatnonzero(kept)
        width = np.diff(t[corners])
        slope = np.diff(v[corners]) / np.where(width > 0, width, 1.0)
        stretch = np.cumsum(kept)[:-1] - 1
        start = corners[stretch]
        off = np.abs(v[:-1] - v[start] - slope[stretch] * (t[:-1] - t[start]))
        off[corners[:-1]] = 0.0
        farthest = np.maximum.reduceat(off, corners[:-1])
        candidates = np.flatnonzero((off == farthest[stretch]) & (off > tolerance))
        if candidates.size == 0:
            break
        kept[candidates[np.unique(stretch[candidates], return_index=True)[1]]] = True  # the first of each stretch
    return kept
