"""The hidden input of an equation: what would have to be added to a slot's signal, as terms, over time, or over a signal.

Weak form: nothing is differentiated. Each term is put on the slot as the model runs, and its answer at the outputs,
whitened and freed of what the parameters can make good, is a column of a regression of the residual.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hvdc_ident.discrepancy.nominal import Nominal
from hvdc_ident.discrepancy.scores import Path, Whitening
from hvdc_ident.trajectory import Array

KNOTS = 24


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

    def selected(self, most: int, price: float) -> list[int]:
        """Columns chosen one after the other, each the one that lowers chi2 most, while that is worth its price."""
        chosen: list[int] = []
        for _ in range(most):
            falls = self._falls(chosen)
            k = int(np.argmax(falls))
            if falls[k] <= price:
                break
            chosen.append(k)
        return chosen

    def _falls(self, chosen: list[int]) -> Array:
        """(k,) by how much chi2 falls with each column beside those chosen; 0 for one that is made of them."""
        left, columns = self.residual, self.columns
        if chosen:
            q = np.linalg.qr(self.columns[:, chosen])[0]
            left, columns = left - q @ (q.T @ left), columns - q @ (q.T @ columns)
        norms = np.linalg.norm(columns, axis=0)
        sound = norms > 1e-4 * np.maximum(np.linalg.norm(self.columns, axis=0), 1e-300)
        return np.where(sound, (columns.T @ left) ** 2 / np.where(sound, norms**2, 1.0), 0.0)


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
