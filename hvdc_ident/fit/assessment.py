"""Assessment of a fit: goodness by output and experiment, held-out experiments, bands of the prediction.

Everything in this module takes a problem in its final weights and the result of its fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.special import stdtrit

from hvdc_ident.errors import SimulationError
from hvdc_ident.fit.adequacy import ljung_box
from hvdc_ident.fit.descent import descend
from hvdc_ident.fit.noise import from_misfit
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.residual import Curve, compared_rows, stretches
from hvdc_ident.fit.result import FitResult, Goodness, HeldOut, HeldOutQuality, SignalQuality
from hvdc_ident.fit.simulator import observe, unknown_of
from hvdc_ident.immutable import FrozenMap


def assessed(problem: Problem, result: FitResult) -> FitResult:
    """Return the result with curves, `goodness` and `validation`; those of held-out experiments have their own nuisances."""
    nuisances = held_out_nuisances(problem, result)
    by_experiment = curves(problem, result, nuisances)
    rmse = {o: dict(line) for o, line in result.rmse.items()}
    for e in problem.experiments:
        if nuisances.get(e.name):
            for output, c in by_experiment.get(e.name, {}).items():
                rmse[output][e.name] = c.rmse
    result = replace(result, rmse=rmse)
    held_out = {e.name for e in problem.experiments if e.role == "holdout"}
    return replace(
        result,
        curves=by_experiment,
        goodness=goodness({n: c for n, c in by_experiment.items() if n not in held_out}),
        validation=validation(problem, result, {n: by_experiment.get(n) for n in sorted(held_out)}, nuisances),
    )


def in_final_weights(problem: Problem, result: FitResult) -> Problem:
    """Return the problem with the standard deviations and the noise model that its fit ended with."""
    return replace(
        problem,
        weights=problem.weights | deviations_from_misfit(result),
        rho=problem.rho | dict(result.whitening),
    )


def held_out_nuisances(problem: Problem, result: FitResult) -> dict[str, dict[str, float] | None]:
    """Return the nuisances of each held-out experiment, estimated from its own record with the parameters at their estimates.

    None where they cannot be estimated, for the run fails.
    """
    nuisances: dict[str, dict[str, float] | None] = {}
    for e in problem.experiments:
        if e.role != "holdout" or not e.nuisance or not e.outputs:
            continue
        alone = replace(
            problem,
            experiments=(e.with_(role="fit"),),
            rho=FrozenMap(),
            band=None,
            priors=FrozenMap(),
            weights=FrozenMap(deviations_from_misfit(result)),
        )
        theta = alone.start
        known = len(alone.free)
        theta[:known] = [result.values[f.name] for f in alone.free]
        fixed = np.arange(theta.size) < known
        try:
            end = descend(alone, theta, fixed, enough=1e-6)
        except SimulationError:
            nuisances[e.name] = None
            continue
        nuisances[e.name] = {n: float(v) for n, v in zip(e.nuisance, end.theta[known:], strict=True)}
    return nuisances


def deviations_from_misfit(result: FitResult) -> dict[str, float]:
    """Return the standard deviations that came from the misfit, by output."""
    return {
        o: next(s[o] for s in result.sigma.values() if o in s) for o, w in result.noise_source.items() if from_misfit(w)
    }


def curves(
    problem: Problem, result: FitResult, held_out: Mapping[str, Mapping[str, float] | None] | None = None
) -> dict[str, dict[str, Curve]]:
    """Return every output of every experiment at the estimates, by experiment and output; those that fail are left out.

    held_out: nuisances of held-out experiments, None where they could not be estimated.
    """
    table: dict[str, dict[str, Curve]] = {}
    known = result.covariance
    quantile = float(stdtrit(known.dof, 0.975)) if known is not None else np.nan
    for e in problem.experiments:
        if not e.outputs or e.measured is None:
            continue
        nuisance = {n: v.value for n, v in result.nuisance.get(e.name, {}).items()}
        if held_out and e.name in held_out:
            estimated = held_out[e.name]
            if estimated is None:
                continue
            nuisance = dict(estimated)
        names = [f.name for f in problem.free]
        columns = [*names, *(unknown_of(e.name, n) for n in nuisance)]
        try:
            observed = observe(problem.simulator, e, result.values, names, nuisance)
        except SimulationError:
            continue
        table[e.name] = {}
        for o in e.outputs:
            sigma, profile, std, band = problem.sigma[e.name][o], e.noise_profile.get(o), None, None
            if known is not None and known.names:
                pick = [k for k, n in enumerate(columns) if n in known.names]
                place = [known.names.index(columns[k]) for k in pick]
                g = observed.gradient[o][:, pick]
                variance = np.einsum("ni,ij,nj->n", g, known.matrix[np.ix_(place, place)], g)
                std = np.sqrt(np.clip(variance, 0.0, None))
                band = quantile * np.sqrt(std**2 + (sigma if profile is None else sigma * profile) ** 2)
            table[e.name][o] = Curve(observed.values[o], e.measured[o], compared_rows(e, o), sigma, std, band, profile)
    return table


def goodness(by_experiment: Mapping[str, Mapping[str, Curve]]) -> Goodness:
    """Return the quality of the curves of the fitted experiments."""
    table: dict[str, dict[str, SignalQuality]] = {}
    for experiment, line in by_experiment.items():
        for output, c in line.items():
            table.setdefault(output, {})[experiment] = _quality(c)
    return Goodness(table)


def _quality(c: Curve) -> SignalQuality:
    e, y = c.misfit, c.measured[c.rows]
    moved = float(np.sum((y - y.mean()) ** 2))
    return SignalQuality(
        int(e.size),
        c.rmse,
        1.0 - float(e @ e) / moved if moved > 0 else None,
        float(np.mean(np.abs(e) <= c.band[c.rows])) if c.band is not None else None,
    )


def validation(
    problem: Problem,
    result: FitResult,
    by_experiment: Mapping[str, Mapping[str, Curve] | None],
    nuisances: Mapping[str, Mapping[str, float] | None],
) -> dict[str, HeldOut]:
    """Return the quality of the curves of the held-out experiments, by name."""
    fitted = {e.name for e in problem.experiments if e.role == "fit"}
    table = {}
    for name, line in by_experiment.items():
        outputs = {}
        for output, c in (line or {}).items():
            errors = [v for e, v in result.rmse.get(output, {}).items() if e in fitted and v is not None]
            typical = float(np.sqrt(np.mean(np.square(errors)))) if errors else None
            quality = _quality(c)
            outputs[output] = HeldOutQuality(
                quality,
                result.rmse_start.get(output, {}).get(name),
                quality.rmse / typical if typical else None,
                ljung_box(c.residual, parts=stretches(c.rows)),
            )
        table[name] = HeldOut("done" if line else "failed", dict(nuisances.get(name) or {}), outputs)
    return table
