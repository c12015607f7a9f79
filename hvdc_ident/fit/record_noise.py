"""The noise of the records: how large, how correlated from row to row, how coarse, told by what lies before the event.

A fit's own residuals would tell it wrong where an effect is missing: they hold the effect. So the records before the
event decide, less the run of the model, and only where both are at rest: what moves there holds the effect too. Stated
standard deviations stand unless those rows are plainly noisier, and what the records say against them is told.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hvdc_ident.data import Array, Experiment, Trajectory, at_rest, event_time, noise_floor
from hvdc_ident.errors import StudyError
from hvdc_ident.fit.likelihood import QuantisedNoise
from hvdc_ident.fit.noise_colour import TANH, Colour, Likelihood, likelihood, together, without_common
from hvdc_ident.fit.noise_model import AR, autoregression, scatter_of, segments
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.residual import ResidualBlock
from hvdc_ident.immutable import FrozenMap

SURE = 4.0
"""Standard errors beyond which nothing is put down to chance: one in 16 000, where a diagnosis asks some hundred such questions."""
FEWEST = 8
"""Rows before an event from which anything is told of the noise."""
GIVEN = "given"
"""The source of a standard deviation that stands as it was given."""
MOVING = "the records before the event less the model's run, which moves there: at most so much"
"""The source where inputs that are recorded with their noise keep the model moving. What it lacks is in such rows too, so that the
noise is no more; all rows tell more of what it lacks, and no steps from row to row tell of noise that a recorder has smoothed."""
LOUDER, QUIETER = "louder", "quieter"
"""What records before the event are, where they are not as loud as was stated."""
SCATTER_ERROR = 0.9
"""Standard error of the logarithm of the scatter from row to row, times the root of the number of rows (`row_scatter`)."""
ROWS_OF_MOTION = 32
"""Rows in which a motion of 30 times the noise is seen (`at_rest`, by simulation); in 20 it is not."""
SOFT = 1e-6
LONG = 120
"""Rows of a record from which more than one AR coefficient is told."""
COMMON = 0.95
"""Share of what sines of free phase explain that one of common phase must."""
STANDS_OUT = 12.0
"""Its power over that of the rest, as an F value."""
COARSE = 1.0
"""Noise of less than so many steps does not hide the rounding; above, that is white noise of step/sqrt(12) beside it."""
FINEST = 0.1
"""The least noise below a quantiser, in steps, for a model is not exact to less."""
FLICKER = 1.0 / 3.0
"""Standard error of the logarithm of the noise that flicker tells: records stand on few levels (over 103 of 3 x 300 rows)."""
SLOW = 0.5
"""Lag-1 coefficient from which the noise of a rounded record is coloured, and not white noise that flickers."""


@dataclass(frozen=True)
class OutputNoise:
    """The noise of one output. std: in its unit, None where the data are deterministic (the misfit stands in).

    model: its AR coefficients from row to row, () where it is white; error: the standard error of artanh of a single
    one. step: what values are rounded to, 0 for nothing. source: where it comes from, in words. rows: how many before an
    event that are at rest. freedom: degrees of freedom of a standard deviation that is estimated; 0 for one that is stated.
    stated: what was stated, None where nothing was; shown: what the records show of it; contradicted: "louder" or "quieter"
    where they are so beyond chance.
    by_record: by experiment the standard deviation and its degrees of freedom, where the records' own differ beyond chance.
    moving: rows before an event of which nothing is told, for the model or the record is not at rest there.
    """

    std: float | None
    model: AR
    error: float
    step: float
    source: str
    rows: int
    freedom: int = 0
    stated: float | None = None
    shown: float = 0.0
    contradicted: str = ""
    by_record: FrozenMap[tuple[float, int]] = field(default_factory=FrozenMap)
    moving: int = 0

    @property
    def std_error(self) -> float:
        """The relative standard error of the standard deviation; 0 of a stated one."""
        return float(1.0 / np.sqrt(2.0 * self.freedom)) if self.freedom else 0.0

    @property
    def below(self) -> float:
        """The standard deviation of the noise before rounding, in the output's unit; 0 where rounding is all there is."""
        return float(max((self.std or 0.0) ** 2 - self.step**2 / 12.0, 0.0) ** 0.5)

    @property
    def quantised(self) -> QuantisedNoise | None:
        """Quantised noise of the record where its white noise does not hide the steps; else None."""
        coarse = self.step > 0 and self.std is not None and not self.model and self.below < COARSE * self.step
        return QuantisedNoise(self.step, max(self.below, FINEST * self.step)) if coarse else None


