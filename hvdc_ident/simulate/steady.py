"""The slow way to a steady state, for models on which Newton's method alone fails: least squares, else pseudo-transient."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.errors import SteadyStateError
from hvdc_ident.simulate.structure import ACCURACY, Structure
from hvdc_ident.trajectory import Array

CLOSE = 1e-3  # a guess that is not 0 tells a state's size up to 1 / CLOSE times


def fallback(
    structure: Structure, address: NDArray[np.int64], p: Array, u: Array, guess: Array, time: float = 0.0
) -> tuple[Array, Array]:
    """The flat vectors y and w of the steady state, or SteadyStateError with the worst equation named."""
    # Compiled when it is needed first: who never needs it does not wait for the compiler.
    from hvdc_ident.simulate.machine import evaluate
    from hvdc_ident.simulate.patient import follow, judge, nearest, slide
    from hvdc_ident.simulate.rest import REST_P

    s = structure.sizes
    inner, extra = s.nx + s.nz, s.nd + s.nq
    n = inner + extra
    y, w, m = np.zeros(inner * (1 + s.width)), np.zeros(1 + s.nu + extra * (1 + s.width)), np.zeros(max(s.ns, 1))
    w[0], w[1 : 1 + s.nu] = time, u
    near = _Region.of(structure, guess, extra)
    begin = np.concatenate([guess, np.zeros(extra)])
    model = (y, w, np.ascontiguousarray(p, dtype=float), m, near.size)

    def closest(v: Array) -> None:
        nearest(address, inner, s.nu, *model, v)

    def followed(v: Array) -> None:
        follow(address, inner, s.nu, s.nx, *model, v)
        closest(v)

    def slid(v: Array) -> None:
        slide(address, inner, s.nu, s.nx, *model, v)

    def judged(v: Array) -> tuple[Array, Array, Array]:
        r, jac, shares = np.zeros(n), np.zeros((n, n)), np.zeros(n)
        judge(address, inner, s.nu, *model, v, r, jac, shares)
        return r, jac, shares

    ends: list[Array] = []
    with np.errstate(all="ignore"):
        # The rest next to the guess comes first; where there are several, following the model may end at a far one.
        for way in (closest, followed, slid):
            v = begin.copy()
            way(v)
            _, jac, shares = judged(v)
            if near.is_rest(shares, v):
                break
            ends.append(v)
        else:
            r, _, shares = judged(ends[1])  # where the model went is what tells most
            raise _refused(structure, near, r, shares, ends[1])
    if s.width:
        rows = np.zeros(n * s.width)
        evaluate(address[REST_P], y, w, p, m, rows)
        slope = np.linalg.lstsq(jac, -rows.reshape(n, s.width), rcond=1e-12)[0]
        y[inner:], w[1 + s.nu + extra :] = slope[:inner].ravel(), slope[inner:].ravel()
    return y, w


@dataclass(frozen=True)
class _Region:
    """Where a rest is looked for: the sizes of states, unknowns and held values as far as the model's guesses tell them.

    size: what is usual; a residual is judged against it, so that a value that grows without bound, as a dc voltage whose
    power balance P / Vdc goes to 0, cannot make its own residual small. limit: what is out of question (infinite: not known).
    """

    size: Array
    limit: Array

    @classmethod
    def of(cls, structure: Structure, guess: Array, extra: int) -> _Region:
        given = [s.guess for s in structure.model.states.values()]
        sizes = [1 / CLOSE if g is None else max(abs(g), 1.0) for g in given]
        limits = [abs(g) / CLOSE if g else np.inf for g in given]
        rest = np.maximum(np.abs(guess[len(given) :]), 1.0)
        unknown = np.full(rest.size + extra, np.inf)
        return cls(np.concatenate([sizes, rest, np.full(extra, 1 / CLOSE)]), np.concatenate([limits, unknown]))

    def is_rest(self, shares: Array, v: Array) -> bool:
        """Whether v solves the equations, by the scaled residuals there, within the limits."""
        return bool((shares < ACCURACY).all() and (np.abs(v) <= self.limit).all())


def _refused(structure: Structure, near: _Region, r: Array, shares: Array, v: Array) -> SteadyStateError:
    """The error that names the state that runs away, or else the worst equation."""
    worst = int(np.argmax(np.where(np.isfinite(shares), shares, np.inf)))
    got = f"{_equation(structure, worst)} left with {r[worst]:.3g} (scaled {shares[worst]:.2g})"
    far = np.abs(v) / near.limit
    away = int(np.argmax(np.where(np.isfinite(far), far, np.inf))) if v.size else 0
    if v.size and not far[away] <= 10 * CLOSE:
        name = structure.states[away]
        guess = structure.model.states[name].guess
        got = f"state '{name}' runs away to {v[away]:.4g} from its guess {guess:g}; {got}"
    return SteadyStateError(
        "no steady state was found",
        where=f"model '{structure.model.name}'",
        expected="every derivative 0, at states near their guesses",
        got=got,
        hint="check the input levels and limits, give states a `guess` near the solution, or a `start`",
    )


def _equation(structure: Structure, index: int) -> str:
    m = structure.model
    names = [f"d({n})/dt" for n in structure.states] + [f"unknown '{n}'" for n in structure.unknowns]
    names += [f"delay '{n}'" for n in m.delays] + [f"sampled value '{n}'" for n in m.sampled]
    return names[index]
