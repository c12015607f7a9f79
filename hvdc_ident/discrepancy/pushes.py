"""Answers of a model to small pushes at its slots, along the run of an experiment: simulated, and counted per unit of the push.

What any effect could add at a place is a push there. All places are had from one compilation: every slot reads its signal and
the push by the weight of its place.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import sympy as sp

from hvdc_ident.data import Array, Experiment, InputSignal
from hvdc_ident.discrepancy.nominal import Nominal
from hvdc_ident.discrepancy.refit import Refit
from hvdc_ident.errors import SimulationError
from hvdc_ident.expression import symbol
from hvdc_ident.fit.residual import ResidualBlock, Treatment
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, fresh, rewritten
from hvdc_ident.parameters import Input, Parameter
from hvdc_ident.simulate import simulate

SMALL = 1e-3
"""Of a signal's range, or a thousandth of its peak: how large a push is. Runs are exact to 1e-8 of a signal: the answer to 1e-4."""
CORNERS = 16
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

    def signal(self, place: str) -> Array:
        """(n,): the slot's own signal on the run."""
        return self.values[place]

    def answer(self, place: str, pushes: Array) -> Array:
        """Return (o, n, nc), what the outputs do in answer to pushes (n, nc) at a slot, to first order; nan where a run fails."""
        found = np.full((len(self.outputs), self.time.size, pushes.shape[1]), np.nan)
        u = self.values[place]
        most = SMALL * max(float(np.ptp(u)), SMALL * float(np.abs(u).max(initial=0.0)), SMALL**2)
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
    assert isinstance(before.model, Model)
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
    return time[bends] if np.count_nonzero(bends) <= CORNERS else np.empty(0)


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
        return np.concatenate([self._rows(b, y[k, b.rows], time) for b, k, time in self.parts])

    def _rows(self, b: ResidualBlock, y: Array, time: Array) -> Array:
        if b.slope is not None:
            return np.asarray(y * b.slope[:, None])
        return self.treatment.applied(b.scaled(y), time, b.output, self.name)
