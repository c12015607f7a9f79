"""Profiles of two gains, against pyPESTO."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from typing import Any

import engine as link_bench  # of the folder above
import numpy as np

from hvdc_ident.fit import fit
from hvdc_ident.fit.profile import profiles
from hvdc_ident.fit.uncertainty import TWO_SIDED

from .integrators import installed
from .plant import FREE, Line, Plant, recorded


def profiling() -> Iterator[Line]:
    """Both gains' profiles from the optimum; pyPESTO is given our cost with its exact gradient."""
    if not installed("pypesto"):
        return
    import pypesto
    import pypesto.optimize
    import pypesto.profile

    logging.disable(logging.WARNING)
    problem, _ = recorded(Plant())
    count = [0]
    best = np.array([fit(problem, starts=1).values[f.name] for f in FREE])
    mine = link_bench.best(lambda: profiles(problem, best), 5, 1)
    own = profiles(problem, best)

    def cost(theta: np.ndarray) -> float:
        count[0] += 1
        return problem.cost(theta)

    def gradient(theta: np.ndarray) -> np.ndarray:
        r, jacobian = problem.residual(theta)
        return np.asarray(jacobian.T @ r)

    low, high = [f.min for f in FREE], [f.max for f in FREE]
    theirs = pypesto.Problem(
        pypesto.Objective(fun=cost, grad=gradient), low, high,
        x_names=[f.name for f in FREE],
    )  # fmt: skip
    optimizer = pypesto.optimize.ScipyOptimizer(method="L-BFGS-B")
    begun = _begun(pypesto, theirs, optimizer, best)
    options = pypesto.profile.ProfileOptions(ratio_min=float(np.exp(-1.1 * TWO_SIDED)))

    def work() -> Any:
        count[0] = 0
        return pypesto.profile.parameter_profile(
            theirs, begun(), optimizer, profile_options=options, progress_bar=False
        )

    result = work()
    seconds = link_bench.best(work, 1, 0)
    apart = []
    for k, f in enumerate(FREE):
        found = result.profile_result.list[0][k]
        x, rise = found["x_path"][k], found["fval_path"] - found["fval_path"].min()
        middle = int(np.argmin(rise))
        for side, limit in (
            (slice(None, middle + 1), own.by_name[f.name].lower),
            (slice(middle, None), own.by_name[f.name].upper),
        ):
            order = np.argsort(rise[side])
            end = np.interp(np.sqrt(TWO_SIDED), np.sqrt(rise[side][order]), x[side][order])
            apart.append(abs(end - limit.limit) / abs(best[k] - limit.limit))
    assert max(apart) < 0.1, f"pyPESTO's intervals are others: {apart}"
    evaluations = sum(p.evaluations for p in own.by_name.values())
    yield Line(
        "2 profiles", "pyPESTO", mine, seconds,
        f"{evaluations} evaluations here, {count[0]} there; ends within {max(apart):.1%} of half an interval",
    )  # fmt: skip


def _begun(pypesto: Any, problem: Any, optimizer: Any, best: np.ndarray) -> Callable[[], Any]:
    """A new result that holds the optimum and no profile yet."""

    def make() -> Any:
        given = pypesto.Problem(problem.objective, problem.lb, problem.ub, x_names=problem.x_names, x_guesses=[best])
        return pypesto.optimize.minimize(given, optimizer, n_starts=1, progress_bar=False)

    return make
