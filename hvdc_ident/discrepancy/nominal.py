"""The nominal model at its own best: refitted over what the data determine, for a gap before that is the calibration's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import FEWEST_QUIET, Array, Experiment, Trajectory, event_time, quiet_rows
from hvdc_ident.data.noise import TANH
from hvdc_ident.errors import SimulationError, StudyError
from hvdc_ident.executor import Executor
from hvdc_ident.fit import FitParameter, Problem, Simulator, StartOutcome
from hvdc_ident.fit.noise import GIVEN, OutputNoise, noise_of, stated_by
from hvdc_ident.fit.residual import ResidualBlock, passed_draws, whitened_together
from hvdc_ident.fit.simulator import approximate, observe
from hvdc_ident.identifiability import IdentifiabilityReport
from hvdc_ident.identifiability.gate import gate, gated
from hvdc_ident.identifiability.pilot_fit import LocalAnalysis, pilot_fit
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.sensitivity import independent, null_directions

ON_JUMP = 0.05
"""Share of the rows' interval: a row this near to a jump of an input lies on it."""
THINNED_ROWS, ROWS_KEPT_AFTER_BREAK = 300, 20
"""Rows of a thinned record, about, and those behind a break of an input that stay as they are: a search looks at thousands of runs,
and what it ranks moves over many rows."""
F = TypeVar("F", bound=np.floating)


@dataclass(frozen=True, eq=False)
class Nominal:
    """A model at its optimum, and what a test of it needs.

    problem: with its weights and AR coefficients; theta: (p,) the optimum. noise: by output. extra: (N, q) further
    nuisance directions, whitened (start states, where they are not known).
    """

    problem: Problem
    theta: Array
    noise: FrozenMap[OutputNoise]
    extra: Array | None = None

    @cached_property
    def blocks(self) -> tuple[ResidualBlock, ...]:
        """Residuals and derivatives at the optimum."""
        return self.problem.blocks(self.theta)

    @cached_property
    def residual(self) -> Array:
        """(N,) whitened residuals of all blocks."""
        return np.concatenate([b.residual for b in self.blocks])

    @property
    def chi2(self) -> float:
        """The sum of squared residuals, as `ResidualBlock.chi2`."""
        return float(self.residual @ self.residual) + sum(b.spare * b.residual.size for b in self.blocks)

    @cached_property
    def basis(self) -> Array:
        """(N, k) orthonormal: what fitted and nuisance parameters can make of the residual."""
        columns = np.vstack([b.jacobian for b in self.blocks])
        if self.extra is not None:
            columns = np.hstack([columns, self.extra])
        if self.problem.free_initial_states:
            columns = np.hstack([columns, self.problem.initial_state_jacobian(self.theta)])
        return orthonormal(columns)

    @cached_property
    def starts(self) -> Array:
        """(N, k) orthonormal, and to the basis: what unknown starts of the states can make of the residual besides."""
        if self.problem.free_initial_states:
            return np.zeros((self.residual.size, 0))
        left = self.projected(unit_columns(self.problem.initial_state_jacobian(self.theta)))
        return orthonormal(left[:, np.linalg.norm(left, axis=0) > 1e-6])

    @property
    def values(self) -> dict[str, float]:
        """Parameters at the optimum, those held included."""
        return self.problem.values(self.theta)

    def projected(self, columns: NDArray[F]) -> NDArray[F]:
        """M columns: what the parameters cannot make good, worked out in all digits and kept in as many as the columns have."""
        return (columns - self.basis @ (self.basis.T @ columns)).astype(columns.dtype, copy=False)

    def drawn(self, count: int, seed: int) -> NDArray[np.float32]:
        """(N, count) records of nothing but noise, as the residuals are; in half the digits, for noise needs no more."""
        found = draws(self.problem, self.blocks, self.noise, self.fitted(), count, seed)
        return np.vstack([d.astype(np.float32) for d in found])

    def fitted(self) -> list[Array]:
        """The model's output at each block's rows, in its unit."""
        by_name = {e.name: e for e in self.problem.fitted_experiments}
        found = []
        for b in self.blocks:
            measured = by_name[b.experiment].measured
            assert measured is not None
            found.append(measured[b.output][b.rows] - b.misfit)
        return found


