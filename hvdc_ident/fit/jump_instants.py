"""Unknowns that move an instant at which an output jumps: the search over them, and the stretches that the rows leave.

Such an instant is that of a condition on `time` with a parameter in it, a jump of an input that a delay brings later, or, for
a clock of unknown offset, any jump of an input. The samples show the jump's place only as far as the rows stand: the cost jumps
each time the instant passes a row, and between two such values, over a stretch, it is smooth. A descent never leaves the
stretch it begins in. So the stretches are tried; and what the records tell of the unknown is at most the stretch.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hvdc_ident.data import Array, Experiment
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit.descent import descend
from hvdc_ident.fit.fit_parameter import FitParameter, starting_points
from hvdc_ident.fit.optimiser import LocalMinimum, Optimiser
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.simulator import TIME_SHIFT, unknown_of
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize.system import evaluate
from hvdc_ident.model import Model, is_white_box, used_names
from hvdc_ident.simulate import ModelEquations, by_structure, with_recording

MOST_STRETCHES = 80
"""Stretches that are tried at once; of more, every so many, and then those beside the best of these."""
JOINT = 40
"""Points of a Latin hypercube that are tried where several parameters move instants: each alone finds its place only
where the others are about right."""
ROUNDS = 6
"""Rounds of finding the other unknowns again between two searches over the stretches."""
GRID = 33
"""Values of an unknown between which the instants are followed: they pass a row at most once between two of them."""
EVALUATIONS = 6
"""Evaluations to find the other unknowns again in a stretch that is tried: a step or two on what is linear, and some more."""
FLAT = 1e-4
"""A rise of the cost by less moves no estimate by a hundredth of its standard deviation."""
BISECTIONS = 20
"""Halvings of a stretch that find an end of an interval inside it to a millionth."""
INSIDE = 1e-5
"""Share of a stretch that its ends are kept inside: at an end itself the instant has passed the row. A run places an instant to
1e-10 of its length, which in a record of 1e5 rows is this share."""


# --- instants ---


@dataclass(frozen=True)
class _Jump:
    """A jump of the outputs at the roots in time of a switching function, or at an input's breaks, some delays later.

    node: of the switching function in the model's graph; None for the breaks of `source`. delays: places of the delays passed.
    parameters: those that move it.
    """

    node: int | None
    source: str
    delays: tuple[int, ...]
    parameters: frozenset[str]


@dataclass(frozen=True, eq=False)
class JumpInstants:
    """The instants at which some outputs of a model jump by conditions on time, and by the breaks of its inputs after delays."""

    equations: ModelEquations
    jumps: tuple[_Jump, ...]

    @cached_property
    def parameters(self) -> frozenset[str]:
        """Those that move any of the instants."""
        return frozenset().union(*(jump.parameters for jump in self.jumps))

    def distance(self, jump: _Jump, time: Array, values: Mapping[str, Array]) -> Array:
        """Return a function of time, (n,), that changes its sign at the instant of a jump.

        time: (n,) s; less the instant of the break, where it is that of an input's. values: (n,) of each parameter.
        """
        g = self.equations.graph
        leaves = {g.leaf("p", k): values[n] for k, n in enumerate(self.equations.model.parameters)}
        timing = [self.equations.timing[k] for k in jump.delays]
        at = time - sum((delay.real for delay in evaluate(g, timing, leaves, time.size)), np.zeros(time.size))
        if jump.node is None:
            return np.asarray(at)
        return np.asarray(evaluate(g, [jump.node], {**leaves, g.leaf("w", 0): at}, time.size)[0].real)


def _instants(model: Model, outputs: tuple[str, ...]) -> JumpInstants:
    equations = ModelEquations(model, (), outputs)
    g = equations.graph
    inputs, n_states = list(model.inputs), len(equations.states)
    jumps: dict[_Jump, None] = {}

    def add(node: int | None, source: str, delays: tuple[int, ...]) -> None:
        roots = [*([] if node is None else [node]), *(equations.timing[k] for k in delays)]
        moving = frozenset().union(*(_parameters(equations, root) for root in roots))
        if moving or node is not None:
            jumps.setdefault(_Jump(node, source, delays, moving))

    seen: set[tuple[int, tuple[int, ...]]] = set()
    waiting: list[tuple[int, tuple[int, ...]]] = [(n, ()) for n in equations.observed]
    while waiting:
        root, delays = waiting.pop()
        if (root, delays) in seen:
            continue
        seen.add((root, delays))
        for node in g.reachable([root]):
            kind, *rest = g.nodes[node]
            if kind == "switch":
                switch = g.switches[rest[0]]
                if _is_of_time(equations, switch):
                    add(switch, "", delays)
                waiting.append((switch, delays))
            elif kind == "leaf" and rest[0] == "y" and rest[1] >= n_states:
                waiting += [(n, delays) for n in equations.residuals]
            elif kind == "leaf" and rest[0] == "w" and 0 < rest[1] <= len(inputs):
                add(None, inputs[rest[1] - 1], delays)
            elif kind == "leaf" and rest[0] == "w" and 0 <= rest[1] - 1 - len(inputs) < len(model.delays):
                passed = rest[1] - 1 - len(inputs)
                if passed not in delays:
                    waiting.append((equations.sources[passed], (*delays, passed)))
    return JumpInstants(equations, tuple(jumps))


def _parameters(equations: ModelEquations, root: int) -> frozenset[str]:
    """Return the parameters that a node depends on."""
    names, nodes = list(equations.model.parameters), equations.graph.nodes
    return frozenset(names[nodes[n][2]] for n in _leaves(equations, root) if nodes[n][1] == "p")


def _leaves(equations: ModelEquations, root: int) -> set[int]:
    """Return the leaves that a node depends on, also through conditions."""
    g, waiting = equations.graph, [root]
    leaves: set[int] = set()
    seen: set[int] = set()
    while waiting:
        for node in g.reachable([waiting.pop()], known=seen):
            seen.add(node)
            kind, *rest = g.nodes[node]
            if kind == "leaf":
                leaves.add(node)
            elif kind == "switch":
                waiting.append(g.switches[rest[0]])
    return leaves


def _is_of_time(equations: ModelEquations, switch: int) -> bool:
    """Return whether a switching function depends on time, and on parameters alone beside it."""
    leaves = {equations.graph.nodes[n][1:] for n in _leaves(equations, switch)}
    return ("w", 0) in leaves and all(group == "p" or (group, k) == ("w", 0) for group, k in leaves)


_instants_of = by_structure(_instants, room=32)


def _of_experiment(problem: Problem, e: Experiment) -> JumpInstants | None:
    """Return the instants of an experiment's run; None of a simulator without equations, of a response, and where nothing moves one."""
    model = getattr(problem.simulator, "model", None)
    if not is_white_box(model) or e.domain != "time" or not (model.delays or "time" in used_names(model)):
        return None
    instants: JumpInstants = _instants_of(with_recording(model, e), tuple(e.outputs))
    return instants