def noise_of(
    experiments: Sequence[Experiment], runs: Mapping[str, Mapping[str, Array]] | None = None
) -> FrozenMap[OutputNoise]:
    """The noise of every measured output, from all its records together; AR coefficients from all outputs together.

    runs: by experiment and output the run of the model, (n,) at the experiment's rows; without one a level is taken for it.
    """
    outputs = dict.fromkeys(o for e in experiments for o in e.outputs)
    quiet = {o: _quiet(o, [e for e in experiments if o in e.outputs], runs or {}) for o in outputs}
    short = {o: likelihood(q.records) for o, q in quiet.items() if q.moves and q.even and not q.longer and not q.coarse}
    colours = _colours(quiet, short)
    return FrozenMap({o: _noise(q, colours.get(o, Colour()), short.get(o)) for o, q in quiet.items()})


@dataclass(frozen=True, eq=False)
class Quiet:
    """The records of one output before the events, less line and what they have in common, and what is told of them.

    std: their standard deviation if they were white; moves: whether there is noise in them at all. given: the standard
    deviation told; step: what the whole records are rounded to; rounded: their noise when below that. floor: the least a
    record can hold. scatter: the white noise that all rows show from one to the next, and their number. longer: an AR model
    of several coefficients, where there are rows enough. even: evenly spaced rows. own: by experiment the variance and the number
    of its rows at rest. moving: rows before the events that are not at rest. restless: whether `records` are such rows.
    """

    records: tuple[Array, ...]
    std: float
    moves: bool
    given: float | None
    step: float
    rounded: float
    floor: float
    scatter: tuple[float, int] | None
    longer: AR
    even: bool
    own: Mapping[str, tuple[float, int]]
    moving: int
    restless: bool = False

    @property
    def rows(self) -> int:
        """All of them."""
        return sum(r.size for r in self.records)

    @property
    def coarse(self) -> bool:
        """True where the noise is white and too small to hide the rounding."""
        power = sum(float(r @ r) for r in self.records)
        slow = sum(float(r[1:] @ r[:-1]) for r in self.records) > SLOW * power
        return self.step > 0.0 and self.std < COARSE * self.step and not (self.moves and slow)


def _quiet(output: str, experiments: Sequence[Experiment], runs: Mapping[str, Mapping[str, Array]]) -> Quiet:
    resting = {e.name: _before(e, output, runs.get(e.name, {}).get(output)) for e in experiments}
    before = {name: (t, r) for name, (t, r, _) in resting.items() if r.size}
    scatter = scatter_of([_less(e, output, runs.get(e.name, {}).get(output)) for e in experiments], output)
    restless = not before and scatter is None
    if restless:
        moved = {e.name: _until_event(e, output, runs[e.name].get(output)) for e in experiments if e.name in runs}
        before = {name: (t, without_line(t, r)) for name, (t, r, _) in moved.items() if r.size >= FEWEST}
    quiet = without_tone([t for t, _ in before.values()], [r for _, r in before.values()])
    whole = [e.measured[output][np.isfinite(e.measured[output])] for e in experiments if e.measured is not None]
    step, given, even = _step(whole), _given(output, experiments), _even(experiments)
    rounded = step * float(np.sqrt(1.0 / 12.0 + _dither(whole, step) ** 2)) if step > 0.0 else 0.0
    floor = max((noise_floor(r) for r in whole), default=0.0)
    records = tuple(without_common(quiet) if even else quiet)
    rows, power = sum(r.size for r in records), sum(float(r @ r) for r in records)
    scale = max((float(np.abs(r).max()) for r in whole if r.size), default=1.0)
    std = float(np.sqrt(power / max(rows - 2 * len(records), 1))) if rows else 0.0
    moves = std > 1e-12 * scale and (given is None or std >= 1e-3 * given) and (given is not None or std > floor)
    longer = autoregression(records) if moves and even and rows >= LONG * len(records) else ()
    return Quiet(
        records,
        std,
        moves,
        given,
        step,
        rounded,
        floor,
        scatter,
        longer if len(longer) > 1 else (),
        even,
        {n: (float(r @ r) / (r.size - 2), r.size) for n, r in zip(before, quiet, strict=True)},
        sum(moving for _, _, moving in resting.values()),
        restless and bool(before),
    )


