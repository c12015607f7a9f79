"""Answers of a model to small pushes at its slots, along the run of an experiment: simulated, and counted per unit of the push.

What any effect could add at a place is a push there. All places are had from one compilation: every slot reads its signal and
the push by the weight of its place. Hats over time at a place show what any effect there could explain, as far as the records
ask for them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import sympy as sp
from numpy.typing import NDArray
from scipy.linalg import block_diag, solve_triangular

from hvdc_ident.data import Array, Experiment, InputSignal
from hvdc_ident.discrepancy.hypothesis import Refit
from hvdc_ident.discrepancy.nominal import F, Nominal
from hvdc_ident.errors import SimulationError
from hvdc_ident.expression import symbol
from hvdc_ident.fit.residual import ResidualBlock, Treatment, whitened_together
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, fresh, is_white_box, rewritten
from hvdc_ident.parameters import Input, Parameter
from hvdc_ident.simulate import simulate

PUSH_SHARE = 1e-3
"""Of a signal's range, or a thousandth of its peak: how large a push is. Runs are exact to 1e-8 of a signal: the answer to 1e-4."""
MAX_CORNERS = 16
"""Corners of a push that an integrator stops at, at most; one with more moves with the model, whose steps follow it."""


@dataclass(frozen=True, eq=False)
class Pushed:
    """A model's run of an experiment, and its answers to pushes at the slots.

    time: (n,) the experiment's rows, s. values: by slot its signal, (n,). outputs: names of the answers. base: (o, n) them
    without a push. weights: by slot the parameter that puts the push there; push: the input that it follows.
    """

    model: Model
    experiment: Experiment
    parameters: FrozenMap[float]
    values: Mapping[str, Array]
    outputs: tuple[str, ...]
    base: Array
    weights: FrozenMap[str]
    push: str

    @property
    def time(self) -> Array:
        """(n,) s."""
        return self.experiment.time

    def answer(self, place: str, pushes: Array) -> Array:
        """Return (o, n, nc), what the outputs do in answer to pushes (n, nc) at a slot, to first order; nan where a run fails."""
        found = np.full((len(self.outputs), self.time.size, pushes.shape[1]), np.nan)
        u = self.values[place]
        most = PUSH_SHARE * max(float(np.ptp(u)), PUSH_SHARE * float(np.abs(u).max(initial=0.0)), PUSH_SHARE**2)
        for c in range(pushes.shape[1]):
            size = float(np.abs(pushes[:, c]).max(initial=0.0))
            if size == 0.0:
                found[:, :, c] = 0.0
                continue
            scale = most / size
            signal = InputSignal(self.time, scale * pushes[:, c], _corners(self.time, pushes[:, c]))
            asked = self.experiment.with_(inputs=self.experiment.inputs | {self.push: signal})
            try:
                run = simulate(
                    self.model,
                    asked,
                    self.parameters | {self.weights[place]: 1.0},
                    outputs=self.outputs,
                )
            except SimulationError:
                continue
            found[:, :, c] = (np.array([run[o] for o in self.outputs]) - self.base) / scale
        return found


def pushed(before: Refit, signals: Mapping[str, Sequence[Array]]) -> dict[str, Pushed]:
    """Return the runs of the fitted experiments, by name, of a model with equations. signals: as `slot_signals` has them.

    Raises SimulationError where the model cannot be run.
    """
    assert is_white_box(before.model)
    model, weights, push = _with_push(before.model, tuple(signals))
    found = {}
    for k, e in enumerate(before.problem.fitted_experiments):
        plain = e.with_(measured=None)
        base = simulate(model, plain, before.values, outputs=e.outputs)
        rows = {p: u[k] for p, u in signals.items()}
        found[e.name] = Pushed(
            model, plain, FrozenMap(before.values), rows, e.outputs, np.array([base[o] for o in e.outputs]), weights, push
        )  # fmt: skip
    return found


@lru_cache(maxsize=16)
def _with_push(model: Model, slots: tuple[str, ...]) -> tuple[Model, FrozenMap[str], str]:
    push = fresh(model, "push")
    weights = {p: f"{push}_at_{k}" for k, p in enumerate(slots)}
    made = replace(
        model,
        inputs=model.inputs | {push: Input(0.0)},
        parameters=model.parameters | {w: Parameter(0.0, min=0.0, max=1.0) for w in weights.values()},
    )
    for place, weight in weights.items():

        def read(m: Model, u: sp.Expr, weight: str = weight) -> tuple[Model, sp.Expr]:
            return m, u + symbol(weight) * symbol(push)

        made = rewritten(made, place, push, read)
    return replace(made, origin=None), FrozenMap(weights), push


