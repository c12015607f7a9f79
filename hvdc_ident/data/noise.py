"""Noise that a record shows by itself: how large it is, how correlated, how coarse, and how well that is known.

The rows before an event show the noise where they are at rest; all rows do where they follow the signal closely. What the run
of a model or the residual of a fit says beside that is in `fit.noise`, which builds on this module.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hvdc_ident.data.level_steps import without_steps
from hvdc_ident.data.rounding import RoundedNoise, distinct_levels, flicker_of, resolution, rounded_noise
from hvdc_ident.data.signals import distinct, robust_std
from hvdc_ident.data.trajectory import Array, is_even

ESTIMATED = "estimated before the event"
SCATTER = "estimated from row to row"
ROUNDED = "estimated from the rounding"

FLOOR_SHARE = 1e-6
"""Smallest noise that is assumed, as a share of the range."""
FEWEST_QUIET = 8
"""Rows before an event from which the noise of a record is estimated: its standard deviation is then known to 30 %."""
ENOUGH = 32
"""Rows in which a motion of 30 times the noise is seen (`at_rest`; in 20 it is not), and in which the orders of `row_scatter` say
something: in fewer any two agree within a factor of 1.6. Both by simulation."""
OUTLYING = 1e-2
"""Chance that normal noise has a row that is taken for an outlier; of 250 rows the standard deviation is then 4 % too small."""
TANH = np.linspace(-0.55, 3.0, 72)
"""artanh of the lag-1 coefficients that are estimated: from -0.5 to 0.995, beyond which the rows do not tell the standard deviation."""
RHO = np.tanh(TANH)
COLOURED = 1.645
"""Standard errors that a coefficient lies off 0 if it is one (5 %, one-sided)."""

_ANY = np.tanh(np.linspace(-0.5, 3.5, 21))  # lag-1 coefficients of noise that a motion is compared with, to 0.998
_WHITE = np.concatenate([[0.0], np.geomspace(1e-2, 1e2, 9)])  # white noise beside that of first order, in its variances
_BENDS = np.concatenate(
    [[0.0], np.geomspace(1e-8, 1e4, 25)]
)  # variance of a motion's second differences, to white noise
_LIKELIER = math.log(1000.0)  # of two likelihoods
_LONGEST = 1000  # rows in which a motion is looked for, the last of a longer record: tens of milliseconds
_PIECE = 500  # rows of a record that are taken as one in a likelihood
_SPREADS = 0.0, 0.1, 0.2, 0.4, 0.8, 1.6  # of artanh(rho) among outputs that are told together, as a standard deviation
_SCATTER_ERROR = 0.9  # standard error of the logarithm of `row_scatter`, times the root of the number of rows
_SMOOTH = 0.05  # see `is_smooth`
_SLOW = 0.5  # lag-1 coefficient from which the noise of a rounded record is coloured, and not white noise that flickers


@dataclass(frozen=True)
class NoiseEstimate:
    """The noise that a record shows by itself.

    std: standard deviation, in the record's unit; 0 where it shows none. freedom: its degrees of freedom. source: which rows
    tell of it, in words: `ESTIMATED`, `SCATTER`, `ROUNDED`; "" where no rows do.
    """

    std: float = 0.0
    freedom: float = 0.0
    source: str = ""


@dataclass(frozen=True)
class InputNoise:
    """The noise of a recorded input, in its unit.

    std: standard deviation of each row. before: of the rows before the event by themselves, common: of the error that all of those
    have in common, as rows have that are rounded to one step.
    """

    std: float
    before: float
    common: float = 0.0

    @property
    def any(self) -> bool:
        """True where there is some."""
        return max(self.std, self.before, self.common) > 0.0


@dataclass(frozen=True, eq=False)
class QuietRows:
    """The rows of a record before its event that are at rest.

    rows: (n,) their indices; values: (n,) less their straight line, in the record's unit, outliers left out of both. moving:
    number of rows before the event of which nothing is told, for they move.
    """

    rows: NDArray[np.intp]
    values: Array
    moving: int


def noise_estimate(time: ArrayLike, values: ArrayLike, event: float | None) -> NoiseEstimate:
    """Return the noise that a record shows before its event, or from row to row where no rows there are at rest.

    time: (n,) in s. values: (n,), NaN where not recorded. event: instant of the first disturbance in s; None where there
    is none. A record that is smooth, or rounded and still, shows none. Where no rows tell of noise the source is "".
    """
    t, v = np.asarray(time, dtype=float), np.asarray(values, dtype=float)
    quiet = quiet_rows(t, v, event)
    if not quiet.rows.size:
        scatter = row_scatter(t, v)
        if scatter is not None:
            return NoiseEstimate(scatter, freedom_of_scatter(v), SCATTER)
        before = before_event(t, v, event)
        return NoiseEstimate(source=SCATTER if is_smooth(t[before], v[before]) else "")
    step, records = resolution(v), [quiet.values]
    if is_coarse(records, step):
        flicker = flicker_of([v], step)
        if flicker == 0.0 and not np.any(quiet.values):
            return NoiseEstimate(source=ROUNDED)
        below = below_rounding(records, step, flicker)
        return NoiseEstimate(below.std, below.freedom, ROUNDED)
    if white_std(records) <= noise_floor(v):
        return NoiseEstimate(source=ESTIMATED)
    if not is_even(t):
        return NoiseEstimate(white_std(records), quiet.rows.size - 2.0, ESTIMATED)
    std, freedom = FirstOrder.of(records).level
    # Noise slower than any that is compared has its own scatter at least: a line and correlation hide some of it, and add none.
    return NoiseEstimate(max(std, white_std(records)), freedom, ESTIMATED)


def noise_before(time: Array, values: Array, event: float | None) -> NoiseEstimate:
    """Return the noise of an output as its recorded rows tell it; of source "" where too few lie before the event, and a fit's residual
    has to tell.

    time, values, event: as for `noise_estimate`.
    """
    known = np.isfinite(values)
    t, v = time[known], values[known]
    if int(before_event(t, v, event).sum()) < FEWEST_QUIET:
        return NoiseEstimate()
    # A column that does not move has no scatter to measure others by.
    return noise_estimate(t, v, event) if np.ptp(v) else NoiseEstimate(source=ESTIMATED)


def input_noise(time: ArrayLike, values: ArrayLike, event: float | None) -> InputNoise:
    """Return the noise that the record of an input shows, as `noise_estimate` finds it."""
    estimate, v = noise_estimate(time, values, event), np.asarray(values, dtype=float)
    if estimate.source != ROUNDED:
        return InputNoise(estimate.std, estimate.std)
    step = resolution(v)
    below = math.sqrt(max(estimate.std**2 - step**2 / 12.0, 0.0))
    return InputNoise(math.hypot(step / math.sqrt(12.0), below), below, step / math.sqrt(12.0))


def before_event(time: Array, values: Array, event: float | None) -> NDArray[np.bool_]:
    """Return (n,) which rows show the record before its event: recorded, and of two rows at one time the second; none without one.

    A row within a billionth of the record's length of the event lies on it.
    """
    if event is None or not time.size:
        return np.zeros(time.size, dtype=bool)
    single = np.append(np.diff(time) > 0, True)
    return np.asarray(single & np.isfinite(values) & (time < event - 1e-9 * (time[-1] - time[0])))


def quiet_rows(
    time: Array, values: Array, event: float | None, run: Array | None = None, profile: Array | None = None
) -> QuietRows:
    """Return the rows before the event that are at rest, less the model's run and a line; at least 8 of them, or none.

    run: (n,) of the model at all rows; None where there is none. profile: (n,) the standard deviation of each row over that of
    the record, where rows differ; values are then divided by it. Where the model moves, what it lacks moves too. All of its motion
    could be missing: it is at rest where even that would change the variance of the rows by less than the standard error of this
    variance, sqrt(2/n) of it. Of a model that comes to rest the last half, quarter and so on are asked, for the plant may come to
    rest later, as far as there are rows enough to see that.
    """
    rows = np.flatnonzero(before_event(time, values, event))
    moves = np.zeros(time.size) if run is None else run
    size = np.ones(time.size) if profile is None else profile
    first, least, known, step = 0, FEWEST_QUIET, noise_floor(values), resolution(values)
    while rows.size - first >= least:
        own = rows[first:]
        floor = max(known, _least_gap(values[own]) / math.sqrt(12.0)) if step == 0.0 else known
        rest, near = without_line(time[own], values[own] - moves[own], size[own], floor)
        motion = (moves[own] - moves[own].mean()) / size[own]
        if motion @ motion <= math.sqrt(2.0 / rest.size) * (rest @ rest):
            if not at_rest(rest):
                break
            # Only now: steps enough come close to any motion.
            return QuietRows(own[near], without_steps(rest[near], known), first)
        first, least = first + (rows.size - first + 1) // 2, ENOUGH
    none = np.zeros(0, dtype=np.intp)
    return QuietRows(none, np.zeros(0), rows.size if rows.size >= FEWEST_QUIET else 0)


def _least_gap(values: Array) -> float:
    """Return the smallest difference of different values, a step of a rounding that too few rows tell of; 0 of one value."""
    gaps = np.diff(distinct_levels(values))
    return float(gaps.min()) if gaps.size else 0.0


def without_line(
    time: Array, values: Array, size: Array | None = None, floor: float = 0.0
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the values less the straight line that fits them best, over their size, and which are no outliers; both (n,).

    Outliers are left out of the line. A row is one where its distance over the scatter by the median is larger than that of any
    row among n of normal noise by a chance of one in a hundred: a quantile of Student's t with n/2 degrees of freedom, for that
    scatter counts the inner half of the rows (7.6 for 8 rows, 5.0 for 20, 4.3 for 250; simulation agrees, whatever the colour).
    floor: the least scatter there can be, for rounded rows differ by a step.
    """
    from scipy.special import stdtrit  # a simulation does without it

    size = np.ones(values.size) if size is None else size
    limit = float(stdtrit(0.5 * values.size, 1.0 - 0.5 * OUTLYING / values.size))
    rest = (values - np.median(values)) / size
    near = np.ones(values.size, dtype=bool)
    for _ in range(5):
        near = np.abs(rest - np.median(rest)) <= limit * max(robust_std(rest), floor)
        middle, level = time[near].mean(), values[near].mean()
        x = time[near] - middle
        power = float(x @ x)
        slope = float(x @ (values[near] - level)) / power if power else 0.0
        rest = (values - level - slope * (time - middle)) / size
    return np.asarray(rest), near


