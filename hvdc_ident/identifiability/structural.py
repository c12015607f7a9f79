"""Structural identifiability: the parameters that no data of these outputs could tell, and the combinations seen of them.

From the equations where there are any that the symbolic test reaches; else from the rank of the sensitivities at random points,
which asks the simulator for nothing but runs with sensitivities (exact ones, or differences whose error it states) and so serves
models with delays and sampled parts, recordings played in, and models that have no equations here at all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from hvdc_ident.data import Array, Experiment
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import Problem
from hvdc_ident.fit.frequency_data import in_time
from hvdc_ident.fit.search import starting_points
from hvdc_ident.fit.simulator import sensitivity_error
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model
from hvdc_ident.sensitivity import (
    SENSITIVITY_ERROR,
    StructuralCombination,
    identifiable_subset,
    null_directions,
    structural_identifiability,
)
from hvdc_ident.simulate import ModelEquations
from hvdc_ident.text import listed

SECONDS = 10.0
"""Time that the symbolic test may take; the shipped link takes 3 s."""
METHOD = "numerical, local"
POINTS = 5
WIDE = 8
"""Number of points of which one lies in each eighth of every parameter's range."""
INSIDE = (0.2, 0.8)
"""Share of the bounds that the points are drawn from: at a bound a parameter may do nothing that does else."""
SMALL = 1e-2
"""Parts of a direction below this share of its largest are not members."""


@dataclass(frozen=True)
class Combination:
    """Parameters of which only combinations are seen.

    members: in the order listed. seen: the combinations, in words. kind: "structural" (no data could tell) or
    "practical" (these data do not). direction: the change of the members that leaves the outputs alone, in scaled
    coordinates (relative, or share of the range). held: those put at their given value so that the others can be told.
    text: the finding in words where `seen` has none.
    """

    members: tuple[str, ...]
    seen: tuple[str, ...]
    kind: Literal["structural", "practical"]
    direction: FrozenMap[float] = field(default_factory=FrozenMap)
    held: tuple[str, ...] = ()
    text: str = ""

    @property
    def words(self) -> str:
        """The finding as a sentence."""
        names = listed(self.members)
        if self.text:
            return self.text
        if not self.seen:
            return f"{names} cannot be told apart" if len(self.members) > 1 else f"{names} is not seen"
        verb = "is" if len(self.seen) == 1 else "are"
        return f"only {listed(self.seen)} {verb} seen, not {names} apart"


def in_words(direction: Array, names: Sequence[str], logs: Sequence[bool], values: Sequence[float]) -> tuple[str, ...]:
    """Return the combinations that a null direction leaves unchanged: products of powers where all members are positive.

    direction: (p,) in scaled coordinates. logs: which coordinates are relative. values: of the parameters.
    """
    members = [i for i in range(len(names)) if abs(direction[i]) > SMALL * np.abs(direction).max()]
    pivot = members[0]
    found = []
    for i in members[1:]:
        ratio = float(direction[i] / direction[pivot])
        if logs[i] and logs[pivot]:
            found.append(_product(names[pivot], names[i], -ratio))
        else:
            slope = ratio * (values[i] if logs[i] else 1.0) / ((values[pivot] if logs[pivot] else 1.0) or 1.0)
            sign = "-" if slope > 0 else "+"
            found.append(f"{names[i]} {sign} {abs(slope):.3g}*{names[pivot]} (near these values)")
    return tuple(found)


def _product(pivot: str, name: str, power: float) -> str:
    """Return name * pivot^power as people write it."""
    near = round(2.0 * power) / 2.0
    power = near if abs(power - near) < 0.02 and near else power
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
    found = []
    for row in null:
        members = tuple(n for n, v in zip(names, row, strict=True) if abs(v) > SMALL * np.abs(row).max())
        direction = FrozenMap({n: float(v) for n, v in zip(names, row, strict=True) if n in members})
        found.append(Combination(members, in_words(row, names, logs, values), kind, direction))
    return tuple(found)


def held_of(null: Array) -> frozenset[int]:
    """Return the indices of the parameters to hold so that the others can be estimated: one a direction, the last listed that will do.

    null: (k, p) independent directions. Any set of columns in which they stay independent would do; the equations' route
    keeps the earlier listed, and how strongly each is seen must not make the two routes differ.
    """
    rest, held = null.copy(), set()
    for i in reversed(range(null.shape[1])):
        if not rest.shape[0]:
            break
        rest = rest / np.abs(rest[:, : i + 1]).max(axis=1, keepdims=True)
        row = int(np.argmax(np.abs(rest[:, i])))
        if abs(rest[row, i]) > SMALL:
            held.add(i)
            rest = np.delete(rest - np.outer(rest[:, i] / rest[row, i], rest[row]), row, axis=0)
    return frozenset(held)


