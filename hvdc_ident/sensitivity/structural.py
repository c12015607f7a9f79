"""Which parameters the chosen outputs can tell at all, whatever the data's quality: local structural identifiability.

Method: the rank of the observability-identifiability matrix at random points of a prime field, from Taylor series of the
outputs (A. Sedoglavic, J. Symbolic Computation 33 (2002) 735-755), with the inputs that really move, the start that really
holds and the limiters on one branch each. A parameter is locally identifiable where its unit row is among the rows.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from hvdc_ident.errors import InputError, unknown_name
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.model.definition import Model
from hvdc_ident.sensitivity.rank.answer import Ask
from hvdc_ident.sensitivity.rank.combination import Combination
from hvdc_ident.sensitivity.rank.equations import Start
from hvdc_ident.sensitivity.rank.points import InputClass
from hvdc_ident.sensitivity.rank.prime_field import NotRational, PrimeField
from hvdc_ident.sensitivity.rank.ring import OutOfTime

__all__ = ["Combination", "StructuralResult", "identifiable_subset", "structural_identifiability"]

CLASSES = ("constant", "step", "ramp", "free")


@dataclass(frozen=True)
class StructuralResult:
    """What the outputs can tell, for one regime, input class and start.

    status: "decided" or "not decided"; then `reason` says why, and nothing is claimed: identifiable, unidentifiable and
    combinations are empty. method: "prime field" (exact up to a probability below 1e-6) or "numeric, local" (real points
    near the model's values, 120 decimals). rank: how many combinations of the parameters are seen. rows: (rank, parameters)
    a basis of what is seen at one random point, reduced; modulo `prime` unless that is 0. out_of_reach: not decided because
    the model has parts that no more time would help with (delays, sampling, functions without a series).
    """

    parameters: tuple[str, ...]
    outputs: tuple[str, ...]
    inputs: FrozenMap[str]
    start: FrozenMap[str]
    regime: tuple[str, ...]
    status: Literal["decided", "not decided"]
    reason: str = ""
    method: str = ""
    identifiable: tuple[str, ...] = ()
    unidentifiable: tuple[str, ...] = ()
    combinations: tuple[Combination, ...] = ()
    rank: int = 0
    rows: tuple[tuple[float, ...], ...] = ()
    prime: int = 0
    seconds: float = 0.0
    out_of_reach: bool = False

    def combination_of(self, parameter: str) -> Combination | None:
        """The combination a parameter is a member of, or None."""
        return next((c for c in self.combinations if parameter in c.members), None)

    def to_dict(self) -> dict[str, Any]:
        """The result as plain values, without the time it took."""
        return {
            "parameters": list(self.parameters),
            "outputs": list(self.outputs),
            "inputs": dict(self.inputs),
            "start": dict(self.start),
            "regime": list(self.regime),
            "status": self.status,
            "reason": self.reason,
            "method": self.method,
            "identifiable": list(self.identifiable),
            "unidentifiable": list(self.unidentifiable),
            "combinations": [c.to_dict() for c in self.combinations],
            "rank": self.rank,
        }

    def __str__(self) -> str:
        if self.status != "decided":
            return f"not decided: {self.reason}"
        lines = [f"identifiable ({self.method}): {', '.join(self.identifiable) or 'none'}"]
        return "\n".join([*lines, *(c.words for c in self.combinations)])


def structural_identifiability(
    model: Model,
    parameters: Sequence[str],
    outputs: Sequence[str],
    *,
    inputs: Mapping[str, InputClass] | None = None,
    start: Start | Mapping[str, Start] | None = None,
    regime: Mapping[str, str] | None = None,
    seed: int = 0,
    time_limit: float = 10.0,
) -> StructuralResult:
    """Which of the parameters the outputs can tell, and what alone is seen of the others.

    outputs: names of outputs or signals. inputs: how each moves: "step" (to another constant level, known), "ramp", "free"
    (any smooth signal) or "constant"; one that is not named is constant, None lets every input move freely. Every moved
    input moves on its own and all together, from the same start. start: "steady" (at rest before the event), "free"
    (unknown) or "given" (as the model says), for all states or by name; None: as the model says. regime: {signal: branch
    of its limiter after the event}, a clip's "low", "inside" or "high", a min's or max's "first" or "second"; all
    others stay as they are at the operating point. An input or a known parameter that is 0 in the model is 0 here; other
    known numbers are taken as general. time_limit in s, the search for the operating point not counted: where it is
    reached the result says "not decided".

    Raises UnknownNameError for a name the model lacks, InputError for a class or branch there is none of.
    """
    begun = time.thread_time()
    names, watched = tuple(dict.fromkeys(parameters)), tuple(outputs)
    moved = _classes(model, inputs)
    starts = _starts(model, start)
    for name in names:
        if name not in model.parameters:
            raise unknown_name("parameter", name, model.parameters, where=f"model '{model.name}'")
    ask = Ask(model, names, watched, moved, starts, dict(regime or {}), seed, begun + time_limit)
    try:
        found = ask.answer()
    except OutOfTime:
        found = {"status": "not decided", "reason": f"the time limit of {time_limit:g} s was reached"}
    except NotRational as e:
        found = {
            "status": "not decided",
            "reason": f"the method does not reach this model: {e}",
            "out_of_reach": True,
        }
    seconds = time.thread_time() - begun
    return StructuralResult(
        names, watched, FrozenMap(moved), FrozenMap(starts), tuple(ask.regime_words), seconds=seconds, **found
    )


def identifiable_subset(result: StructuralResult, order: Sequence[str] | None = None) -> tuple[str, ...]:
    """The largest set of parameters that is identifiable once all others are held; earlier in `order` is kept first.

    order: names of the result's parameters; None: as they were listed. All of them where nothing was decided.
    """
    names = tuple(result.parameters if order is None else order)
    for n in names:
        if n not in result.parameters:
            raise unknown_name("parameter", n, result.parameters, where="order")
    if result.status != "decided":
        return names
    position = {n: k for k, n in enumerate(result.parameters)}
    kept: list[str] = []
    for n in names:
        columns = [[row[position[k]] for row in result.rows] for k in (*kept, n)]
        if _rank(columns, result.prime) == len(columns):
            kept.append(n)
    return tuple(n for n in result.parameters if n in kept)


def _rank(vectors: Sequence[Sequence[float]], prime: int) -> int:
    if not vectors[0]:
        return 0
    if prime:
        return len(PrimeField(prime).rref(np.array([[int(x) for x in v] for v in vectors]))[1])
    columns = np.array(vectors, float)
    sizes = np.linalg.norm(columns, axis=1, keepdims=True)
    return int(np.linalg.matrix_rank(columns / np.where(sizes > 0, sizes, 1.0), tol=1e-12))


def _classes(model: Model, inputs: Mapping[str, InputClass] | None) -> dict[str, InputClass]:
    if inputs is None:
        return dict.fromkeys(model.inputs, "free")
    for name, kind in inputs.items():
        if name not in model.inputs:
            raise unknown_name("input", name, model.inputs, where=f"model '{model.name}'")
        if kind not in CLASSES:
            raise InputError(f"input '{name}' has no class '{kind}'", expected=f"one of {', '.join(CLASSES)}")
    return {name: kind for name, kind in inputs.items() if kind != "constant"}


def _starts(model: Model, start: Start | Mapping[str, Start] | None) -> dict[str, Start]:
    own: dict[str, Start] = {
        n: "steady" if s.start is None else "free" if s.start == "free" else "given" for n, s in model.states.items()
    }
    given = dict.fromkeys(own, start) if isinstance(start, str) else dict(start or {})
    for name, kind in given.items():
        if name not in own:
            raise unknown_name("state", name, own, where=f"model '{model.name}'")
        if kind not in ("steady", "free", "given") or (kind == "given" and own[name] == "steady"):
            expected = "steady or free" + (
                ", for the model gives it no start" if own[name] == "steady" else " or given"
            )
            raise InputError(f"state '{name}' cannot start '{kind}'", where=f"model '{model.name}'", expected=expected)
    return own | given
