"""Hypotheses: the model with some effects at insertion points, their sizes and its free parameters refitted together.

A refit runs from where the screen put it, with exact sensitivities, and is judged on data that it has not seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property

import numpy as np

from hvdc_ident.data import Array, Experiment
from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.movable import Movable, in_proportion
from hvdc_ident.discrepancy.nominal import Nominal, orthonormal
from hvdc_ident.discrepancy.prediction import held_out, predictive_score, root_mean_square
from hvdc_ident.effects import EffectUse, Probe, apply_effects, distance_from_neutral, effects
from hvdc_ident.errors import HvdcIdentError, SimulationError
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.fit.followed_noise import followed_noise, follows_noise, unbiased
from hvdc_ident.fit.noise import OutputNoise
from hvdc_ident.fit.optimiser import OptimiserResult
from hvdc_ident.fit.optimisers.trust_region import TrustRegion
from hvdc_ident.fit.residual import ResidualBlock
from hvdc_ident.fit.uncertainty import SINGULAR, Uncertainty, uncertainty
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel, Model, insertion_point, is_white_box
from hvdc_ident.simulate import Method, ModelSimulator, Statistics, Tolerance, equilibria, simulate

REFIT_TOLERANCE = Tolerance(rtol=1e-6, atol=1e-9, brief=True)
"""Of a refit's runs. A candidate's model has some hundred of them: to compile it well would take longer than they do."""
STEPS_PER_OWN_STEP, STEPS_PER_ROW = 10, 3
"""Steps of a candidate's run: times those of the model without it, and more for each row. What happens several times between two rows
(a chatter, a window of a microsecond) does not show in the record: a candidate that takes more steps is none."""
MAX_SIZE_FACTOR = 5.0
"""Times a probe's size at most, or this share of it at least, that a refit begins at: a score far from its size says little. Where the
score asks for another size, that is a second start: a dead band far from 0 is an offset, and its score is exact."""
MAX_PROPORTIONAL_FACTOR = 1e3
"""Largest such factor for an effect in proportion to its size, whose score at one size is that at every."""
BOUND_FACTOR = 3.0
"""Times the size asked for: how far a refit may go."""


@dataclass(frozen=True)
class Placed:
    """An effect in a model: its candidate, its use, and by its own parameter names those of the model.

    movable: whether its place is chosen at run time, so that its use is none of the model's own.
    """

    candidate: CandidateEffect
    use: EffectUse
    names: FrozenMap[str]
    bounds: FrozenMap[tuple[float, float]]
    start: FrozenMap[float]
    movable: bool = False


def begins_anywhere(model: AnyModel, without: AnyModel, uses: Sequence[EffectUse]) -> bool:
    """Return True where a record of the model with these effects need not begin at the steady state that the solver finds.

    An effect moves the model by itself, or effects leave open at which of many steady states it rests, as without them it does
    not: a dead band before an integrator holds it at any level, which is the one that was left by what came before.
    """
    entries = [effects()[u.effect] for u in uses]
    if any(e.self_exciting for e in entries):
        return True
    if not (any(e.holds for e in entries) and is_white_box(model) and is_white_box(without)):
        return False
    return _determinant(model) == 0.0 and _determinant(without) not in (None, 0.0)


def _determinant(model: Model) -> float | None:
    """Sign of the determinant of the equations at the model's own steady state; None where it has none."""
    anchor = equilibria(model).reference(model, np.array([i.value for i in model.inputs.values()]))
    return None if anchor is None else anchor.sign


def with_wider_bounds(candidate: CandidateEffect, probe: int, factor: float) -> CandidateEffect:
    """The candidate with room in the probe's bounds for the size that a score asks for, where it is in proportion to that.

    What a slot carries by itself is no measure of what is added there: a friction that hardly moves may be kicked hard.
    """
    chosen, entry = candidate.probes[probe], effects()[candidate.effect]
    if not np.isfinite(factor) or abs(factor) <= 1.0 or not in_proportion(candidate, probe):
        return candidate
    free = dict(chosen.free)
    for n in (n for n in free if entry.parameters[n].neutral == 0.0):
        asked, (low, high) = BOUND_FACTOR * min(abs(factor), MAX_PROPORTIONAL_FACTOR) * abs(chosen.values[n]), free[n]
        q = entry.parameters[n]
        free[n] = (max(min(low, -asked), q.min) if low < 0 else low, min(max(high, asked), q.max))
    wider = replace(chosen, free=FrozenMap(free))
    return replace(candidate, probes=(*candidate.probes[:probe], wider, *candidate.probes[probe + 1 :]))


