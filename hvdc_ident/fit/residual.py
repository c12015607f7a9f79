"""The residuals of one experiment with their derivatives: weighted, and if asked whitened or turned into a spectrum.

Where a record does not begin at rest, what the states' unknown starts can make good is taken out of the residuals. What
moves a system by itself, a periodic disturbance say, has moved it before the record's first row too; the steady start of a
run is then one of many, and the difference dies out like any other answer to the states' start. The best start for given
parameters is found by a step from the steady one; about it the starts are eliminated: variable projection (Golub and
Pereyra 1973) with the jacobian of Kaufman (1975), whose gradient is exact because it is taken at the best start.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Experiment, Trajectory
from hvdc_ident.errors import SimulationError, StudyError
from hvdc_ident.fit.likelihood import QuantisedNoise
from hvdc_ident.fit.noise_model import AR, GAP, segments, whitened
from hvdc_ident.fit.simulator import TIME_SHIFT, Simulator, WithStates, observe
from hvdc_ident.immutable import FrozenMap

LARGEST = 1e100
"""Residuals and derivatives beyond this leave the range of floats (1e308) once products of two are scaled and summed: no
factorisation of them would end."""


@dataclass(frozen=True, eq=False)
class ResidualBlock:
    """The residuals of one output in one experiment, over its m compared rows; a spectrum has n values instead of m.

    misfit: (m,) measured - simulated, in the output's unit. sigma: standard deviation, in the same unit.
    profile: (m,) the standard deviation of each row over sigma, where rows differ; else None.
    residual: (n,) misfit/(sigma profile), treated; positive where the measurement lies above the model. No unit.
    jacobian: (n, p) d residual/d unknown, so minus the treated sensitivity over sigma.
    rows: (m,) the experiment's rows that are compared.
    taken: how many independent directions the elimination of unknown starts has taken out of the experiment's blocks,
    told with the first of them: chance then leaves so much less in the sum of squares.
    slope: (m,) d residual/d misfit, per unit of the output, where the record is rounded; else None: it is 1/sigma, treated.
    spare: what the mean square of a rounded record's residuals lacks of 1 where only noise is left.
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
        """Values of the compared rows, (m,) or (m, k) in the output's unit, in standard deviations."""
        return per_deviation(values, self.sigma, self.profile)

    @property
    def stretches(self) -> tuple[slice, ...]:
        """The stretches of residuals between which rows are missing; a spectrum is one."""
        if self.residual.size != self.rows.size:
            return (slice(0, self.residual.size),)
        return stretches(self.rows)

    @property
    def rmse(self) -> float:
        """Root mean square of the misfit, in the output's unit."""
        return float(np.sqrt(np.mean(self.misfit**2)))

    def among(self, columns: Sequence[int], width: int) -> ResidualBlock:
        """The block with a jacobian of `width` columns, its own at these places, if any, and 0 elsewhere."""
        jacobian = np.zeros((self.residual.size, width))
        if columns:
            jacobian[:, columns] = self.jacobian
        return ResidualBlock(
            self.experiment, self.output, self.rows, self.misfit, self.sigma, self.residual, jacobian, self.taken,
            self.slope, self.spare, self.profile,
        )  # fmt: skip

    @property
    def squares(self) -> Array:
        """(n,) squared residuals, of mean 1 under noise: their sums differ from -2 log likelihood by a constant."""
        return np.asarray(self.residual**2 + self.spare)

    @property
    def chi2(self) -> float:
        """The sum of the squares."""
        return float(self.residual @ self.residual) + self.spare * self.residual.size

    @property
    def score(self) -> Array:
        """(n,) what each row says of its level, of mean 0 under noise also where the level lies askew between two steps."""
        return self.residual if self.slope is None else self.residual * self.slope * self.sigma


def per_deviation(values: Array, sigma: float, profile: Array | None) -> Array:
    """Values, (m,) or (m, k), over the standard deviation of each row."""
    if profile is None:
        return values / sigma
    return np.asarray(values / (sigma * profile).reshape(-1, *([1] * (values.ndim - 1))))


