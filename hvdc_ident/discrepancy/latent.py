"""Estimate of a slot's signal from the records, and the fit of an effect that acts on that signal.

Gains that are biased by what is missing give the slot another signal than it had: an effect that hangs on its levels or
instants leaves traces with little in common with the true ones. The records know better. What would have to be added at
the slot, smooth only as far as they ask for it, makes good what the bias spoiled; with it the slot's signal is near to
the true one, and an effect of the right size, put on that signal, explains the residual as it stands.

All of this is linear in what is added at the slot: hats over time, a knot for every row or so, are put on it once, and
thousands of sizes are then had by their values at the knots.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.linalg import block_diag, solve_triangular

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.nominal import F, Nominal
from hvdc_ident.discrepancy.options import SURE
from hvdc_ident.discrepancy.scores import SEEN, Path, Whitening
from hvdc_ident.discrepancy.signatures.response import Along, alone
from hvdc_ident.executor import Executor, Made, mapped
from hvdc_ident.immutable import FrozenMap

KNOTS = 600
"""Of all records together, at most: where there are more rows, several are taken together."""
WEAK = 1e-4
"""Of the strongest direction: weaker ones leave no trace."""
TRIED = np.geomspace(1e-4, 1e4, 60)
"""Sizes of what is added, in units of what the strongest direction shows, of which the likeliest is taken."""


@dataclass(frozen=True, eq=False)
class Inversion:
    """A slot, what is added to it, and what of it shows.

    time: (K,) instants of each experiment, s. own: the model's signal there, one array an experiment. seen: (K, k) what
    the slot's signal makes of hats put on it. means: (k, K) values at the knots of what is given at the instants. shown:
    (rows, k) hats in whitened rows. Of all n experiments' hats, without what parameters can make good: square (k n, k n)
    products with each other, and asked (k n,) with the residual.
    """

    time: tuple[Array, ...]
    own: tuple[Array, ...]
    seen: tuple[Array, ...]
    means: tuple[scipy.sparse.csr_array, ...]
    shown: tuple[Array, ...]
    square: Array
    asked: Array

    @classmethod
    def of(cls, nominal: Nominal, paths: Mapping[str, Along], place: str) -> Inversion:
        """The inversion of one slot on the fitted experiments."""
        experiments = nominal.problem.fitted_experiments
        time, own, seen, means, shown = [], [], [], [], []
        for e in experiments:
            path = paths[e.name]
            hats, mean = _hats(path.time, min(KNOTS // len(experiments), path.count))
            u, y = path.answer([place], hats[None])
            whitening = Whitening.of([b for b in nominal.blocks if b.experiment == e.name], e, nominal)
            shown.append(np.nan_to_num(whitening(y)))
            time.append(path.time)
            own.append(path.signal(place))
            seen.append(u[0])
            means.append(mean)
        taken = np.hstack([q.T @ s for q, s in zip(_split(nominal.basis, shown), shown, strict=True)])
        square = block_diag(*(s.T @ s for s in shown)) - taken.T @ taken
        free = nominal.projected(nominal.residual[:, None])
        asked = _with_hats(shown, free)[:, 0]
        return cls(tuple(time), tuple(own), tuple(seen), tuple(means), tuple(shown), square, asked)

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

    @cached_property
    def added(self) -> Array:
        """(k n,) what was added at the slot, at the knots, as far as the records ask for anything; 0 where nothing shows."""
        if not self.strength.size:
            return np.zeros(self.directions.shape[0])
        likely = []
        for size in TRIED / self.strength[0]:
            spread = 1.0 + (size * self.strength) ** 2
            likely.append(float(np.sum(self.wanted**2 / spread + np.log(spread))))
        size = TRIED[int(np.argmin(likely))] / self.strength[0]
        weights = size**2 * self.strength / (1.0 + (size * self.strength) ** 2)
        return np.asarray(self.directions @ (weights * self.wanted))

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

    @cached_property
    def told(self) -> tuple[Array, ...]:
        """The slot's signal as the records tell it, one array (K,) an experiment."""
        parts = zip(self.own, self.seen, _split(self.added, self.means), strict=True)
        return tuple(u + w @ c for u, w, c in parts)

    def knots(self, changes: Sequence[NDArray[np.floating]]) -> Array:
        """(k n, C) at the knots of what is added at the instants, (K, C) in each experiment."""
        return np.vstack([m @ d for m, d in zip(self.means, changes, strict=True)])

    def against(self, rows: NDArray[np.floating]) -> Array:
        """(m, B) what whitened rows (N, B), without what parameters can make good, have of each direction."""
        return np.asarray(self.directions.T @ _with_hats(self.shown, rows) / self.strength[:, None])

    def falls(self, at_knots: Array, noise: Array) -> tuple[Array, Array, Array]:
        """By how much chi2 falls with each of C additions, the parameters' answer to first order.

        at_knots: (k n, C); noise: (m, B), as `against` gives it. (C,) as it is; (C,) at its best multiple, the score;
        (B,) the largest such score in each record of noise.
        """
        # Thousands are compared, and the best run again: half the digits take half the time.
        shown = self._shown @ at_knots.astype(np.float32, copy=False)
        raw, square = self.wanted @ shown, np.einsum("ij,ij->j", shown, shown, dtype=float)
        share = np.where(square > SEEN, 1.0 / np.maximum(square, SEEN), 0.0)
        chance = (shown * np.sqrt(share).astype(np.float32)).T @ noise.astype(np.float32)
        under = np.max(chance, axis=0, initial=0.0).astype(float) ** 2
        return np.where(share > 0, 2.0 * raw - square, 0.0), np.maximum(raw, 0.0) ** 2 * share, under

    @cached_property
    def _shown(self) -> NDArray[np.float32]:
        """(m, k n) what shows, in each direction, of a unit at each knot."""
        return np.ascontiguousarray((self.strength * self.directions).T, dtype=np.float32)

    def answers(self, nominal: Nominal, at_knots: Array) -> Array:
        """(C, p) the unknowns, to first order, where each of C is added (k n, C), within their bounds."""
        jacobian = np.vstack([b.jacobian for b in nominal.blocks])
        norms = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
        parts = zip(self.shown, _split(at_knots, self.means), strict=True)
        left = nominal.residual[:, None] - np.vstack([s @ c for s, c in parts])
        step = np.linalg.lstsq(jacobian / norms, left, rcond=1e-6)[0].T / norms
        low = np.array([u.min for u in nominal.problem.unknowns])
        high = np.array([u.max for u in nominal.problem.unknowns])
        return np.clip(nominal.theta - step, low, high)


