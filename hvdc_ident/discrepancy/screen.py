"""The screen: every effect at every place, from every source, in a few sizes, simulated beside the parameters' answer.

A candidate is a run of the model with the movable effect at its place, and a bounded Gauss-Newton step of the size and the unknowns
from some point (the optimum of the model without effects, the given values, the end of a refit), with the answers that the unknowns
have there without an effect. What noise alone makes of the best of all these candidates is had
from records of noise (the largest of several statistics; Westfall and Young, 1993).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from hvdc_ident.data import Array, Experiment
from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.hypothesis import FAILURES
from hvdc_ident.discrepancy.movable import Form, Movable, in_proportion, is_proportional, movable, on_loop
from hvdc_ident.discrepancy.nominal import Nominal
from hvdc_ident.effects import apply_effects, distance_from_neutral, effects
from hvdc_ident.errors import SteadyStartError
from hvdc_ident.executor import Executor, mapped
from hvdc_ident.fit import Problem
from hvdc_ident.fit.problem import stacked
from hvdc_ident.fit.residual import unknown_initial_states, with_steady_start
from hvdc_ident.model import AnyModel, insertion_point, is_white_box
from hvdc_ident.simulate import Method, ModelSimulator, Tolerance

SCREEN_TOLERANCE = Tolerance(rtol=1e-5, atol=1e-8, search=False, brief=True)
"""Of a first look. Its runs are exact to a hundredth of the noise; one that has no steady state at once begins elsewhere."""
ANY_FACTOR, UP_TO_ONE = (-np.inf, np.inf), (0.0, 1.0)
"""Factors on the size of an effect in proportion to it; of another, between nothing and the size that was run."""
EXCITED_CHI2 = 1.0
"""Sum of squares of an answer, in noise units, below which no experiment excites it."""
LEAST_SHARE_LEFT = 1e-3
"""Share of the square of an answer that the parameters have to leave: runs of a search are exact to a few of its hundredths."""
NOT_TRIED = "not tried: the budget ended"
"""Failure of a candidate that was not simulated, or not refitted."""
BATCH_SIZE = 150
"""Candidates in one piece of work: some tenths of a second."""
TOGETHER = 64
"""Candidates whose runs are compared in one go: a matrix product of so many columns takes little more than of one."""


@dataclass(frozen=True, eq=False)
class Score:
    """One candidate at one size.

    candidate, probe: its places in the lists. fall: by how much chi2 falls, beside the model without effects at its
    optimum. theta: the unknowns of that model after the step. factor: the size asked for, in units of the probe's distance from
    neutral. ran: the unknowns that the candidate was run beside, where it was.
    """

    candidate: int
    probe: int
    fall: float
    theta: Array
    factor: float = 1.0
    ran: Array | None = None


@dataclass(frozen=True, eq=False)
class Screen:
    """Result of a screen of all candidates.

    scores: those that run, the best first. size, left: by candidate and probe the square of the answer in noise units, and what
    of it the parameters leave. largest: (B,) the largest score of all in each record of noise. failures: by candidate why none
    of its sizes runs. answers: by candidate and probe what it adds to the residual, sketched (`Sketch`).
    """

    scores: tuple[Score, ...]
    size: Mapping[tuple[int, int], float]
    left: Mapping[tuple[int, int], float]
    largest: Array
    failures: Mapping[int, str]
    answers: Mapping[tuple[int, int], NDArray[np.float32]] = field(default_factory=dict)

    def p(self, fall: float) -> float:
        """Return the chance that noise alone makes chi2 fall as much anywhere."""
        return float((1 + np.count_nonzero(self.largest >= fall)) / (1 + self.largest.size))

    def best(self) -> dict[int, Score]:
        """Return the best score of each candidate, the best first."""
        found: dict[int, Score] = {}
        for s in self.scores:
            found.setdefault(s.candidate, s)
        return found

    @classmethod
    def of(cls, parts: Sequence[Screen], candidates: Sequence[CandidateEffect]) -> Screen:
        """Return parts of a screen in one, of different candidates or sizes, from the same point beside the same noise."""
        scores = ranked((s for part in parts for s in part.scores), candidates)
        ran = {s.candidate for s in scores}
        failures = {k: why for part in reversed(parts) for k, why in part.failures.items() if k not in ran}
        return cls(
            scores,
            {c: v for part in parts for c, v in part.size.items()},
            {c: v for part in parts for c, v in part.left.items()},
            np.max([part.largest for part in parts], axis=0),
            failures,
            {c: v for part in parts for c, v in part.answers.items()},
        )

    def reordered(self, at: Linearised, candidates: Sequence[CandidateEffect]) -> list[int]:
        """Return the candidates by chi2 after a step from elsewhere, the best first, with the answers that they had where they were run.

        at: the model without effects there. Answers beside other unknowns are not those there: this is an order, which costs no run.
        """
        sketch = Sketch(at.residual.size)
        slopes = np.column_stack([sketch(column) for column in at.jacobian.T])
        there = Linearised(sketch(at.residual), slopes, at.low, at.high)
        best: dict[int, float] = {}
        answers = list(self.answers.items())
        for part in (answers[n : n + TOGETHER] for n in range(0, len(answers), TOGETHER)):
            reach = [_reach(candidates[k], n) if in_proportion(candidates[k], n) else UP_TO_ONE for (k, n), _ in part]
            _, chi2, _ = there.stepped(np.column_stack([added.astype(float) for _, added in part]), reach)
            for ((k, _), _), left in zip(part, chi2.tolist(), strict=True):
                best[k] = min(left, best.get(k, np.inf))
        return sorted(best, key=lambda k: best[k])

    def usable(self, column: tuple[int, int]) -> bool:
        """Return True for a size that the experiments excite and the parameters cannot make good."""
        return self.size[column] >= EXCITED_CHI2 and self.left[column] > LEAST_SHARE_LEFT * self.size[column]

    def absorbed(self) -> list[int]:
        """Return the candidates that the experiments excite and the parameters make good altogether."""
        own: dict[int, list[bool]] = {}
        for column, size in self.size.items():
            if size >= EXCITED_CHI2:
                own.setdefault(column[0], []).append(self.usable(column))
        return [c for c, usable in own.items() if not any(usable)]


@dataclass(frozen=True, eq=False)
class Linearised:
    """A residual (N,), its derivatives (N, p) by some unknowns, and bounds (p,) on a step of them."""

    residual: Array
    jacobian: Array
    low: Array
    high: Array

    @cached_property
    def _normal(self) -> tuple[Array, Array, Array, Array]:
        """The derivatives in columns of length 1, these lengths, their products with each other, and with the residual."""
        scale = np.linalg.norm(self.jacobian, axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        unit = self.jacobian / scale
        return unit, scale, unit.T @ unit, unit.T @ self.residual

    def stepped(
        self, added: Array, reach: Sequence[tuple[float, float]], *, held: bool = False
    ) -> tuple[Array, Array, Array]:
        """Return for k effects the bounded step that lowers chi2 most to first order, (k, p), chi2 after it, and the factor on the
        size, both (k,).

        added: (N, k) what each adds to the residual in the size that was run. reach: bounds of each factor. held: whether it is 1.
        """
        unit, scale, square, asked = self._normal
        count, p = added.shape[1], scale.size
        low, high = np.tile(self.low * scale, (count, 1)), np.tile(self.high * scale, (count, 1))
        chi2, own = float(self.residual @ self.residual), self.residual @ added
        wanted, beside = np.tile(asked, (count, 1)), (unit.T @ added).T
        if held:
            squares, chi2 = (
                np.broadcast_to(square, (count, p, p)),
                chi2 + 2.0 * own + np.einsum("nk,nk->k", added, added),
            )
            wanted = wanted + beside
        else:
            size = np.linalg.norm(added, axis=0)
            size = np.where(size > 0.0, size, 1.0)
            squares = np.ones((count, p + 1, p + 1))
            squares[:, :p, :p] = square
            squares[:, p, :p] = squares[:, :p, p] = beside / size[:, None]
            wanted = np.column_stack([wanted, own / size])
            ends = np.array(reach).reshape(count, 2) * size[:, None]
            low, high = np.column_stack([low, ends[:, 0]]), np.column_stack([high, ends[:, 1]])
        step = _bounded(squares, wanted, low, high)
        after = chi2 + np.einsum("ki,ki->k", 2.0 * wanted + np.einsum("kij,kj->ki", squares, step), step)
        factor = np.ones(count) if held else step[:, p] / size
        return step[:, :p] / scale, np.maximum(after, 0.0), factor


SKETCHED = 1024
"""Sums of rows that are kept of an answer: products of two answers are those of all rows to a thirtieth of their lengths."""


@lru_cache(maxsize=4)
def _sums(rows: int) -> tuple[NDArray[np.intp], Array]:
    """Return the sum that each row goes to, and its sign, both (rows,)."""
    random = np.random.default_rng(0)
    return random.integers(SKETCHED, size=rows), random.choice([-1.0, 1.0], size=rows)


@dataclass(frozen=True)
class Sketch:
    """Sums of rows with random signs, which keep the products of columns about as they are (Charikar, Chen and Farach-Colton 2002).

    rows: number N of a column's rows.
    """

    rows: int

    @property
    def size(self) -> int:
        """Number m of sums."""
        return min(self.rows, SKETCHED)

    def __call__(self, column: Array) -> Array:
        """Return (m,) of a column (N,)."""
        if self.rows <= SKETCHED:
            return column
        to, sign = _sums(self.rows)
        return np.asarray(np.bincount(to, sign * column, SKETCHED), dtype=float)

    def kept(self, answer: Array) -> NDArray[np.float32]:
        """Return (m,) of an answer (N,) in half the digits; one that runs away is as large as they let."""
        most = float(np.finfo(np.float32).max)
        return np.clip(self(answer), -most, most).astype(np.float32)


@dataclass(frozen=True, eq=False)
class ScreenSetup:
    """What candidates are compared on: the model without them, its optimum, and noise.

    patience, method: of runs of candidates. places, sources: where movable effects may sit, and what they may bring in: the same for
    all, so that an effect is compiled once. point: unknowns that candidates are looked at from. noise: (N, B) records, without what the
    parameters make good. still: places whose signal never moves. held: whether sizes are as they are.
    """

    model: AnyModel
    nominal: Nominal
    patience: Tolerance
    method: Method
    places: tuple[str, ...]
    sources: tuple[str, ...]
    point: Array
    noise: NDArray[np.float32]
    still: frozenset[str] = frozenset()
    held: bool = False

    @cached_property
    def without(self) -> Linearised:
        """The residual of the model without effects, linear in the unknowns."""
        own, unknowns = self.nominal, self.nominal.problem.unknowns
        found = stacked(own.blocks if np.array_equal(self.point, own.theta) else own.problem.blocks(self.point))
        low, high = np.array([u.min for u in unknowns]), np.array([u.max for u in unknowns])
        return Linearised(*found, low - self.point, high - self.point)

    @cached_property
    def at_rest(self) -> tuple[Experiment, ...]:
        """The experiments, those fitted begun at the steady state of the model without effects."""
        return tuple(_at_rest(self.nominal.problem, e, self.point) for e in self.nominal.problem.experiments)

    @cached_property
    def nominal_chi2(self) -> float:
        """Sum of squared residuals of the model without effects at its optimum."""
        return float(self.nominal.residual @ self.nominal.residual)

    @property
    def haste(self) -> Tolerance:
        """Tolerance of the runs of a first look."""
        return replace(SCREEN_TOLERANCE, max_steps=self.patience.max_steps, slides=self.patience.slides)

    def movable(self, form: Form) -> Movable:
        """Return the model with an effect of this form, at one place, to be moved. It has to be one with equations."""
        assert is_white_box(self.model)
        model, kinds = self.model, effects()[form.effect].insertion_kinds
        places = tuple(
            p for p in self.places if insertion_point(model, p)[0] in kinds and on_loop(model, p) == form.loop
        )
        return movable(model, replace(form, copies=1), places, self.sources)


def _at_rest(problem: Problem, experiment: Experiment, theta: Array) -> Experiment:
    """Return the experiment with the states that begin at rest begun where the problem's own model rests."""
    states = unknown_initial_states(problem.simulator, experiment)
    if experiment.role != "fit" or experiment.domain != "time" or not states:
        return experiment
    nuisance = problem.nuisances(experiment, theta)
    return with_steady_start(problem.simulator, experiment, problem.values(theta), states, nuisance)