def stretches(rows: NDArray[np.intp]) -> tuple[slice, ...]:
    """The stretches of compared rows without a gap; a step over 1.5 median ones is one, as between instants."""
    steps = np.diff(rows)
    if not steps.size or steps.max() == 1:
        return (slice(0, rows.size),)
    ends = [0, *(np.flatnonzero(steps > GAP * np.median(steps)) + 1).tolist(), rows.size]
    return tuple(slice(a, b) for a, b in pairwise(ends))


def compared_rows(experiment: Experiment, output: str, guard: float = 0.0) -> NDArray[np.intp]:
    """The rows of an output that are compared: inside the window, with a finite measurement, off the guarded instants.

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
    """What of an output's record is compared with every run: (m,) rows, and values in its unit at instants in s.

    whole: whether it is every row. profile: (m,) as in `ResidualBlock`.
    """

    output: str
    rows: NDArray[np.intp]
    values: Array
    time: Array
    whole: bool
    profile: Array | None = None


def records(experiment: Experiment, guard: float = 0.0) -> tuple[ComparedRecord, ...]:
    """One record for each measured output. guard: as in `compared_rows`. Raises StudyError where nothing can be compared."""
    return tuple(_record(experiment, o, guard) for o in experiment.outputs)


def _record(experiment: Experiment, output: str, guard: float) -> ComparedRecord:
    rows = compared_rows(experiment, output, guard)
    assert experiment.measured is not None
    values, time = experiment.measured[output][rows], experiment.time[rows]
    profile = experiment.noise_profile.get(output)
    return ComparedRecord(
        output, rows, values, time, rows.size == experiment.time.size, None if profile is None else profile[rows]
    )


@dataclass(frozen=True)
class Treatment:
    """What is done to misfits before they are residuals.

    whitening: the noise model by output. guard: rows this close to a break of an input are left out, s. band: Hz; given,
    residuals are the misfit's spectrum within it; None, they are samples in time. quantised_noise: by output whose record is
    rounded; its residuals are samples in time and not whitened.
    """

    whitening: FrozenMap[AR] = field(default_factory=FrozenMap)
    guard: float = 0.0
    band: Band | None = None
    quantised_noise: FrozenMap[QuantisedNoise] = field(default_factory=FrozenMap)

    def applied(self, signal: Array, time: Array, output: str, where: str) -> Array:
        """The signal over the compared instants, (m,) or (m, p), as a residual: (n,) or (n, p)."""
        model = self.whitening.get(output, ())
        if any(model):
            signal = whitened(signal, model, segments(time, where))
        return signal if self.band is None else transformed(signal, time, self.band, where)

    def quantised(self, output: str) -> QuantisedNoise | None:
        """The quantised noise of an output, where its residuals are to know of it: not in a spectrum, nor where they are whitened."""
        known = self.quantised_noise.get(output)
        return None if self.band is not None or any(self.whitening.get(output, ())) else known


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
    unknown_starts: Sequence[str] = (),
    compared: Sequence[ComparedRecord] | None = None,
) -> tuple[ResidualBlock, ...]:
    """One block for each measured output; unknowns are `sensitivities`, then the nuisances in their order.

    sigma: standard deviation by output, in its unit. derivatives: whether jacobians are wanted; else they have no column.
    unknown_starts: states, given starts by the experiment, that are taken for unknown and eliminated.
    compared: the experiment's records with the treatment's guard, where they are at hand.
    Raises SimulationError where the run fails, StudyError where nothing can be compared.
    """
    treatment = treatment or Treatment()
    wanted = sensitivities if derivatives else ()
    k = len(wanted)
    given = dict(nuisance or {})
    seen = observe(
        simulator,
        experiment,
        values,
        (*wanted, *unknown_starts),
        given,
        derivatives=derivatives or bool(unknown_starts),
    )
    blocks, raw = [], []
    for record in compared if compared is not None else records(experiment, treatment.guard):
        output, weight = record.output, sigma[record.output]
        y, dy = seen.values[output], seen.gradient[output]
        misfit = record.values - (y if record.whole else y[record.rows])
        slopes = -(dy if record.whole else dy[record.rows])
        quantised = treatment.quantised(output) if record.profile is None else None
        if quantised is not None:
            residual, slope = quantised.residual(misfit)
            jacobian, spare = slopes * slope[:, None], quantised.spare
        else:
            both = np.empty((misfit.size, 1 + slopes.shape[1]))
            both[:, 0] = per_deviation(misfit, weight, record.profile)
            both[:, 1:] = per_deviation(slopes, weight, record.profile)
            if not np.abs(both).max(initial=0.0) < LARGEST:
                raise SimulationError(
                    f"output '{output}' or its sensitivity grows beyond all bounds",
                    where=f"experiment '{experiment.name}'",
                    expected=f"below {LARGEST:g} standard deviations",
                )
            treated = treatment.applied(both, record.time, output, f"experiment '{experiment.name}'")
            residual, jacobian, slope, spare = treated[:, 0].copy(), treated[:, 1:], None, 0.0
        block = ResidualBlock(
            experiment.name, output, record.rows, misfit, weight, residual, jacobian, slope=slope, spare=spare,
            profile=record.profile,
        )  # fmt: skip
        blocks.append(block)
        raw.append(slopes[:, k : k + len(unknown_starts)])
    return freed(blocks, raw, slice(k, k + len(unknown_starts))) if unknown_starts else tuple(blocks)


Band = tuple[float, float]


def transformed(signal: Array, time: Array, band: Band, where: str) -> Array:
    """The real and imaginary parts of the signal's spectrum within the band, (k,) or (k, p).

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