def _corners(time: Array, values: Array) -> Array:
    """The instants where a push bends, where these are few."""
    bends = np.abs(np.diff(values, 2, prepend=values[0], append=values[-1])) > 1e-9 * np.abs(values).max()
    return time[bends] if np.count_nonzero(bends) <= MAX_CORNERS else np.empty(0)


@dataclass(frozen=True, eq=False)
class Whitening:
    """Map from an experiment's answers to whitened rows, block by block."""

    name: str
    treatment: Treatment
    parts: tuple[tuple[ResidualBlock, int, Array], ...]

    @classmethod
    def of(cls, blocks: Sequence[ResidualBlock], experiment: Experiment, nominal: Nominal) -> Whitening:
        slim = [replace(b, jacobian=b.jacobian[:0]) for b in blocks]  # a job is sent to where it is done
        parts = [(b, experiment.outputs.index(b.output), experiment.time[b.rows]) for b in slim]
        return cls(experiment.name, nominal.problem.treatment, tuple(parts))

    def __call__(self, y: Array) -> Array:
        """(rows, nc) of y (o, R, nc)."""
        rows = np.concatenate([self._rows(b, y[k, b.rows], time) for b, k, time in self.parts])
        blocks, _, times = zip(*self.parts, strict=True)
        return whitened_together(rows, blocks, times, self.treatment)

    def _rows(self, b: ResidualBlock, y: Array, time: Array) -> Array:
        if b.slope is not None:
            return np.asarray(y * b.slope[:, None])
        return self.treatment.applied(b.scaled(y), time, b.output, self.name)


def hats(time: Array, knots: Array) -> Array:
    """Return (n, k) hats: 1 at their knot (k,), straight to 0 at its neighbours, level beyond the first and the last."""
    return np.column_stack([np.interp(time, knots, unit) for unit in np.eye(knots.size)])


def answered(nominal: Nominal, experiment: Experiment, path: Pushed, place: str, pushes: Array) -> Array:
    """Return (rows, k) whitened answers of a fitted experiment to pushes (n, k) at a place; nan where a run fails."""
    blocks = [b for b in nominal.blocks if b.experiment == experiment.name]
    return Whitening.of(blocks, experiment, nominal)(path.answer(place, pushes))


EVEN_KNOTS, KNOTS_AFTER_BREAK = 16, 8
"""Knots of a push over a record, and over each part of it behind a break of an input, ever nearer to the break."""
MAX_KNOTS = 120
"""Knots of all records together, about: with many breaks the parts behind them have fewer."""
WEAKEST = 1e-4
"""Of the strongest direction: weaker ones leave no trace."""
INPUT_SIZES = np.geomspace(1e-4, 1e4, 60)
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
            over = _hats(e, MAX_KNOTS // len(experiments))
            shown.append(np.nan_to_num(answered(nominal, e, paths[e.name], place, over)))
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
        weak = 2.0 * WEAKEST**2 * strength
        lower = np.linalg.cholesky(self.square + weak * np.eye(self.asked.size))
        half = solve_triangular(lower, np.column_stack([self.asked, np.eye(self.asked.size)]), lower=True)
        return float(half[:, 0] @ half[:, 0]), round(self.asked.size - weak * np.sum(half[:, 1:] ** 2))

    @cached_property
    def _spectrum(self) -> tuple[Array, Array]:
        square, directions = np.linalg.eigh(self.square)
        strength = np.sqrt(np.maximum(square[::-1], 0.0))
        kept = strength > WEAKEST * strength[0]
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
        for size in INPUT_SIZES / self.strength[0]:
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
        even = EVEN_KNOTS
    quick = min(KNOTS_AFTER_BREAK, max((most - even) // breaks.size, 1))
    behind = [
        b + (np.append(breaks[breaks > b], end)[0] - b) * np.geomspace(2.0**-KNOTS_AFTER_BREAK, 1.0, quick)
        for b in breaks
    ]
    knots = np.unique(np.concatenate([np.linspace(begin, end, even), breaks, *behind]))
    knots = t[np.unique(np.searchsorted(t, knots).clip(max=t.size - 1))]
    knots = np.unique(knots)
    return hats(t, knots)
