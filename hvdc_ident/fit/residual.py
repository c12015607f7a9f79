"""The residuals of one experiment with their derivatives: weighted, and if asked whitened or turned into a spectrum.

Where a record does not begin at rest, the part that unknown initial states can make good is taken out of the residuals by
variable projection (Golub and Pereyra 1973) with the jacobian of Kaufman (1975): the best start is found by a step from the
steady one, and about it the starts are eliminated. The gradient is exact because it is taken at the best start.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from hvdc_ident.data import GAP, Array, Experiment, Trajectory, segments
from hvdc_ident.errors import SimulationError, StudyError
from hvdc_ident.fit.likelihood import QuantisedNoise
from hvdc_ident.fit.passed_noise import PassedNoise
from hvdc_ident.fit.simulator import TIME_SHIFT, Simulator, observe, states_of
from hvdc_ident.fit.whitening import AR, whitened
from hvdc_ident.immutable import FrozenMap

Band = tuple[float, float]

TELLS = 1e-7
"""Singular value, relative to the largest of columns of length 1, from which a direction counts."""
SQUARABLE = 1e100
"""Residuals and derivatives beyond this leave the range of floats (1e308) once products of two are scaled and summed: no
factorisation of them would end."""
OPEN = 100.0
"""Standard deviation of an output's level before the event, in those of its noise: what is known of the level, the rows tell."""
ROWS_TOGETHER = 3000
"""Rows that are whitened together; what longer records have in common beyond so many is left in them."""


@dataclass(frozen=True, eq=False)
class ResidualBlock:
    """The residuals of one output in one experiment, over its m compared rows; a spectrum has n values instead of m.

    misfit: (m,) measured - simulated, in the output's unit. sigma: standard deviation, in the same unit.
    profile: (m,) the standard deviation of each row over sigma, where rows differ; else None.
    residual: (n,) misfit/(sigma profile), treated; positive where the measurement lies above the model. No unit.
    jacobian: (n, p) d residual/d unknown, so minus the treated sensitivity over sigma.
    rows: (m,) the experiment's rows that are compared.
    taken: number of independent directions that the elimination of unknown initial states has taken out of the experiment's
    blocks, counted in the first of them: chance then leaves so much less in the sum of squares.
    slope: (m,) d residual/d misfit, per unit of the output, where the record is rounded; else None: it is 1/sigma, treated.
    spare: 1 less the mean square of a rounded record's residuals where only noise is left.
    """

    experiment: str
    output: str
    rows: NDArray[np.intp]
    misfit: Array
    sigma: float
    residual: Array
    jacobian: Array
    taken: int = 0
    slope: Array | None = None
    spare: float = 0.0
    profile: Array | None = None

    def scaled(self, values: Array) -> Array:
        """Return values of the compared rows, (m,) or (m, k) in the output's unit, in standard deviations."""
        return per_deviation(values, self.sigma, self.profile)

    @property
    def stretches(self) -> tuple[slice, ...]:
        """Stretches of residuals between which rows are missing; a spectrum is one."""
        if self.residual.size != self.rows.size:
            return (slice(0, self.residual.size),)
        return stretches(self.rows)

    @property
    def rmse(self) -> float:
        """Root mean square of the misfit, in the output's unit."""
        return float(np.sqrt(np.mean(self.misfit**2)))

    def among(self, columns: Sequence[int], width: int) -> ResidualBlock:
        """Return the block with a jacobian of `width` columns, its own at these indices and 0 elsewhere."""
        jacobian = np.zeros((self.residual.size, width))
        jacobian[:, columns] = self.jacobian
        return replace(self, jacobian=jacobian)

    @property
    def squares(self) -> Array:
        """Squared residuals, (n,), of mean 1 under noise: their sums differ from -2 log likelihood by a constant."""
        return np.asarray(self.residual**2 + self.spare)

    @property
    def chi2(self) -> float:
        """Sum of the squares."""
        return float(self.residual @ self.residual) + self.spare * self.residual.size

    @property
    def score(self) -> Array:
        """Score of each row for its level, (n,), of mean 0 under noise also where the level lies askew between two steps."""
        return self.residual if self.slope is None else self.residual * self.slope * self.sigma


