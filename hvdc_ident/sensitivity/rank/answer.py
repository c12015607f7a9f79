"""One question of structural identifiability answered: points drawn, ranks compared, combinations put in words."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from random import Random
from typing import Any

import numpy as np

from hvdc_ident.model.definition import Model
from hvdc_ident.sensitivity.pivot import leading
from hvdc_ident.sensitivity.rank.combination import Combination, listed, tied
from hvdc_ident.sensitivity.rank.equations import Source, Start
from hvdc_ident.sensitivity.rank.high_precision import context
from hvdc_ident.sensitivity.rank.points import InputClass, Question, Rows
from hvdc_ident.sensitivity.rank.prime_field import PRIMES, NotRational, PrimeField
from hvdc_ident.sensitivity.rank.prime_points import FieldPoints
from hvdc_ident.sensitivity.rank.real_points import RealPoints
from hvdc_ident.sensitivity.rank.ring import OutOfTime
from hvdc_ident.sensitivity.rank.words import SPARE, Invariant, components, invariants, nulls

REAL_POINTS = 5
LOW = 8  # Taylor order that often shows all there is to see
CHECK = 0.4  # share of the time left that a confirmation may take
FEW = 8  # members of a combination up to which polynomials are looked for


Drawn = tuple[list[Rows], Callable[[], Rows], str]


class _Precise:
    """Real points, each computed with all its digits."""

    def __init__(self, points: RealPoints) -> None:
        self.points = points

    def __call__(self) -> Rows:
        with context():
            return self.points()


class Ask:
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
        if source.graph.switches:
            self._operating(source)
        self.regime_words += [x for x in source.active() if x.split(":")[0] not in self.regime]
        rest = source.equations({})
        move = source.equations(self.regime) if self.regime else rest
        own = self._question(source, rest, move, self.moved)
        result = self._decide(own)
        wide = dict.fromkeys(self.moved, "free")
        if own.rested or not result.get("unidentifiable") or all(k == "free" for k in self.moved.values()):
            return result
        most = self._decide(self._question(source, rest, move, wide))
        if most.get("rank") == result["rank"]:
            return result
        return {"status": "not decided", "reason": "from this start one move of the inputs may show less than several"}

    def _operating(self, source: Source) -> None:
        """Finds the operating point; that the machine code may have to be made first is not counted as time."""
        begun = time.thread_time()
        _ = source.point
        self.deadline += time.thread_time() - begun

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
        make = _Precise(RealPoints(q, Random(self.seed), self.deadline))
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

    def _confirmed(self, q: Question, found: Rows) -> bool:
        """Whether a real point sees the same, where a point of the field may lie on another branch; yes if time is short."""
        if q.highest and len(found.pivots) < len(self.names):
            return True  # it is asked again at the full order
        self._operating(q.source)
        now = time.thread_time()
        try:
            real = _Precise(RealPoints(q, Random(self.seed), now + CHECK * (self.deadline - now)))()
        except (OutOfTime, NotRational, ArithmeticError):
            return True
        return _pattern(real) == _pattern(found)

    def _result(self, points: list[Rows], make: Callable[[], Rows], method: str) -> dict[str, Any]:
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

    def _combination(self, members: tuple[int, ...], points: list[Rows], make: Callable[[], Rows]) -> Combination:
        names = tuple(self.names[k] for k in members)
        if len(members) == 1:
            return Combination(names, (), f"nothing is seen of {names[0]}", 1, ((1.0,),))
        null = nulls(points[0])[:, list(members)]
        free = int(np.any(null != 0, axis=1).sum())
        found = self._named(members, points, make, free)
        if found is None:
            return Combination(names, (), tied(names, free), free)
        seen = tuple(i.text(names) for i in found)
        directions, relative = self._directions(names, found, free)
        words = f"only {listed(seen)} {'is' if len(seen) == 1 else 'are'} seen"
        return Combination(names, seen, words, free, directions, relative)

    def _named(
        self, members: tuple[int, ...], points: list[Rows], make: Callable[[], Rows], free: int
    ) -> tuple[Invariant, ...] | None:
        """What is seen of the members, from points enough to rule out chance; None where it has no simple form."""
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


def _pattern(rows: Rows) -> tuple[tuple[int, ...], tuple[int, ...]]:
    return rows.pivots, rows.seen