def scaled_sizes(candidate: CandidateEffect, probe: int, factor: float, most: float | None = None) -> dict[str, float]:
    """The probe's values with its size multiplied, within the refit's bounds; a reversed phase where that is meant.

    most: the largest factor, and the inverse of the least; left out, as far as a score of the effect's size can be trusted.
    """
    values, free = candidate.probes[probe].values, candidate.probes[probe].free
    entry, found = effects()[candidate.effect], dict(values)
    most = most or (MAX_PROPORTIONAL_FACTOR if in_proportion(candidate, probe) else MAX_SIZE_FACTOR)
    size = float(np.clip(abs(factor), 1.0 / most, most)) if np.isfinite(factor) and factor else 1.0
    if factor < 0 and "phase" in found:
        found["phase"] += np.pi if found["phase"] <= 0 else -np.pi
    sign = -1.0 if factor < 0 and "phase" not in found else 1.0
    for n, q in entry.parameters.items():
        if q.neutral is None or n not in free or (q.optional and values[n] == q.neutral):
            continue
        neutral = values[q.neutral] if isinstance(q.neutral, str) else float(q.neutral)
        if np.isinf(neutral):
            # A delay is in proportion to 1/wn; where a bend begins is in proportion to nothing.
            if entry.equivalent_delay is not None and factor > 0:
                found[n] = values[n] / size
            continue
        found[n] = neutral + sign * size * (values[n] - neutral)
    for n, (low, high) in free.items():
        margin = 1e-3 * (high - low) if low <= 0 else 0.0
        found[n] = float(np.clip(found[n], low + margin if margin else low * 1.001, high - 1e-3 * (high - low)))
    return found


OPTIMISER = TrustRegion(max_evaluations=60, gradient=1e-5, reduction=1e-6, step=1e-7)
"""A reduction by this share is a hundredth of a unit of chi2 with ten thousand rows of noise."""
FAILURES = (HvdcIdentError, ValueError, ArithmeticError)
"""Errors of the work on one candidate that cannot be done: the candidate has failed then, with this as its reason, and the
search goes on. numpy's LinAlgError is a ValueError."""
EVALUATIONS_AFTER_SCAN = 15
"""Evaluations where the size was scanned for, a walk begins at the end of its way or leads nowhere."""


@dataclass(frozen=True, eq=False)
class RefitJob:
    """A refit to be done: the model with its effects and the problem on it, and where it may begin (one row a start).

    evaluations: at most. judged: whether its end is judged on data that it has not seen.
    """

    model: AnyModel
    placed: tuple[Placed, ...]
    problem: Problem
    begins: tuple[Array, ...]
    noise: FrozenMap[OutputNoise]
    evaluations: int = OPTIMISER.max_evaluations
    judged: bool = True