def moving(problem: Problem) -> tuple[int, ...]:
    """Return the places of the unknowns that move an instant at which a compared output jumps."""
    parameters: set[str] = set()
    for e in problem.fitted_experiments:
        instants = _of_experiment(problem, e)
        moved = frozenset() if instants is None else instants.parameters
        parameters |= moved.difference(e.nuisance)
        parameters |= {unknown_of(e.name, n) for n in e.nuisance if n == TIME_SHIFT or n in moved}
    return tuple(k for k, n in enumerate(problem.names) if n in parameters)


def moving_parameters(problem: Problem) -> tuple[str, ...]:
    """Return the free parameters among them: those that are reported."""
    return tuple(problem.names[k] for k in moving(problem) if k < len(problem.free))


# --- stretches ---


def _passing(problem: Problem, theta: Array, place: int) -> Array:
    """Return the values of one unknown at which an instant passes a row, sorted, between the ends of its range."""
    low, high = problem.unknowns[place].drawn
    name = problem.names[place]
    passing = [np.empty(0)]
    for e in problem.fitted_experiments:
        own = {unknown_of(e.name, n): n for n in e.nuisance}.get(name, "" if place >= len(problem.free) else name)
        rows = np.unique(e.time[e.compared])
        if own == TIME_SHIFT:
            passing.append(np.subtract.outer(rows, _breaks(e, e.inputs)).reshape(-1))
        instants = _of_experiment(problem, e) if own else None
        for jump in instants.jumps if instants is not None else ():
            if own == TIME_SHIFT or own in jump.parameters:
                assert instants is not None
                passing.append(_crossings(problem, e, theta, own, instants, jump, (low, high)))
    values = np.unique(np.concatenate(passing))
    values = values[(values > low) & (values < high)]
    apart = np.diff(values, prepend=-np.inf) > 1e-12 * (high - low)
    return np.asarray(values[apart])