@dataclass(frozen=True, eq=False)
class _Batch:
    """Columns (candidate, probe) of one form, the candidates, and how a column is run.

    movable: the models that they run on, by whether their place is on a loop; none of a model that is closed inside.
    """

    setup: ScreenSetup
    movable: Mapping[bool, Movable]
    columns: Sequence[tuple[int, int]]
    candidates: Mapping[int, CandidateEffect]

    def reach(self, column: tuple[int, int]) -> tuple[float, float]:
        """Factors on the size that a step may ask for."""
        if not any(is_proportional(m.form) for m in self.movable.values()):
            return UP_TO_ONE
        return _reach(self.candidates[column[0]], column[1])

    @cached_property
    def _problems(self) -> Mapping[bool, Problem]:
        setup = self.setup
        own, how = setup.nominal.problem, (setup.haste, setup.method)
        return {x: replace(own, simulator=m.simulator(*how)) for x, m in self.movable.items()}

    @cached_property
    def _from_rest(self) -> Mapping[bool, Problem]:
        """The problems with runs that begin where the model without an effect rests."""
        return {x: replace(p, experiments=self.setup.at_rest) for x, p in self._problems.items()}

    def __call__(self, column: tuple[int, int]) -> Array:
        """Return (M,) the misfits with a candidate in the size of a probe (`Problem.misfits`)."""
        setup, candidate = self.setup, self.candidates[column[0]]
        own, theta, probe = setup.nominal.problem, setup.point, candidate.probes[column[1]]
        if not self.movable or not is_white_box(setup.model):
            larger = apply_effects(setup.model, [candidate.use(probe)])
            return replace(own, simulator=ModelSimulator(larger, setup.patience)).misfits(theta, {})
        loop = on_loop(setup.model, candidate.at[0])
        moved = self.movable[loop]
        known = own.values(theta) if candidate.named else {}
        named = {n: known.get(str(p), setup.model.parameters[str(p)].value) for n, p in candidate.named.items()}
        values = moved.placed(candidate) | moved.sized({**probe.values, **named})
        if effects()[
            candidate.effect
        ].self_exciting:  # what it does at the first row is no state that the plant rests in
            return self._from_rest[loop].misfits(theta, values)
        try:
            return self._problems[loop].misfits(theta, values)
        except SteadyStartError:  # it leaves no steady state, as levels in a loop do not, or none near
            return self._from_rest[loop].misfits(theta, values)