def partners(combinations: Sequence[Combination], held: Mapping[str, str]) -> dict[str, tuple[str, ...]]:
    """Return the held members of its combinations for each member that is not held."""
    found: dict[str, tuple[str, ...]] = {}
    for c in combinations:
        stuck = tuple(n for n in c.members if n in held)
        for n in c.members:
            if n not in held and stuck:
                found[n] = tuple(dict.fromkeys((*found.get(n, ()), *stuck)))
    return found


@dataclass(frozen=True)
class StructuralAnalysis:
    """The structural verdict on the candidates.

    status: decided, or not decided. method: "prime field" or "numerical, local". admissible: the most that can be estimated
    together once the others are held; the earlier listed where there is a choice. combinations: what is seen of others.
    note: why it is not decided, or what the method cannot see. unmoved: parameters that show only where an input is
    moved that was not, or in another regime. moving: parameters that move the outputs along the records by more than the
    sensitivities' error. points: how many points of the numerical method could be simulated.
    """

    status: str
    method: str
    admissible: tuple[str, ...]
    combinations: tuple[Combination, ...] = ()
    note: str = ""
    unmoved: tuple[str, ...] = ()
    moving: tuple[str, ...] = ()
    points: int = 0

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


def rank_analysis(problem: Problem, seed: int = 0, *, wide: bool = False) -> StructuralAnalysis:
    """Return the structure from the rank of the whitened sensitivities at the start and at five random points in the bounds.

    For anything that can be simulated; local. wide: whether to look for other regimes too, at a Latin hypercube of points
    up to the bounds. Points that cannot be simulated are passed over; those of the five are counted in the note. A parameter
    without any effect stands among the admissible ones: the data's verdict on it says more.
    """
    names = tuple(f.name for f in problem.free)
    error = sensitivity_error(problem.simulator)
    jacobians, failures = [], []
    random = np.random.default_rng(seed).uniform(*INSIDE, (POINTS, len(problem.unknowns)))
    points = [np.array([u.draw(s) for u, s in zip(problem.unknowns, row, strict=True)]) for row in random.tolist()]
    others = starting_points(problem.unknowns, (), WIDE, seed) if wide else []
    for k, theta in enumerate([*points, problem.start, *others]):
        try:
            jacobian = problem.residual(theta)[1]
        except SimulationError as e:
            failures += [e.what] if k < POINTS else []
            continue
        jacobians.append(jacobian * scaled_slope(problem, theta))
    if not jacobians:
        return StructuralAnalysis("not decided", METHOD, names, note="no random point could be simulated")
    lengths = [np.linalg.norm(j, axis=0) for j in jacobians]
    effective = np.any([n[: len(names)] > error * n.max(initial=0.0) for n in lengths], axis=0)
    null = _common_null(jacobians, len(names), error)
    logs = [f.min > 0 for f in problem.free]
    combos = combinations_of(null, names, logs, [f.start for f in problem.free], "structural")
    held = held_of(null)
    return StructuralAnalysis(
        "decided",
        METHOD,
        tuple(n for i, n in enumerate(names) if i not in held),
        combos,
        _note(failures, error),
        moving=tuple(n for n, e in zip(names, effective, strict=True) if e),
        points=len(jacobians),
    )


def _note(failures: Sequence[str], error: float) -> str:
    parts = []
    if failures:
        parts.append(f"{len(failures)} of {POINTS} random points could not be simulated ({failures[0]})")
    if error > SENSITIVITY_ERROR:
        parts.append(
            f"the sensitivities are differences, good to {error:.1g}: what is seen more weakly counts as not seen"
        )
    return "; ".join(parts)


def _common_null(jacobians: Sequence[Array], count: int, error: float) -> Array:
    """Return the directions without effect at every point, (k, count), the nuisances left out."""
    ranks = [null_directions(j, error).shape[0] for j in jacobians]
    if min(ranks) == 0:
        return np.zeros((0, count))
    together = np.vstack([j / np.maximum(np.linalg.norm(j), 1e-300) for j in jacobians])
    null = parameter_directions(together, count, error)
    # where the direction turns from point to point, it is taken where there are fewest
    return null if null.size else parameter_directions(jacobians[int(np.argmin(ranks))], count, error)