def _breaks(e: Experiment, names: Iterable[str]) -> Array:
    """Return the breaks of some inputs of an experiment, s."""
    return np.unique(np.concatenate([np.empty(0), *(e.inputs[n].breaks for n in names if n in e.inputs)]))


def _crossings(
    problem: Problem,
    e: Experiment,
    theta: Array,
    own: str,
    instants: JumpInstants,
    jump: _Jump,
    ends: tuple[float, float],
) -> Array:
    """Return the values of one unknown, between two ends, at which the instant of a jump passes a row of an experiment.

    own: the unknown's name in the experiment.
    """
    nuisances = problem.nuisances(e, theta)
    parameters = instants.equations.model.parameters
    numbers = {**{n: q.value for n, q in parameters.items()}, **e.values, **problem.values(theta), **nuisances}

    def distance(times: Array, values: Array) -> Array:
        at = {n: values if n == own else np.full(times.size, numbers[n]) for n in parameters}
        late = values if own == TIME_SHIFT else nuisances.get(TIME_SHIFT, 0.0)
        return instants.distance(jump, times - late, at)

    grid = np.linspace(*ends, GRID)
    rows = np.unique(e.time[e.compared])
    if jump.node is None:
        rows = np.unique(np.subtract.outer(rows, _breaks(e, [jump.source])))
        delays = -distance(np.zeros(GRID), grid)
        rows = rows[(rows > delays.min()) & (rows < delays.max())]
    along = distance(np.repeat(rows, GRID), np.tile(grid, rows.size)).reshape(rows.size, GRID)
    i, j = np.nonzero((along[:, 1:] < 0) != (along[:, :-1] < 0))
    below, above, at_below = grid[j], grid[j + 1], along[i, j]
    crossing = below - at_below * (above - below) / (along[i, j + 1] - at_below)
    left = distance(rows[i], crossing)
    if np.abs(left).max(initial=0.0) > 1e-9 * np.abs(along).max(initial=0.0):
        for _ in range(50):  # not linear in the unknown: bisection
            crossing = 0.5 * (below + above)
            same = (distance(rows[i], crossing) < 0) == (at_below < 0)
            below, above = np.where(same, crossing, below), np.where(same, above, crossing)
    return np.asarray(crossing)


def _stretches(problem: Problem, theta: Array, place: int) -> Array:
    """Return the ends of the stretches of one unknown, sorted."""
    low, high = problem.unknowns[place].drawn
    return np.concatenate([[low], _passing(problem, theta, place), [high]])


def stretch(problem: Problem, theta: Array, place: int) -> tuple[float, float]:
    """Return the ends of the stretch that one unknown lies in; the value at an end belongs to one of two."""
    ends = _stretches(problem, theta, place)
    k = int(np.clip(np.searchsorted(ends, theta[place], side="left"), 1, ends.size - 1))
    return float(ends[k - 1]), float(ends[k])


def within_own_stretches(problem: Problem, ends: Sequence[LocalMinimum]) -> list[LocalMinimum]:
    """Return the ends of descents, the lowest first, that began in its stretches: no other could come to where it ended."""
    if not ends:
        return []
    own = {k: stretch(problem, ends[0].theta, k) for k in moving(problem)}
    return [e for e in ends if all(low <= e.theta[k] <= high for k, (low, high) in own.items())]


def within_stretches(problem: Problem, theta: Array) -> Problem:
    """Return the problem in which the parameters that move instants are bounded by their stretches: its cost is smooth."""
    return within(
        problem, theta, {n: stretch(problem, theta, problem.names.index(n)) for n in moving_parameters(problem)}
    )


def within(problem: Problem, theta: Array, ranges: Mapping[str, tuple[float, float]]) -> Problem:
    """Return the problem in which some parameters are bounded by a range between two values at which instants pass rows."""
    if not ranges:
        return problem
    values = dict(zip(problem.names, map(float, theta), strict=True))
    free = [_bounded(f, ranges[f.name], values[f.name]) if f.name in ranges else f for f in problem.free]
    return replace(problem, free=tuple(free))