TELLS = 1e-7
"""Singular value, relative to the largest of columns of length 1, from which a direction counts."""


def unknown_initial_states(simulator: Simulator, experiment: Experiment) -> tuple[str, ...]:
    """The states whose start is neither given nor estimated; none of a simulator that does not show its states."""
    known = {*experiment.starts, *experiment.nuisance}
    return tuple(n for n in simulator.states if n not in known) if isinstance(simulator, WithStates) else ()


def centred(
    simulator: Simulator,
    experiment: Experiment,
    values: Mapping[str, float],
    states: Sequence[str],
    nuisance: Mapping[str, float],
) -> Experiment:
    """The experiment with the steady start of these states given as numbers. Raises SimulationError where there is none."""
    first = experiment.time[:1]
    blank = Trajectory(first, np.zeros((1, len(states))), tuple(states), tuple("" for _ in states))
    asked = experiment.with_(time=first, measured=blank, window=None, instrument=FrozenMap())
    own = {n: v for n, v in nuisance.items() if n != TIME_SHIFT}
    at = observe(simulator, asked, values, (), own, derivatives=False).values
    return experiment.with_(starts=experiment.starts | {n: float(at[n][0]) for n in states})


def recentred(experiment: Experiment, blocks: Sequence[ResidualBlock], states: Sequence[str]) -> Experiment:
    """The experiment with these states' starts moved to where its residuals are least, to first order.

    blocks: at the starts as they are; their first columns are by the starts. A start that the records hardly show is kept
    by a weak prior, as wide as its own value (or 1): it would otherwise be moved by noise, and far.
    """
    at = np.array([experiment.starts[n] for n in states])
    size = np.where(at != 0.0, np.abs(at), 1.0)
    columns = np.vstack([b.jacobian[:, : len(states)] for b in blocks]) * size
    residual = np.concatenate([b.residual for b in blocks])
    # Stacked, not squared: of columns that are alike and large, the prior would be lost in rounding.
    whole, wanted = np.vstack([columns, np.eye(len(states))]), np.append(-residual, np.zeros(len(states)))
    step = np.linalg.lstsq(whole, wanted)[0]
    moved = {n: float(v) for n, v in zip(states, at + size * step, strict=True)}
    return experiment.with_(starts=experiment.starts | moved)


def freed(blocks: Sequence[ResidualBlock], raw: Sequence[Array], columns: slice) -> tuple[ResidualBlock, ...]:
    """The blocks of one experiment without what the starts can make good.

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
    rest = np.vstack([np.delete(b.jacobian, columns, axis=1) for b in blocks])
    start = -(vt[kept].T @ ((u.T @ residual) / s[kept])) / norms
    residual, rest = residual - u @ (u.T @ residual), rest - u @ (u.T @ rest)
    found, at = [], 0
    for k, (b, d) in enumerate(zip(blocks, raw, strict=True)):
        own = slice(at, at + b.residual.size)
        taken = int(np.count_nonzero(kept)) if k == 0 else 0
        found.append(
            replace(b, misfit=b.misfit + d @ start, residual=residual[own], jacobian=rest[own], taken=taken)
        )  # fmt: skip
        at = own.stop
    return tuple(found)
