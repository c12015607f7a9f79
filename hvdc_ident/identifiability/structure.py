"""What can be told from any data at all: the structural part of the report, symbolic where there are equations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hvdc_ident.experiment import Experiment
from hvdc_ident.fit import Problem
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.identifiability.combinations import Combination
from hvdc_ident.identifiability.local_rank import METHOD, local_rank
from hvdc_ident.model.definition import Model
from hvdc_ident.sensitivity.rank.combination import Combination as Found
from hvdc_ident.sensitivity.structural import StructuralResult, identifiable_subset, structural_identifiability

SECONDS = 10.0
"""How long the symbolic test may compute; the shipped link takes 3."""


@dataclass(frozen=True)
class Structure:
    """The structural verdict on the candidates.

    status: decided, or not decided. method: "symbolic" or "numerical, local". admissible: the most that can be told
    together once the others are held; the earlier listed where there is a choice. combinations: what is seen of others.
    note: why it is not decided, or what the method cannot see. unmoved: parameters that show only where an input is
    moved that was not.
    """

    status: str
    method: str
    admissible: tuple[str, ...]
    combinations: tuple[Combination, ...] = ()
    note: str = ""
    unmoved: tuple[str, ...] = ()

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
    Where the equations lose a combination that the numbers, with all experiments together, tell apart, the numbers are
    right: several operating points show more than one does. A parameter of which nothing at all is seen with the inputs
    that were moved is structural only where no other input would show it; else it is left to the data's verdict.
    """
    numbers = numerical_structure(problem, seed)
    if model is None:
        return numbers
    names = tuple(f.name for f in problem.free)
    outputs = problem.outputs
    if any(e.drive or e.instrument for e in problem.fitted_experiments):
        return _by_numbers(numbers, "slots are driven by recordings, or outputs seen through instruments")
    moved = moves(problem.fitted_experiments)
    result = structural_identifiability(model, names, outputs, inputs=moved, seed=seed, time_limit=SECONDS)
    if result.out_of_reach:
        return _by_numbers(numbers, result.reason)
    if result.status != "decided":
        return _undecided(numbers, result.reason)
    alone = [c.members[0] for c in result.combinations if len(c.members) == 1]
    hidden = _hidden(model, alone, names, outputs, seed)
    together = tuple(_combination(c) for c in result.combinations if len(c.members) > 1)
    if together and not numbers.combinations:
        note = "one move from one start would not tell them all apart, but these experiments together do"
        together, kept = (), set(names)
    else:
        note, kept = "", {*identifiable_subset(result), *alone}
    unseen = tuple(Combination((n,), (), "structural", text=f"nothing is seen of {n}") for n in hidden)
    admissible = tuple(n for n in names if n in kept and n not in hidden)
    return Structure(
        "decided", result.method, admissible, (*together, *unseen), note, tuple(n for n in alone if n not in hidden)
    )


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


def _combination(c: Found) -> Combination:
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


def numerical_structure(problem: Problem, seed: int = 0) -> Structure:
    """The structure from the rank of the sensitivities at random points, for anything that can be simulated: local."""
    found = local_rank(problem, seed)
    names = tuple(f.name for f in problem.free)
    if not found.points:
        return Structure("not decided", METHOD, names, note="no random point could be simulated")
    return Structure("decided", METHOD, found.independent, found.combinations, found.note)
