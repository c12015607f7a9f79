"""Which parameters the chosen outputs can tell at all, whatever the data's quality: local structural identifiability.

Method: the rank of the observability-identifiability matrix at random points of a prime field, from Taylor series of the
outputs (A. Sedoglavic, J. Symbolic Computation 33 (2002) 735-755), with the inputs that really move, the start that really
holds and the limiters on one branch each. A parameter is locally identifiable where its unit row is among the rows.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from random import Random
from typing import Any, Literal

import numpy as np

from hvdc_ident.errors import InputError, unknown_name
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.model.definition import Model
from hvdc_ident.sensitivity.equations import Source, Start
from hvdc_ident.sensitivity.high_precision import context
from hvdc_ident.sensitivity.points import FieldPoints, InputClass, Question, RealPoints, Rows
from hvdc_ident.sensitivity.prime_field import PRIMES, Array, NotRational, PrimeField
from hvdc_ident.sensitivity.taylor import OutOfTime
from hvdc_ident.sensitivity.words import Invariant, components, invariants, nulls

CLASSES = ("constant", "step", "ramp", "free")
REAL_POINTS = 5
FEW = 8  # members of a combination up to which polynomials are looked for


@dataclass(frozen=True)
class Combination:
    """Parameters that only together are seen.

    members: their names. seen: the combinations that hold all that is seen of them; empty where none is simple, or where
    nothing is seen of them at all. words: the sentence for the report. free: how many of the members can be given any
    value, the others then following. directions: (free, members) null directions at the model's values, the largest entry
    1: of the relative changes where `relative`, else of the changes themselves; empty where they are not known.
    """

    members: tuple[str, ...]
    seen: tuple[str, ...]
    words: str
    free: int
    directions: tuple[tuple[float, ...], ...] = ()
    relative: bool = False

    def to_dict(self) -> dict[str, Any]:
        """The combination as plain values."""
        return {
            "members": list(self.members),
            "seen": list(self.seen),
            "words": self.words,
            "free": self.free,
            "directions": [list(d) for d in self.directions],
            "relative": self.relative,
        }


@dataclass(frozen=True)
class StructuralResult:
    """What the outputs can tell, for one regime, input class and start.

    status: "decided" or "not decided"; then `reason` says why, and nothing is claimed: identifiable, unidentifiable and
    combinations are empty. method: "prime field" (exact up to a probability below 1e-6) or "numeric, local" (real points
    near the model's values, 120 decimals). rank: how many combinations of the parameters are seen. rows: (rank, parameters)
    a basis of what is seen at one random point, scaled to at most 1 or modulo `prime`.
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
    known numbers are taken as general. time_limit in s: where it is reached the result says "not decided".

    Raises UnknownNameError for a name the model lacks, InputError for a class or branch there is none of.
    """
    begun = time.monotonic()
    names, watched = tuple(dict.fromkeys(parameters)), tuple(outputs)
    moved = _classes(model, inputs)
    starts = _starts(model, start)
    for name in names:
        if name not in model.parameters:
            raise unknown_name("parameter", name, model.parameters, where=f"model '{model.name}'")
    ask = _Ask(model, names, watched, moved, starts, dict(regime or {}), seed, begun + time_limit)
    try:
        found = ask.answer()
    except OutOfTime:
        found = {"status": "not decided", "reason": f"the time limit of {time_limit:g} s was reached"}
    except NotRational as e:
        found = {"status": "not decided", "reason": f"the method does not reach this model: {e}"}
    seconds = time.monotonic() - begun
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
    return int(np.linalg.matrix_rank(np.array(vectors, float), tol=1e-12))


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
            expected = "steady or free" + (", for the model gives it no start" if own[name] == "steady" else " or given")
            raise InputError(f"state '{name}' cannot start '{kind}'", where=f"model '{model.name}'", expected=expected)
    return own | given  # type: ignore[operator]


class _Ask:
    """One question, its points and the answer put together."""

    def __init__(
        self,
        model: Model,
        names: tuple[str, ...],
        outputs: tuple[str, ...],
        moved: Mapping[str, InputClass],
        starts: Mapping[str, Start],
        regime: dict[str, str],
        seed: int,
        deadline: float,
    ) -> None:
        self.model, self.names, self.outputs, self.moved = model, names, outputs, moved
        self.starts, self.regime, self.seed, self.deadline = starts, regime, seed, deadline
        self.regime_words: list[str] = [f"{n}: {mode}" for n, mode in regime.items()]

    def answer(self) -> dict[str, Any]:
        """What the result says besides the question."""
        if self.model.delays or self.model.sampled:
            raise NotRational("it has delays or sampled parts")
        source = Source(self.model, self.outputs, self._known_starts())
        self.regime_words += [x for x in source.active() if x.split(":")[0] not in self.regime]
        rest = source.equations({})
        move = source.equations(self.regime) if self.regime else rest
        own = self._question(source, rest, move, self.moved)
        result = self._decide(own)
        wide = {n: "free" for n in self.moved}
        if own.rested or not result.get("unidentifiable") or all(k == "free" for k in self.moved.values()):
            return result
        most = self._decide(self._question(source, rest, move, wide))
        if most.get("rank") == result["rank"]:
            return result
        return {"status": "not decided", "reason": "from this start one move of the inputs may show less than several"}

    def _known_starts(self) -> dict[str, Start]:
        """A free start that is one of the parameters asked for is given by it."""
        mine = {n for n in self.starts if f"{n}_start" in self.names and self.model.states[n].start == "free"}
        return {n: "given" if n in mine else s for n, s in self.starts.items()}

    def _question(self, source: Source, rest: Any, move: Any, moved: Mapping[str, Any]) -> Question:
        places = list(self.model.parameters)
        inputs = tuple((1 + list(self.model.inputs).index(n), k) for n, k in moved.items())
        rested = all(s == "steady" for s in source.start.values())
        return Question(source, rest, move, tuple(places.index(n) for n in self.names), inputs, rested)

    def _decide(self, q: Question) -> dict[str, Any]:
        try:
            return self._exact(q)
        except NotRational:
            with context():
                return self._numeric(q)

    # --- over prime fields ---

    def _exact(self, q: Question) -> dict[str, Any]:
        makers = [FieldPoints(q, PrimeField(p), Random(self.seed + i), self.deadline) for i, p in enumerate(PRIMES[:3])]
        points = [make() for make in makers[:2]]
        if _pattern(points[0]) != _pattern(points[1]):
            points.append(makers[2]())  # an unlucky point sees less, never more
            points.sort(key=lambda r: (-len(r.pivots), len(r.seen)))
            if _pattern(points[0]) != _pattern(points[1]):
                return {"status": "not decided", "reason": "the random points disagree"}
        first = points[0]
        make = next(m for m in makers if m.ring == first.ring)
        groups = components(nulls(first))
        more = self._more(make, first, groups)
        found = [self._combination(members, more) for members in groups]
        return self._result(first, "prime field", found)

    def _more(self, make: FieldPoints, first: Rows, groups: Sequence[tuple[int, ...]]) -> list[Rows]:
        """Points enough to tell which combinations hold at all of them."""
        entangled = [len(g) for g in groups if len(g) > 1]
        points = [first]
        if not entangled:
            return points
        wanted = max(entangled) + 3 + (max(entangled) * (max(entangled) + 3) // 2 if max(entangled) <= FEW else 0)
        while len(points) < wanted:
            if len(points) == max(entangled) + 3 and self._named(points, groups):
                break
            r = make()
            if _pattern(r) == _pattern(first):
                points.append(r)
        return points

    def _named(self, points: Sequence[Rows], groups: Sequence[tuple[int, ...]]) -> bool:
        return all(invariants(points, g) is not None for g in groups if len(g) > 1)

    def _combination(self, members: tuple[int, ...], points: Sequence[Rows]) -> Combination:
        names = tuple(self.names[k] for k in members)
        if len(members) == 1:
            return Combination(names, (), f"nothing is seen of {names[0]}", 1, ((1.0,),))
        free = int(np.any(nulls(points[0])[:, members], axis=1).sum())
        found = invariants(points, members)
        if found is None:
            return Combination(names, (), tied(names, free), free)
        seen = tuple(i.text(names) for i in found)
        directions, relative = self._directions(names, found, free)
        return Combination(names, seen, f"only {_listed(seen)} {'is' if len(seen) == 1 else 'are'} seen", free, directions, relative)

    def _directions(self, names: Sequence[str], found: Sequence[Invariant], free: int) -> tuple[tuple[tuple[float, ...], ...], bool]:
        """The null directions at the model's values: of the logarithms where only products are seen."""
        relative = all(len(i.terms) == 1 for i in found)
        if relative:
            matrix = np.array([[float(x) for x in i.terms[0][1]] for i in found])
        else:
            values = [self.model.parameters[n].value or 1e-3 * self.model.parameters[n].size for n in names]
            matrix = np.array([i.slopes(values) for i in found])
        null = np.linalg.svd(matrix)[2][len(matrix) :] if free else np.zeros((0, len(names)))
        scaled = [v / v[np.argmax(np.abs(v))] for v in null]
        return tuple(tuple(float(round(x, 12)) + 0.0 for x in v) for v in scaled), relative

    # --- with real numbers ---

    def _numeric(self, q: Question) -> dict[str, Any]:
        make = RealPoints(q, Random(self.seed), self.deadline)
        points = [make() for _ in range(REAL_POINTS)]
        if len({_pattern(r) for r in points}) > 1:
            return {"status": "not decided", "reason": "the random points disagree"}
        first = points[0]
        null = _real_null(first)
        found = []
        for members in components(null):
            names = tuple(self.names[k] for k in members)
            part = null[:, members]
            part = part[np.any(part, axis=1)]
            words = f"nothing is seen of {names[0]}" if len(members) == 1 else tied(names, len(part))
            directions = tuple(tuple(float(x) for x in v / v[np.argmax(np.abs(v))]) for v in part)
            found.append(Combination(names, (), words, len(part), directions))
        return self._result(first, "numeric, local", found)

    def _result(self, rows: Rows, method: str, found: Sequence[Combination]) -> dict[str, Any]:
        seen = tuple(self.names[k] for k in rows.seen)
        return {
            "status": "decided",
            "method": method,
            "identifiable": seen,
            "unidentifiable": tuple(n for n in self.names if n not in seen),
            "combinations": tuple(found),
            "rank": len(rows.pivots),
            "rows": tuple(tuple(float(x) for x in row) for row in rows.matrix),
            "prime": rows.ring.p,
        }


def _pattern(rows: Rows) -> tuple[tuple[int, ...], tuple[int, ...]]:
    return rows.pivots, rows.seen


def _real_null(rows: Rows) -> Array:
    n = len(rows.theta)
    free = [c for c in range(n) if c not in rows.pivots]
    null = np.zeros((len(free), n))
    for i, c in enumerate(free):
        null[i, c] = 1.0
        for row, pivot in enumerate(rows.pivots):
            null[i, pivot] = -float(rows.matrix[row, c])
    return null


def tied(names: Sequence[str], free: int) -> str:
    """The plain sentence for parameters whose combinations have no simple form."""
    k = len(names) - free
    number = "one combination" if k == 1 else f"{k} combinations"
    return f"only {number} of {_listed(names)} {'is' if k == 1 else 'are'} seen"


def _listed(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
