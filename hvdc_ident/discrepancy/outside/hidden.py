"""The hidden input of an equation: what would have to be added to a slot's signal, as terms, over time, or over a signal.

Weak form: nothing is differentiated. Each term is put on the slot as the model runs, and its answer at the outputs,
whitened and freed of what the parameters can make good, is a column of a regression of the residual.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.refits.nominal import Nominal
from hvdc_ident.discrepancy.scores.scored import Path, Whitening

KNOTS = 24
INDEPENDENT = 1e-8
"""Share of a column's square that is left beside those chosen: with less it is made of them."""


@dataclass(frozen=True, eq=False)
class Regression:
    """Columns of a linear model of the residual. columns: (N, k) projected; residual: (N,) projected."""

    columns: Array
    residual: Array

    def solved(self, which: Sequence[int]) -> tuple[Array, float]:
        """The coefficients of some columns, and the fall of chi2 they bring."""
        a = self.columns[:, list(which)]
        norms = np.maximum(np.linalg.norm(a, axis=0), 1e-300)
        c = np.linalg.lstsq(a / norms, self.residual, rcond=1e-8)[0]
        return c / norms, float(self.residual @ self.residual - np.sum((self.residual - (a / norms) @ c) ** 2))

    def selected(self, most: int, price: float, residual: Array | None = None) -> list[int]:
        """Columns that lower chi2 by more than their price: the best one, pair, and so on, each found from the pair before.

        Of columns that are much alike none of two that explain the residual together need be the best by itself: pairs are
        all looked at, a further one is added to them. residual: (N,) another one; one of many is asked for in little time.
        """
        asked = self._units.T @ (self.residual if residual is None else residual)
        best = self._pair(asked, price)
        while best and len(best) < most:
            falls = self._further(asked, best)
            k = int(np.argmax(falls))
            if falls[k] <= price:
                break
            best = [*best, k]
        return best

    def _pair(self, asked: Array, price: float) -> list[int]:
        """The best column, or the best two where the second is worth its price; none where none is."""
        alone = asked**2
        k = int(np.argmax(alone))
        left = 1.0 - self._products**2
        sound = left > INDEPENDENT
        cross = self._products * np.outer(asked, asked)
        both = np.where(sound, (alone[:, None] + alone - 2.0 * cross) / np.where(sound, left, 1.0), 0.0)
        i, j = np.unravel_index(int(np.argmax(both)), both.shape)
        if both[i, j] - alone[k] > price:
            return sorted((int(i), int(j)), key=lambda n: -alone[n])
        return [k] if alone[k] > price else []

    def _further(self, asked: Array, chosen: list[int]) -> Array:
        """(k,) by how much chi2 falls with each column beside those chosen; 0 for one that is made of them."""
        half = np.linalg.solve(
            self._products[np.ix_(chosen, chosen)], np.column_stack([self._products[chosen], asked[chosen]])
        )
        square = np.diag(self._products) - np.einsum("ij,ij->j", self._products[chosen], half[:, :-1])
        left = asked - self._products[chosen].T @ half[:, -1]
        sound = square > INDEPENDENT
        return np.where(sound, left**2 / np.where(sound, square, 1.0), 0.0)

    @cached_property
    def _norms(self) -> Array:
        return np.asarray(np.linalg.norm(self.columns, axis=0))

    @cached_property
    def _units(self) -> Array:
        return np.asarray(self.columns / np.where(self._norms > 0, self._norms, 1.0))

    @cached_property
    def _products(self) -> Array:
        return np.asarray(self._units.T @ self._units)


def regression(
    nominal: Nominal, paths: Mapping[str, Path], place: str, functions: Sequence[Callable[[str, Path], Array]]
) -> Regression:
    """The regression of the residual on functions of time put on a slot; each gives (K,) for an experiment and its run."""
    parts = []
    for e in nominal.problem.fitted_experiments:
        path = paths[e.name]
        d = np.array([f(e.name, path) for f in functions]).T[None]
        whitening = Whitening.of([b for b in nominal.blocks if b.experiment == e.name], e, nominal)
        parts.append(whitening(path.answer([place], d)[1]))
    columns = nominal.projected(np.vstack(parts))
    return Regression(np.where(np.isfinite(columns), columns, 0.0), nominal.projected(nominal.residual[:, None])[:, 0])


def over_time(paths: Mapping[str, Path]) -> list[Callable[[str, Path], Array]]:
    """Hats over time, the same in every experiment."""
    begin, end = min(a.time[0] for a in paths.values()), max(a.time[-1] for a in paths.values())
    return [_hat(np.linspace(begin, end, KNOTS), k, lambda _, a: a.time) for k in range(KNOTS)]


def over_signal(
    paths: Mapping[str, Path], signal: str, knots: int = 9
) -> tuple[Array, list[Callable[[str, Path], Array]]]:
    """Knots over the levels of a signal, and hats over them."""
    whole = np.concatenate([a.signal(signal) for a in paths.values()])
    at = np.linspace(float(whole.min()), float(whole.max()), knots)
    return at, [_hat(at, k, lambda _, a: a.signal(signal)) for k in range(knots)]


def _hat(at: Array, k: int, of: Callable[[str, Path], Array]) -> Callable[[str, Path], Array]:
    unit = np.eye(at.size)[k]
    return lambda name, path: np.asarray(np.interp(of(name, path), at, unit))