def structural_analysis(model: Model | None, problem: Problem, seed: int = 0) -> StructuralAnalysis:
    """Return the structure from the model's equations where there are any and the test comes to an end, else from numbers.

    Numbers decide, locally, where there are no equations, or the equations have parts that the test does not reach
    (delays, sampling, recordings played in, instruments); where it ran out of time they stand in, undecided.
    The equations are asked in the regime of the start: every limiter on the branch it then has, every switch of time
    where it then stands. What the records' own runs see beyond that, in other regimes or from several starts, counts: a
    parameter whose derivative along them is more than its error is not lost, and a combination whose members no
    direction without effect moves is told apart. A parameter of which nothing at all is seen with the inputs that were
    moved is structural only where no other input would show it and no switch could; else it is left to the data's verdict.
    """
    numbers = rank_analysis(problem, seed)
    if model is None:
        return numbers

    def by_numbers(why: str) -> StructuralAnalysis:
        notes = [f"from the sensitivities at random points, because {why}", numbers.note]
        return replace(numbers, note="; ".join(filter(None, notes)))

    names = tuple(f.name for f in problem.free)
    outputs = problem.outputs_in_time
    recordings = in_time(problem.fitted_experiments)
    if not recordings:
        return by_numbers("there are frequency responses only")
    if any(e.drive or e.instrument for e in recordings):
        return by_numbers("insertion points are driven by recordings, or outputs seen through instruments")
    result = structural_identifiability(model, names, outputs, inputs=moves(recordings), seed=seed, time_limit=SECONDS)
    if result.out_of_reach:
        return by_numbers(result.reason)
    if result.status != "decided":
        note = f"the equations did not decide ({result.reason}); the sensitivities at random points stand in for them"
        return replace(numbers, status="not decided", note=note)
    switched = _behind_switches(model, outputs) if result.combinations else set()
    if switched:
        numbers = rank_analysis(problem, seed, wide=True)
    alone = [c.members[0] for c in result.combinations if len(c.members) == 1]
    unseen = [n for n in alone if n not in numbers.moving]
    invisible: set[str] = set()  # whatever input were moved
    if unseen:
        wide = structural_identifiability(model, names, outputs, seed=seed, time_limit=SECONDS)
        invisible = {n for n in unseen if any(c.members == (n,) for c in wide.combinations)} - switched
    together, separated = _confirmed([c for c in result.combinations if len(c.members) > 1], numbers)
    kept = {*identifiable_subset(result), *alone, *separated}
    note = ""
    if separated:
        apart = ", ".join(n for n in names if n in separated)
        note = f"the equations at the start would not tell {apart} apart, but these experiments do"
    single = tuple(Combination((n,), (), "structural", text=f"nothing is seen of {n}") for n in names if n in invisible)
    admissible = tuple(n for n in names if n in kept and n not in invisible)
    unmoved = tuple(n for n in alone if n not in invisible and n not in numbers.moving)
    return StructuralAnalysis("decided", result.method, admissible, (*together, *single), note, unmoved, numbers.moving)


def moves(experiments: Sequence[Experiment]) -> dict[str, Literal["step", "free"]]:
    """Return the kind of move by input: in steps alone, or in any other way; constant inputs are left out."""
    found: dict[str, Literal["step", "free"]] = {}
    for e in experiments:
        for name, signal in e.inputs.items():
            if signal.is_constant:
                continue
            jumps = bool((np.diff(signal.values)[np.diff(signal.times) > 0] == 0).all())
            found[name] = "step" if jumps and found.get(name, "step") == "step" else "free"
    return found


def _confirmed(
    found: Sequence[StructuralCombination], numbers: StructuralAnalysis
) -> tuple[tuple[Combination, ...], set[str]]:
    """Return the combinations that the numbers lose too, and the parameters that the numbers tell apart.

    Of a combination that the numbers lose in part only, that part stands, in the numbers' words.
    """
    lost = set(numbers.unidentifiable)
    stand: dict[tuple[str, ...], Combination] = {}
    separated: set[str] = set()
    for c in found:
        members = set(c.members)
        if members <= lost:
            stand[c.members] = _combination(c)
            continue
        separated |= (members - lost) | (members & set(numbers.admissible))
        stand |= {part.members: part for part in numbers.combinations if members & set(part.members)}
    return tuple(stand.values()), separated


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


def _combination(c: StructuralCombination) -> Combination:
    """Return a combination that the equations found, in this room's form."""
    direction: FrozenMap[float] = (
        FrozenMap(zip(c.members, c.directions[0], strict=True)) if c.directions else FrozenMap()
    )
    return Combination(c.members, c.seen, "structural", direction, text="" if c.seen else c.words)
