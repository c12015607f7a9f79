"""Local structural identifiability: the parameters that given outputs can tell at all, whatever the data's quality.

Method: the directions in parameters that no Taylor coefficient of the outputs shows, at random points near the model's values and
in decimals of many digits, with the inputs that really move, the start that really holds and the limiters on one branch each.
A parameter is locally identifiable where no such direction moves it.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from typing import Any, Literal

import numpy as np

from hvdc_ident.codec import NOT_STORED, Coded
from hvdc_ident.data import Array
from hvdc_ident.errors import InputError, SteadyStateError, require_known, unknown_name
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model
from hvdc_ident.sensitivity.structural.combinations import (
    EXACT,
    Combination,
    Point,
    combinations_seen,
    held_of,
)
from hvdc_ident.sensitivity.structural.regime import EquationSource, Start
from hvdc_ident.sensitivity.structural.unseen_directions import (
    InputClass,
    NotReached,
    OutOfTime,
    Question,
    unseen_at_random,
)

METHOD = "Taylor series at random points"
POINTS = 3
"""Points of which two must agree: an unlucky one sees less."""


def _agreeing(question: Question, seed: int) -> list[Point]:
    """One point that sees everything, or two that agree. Raises NotReached where no two do."""
    points: list[Point] = []
    for k in range(POINTS):
        points.append(unseen_at_random(question, seed + k))
        alike = [p for p in points if p.pattern == points[-1].pattern]
        if len(alike) > 1 or not points[-1].directions.size:
            return alike
    raise NotReached("the random points disagree")


def _answer(question: Question, names: tuple[str, ...], seed: int) -> dict[str, Any]:
    """Return the result's fields beside the question. Raises NotReached for a model outside the method, OutOfTime."""
    points, seeds = _agreeing(question, seed), count(seed + POINTS)
    if points[0].directions.size and not question.rested and any(k != "free" for _, k in question.moved):
        general = _agreeing(replace(question, moved=tuple((k, "free") for k, _ in question.moved)), seed)
        if len(general[0].directions) != len(points[0].directions):
            return {"reason": "from this start one move of the inputs may show less than several"}

    def more() -> Point | None:
        try:
            unseen = (unseen_at_random(question, next(seeds)) for _ in range(POINTS))
            return next((p for p in unseen if p.pattern == points[0].pattern), None)
        except (OutOfTime, NotReached):
            return None

    values = [x.value or 1e-3 * x.size for x in (question.source.model.parameters[n] for n in names)]
    lost = {names[k] for g in points[0].groups for k in g}
    return {
        "status": "decided",
        "method": METHOD,
        "identifiable": tuple(n for n in names if n not in lost),
        "unidentifiable": tuple(n for n in names if n in lost),
        "combinations": combinations_seen(names, points, values, more),
        "rank": len(names) - len(points[0].directions),
        "unseen": points[0].directions,
    }


CLASSES = ("constant", "step", "ramp", "free")


@dataclass(frozen=True, eq=False)
class StructuralResult(Coded):
    """Structural identifiability of parameters from outputs, for one regime, input class and start.

    status: "decided" or "not decided"; then `reason` says why, and nothing is claimed: identifiable, unidentifiable and
    combinations are empty. rank: how many combinations of the parameters are seen. unseen: (parameters - rank, parameters)
    a sparse basis of the directions in the parameters' logarithms that are not seen at one random point. out_of_reach: not
    decided because no more time would help (delays, sampling, no operating point).
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
    unseen: Array = field(default_factory=lambda: np.zeros((0, 0)))
    seconds: float = field(default=0.0, metadata=NOT_STORED)
    out_of_reach: bool = False

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
    """Return the parameters that the outputs can tell, and the combinations that alone are seen of the others.

    outputs: names of outputs or signals. inputs: how each moves: "step" (to another constant level, known), "ramp", "free"
    (any smooth signal) or "constant"; one that is not named is constant, None lets every input move freely. Every moved
    input moves on its own and all together, from the same start. start: "steady" (at rest before the event), "free"
    (unknown) or "given" (as the model says), for all states or by name; None: as the model says. regime: {signal: branch
    of its limiter after the event}, a clip's "low", "inside" or "high", a min's or max's "first" or "second"; all
    others stay as they are at the operating point. Inputs and known parameters have the model's values. time_limit in s, the
    search for the operating point not counted: where it is reached, or there is no operating point, the result says "not decided".

    Raises UnknownNameError for a name the model lacks, InputError for a class or branch there is none of.
    """
    begun = time.thread_time()
    names, watched = tuple(dict.fromkeys(parameters)), tuple(outputs)
    moved = _classes(model, inputs)
    starts = _starts(model, start)
    require_known("parameter", names, model.parameters, f"model '{model.name}'")
    asked = {n for n, s in model.states.items() if s.start == "free" and f"{n}_start" in names}
    branches, places = dict(regime or {}), list(model.parameters)
    words = [f"{n}: {mode}" for n, mode in branches.items()]
    answer: dict[str, Any] = {}
    try:
        if model.delays or model.sampled:
            raise NotReached("it has delays or sampled parts")
        source = EquationSource(model, watched, starts | dict.fromkeys(asked, "given"))
        words += [x for x in source.active() if x.split(":")[0] not in branches]
        rest = source.equations({})
        question = Question(
            source,
            rest,
            source.equations(branches) if branches else rest,
            tuple(places.index(n) for n in names),
            tuple((1 + list(model.inputs).index(n), kind) for n, kind in moved.items()),
            all(s == "steady" for s in source.start.values()),
            time.thread_time() + time_limit,
        )
        answer = _answer(question, names, seed)
    except OutOfTime:
        answer = {"reason": f"the time limit of {time_limit:g} s was reached"}
    except (NotReached, SteadyStateError) as e:
        answer = {"reason": f"the method does not reach this model: {e}", "out_of_reach": True}
    result = {"status": "not decided", "regime": tuple(words), "seconds": time.thread_time() - begun, **answer}
    return StructuralResult(names, watched, FrozenMap(moved), FrozenMap(starts), **result)


def identifiable_subset(result: StructuralResult, order: Sequence[str] | None = None) -> tuple[str, ...]:
    """Return the largest set of parameters that is identifiable once all others are held; earlier in `order` is kept first.

    order: names of the result's parameters; None: as they were listed. All of them where nothing was decided.
    """
    names = tuple(result.parameters if order is None else order)
    require_known("parameter", names, result.parameters, "order")
    if result.status != "decided":
        return names
    ordered = (*names, *(n for n in result.parameters if n not in names))  # those left out are held before the others
    held = {ordered[k] for k in held_of(result.unseen[:, [result.parameters.index(n) for n in ordered]], EXACT)}
    return tuple(n for n in result.parameters if n in names and n not in held)


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
    by_model: dict[str, Start] = {
        n: "steady" if s.start is None else "free" if s.start == "free" else "given" for n, s in model.states.items()
    }
    given = dict.fromkeys(by_model, start) if isinstance(start, str) else dict(start or {})
    for name, kind in given.items():
        if name not in by_model:
            raise unknown_name("state", name, by_model, where=f"model '{model.name}'")
        if kind not in ("steady", "free", "given") or (kind == "given" and by_model[name] == "steady"):
            expected = "steady or free" + (
                ", for the model gives it no start" if by_model[name] == "steady" else " or given"
            )
            raise InputError(f"state '{name}' cannot start '{kind}'", where=f"model '{model.name}'", expected=expected)
    return by_model | given