def white_std(records: Sequence[Array]) -> float:
    """Return the standard deviation of rows that are less a line of each record, as of white noise; 0 for none."""
    power, free = sum(float(r @ r) for r in records), sum(r.size - 2 for r in records)
    return math.sqrt(power / free) if free > 0 else 0.0


def at_rest(values: ArrayLike) -> bool:
    """Return False where a record is a motion with white noise on it rather than noise about a line: its scatter is then no noise.

    values: (n,) rows in their order, evenly sampled, without NaN; of more than 1000 the last count. Two explanations with as
    many parameters are compared by their restricted likelihoods: stationary noise, white and of first order together, about a
    line; and white noise on a smooth course, whose second differences are random (the model behind a smoothing spline). The
    record moves where the second is a thousand times as likely: the ratio is 1 on average under noise, so larger than that once in
    a thousand records at most. Noise of any correlation time keeps below that, for it is rougher from row to row than a motion is.
    Source: Patterson and Thompson, Biometrika 58 (1971); Wahba, J. R. Stat. Soc. B 40 (1978).
    """
    v = np.asarray(values, dtype=float)[-_LONGEST:]
    if v.size < FEWEST_QUIET:
        return True
    line = _line(v.size)
    rest = v - line @ (line.T @ v)
    power = float(rest @ rest)
    # Of white noise the squared steps are twice its variance, within their error; then nothing but white noise is there.
    steps = float(np.sum(np.diff(rest) ** 2)) / 2.0
    if power <= (1e-12 * float(np.abs(v).max())) ** 2 * v.size or power < (1.0 + 2.0 / np.sqrt(v.size)) * steps:
        return True
    noise = max(float(np.max(_of_first_order(rest[:, None], _ANY, white).profile)) for white in _WHITE.tolist())
    return _of_motion(rest) - noise < _LIKELIER