def screened(
    setup: ScreenSetup,
    candidates: Sequence[CandidateEffect],
    *,
    executor: Executor | None = None,
    tell: Callable[[int, int], None] = lambda done, total: None,
    columns: Iterable[tuple[int, int]] | None = None,
    spent: Callable[[], bool] = lambda: False,
) -> Screen:
    """Return the screen of candidates; one at several places is computed from its parts.

    columns: candidates and probes, by their places in the lists, instead of all that move. spent: whether the budget is over; what
    was not simulated by then has failed, but for the first piece of work.
    """
    every = ((k, n) for k, c in enumerate(candidates) if not c.still for n in range(len(c.probes)))
    batches = list(_batches(setup, candidates, every if columns is None else columns))
    parts = [Screen((), {}, {}, np.zeros(setup.noise.shape[1]), {})]
    for done, found in enumerate(mapped(executor, _screened_batch, batches), start=1):
        parts += found
        tell(done, len(batches))
        if spent():
            parts.append(
                replace(parts[0], failures={k: NOT_TRIED for batch in batches[done:] for k, _ in batch.columns})
            )
            break
    return Screen.of(parts, candidates)


def ranked(scores: Iterable[Score], candidates: Sequence[CandidateEffect]) -> tuple[Score, ...]:
    """Return scores, the best first; of equal falls the simpler: fewer places first, as listed."""
    return tuple(
        sorted(scores, key=lambda s: (-round(s.fall, 6), len(candidates[s.candidate].at), s.candidate, s.probe))
    )