def _split(rows: NDArray[F], like: Sequence[Array | scipy.sparse.csr_array]) -> list[NDArray[F]]:
    """The rows of each experiment: as many as its own matrix has."""
    return np.split(rows, np.cumsum([m.shape[0] for m in like])[:-1])


def _with_hats(shown: Sequence[Array], rows: NDArray[np.floating]) -> Array:
    """(k n, B) products of whitened rows (N, B) with what each hat shows."""
    return np.vstack([s.T @ r for s, r in zip(shown, _split(rows, shown), strict=True)])


def _hats(time: Array, knots: int) -> tuple[Array, scipy.sparse.csr_array]:
    """(K, k) hats over the instants, and (k, K) the weights of the means under them."""
    place = (time - time[0]) / (time[-1] - time[0]) * (knots - 1)
    low = np.minimum(place.astype(np.intp), knots - 2)
    rows = np.arange(time.size)
    entries = (np.concatenate([low + 1 - place, place - low]), (np.tile(rows, 2), np.concatenate([low, low + 1])))
    hats = scipy.sparse.csr_array(entries, shape=(time.size, knots))
    weights = scipy.sparse.csr_array(hats.T * np.gradient(time))
    total = np.maximum(weights.sum(axis=1), 1e-300)
    return hats.toarray(), scipy.sparse.csr_array(weights / total[:, None], dtype=np.float32)


SHARE = 0.7
"""Of what the best slot could make good, up to which another one is too little. Of 222 hidden effects of at least ten times
what can be detected the own slot had less than nine tenths for three, and for none less than eight."""
SHOWN = 3
"""Slots, those where most could be made good, of which the course of what is missing is told."""


@dataclass(frozen=True, eq=False)
class Reach:
    """Upper bound of the misfit that an addition at each slot could explain.

    shares: of the gap beyond noise, by slot, the largest first; above 1 where noise is fitted too. enough: the slots at
    which it is not far less than at the best. curves: of the best slots by experiment what would have to be added there, as far as
    the records ask for it: (2, k), the times in s and the values in the slot's unit.
    """

    shares: FrozenMap[float]
    enough: frozenset[str]
    curves: FrozenMap[FrozenMap[Array]] = field(default_factory=FrozenMap)


@dataclass(frozen=True, eq=False)
class _SlotJob:
    """One slot's share of the work."""

    nominal: Nominal
    paths: Mapping[str, Along]
    place: str


def reach(nominal: Nominal, paths: Mapping[str, Path], slots: Sequence[str], executor: Executor | None) -> Reach | None:
    """Upper bound of the explainable misfit at each of the slots, which all runs have; None where that cannot be told.

    It cannot of a model that is closed inside, nor where the records have more rows than what is added has values: a
    quick one would not be followed then; nor where there is no gap beyond what chance leaves.
    """
    inner = {n: p for n, p in paths.items() if isinstance(p, Along)}
    if len(inner) < len(paths) or max(p.count for p in inner.values()) > KNOTS // len(inner):
        return None
    left, rows = nominal.projected(nominal.residual[:, None]), nominal.residual.size - nominal.basis.shape[1]
    gap = float(np.sum(left**2)) - rows
    if not gap > SURE * np.sqrt(2.0 * rows):
        return None

    def job(place: str) -> _SlotJob:
        return _SlotJob(nominal, alone(inner, place), place)

    found = np.array(list(mapped(executor, _at_slot, Made(job, slots))))
    brings, count = found[:, 0] - found[:, 1], found[:, 1]
    chance = SURE * np.sqrt(2.0 * count + 4.0 * np.maximum(brings, 0.0))
    best = int(np.argmax(brings))
    enough = brings + chance >= SHARE * (brings[best] - chance[best])
    order = np.argsort(-brings, kind="stable")
    shown = [slots[k] for k in order[:SHOWN] if brings[k] > 0]
    curves = mapped(executor, _curve, Made(job, shown))
    return Reach(
        FrozenMap({slots[k]: float(max(brings[k], 0.0) / gap) for k in order}),
        frozenset(s for s, near in zip(slots, enough, strict=True) if near),
        FrozenMap(dict(zip(shown, curves, strict=True))),
    )


def _curve(slot: _SlotJob) -> FrozenMap[Array]:
    """By experiment what would have to be added at the slot, (2, k)."""
    latent = Inversion.of(slot.nominal, slot.paths, slot.place)
    names = [e.name for e in slot.nominal.problem.fitted_experiments]
    courses = _split(latent.added, latent.means)
    return FrozenMap(
        {
            n: np.vstack([np.linspace(t[0], t[-1], c.size), c])
            for n, t, c in zip(names, latent.time, courses, strict=True)
        }
    )


def _at_slot(slot: _SlotJob) -> tuple[float, int]:
    return Inversion.of(slot.nominal, slot.paths, slot.place).reach