def per_deviation(values: Array, sigma: float, profile: Array | None) -> Array:
    """Return values, (m,) or (m, k), over the standard deviation of each row."""
    if profile is None:
        return values / sigma
    return np.asarray(values / (sigma * profile).reshape(-1, *([1] * (values.ndim - 1))))


@dataclass(frozen=True, eq=False)
class Curve:
    """One output of one experiment at the estimates, at all n rows.

    model, measured: (n,) in the output's unit. rows: those compared. sigma: standard deviation of the noise; profile:
    (n,) that of each row over sigma, where rows differ.
    std: (n,) standard deviation of the model's curve from that of the estimates; band: half the width of the 95 % band
    within which a recorded sample is expected. Both None where no estimate has a standard deviation.
    """

    model: Array
    measured: Array
    rows: NDArray[np.intp]
    sigma: float
    std: Array | None
    band: Array | None
    profile: Array | None = None

    @property
    def residual(self) -> Array:
        """Misfit in standard deviations."""
        return per_deviation(self.misfit, self.sigma, None if self.profile is None else self.profile[self.rows])

    @property
    def misfit(self) -> Array:
        """Measured - model over the compared rows."""
        return self.measured[self.rows] - self.model[self.rows]

    @property
    def rmse(self) -> float:
        """Root mean square of the misfit, in the output's unit."""
        return float(np.sqrt(np.mean(self.misfit**2)))


def stretches(rows: NDArray[np.intp]) -> tuple[slice, ...]:
    """Return the stretches of compared rows without a gap; a step over 1.5 median ones is one, as between instants."""
    steps = np.diff(rows)
    if not steps.size or steps.max() == 1:
        return (slice(0, rows.size),)
    ends = [0, *(np.flatnonzero(steps > GAP * np.median(steps)) + 1).tolist(), rows.size]
    return tuple(slice(a, b) for a, b in pairwise(ends))


def compared_rows(experiment: Experiment, output: str, guard: float = 0.0) -> NDArray[np.intp]:
    """Return the rows of an output that are compared: inside the window, with a finite measurement, off the guarded instants.

    guard: s on either side of every break of an input. Raises StudyError where there are none.
    """
    if experiment.measured is None:
        raise StudyError("nothing was measured", where=f"experiment '{experiment.name}'", expected="measured outputs")
    chosen = experiment.compared & np.isfinite(experiment.measured[output])
    if guard > 0:
        for b in {b for signal in experiment.inputs.values() for b in signal.breaks.tolist()}:
            chosen &= np.abs(experiment.time - b) > guard
    rows = np.flatnonzero(chosen)
    if not rows.size:
        raise StudyError(
            f"no row of '{output}' can be compared",
            where=f"experiment '{experiment.name}'",
            expected="finite measurements inside the window, off the guarded instants",
            got=f"window {experiment.window}, guard {guard:g} s",
        )
    return rows


@dataclass(frozen=True, eq=False)
class ComparedRecord:
    """The part of an output's record that is compared with every run: (m,) rows, values in its unit, instants in s.

    whole: whether it is every row. profile: (m,) as in `ResidualBlock`.
    """

    output: str
    rows: NDArray[np.intp]
    values: Array
    time: Array
    whole: bool
    profile: Array | None = None


def compared_records(experiment: Experiment, guard: float = 0.0) -> tuple[ComparedRecord, ...]:
    """Return one record for each measured output.

    guard: as in `compared_rows`. Raises StudyError where an output has no row to compare.
    """
    records = []
    for output in experiment.outputs:
        rows = compared_rows(experiment, output, guard)
        assert experiment.measured is not None
        profile = experiment.noise_profile.get(output)
        records.append(
            ComparedRecord(
                output,
                rows,
                experiment.measured[output][rows],
                experiment.time[rows],
                rows.size == experiment.time.size,
                None if profile is None else profile[rows],
            )
        )
    return tuple(records)


