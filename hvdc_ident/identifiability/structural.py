"""Structural identifiability: the parameters that no data of these outputs could tell, and the combinations seen of them.

From the Taylor series of the equations where there are any that these reach; else from the rank of the sensitivities along the
records' runs at random points, which asks the simulator for nothing but runs with sensitivities (exact ones, or differences whose
error it states) and so serves models with delays and sampled parts, recordings played in, and models without equations here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np

from hvdc_ident.data import Array, Experiment
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import Problem
from hvdc_ident.fit.fit_parameter import starting_points
from hvdc_ident.fit.frequency_data import in_time
from hvdc_ident.fit.simulator import sensitivity_error
from hvdc_ident.model import Model
from hvdc_ident.sensitivity import (
    SENSITIVITY_ERROR,
    Combination,
    StructuralResult,
    identifiable_subset,
    null_directions,
    structural_identifiability,
)
from hvdc_ident.sensitivity.information import leading
from hvdc_ident.sensitivity.structural.combinations import SMALL, Point, combinations_seen, held_of, only_seen
from hvdc_ident.simulate import ModelEquations
from hvdc_ident.text import listed

SECONDS = 10.0
"""Time that the Taylor series may take; the shipped link takes 2 s."""
METHOD = "numerical, local"
INSTEAD = "from the sensitivities at random points, because"
POINTS = 5
COMBINATION_POINTS = 12
"""Number of points from which on no more are drawn for a combination of many parameters."""
WIDE = 8
"""Number of points of which one lies in each eighth of every parameter's range."""
NEAR = 0.02
"""Distance of a power from a half of a whole number, and of a coefficient from 1, that counts as none."""
ASIDE = 1e-3
"""Share of the way to a random point by which the start is left: at round values a delayed jump may meet a row of the record, where the
derivative by the delay has two values."""
INSIDE = (0.2, 0.8)
"""Share of the bounds that the points are drawn from: at a bound a parameter may do nothing that does else."""
CONSTANT = 1e-3
"""Share of itself by which a direction found from runs may differ from one point to the next and still be the same."""


def in_words(direction: Array, names: Sequence[str], logs: Sequence[bool], values: Sequence[float]) -> tuple[str, ...]:
    """Return the combinations that a null direction at one point leaves unchanged: simple products, else sums, else what fits there.

    direction: (p,) in scaled coordinates. logs: which coordinates are relative. values: of the parameters.
    """
    members = [i for i in range(len(names)) if abs(direction[i]) > SMALL * np.abs(direction).max()]
    pivot = members[0]
    words = []
    for i in members[1:]:
        ratio = float(direction[i] / direction[pivot])
        slope = ratio * (values[i] if logs[i] else 1.0) / ((values[pivot] if logs[pivot] else 1.0) or 1.0)
        power, both = round(-2.0 * ratio) / 2.0, logs[i] and logs[pivot]
        if both and power and abs(power + ratio) < NEAR:
            words.append(_product(names[pivot], names[i], power))
        elif abs(abs(slope) - 1.0) < NEAR:
            words.append(f"{names[i]} - {names[pivot]}" if slope > 0 else f"{names[pivot]} + {names[i]}")
        elif both:
            words.append(_product(names[pivot], names[i], -ratio))
        else:
            sign = "-" if slope > 0 else "+"
            words.append(f"{names[i]} {sign} {abs(slope):.3g}*{names[pivot]} (near these values)")
    return tuple(words)


def _product(pivot: str, name: str, power: float) -> str:
    """Return name * pivot^power as people write it."""
    if abs(power) == 1.0:
        return f"{pivot}*{name}" if power > 0 else f"{name}/{pivot}"
    return f"{name}*{pivot}^{power:.3g}"


def parameter_directions(columns: Array, count: int, error: float) -> Array:
    """Return the null directions of whitened, scaled sensitivities that move a parameter, (k, count), nuisances left out.

    columns: (n, p), the parameters first. error: relative, of the sensitivities.
    """
    null = null_directions(columns, error)[:, :count]
    return null[(np.abs(null) > 0).any(axis=1)]


def combinations_of(
    null: Array,
    names: Sequence[str],
    logs: Sequence[bool],
    values: Sequence[float],
    kind: Literal["structural", "practical"],
) -> tuple[Combination, ...]:
    """Return one combination for each null direction, (k, p) in scaled coordinates, with its members and words."""
    combinations = []
    for row in null:
        direction = {n: float(v) for n, v in zip(names, row, strict=True) if abs(v) > SMALL * np.abs(row).max()}
        members, seen = tuple(direction), in_words(row, names, logs, values)
        words = only_seen(members, seen)
        combinations.append(Combination(members, seen, words, directions=(tuple(direction.values()),), kind=kind))
    return tuple(combinations)