def _batches(
    setup: ScreenSetup, candidates: Sequence[CandidateEffect], asked: Iterable[tuple[int, int]]
) -> Iterator[_Batch]:
    """The columns by form; of a model that is closed inside each candidate by itself."""
    model = setup.model
    groups: dict[Form | int, list[tuple[int, int]]] = {}
    for k, n in asked:
        form = Form.of(model, candidates[k], candidates[k].probes[n].values) if is_white_box(model) else None
        groups.setdefault(k if form is None else replace(form, copies=1, loop=False), []).append((k, n))
    for key, columns in groups.items():
        own = sorted(columns, key=lambda c: len(candidates[c[0]].at))
        moved: dict[bool, Movable] = {}
        if isinstance(key, Form) and is_white_box(model):
            moved = {
                x: setup.movable(replace(key, loop=x)) for x in {on_loop(model, candidates[k].at[0]) for k, _ in own}
            }
        # Those at several places are computed from the answers at single ones, and stay with them.
        alone = sum(len(candidates[k].at) == 1 for k, _ in own)
        cut = [own] if alone < len(own) else [own[n : n + BATCH_SIZE] for n in range(0, len(own), BATCH_SIZE)]
        for part in cut:
            yield _Batch(setup, moved, part, {k: candidates[k] for k, _ in part})


