"""Times of samples from sampling rates and time stamps, which may tell of pauses between the samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array

WRAPS = 2.0**16, 2.0**32
"""Numbers of the time stamps that two and four bytes hold: a count that goes on begins again at 0."""

_NAMED = 3  # pauses named in a remark


def placed(rates: Array, stamps: Array, unit: float) -> tuple[Array, tuple[str, ...]]:
    """Return (n,) times in s from the first sample, and remarks on what the time stamps say of them.

    rates: (n - 1,) in Hz of the step to each later sample. stamps: (n,) whole numbers, NaN where there is none; unit: s in 1.

    A step of the stamps agrees with its rate within the larger of half a period and the resolution of the stamps, since two
    stamps that are each rounded or cut off differ by less than that from what they stand for. A longer step is a pause. It
    is kept where the stamps are consistent: every step agrees or is a pause between neighbours, more agree than pause, and
    from pause to pause the stamps keep to the rates within the same bound in sum. Else the rates alone tell the times, and
    a remark says so. Stamps that are all the same say nothing.
    """
    plain = _by_rates(rates)
    known = np.flatnonzero(np.isfinite(stamps))
    if known.size < 2 or np.ptp(stamps[known]) == 0:
        return plain, ()
    counts = np.diff(stamps[known])
    periods, turned = _nearest_periods(rates, unit * counts, known)
    time = np.concatenate([[0.0], np.cumsum(periods)]) if turned else plain
    expected, period = np.diff(time[known]), periods[known[1:] - 1]
    steps = unit * counts
    for wrap in WRAPS:
        again = (counts < 0) & (np.abs(unit * (counts + wrap) - expected) < np.maximum(0.5 * period, unit))
        steps = np.where(again, unit * (counts + wrap), steps)
    for resolution in (unit, unit * _common_divisor(counts)):
        rounded = _rounded_periods(steps, expected, period, unit) if resolution == unit else np.zeros(steps.size, bool)
        pause = _pauses(steps, np.where(rounded, steps, expected), period, resolution)
        if pause is not None and (np.diff(known)[pause] == 1).all():
            late = np.zeros(time.size)
            late[known[1:][pause]] = (steps - expected)[pause]
            time = time + np.cumsum(late)
            return time, _pause_remarks(time, known[1:][pause])
    apart = float(np.max(np.abs(np.cumsum(steps) - (plain[known[1:]] - plain[known[0]]))))
    return plain, (
        f"the time stamps contradict the sampling rates, by up to {apart:.4g} s: the times are those of the rates, "
        f"{plain[-1]:.4g} s from the first sample to the last",
    )


def _pauses(steps: Array, expected: Array, period: Array, resolution: float) -> NDArray[np.bool_] | None:
    """Return (m,) the steps that are pauses; None where the stamps are not consistent. All in s."""
    slack = np.maximum(0.5 * period, resolution) * (1.0 - 1e-9)  # less the rounding of doubles
    excess = steps - expected
    agrees, pause = np.abs(excess) < slack, excess >= slack
    if not (agrees | pause).all() or np.count_nonzero(agrees) <= np.count_nonzero(pause):
        return None
    total = np.cumsum(np.where(agrees, excess, 0.0))
    starts = np.concatenate([[0.0], total[pause]])
    return pause if (np.abs(total - starts[np.cumsum(pause)]) < slack).all() else None


def _common_divisor(counts: Array) -> float:
    """Return the greatest common divisor of the counts: 1000 where stamps in us are whole milliseconds."""
    if np.abs(counts).max() >= 2**53:  # beyond that doubles are not whole numbers one by one
        return 1.0
    return float(np.gcd.reduce(np.abs(counts).astype(np.int64)))


def _by_rates(rates: Array) -> Array:
    """Return (n,) times in s; at one rate a multiple of the period and not a sum, so that no rounding adds up."""
    if rates.size == 0 or (rates == rates[0]).all():
        return np.arange(rates.size + 1) / (rates[0] if rates.size else 1.0)
    return np.concatenate([[0.0], np.cumsum(1.0 / rates)])


def _nearest_periods(rates: Array, steps: Array, known: NDArray[np.intp]) -> tuple[Array, bool]:
    """Return (n - 1,) the periods in s, and whether one is that of the rate before.

    The step at which the rate changes may take the period before or after: the one that is nearer to the stamps.
    """
    periods = 1.0 / rates
    turned = False
    for i in np.flatnonzero(np.diff(rates)) + 1:
        place = int(np.searchsorted(known, i))
        if place < known.size - 1 and known[place] == i and known[place + 1] == i + 1:
            before, after = 1.0 / rates[i - 1], 1.0 / rates[i]
            if abs(steps[place] - before) < abs(steps[place] - after):
                periods[i], turned = before, True
    return periods, turned


def _rounded_periods(steps: Array, expected: Array, period: Array, unit: float) -> NDArray[np.bool_]:
    """Return (m,) the steps that add up a period rounded to the unit: all of one rate the same, less than one unit off."""
    rounded = np.zeros(steps.size, dtype=bool)
    for p in np.unique(period):
        own = (period == p) & (np.abs(steps - expected) < unit)
        rounded[own] = bool(own.any()) and np.ptp(steps[own]) < 0.5 * unit
    return rounded


def _pause_remarks(time: Array, rows: NDArray[np.intp]) -> tuple[str, ...]:
    """Return the remark on the pauses before the rows, none without pauses."""
    if not rows.size:
        return ()
    named = [f"{time[r] - time[r - 1]:.4g} s after {time[r - 1]:.6g} s" for r in rows[:_NAMED]]
    more = f" and {rows.size - _NAMED} more" if rows.size > _NAMED else ""
    pauses = "a pause in the recording, kept" if rows.size == 1 else f"{rows.size} pauses in the recording, kept"
    return (f"the time stamps show {pauses}: {', '.join(named)}{more}; nothing is known of what happened there",)
