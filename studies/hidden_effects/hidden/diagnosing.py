"""The diagnosis of a case as one line of numbers. This is the only part that imports the package."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from hidden.campaigns import summary
from hidden.cases import Case
from hidden.noise import whitened
from hidden.plants import PLANTS
from hidden.sizes import UNIT, WIDTH, on_jumps
from hvdc_ident import simulate
from hvdc_ident.budget import Budget
from hvdc_ident.data import Experiment, InputSignal, Trajectory
from hvdc_ident.discrepancy import DiagnosisOptions, diagnose
from hvdc_ident.effects import EffectUse, apply_effects, effects
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, read_card
from hvdc_ident.simulate import ModelSimulator

CARDS = Path(__file__).resolve().parents[1] / "cards"
NAMES = ("fit-1", "fit-2", "holdout")


def model_of(plant: str) -> Model:
    """Return the plant's card."""
    return read_card(CARDS / f"{plant}.toml")


def experiments_of(case: Case) -> tuple[Experiment, ...]:
    """Return the case's records as experiments; the last one is held out."""
    outputs = PLANTS[case.design.plant].outputs
    names = tuple(outputs[k] for k in case.channels)
    noise = {} if case.told is None else {outputs[k]: float(case.told[k]) for k in case.channels}
    found = []
    for k, run in enumerate(case.runs):
        inputs = {n: InputSignal.corners(points) for n, points in summary(run).items()}  # type: ignore[arg-type]
        records = np.asarray(case.records[:, k][:, list(case.channels)], dtype=np.float64)
        rows = np.asarray(case.times, dtype=np.float64)
        measured = Trajectory(rows, records, names, tuple("" for _ in names))
        found.append(
            Experiment(
                rows,
                NAMES[k],
                inputs=FrozenMap(inputs),
                measured=measured,
                noise=FrozenMap(noise),
                event=case.event,
                role="holdout" if k == 2 else "fit",
            )
        )
    return tuple(found)


def free_of(case: Case) -> tuple[FitParameter, ...]:
    """Return the fit parameters with the values that a user would start from."""
    true = PLANTS[case.design.plant].parameters
    return tuple(FitParameter(n, v, true[n] / WIDTH, true[n] * WIDTH) for n, v in case.given.items())


def diagnosed(case: Case, seed: int = 0, sindy: bool = False, budget: float | None = None) -> dict[str, Any]:
    """Return one line: the design, the truth, the diagnosis, and the misfit of the held-out record.

    sindy: run the baseline of that name too. budget: CPU time that the diagnosis may take, s; None: no limit.
    """
    design = case.design
    line: dict[str, Any] = {
        "case": design.name,
        "part": design.part,
        "plant": design.plant,
        "effects": list(design.effects),
        "size": design.size,
        "noise": design.noise,
        "excitation": design.excitation,
        "removed": design.removed,
        "messy": design.messy,
        "told": case.told is not None,
        "level": design.level,
        "units": case.units,
        "tries": case.tries,
        "truth": case.truth,
    }
    if case.value is not None:
        line["value"] = asdict(case.value)
    model, experiments, free = model_of(design.plant), experiments_of(case), free_of(case)
    others = [n for n, e in effects().items() if e.tried_by_default and n not in design.effects]
    tried: Any = others if design.part == "left-out" else "all"
    begin, spent = time.perf_counter(), time.process_time()
    # By the clock on the wall it would be shorter beside other work, and two runs would not have the same.
    limit = None if budget is None else Budget.of(budget, time.process_time)
    try:
        found = diagnose(model, experiments, free, effects=tried, seed=seed, options=DiagnosisOptions(budget=limit))
    except HvdcIdentError as e:
        return line | {"failed": str(e), "seconds": time.perf_counter() - begin, "cpu": time.process_time() - spent}
    line |= {"seconds": time.perf_counter() - begin, "cpu": time.process_time() - spent} | _told(found)
    line["held_out"] = {
        "refitted": _misfit(model, experiments, case, found.parameters_refitted),
        "augmented": None
        if found.augmented is None
        else _misfit(found.augmented, experiments, case, found.parameters_after),
        "oracle": _oracle(model, experiments, case, free),
    }
    if found.augmented is not None:
        line["apart"] = _apart(found.augmented, experiments, case, found.parameters_after)
    if sindy:
        line["sindy"] = _sindy(model, experiments, case, found.parameters_refitted)
    return line


def _told(found: Any) -> dict[str, Any]:
    """Return the diagnosis as plain numbers, with the best candidate by score and the best by BIC."""
    told = found.to_dict()
    lines = told["candidates"]
    scored = [c for c in lines if c["score"] is not None and np.isfinite(c["score"])]
    refitted = [c for c in lines if c["delta_bic"] is not None]
    return {
        "verdict": told["verdict"],
        "found": told["effects"],
        "ambiguity": told["ambiguity"],
        "text": told["text"],
        "findings": told.get("findings", []),
        "remainder": told.get("remainder", {}),
        "location": told["location"],
        "law": {n: (told["fallback"] or {}).get(n) for n in ("kind", "at", "expression")},
        "shrink": told["gap"]["shrink_holdout"],
        "adequate": told["remaining"].get("adequate"),
        "best_score": max(scored, key=lambda c: c["score"], default=None),
        "best_bic": max(refitted, key=lambda c: c["delta_bic"], default=None),
        "tried": len(lines),
    }