@dataclass(frozen=True, eq=False)
class Refit:
    """Result of a refit. failure: why it has no result, empty where it has one.

    chi2: sum of squared residuals (`ResidualBlock.chi2`); rows: their number; correlation: lag-1 autocorrelation left in them.
    holdout: root mean square of held-out residuals, in noise units, whitened; None without held-out experiments. predicted: root
    mean score of their prediction, or without them of parts of the fitted ones predicted from the rest (`prediction`); unseen_rows: of
    what it is the score of. std: standard deviation of each free parameter, of the effects and of the model, by its name in the model.
    apart: of each effect, by how many standard deviations its parameters together are off doing nothing. followed: sum of squares that
    the noise of played inputs makes of the residuals. ended: whether it came to its end, and was not only left where its evaluations
    were used up.
    """

    model: AnyModel
    placed: tuple[Placed, ...]
    problem: Problem
    noise: FrozenMap[OutputNoise]
    theta: Array
    chi2: float = np.inf
    rows: int = 0
    correlation: float = 0.0
    holdout: float | None = None
    predicted: float | None = None
    unseen_rows: int = 0
    std: FrozenMap[float | None] = field(default_factory=FrozenMap)
    apart: tuple[float, ...] = ()
    followed: float = 0.0
    failure: str = ""
    ended: bool = True

    @property
    def values(self) -> dict[str, float]:
        """All estimated and held parameters."""
        return self.problem.values(self.theta)

    @property
    def unseen(self) -> float | None:
        """Root mean square of the held-out residuals, in noise units; without held-out experiments the score of parts left out."""
        return self.predicted if self.holdout is None else self.holdout

    @property
    def count(self) -> int:
        """Number of parameters that the effects added."""
        return sum(len(p.bounds) for p in self.placed)

    @property
    def effective(self) -> float:
        """Number of independent residuals: fewer than rows where neighbours are alike."""
        rho = min(max(self.correlation, 0.0), 0.999)
        return max(self.rows * (1.0 - rho) / (1.0 + rho), 4.0)

    @property
    def gains(self) -> list[int]:
        """The places in theta of the nominal model's own free parameters."""
        added = {n for p in self.placed for n in p.names.values()}
        return [k for k, f in enumerate(self.problem.free) if f.name not in added]

    def _runs_with(self, tolerance: Tolerance) -> list[Statistics]:
        """Return the statistics of a run of each fitted experiment; none of a model that is closed inside and steps as it likes."""
        if not is_white_box(self.model):
            return []
        plain = [e.with_(measured=None) for e in self.problem.fitted_experiments]
        return [simulate(self.model, e, self.values, tolerance=tolerance).statistics for e in plain]

    @cached_property
    def _runs(self) -> list[Statistics]:
        return self._runs_with(REFIT_TOLERANCE)

    @cached_property
    def _slides(self) -> bool:
        """Return True where the model slides by itself: candidates on it have to, too."""
        try:
            self._runs_with(replace(REFIT_TOLERANCE, slides=False))
        except SimulationError:
            return True
        return False

    @cached_property
    def patience(self) -> Tolerance:
        """Tolerance of the runs of a model with more than this one has, with the steps that they may take."""
        own = max((s.accepted + s.rejected for s in self._runs), default=0)
        rows = max((e.time.size for e in self.problem.fitted_experiments), default=0)
        return replace(REFIT_TOLERANCE, max_steps=STEPS_PER_OWN_STEP * own + STEPS_PER_ROW * rows, slides=self._slides)

    @property
    def method(self) -> Method:
        """Method of the runs of a model with a movable effect: it must not depend on what was run before."""
        return "nonstiff" if all(s.method == "explicit" for s in self._runs) else "rosenbrock"

    @property
    def theta_at_given(self) -> Array:
        """(p,) theta with the gains at their given values, which may lie outside their bounds; the rest as it is."""
        theta = self.theta.copy()
        theta[self.gains] = [self.problem.free[k].given for k in self.gains]
        return theta

    def sizes(self, placed: Placed) -> dict[str, float]:
        """The effect's own parameters at the optimum."""
        at = self.values
        own = dict(placed.start)
        return own | {n: at[name] for n, name in placed.names.items() if name in at}

    def nominal(self) -> Nominal:
        """The refitted model as something to test further."""
        return Nominal(self.problem, self.theta, self.noise)


@dataclass(frozen=True, eq=False)
class RefitResult:
    """Result of a refit without its job: small enough to be sent and stored. Fields as in `Refit`."""

    theta: Array
    chi2: float
    rows: int
    correlation: float
    holdout: float | None
    predicted: float | None
    unseen_rows: int
    std: FrozenMap[float | None]
    apart: tuple[float, ...]
    followed: float
    failure: str
    ended: bool

    def refit(self, job: RefitJob) -> Refit:
        """The refit of the job that found this."""
        own = {f.name: getattr(self, f.name) for f in fields(self)}
        return Refit(job.model, job.placed, job.problem, job.noise, **own)


def refit_result(job: RefitJob) -> RefitResult:
    """Result of `run` without its job; what it raises is its failure."""
    try:
        return result_of(refitted(job))
    except FAILURES as error:
        return result_of(failed(job, error))


def failed_at(before: Refit, why: str) -> Refit:
    """The refit of a model with one more effect that could not be made, with the model before it."""
    return Refit(before.model, before.placed, before.problem, before.noise, before.theta, failure=why)


