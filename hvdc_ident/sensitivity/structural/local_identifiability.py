"""Local structural identifiability: the parameters that given outputs can tell at all, whatever the data's quality.

Method: the rank of the observability-identifiability matrix at random points of a prime field, from Taylor series of the
outputs (A. Sedoglavic, J. Symbolic Computation 33 (2002) 735-755), with the inputs that really move, the start that really
holds and the limiters on one branch each. A parameter is locally identifiable where its unit row is among the rows.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from random import Random
from typing import Any, Literal

import numpy as np

from hvdc_ident.errors import InputError, require_known, unknown_name
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model
from hvdc_ident.sensitivity.information import leading
from hvdc_ident.sensitivity.structural.finite_field import PRIMES, NotRational, OutOfTime, PrimeField, context
from hvdc_ident.sensitivity.structural.invariants import (
    SPARE,
    Invariant,
    StructuralCombination,
    components,
    invariants,
    nulls,
    tied,
)
from hvdc_ident.sensitivity.structural.observability import (
    EquationSource,
    InputClass,
    PointRows,
    Question,
    RealPoints,
    Start,
)
from hvdc_ident.sensitivity.structural.random_points import FieldPoints
from hvdc_ident.text import listed

REAL_POINTS = 5
LOW = 8  # Taylor order that often shows all there is to see
CHECK = 0.4  # share of the time left that a confirmation may take
FEW = 8  # members of a combination up to which polynomials are looked for


Drawn = tuple[list[PointRows], Callable[[], PointRows], str]


@dataclass
class _Analysis:
    """One question put to a model: its points, and the answer in words."""

    model: Model
    names: tuple[str, ...]
    outputs: tuple[str, ...]
    moved: Mapping[str, InputClass]
    starts: Mapping[str, Start]
    regime: dict[str, str]
    seed: int
    deadline: float

    def __post_init__(self) -> None:
        self.regime_words = [f"{n}: {mode}" for n, mode in self.regime.items()]

    def answer(self) -> dict[str, Any]:
        """Return the result's fields beside the question. Raises NotRational for a model outside the method, OutOfTime."""
        if self.model.delays or self.model.sampled:
            raise NotRational("it has delays or sampled parts")
        asked = {n for n, s in self.model.states.items() if s.start == "free" and f"{n}_start" in self.names}
        starts: dict[str, Start] = {n: "given" if n in asked else s for n, s in self.starts.items()}
        source = EquationSource(self.model, self.outputs, starts)
        if source.graph.switches:
            self._operating(source)
        self.regime_words += [x for x in source.active() if x.split(":")[0] not in self.regime]
        rest = source.equations({})
        move = source.equations(self.regime) if self.regime else rest
        question = self._question(source, rest, move, self.moved)
        result = self._decide(question)
        wide = dict.fromkeys(self.moved, "free")
        if question.rested or not result.get("unidentifiable") or all(k == "free" for k in self.moved.values()):
            return result
        general = self._decide(self._question(source, rest, move, wide))
        if general.get("rank") == result["rank"]:
            return result
        return {"status": "not decided", "reason": "from this start one move of the inputs may show less than several"}

    def _operating(self, source: EquationSource) -> None:
        """Find the operating point. Its time, machine code included, does not count against the limit."""
        begun = time.thread_time()
        _ = source.point
        self.deadline += time.thread_time() - begun

    def _question(self, source: EquationSource, rest: Any, move: Any, moved: Mapping[str, Any]) -> Question:
        places = list(self.model.parameters)
        inputs = tuple((1 + list(self.model.inputs).index(n), k) for n, k in moved.items())
        rested = all(s == "steady" for s in source.start.values())
        return Question(source, rest, move, tuple(places.index(n) for n in self.names), inputs, rested)

    def _decide(self, q: Question) -> dict[str, Any]:
        """The verdict: from a few coefficients where they show all there is to see, else from all that are needed."""
        for question in (replace(q, highest=LOW), q) if q.order > LOW else (q,):
            points, make, method = self._points(question)
            if points and len(points[0].pivots) == len(self.names):
                break
        if not points:
            return {"status": "not decided", "reason": "the random points disagree"}
        with context():
            return self._result(points, make, method)

    def _points(self, q: Question) -> Drawn:
        """Points that agree, what makes more of them, and the method's name; no points where they disagree."""
        try:
            drawn = self._exact(q)
            if drawn is not None:
                return drawn
        except NotRational:
            pass
        self._operating(q.source)
        make = RealPoints(q, Random(self.seed), self.deadline)
        points = [make() for _ in range(REAL_POINTS)]
        return (points if len({_pattern(r) for r in points}) == 1 else []), make, "numeric, local"

    def _exact(self, q: Question) -> Drawn | None:
        """Points over prime fields; None where a real point sees something else."""
        makers = [FieldPoints(q, PrimeField(p), Random(self.seed + i), self.deadline) for i, p in enumerate(PRIMES[:3])]
        points = [make() for make in makers[:2]]
        if _pattern(points[0]) != _pattern(points[1]):
            points.append(makers[2]())  # an unlucky point sees less, never more
            points.sort(key=lambda r: (-len(r.pivots), len(r.seen)))
            if _pattern(points[0]) != _pattern(points[1]):
                return [], makers[0], ""
        if any(m.chose for m in makers) and not self._confirmed(q, points[0]):
            return None
        return points[:1], next(m for m in makers if m.ring == points[0].ring), "prime field"

    def _confirmed(self, q: Question, found: PointRows) -> bool:
        """True where a real point sees the same as a point of the field, which may lie on another branch; or time is short."""
        if q.highest and len(found.pivots) < len(self.names):
            return True  # it is asked again at the full order
        self._operating(q.source)
        now = time.thread_time()
        try:
            real = RealPoints(q, Random(self.seed), now + CHECK * (self.deadline - now))()
        except (OutOfTime, NotRational, ArithmeticError):
            return True
        return _pattern(real) == _pattern(found)

    def _result(self, points: list[PointRows], make: Callable[[], PointRows], method: str) -> dict[str, Any]:
        rows = points[0]
        seen = tuple(self.names[k] for k in rows.seen)
        return {
            "status": "decided",
            "method": method,
            "identifiable": seen,
            "unidentifiable": tuple(n for n in self.names if n not in seen),
            "combinations": tuple(self._combination(g, points, make) for g in components(nulls(rows))),
            "rank": len(rows.pivots),
            "rows": tuple(tuple(float(x) for x in row) for row in rows.matrix),
            "prime": rows.ring.p,
        }

    # --- words ---

    def _combination(
        self, members: tuple[int, ...], points: list[PointRows], make: Callable[[], PointRows]
    ) -> StructuralCombination:
        names = tuple(self.names[k] for k in members)
        if len(members) == 1:
            return StructuralCombination(names, (), f"nothing is seen of {names[0]}", 1, ((1.0,),))
        null = nulls(points[0])[:, list(members)]
        free = int(np.any(null != 0, axis=1).sum())
        found = self._named(members, points, make, free)
        if found is None:
            return StructuralCombination(names, (), tied(names, free), free)
        seen = tuple(i.text(names) for i in found)
        directions, relative = self._directions(names, found, free)
        words = f"only {listed(seen)} {'is' if len(seen) == 1 else 'are'} seen"
        return StructuralCombination(names, seen, words, free, directions, relative)

    def _named(
        self, members: tuple[int, ...], points: list[PointRows], make: Callable[[], PointRows], free: int
    ) -> tuple[Invariant, ...] | None:
        """Return the invariants of the members, from points enough to rule out chance; None where they have no simple form."""
        n = len(members)
        for coefficients in (n, n * (n + 3) // 2) if n <= FEW else (n,):
            try:
                while len(points) * free < coefficients + SPARE:
                    more = make()
                    points += [more] if _pattern(more) == _pattern(points[0]) else []
            except OutOfTime:
                return None
            found = invariants(points, members)
            if found is not None:
                return found
        return None

    def _directions(
        self, names: Sequence[str], found: Sequence[Invariant], free: int
    ) -> tuple[tuple[tuple[float, ...], ...], bool]:
        """The null directions at the model's values: of the logarithms where only products are seen."""
        relative = all(len(i.terms) == 1 for i in found)
        if relative:
            matrix = np.array([[float(x) for x in i.terms[0][1]] for i in found])
        else:
            values = [np.float64(self.model.parameters[n].value or 1e-3 * self.model.parameters[n].size) for n in names]
            with np.errstate(all="ignore"):
                matrix = np.array([i.slopes(values) for i in found])
            if not np.isfinite(matrix).all():  # a power or a quotient that has no slope at these values
                return (), False
        null = np.linalg.svd(matrix)[2][len(matrix) :] if free else np.zeros((0, len(names)))
        scaled = [v / v[leading(v)] for v in null]
        return tuple(tuple(float(round(x, 12)) + 0.0 for x in v) for v in scaled), relative


def _pattern(rows: PointRows) -> tuple[tuple[int, ...], tuple[int, ...]]:
    return rows.pivots, rows.seen


CLASSES = ("constant", "step", "ramp", "free")


@dataclass(frozen=True)
class StructuralResult:
    """Structural identifiability of parameters from outputs, for one regime, input class and start.

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
    combinations: tuple[StructuralCombination, ...] = ()
    rank: int = 0
    rows: tuple[tuple[float, ...], ...] = ()
    prime: int = 0
    seconds: float = 0.0
    out_of_reach: bool = False

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
    """Return the parameters that the outputs can tell, and the combinations that alone are seen of the others.

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
    require_known("parameter", names, model.parameters, f"model '{model.name}'")
    analysis = _Analysis(model, names, watched, moved, starts, dict(regime or {}), seed, begun + time_limit)
    try:
        found = analysis.answer()
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
        names, watched, FrozenMap(moved), FrozenMap(starts), tuple(analysis.regime_words), seconds=seconds, **found
    )


def identifiable_subset(result: StructuralResult, order: Sequence[str] | None = None) -> tuple[str, ...]:
    """Return the largest set of parameters that is identifiable once all others are held; earlier in `order` is kept first.

    order: names of the result's parameters; None: as they were listed. All of them where nothing was decided.
    """
    names = tuple(result.parameters if order is None else order)
    require_known("parameter", names, result.parameters, "order")
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