def partners(combinations: Sequence[Combination], held: Mapping[str, str]) -> dict[str, tuple[str, ...]]:
    """Return the held members of its combinations for each member that is not held."""
    by_member: dict[str, tuple[str, ...]] = {}
    for c in combinations:
        stuck = tuple(n for n in c.members if n in held)
        for n in c.members:
            if n not in held and stuck:
                by_member[n] = tuple(dict.fromkeys((*by_member.get(n, ()), *stuck)))
    return by_member


@dataclass(frozen=True)
class StructuralAnalysis:
    """The structural verdict on the candidates.

    status: decided, or not decided. method: "Taylor series at random points" or "numerical, local". admissible: the most that can
    be estimated together once the others are held; the earlier listed where there is a choice. combinations: what is seen of others.
    note: why it is not decided, or what the method cannot see. unmoved: parameters that show only where an input is
    moved that was not, or in another regime. moving: parameters that move the outputs along the records by more than the
    sensitivities' error. points: how many points of the numerical method could be simulated.
    """

    status: str = "not decided"
    method: str = ""
    admissible: tuple[str, ...] = ()
    combinations: tuple[Combination, ...] = ()
    note: str = ""
    unmoved: tuple[str, ...] = ()
    moving: tuple[str, ...] = ()
    points: int = 0
    stored_properties: ClassVar[tuple[str, ...]] = ("unidentifiable",)

    @property
    def local(self) -> bool:
        """Return True if that was found from numbers at some points, so that other points might show more."""
        return self.method.endswith("local")

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """Members of any combination."""
        return tuple(dict.fromkeys(n for c in self.combinations for n in c.members))


def scaled_slope(problem: Problem, theta: Array) -> Array:
    """Return the length of a scaled coordinate's unit, (p,): the value where an unknown is positive, else its range."""
    return np.array([v if u.min > 0 else u.span for u, v in zip(problem.unknowns, theta, strict=True)], dtype=float)