def draws(
    problem: Problem,
    blocks: Sequence[ResidualBlock],
    noise: Mapping[str, OutputNoise],
    fitted: Sequence[Array],
    count: int,
    seed: int,
) -> list[Array]:
    """Return for each block (m, count) records of nothing but noise, weighted and whitened as the residuals are.

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
        if n.freedom and n.quantised is None:
            own = n.by_record.get(b.experiment)
            freedom, which = (n.freedom, ()) if own is None else (own[1], (k,))
            spread = np.random.default_rng([seed, 4, outputs.index(b.output), *which]).chisquare(freedom, count)
            e *= np.sqrt(freedom / spread)
        if n.step:
            size = n.below * np.ones(count)
            if n.quantised is not None:
                spread = np.random.default_rng([seed, 3, outputs.index(b.output)]).standard_normal(count)
                size = size * np.exp(n.error * spread)
            placed = y[:, None] + n.step * random.uniform(-0.5, 0.5, count)
            e = np.round((placed + size * e) / n.step) * n.step - placed
            quantised = problem.treatment.quantised(b.output, b.experiment)
            if quantised is not None and b.profile is None:
                found.append(quantised.residual(e)[0])
                continue
            e = b.scaled(e)
        found.append(problem.treatment.applied(e, times[b.experiment][b.rows], b.output, b.experiment))
    return _with_passed(problem, blocks, found, times, seed)


def _with_passed(
    problem: Problem, blocks: Sequence[ResidualBlock], drawn: list[Array], times: Mapping[str, Array], seed: int
) -> list[Array]:
    """Return draws of each output's own noise with those of what recorded inputs pass on, whitened together."""
    whole = list(drawn)
    for k, name in enumerate(problem.passed):
        own = [i for i, b in enumerate(blocks) if b.experiment == name]
        if not own:
            continue
        beside, random = [blocks[i] for i in own], np.random.default_rng([seed, 5, k])
        rows = np.vstack([drawn[i] for i in own])
        at = [times[name][b.rows] for b in beside]
        rows = rows + passed_draws(beside, at, problem.treatment, rows.shape[1], random)
        rows = whitened_together(rows, beside, at, problem.treatment)
        for i, part in zip(own, np.split(rows, np.cumsum([drawn[i].shape[0] for i in own])[:-1]), strict=True):
            whole[i] = part
    return whole


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


def unit_columns(columns: Array) -> Array:
    """The columns that are not 0, of length 1."""
    norms = np.linalg.norm(columns, axis=0)
    return np.asarray(columns[:, norms > 0] / norms[norms > 0])


def orthonormal(columns: Array) -> Array:
    """(N, k) an orthonormal basis of what the columns, each as long as the others, span beyond rounding."""
    unit = unit_columns(columns)
    if not unit.shape[1]:
        return unit
    u, s, _ = np.linalg.svd(unit, full_matrices=False)
    return np.asarray(u[:, s > 1e-7 * s[0]])


def thinned(nominal: Nominal) -> Nominal:
    """Return the model at its optimum against means over neighbouring rows, about `ROWS` of each record; as it is where noise is
    coloured or passed on by inputs, or a record is no course over time.

    Behind each break of an input, where things are quick, every row stays. What a mean over rows bends is taken from the
    model's own run, so that the residual is exactly the mean of the rows' residuals; white noise keeps its information.
    """
    problem = nominal.problem
    plain = all(e.domain == "time" and not e.nuisance for e in problem.fitted_experiments)
    if problem.rho or problem.passed or problem.band is not None or not plain:
        return nominal
    blocks: dict[str, list[tuple[ResidualBlock, Array]]] = {}
    for b, run in zip(nominal.blocks, nominal.fitted(), strict=True):
        blocks.setdefault(b.experiment, []).append((b, run))
    fewer = tuple(_means(e, blocks[e.name]) for e in problem.fitted_experiments)
    # Means of rounded rows are no levels any more.
    noise = FrozenMap({o: replace(n, step=0.0) for o, n in nominal.noise.items()})
    return Nominal(replace(problem, experiments=fewer, quantised_noise=FrozenMap()), nominal.theta, noise)