def failed(job: RefitJob, error: Exception) -> Refit:
    """The refit of a job that could not be done, where it would have begun, with the reason."""
    return Refit(
        job.model, job.placed, job.problem, job.noise, job.begins[0], failure=str(error) or type(error).__name__
    )


def result_of(refit: Refit) -> RefitResult:
    """Result of a refit without its job."""
    return RefitResult(**{f.name: getattr(refit, f.name) for f in fields(RefitResult)})


def refitted(job: RefitJob) -> Refit:
    """The end of the best start, judged on the held-out experiments too; a failure is returned, not raised."""
    scanned = any(effects()[p.candidate.effect].needs_grid for p in job.placed)
    most = min(job.evaluations, EVALUATIONS_AFTER_SCAN) if scanned else job.evaluations
    end = _best_walk(job, most)
    # A walk that stalled stands somewhere all the same: with samplers and levels the cost has steps of its own.
    if end.cost is None:
        return Refit(job.model, job.placed, job.problem, job.noise, job.begins[0], failure=end.message)
    ended = scanned or end.status != "max-evaluations"
    best = Refit(job.model, job.placed, job.problem, job.noise, end.theta, 2.0 * end.cost, ended=ended)
    if not job.judged:
        return best
    try:
        return judged(best)
    except FAILURES as error:
        return replace(best, failure=str(error))


def _best_walk(job: RefitJob, most: int) -> OptimiserResult:
    """The end of a walk of so many evaluations from the start with the least cost, of those from which one can be walked."""
    starts = _apart(job.begins)
    if len(starts) > 1:
        starts = sorted(starts, key=lambda begin: _cost_at(job, begin))
    walks = (_walk(job.problem, begin, most) for begin in starts)
    first = next(walks)
    return first if first.cost is not None else next((w for w in walks if w.cost is not None), first)


def _cost_at(job: RefitJob, begin: Array) -> float:
    """Sum of squared residuals at a start; infinite where the model does not run there."""
    try:
        # The values alone of a model that is not moved would need machine code of their own.
        moves = bool(job.placed) and job.placed[-1].movable
        blocks = job.problem.blocks(begin, derivatives=not moves)
    except FAILURES:
        return math.inf
    return sum(b.chi2 for b in blocks)


def _walk(problem: Problem, begin: Array, evaluations: int) -> OptimiserResult:
    """The end of a walk, failed with the reason where the model raises."""
    try:
        return replace(OPTIMISER, max_evaluations=evaluations).run(problem, begin)
    except FAILURES as error:
        return OptimiserResult(begin, None, "failed", str(error), 0)


def _apart(begins: Sequence[Array]) -> list[Array]:
    """The starts, each once."""
    return [b for k, b in enumerate(begins) if not any(np.array_equal(b, a) for a in begins[:k])]


def judged(refit: Refit) -> Refit:
    """The refit with its intervals, and what it predicts of data it has not seen."""
    blocks = refit.problem.blocks(refit.theta)
    names, known = refit.problem.names, uncertainty_of(refit.problem, blocks)
    # What unknown starts took is what chance would have left there: refits with and without them are then compared fairly.
    chi2 = sum(b.chi2 + b.taken for b in blocks)
    rows = sum(b.residual.size for b in blocks)
    wider = float(np.sqrt(max(1.0, chi2 / max(rows - len(names), 1))))
    std = {f.name: None if (s := known.std(f.name)) is None else wider * s for f in refit.problem.free}
    apart = tuple(_apart_from_nothing(refit, p, known, blocks) / wider for p in refit.placed)
    others = held_out(refit.problem, refit.theta)
    return replace(
        refit, chi2=chi2, rows=rows, correlation=_correlation(blocks), holdout=root_mean_square(others),
        predicted=predictive_score(blocks, others),
        unseen_rows=rows if others is None else sum(b.residual.size for b in others), std=FrozenMap(std), apart=apart,
        followed=followed_noise(refit.problem, refit.theta),
    )  # fmt: skip


def without_bias(refit: Refit) -> Refit:
    """Return a refit whose values are free of what they gain by following less of the noise of played inputs.

    The refit is returned as it is where the step does not make chi2 less the followed noise smaller, as one along values that the records
    hardly determine, or leads where the model does not run.
    """
    if not follows_noise(refit.problem):
        return refit
    try:
        freed = judged(replace(refit, theta=unbiased(refit.problem, refit.theta)))
    except FAILURES:
        return refit
    return freed if freed.chi2 - freed.followed < refit.chi2 - refit.followed else refit