class _Runs:
    """Whitened sensitivities along the records' runs: at the start and at random points in the bounds.

    points: values of the unknowns, parameters first, with the (n, unknowns) sensitivities in scaled coordinates. failures: why
    some of the first POINTS could not be simulated. simulated: number of points before any were added. error: of the
    sensitivities, relative.
    """

    def __init__(self, problem: Problem, seed: int, wide: bool = False) -> None:
        """wide: at a Latin hypercube of points up to the bounds too."""
        self.problem, self.error = problem, sensitivity_error(problem.simulator)
        self.names = tuple(f.name for f in problem.free)
        self.points: list[tuple[Array, Array]] = []
        self._random = np.random.default_rng(seed)
        drawn = self._drawn(POINTS)
        self.failures = [f for f in map(self._run, drawn) if f]
        start = (1.0 - ASIDE) * problem.start + ASIDE * drawn[0]
        for theta in (start, *(starting_points(problem.unknowns, (), WIDE, seed) if wide else [])):
            self._run(theta)
        self.simulated = len(self.points)

    def _drawn(self, count: int) -> list[Array]:
        """Return random points."""
        unknowns = self.problem.unknowns
        shares = self._random.uniform(*INSIDE, (count, len(unknowns))).tolist()
        return [np.array([u.draw(s) for u, s in zip(unknowns, row, strict=True)]) for row in shares]

    def _run(self, theta: Array) -> str:
        """Add a point; return why it cannot be simulated, if so."""
        try:
            jacobian = self.problem.residual(theta)[1]
        except SimulationError as e:
            return e.what
        self.points.append((theta, jacobian * scaled_slope(self.problem, theta)))
        return ""

    @property
    def moving(self) -> tuple[str, ...]:
        """Parameters that move the outputs at any point by more than the sensitivities' error."""
        lengths = [np.linalg.norm(j, axis=0) for _, j in self.points]
        seen = np.any([n > self.error * n.max(initial=0.0) for n in lengths], axis=0)
        return tuple(n for n, e in zip(self.names, seen, strict=False) if e)

    def unseen(self, members: Sequence[int]) -> list[Point]:
        """The directions among some parameters, the others known, that are not seen, where there are fewest; points that agree."""
        points = [self._unseen_at(theta, jacobian, members) for theta, jacobian in self.points]
        fewest = min((len(p.directions) for p in points), default=0)
        alike = [p for p in points if len(p.directions) == fewest]
        return max(([q for q in alike if q.groups == p.groups] for p in alike), key=len, default=[])

    def _unseen_at(self, theta: Array, jacobian: Array, members: Sequence[int]) -> Point:
        columns = [*members, *range(len(self.names), theta.size)]
        null = parameter_directions(jacobian[:, columns], len(members), self.error)
        null[np.abs(null) <= SMALL * np.abs(null).max(axis=1, keepdims=True, initial=0.0)] = 0.0
        values, slope = theta[list(members)], scaled_slope(self.problem, theta)[list(members)]
        return Point(values, null * slope / np.where(values == 0, 1.0, values))

    def combinations(self, members: Sequence[int]) -> tuple[tuple[Combination, ...], frozenset[str]]:
        """Return what is seen of the directions among some parameters, and the fewest of these to hold."""
        points, names = self.unseen(members), [self.names[k] for k in members]
        if not points:
            return (), frozenset()

        def more() -> Point | None:
            for theta in self._drawn(POINTS) if len(self.points) < COMBINATION_POINTS else ():
                if not self._run(theta):
                    point = self._unseen_at(*self.points[-1], members)
                    if point.pattern == points[0].pattern:
                        return point
            return None

        start = [self.problem.free[k].start for k in members]
        combinations = combinations_seen(names, points, start, more, CONSTANT)
        held = frozenset(names[k] for k in held_of(points[0].directions))
        nearest = min(points, key=lambda p: float(np.abs(p.theta - start).max()))
        return tuple(c if c.seen else _local(c, names, nearest) for c in combinations), held

    @property
    def note(self) -> str:
        """Points that failed, and the sensitivities' error, in words; empty where there is nothing to say."""
        parts = []
        if self.failures:
            first, number = self.failures[0], len(self.failures)
            parts.append(f"{number} of {POINTS} random points could not be simulated ({first})")
        if self.error > SENSITIVITY_ERROR:
            parts.append(
                f"the sensitivities are differences, good to {self.error:.1g}: "
                "what is seen more weakly counts as not seen"
            )
        return "; ".join(parts)


def _from_runs(runs: _Runs, status: str = "decided", why: str = "") -> StructuralAnalysis:
    """Return the structure that the runs show, for anything that can be simulated. why: the equations do not tell it.

    Points that cannot be simulated are passed over; those of the five are counted in the note. A parameter without any effect
    stands among the admissible ones: the data's verdict on it says more.
    """
    names = runs.names
    if not runs.points:
        return StructuralAnalysis("not decided", METHOD, names, note="no random point could be simulated")
    combos, held = runs.combinations(range(len(names)))
    note = "; ".join(filter(None, (why, runs.note)))
    admissible = tuple(n for n in names if n not in held)
    return StructuralAnalysis(status, METHOD, admissible, combos, note, moving=runs.moving, points=runs.simulated)