@dataclass(frozen=True, eq=False)
class Comparison:
    """What runs of an experiment are compared with, in two steps: the first of each run by itself, the second of many together.

    records: one for each measured output. sigma: standard deviation by output, in its unit. Of a spectrum residuals are fewer than rows.
    """

    experiment: Experiment
    records: tuple[ComparedRecord, ...]
    sigma: Mapping[str, float]
    treatment: Treatment

    def misfits(self, outputs: Mapping[str, Array]) -> Array:
        """Return (M,) measured - simulated in standard deviations, all compared rows of an output after those of another; of a
        rounded record in its unit.

        outputs: (n,) by output, at the experiment's rows. Raises SimulationError where one grows beyond all bounds.
        """
        there = np.concatenate([outputs[r.output] if r.whole else outputs[r.output][r.rows] for r in self.records])
        misfits = (self._measured - there) / self._deviations
        if not np.abs(misfits).max(initial=0.0) < SQUARABLE:
            for r, part in zip(self.records, self._parts(misfits), strict=True):
                _require_squarable(part, r.output, self.experiment.name)
        return np.asarray(misfits)

    def residuals(self, misfits: Array) -> Array:
        """Return (N, k) the residuals of k runs, as those of `residual_blocks`, from their misfits (M, k)."""
        name, found = self.experiment.name, []
        for r, part in zip(self.records, self._parts(misfits), strict=True):
            quantised = self._quantised(r)
            if quantised is not None:
                found.append(quantised.residual(part)[0])
            else:
                found.append(self.treatment.applied(part, r.time, r.output, f"experiment '{name}'"))
        rows = np.vstack(found)
        if name not in self.treatment.passed:
            return rows
        none = np.empty(0)
        blocks = [
            ResidualBlock(name, r.output, r.rows, none, self.sigma[r.output], none, none, profile=r.profile)
            for r in self.records
        ]
        return whitened_together(rows, blocks, [r.time for r in self.records], self.treatment)

    def _quantised(self, record: ComparedRecord) -> QuantisedNoise | None:
        return self.treatment.quantised(record.output, self.experiment.name) if record.profile is None else None

    def _parts(self, misfits: Array) -> list[Array]:
        """The rows of each record."""
        return np.split(misfits, np.cumsum([r.rows.size for r in self.records])[:-1])

    @cached_property
    def _measured(self) -> Array:
        return np.concatenate([r.values for r in self.records])

    @cached_property
    def _deviations(self) -> Array:
        """(M,) what each misfit is divided by."""
        found = []
        for r in self.records:
            own = np.ones(r.rows.size) if r.profile is None else r.profile
            found.append(own if self._quantised(r) is not None else self.sigma[r.output] * own)
        return np.concatenate(found)


def _require_squarable(scaled: Array, output: str, experiment: str) -> None:
    """Raise SimulationError where an output or its sensitivity, in standard deviations, grows beyond all bounds."""
    if not np.abs(scaled).max(initial=0.0) < SQUARABLE:
        raise SimulationError(
            f"output '{output}' or its sensitivity grows beyond all bounds",
            where=f"experiment '{experiment}'",
            expected=f"below {SQUARABLE:g} standard deviations",
        )


@dataclass(frozen=True)
class Treatment:
    """The steps that turn misfits into residuals.

    whitening: the noise model by output. guard: rows this close to a break of an input are left out, s. band: Hz; given,
    residuals are the misfit's spectrum within it; None, they are samples in time. quantised_noise: by output whose record is
    rounded; its residuals are samples in time and not whitened. passed: by experiment the noise that its inputs pass on, which all its
    outputs are whitened by together; it hides the steps of rounded records.
    """

    whitening: FrozenMap[AR] = field(default_factory=FrozenMap)
    guard: float = 0.0
    band: Band | None = None
    quantised_noise: FrozenMap[QuantisedNoise] = field(default_factory=FrozenMap)
    passed: FrozenMap[PassedNoise] = field(default_factory=FrozenMap)

    def applied(self, signal: Array, time: Array, output: str, where: str) -> Array:
        """Return the signal over the compared instants, (m,) or (m, p), as a residual: (n,) or (n, p)."""
        model = self.whitening.get(output, ())
        if any(model):
            signal = whitened(signal, model, segments(time, where))
        return signal if self.band is None else transformed(signal, time, self.band, where)

    def quantised(self, output: str, experiment: str) -> QuantisedNoise | None:
        """Return the quantised noise of an output; None where there is none, in a spectrum, and where residuals are whitened."""
        if self.band is not None or experiment in self.passed or any(self.whitening.get(output, ())):
            return None
        return self.quantised_noise.get(output)