def _screened_batch(batch: _Batch) -> list[Screen]:
    """The columns of a batch, simulated, in parts."""
    failures: dict[int, str] = {}
    parts = [Screen((), {}, {}, np.zeros(batch.setup.noise.shape[1]), failures)]
    answers: dict[tuple[int, int], Array] | None = {} if any(len(c.at) > 1 for c in batch.candidates.values()) else None
    run: dict[tuple[int, int], Array] = {}
    for column in batch.columns:
        if len(batch.candidates[column[0]].at) > 1 and batch.movable:
            continue
        try:
            run[column] = batch(column)
        except FAILURES as error:
            failures[column[0]] = str(error) or type(error).__name__
        if len(run) == TOGETHER:
            parts.append(_compared(batch, run, answers))
            run = {}
    if run:
        parts.append(_compared(batch, run, answers))
    if answers is not None and batch.movable:
        parts.append(_at_several(batch, answers))
    return parts


def _compared(
    batch: _Batch, run: Mapping[tuple[int, int], Array], answers: dict[tuple[int, int], Array] | None
) -> Screen:
    """Return what some columns do. run: by column its misfits; answers: to keep what each takes off the residual in."""
    setup = batch.setup
    nominal, was, columns = setup.nominal, setup.without.residual, list(run)
    added = nominal.problem.residuals(np.column_stack(list(run.values()))) - was[:, None]
    steps, fell, factors = setup.without.stepped(added, [batch.reach(c) for c in columns], held=setup.held)
    left = nominal.projected(-added)
    size, kept = np.einsum("nk,nk->k", added, added), np.einsum("nk,nk->k", left, left)
    sketch = Sketch(was.size)
    if answers is not None:
        answers |= {column: -added[:, n] for n, column in enumerate(columns)}
    told = (size >= EXCITED_CHI2) & (kept > LEAST_SHARE_LEFT * size)
    units = (left[:, told] / np.sqrt(kept[told])).astype(np.float32)
    largest = np.max(np.abs(units.T @ setup.noise), axis=0, initial=0.0).astype(float) ** 2
    return Screen(
        tuple(
            Score(*c, setup.nominal_chi2 - float(fell[n]), setup.point + steps[n], float(factors[n]), setup.point)
            for n, c in enumerate(columns)
        ),
        dict(zip(columns, size.tolist(), strict=True)),
        dict(zip(columns, kept.tolist(), strict=True)),
        largest,
        {},
        {c: sketch.kept(added[:, n]) for n, c in enumerate(columns)},
    )


