"""Parameters as hypotheses: those that were held are set free where the records, under a hypothesis, speak against their values.

The report of a model that lacks something holds parameters for the misfit that is being diagnosed. What such a parameter is
off would be told as an effect, so "this parameter is off its value" is compared with the effects, and asked again beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.context import SearchContext
from hvdc_ident.discrepancy.evidence import Ruler, evidence_between
from hvdc_ident.discrepancy.refit import Refit, run
from hvdc_ident.discrepancy.refit_jobs import job_of
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import FitParameter

SEEN = 1e-6
"""Share of its squared derivative that the free parameters must not make good, for a parameter to be told at all."""


def released(search: SearchContext, base: Refit, here: Refit) -> tuple[Refit, Refit]:
    """Return the nominal model and the hypothesis `here`, with those held parameters free that bring more evidence than they cost.

    base: the nominal model that `here` adds effects to, at its values. One parameter is set free at a time, the one whose
    score is largest, until the next gains no more in BIC than an effect needs to be named.
    """
    while held := [f for f in search.held if f.name not in here.problem.names]:
        try:
            best = _most_wanted(here, held)
            if best is None:
                break
            search.tell(0, 1, f"with {best.name} free")
            wider = _with_free(base, best)
            freed = run(job_of(wider, here, here.placed, {}))
        except SimulationError:  # with this parameter moved the model does not run: its value stays what it is
            break
        if freed.failure or not evidence_between(here, freed, Ruler.of(freed), 1) > search.options.named_bic:
            break
        base, here = wider, freed
    return base, here


def _with_free(refit: Refit, parameter: FitParameter) -> Refit:
    """Return the nominal model with one parameter more among the free ones, at the value that it was held at."""
    count, value = len(refit.problem.free), refit.problem.held.get(parameter.name, parameter.given)
    held = {n: v for n, v in refit.problem.held.items() if n != parameter.name}
    free = replace(parameter, start=float(np.clip(value, parameter.min, parameter.max)))
    problem = replace(refit.problem, free=(*refit.problem.free, free), held=type(refit.problem.held)(held))
    return replace(refit, problem=problem, theta=np.insert(refit.theta, count, free.start))


def _most_wanted(here: Refit, held: Sequence[FitParameter]) -> FitParameter | None:
    """Return the held parameter whose derivative explains most of what is left; None where they explain nothing of it."""
    residual, columns = _derivatives(here, held)
    scores = []
    basis = here.nominal().basis
    for column in columns.T:
        rest = column - basis @ (basis.T @ column)
        power = float(rest @ rest)
        told = power > SEEN * float(column @ column)
        scores.append(float(residual @ rest) ** 2 / power if told else 0.0)
    k = int(np.argmax(scores))
    return held[k] if scores[k] > 0.0 else None


def _derivatives(here: Refit, held: Sequence[FitParameter]) -> tuple[Array, Array]:
    """Return (N,) the whitened residual and (N, k) its derivative by each held parameter."""
    wide, count = here, len(here.problem.free)
    for f in held:
        wide = _with_free(wide, f)
    blocks = wide.problem.blocks(wide.theta)
    jacobian = np.vstack([b.jacobian for b in blocks])
    return np.concatenate([b.residual for b in blocks]), jacobian[:, count : count + len(held)]