def _of_motion(v: Array) -> float:
    """Return the largest restricted log-likelihood of white noise on a course with random second differences."""
    z = np.diff(v, 2)
    cover = np.ones((3, z.size))  # of the second differences of white noise: 6, -4, 1, by diagonals
    cover[1] = -4.0
    best, first = -np.inf, 0.0
    for k, bends in enumerate(_BENDS):
        cover[0] = 6.0 + bends
        size, solved = _solved(cover, z)
        first = first if k else size
        square = float(z @ solved)
        best = max(best, -0.5 * (z.size * (math.log(square / z.size) + 1.0) + size - first))
    return best


@dataclass(frozen=True)
class Colour:
    """artanh of a lag-1 coefficient, with its standard error; 0 with error 0 is white."""

    tanh: float = 0.0
    error: float = 0.0

    @property
    def rho(self) -> float:
        """The coefficient."""
        return math.tanh(self.tanh)


@dataclass(frozen=True, eq=False)
class FirstOrder:
    """The restricted log-likelihood of first-order noise beside a line in each record, over the coefficients `RHO`, up to a constant.

    free: number of rows less two for each line. size: (G,) log-determinants. square: (G,) sums of squares of the whitened rows, of
    noise whose standard deviation is 1.
    """

    free: int
    size: Array
    square: Array

    @classmethod
    def of(cls, records: Sequence[Array]) -> FirstOrder:
        """Return the likelihood of several records together. records: (n,) each, evenly sampled; shorter than 4 they tell nothing.

        Rows of more than 500 are cut into pieces with a line each.
        """
        pieces = [p for r in records if r.size > 3 for p in np.array_split(r, -(-r.size // _PIECE))]
        whole = cls(0, np.zeros(RHO.size), np.zeros(RHO.size))
        for n in sorted({p.size for p in pieces}):
            part = _of_first_order(np.column_stack([p for p in pieces if p.size == n]), RHO)
            whole = cls(whole.free + part.free, whole.size + part.size, whole.square + part.square)
        return whole

    @property
    def profile(self) -> Array:
        """(G,) the largest log-likelihood over all standard deviations."""
        square = np.maximum(self.square, np.finfo(float).tiny)
        return np.asarray(-0.5 * (self.free * (np.log(square / self.free) + 1.0) + self.size))

    def at(self, std: float) -> Array:
        """(G,) the log-likelihood at a standard deviation."""
        return np.asarray(-0.5 * (2.0 * self.free * math.log(std) + self.size + self.square / std**2))

    @property
    def level(self) -> tuple[float, float]:
        """The standard deviation and its degrees of freedom, where white noise is as likely beforehand as noise of any correlation.

        Of few rows that may be correlated the standard deviation is hardly known: what is possible counts by its likelihood.
        """
        prior = (1.0 - RHO**2) / np.sum(1.0 - RHO**2)
        prior[int(np.argmin(np.abs(RHO)))] += 1.0
        weight = prior * np.exp(self.profile - self.profile.max())
        weight /= weight.sum()
        logs = 0.5 * np.log(self.square / self.free)
        mean = float(weight @ logs)
        return math.exp(mean), 0.5 / (float(weight @ (logs - mean) ** 2) + 0.5 / self.free)

    def std(self, colour: Colour) -> float:
        """The likeliest standard deviation beside a coefficient."""
        return math.sqrt(float(np.interp(colour.tanh, TANH, self.square)) / self.free)


def _of_first_order(records: Array, coefficients: Array, white: float = 0.0) -> FirstOrder:
    """Return the likelihood of noise about a line in records of one length, (n, k). white: the variance of white noise beside it."""
    n, count = records.shape
    rows = np.column_stack([_line(n), records])
    cover = np.empty((2, n))
    sizes, squares = np.empty(coefficients.size), np.empty(coefficients.size)
    for k, rho in enumerate(coefficients.tolist()):
        steps = rows.copy()
        steps[1:] -= rho * rows[:-1]
        # Noise of first order leaves white steps; of white noise they are a moving average, correlated with the next ones.
        cover[0], cover[1] = 1.0 - rho**2 + white * (1.0 + rho**2), -rho * white
        cover[0, 0] = 1.0 + white
        size, solved = _solved(cover, steps)
        square = steps.T @ solved
        slopes = np.linalg.solve(square[:2, :2], square[:2, 2:])
        sizes[k] = count * (size + float(np.linalg.slogdet(square[:2, :2])[1]))
        squares[k] = float(np.trace(square[2:, 2:]) - np.sum(square[:2, 2:] * slopes))
    return FirstOrder(count * (n - 2), sizes, squares)


def common_colours(first_orders: Sequence[FirstOrder], stds: Sequence[float | None] | None = None) -> list[Colour]:
    """Return the coefficient of each output, drawn to what they have in common as far as they agree (empirical Bayes).

    first_orders: by output. stds: standard deviations that are known, which sharpen a coefficient. artanh(rho) of the outputs scatters
    normally about a common one, of which any rho is as likely; by how much is what makes the data likeliest. Each is the mean of
    what is then likely.
    """
    profiles = [
        f.profile if s is None else f.at(s)
        for f, s in zip(first_orders, stds or [None] * len(first_orders), strict=True)
    ]
    likely = np.exp([p - p.max() for p in profiles])
    prior = 1.0 - RHO**2
    best, chosen = -np.inf, likely
    for spread in _SPREADS if len(likely) > 1 else (0.0,):
        about = np.exp(-0.5 * ((TANH[:, None] - TANH[None, :]) / spread) ** 2) if spread else np.eye(TANH.size)
        about /= about.sum(axis=1, keepdims=True)
        seen = likely @ about.T
        evidence = float(prior @ np.prod(seen, axis=0))
        if evidence > best:
            best = evidence
            others = np.array([np.prod(np.delete(seen, k, axis=0), axis=0) for k in range(len(seen))])
            chosen = likely * ((others * prior) @ about)
    chosen = chosen / chosen.sum(axis=1, keepdims=True)
    means = chosen @ TANH
    errors = np.sqrt(np.maximum(chosen @ TANH**2 - means**2, 0.0))
    return [
        Colour(float(m), float(e)) if abs(m) > COLOURED * e else Colour() for m, e in zip(means, errors, strict=True)
    ]


def row_scatter(time: ArrayLike, values: ArrayLike) -> float | None:
    """Return the standard deviation of the white noise that a record shows from row to row, in its unit; None where it does not.

    time: (n,) in s, uneven allowed; values: (n,), NaN where nothing was recorded. The divided differences of second,
    third and fourth order of white noise give the same standard deviation once each is scaled, and so do those of
    every other row; those of a signal do not, for every order sees less of a smooth course and more of one that the
    rows hardly follow, and coloured noise grows with the distance of rows (Moré and Wild 2011, doi
    10.1137/100786125). So they have to agree, within three standard errors of their ratios (0.9/sqrt(n) and, for
    every other row, 1.9/sqrt(n) in the logarithm, by simulation). Below 32 rows such an agreement would say nothing.
    """
    t, v = np.asarray(time, dtype=float), np.asarray(values, dtype=float)
    t, v = distinct(t[np.isfinite(v)], v[np.isfinite(v)])
    if t.size < ENOUGH or np.ptp(v) == 0.0:
        return None
    orders = [robust_std(_difference(t, v, k)) for k in (2, 3, 4)]
    sparse = float(np.mean([robust_std(_difference(t[i::2], v[i::2], 3)) for i in (0, 1)]))
    if min(*orders, sparse) <= noise_floor(v):
        return None
    error = 3.0 / np.sqrt(t.size)
    agree = np.log(max(orders) / min(orders)) <= 0.9 * error and abs(np.log(sparse / orders[0])) <= 1.9 * error
    return orders[0] if agree else None


def is_smooth(time: Array, values: Array) -> bool:
    """Return whether rows, 8 at least, are those of a course without noise: its differences fall from the second order to the fourth.

    Of a sine they fall by 0.29 w^2, w its angle from row to row: it is seen as one from 15 rows in a period on. Of noise, filtered
    once or twice too, they fall to 0.7 and no less.
    """
    if time.size < FEWEST_QUIET:
        return False
    second, fourth = (robust_std(_difference(time, values, order)) for order in (2, 4))
    return fourth <= max(_SMOOTH * second, noise_floor(values))


def freedom_of_scatter(values: ArrayLike) -> float:
    """Return the degrees of freedom of a record's `row_scatter`."""
    return max(float(np.isfinite(values).sum()) / (2.0 * _SCATTER_ERROR**2), 1.0)


def _difference(t: Array, v: Array, order: int) -> Array:
    """Return (n - order,) divided differences, scaled so that white noise of 1 makes a standard deviation of 1."""
    windows = np.lib.stride_tricks.sliding_window_view(t, order + 1)
    gaps = windows[:, :, None] - windows[:, None, :]
    gaps[:, range(order + 1), range(order + 1)] = np.median(np.diff(t))  # leaves the product's scale as it is
    weights = 1.0 / gaps.prod(axis=2)
    weights /= np.linalg.norm(weights, axis=1, keepdims=True)
    return np.asarray((weights * np.lib.stride_tricks.sliding_window_view(v, order + 1)).sum(axis=1))


def noise_floor(values: ArrayLike) -> float:
    """Return the smallest noise to assume of a record, in its unit: 1e-6 of the range, or step/sqrt(12) of rounded values.

    values: (n,), NaN where not recorded.
    """
    v = np.asarray(values, dtype=float)
    v = v[np.isfinite(v)]
    return max(FLOOR_SHARE * float(np.ptp(v)), resolution(v) / math.sqrt(12.0)) if v.size else 0.0


def is_coarse(records: Sequence[Array], step: float) -> bool:
    """Return whether the noise in rows at rest, less their lines, is too small to hide that they are rounded.

    Noise of more than a step hides it, which is then white noise of step/sqrt(12) beside it; slow noise does from that size on, for
    its rows are rounded to several levels in turn.
    """
    return step > 0.0 and white_std(records) < (step if _lag_one(records) <= _SLOW else step / math.sqrt(12.0))


def below_rounding(records: Sequence[Array], step: float, flicker: float) -> RoundedNoise:
    """Return the noise of rows at rest, less their lines, that `is_coarse`. flicker: what all rows tell, in steps."""
    slow = max(_lag_one(records), 0.0)
    return rounded_noise(records, step, flicker, (1.0 - slow) / (1.0 + slow))


def _lag_one(records: Sequence[Array]) -> float:
    """Return the correlation of neighbouring rows; 0 of rows that are all equal."""
    power = sum(float(r @ r) for r in records)
    return sum(float(r[1:] @ r[:-1]) for r in records) / power if power else 0.0


def _line(count: int) -> Array:
    """Return (count, 2) an orthonormal basis of straight lines over evenly spaced rows."""
    return np.asarray(np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, count), 2))[0])


def _solved(cover: Array, rows: Array) -> tuple[float, Array]:
    """Return the log-determinant of a banded covariance (its lower diagonals), and its inverse times rows."""
    from scipy.linalg import cho_solve_banded, cholesky_banded  # a simulation does without it

    factor = cholesky_banded(cover, lower=True, check_finite=False)
    return 2.0 * float(np.sum(np.log(factor[0]))), cho_solve_banded((factor, True), rows, check_finite=False)
