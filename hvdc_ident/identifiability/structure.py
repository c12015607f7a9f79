"""What can be told from any data at all: the structural part of the report, symbolic where there are equations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hvdc_ident.data import Experiment
from hvdc_ident.fit import Problem
from hvdc_ident.fit.frequency_data import in_time
from hvdc_ident.identifiability.combinations import Combination
from hvdc_ident.identifiability.local_rank import METHOD, local_rank
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model
from hvdc_ident.sensitivity import (
    StructuralCombination,
    StructuralResult,
    identifiable_subset,
    structural_identifiability,
)
from hvdc_ident.simulate import ModelEquations as Equations

SECONDS = 10.0
"""How long the symbolic test may compute; the shipped link takes 3."""


@dataclass(frozen=True)
class Structure:
    """The structural verdict on the candidates.

    status: decided, or not decided. method: "symbolic" or "numerical, local". admissible: the most that can be told
    together once the others are held; the earlier listed where there is a choice. combinations: what is seen of others.
    note: why it is not decided, or what the method cannot see. unmoved: parameters that show only where an input is
    moved that was not, or in another regime. moving: parameters that move the outputs along the records, by numbers.
    """

    status: str
    method: str
    admissible: tuple[str, ...]
    combinations: tuple[Combination, ...] = ()
    note: str = ""
    unmoved: tuple[str, ...] = ()
    moving: tuple[str, ...] = ()

    @property
    def local(self) -> bool:
        """Whether that was found from numbers at some points, so that other points might show more."""
        return self.method.endswith("local")

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """Members of any combination."""
        return tuple(dict.fromkeys(n for c in self.combinations for n in c.members))


def structure(model: Model | None, problem: Problem, seed: int = 0) -> Structure:
    """The structure from the model's equations where there are any and the test comes to an end, else from numbers.

    Numbers decide, locally, where there are no equations, or the equations have parts that the test does not reach
    (delays, sampling, recordings played in, instruments); where it ran out of time they stand in, undecided.
    The equations are asked in the regime of the start: every limiter on the branch it then has, every switch of time
    where it then stands. What the records' own runs see beyond that, in other regimes or from several starts, counts: a
    parameter whose derivative along them is more than its error is not lost, and a combination whose members no
    direction without effect moves is told apart. A parameter of which nothing at all is seen with the inputs that were
    moved is structural only where no other input would show it and no switch could; else it is left to the data's verdict.
    """
    numbers = numerical_structure(problem, seed)
    if model is None:
        return numbers
    names = tuple(f.name for f in problem.free)
    outputs = problem.outputs_in_time
    recordings = in_time(problem.fitted_experiments)
    if not recordings:
        return _by_numbers(numbers, "there are frequency responses only")
    if any(e.drive or e.instrument for e in recordings):
        return _by_numbers(numbers, "insertion points are driven by recordings, or outputs seen through instruments")
    moved = moves(recordings)
    result = structural_identifiability(model, names, outputs, inputs=moved, seed=seed, time_limit=SECONDS)
    if result.out_of_reach:
        return _by_numbers(numbers, result.reason)
    if result.status != "decided":
        return _undecided(numbers, result.reason)
    switched = _behind_switches(model, outputs) if result.combinations else set()
    if switched:
        numbers = numerical_structure(problem, seed, wide=True)
    alone = [c.members[0] for c in result.combinations if len(c.members) == 1]
    hidden = _hidden(model, [n for n in alone if n not in numbers.moving], names, outputs, seed)
    hidden -= switched
    together, told = _confirmed([c for c in result.combinations if len(c.members) > 1], numbers)
    kept = {*identifiable_subset(result), *alone, *told}
    note = ""
    if told:
        apart = ", ".join(n for n in names if n in told)
        note = f"the equations at the start would not tell {apart} apart, but these experiments do"
    unseen = tuple(Combination((n,), (), "structural", text=f"nothing is seen of {n}") for n in names if n in hidden)
    admissible = tuple(n for n in names if n in kept and n not in hidden)
    unmoved = tuple(n for n in alone if n not in hidden and n not in numbers.moving)
    return Structure("decided", result.method, admissible, (*together, *unseen), note, unmoved, numbers.moving)


def moves(experiments: Sequence[Experiment]) -> dict[str, Literal["step", "free"]]:
    """How each input that moves does: in steps alone, or in any other way; constant ones are left out."""
    found: dict[str, Literal["step", "free"]] = {}
    for e in experiments:
        for name, signal in e.inputs.items():
            if signal.is_constant:
                continue
            jumps = bool((np.diff(signal.values)[np.diff(signal.times) > 0] == 0).all())
            found[name] = "step" if jumps and found.get(name, "step") == "step" else "free"
    return found


def _hidden(model: Model, alone: Sequence[str], names: Sequence[str], outputs: Sequence[str], seed: int) -> set[str]:
    """Those of which nothing would be seen whatever input was moved; none where that is not decided."""
    if not alone:
        return set()
    wide: StructuralResult = structural_identifiability(model, names, outputs, seed=seed, time_limit=SECONDS)
    return {n for n in alone if any(c.members == (n,) for c in wide.combinations)}


def _confirmed(found: Sequence[StructuralCombination], numbers: Structure) -> tuple[tuple[Combination, ...], set[str]]:
    """The combinations that the numbers lose too, and the parameters that the numbers tell apart.

    Of a combination that the numbers lose in part only, that part stands, in the numbers' words.
    """
    lost = set(numbers.unidentifiable)
    stand: dict[tuple[str, ...], Combination] = {}
    told: set[str] = set()
    for c in found:
        members = set(c.members)
        if members <= lost:
            stand[c.members] = _combination(c)
            continue
        told |= (members - lost) | (members & set(numbers.admissible))
        stand |= {part.members: part for part in numbers.combinations if members & set(part.members)}
    return tuple(stand.values()), told


def _behind_switches(model: Model, outputs: Sequence[str]) -> set[str]:
    """The parameters that stand in a limiter or another switch on the way to the outputs: in its branches or its condition.

    The equations are asked with every switch on one branch, so nothing is proved of what stands on the others.
    """
    compiled = Equations(model, (), outputs)
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
    listed = list(model.parameters)
    return {listed[k] for _, group, k in behind if group == "p"}


def _combination(c: StructuralCombination) -> Combination:
    direction: FrozenMap[float] = (
        FrozenMap(zip(c.members, c.directions[0], strict=True)) if c.directions else FrozenMap()
    )
    return Combination(c.members, c.seen, "structural", direction, text="" if c.seen else c.words)


def _by_numbers(numbers: Structure, why: str) -> Structure:
    """The structure from numbers, with the remark why not from the equations."""
    return replace(
        numbers,
        note="; ".join(
            [f"from the sensitivities at random points, because {why}", *([numbers.note] if numbers.note else [])]
        ),
    )


def _undecided(numbers: Structure, why: str) -> Structure:
    note = f"the equations did not decide ({why}); the sensitivities at random points stand in for them"
    return replace(numbers, status="not decided", note=note)


def numerical_structure(problem: Problem, seed: int = 0, *, wide: bool = False) -> Structure:
    """The structure from the rank of the sensitivities at random points, for anything that can be simulated: local.

    wide: whether to look for other regimes too, up to the bounds.
    """
    found = local_rank(problem, seed, wide=wide)
    names = tuple(f.name for f in problem.free)
    if not found.points:
        return Structure("not decided", METHOD, names, note="no random point could be simulated")
    return Structure("decided", METHOD, found.independent, found.combinations, found.note, moving=found.moving)