def uncertainty_of(problem: Problem, blocks: Sequence[ResidualBlock]) -> Uncertainty:
    """Return the uncertainty of a problem's unknowns by its residuals, whose noise is taken as known."""
    spans = np.array([u.span for u in problem.unknowns])
    return uncertainty(blocks, problem.names, spans, dict.fromkeys(problem.outputs, "given"))


def _apart_from_nothing(refit: Refit, placed: Placed, known: Uncertainty, blocks: Sequence[ResidualBlock]) -> float:
    """Distance of an effect's parameters from neutral, in standard deviations; 0 where that is not known."""
    entry, sizes = effects()[placed.candidate.effect], refit.sizes(placed)
    fitted = [n for n, name in placed.names.items() if name in known.names]
    here = distance_from_neutral(entry, sizes)
    if not fitted or not here:
        return 0.0
    slopes: Array = np.zeros((len(here), len(fitted)))
    for k, n in enumerate(fitted):
        h = 1e-6 * abs(sizes[n]) or 1e-9
        there = distance_from_neutral(entry, {**sizes, n: sizes[n] + h})
        slopes[:, k] = np.array([there.get(m, v) - v for m, v in here.items()]) / h
    at = [known.names.index(placed.names[n]) for n in fitted]
    spread = slopes @ _covariance(known, at, blocks) @ slopes.T
    distance = np.array(list(here.values()))
    scale = np.sqrt(np.diag(spread))
    seen = scale > 0
    if not seen.any():
        return 0.0
    d, unit = distance[seen] / scale[seen], spread[np.ix_(seen, seen)] / np.outer(scale[seen], scale[seen])
    square = float(d @ np.linalg.pinv(unit, rcond=1e-9, hermitian=True) @ d)
    return math.sqrt(max(square, 0.0))