def residual_blocks(
    simulator: Simulator,
    experiment: Experiment,
    values: Mapping[str, float],
    sensitivities: Sequence[str],
    sigma: Mapping[str, float],
    *,
    nuisance: Mapping[str, float] | None = None,
    treatment: Treatment | None = None,
    derivatives: bool = True,
    eliminated: Sequence[str] = (),
    compared: Sequence[ComparedRecord] | None = None,
) -> tuple[ResidualBlock, ...]:
    """Return one block for each measured output; unknowns are `sensitivities`, then the nuisances in their order.

    sigma: standard deviation by output, in its unit. derivatives: whether jacobians are wanted; else they have no column.
    eliminated: states, given starts by the experiment, that are taken for unknown and eliminated.
    compared: the experiment's records with the treatment's guard, where they are at hand.
    Raises SimulationError where the run fails, StudyError where nothing can be compared.
    """
    treatment = treatment or Treatment()
    wanted = sensitivities if derivatives else ()
    k = len(wanted)
    given = dict(nuisance or {})
    observed = observe(
        simulator,
        experiment,
        values,
        (*wanted, *eliminated),
        given,
        derivatives=derivatives or bool(eliminated),
    )
    blocks, raw = [], []
    for record in compared if compared is not None else compared_records(experiment, treatment.guard):
        output, weight = record.output, sigma[record.output]
        y, dy = observed.values[output], observed.gradient[output]
        misfit = record.values - (y if record.whole else y[record.rows])
        slopes = -(dy if record.whole else dy[record.rows])
        quantised = treatment.quantised(output, experiment.name) if record.profile is None else None
        if quantised is not None:
            residual, slope = quantised.residual(misfit)
            jacobian, spare = slopes * slope[:, None], quantised.spare
        else:
            scaled = per_deviation(np.column_stack([misfit, slopes]), weight, record.profile)
            _require_squarable(scaled, output, experiment.name)
            treated = treatment.applied(scaled, record.time, output, f"experiment '{experiment.name}'")
            residual, jacobian, slope, spare = np.ascontiguousarray(treated[:, 0]), treated[:, 1:], None, 0.0
        block = ResidualBlock(
            experiment.name, output, record.rows, misfit, weight, residual, jacobian, slope=slope, spare=spare,
            profile=record.profile,
        )  # fmt: skip
        blocks.append(block)
        raw.append(slopes[:, k : k + len(eliminated)])
    if experiment.name in treatment.passed:
        blocks = _whitened_together(blocks, [experiment.time[b.rows] for b in blocks], treatment)
    return eliminate_initial_states(blocks, raw, slice(k, k + len(eliminated))) if eliminated else tuple(blocks)


def _whitened_together(
    blocks: Sequence[ResidualBlock], times: Sequence[Array], treatment: Treatment
) -> list[ResidualBlock]:
    rows = np.vstack([np.column_stack([b.residual, b.jacobian]) for b in blocks])
    rows = whitened_together(rows, blocks, times, treatment)
    parts = np.split(rows, np.cumsum([b.residual.size for b in blocks])[:-1])
    return [
        replace(b, residual=np.ascontiguousarray(part[:, 0]), jacobian=part[:, 1:])
        for b, part in zip(blocks, parts, strict=True)
    ]


def whitened_together(
    rows: Array, blocks: Sequence[ResidualBlock], times: Sequence[Array], treatment: Treatment
) -> Array:
    """Return treated values of all blocks of an experiment, (N,) or (N, p), whitened by the noise that its inputs pass on, too.

    times: by block, (m,) the instants of its rows. Each row is freed of what those before it, of all outputs, tell of it.
    """
    white = rows
    for part in _parts(blocks, times, treatment):
        white = white.copy() if white is rows else white
        white[part.at] = solve_triangular(part.lower, rows[part.at], lower=True, check_finite=False)
    return white