def structural_analysis(model: Model | None, problem: Problem, seed: int = 0) -> StructuralAnalysis:
    """Return the structure from the model's equations where there are any and these come to an end, else from runs.

    Runs decide, locally, where there are no equations, or the equations have parts that Taylor series do not reach (delays,
    sampling, recordings played in, instruments); where time ran out they stand in, undecided.
    The equations are asked in the regime of the start: every limiter on the branch it then has, every switch of time
    where it then stands. What the records' own runs see beyond that, in other regimes or from several starts, counts: a direction
    is lost where neither shows it. A parameter of which nothing at all is seen with the inputs that were moved is structural
    only where no other input would show it and no switch could; else it is left to the data's verdict.
    """
    runs = _Runs(problem, seed)
    if model is None:
        return _from_runs(runs)
    recordings = in_time(problem.fitted_experiments)
    if not recordings:
        return _from_runs(runs, why=f"{INSTEAD} there are frequency responses only")
    if any(e.drive or e.instrument for e in recordings):
        driven = "insertion points are driven by recordings, or outputs seen through instruments"
        return _from_runs(runs, why=f"{INSTEAD} {driven}")
    names, outputs = runs.names, problem.outputs_in_time
    result = structural_identifiability(model, names, outputs, inputs=moves(recordings), seed=seed, time_limit=SECONDS)
    if result.out_of_reach:
        return _from_runs(runs, why=f"{INSTEAD} {result.reason}")
    if result.status != "decided":
        note = f"the equations did not decide ({result.reason}); the sensitivities at random points stand in for them"
        return _from_runs(runs, "not decided", note)
    switched = _behind_switches(model, outputs) if result.combinations else set()
    if switched:
        runs = _Runs(problem, seed, wide=True)
    unseen = [c.members[0] for c in result.combinations if len(c.members) == 1 and c.members[0] not in runs.moving]
    invisible: set[str] = set()  # whatever input were moved
    if unseen:
        wide = structural_identifiability(model, names, outputs, seed=seed, time_limit=SECONDS)
        invisible = {n for n in unseen if any(c.members == (n,) for c in wide.combinations)} - switched
    together, held, apart = _where_neither_sees(result, runs)
    alone = [c for c in result.combinations if c.members[0] in invisible and len(c.members) == 1]
    note = (
        f"the equations at the start would not tell {', '.join(apart)} apart, but these experiments do" if apart else ""
    )
    admissible = tuple(n for n in names if n not in held | invisible)
    unmoved = tuple(n for n in unseen if n not in invisible)
    return StructuralAnalysis("decided", result.method, admissible, (*together, *alone), note, unmoved, runs.moving)


def _where_neither_sees(result: StructuralResult, runs: _Runs) -> tuple[list[Combination], set[str], list[str]]:
    """Return the combinations that runs tell no further than the equations, what to hold, and the parameters that runs tell."""
    combinations: list[Combination] = []
    held, apart = set[str](), set[str]()
    for c in result.combinations:
        if len(c.members) == 1:
            continue
        members = [result.parameters.index(n) for n in c.members]
        if all(len(p.directions) >= c.free for p in runs.unseen(members)):
            combinations.append(c)
            held |= set(c.members) - set(identifiable_subset(result, c.members))
            continue
        parts, stuck = runs.combinations(members)
        combinations += parts
        held |= stuck
        apart |= set(c.members) - {n for part in parts for n in part.members} or set(c.members)
    return combinations, held, [n for n in result.parameters if n in apart]


def moves(experiments: Sequence[Experiment]) -> dict[str, Literal["step", "free"]]:
    """Return the kind of move by input: in steps alone, or in any other way; constant inputs are left out."""
    kinds: dict[str, Literal["step", "free"]] = {}
    for e in experiments:
        for name, signal in e.inputs.items():
            if signal.is_constant:
                continue
            jumps = bool((np.diff(signal.values)[np.diff(signal.times) > 0] == 0).all())
            kinds[name] = "step" if jumps and kinds.get(name, "step") == "step" else "free"
    return kinds


def _behind_switches(model: Model, outputs: Sequence[str]) -> set[str]:
    """Return the parameters that stand in a limiter or another switch on the way to the outputs: in its branches or its condition.

    The equations are asked with every switch on one branch, so nothing is proved of what stands on the others.
    """
    compiled = ModelEquations(model, (), outputs)
    graph = compiled.graph
    unknowns = (*compiled.derivatives, *compiled.residuals)
    reached, roots = set[int](), [*compiled.observed]
    while roots:
        new = [n for n in graph.reachable(roots) if n not in reached]
        reached.update(new)
        leaves = [graph.nodes[n] for n in new if graph.nodes[n][0] == "leaf"]
        roots = [unknowns[k] for _, group, k in leaves if group == "y" and unknowns[k] not in reached]
    switches = [n for n in reached if graph.nodes[n][0] == "select"]
    behind = [graph.nodes[n] for n in graph.reachable(switches) if graph.nodes[n][0] == "leaf"]
    names = list(model.parameters)
    return {names[k] for _, group, k in behind if group == "p"}


def _local(c: Combination, names: Sequence[str], at: Point) -> Combination:
    """Return a combination without a simple form, with what is seen near a point."""
    if len(c.members) == 1:
        return c
    members = [names.index(n) for n in c.members]
    rows = at.among(members).directions * at.theta[members]
    seen = tuple(dict.fromkeys(w for row in rows for w in in_words(row, c.members, [False] * len(row), row)))
    words = f"{listed(c.members)} cannot be told apart, {only_seen(c.members, seen)}"
    largest = rows[0] / rows[0][leading(rows[0])]
    return replace(c, words=words, directions=(tuple(largest.tolist()),))