def _misfit(model: Any, experiments: Sequence[Experiment], case: Case, values: Mapping[str, float]) -> float | None:
    """Return the rms of the held-out record's residuals in units of its true noise; None if the model cannot run."""
    held = experiments[2]
    assert held.measured is not None
    try:
        run = simulate(model, held, values, outputs=held.outputs)
    except HvdcIdentError:
        return None
    sigma = case.sigma[list(case.channels)]
    return float(np.sqrt(np.mean(((run.trajectory.values - held.measured.values) / sigma) ** 2)))


def _apart(model: Any, experiments: Sequence[Experiment], case: Case, values: Mapping[str, float]) -> float | None:
    """Return the distance of the model's response from the noise-free truth, in units; None if the model cannot run.

    Rows on a jump of an input do not count: they are not defined in a record.
    """
    off = np.zeros_like(case.clean)
    for k, e in enumerate(experiments):
        try:
            run = simulate(model, e, values, outputs=e.outputs)
        except HvdcIdentError:
            return None
        off[:, k, list(case.channels)] = run.trajectory.values - case.clean[:, k, list(case.channels)]
    return float(np.linalg.norm(whitened(off, case.sigma, case.design.noise, on_jumps(case.runs))) / UNIT)


def _sindy(
    model: Model, experiments: Sequence[Experiment], case: Case, values: Mapping[str, float]
) -> dict[str, float | None]:
    """Return the held-out misfit with a sparse law for the residual, and the number of its terms."""
    from hidden.sindy import predicted

    plant = PLANTS[case.design.plant]
    residuals, drivers = [], []
    for e, run in zip(experiments, case.runs, strict=True):
        assert e.measured is not None
        told = simulate(model, e, values, outputs=e.outputs).trajectory.values
        inputs = [
            run.inputs[n].at(case.times) if n in run.inputs else np.full(case.times.size, v)
            for n, v in plant.inputs.items()
        ]
        residuals.append(np.asarray(e.measured.values - told))
        drivers.append(np.column_stack([told, *(i for i in inputs)]))
    moving = np.ptp(np.concatenate(drivers), axis=0) > 1e-9
    times = np.asarray(case.times / plant.pace, dtype=np.float64)
    law, terms = predicted(residuals, [d[:, moving] for d in drivers], times)
    sigma = case.sigma[list(case.channels)]
    misfit = None if law is None else float(np.sqrt(np.mean(((residuals[-1] - law) / sigma) ** 2)))
    return {"augmented": misfit, "terms": float(terms)}


def _oracle(model: Model, experiments: Sequence[Experiment], case: Case, free: Sequence[FitParameter]) -> float | None:
    """Return the misfit of the model with the true effects, or the true value, fitted from the truth.

    None outside the catalogue, and where nothing is hidden and no value is wrong.
    """
    known = effects()
    if case.value is not None:
        model = model.with_values({case.value.name: case.value.true})
    elif not case.hidden or any(h.effect not in known for h in case.hidden):
        return None
    true = PLANTS[case.design.plant].parameters
    unknown = [FitParameter(f.name, true[f.name], f.min, f.max) for f in free]
    for h in case.hidden:
        use = EffectUse(h.effect, (h.at,), FrozenMap(_numbers(h.parameters)), source=h.source)
        before = set(model.parameters)
        model = apply_effects(model, [use])
        bounds = _bounds(h.effect, _numbers(h.parameters))
        for name in (n for n in model.parameters if n not in before):
            own = next(
                n for n in h.parameters if use.parameter_name(n) == name or name.startswith(use.parameter_name(n))
            )
            if own in bounds:
                low, high = bounds[own]
                value = model.parameters[name].value
                unknown.append(FitParameter(name, value, min(low, value), max(high, value)))
    sigma = {o: float(case.sigma[k]) for o, k in zip(experiments[0].outputs, case.channels, strict=True)}
    coloured = case.design.noise in ("ar", "told-white")
    problem = Problem(ModelSimulator(model), tuple(experiments), tuple(unknown), weights=FrozenMap(sigma))
    try:
        result = fit(problem, starts=1, assess=False, whiten="pre-event" if coloured else "no")
    except HvdcIdentError:
        return None
    if result.status == "failed":
        return None
    return _misfit(model, experiments, case, {n: e.value for n, e in result.estimates.items()})


def _numbers(parameters: Mapping[str, Any]) -> dict[str, float]:
    return {n: float(v) for n, v in parameters.items()}


def _bounds(effect: str, values: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    """Return bounds for a fit from the truth: a factor of ten, or ten times the distance from neutral; held ones are omitted."""
    found = {}
    for name, q in effects()[effect].parameters.items():
        value = values.get(name, q.value)
        if q.fixed or (q.optional and value == q.neutral):
            continue
        low, high = sorted((value / 10.0, value * 10.0)) if value else (-1.0, 1.0)
        found[name] = (max(low, q.min), min(high, q.max))
    return found
