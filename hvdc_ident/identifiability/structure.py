"""What can be told from any data at all: the structural part of the report, symbolic where there are equations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hvdc_ident.errors import SimulationError
from hvdc_ident.experiment import Experiment
from hvdc_ident.fit import Problem
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.identifiability.combinations import Combination, combinations_of
from hvdc_ident.model.definition import Model
from hvdc_ident.sensitivity.fisher import independent, null_directions
from hvdc_ident.sensitivity.structural import StructuralResult, identifiable_subset, structural_identifiability
from hvdc_ident.trajectory import Array

POINTS = 5
SECONDS = 5.0
"""How long the symbolic test may take."""


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
    def unidentifiable(self) -> tuple[str, ...]:
        """Members of any combination."""
        return tuple(dict.fromkeys(n for c in self.combinations for n in c.members))


def structure(model: Model | None, problem: Problem, seed: int = 0) -> Structure:
    """The structure from the model's equations where there are any and the test comes to an end, else from numbers.

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
        return _undecided(numbers, "slots are driven by recordings, or outputs seen through instruments")
    moved = moves(problem.fitted_experiments)
    result = structural_identifiability(model, names, outputs, inputs=moved, seed=seed, time_limit=SECONDS)
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


def _combination(c: object) -> Combination:
    members, seen = tuple(c.members), tuple(c.seen)  # type: ignore[attr-defined]
    rows = c.directions  # type: ignore[attr-defined]
    direction = FrozenMap(zip(members, map(float, rows[0]), strict=True)) if rows else FrozenMap()
    return Combination(members, seen, "structural", direction, text="" if seen else c.words)  # type: ignore[attr-defined]


def _undecided(numbers: Structure, why: str) -> Structure:
    note = f"the equations did not decide ({why}); the sensitivities at {POINTS} random points stand in for them"
    return replace(numbers, status="not decided", note=note)


def numerical_structure(problem: Problem, seed: int = 0) -> Structure:
    """The structure from the rank of the sensitivities at five random points: what is lost at all of them.

    Local, and for the inputs of these experiments. A parameter that is not seen at all is left to the data's verdict.
    Points that cannot be simulated are passed over; with none left the structure is not decided.
    """
    names = tuple(f.name for f in problem.free)
    k, stacked, space = len(names), [], None
    for theta in _points(problem, seed):
        try:
            _, jacobian = problem.residual(theta)
        except SimulationError:
            continue
        space = _slope(problem, theta) if space is None else space
        stacked.append(jacobian * _slope(problem, theta))
    if not stacked or space is None:
        return Structure("not decided", "numerical, local", names, note="no random point could be simulated")
    ranks = [null_directions(j).shape[0] for j in stacked]
    if min(ranks) == 0:
        return Structure("decided", "numerical, local", names)
    scaled = np.vstack([j / np.maximum(np.linalg.norm(j), 1e-300) for j in stacked])
    null = null_directions(scaled)
    null = null[:, :k][(np.abs(null[:, :k]) > 0).any(axis=1)]
    if not null.size:  # the direction turns from place to place: take it where the least is lost
        null = null_directions(stacked[int(np.argmin(ranks))])[:, :k]
        null = null[(np.abs(null) > 0).any(axis=1)]
    if not null.size:
        return Structure("decided", "numerical, local", names)
    logs = [f.min > 0 for f in problem.free]
    combos = combinations_of(null, names, logs, [f.start for f in problem.free], "structural")
    involved = [i for i, n in enumerate(names) if any(n in c.members for c in combos)]
    matrix = scaled[:, :k].T @ scaled[:, :k]
    free = [i for i in range(k) if i not in involved]
    kept = {*free, *(involved[i] for i in independent(matrix[np.ix_(involved, involved)]))}
    return Structure("decided", "numerical, local", tuple(names[i] for i in sorted(kept)), combos)


def _points(problem: Problem, seed: int) -> Sequence[Array]:
    random = np.random.default_rng(seed)
    rows = []
    for _ in range(POINTS):
        rows.append(
            np.array(
                [
                    u.draw(float(s))
                    for u, s in zip(problem.unknowns, random.uniform(0.2, 0.8, len(problem.unknowns)), strict=True)
                ]
            )
        )
    return rows


def _slope(problem: Problem, theta: Array) -> Array:
    return np.array([v if u.min > 0 else u.span for u, v in zip(problem.unknowns, theta, strict=True)])
