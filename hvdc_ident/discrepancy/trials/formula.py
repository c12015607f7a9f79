"""A formula of the model's own signals, put on a slot as a further term and ready to be refitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.refits.begin import Placed
from hvdc_ident.discrepancy.refits.refit import Refit, RefitJob
from hvdc_ident.discrepancy.scores.scored import Path
from hvdc_ident.discrepancy.signatures.candidates import CandidateEffect
from hvdc_ident.discrepancy.trials.library import Term, along
from hvdc_ident.effects import EffectUse, apply_effects
from hvdc_ident.fit import FitParameter
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.simulate import ModelSimulator

WIDE = 20.0
"""Times its start value: how large a coefficient may become."""
LESS = (0.3, 0.1)
"""Shares of its start value to begin from where the model does not run with it: a power that is too large runs away."""


@dataclass(frozen=True, eq=False)
class Law:
    """A formula in the model, refitted, or a curve.

    gain: delta BIC over the model without it. stability: share of noise records that choose the same terms. near: whether it
    comes near the noise, and nothing of the catalogue does. terms: those of it; of a curve hats over one signal. others:
    refits of other formulas, or of the same at other places, that explain as much.
    """

    refit: Refit
    gain: float
    stability: float | None = None
    near: bool = False
    terms: tuple[Term, ...] = ()
    others: tuple[Refit, ...] = ()


def formula_job(before: Refit, place: str, chosen: Sequence[Term], coefficients: Array) -> RefitJob:
    """The refit of a model with the sum of k1, k2, … times the terms added at a slot, begun at those coefficients.

    Raises ModelError where the term cannot be put there.
    """
    names = [f"k{i + 1}" for i in range(len(chosen))]
    expression = " + ".join(f"{n}*{t.text}" for n, t in zip(names, chosen, strict=True))
    values = {n: float(c) for n, c in zip(names, coefficients, strict=True)}
    use = EffectUse("term", (place,), FrozenMap(values), expression=expression)
    had = set(before.model.parameters)
    model = apply_effects(before.model, [use])
    new = [n for n in model.parameters if n not in had]
    # Of a curve the largest value tells how large the others may become: one may begin at 0.
    most = max(map(abs, values.values())) if all(t.form == "hat" for t in chosen) else 0.0
    bounds = {n: (-WIDE * max(abs(v), most), WIDE * max(abs(v), most)) for n, v in values.items()}
    free = tuple(FitParameter(m, values[n], *bounds[n]) for n, m in zip(names, new, strict=True))
    problem = replace(before.problem, simulator=ModelSimulator(model), free=(*before.problem.free, *free))
    placed = Placed(
        CandidateEffect("term", (place,), ()),
        use,
        FrozenMap(dict(zip(names, new, strict=True))),
        FrozenMap(bounds),
        FrozenMap(values),
    )
    k = len(before.problem.free)
    begin, *spare = (
        np.concatenate([before.theta[:k], [share * v for v in values.values()], before.theta[k:]])
        for share in (1.0, *LESS)
    )
    return RefitJob(model, (*before.placed, placed), problem, (begin,), before.noise, spare=tuple(spare))


def labelled(refit: Refit) -> str:
    """The formula that a refit ends with, and where."""
    return f"{filled(refit.placed[-1], refit)} at {refit.placed[-1].candidate.at[0]}"


def filled(placed: Placed, refit: Refit) -> str:
    """The formula with its coefficients as they came out."""
    text = placed.use.expression
    for n, value in refit.sizes(placed).items():
        text = text.replace(f"{n}*", f"{value:.4g}*")
    return text.replace("+ -", "- ")


def at_run(term: Term) -> Callable[[str, Path], Array]:
    """The term along an experiment's run, as a regression takes it."""
    return lambda _, path: along(term, path.time, path.values)