def _bounded(f: FitParameter, ends: tuple[float, float], value: float) -> FitParameter:
    """Return the unknown with the ends of a stretch as its bounds, where they are narrower, started inside."""
    inside = INSIDE * (ends[1] - ends[0])
    low = ends[0] + inside if ends[0] > f.min else f.min
    high = ends[1] - inside if ends[1] < f.max else f.max
    return replace(f, start=min(max(value, low), high), min=low, max=high)


@dataclass(frozen=True, eq=False)
class PlacedInstant:
    """An instant that the records place between two rows, as the interval of the parameter that moves it.

    low, high: the 95 % interval; an end that is a bound of the search and nothing else is not excluded. rise: of the cost at an
    end that is no passing of a row. passes: the range between the two passings of rows that it lies in. points: (value, rise of
    the cost, (p,) the unknowns) along it, also beyond the ends.
    """

    name: str
    low: float
    high: float
    rise: float
    passes: tuple[float, float]
    points: tuple[tuple[float, float, Array], ...]

    @property
    def text(self) -> str:
        """Sentence for the reader of a report."""
        return (
            f"It sets an instant at which an output jumps, and the cost jumps where that passes a row, at {self.passes[0]:.6g} and at "
            f"{self.passes[1]:.6g}: it lies between them"
        )


def placed_instants(problem: Problem, theta: Array, rise: float) -> dict[str, PlacedInstant]:
    """Return what the records tell of each parameter that moves an instant, around the optimum theta, (p,).

    rise: of the cost, the other unknowns found again, at the ends of an interval. Left out is a parameter of which the smooth part
    of the cost tells more than the rows, and one whose instant may pass any row, for the jump is lost in the noise.
    """
    instants = {}
    for name in moving_parameters(problem):
        placed = _placed(problem, theta, problem.names.index(name), rise)
        if placed is not None:
            instants[name] = placed
    return instants


def _placed(problem: Problem, theta: Array, place: int, rise: float) -> PlacedInstant | None:
    ends = _stretches(problem, theta, place)
    unknown, value = problem.unknowns[place], float(theta[place])
    own = int(np.clip(np.searchsorted(ends, value, side="left"), 1, ends.size - 1)) - 1
    best = problem.cost(theta)
    points = [(value, 0.0, theta)]

    def at(value: float, near: Array) -> float:
        """Return the rise of the cost at a value, begun from unknowns nearby."""
        end = _found_again(problem, _with(near, place, value), [place])
        if np.isfinite(end.cost):
            points.append((value, end.cost - best, end.theta))
        return end.cost - best

    sides = []
    for step in (-1, 1):
        # The present stretch, then the next ones, as long as the records do not exclude them.
        k, good, near, excluded = own, value, theta, False
        while 0 <= k + step < ends.size - 1 and abs(k - own) < MOST_STRETCHES:
            middle = 0.5 * float(ends[k + step] + ends[k + step + 1])
            if at(middle, near) >= rise:
                excluded = True
                break
            k, good, near = k + step, middle, points[-1][2]
        edge = float(ends[k] if step < 0 else ends[k + 1])
        inside = _bounded(unknown, (float(ends[k]), float(ends[k + 1])), good)
        far = inside.min if step < 0 else inside.max
        if at(far, near) >= rise:
            for _ in range(BISECTIONS):
                middle = 0.5 * (good + far)
                good, far = (middle, far) if at(middle, near) < rise else (good, middle)
            sides.append((good, edge, "smooth"))
        else:
            sides.append((edge, edge, "jump" if excluded else "open"))
    (low, low_edge, below), (high, high_edge, above) = sides
    if "open" in (below, above) or "jump" not in (below, above):
        return None
    points.sort(key=lambda point: point[0])
    return PlacedInstant(unknown.name, low, high, rise, (low_edge, high_edge), tuple(points))


# --- the search ---


def search_instants(problem: Problem, best: LocalMinimum, method: Optimiser) -> LocalMinimum:
    """Return the best optimum over the stretches of all unknowns that move instants: search, fit again, until none is better."""
    places = moving(problem)
    if not places:
        return best
    best = _joint(problem, best, places)
    for _ in range(ROUNDS):
        theta = best.theta
        for k in places:
            theta = _best_stretch(problem, theta, k, places)
        if np.array_equal(theta, best.theta):
            break
        refined = _refined(problem, LocalMinimum(theta, best.cost), method)
        if not refined.cost < best.cost:
            break
        best = refined
    if not moving_parameters(problem):
        return best
    return _centred(problem, _refined(problem, best, method), places)