def _at_several(batch: _Batch, answers: Mapping[tuple[int, int], Array]) -> Screen:
    """Return what an effect at several places does, to first order: the sum of what it does at each, in proportion to its size."""
    setup, candidates = batch.setup, batch.candidates
    nominal, chi2 = setup.nominal, setup.nominal_chi2
    single: dict[tuple[str, str], list[tuple[float, tuple[int, int]]]] = {}
    for k, n in answers:
        c = candidates[k]
        single.setdefault((c.at[0], c.source), []).append((distance(c, n), (k, n)))
    scores: list[Score] = []
    sizes: dict[tuple[int, int], float] = {}
    kept: dict[tuple[int, int], float] = {}
    sketches: dict[tuple[int, int], NDArray[np.float32]] = {}
    for k, n in batch.columns:
        c = candidates[k]
        if len(c.at) == 1:
            continue
        size, parts = distance(c, n), []
        own = {s: single.get(s) for s in zip(c.at, c.sources or ("",) * len(c.at), strict=True)}
        # Where nothing moves the effect does nothing, and was not run.
        moving = [near for (place, _), near in own.items() if near or place not in setup.still]
        if not size or not moving or not all(moving):
            continue
        for nearby in filter(None, moving):
            near, column = min(nearby, key=lambda s: abs(np.log(s[0] / size)) if s[0] > 0 else np.inf)
            parts.append(answers[column] * (size / near if near else 1.0))
        answer = np.sum(parts, axis=0, dtype=float)
        steps, fell, factors = setup.without.stepped(-answer[:, None], [UP_TO_ONE])
        left = nominal.projected(answer[:, None])[:, 0]
        sizes[k, n], kept[k, n] = float(answer @ answer), float(left @ left)
        sketches[k, n] = Sketch(answer.size).kept(-answer)
        scores.append(Score(k, n, chi2 - float(fell[0]), setup.point + steps[0], float(factors[0])))
    return Screen(tuple(scores), sizes, kept, np.zeros(setup.noise.shape[1]), {}, sketches)


def distance(candidate: CandidateEffect, probe: int) -> float:
    """Return how far a probe is from doing nothing."""
    away = distance_from_neutral(effects()[candidate.effect], candidate.probes[probe].values)
    return max((abs(v) for v in away.values()), default=0.0)


def _reach(candidate: CandidateEffect, probe: int) -> tuple[float, float]:
    """Return the factors on the size of a candidate in proportion to it that a step may ask for."""
    free = candidate.probes[probe].free
    return ANY_FACTOR if any(low < 0.0 for low, _ in free.values()) else (0.0, np.inf)


def _bounded(squares: Array, asked: Array, low: Array, high: Array) -> Array:
    """Return (k, n) the x between bounds at which x' square x + 2 asked' x is least; squares: (k, n, n) of columns of length 1."""
    # What is made of the other columns is rounding alone.
    halves = np.linalg.cholesky(squares + 1e-10 * np.eye(asked.shape[1]))
    targets = -np.linalg.solve(halves, asked[:, :, None])
    steps = np.linalg.solve(halves.transpose(0, 2, 1), targets)[:, :, 0]
    for k in np.flatnonzero(((steps < low) | (steps > high)).any(axis=1)):
        half, target = halves[k].T, targets[k, :, 0]
        clipped = np.clip(steps[k], low[k], high[k])
        # Nearly always the best has what was out of bounds on them, and the rest within: then this is it.
        on = clipped != steps[k]
        clipped[~on] = np.linalg.lstsq(half[:, ~on], target - half[:, on] @ clipped[on])[0]
        slope = half.T @ (half @ clipped - target)
        outwards = np.where(clipped == low[k], slope >= 0.0, slope <= 0.0)
        best = outwards[on].all() and ((low[k] <= clipped) & (clipped <= high[k])).all()
        steps[k] = clipped if best else lsq_linear(half, target, (low[k], high[k]), method="bvls").x
    return steps
