"""What any effect at a place could explain: pushes there, hats over time, as far as the records ask for them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, solve_triangular

from hvdc_ident.data import Array, Experiment
from hvdc_ident.discrepancy.nominal import F, Nominal
from hvdc_ident.discrepancy.pushes import Pushed, Whitening

EVEN, QUICK = 16, 8
"""Knots of a push over a record, and over each part of it behind a break of an input, ever nearer to the break."""
MOST = 120
"""Knots of all records together, about: with many breaks the parts behind them have fewer."""
WEAK = 1e-4
"""Of the strongest direction: weaker ones leave no trace."""
TRIED = np.geomspace(1e-4, 1e4, 60)
"""Sizes of what is added, in units of what the strongest direction shows, of which the likeliest is taken."""


@dataclass(frozen=True, eq=False)
class Inversion:
    """A slot, and what of pushes there shows.

    shown: (rows, k) hats in whitened rows, by experiment. Of all experiments' hats, without what parameters can make good:
    square, products with each other, and asked, with the residual.
    """

    shown: tuple[Array, ...]
    square: Array
    asked: Array

    @classmethod
    def of(cls, nominal: Nominal, paths: Mapping[str, Pushed], place: str) -> Inversion:
        """Return the inversion of one slot on the fitted experiments."""
        experiments, shown = nominal.problem.fitted_experiments, []
        for e in experiments:
            whitening = Whitening.of([b for b in nominal.blocks if b.experiment == e.name], e, nominal)
            hats = _hats(e, MOST // len(experiments))
            shown.append(np.nan_to_num(whitening(paths[e.name].answer(place, hats))))
        taken = np.hstack([q.T @ s for q, s in zip(_split(nominal.basis, shown), shown, strict=True)])
        square = block_diag(*(s.T @ s for s in shown)) - taken.T @ taken
        free = nominal.projected(nominal.residual[:, None])
        return cls(tuple(shown), square, _with_hats(shown, free)[:, 0])

    @property
    def reach(self) -> tuple[float, int]:
        """By how much chi2 falls with the best of everything that may be added at the slot, and with how many values: on
        average noise falls by their number."""
        strength = np.abs(self.square).sum(axis=0).max(initial=0.0)
        if not 0.0 < strength < np.inf:  # nothing shows, or the answer runs away
            return 0.0, 0
        weak = 2.0 * WEAK**2 * strength
        lower = np.linalg.cholesky(self.square + weak * np.eye(self.asked.size))
        half = solve_triangular(lower, np.column_stack([self.asked, np.eye(self.asked.size)]), lower=True)
        return float(half[:, 0] @ half[:, 0]), round(self.asked.size - weak * np.sum(half[:, 1:] ** 2))

    @cached_property
    def _spectrum(self) -> tuple[Array, Array]:
        square, directions = np.linalg.eigh(self.square)
        strength = np.sqrt(np.maximum(square[::-1], 0.0))
        kept = strength > WEAK * strength[0]
        return strength[kept], directions[:, ::-1][:, kept]

    @property
    def strength(self) -> Array:
        """(m,) how strongly each direction of what may be added shows, the strongest first."""
        return self._spectrum[0]

    @property
    def directions(self) -> Array:
        """(k n, m) what is added at the knots in each, orthonormal."""
        return self._spectrum[1]

    @cached_property
    def wanted(self) -> Array:
        """(m,) what the residual has of each."""
        return np.asarray(self.directions.T @ self.asked / self.strength)

    def log_evidence(self, wanted: Array) -> Array:
        """(B,) log marginal likelihood in nats of what is added, at its likeliest size, over nothing added; 0 where that is likeliest.

        wanted: (m, B) what each residual has of the directions. Each direction is added with a Gaussian prior of one size.
        """
        squares = wanted**2
        best = np.zeros(wanted.shape[1])
        for size in TRIED / self.strength[0]:
            spread = 1.0 + (size * self.strength) ** 2
            best = np.maximum(best, 0.5 * ((1.0 - 1.0 / spread) @ squares - np.sum(np.log(spread))))
        return best

    def against(self, rows: NDArray[np.floating]) -> Array:
        """(m, B) what whitened rows (N, B), without what parameters can make good, have of each direction."""
        return np.asarray(self.directions.T @ _with_hats(self.shown, rows) / self.strength[:, None])


def _split(rows: NDArray[F], like: Sequence[Array]) -> list[NDArray[F]]:
    """The rows of each experiment: as many as its own matrix has."""
    return np.split(rows, np.cumsum([m.shape[0] for m in like])[:-1])


def _with_hats(shown: Sequence[Array], rows: NDArray[np.floating]) -> Array:
    """(k n, B) products of whitened rows (N, B) with what each hat shows."""
    return np.vstack([s.T @ r for s, r in zip(shown, _split(rows, shown), strict=True)])


def _hats(experiment: Experiment, most: int) -> Array:
    """(n, k) hats at an experiment's rows: evenly over the record, and closer behind each break of an input."""
    t = experiment.time
    begin, end = float(t[0]), float(t[-1])
    breaks = np.unique(np.concatenate([[begin], *(s.breaks for s in experiment.inputs.values())]))
    breaks = breaks[(breaks >= begin) & (breaks < end)]
    if breaks.size > most // 2:  # an input that never rests: no part of the record is behind a break
        breaks, even = breaks[:1], most
    else:
        even = EVEN
    quick = min(QUICK, max((most - even) // breaks.size, 1))
    behind = [b + (np.append(breaks[breaks > b], end)[0] - b) * np.geomspace(2.0**-QUICK, 1.0, quick) for b in breaks]
    knots = np.unique(np.concatenate([np.linspace(begin, end, even), breaks, *behind]))
    knots = t[np.unique(np.searchsorted(t, knots).clip(max=t.size - 1))]
    knots = np.unique(knots)
    return np.column_stack([np.interp(t, knots, unit) for unit in np.eye(knots.size)])