def _centred(problem: Problem, best: LocalMinimum, places: Sequence[int]) -> LocalMinimum:
    """Return the optimum with each parameter that its stretch alone bounds in the middle of that: elsewhere it would lie by chance."""
    for k in places:
        if k < len(problem.free):
            theta = _with(best.theta, k, 0.5 * sum(stretch(problem, best.theta, k)))
            middle = _found_again(problem, theta, [k], enough=1e-2 * FLAT, evaluations=80)
            best = middle if middle.cost <= best.cost + FLAT else best
    return best


def _refined(problem: Problem, at: LocalMinimum, method: Optimiser) -> LocalMinimum:
    """Return the optimum within the stretches of a point; the point itself where no run from it is lower."""
    run = method.run(within_stretches(problem, at.theta), at.theta)
    if run.status == "failed" or run.cost is None or not run.cost < at.cost:
        return at
    return LocalMinimum(run.theta, run.cost)


def _joint(problem: Problem, best: LocalMinimum, places: Sequence[int]) -> LocalMinimum:
    """Return the best of some points at which all parameters that move instants are drawn together, and of the one given."""
    free = [k for k in places if k < len(problem.free)]
    if len(free) < 2:
        return best
    for point in starting_points([problem.unknowns[k] for k in free], [], JOINT, seed=0):
        theta = best.theta.copy()
        theta[free] = point
        best = min(best, _found_again(problem, theta, free), key=lambda end: end.cost)
    return best


def _best_stretch(problem: Problem, theta: Array, place: int, places: Sequence[int]) -> Array:
    """Return theta with one unknown in the best of its stretches: the present value, or the middle of another.

    The other unknowns are found again in each; those of a clock are small by nature, and stay.
    """
    ends = _stretches(problem, theta, place)
    middles = 0.5 * (ends[1:] + ends[:-1])
    if place < len(problem.free):
        parameters = [k for k in places if k < len(problem.free)]

        def tried(value: float) -> LocalMinimum:
            return _found_again(problem, _with(theta, place, value), parameters)

    else:
        alone, own = _alone(problem, theta, place)

        def tried(value: float) -> LocalMinimum:
            return _cost(alone, _with(own, alone.names.index(problem.names[place]), value), _with(theta, place, value))

    best = tried(float(theta[place]))
    first, last, step = 0, middles.size, max(1, -(-middles.size // MOST_STRETCHES))
    while True:
        tries = [(k, tried(float(middles[k]))) for k in range(first, last, step)]
        k, lowest = min(tries, key=lambda pair: pair[1].cost)
        best = min(best, lowest, key=lambda end: end.cost)
        if step == 1:
            return best.theta
        first, last = max(0, k - step + 1), min(middles.size, k + step)
        step = max(1, -(-(last - first) // MOST_STRETCHES))


def _with(theta: Array, place: int, value: float) -> Array:
    moved = theta.copy()
    moved[place] = value
    return moved


def _found_again(
    problem: Problem, theta: Array, fixed: Sequence[int], *, enough: float = 1e-3, evaluations: int = EVALUATIONS
) -> LocalMinimum:
    """Return where some descent steps lead with a few unknowns fixed; of cost infinity where that cannot be simulated."""
    mask = np.isin(np.arange(theta.size), fixed)
    try:
        end = descend(problem, theta, mask, enough=enough, max_evaluations=evaluations)
    except SimulationError:
        return LocalMinimum(theta, np.inf)  # only compared: what cannot be simulated is not chosen
    return LocalMinimum(end.theta, end.at.cost)


def _alone(problem: Problem, theta: Array, place: int) -> tuple[Problem, Array]:
    """Return the problem of the one experiment that a nuisance belongs to, without priors, and its unknowns."""
    name = problem.names[place]
    (e,) = [e for e in problem.fitted_experiments if name in {unknown_of(e.name, n) for n in e.nuisance}]
    alone = replace(problem, experiments=(e,), priors=FrozenMap())
    return alone, np.array([theta[problem.names.index(n)] for n in alone.names])


def _cost(problem: Problem, theta: Array, whole: Array) -> LocalMinimum:
    """Return the cost at theta, under the unknowns of the whole problem; infinity where it cannot be simulated."""
    try:
        return LocalMinimum(whole, problem.cost(theta))
    except SimulationError:
        return LocalMinimum(whole, np.inf)  # only compared: an offset that cannot be simulated is not chosen