def passed_draws(
    blocks: Sequence[ResidualBlock],
    times: Sequence[Array],
    treatment: Treatment,
    count: int,
    random: np.random.Generator,
) -> Array:
    """Return (N, count) what draws of the noise that an experiment's inputs pass on add to the treated values of its blocks."""
    passed = treatment.passed.get(blocks[0].experiment)
    if passed is None:
        return np.zeros((sum(b.residual.size for b in blocks), count))
    caused, _ = _causes(passed, _outputs(blocks, times), treatment)
    return caused @ random.standard_normal((caused.shape[1], count))


@dataclass(frozen=True, eq=False)
class _Part:
    """Rows of an experiment's blocks that are whitened together.

    at: (m,) their places, in the order of time; lower: (m, m) the factor of their covariance.
    """

    at: NDArray[np.intp]
    lower: Array


_Outputs = tuple[tuple[str, bytes, float, bytes | None], ...]
"""Of each block its output, the instants of its rows, standard deviation and profile."""


def _outputs(blocks: Sequence[ResidualBlock], times: Sequence[Array]) -> _Outputs:
    profiles = [None if b.profile is None else b.profile.tobytes() for b in blocks]
    return tuple((b.output, t.tobytes(), b.sigma, p) for b, t, p in zip(blocks, times, profiles, strict=True))


def _parts(blocks: Sequence[ResidualBlock], times: Sequence[Array], treatment: Treatment) -> tuple[_Part, ...]:
    """Return the parts of an experiment's blocks; none where its inputs pass on no noise."""
    passed = treatment.passed.get(blocks[0].experiment)
    return () if passed is None else _parts_of(passed, _outputs(blocks, times), treatment)