def _less(experiment: Experiment, output: str, run: Array | None) -> Experiment:
    """The experiment with what the model leaves of one output, in which only what it lacks is left of the motion."""
    if run is None or experiment.measured is None:
        return experiment
    left = (experiment.measured[output] - run)[:, None]
    return experiment.with_(measured=Trajectory(experiment.time, left, (output,), (experiment.measured.unit(output),)))


def _colours(quiet: Mapping[str, Quiet], short: Mapping[str, Likelihood]) -> dict[str, Colour]:
    """The AR(1) coefficient of each output: told by the records alone first, then with the standard deviations given."""
    if not short:
        return {}
    alone = dict(zip(short, together(np.array([s.profile for s in short.values()])), strict=True))
    known = {o: quiet[o].given for o in short if alone[o].tanh and _agrees(short[o], quiet[o].given)}
    rows = [s.profile if (g := known.get(o)) is None else s.at(g) for o, s in short.items()]
    sharper = dict(zip(short, together(np.array(rows)), strict=True))
    return {o: sharper[o] if alone[o].tanh and sharper[o].tanh else alone[o] for o in short}


def _agrees(found: Likelihood, given: float | None) -> bool:
    """Return True where a given standard deviation is compatible with the records."""
    return given is not None and _lack(found, given)[0] < SURE**2


def _lack(found: Likelihood, given: float) -> tuple[float, bool]:
    """By how much twice the log-likelihood falls with the standard deviation given, and whether the records are above it."""
    best = np.unravel_index(np.argmax(found.values), found.values.shape)
    return 2.0 * float(found.values.max() - found.at(given).max()), bool(found.std[best[1]] > given)


def _noise(quiet: Quiet, colour: Colour, found: Likelihood | None) -> OutputNoise:
    return replace(_told(quiet, colour, found), stated=quiet.given, moving=quiet.moving)


def _told(quiet: Quiet, colour: Colour, found: Likelihood | None) -> OutputNoise:
    given, rows, step = quiet.given, quiet.rows, quiet.step
    freedom = max(rows - 2 * len(quiet.records), 1)
    std = quiet.std if quiet.moves else 0.0
    if quiet.coarse and (given is None or given < quiet.rounded):
        # A level tells its own flicker only: none in the middle of a step, most at its edge. So all rows are asked.
        return OutputNoise(quiet.rounded, (), 0.0, step, "the resolution of the record and its flicker", rows)
    if quiet.coarse:
        return OutputNoise(given, (), 0.0, step, GIVEN, rows)
    if rows == 0 and quiet.scatter is not None:
        return _from_scatter(quiet, *quiet.scatter)
    if given is None and std <= quiet.floor:
        if step > 0.0:
            return OutputNoise(quiet.rounded, (), 0.0, step, "the resolution of the record and its flicker", rows)
        return OutputNoise(None, (), 0.0, step, "none: the misfit stands in for it", rows)
    model = (colour.rho,) if colour.tanh else quiet.longer
    if colour.tanh and found is not None:
        std = found.best_std(colour.tanh)
    rho = sum(model)
    fresh = max((1.0 - min(rho, 0.99) ** 2) / (1.0 + rho**2), 1.0 / max(rows, 1))
    if given is None:
        own = _by_record(quiet, std, fresh)
        return OutputNoise(
            std, model, colour.error, step, MOVING if quiet.restless else "the records before the event", rows, freedom,
            by_record=FrozenMap(own),
        )  # fmt: skip
    margin = 1.0 + SURE / np.sqrt(2.0 * max(rows, 1) * fresh)
    if colour.tanh and found is not None:
        lack, above = _lack(found, given)
        louder, quieter = above and lack > SURE**2, not above and lack > SURE**2
    else:
        louder, quieter = std > given * margin, bool(rows) and given > std * margin
    if louder:
        source = "the records before the event, noisier than what was given"
        return OutputNoise(std, model, colour.error, step, source, rows, freedom, shown=std, contradicted=LOUDER)
    against = QUIETER if quieter else ""
    return OutputNoise(given, model, colour.error, step, GIVEN, rows, shown=std, contradicted=against)


