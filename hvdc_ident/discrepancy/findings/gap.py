"""The gap between model and data, before and after."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.findings.conclusion import Gap, Table
from hvdc_ident.discrepancy.refits.refit import Refit, held_out, unseen
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import Problem
from hvdc_ident.immutable import FrozenMap


def gap(given: Refit, refitted: Refit, augmented: Refit) -> Gap:
    """RMSE by output and experiment of the model with the given gains, refitted, and with the effects."""
    tables = [_tables(r.problem, r.theta) for r in (given, refitted, augmented)]
    pooled: dict[str, Mapping[str, float | None]] = {
        name: {"fit": _pooled(r.problem, r.theta), "holdout": unseen(r) if name != "nominal" else _held(r)}
        for name, r in (("nominal", given), ("refitted", refitted), ("augmented", augmented))
    }
    was, now = unseen(refitted), unseen(augmented)
    shrink = None if was is None or now is None or not was > 0 or not np.isfinite(was) else 1.0 - now / was
    floor = {o: n.std for o, n in refitted.noise.items() if n.std is not None}
    held = "experiments" if refitted.holdout is not None else "parts of the fitted experiments, predicted from the rest"
    return Gap(tables[0], tables[1], tables[2], FrozenMap(floor), pooled, shrink, held)


def _tables(problem: Problem, theta: Array) -> dict[str, Table]:
    roles = {e.name: e.role for e in problem.experiments}
    found: dict[str, dict[str, dict[str, float | None]]] = {"fit": {}, "holdout": {}}
    for output, row in problem.rmse(theta).items():
        for name, value in row.items():
            found[roles[name]].setdefault(output, {})[name] = value
    return dict(found)


def _pooled(problem: Problem, theta: Array) -> float | None:
    try:
        blocks = problem.blocks(theta, derivatives=False)
    except SimulationError:
        return None
    return float(np.sqrt(np.mean(np.concatenate([b.squares for b in blocks]))))


def _held(refit: Refit) -> float | None:
    """The held-out residual of the given gains; None without held-out experiments, or where a run fails."""
    blocks = held_out(refit.problem, refit.theta)
    return float(np.sqrt(np.mean(np.concatenate([b.squares for b in blocks])))) if blocks else None


def at_given(refitted: Refit, given: Mapping[str, float]) -> Refit:
    """The nominal model at the given values, nuisances as they were found. given: of all candidates, held ones too."""
    held = refitted.problem.held | {n: v for n, v in given.items() if n in refitted.problem.held}
    return replace(refitted, problem=replace(refitted.problem, held=held), theta=refitted.theta_at_given)
