"""The model with the effects of a diagnosis: from its results; and beside the recordings its curves, errors and intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.discrepancy.result import FoundEffect, Rival
from hvdc_ident.effects import EffectUse, apply_effects
from hvdc_ident.errors import ComputationError
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.fit.adequacy import adequacy, residual_tests
from hvdc_ident.fit.noise import MISFIT, source_of, source_text
from hvdc_ident.fit.residual import Curve
from hvdc_ident.fit.result import Estimate
from hvdc_ident.fit.uncertainty import estimates_of, uncertainty
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel, read_card
from hvdc_ident.simulate import ModelSimulator, simulate
from hvdc_ident.study import fitting

if TYPE_CHECKING:
    from hvdc_ident.discrepancy import Diagnosis
    from hvdc_ident.study.study import Study


def augmented_model(study: Study, diagnosis: Diagnosis, folder: Path) -> AnyModel:
    """Return the model with what a diagnosis put in, at its values. folder: where its files stand.

    It is the card that the diagnosis wrote; an FMU, which has none, gets the effects anew.
    """
    if diagnosis.augmented_model:
        return read_card(folder / Path(diagnosis.augmented_model).name)
    own = {n: v for n, v in diagnosis.parameters_after.items() if n in study.model.parameters}
    return apply_effects(study.model.with_values(own), [use_of(e) for e in diagnosis.effects])


def use_of(effect: FoundEffect | Rival) -> EffectUse:
    """Return an effect of the results as `apply_effects` takes it, at its sizes."""
    sizes = {n: p if isinstance(p, float) else p.value for n, p in effect.parameters.items()}
    expression = "" if isinstance(effect, FoundEffect) else effect.expression
    return EffectUse(effect.effect, effect.at, FrozenMap(sizes), source=effect.source, expression=expression)


def compared(study: Study, diagnosis: Diagnosis) -> tuple[dict[str, Any], dict[str, str]]:
    """Return what discrepancy.json says of the augmented model beside the recordings, and a CSV file of its curves by name.

    The JSON holds `units` of the outputs, `judgement` and `rmse_after`, as fit.json does of the fit; where no effect was put in, no
    errors but those at the given values.
    """
    sets = {"given": fitting.curves_at_given(study)}
    units = {o: study.model.outputs[o].unit for e in study.experiments for o in e.outputs}
    if diagnosis.augmented is None:
        return {"units": units, "judgement": fitting.judgement_of(study, sets)}, {}
    curves = _curves(study, diagnosis)
    files = {
        f"discrepancy.{e.name}.csv": fitting.curves_csv(e, curves[e.name])
        for e in study.experiments
        if e.name in curves
    }
    rmse: dict[str, dict[str, float]] = {}
    for name, line in curves.items():
        for output, curve in line.items():
            rmse.setdefault(output, {})[name] = curve.rmse
    judgement = fitting.judgement_of(study, {**sets, "effect": curves})
    return {"units": units, "rmse_after": rmse, "judgement": judgement}, files


def _curves(study: Study, diagnosis: Diagnosis) -> dict[str, dict[str, Curve]]:
    """Return the curves of the augmented model by experiment and output.

    Experiments that it cannot be run on are left out, and so are those with unknowns of their own, whose values a diagnosis does not
    keep.
    """
    assert diagnosis.augmented is not None
    curves = {}
    for e in study.experiments:
        if e.nuisance or e.measured is None:
            continue
        try:
            run = simulate(diagnosis.augmented, e, diagnosis.parameters_after).trajectory
        except ComputationError:  # its error is missing in `gap` too
            continue
        curves[e.name] = fitting.curves_of_run(e, run)
    return curves


def with_estimates(study: Study, diagnosis: Diagnosis, fitted: Sequence[str]) -> Diagnosis:
    """Return the diagnosis with the estimates of the augmented model's fitted parameters at its values, and tests of its residuals.

    fitted: the parameters that the diagnosis estimated. Their 95 % intervals are by the curvature of the cost there, widened for
    correlated residuals, and without intervals where what is left is more than noise, as those of a fit are; the parameters of the
    effects are unknowns too. Nothing is added where nothing was put in, and where an experiment has unknowns of its own.
    """
    model = diagnosis.augmented
    if model is None or any(e.nuisance for e in study.experiments):
        return diagnosis
    added = [n for n in model.parameters if n not in study.model.parameters]
    unknowns = [FitParameter.of(n, model.parameters[n]) for n in (*fitted, *added)]
    free = tuple(u for u in unknowns if not u.on_bound(u.start))
    if not any(u.name in fitted for u in free):
        return diagnosis
    problem = Problem(ModelSimulator(model), study.experiments, free, weights=FrozenMap(_misfit(study, diagnosis)))
    try:
        blocks = problem.blocks(problem.start)
    except ComputationError:
        return diagnosis
    sources = {o: source_text(problem.fitted_experiments, o, problem.weights.get(o)) for o in problem.outputs}
    spans = np.array([u.span for u in problem.unknowns])
    known = uncertainty(blocks, problem.names, spans, problem.noise_source, None, problem.noise_dof)
    known = known.widened(adequacy(problem, blocks, sources, known.effective, known.rho).widening)
    estimates = estimates_of(problem, problem.start, blocks, known, known, systematic=diagnosis.beyond_noise)
    why = "it depends on which of the likely effects and places is the true one"
    placed = {
        n: Estimate(math.nan, unit=estimates[n].unit, reason=why) for n in diagnosis.values_by_place if n in estimates
    }
    return replace(
        diagnosis,
        estimates_after=FrozenMap({n: placed.get(n) or estimates[n] for n in fitted if n in estimates}),
        residual_tests_after=residual_tests(blocks, problem.fitted_experiments),
    )


def _misfit(study: Study, diagnosis: Diagnosis) -> dict[str, float]:
    """Return the standard deviation of the misfit of every output whose noise is not known, over the fitted recordings."""
    fitted = tuple(e for e in study.experiments if e.role == "fit" and e.outputs)
    outputs = [o for o in dict.fromkeys(o for e in fitted for o in e.outputs) if source_of(fitted, o) == MISFIT]
    curves = _curves(study, diagnosis) if outputs else {}
    misfits = {o: [line[o].misfit for e in fitted if o in (line := curves.get(e.name, {}))] for o in outputs}
    return {o: float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) for o, parts in misfits.items() if parts}