def _from_scatter(quiet: Quiet, scatter: float, count: int) -> OutputNoise:
    """The noise where no rows before an event tell it: as stated, unless that is plainly less than what all rows show."""
    why = "before an event are at rest" if quiet.moving else "lie before an event"
    freedom = max(int(count / (2.0 * SCATTER_ERROR**2)), 1)
    if quiet.given is None:
        return OutputNoise(scatter, (), 0.0, quiet.step, f"the scatter from row to row, for no rows {why}", 0, freedom)
    # What is not followed from row to row is in the scatter too, as far as its orders agree all the same: three standard errors.
    if scatter > quiet.given * np.exp((SURE + 3.0) * SCATTER_ERROR / np.sqrt(count)):
        source = "the scatter from row to row, more than what was given"
        return OutputNoise(scatter, (), 0.0, quiet.step, source, 0, freedom, shown=scatter, contradicted=LOUDER)
    return OutputNoise(quiet.given, (), 0.0, quiet.step, GIVEN, 0)


def _by_record(quiet: Quiet, std: float, fresh: float) -> dict[str, tuple[float, int]]:
    """By experiment its standard deviation and degrees of freedom, where one of them is not that of all; else nothing.

    std: of all together; fresh: the share of the rows that are independent.
    """
    if quiet.step > 0.0 or len(quiet.own) < 2:
        return {}
    scale = std / quiet.std
    own = {n: (scale * float(np.sqrt(variance)), rows - 2) for n, (variance, rows) in quiet.own.items()}
    differ = any(
        s <= 0.0 or abs(np.log(s / std)) > SURE / np.sqrt(2.0 * max(rows * fresh, 1.0)) for s, rows in own.values()
    )
    return own if differ and all(s > quiet.floor for s, _ in own.values()) else {}


def freedom_of(noise: Mapping[str, OutputNoise], outputs: Iterable[str]) -> float:
    """Degrees of freedom of the noise level of some outputs together; infinite where all of it is stated.

    Source: Satterthwaite, Biometrics Bulletin 2 (1946), for outputs with as many rows each.
    """
    shares = [1.0 / n.freedom if (n := noise[o]).freedom else 0.0 for o in outputs]
    return len(shares) ** 2 / sum(shares) if any(shares) else float("inf")


def _even(experiments: Sequence[Experiment]) -> bool:
    """Return True where the rows are evenly spaced, as an AR model needs."""
    try:
        for e in experiments:
            segments(e.time, e.name)
    except StudyError:
        return False
    return True


def stated_by(experiment: Experiment, output: str) -> float | None:
    """The standard deviation that a record states for an output; None where it was estimated from its rows, or is next to nothing."""
    value = experiment.noise.get(output)
    if value is None or experiment.measured is None or (output in experiment.noise_dof and experiment.domain == "time"):
        return None
    v = experiment.measured[output]
    extent = float(np.nanmax(v) - np.nanmin(v)) if np.isfinite(v).any() else 0.0
    return value if value > 1.001 * SOFT * extent else None


def _given(output: str, experiments: Sequence[Experiment]) -> float | None:
    """The root mean square of the standard deviations stated; None where one is missing or all are next to nothing."""
    found = [stated_by(e, output) for e in experiments]
    if any(n is None or n <= 0 for n in found):
        return None
    whole = [e.measured[output] for e in experiments if e.measured is not None]
    ranges = [float(np.nanmax(v) - np.nanmin(v)) for v in whole if np.isfinite(v).any()]
    value = float(np.sqrt(np.mean([n**2 for n in found if n is not None])))
    return value if value > 1.001 * SOFT * max([*ranges, 0.0]) else None