def _means(experiment: Experiment, blocks: Sequence[tuple[ResidualBlock, Array]]) -> Experiment:
    """Return an experiment whose rows are means over the compared rows of its outputs. blocks: with the model's run at their rows."""
    time, count = experiment.time, experiment.time.size
    width = -(-count // THINNED_ROWS)
    breaks = np.unique(np.concatenate([time[:1], *(s.breaks for s in experiment.inputs.values())]))
    first = np.searchsorted(time, breaks[breaks <= time[-1]])
    if (
        width == 1 or first.size * ROWS_KEPT_AFTER_BREAK > THINNED_ROWS
    ):  # few rows; or an input that was recorded, with a corner at each
        return experiment
    behind = np.arange(count) - first[np.searchsorted(first, np.arange(count), "right") - 1]
    begins = np.zeros(count, dtype=bool)
    begins[first] = True
    begins |= (behind < ROWS_KEPT_AFTER_BREAK) | ((behind - ROWS_KEPT_AFTER_BREAK) % width == 0)
    group = np.cumsum(begins) - 1
    edges = np.append(np.flatnonzero(begins), count)
    middle = (edges[:-1] + edges[1:] - 1) // 2
    values = np.full((middle.size, len(blocks)), np.nan)
    profile = {}
    for k, (b, run) in enumerate(blocks):
        weight = 1.0 if b.profile is None else b.profile**-2.0
        total = np.bincount(group[b.rows], weights=np.broadcast_to(weight, b.rows.shape), minlength=middle.size)
        left = np.bincount(group[b.rows], weights=weight * b.misfit, minlength=middle.size)
        own = np.interp(time[middle], time[b.rows], run)
        values[:, k] = np.where(total > 0, own + left / np.where(total > 0, total, 1.0), np.nan)
        profile[b.output] = np.where(total > 0, total, 1.0) ** -0.5
    assert experiment.measured is not None
    names = tuple(b.output for b, _ in blocks)
    units = tuple(experiment.measured.unit(n) for n in names)
    measured = Trajectory(time[middle], values, names, units)
    return experiment.with_(
        time=time[middle], measured=measured, noise_profile=FrozenMap(profile), noise=experiment.noise, window=None
    )


def nominal(
    simulator: Simulator,
    experiments: Sequence[Experiment],
    parameters: Sequence[FitParameter],
    held: Mapping[str, float],
    report: IdentifiabilityReport | None,
    *,
    starts: int | None,
    seed: int,
    executor: Executor | None,
) -> tuple[Nominal, tuple[str, ...]]:
    """The refitted nominal model, and remarks on the fit and on what was held.

    Raises StudyError where there is nothing to compare, SimulationError where no start can be run.
    """
    fitted = [e for e in experiments if e.role == "fit" and e.outputs]
    if not fitted:
        raise StudyError("nothing to diagnose", expected='an experiment of role "fit" with measured outputs')
    problem = Problem(simulator, tuple(experiments), tuple(parameters), held=FrozenMap(held))
    noise = noise_of([e for e in experiments if e.outputs], _runs(problem))
    begun: tuple[StartOutcome, ...] = ()
    if report is not None:
        problem = gated(problem, gate(report, diagnosis=True))
        begun = report.pilot.ends_over([f.name for f in problem.free])
    # What is known of the noise goes into the records: a fit keeps weights of its own for deterministic outputs only.
    with_noise = tuple(
        off_jumps(e).with_(noise=FrozenMap({o: n for o in e.outputs if (n := _stated(e, o, noise[o])) is not None}))
        for e in problem.experiments
    )
    models = {o: n.model for o, n in noise.items() if n.model and o in problem.outputs}
    quantised = {o: q for o, n in noise.items() if (q := n.quantised) is not None}
    problem = replace(problem, experiments=with_noise, rho=FrozenMap(models), quantised_noise=FrozenMap(quantised))
    optimum, result = pilot_fit(problem, starts=starts, seed=seed, begun=begun, executor=executor, misfit_expected=True)
    notes = (
        [f"Nominal fit: {result.status}, {result.message}."] if result.status in ("two-optima", "not-converged") else []
    )
    if report is None:
        optimum, held_now = _told_apart(optimum)
        notes += [f"Held at {v:g}, for these data do not distinguish it: {n}." for n, v in held_now.items()]
    stated = {
        o: replace(n, std=optimum.problem.weights.get(o)) if n.std is None and o in optimum.problem.weights else n
        for o, n in noise.items()
    }
    return Nominal(optimum.problem, optimum.theta, FrozenMap(stated)), tuple(notes)


def off_jumps(experiment: Experiment) -> Experiment:
    """The experiment without the measured rows that lie on a jump of an input.

    Whether such a row shows the value before or after, or where a quick part of the plant then is, no recorder says: one
    row can weigh as much as all that a missing effect does to the others.
    """
    if experiment.measured is None:
        return experiment
    time = experiment.time
    steps = np.diff(time)
    near = ON_JUMP * float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    jumps = [t for s in experiment.inputs.values() for t in s.jumps.tolist()]
    on = np.zeros(time.size, dtype=bool)
    for t in jumps:
        on |= np.abs(time - t) <= near
    if not on.any() or on.all():
        return experiment
    values = np.array(experiment.measured.values)
    values[on] = np.nan
    return experiment.with_(measured=replace(experiment.measured, values=values))


def _stated(experiment: Experiment, output: str, noise: OutputNoise) -> float | None:
    """The standard deviation of a record: its own where that was stated and holds, else what was found of its noise."""
    own = stated_by(experiment, output)
    if own is not None and (noise.source == GIVEN or noise.stated is None):
        return own
    return noise.by_record[experiment.name][0] if experiment.name in noise.by_record else noise.std


def _runs(problem: Problem) -> dict[str, Mapping[str, Array]]:
    """By experiment the outputs of the model at the start of the fit, (n,) at its rows; without those that cannot be run."""
    # With the derivatives of the fit the machine code is that of the fit: compiling another takes longer than running it.
    free = () if approximate(problem.simulator) else tuple(f.name for f in problem.free)
    found: dict[str, Mapping[str, Array]] = {}
    for e in problem.experiments:
        # What a run makes of noisy inputs counts beside the noise of the outputs, which before the event are at rest.
        if e.outputs and e.domain == "time" and not e.input_noise:
            with suppress(SimulationError):  # nothing is known of its motion then: the record has to be at rest
                found[e.name] = observe(problem.simulator, e, problem.values(problem.start), free).values
    return found


def _told_apart(optimum: LocalAnalysis) -> tuple[LocalAnalysis, dict[str, float]]:
    """The optimum without the parameters that these data do not distinguish from the others, held at their given values where it runs."""
    k = len(optimum.names)
    dead = [n for n, c in zip(optimum.names, optimum.columns.T, strict=False) if not np.any(c)]
    null = null_directions(optimum.columns)[:, :k]
    kept = {optimum.names[i] for i in independent(optimum.information.matrix)}
    lost = [n for n in optimum.names if n in dead or (n not in kept and np.any(null[:, optimum.names.index(n)]))]
    if not lost or len(lost) == k:
        return optimum, {}
    given = {f.name: f.given for f in optimum.problem.free if f.name in lost}
    fewer = optimum.with_held(dict.fromkeys(lost, "not distinguished"), given)
    return fewer, {n: fewer.problem.held[n] for n in lost}


def of_held_out(problem: Problem) -> Problem | None:
    """The problem on the held-out experiments, without nuisances; None where there are none."""
    others = [e.with_(role="fit", nuisance=()) for e in problem.experiments if e.role == "holdout" and e.outputs]
    others = [e for e in others if set(e.outputs) & set(problem.outputs)]
    return replace(problem, experiments=tuple(others)) if others else None


def noise_left(left: Nominal) -> float:
    """The mean square that noise alone leaves in whitened residuals, from the rows before the events that are at rest; at least 1.

    It is 1 where the noise is as supposed. AR coefficients from few rows are not: with a standard deviation that is
    given, a coefficient that is wrong by a tenth makes of whitened noise half or three times its size.
    """
    experiments = {e.name: e for e in left.problem.fitted_experiments}
    rows: dict[str, int] = {}
    quiet: dict[str, list[Array]] = {}
    for b, run in zip(left.blocks, left.fitted(), strict=True):
        e = experiments[b.experiment]
        event = e.event if e.event is not None else event_time(e.inputs)
        rows[b.output] = rows.get(b.output, 0) + b.residual.size
        if b.slope is None:  # one level between two steps is no measure of the others
            rest = quiet_rows(e.time[b.rows], b.misfit + run, event, run, b.profile)
            quiet.setdefault(b.output, []).append(b.residual[rest.rows])
    total = 0.0
    for output, count in rows.items():
        own = np.concatenate(quiet.get(output) or [np.zeros(0)])
        total += count * (float(np.mean(own**2)) if own.size >= FEWEST_QUIET else 1.0)
    return max(total / max(sum(rows.values()), 1), 1.0)
