"""Records that do not begin at rest: what the states' unknown starts can make of the residuals is taken out of them.

What moves a system by itself, a periodic disturbance say, has moved it before the record's first row too; the steady
start of a run is then one of many, and the difference dies out like any other answer to the states' start. Those answers
are known (sensitivities by start). The best start for given parameters is found by a step from the steady one; about it
the starts are eliminated: variable projection (Golub and Pereyra 1973) with the jacobian of Kaufman (1975), whose
gradient is exact because it is taken at the best start.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hvdc_ident.data import Array, Experiment, Trajectory
from hvdc_ident.fit.nuisance import TIME_SHIFT, observe
from hvdc_ident.fit.simulator import Simulator, WithStates
from hvdc_ident.immutable import FrozenMap

if TYPE_CHECKING:
    from hvdc_ident.fit.residual import ResidualBlock

TELLS = 1e-7
"""Singular value, relative to the largest of columns of length 1, from which a direction counts."""


def unknown_initial_states(simulator: Simulator, experiment: Experiment) -> tuple[str, ...]:
    """The states whose start is neither given nor estimated; none of a simulator that does not show its states."""
    known = {*experiment.starts, *experiment.nuisance}
    return tuple(n for n in simulator.states if n not in known) if isinstance(simulator, WithStates) else ()


def centred(
    simulator: Simulator,
    experiment: Experiment,
    values: Mapping[str, float],
    states: Sequence[str],
    nuisance: Mapping[str, float],
) -> Experiment:
    """The experiment with the steady start of these states given as numbers. Raises SimulationError where there is none."""
    first = experiment.time[:1]
    blank = Trajectory(first, np.zeros((1, len(states))), tuple(states), tuple("" for _ in states))
    asked = experiment.with_(time=first, measured=blank, window=None, instrument=FrozenMap())
    own = {n: v for n, v in nuisance.items() if n != TIME_SHIFT}
    at = observe(simulator, asked, values, (), own, derivatives=False).values
    return experiment.with_(starts=experiment.starts | {n: float(at[n][0]) for n in states})


def recentred(experiment: Experiment, blocks: Sequence[ResidualBlock], states: Sequence[str]) -> Experiment:
    """The experiment with these states' starts moved to where its residuals are least, to first order.

    blocks: at the starts as they are; their first columns are by the starts. A start that the records hardly show is kept
    by a weak prior, as wide as its own value (or 1): it would otherwise be moved by noise, and far.
    """
    at = np.array([experiment.starts[n] for n in states])
    size = np.where(at != 0.0, np.abs(at), 1.0)
    columns = np.vstack([b.jacobian[:, : len(states)] for b in blocks]) * size
    residual = np.concatenate([b.residual for b in blocks])
    # Stacked, not squared: of columns that are alike and large, the prior would be lost in rounding.
    whole, wanted = np.vstack([columns, np.eye(len(states))]), np.append(-residual, np.zeros(len(states)))
    step = np.linalg.lstsq(whole, wanted)[0]
    moved = {n: float(v) for n, v in zip(states, at + size * step, strict=True)}
    return experiment.with_(starts=experiment.starts | moved)


def freed(blocks: Sequence[ResidualBlock], raw: Sequence[Array], columns: slice) -> tuple[ResidualBlock, ...]:
    """The blocks of one experiment without what the starts can make good.

    columns: the jacobians' columns by the starts, which are gone from the result. raw: by block, (m, starts) the derivative
    of its misfit by them, neither weighted nor whitened.
    """
    slopes = np.vstack([b.jacobian[:, columns] for b in blocks])
    norms = np.linalg.norm(slopes, axis=0)
    norms = np.where(norms > 0, norms, np.inf)
    u, s, vt = np.linalg.svd(slopes / norms, full_matrices=False)
    kept = s > TELLS * s.max(initial=0.0)
    u = u[:, kept]
    residual = np.concatenate([b.residual for b in blocks])
    rest = np.vstack([np.delete(b.jacobian, columns, axis=1) for b in blocks])
    start = -(vt[kept].T @ ((u.T @ residual) / s[kept])) / norms
    residual, rest = residual - u @ (u.T @ residual), rest - u @ (u.T @ rest)
    found, at = [], 0
    for k, (b, d) in enumerate(zip(blocks, raw, strict=True)):
        own = slice(at, at + b.residual.size)
        taken = int(np.count_nonzero(kept)) if k == 0 else 0
        found.append(
            replace(b, misfit=b.misfit + d @ start, residual=residual[own], jacobian=rest[own], taken=taken)
        )  # fmt: skip
        at = own.stop
    return tuple(found)