def without_tone(times: Sequence[Array], records: Sequence[Array]) -> list[Array]:
    """The records less the sine that all of them share at the same times, where there is one: that is no noise.

    times: (n,) s each. A sine of common phase has to hold nearly all that sines of free phase would, and to stand out of
    the rest; noise has no phase in common. A single record is left as it is.
    """
    if len(records) < 2 or min(t.size for t in times) < 3 * FEWEST:
        return list(records)
    span = max(float(np.ptp(t)) for t in times)
    step = min(float(np.median(np.diff(t))) for t in times)
    power = sum(float(r @ r) for r in records)
    rows = sum(r.size for r in records)
    best = (0.0, list(records))
    for f in np.arange(1.5 / span, 0.4 / step, 0.2 / span):
        waves = [np.column_stack([np.cos(2 * np.pi * f * t), np.sin(2 * np.pi * f * t)]) for t in times]
        free = sum(
            float(r @ r - np.linalg.lstsq(w, r, rcond=None)[1].sum()) for w, r in zip(waves, records, strict=True)
        )
        whole = np.vstack(waves)
        c = np.linalg.lstsq(whole, np.concatenate(records), rcond=None)[0]
        left = [r - w @ c for w, r in zip(waves, records, strict=True)]
        shared = power - sum(float(r @ r) for r in left)
        if shared > COMMON * free and shared / 2.0 > STANDS_OUT * (power - shared) / rows and shared > best[0]:
            best = (shared, left)
    return best[1]


def _before(experiment: Experiment, output: str, run: Array | None) -> tuple[Array, Array, int]:
    """The times and rows before the event that are at rest, less the model's run and a line, and how many rows are not.

    run: (n,) of the model at the experiment's rows; None where there is none.
    """
    t, misfit, moved = _until_event(experiment, output, run)
    first = first_at_rest(t, misfit, moved) if t.size else None
    if first is None:
        return t[:0], misfit[:0], t.size if t.size >= FEWEST else 0
    return t[first:], without_line(t[first:], misfit[first:]), first


def _until_event(experiment: Experiment, output: str, run: Array | None) -> tuple[Array, Array, Array]:
    """The times before the event, the rows there less the model's run, and that run; nothing without an event."""
    assert experiment.measured is not None
    event = experiment.event if experiment.event is not None else event_time(experiment.inputs)
    if event is None:
        return np.empty(0), np.empty(0), np.empty(0)
    keep = (experiment.time < event - 1e-12) & np.isfinite(experiment.measured[output])
    t, y = experiment.time[keep], experiment.measured[output][keep]
    moved = np.zeros(t.size) if run is None else run[keep]
    return t, y - moved, moved


def first_at_rest(time: Array, misfit: Array, run: Array) -> int | None:
    """The row from which a record is at rest, and the model too; None where there is none.

    time: (n,) s; misfit: record less run. Where the model moves, what it lacks moves too. All of its motion could be missing:
    it is at rest where even that would change the variance of the misfit by less than the standard error of this variance,
    sqrt(2/n) of it. Of a model that comes to rest the last half, quarter and so on are asked, for the plant may come to rest later
    as far as there are rows enough to see that.
    """
    first, least = 0, FEWEST
    while time.size - first >= least:
        rest, motion = without_line(time[first:], misfit[first:]), run[first:] - run[first:].mean()
        if motion @ motion <= np.sqrt(2.0 / rest.size) * (rest @ rest):
            return first if at_rest(rest) else None
        first, least = first + (time.size - first + 1) // 2, ROWS_OF_MOTION
    return None


def without_line(t: Array, v: Array) -> Array:
    """The values less the straight line that fits them best."""
    x = t - t.mean()
    power = float(x @ x)
    rest = v - v.mean()
    return np.asarray(rest - x * (float(x @ rest) / power if power else 0.0))


def _step(records: Sequence[Array]) -> float:
    """Resolution to which the records are rounded; 0 where they are not."""
    steps = []
    for r in records:
        floor = noise_floor(r) if r.size else 0.0
        if r.size and floor > 1.001 * SOFT * float(np.ptp(r)):
            steps.append(float(floor * np.sqrt(12.0)))
    return max(steps, default=0.0)


