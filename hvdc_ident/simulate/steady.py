"""The slow way to a steady state, for models on which Newton's method alone fails: least squares, else pseudo-transient."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.errors import SteadyStateError
from hvdc_ident.simulate.structure import ACCURACY, TINY, Structure
from hvdc_ident.trajectory import Array

CLOSE = 1e-3  # a guess that is not 0 tells a state's size up to 1 / CLOSE times


def fallback(
    structure: Structure, address: NDArray[np.int64], p: Array, u: Array, guess: Array, time: float = 0.0
) -> tuple[Array, Array]:
    """The flat vectors y and w of the steady state, or SteadyStateError with the worst equation named."""
    # Compiled when it is needed first: who never needs it does not wait for the compiler.
    from hvdc_ident.simulate.machine import evaluate
    from hvdc_ident.simulate.patient import follow, nearest, slide
    from hvdc_ident.simulate.rest import MODES, RESIDUAL, REST_JAC, REST_P

    s = structure.sizes
    inner, extra = s.nx + s.nz, s.nd + s.nq
    n = inner + extra
    y, w, m = np.zeros(inner * (1 + s.width)), np.zeros(1 + s.nu + extra * (1 + s.width)), np.zeros(max(s.ns, 1))
    w[0], w[1 : 1 + s.nu] = time, u

    def equations(v: Array) -> tuple[Array, Array]:
        y[:inner], w[1 + s.nu : 1 + s.nu + extra] = v[:inner], v[inner:]
        r, jac = np.zeros(n), np.zeros(n * n)
        evaluate(address[MODES], y, w, p, m, m)
        evaluate(address[RESIDUAL], y, w, p, m, r)
        evaluate(address[REST_JAC], y, w, p, m, jac)
        return r, jac.reshape(n, n)

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

    ends: list[Array] = []
    with np.errstate(all="ignore"):
        # The rest next to the guess comes first; where there are several, following the model may end at a far one.
        for way in (closest, followed, slid):
            v = begin.copy()
            way(v)
            r, jac = equations(v)
            if near.is_rest(r, jac, v):
                break
            ends.append(v)
        else:
            raise _refused(structure, near, *equations(ends[1]), ends[1])  # where the model went is what tells most
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

    def weights(self, jac: Array, v: Array) -> Array:
        """What each equation's residual is measured by."""
        return _positive(np.abs(jac) @ np.clip(np.abs(v), TINY, self.size))

    def shares(self, r: Array, jac: Array, v: Array) -> Array:
        """The scaled residuals, less what rounding alone leaves."""
        rounding = 16 * np.finfo(float).eps * (np.abs(jac) @ np.abs(v))
        return np.asarray(np.where(np.abs(r) <= rounding, 0.0, np.abs(r) / self.weights(jac, v)))

    def is_rest(self, r: Array, jac: Array, v: Array) -> bool:
        """Whether v solves the equations, within the limits."""
        return bool((self.shares(r, jac, v) < ACCURACY).all() and (np.abs(v) <= self.limit).all())


def _positive(size: Array) -> Array:
    return np.where(size > 0, size, 1.0)


def _refused(structure: Structure, near: _Region, r: Array, jac: Array, v: Array) -> SteadyStateError:
    """The error that names the state that runs away, or else the worst equation."""
    shares = near.shares(r, jac, v)
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
