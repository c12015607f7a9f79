"""Random points in real numbers of many digits, near the operating point, and the rows there."""

from __future__ import annotations

from decimal import Decimal
from random import Random
from typing import Any

import numpy as np

from hvdc_ident.sensitivity.rank.equations import Equations
from hvdc_ident.sensitivity.rank.high_precision import HighPrecision
from hvdc_ident.sensitivity.rank.points import Base, Question, Rows, affected, rows
from hvdc_ident.sensitivity.rank.prime_field import NoSuchNumber, NotRational
from hvdc_ident.sensitivity.rank.taylor import Taylor, inverse


class RealPoints:
    """Random points near the operating point, in real numbers of 120 decimals; use inside `context()`."""

    def __init__(self, question: Question, random: Random, deadline: float) -> None:
        self.q, self.ring, self.random, self.deadline = question, HighPrecision(), random, deadline

    def __call__(self) -> Rows:
        """The rows at one more point."""
        for spread in (0.2, 0.1, 0.05, 0.02, 0.01):
            try:
                return rows(self.q, self.ring, self._base(spread), self._jump, self.random, self.deadline)
            except ArithmeticError:
                continue
        raise NotRational("no start was found near the operating point")

    def _near(self, value: float, spread: float) -> Decimal:
        share = Decimal(self.random.randrange(-(10**6), 10**6)) / 10**6
        return Decimal(repr(float(value))) * (1 + Decimal(str(spread)) * share)

    def _base(self, spread: float) -> Base:
        m, q = self.q.source.model, self.q
        p = [
            self._near(x.value or 0.05 * x.size, spread) if k in q.parameters else Decimal(repr(x.value))
            for k, x in enumerate(m.parameters.values())
        ]
        w = [Decimal(0), *(Decimal(repr(float(v))) for v in q.source.u)]
        y = [Decimal(repr(float(v))) for v in q.source.point]
        free = [k for k, s in enumerate(q.rest.starts) if s is None]
        for k in free:
            y[k] = self._near(float(y[k]) or 0.1, spread)
        zeros = [s for s in q.rest.starts if s is not None] + list(q.rest.residuals)
        unknown = [k for k in range(len(y)) if k not in free]
        return Base(p, self._newton(zeros, unknown, p, y, w), w, {})

    def _newton(self, zeros: list[int], unknown: list[int], p: list[Any], y: list[Any], w: list[Any]) -> list[Any]:
        if not zeros:
            return y
        q = self.q
        flat = Equations(q.rest.graph, (q.rest.graph.zero,) * len(y), (), (), (), ())
        for _ in range(60):
            t = Taylor(flat, self.ring, p, (), 0, self.deadline)
            result = t.run(y, [[v] for v in w], 0, zeros)
            block = np.array([result[n][0] for n in zeros])
            step = self.ring.product(inverse(self.ring, block[:, [1 + k for k in unknown]]), block[:, :1])[:, 0]
            y = list(y)
            for k, d in zip(unknown, step, strict=True):
                y[k] = y[k] - d
            if all(abs(d) < Decimal("1e-100") * (1 + abs(y[k])) for k, d in zip(unknown, step, strict=True)):
                return y
        raise NoSuchNumber("no start was found")

    def _jump(self, base: Base, w: list[Any], jumped: set[int], random: Random) -> list[Any]:
        nx = len(self.q.rest.derivatives)
        unknown = [nx + k for k in sorted(affected(self.q, jumped))]
        zeros = [self.q.move.residuals[k - nx] for k in unknown]
        return self._newton(zeros, unknown, base.p, base.y, w)[nx:] if unknown else base.y[nx:]