def _covariance(known: Uncertainty, at: Sequence[int], blocks: Sequence[ResidualBlock]) -> Array:
    """The covariance of some unknowns; where the data determine only combinations of them, of those, and 0 along the others.

    The constant and the linear part of a loss are one where a signal has two levels, and are there all the same.
    """
    if not any(known.names[k] in known.reasons for k in at):
        return known.corrected[np.ix_(at, at)]
    jacobian = np.vstack([b.jacobian for b in blocks])
    scale = np.linalg.norm(jacobian[:, at], axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    own, others = jacobian[:, at] / scale, orthonormal(np.delete(jacobian, at, axis=1))
    _, s, directions = np.linalg.svd(own - others @ (others.T @ own), full_matrices=False)
    scaled = directions[s > SINGULAR] / s[s > SINGULAR, None]
    return np.asarray(scaled.T @ scaled / np.outer(scale, scale))


def _correlation(blocks: Sequence[ResidualBlock]) -> float:
    """The lag-1 autocorrelation of all residuals, 0 where it is negative or what chance gives."""
    power = sum(float(b.score @ b.score) for b in blocks)
    rows = sum(b.residual.size for b in blocks)
    records = [b.score[part] for b in blocks for part in b.stretches]
    found = sum(float(r[1:] @ r[:-1]) for r in records) / power if power else 0.0
    return found if found > 2.0 / np.sqrt(rows) else 0.0


def signal(refit: Refit, place: str) -> dict[str, Array]:
    """The signal at a place of the model as refitted, by fitted experiment. Raises SimulationError where it cannot be run.

    A model that is closed inside, as an FMU, gives only its outputs: what enters it is the experiment's own input.
    """
    name = place.removeprefix("outputs.")
    model, experiments = refit.model, refit.problem.fitted_experiments
    if not is_white_box(model) and name == place and name in model.inputs:
        at_rest = {**{n: i.value for n, i in model.inputs.items()}, **refit.values}
        return {e.name: _input(e, name, e.values.get(name, at_rest[name])) for e in experiments}
    runs = {e.name: e.with_(measured=None) for e in experiments}
    return {n: np.asarray(simulate(model, e, refit.values, outputs=[name])[name]) for n, e in runs.items()}


def _input(experiment: Experiment, name: str, at_rest: float) -> Array:
    """An input at the experiment's rows, (n,); at_rest: what it is where the experiment does not move it."""
    moved = experiment.inputs.get(name)
    course = np.full(experiment.time.size, at_rest) if moved is None else moved(experiment.time)
    return np.asarray(course + experiment.offsets.get(name, 0.0))


def refit_job(
    before: Refit,
    candidate: CandidateEffect,
    probe: int,
    factor: float,
    theta: Array,
    movable: Movable | None = None,
    ran: Array | None = None,
) -> RefitJob:
    """Return the refit of a model with one more effect, at a probe times a factor, begun beside the unknowns `theta`, or, where that
    is better, at the probe itself beside the unknowns `ran`: a step that a score asks for may lead too far.

    movable: the model with an effect of this form that can be moved, where there is one; else the effect is put in.
    Raises ModelError where the effect cannot sit there.
    """
    candidate = with_wider_bounds(candidate, probe, factor)
    chosen, values = candidate.probes[probe], scaled_sizes(candidate, probe, factor)
    use = candidate.use(replace(chosen, values=FrozenMap(values)))
    entry, plain = effects()[candidate.effect], before.model
    anywhere = before.problem.free_initial_states
    larger = apply_effects(plain, [use]) if movable is None or (entry.holds and not anywhere) else plain
    anywhere = anywhere or begins_anywhere(larger, plain, [use])
    held: dict[str, float] = {}
    if movable is None:
        model, simulator = larger, ModelSimulator(larger, before.patience)
        present = [n for n in entry.present(values) if n not in candidate.named]
        names = dict(zip(present, [n for n in model.parameters if n not in plain.parameters], strict=True))
    else:
        model, simulator = movable.model, movable.simulator(before.patience, before.method)
        known = before.values
        named = {n: known.get(p, model.parameters[p].value) for n, p in candidate.named.items()}
        names = {n: name for n, name in movable.names.items() if n not in candidate.named}
        held = movable.placed(candidate) | movable.sized({**values, **named})
    bounds = {n: b for n, b in chosen.free.items() if n in names}
    free = tuple(FitParameter(names[n], values[n], low, high) for n, (low, high) in bounds.items())
    problem = replace(
        before.problem,
        simulator=simulator,
        free=(*before.problem.free, *free),
        held=before.problem.held | {n: v for n, v in held.items() if n not in {f.name for f in free}},
        free_initial_states=anywhere,
    )
    placed = Placed(candidate, use, FrozenMap(names), FrozenMap(bounds), FrozenMap(values), movable=movable is not None)
    k = len(before.problem.free)
    asked = scaled_sizes(candidate, probe, factor, MAX_PROPORTIONAL_FACTOR)
    beside = [(theta, values), (theta, asked), *([] if ran is None else [(ran, scaled_sizes(candidate, probe, 1.0))])]
    begins = tuple(np.concatenate([at[:k], [size[n] for n in bounds], at[k:]]) for at, size in beside)
    return RefitJob(model, (*before.placed, placed), problem, begins, before.noise)


def with_given_gains(refit: Refit) -> Array | None:
    """The unknowns with the gains at their given values, as near as the bounds let; None where they are there already."""
    theta = refit.theta_at_given
    for k in refit.gains:
        f = refit.problem.free[k]
        theta[k] = min(max(theta[k], f.min), f.max)
    return None if np.array_equal(theta, refit.theta) else theta


def built_in(before: Refit, trial: Refit) -> Refit:
    """Return a refit with its last effect compiled into the model `before`, refitted from there; a failure is returned."""
    placed = trial.placed[-1]
    if not placed.movable:
        return trial
    sizes = FrozenMap(trial.sizes(placed))
    probe = Probe(placed.candidate.effect, sizes, placed.bounds)
    try:
        only = replace(placed.candidate, probes=(probe,))
        found = refitted(replace(refit_job(before, only, 0, 1.0, before.theta), begins=(trial.theta,)))
    except FAILURES as error:
        return replace(trial, failure=str(error))
    candidate = replace(found.placed[-1].candidate, probes=placed.candidate.probes)
    return replace(found, placed=(*found.placed[:-1], replace(found.placed[-1], candidate=candidate)))


def refit_again(first: Refit, here: Refit, placed: Sequence[Placed]) -> Refit:
    """The nominal model `first` with these effects, refitted from where they stand in the hypothesis `here`; a failure is returned."""
    try:
        return refitted(joint_refit_job(first, here, placed, {}))
    except FAILURES as error:
        return replace(here, failure=str(error))


def joint_refit_job(
    first: Refit, here: Refit, placed: Sequence[Placed], sizes: dict[int, dict[str, float]]
) -> RefitJob:
    """The refit of the nominal model with these effects; sizes: of some, by their place, instead of where they stand."""
    model, free, again = first.model, list(first.problem.free), []
    at = here.values
    for k, p in enumerate(placed):
        own = sizes.get(k) or {n: at.get(name, p.start[n]) for n, name in p.names.items()}
        values = {n: float(np.clip(own.get(n, v), *p.bounds[n])) if n in p.bounds else v for n, v in p.start.items()}
        named = {n: v for n, v in p.use.parameters.items() if isinstance(v, str)}
        parameters: dict[str, float | str] = {**values, **named}
        use = replace(p.use, parameters=FrozenMap(parameters), prefix="").within(model)
        before = set(model.parameters)
        model = apply_effects(model, [use])
        new = [n for n in model.parameters if n not in before]
        names = dict(zip(p.names, new, strict=True))
        free += [FitParameter(names[n], values[n], *p.bounds[n]) for n in p.bounds]
        scaled_sizes = replace(p.candidate, at=use.at, source=use.source)
        again.append(replace(p, candidate=scaled_sizes, use=use, names=FrozenMap(names), start=FrozenMap(values)))
    problem = replace(
        here.problem,
        simulator=ModelSimulator(model, first.patience),
        free=tuple(free),
        held=first.problem.held,
        free_initial_states=begins_anywhere(model, first.model, [p.use for p in placed]),
    )
    nuisance = here.theta[len(here.problem.free) :]
    gains = [at.get(f.name, f.start) for f in first.problem.free]
    begin = np.concatenate([gains, [f.start for f in free[len(gains) :]], nuisance])
    return RefitJob(model, tuple(again), problem, (begin,), here.noise)


def slot_signals(before: Refit) -> dict[str, tuple[Array, ...]]:
    """The signal at every slot of the model that all experiments have, one array an experiment, at its rows.

    An instrument has slots of its own in the run of its experiment, which are none of the model's. Nothing is looked for
    inside the effects that are in the model already.
    """
    model, experiments = before.model, before.problem.fitted_experiments
    slots = [p for p in model.insertion_points if not any(one.use.made(p) for one in before.placed)]
    if not is_white_box(model):
        inputs = {p: tuple(signal(before, p).values()) for p in slots if p in model.inputs}
        outputs = [o for o in experiments[0].outputs if all(o in e.outputs for e in experiments)]
        runs = [simulate(model, e.with_(measured=None), before.values, outputs=outputs) for e in experiments]
        ends = {o if o not in model.inputs else f"outputs.{o}": o for o in outputs}
        return inputs | {p: tuple(np.asarray(r[o]) for r in runs) for p, o in ends.items() if p in slots}
    # Of outputs those that are recorded: an effect at another one is not seen.
    recorded = {o for e in experiments for o in e.outputs}
    kinds = {p: insertion_point(model, p) for p in slots}
    kept = [p for p in slots if kinds[p][0] != "output" or kinds[p][1] in recorded]
    names = list(dict.fromkeys(kinds[p][1] for p in kept))
    tolerance = before.problem.simulator.tolerance if isinstance(before.problem.simulator, ModelSimulator) else None
    once = replace(tolerance or Tolerance(), brief=True)  # one run of each experiment with all of them
    found: dict[str, list[Array]] = {p: [] for p in kept}
    for e in experiments:
        run = simulate(model, e.with_(measured=None, instrument={}), before.values, outputs=names, tolerance=once)
        for p in kept:
            found[p].append(np.asarray(run[kinds[p][1]]))
    return {p: tuple(own) for p, own in found.items()}


def last_placed(refit: Refit, k: int) -> Refit:
    """Return the refit with the effect in place k moved to the end, as that of a trial is."""
    order = [*(j for j in range(len(refit.placed)) if j != k), k]
    return replace(refit, placed=tuple(refit.placed[j] for j in order), apart=tuple(refit.apart[j] for j in order))
