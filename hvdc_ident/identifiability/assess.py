"""The verb `identifiability`: structure, pilot fit, information and profiles, put together into verdicts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from hvdc_ident.data import Experiment
from hvdc_ident.errors import SimulationError, SteadyStateError, StudyError
from hvdc_ident.executor import Executor, Progress
from hvdc_ident.fit import FitParameter, FitResult, Problem, Simulator
from hvdc_ident.fit.bootstrap import Bootstrap, bootstrap
from hvdc_ident.fit.frequency_data import WithResponses, in_time
from hvdc_ident.fit.noise_model import unknown_noise
from hvdc_ident.fit.profile_path import ProfileOptions
from hvdc_ident.fit.simulator import inputs_of
from hvdc_ident.identifiability import narrow, verdicts
from hvdc_ident.identifiability.evidence import pair_of, thresholds, told_by_noise
from hvdc_ident.identifiability.findings import Findings
from hvdc_ident.identifiability.heterogeneity import Misspecification, heterogeneity, misspecification
from hvdc_ident.identifiability.pilot import Optimum, pilot, unfitted
from hvdc_ident.identifiability.recommend import Recommendation, recommend
from hvdc_ident.identifiability.report import IdentifiabilityReport
from hvdc_ident.identifiability.structure import Structure
from hvdc_ident.identifiability.structure import structure as structure_of
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model
from hvdc_ident.sensitivity import LocalSensitivities, collinear_subsets, sensitivities
from hvdc_ident.simulate import ModelSimulator

ENOUGH = 5
"""From so many experiments on they are drawn anew: five give 126 different samples, four only 35."""
TELLING = 4.0
"""So many of them, counted by information, must tell of a parameter to draw experiments anew for it."""


def identifiability(
    subject: Model | Simulator,
    experiments: Iterable[Experiment],
    candidates: Iterable[FitParameter],
    *,
    starts: int = 8,
    seed: int = 0,
    held: Mapping[str, float] | None = None,
    pair: tuple[str, str] | None = None,
    profile_options: ProfileOptions | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> IdentifiabilityReport:
    """What the experiments tell about the candidates: a verdict on each, the set to fit, and what to measure next.

    subject: a model, or anything that can be simulated (then the structure is judged by numbers, at random points).
    candidates: the parameters to judge, with start, bounds and the given values, at which those are held that these data
    do not tell. held: values of other parameters.
    pair: two candidates whose common profile is wanted too, over twice their intervals, where both are fitted.
    Raises StudyError where there is nothing to judge, SimulationError where an experiment cannot be simulated.
    """
    simulator: Simulator = ModelSimulator(subject) if isinstance(subject, Model) else subject
    problem = Problem(simulator, tuple(experiments), tuple(candidates), held=FrozenMap(held or {}))
    so_far = Findings(problem, seed, profile_options or ProfileOptions(), progress)
    _check(so_far)
    so_far.tell("structure")
    structure = structure_of(_equations(subject), problem, seed)
    narrow.structural(so_far, structure)
    free = tuple(f for f in problem.free if f.name not in so_far.held)
    if free:
        first = replace(problem, free=free, held=problem.held | {n: so_far.free[n].given for n in so_far.held})
        optimum, result = pilot(first, starts=starts, seed=seed, executor=executor, progress=progress)
    else:
        optimum, result = unfitted(problem)
    _data_notes(so_far, optimum, result)
    so_far.ends = tuple((o.end, o.cost) for o in result.starts if o.cost is not None)
    so_far.thresholds = thresholds(optimum)
    left = narrow.insensitive(so_far, optimum) if free else None
    left = narrow.lost(so_far, left) if left else None
    last = narrow.profiled(so_far, left, executor) if left else None
    report = _assembled(so_far, structure, optimum, last, result, executor)
    if pair and last is not None and set(pair) <= set(report.identifiable):
        return replace(report, pair=pair_of(last, report.parameters, pair))
    note = f"No common profile of {' and '.join(pair)}: not both are fitted." if pair else ""
    return replace(report, notes=(*report.notes, note)) if note else report


def _equations(subject: Model | Simulator) -> Model | None:
    """The model whose equations the structure can be asked of, where there is one."""
    model = subject.model if isinstance(subject, WithResponses) else subject
    return model if isinstance(model, Model) else None


def _check(so_far: Findings) -> None:
    """Notes that nothing moves, where nothing does. Raises StudyError where nothing was measured."""
    experiments = so_far.problem.fitted_experiments
    for e in experiments:
        assert e.measured is not None
        if not any(np.isfinite(e.measured[o][e.compared]).any() for o in e.outputs):
            raise StudyError(
                "nothing was measured", where=f"experiment '{e.name}'", expected="finite values in its window"
            )
    recordings = in_time(experiments)
    so_far.quiet = len(recordings) == len(experiments) and all(
        s.is_constant for e in recordings for s in e.inputs.values()
    )
    if so_far.quiet and any(e.inputs for e in experiments):
        so_far.notes.append("No input moves in any of the experiments: they show a steady state and nothing else.")


def _data_notes(so_far: Findings, optimum: Optimum, result: FitResult) -> None:
    rows, unknowns = sum(b.residual.size for b in optimum.blocks), len(so_far.problem.unknowns)
    if rows < unknowns:
        so_far.notes.append(f"{rows} measured values cannot determine {unknowns} unknowns.")
    elif rows == unknowns:
        so_far.notes.append(f"{rows} measured values for as many unknowns leave nothing to tell a wrong model by.")
    if optimum.deterministic:
        reasons = unknown_noise(so_far.problem.fitted_experiments, result.noise_source)
        so_far.notes += [f"{o}: {why}; its standard deviation is that of the misfit." for o, why in reasons.items()]
        so_far.remark = f"The noise is that of the misfit ({'; '.join(dict.fromkeys(reasons.values()))})."
    if result.status in ("two-optima", "not-converged"):
        so_far.notes.append(f"Pilot fit: {result.status}, {result.message}.")


def _assembled(
    so_far: Findings,
    structure: Structure,
    first: Optimum,
    last: Optimum | None,
    result: FitResult,
    executor: Executor | None,
) -> IdentifiabilityReport:
    """The report. first: the optimum of the pilot fit; last: that of the set that is fitted."""
    bound = {n for n, v in so_far.found.items() if v.verdict == "at-bound"}
    fitted = tuple(n for n in so_far.free if last is not None and n in last.names and n not in bound)
    held = {
        n: (so_far.found[n].value, so_far.found[n].reason)
        if n in bound
        else (so_far.held_at.get(n, so_far.free[n].given), so_far.held[n])
        for n in so_far.free
        if n not in fitted
    }
    whole = _whole(so_far, last or first)
    unjudged = _unjudged(so_far, whole, fitted, first)
    held = {n: (v, so_far.found[n].reason if n in unjudged else why) for n, (v, why) in held.items()}
    resampled = _resampled(so_far, last, executor)
    scatter = resampled.ci95() if resampled else {}
    for n, verdict in so_far.found.items():
        value = held[n][0] if n in held else verdict.value
        if last is not None and not np.isfinite(value):
            value = last.value(n)
        scale = verdicts.scale_of(so_far.free[n], value)[0]
        norm = whole.information.norms[n]
        verdict = replace(verdict.noted(so_far.remark), value=value, scale=scale, sensitivity_norm=norm)
        so_far.found[n] = verdict.scattered(scatter[n], resampled) if resampled and n in scatter else verdict
    several = last is not None and len(last.problem.fitted_experiments) > 1
    different = heterogeneity(last) if last is not None and several else FrozenMap()
    matrix = first.information.matrix
    return IdentifiabilityReport(
        parameters=FrozenMap({n: so_far.found[n] for n in so_far.free}),
        identifiable=fitted,
        held=FrozenMap(held),
        structure=structure,
        combinations=tuple(so_far.combinations),
        collinear=collinear_subsets(matrix, first.names)[:200] if len(first.names) > 1 else (),
        correlation=last.uncertainty.correlation() if last is not None else {},
        shares=whole.information.shares(),
        heterogeneity=different,
        misspecification=misspecification(last, different, so_far.units) if last else Misspecification(False, ()),
        recommended=_recommended(so_far, whole),
        thresholds=FrozenMap(so_far.thresholds),
        pilot={
            "status": result.status,
            "message": result.message,
            "starts": len(result.starts),
            "cost": first.cost,
            "chi2_per_dof": first.misfit,
            "effective_samples": dict(first.uncertainty.effective),
            "noise_source": dict(result.noise_source),
        },
        notes=tuple(so_far.notes),
        bootstrap=resampled,
        sensitivities=_sensitivities(so_far, whole),
        not_judged=unjudged,
        optima=so_far.optima,
    )


def _unjudged(so_far: Findings, whole: Optimum, fitted: Sequence[str], at: Optimum) -> tuple[str, ...]:
    """The held parameters that noise alone would tell, where the misfit is more than noise; their verdicts are taken back.

    at: the optimum of the pilot fit. A misfit that comes only with holding one at its start value is not the model's.
    """
    if at.excess == 1.0:
        return ()
    hidden = ("insensitive", "practically-unidentifiable", "at-bound")
    others = [n for n in so_far.free if n not in fitted and so_far.found[n].verdict in hidden]
    told = told_by_noise(whole, fitted, others) if others else {}
    for n, half in told.items():
        so_far.found[n] = verdicts.not_judged(so_far.found[n], float(np.sqrt(at.excess)), half)
    _widened_by_misfit(so_far, whole, fitted, at)
    return tuple(n for n in so_far.free if n in told)


def _widened_by_misfit(so_far: Findings, whole: Optimum, fitted: Sequence[str], at: Optimum) -> None:
    """Remark on the weak parameters that the noise alone would let be known within `WIDE`. at: as for `_unjudged`."""
    weak = [n for n in fitted if so_far.found[n].verdict == "weak"]
    halves = told_by_noise(whole, [n for n in fitted if n not in weak], weak) if weak else {}
    for n, half in halves.items():
        judged = so_far.found[n]
        scale = verdicts.scale_of(so_far.free[n], judged.value)[0]
        if half <= verdicts.WIDE * scale and (judged.collinearity or 0.0) <= verdicts.COLLINEAR:
            so_far.found[n] = verdicts.misfit_made(judged, float(np.sqrt(at.excess)), half)


def _whole(so_far: Findings, at: Optimum) -> Optimum:
    """All candidates free, at the values found or held."""
    values = {**{n: f.given for n, f in so_far.free.items()}, **at.problem.values(at.theta)}
    theta = [values[n] for n in so_far.free]
    theta += [v for u, v in zip(at.problem.names, at.theta, strict=True) if u not in so_far.free]
    return Optimum(replace(so_far.problem, weights=at.problem.weights), np.array(theta, dtype=float))


def _sensitivities(so_far: Findings, whole: Optimum) -> LocalSensitivities | None:
    """The exact sensitivities of a model with equations, at the values found or held, between what moves and what is seen."""
    subject = so_far.problem.simulator
    subject = subject.simulator if isinstance(subject, WithResponses) else subject
    if not isinstance(subject, ModelSimulator) or not isinstance(subject.model, Model):
        return None
    experiments = in_time(so_far.problem.fitted_experiments)
    if not experiments:
        return None
    moved = [n for n in subject.model.inputs if any(n in e.inputs and not e.inputs[n].is_constant for e in experiments)]
    try:
        return sensitivities(
            subject.model,
            experiments,
            whole.names,
            values=whole.problem.values(whole.theta),
            inputs=moved or None,
            ranges={n: f.drawn for n, f in so_far.free.items() if not f.min > 0},
        )
    except (SimulationError, SteadyStateError) as error:
        so_far.notes.append(f"No table of sensitivities: {error}.")
        return None


def _resampled(so_far: Findings, last: Optimum | None, executor: Executor | None) -> Bootstrap | None:
    """The estimates from experiments drawn anew, of those parameters that enough experiments tell of.

    A parameter that one or two experiments determine would be lost in every sample without them: it stays where it is.
    """
    if last is None or len(last.problem.fitted_experiments) < ENOUGH:
        return None
    telling = last.information.telling()
    told = [n for n in last.names if telling[n] >= TELLING]
    others = [n for n in last.names if n not in told]
    if not told:
        so_far.notes.append("Experiments are not drawn anew: of every parameter only a few of them tell.")
        return None
    if others:
        so_far.notes.append(f"While experiments are drawn anew {', '.join(others)} stay: only a few tell of them.")
    so_far.tell("experiments drawn anew")
    fixed = {n: last.value(n) for n in others}
    places = [i for i, n in enumerate(last.problem.names) if n not in fixed]
    problem = replace(
        last.problem,
        free=tuple(f for f in last.problem.free if f.name in told),
        held=last.problem.held | fixed,
    )
    try:
        return bootstrap(problem, last.theta[places], seed=so_far.seed, executor=executor)
    except SimulationError as error:
        so_far.notes.append(f"The bootstrap over experiments came to nothing: {error.what}.")
        return None


def _recommended(so_far: Findings, whole: Optimum) -> Recommendation | None:
    """What to measure next, where there is an input to move."""
    so_far.tell("what to measure next")
    inputs = inputs_of(so_far.problem.simulator, so_far.problem.fitted_experiments)
    try:
        return recommend(whole, inputs, so_far.units, thresholds=so_far.thresholds)
    except SimulationError as error:
        so_far.notes.append(f"What to measure next cannot be told: {error.what}.")
        return None