def _dither(records: Sequence[Array], step: float) -> float:
    """The standard deviation of white noise below a quantiser, in its steps, from how much the records flicker.

    Noise of sigma steps makes rounded values scatter by sigma/sqrt(pi) (variance, averaged over where the level lies
    between two steps) while it is below a third of a step, and by sigma^2 + 1/12 above.
    """
    bends = np.concatenate([(r[2:] - 2.0 * r[1:-1] + r[:-2]) / step for r in records if r.size > 2] or [np.zeros(1)])
    power = np.sort(bends**2)
    scatter = float(power[: max(1, int(0.98 * power.size))].mean()) / 6.0  # the largest are the events
    low = scatter * float(np.sqrt(np.pi))
    return low if low < 1.0 / 3.0 else float(np.sqrt(max(scatter - 1.0 / 12.0, 0.0)))


def draws(
    problem: Problem,
    blocks: Sequence[ResidualBlock],
    noise: FrozenMap[OutputNoise],
    fitted: Sequence[Array],
    count: int,
    seed: int,
) -> list[Array]:
    """For each block (m, count) records of nothing but noise, weighted and whitened as the residuals are.

    fitted: the model's output at each block's rows, in its unit: rounding depends on it. A single AR coefficient is
    drawn too, within its error, and so is a standard deviation that is estimated, of a record by itself where the records
    differ, and the size of the noise below a quantiser: what is not known of the noise widens what noise can do. Where the
    standard deviation is not given it goes with the coefficient, for the steps from row to row are what is sure.
    """
    times = {e.name: e.time for e in problem.fitted_experiments}
    outputs = list(dict.fromkeys(b.output for b in blocks))
    found: list[Array] = []
    for k, (b, y) in enumerate(zip(blocks, fitted, strict=True)):
        n = noise[b.output]
        random = np.random.default_rng([seed, 1, k])
        model = np.repeat(np.array(n.model)[:, None], count, axis=1)
        if len(n.model) == 1:  # one draw an output: its records share the noise
            spread = np.random.default_rng([seed, 2, outputs.index(b.output)]).standard_normal(count)
            model = np.tanh(np.clip(np.arctanh(model) + n.error * spread, TANH[0], TANH[-1]))
        e = _coloured(random.standard_normal((y.size, count)), model)
        if len(n.model) == 1 and n.source != GIVEN:
            e *= np.sqrt((1.0 - n.model[0] ** 2) / (1.0 - model[0] ** 2))
        if n.freedom:
            own = n.by_record.get(b.experiment)
            freedom, which = (n.freedom, ()) if own is None else (own[1], (k,))
            spread = np.random.default_rng([seed, 4, outputs.index(b.output), *which]).chisquare(freedom, count)
            e *= np.sqrt(freedom / spread)
        if n.step:
            size = n.below * np.ones(count)
            if n.quantised is not None:
                spread = np.random.default_rng([seed, 3, outputs.index(b.output)]).standard_normal(count)
                size = size * np.exp(FLICKER * spread)
            placed = y[:, None] + n.step * random.uniform(-0.5, 0.5, count)
            e = np.round((placed + size * e) / n.step) * n.step - placed
            quantised = problem.treatment.quantised(b.output)
            if quantised is not None and b.profile is None:
                found.append(quantised.residual(e)[0])
                continue
            e = b.scaled(e)
        found.append(problem.treatment.applied(e, times[b.experiment][b.rows], b.output, b.experiment))
    return found


def _coloured(white: Array, model: Array) -> Array:
    """(m, count) stationary AR noise of variance 1; model: (p, count) coefficients."""
    p = model.shape[0]
    if not p:
        return white
    settle = 200
    lead = np.random.default_rng(0).standard_normal((settle, white.shape[1]))
    e = np.vstack([lead, white])
    for k in range(p, e.shape[0]):
        for lag in range(p):
            e[k] += model[lag] * e[k - 1 - lag]
    kept = e[settle:]
    if p == 1:
        return np.asarray(kept * np.sqrt(1.0 - model[0] ** 2))
    return np.asarray(kept / np.sqrt(np.mean(kept**2)))