# A search goes back and forth between a few records and their first parts.
@lru_cache(maxsize=12)
def _parts_of(passed: PassedNoise, outputs: _Outputs, treatment: Treatment) -> tuple[_Part, ...]:
    whole, order = _causes(passed, outputs, treatment)
    parts = []
    for at in np.array_split(order, -(-order.size // ROWS_TOGETHER)):
        covariance = whole[at] @ whole[at].T
        covariance[np.diag_indices(at.size)] += 1.0
        parts.append(_Part(at, cholesky(covariance, lower=True, overwrite_a=True, check_finite=False)))
    return tuple(parts)


def _causes(passed: PassedNoise, outputs: _Outputs, treatment: Treatment) -> tuple[Array, NDArray[np.intp]]:
    """Return (N, k) what independent causes of standard deviation 1 make of the treated values, and the order of time of these."""
    answers, places = [], []
    for k, (output, instants, sigma, profile) in enumerate(outputs):
        time = np.frombuffer(instants)
        level = np.zeros((time.size, len(outputs)))  # each by itself
        level[:, k] = OPEN * sigma if output in passed.levels else 0.0
        caused = np.hstack([passed.answers(output, time), level])
        caused = per_deviation(caused, sigma, None if profile is None else np.frombuffer(profile))
        answers.append(treatment.applied(caused, time, output, "the noise of inputs"))
        places.append(time if treatment.band is None else np.zeros(answers[-1].shape[0]))
    return np.vstack(answers), np.argsort(np.concatenate(places), kind="stable")


def transformed(signal: Array, time: Array, band: Band, where: str) -> Array:
    """Return the real and imaginary parts of the signal's spectrum within the band, (k,) or (k, p).

    signal: (m,) or (m, p) over evenly spaced instants time, (m,) s. band: Hz, ends included. The transform is unitary:
    over the whole band the sum of squares is that of the signal, and white noise stays white.
    Raises StudyError for uneven rows or a band without a frequency.
    """
    if len(segments(time, where)) > 1:
        raise StudyError(
            "the frequency-domain residual needs rows without a gap",
            where=where,
            expected="evenly spaced rows with finite measurements and no guard",
            hint="a window without gaps, or the time-domain residual",
        )
    n = time.size
    step = (time[-1] - time[0]) / max(n - 1, 1)
    frequency = np.fft.rfftfreq(n, step) if step > 0 else np.zeros(1)
    inside = (frequency >= band[0]) & (frequency <= band[1])
    spectrum = np.fft.rfft(signal, axis=0) / np.sqrt(n)
    single = (np.arange(frequency.size) == 0) | ((np.arange(frequency.size) == n // 2) & (n % 2 == 0))
    both = spectrum[inside & ~single] * np.sqrt(2.0)
    result = np.concatenate([spectrum[inside & single].real, both.real, both.imag])
    if not result.shape[0]:
        raise StudyError(
            "the band holds no frequency of the record",
            where=where,
            expected=f"within 0 to {frequency[-1]:g} Hz in steps of {1.0 / (n * step) if step else 0:g} Hz",
            got=f"{band[0]:g} to {band[1]:g} Hz",
        )
    return result


def unknown_initial_states(simulator: Simulator, experiment: Experiment) -> tuple[str, ...]:
    """Return the states whose start is neither given nor estimated; none of a simulator that does not show its states."""
    known = {*experiment.starts, *experiment.nuisance}
    return tuple(n for n in states_of(simulator) if n not in known)


def with_steady_start(
    simulator: Simulator,
    experiment: Experiment,
    values: Mapping[str, float],
    states: Sequence[str],
    nuisance: Mapping[str, float],
) -> Experiment:
    """Return the experiment with the steady start of these states given as numbers. Raises SimulationError where there is none."""
    first = experiment.time[:1]
    blank = Trajectory(first, np.zeros((1, len(states))), tuple(states), tuple("" for _ in states))
    asked = experiment.with_(time=first, measured=blank, window=None, instrument=FrozenMap())
    nuisance = {n: v for n, v in nuisance.items() if n != TIME_SHIFT}
    steady = observe(simulator, asked, values, (), nuisance, derivatives=False).values
    return experiment.with_(starts=experiment.starts | {n: float(steady[n][0]) for n in states})


def with_best_start(experiment: Experiment, blocks: Sequence[ResidualBlock], states: Sequence[str]) -> Experiment:
    """Return the experiment with these states' starts moved to where its residuals are least, to first order.

    blocks: at the starts as they are; their first columns are by the starts. A start that the records hardly show is kept
    by a weak prior, as wide as its own value (or 1): it would otherwise be moved by noise, and far.
    """
    start = np.array([experiment.starts[n] for n in states])
    size = np.where(start != 0.0, np.abs(start), 1.0)
    columns = np.vstack([b.jacobian[:, : len(states)] for b in blocks]) * size
    residual = np.concatenate([b.residual for b in blocks])
    # Stacked, not squared: of columns that are alike and large, the prior would be lost in rounding.
    matrix, target = np.vstack([columns, np.eye(len(states))]), np.append(-residual, np.zeros(len(states)))
    step = np.linalg.lstsq(matrix, target)[0]
    moved = {n: float(v) for n, v in zip(states, start + size * step, strict=True)}
    return experiment.with_(starts=experiment.starts | moved)


def eliminate_initial_states(
    blocks: Sequence[ResidualBlock], raw: Sequence[Array], columns: slice
) -> tuple[ResidualBlock, ...]:
    """Return the blocks of one experiment without the part of their residuals that the starts can make good.

    columns: the jacobians' columns by the starts, which are gone from the result. raw: by block, (m, starts) the derivative
    of its misfit by them, neither weighted nor whitened.
    """
    slopes = np.vstack([b.jacobian[:, columns] for b in blocks])
    norms = np.linalg.norm(slopes, axis=0)
    norms = np.where(norms > 0, norms, np.inf)
    u, s, vt = np.linalg.svd(slopes / norms, full_matrices=False)
    kept = s > TELLS * s.max(initial=0.0)
    u = u[:, kept]
    residual = np.concatenate([b.residual for b in blocks])
    jacobian = np.vstack([np.delete(b.jacobian, columns, axis=1) for b in blocks])
    start = -(vt[kept].T @ ((u.T @ residual) / s[kept])) / norms
    residual, jacobian = residual - u @ (u.T @ residual), jacobian - u @ (u.T @ jacobian)
    projected, first = [], 0
    for k, (b, d) in enumerate(zip(blocks, raw, strict=True)):
        rows = slice(first, first + b.residual.size)
        taken = int(np.count_nonzero(kept)) if k == 0 else 0
        projected.append(
            replace(b, misfit=b.misfit + d @ start, residual=residual[rows], jacobian=jacobian[rows], taken=taken)
        )
        first = rows.stop
    return tuple(projected)
