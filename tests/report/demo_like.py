"""Results as large as the demo's, made without a run: nine recordings of three outputs, a lag that the model lacks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from hvdc_ident.identifiability.experiment_design import (
    ExperimentDesign,
    Move,
    OptimalityCriteria,
    RankedDesign,
    Recommendation,
)
from hvdc_ident.immutable import FrozenMap
from tests.report.judgements import judgement

HEADING = {
    "schema": 1,
    "study": "demo-like",
    "model": "link",
    "software": "hvdc_ident 0",
    "seed": 0,
    "sources": {"s.toml": "ab"},
}
OUTPUTS = ("Ir1", "Ir2", "Ii1")
EXPERIMENTS = tuple(f"{kind}-{k}" for kind in ("p", "q", "vdc") for k in (1, 2, 3))
NOISE, TAU, EVENT = 1e-4, 2e-3, 0.1
GAINS = {
    "KIP": (30.0, 31.4, 29.9),
    "KIQ": (30.0, 31.4, 29.9),
    "KPVDC": (24.0, 25.8, 23.9),
    "KIVDC": (734.7, 846.1, 728.3),
}
SETS = {"simulation": 0.03, "fit": 0.01, "discrepancy": 0.0}
"""By stage, the share of the swing by which its model is off just after the event."""


def runs(
    experiment: str, output: str, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Time, recording and the model's run by stage; `Ir2` stands still in the recordings of `vdc`."""
    time = np.linspace(0.0, 0.9, 901)
    swing = 0.0 if (output, experiment[:3]) == ("Ir2", "vdc") else 0.1 * (1 + EXPERIMENTS.index(experiment) % 3)
    after = np.clip(time - EVENT, 0.0, None)
    clean = swing * (1.0 - np.exp(-after / 0.03))
    off = swing * np.exp(-after / 0.03) * after / 0.03
    return time, clean + NOISE * rng.standard_normal(time.size), {s: clean - share * off for s, share in SETS.items()}


def demo_like(folder: Path) -> Path:
    """The folder, with the JSON and CSV files of the stages simulate, identify, fit and diagnose."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    rmse: dict[str, dict[str, dict[str, float]]] = {s: {o: {} for o in OUTPUTS} for s in SETS}
    for e in EXPERIMENTS:
        columns: dict[str, list[np.ndarray]] = {s: [] for s in SETS}
        for o in OUTPUTS:
            time, record, models = runs(e, o, rng)
            for s, model in models.items():
                rmse[s][o][e] = float(np.sqrt(np.mean((record - model) ** 2)))
                columns[s] += [model, record]
        for s, values in columns.items():
            header = "time," + ",".join(f"{o},{o}.measured" for o in OUTPUTS)
            rows = np.column_stack([time, *values])
            np.savetxt(folder / f"{s}.{e}.csv", rows, fmt="%.9g", delimiter=",", header=header, comments="")
    for name, data in {
        "simulation": _simulation(rmse),
        "fit": _fit(rmse),
        "identifiability": _identifiability(),
        "discrepancy": _discrepancy(rmse),
    }.items():
        (folder / f"{name}.json").write_text(json.dumps({**HEADING, **data}), "utf-8")
    return folder


def _about() -> dict[str, Any]:
    noise = {e: {o: {"std": NOISE, "source": "given", "by_row": False} for o in OUTPUTS} for e in EXPERIMENTS}
    roles = {e: {"role": "holdout" if e.endswith("3") else "fit", "event": EVENT, "window": None} for e in EXPERIMENTS}
    return {"units": dict.fromkeys(OUTPUTS, "pu"), "noise": noise, "experiments": roles}


def _windows(high: float) -> dict[str, Any]:
    limits = {"max": 0.05, "mean": 0.02, "mean_absolute": 0.03}
    window = {"from": 0.0, "to": 0.05, "n": 51, "limits": limits, "mean": 1e-5, "mean_absolute": 8e-5}
    line = {"event": EVENT, "end": 0.2, "end_from": "inputs", "within": high <= 0.05, "reason": ""}
    line |= {w: {**window, "max": high, "within": high <= 0.05} for w in ("before", "during", "after")}
    return dict.fromkeys(OUTPUTS, line)


def judged(rmse: dict[str, Any], *names: str, **more: Any) -> dict[str, Any]:
    """The judgement of some sets of values by the RMSE by stage; more: a tolerance, or that the study names the profile."""
    stages = {"given": "simulation", "fitted": "fit", "effect": "discrepancy"}
    return judgement({n: rmse[stages[n]] for n in names}, dict.fromkeys(OUTPUTS, NOISE), _windows(0.01), **more)


def _simulation(rmse: dict[str, Any]) -> dict[str, Any]:
    return {**_about(), "stage": "simulate", "rmse": rmse["simulation"], "judgement": judged(rmse, "given")}


def _candidates() -> dict[str, Any]:
    return {
        n: {"given": g, "start": 0.9 * g, "min": 1.0, "max": 2000.0, "unit": "pu/s"} for n, (g, _, _) in GAINS.items()
    }


def _fit(rmse: dict[str, Any]) -> dict[str, Any]:
    estimates = {
        n: {"value": f, "std": 0.005 * f, "ci95": [0.99 * f, 1.01 * f], "unit": "pu/s"}
        for n, (_, f, _) in GAINS.items()
    }
    adequacy = {
        "verdict": "does-not-fit",
        "chi2_per_dof": 28.0,
        "text": "the residual of Ir1 is 9 times the noise",
        "next": [{"kind": "diagnose", "text": ""}],
    }
    return {
        **_about(),
        "stage": "fit",
        "status": "converged",
        "message": "8 of 8 runs reached this optimum",
        "fitted": list(GAINS),
        "held": {"C1": "not a candidate"},
        "values": {n: f for n, (_, f, _) in GAINS.items()},
        "estimates": estimates,
        "candidates": _candidates(),
        "rmse": rmse["fit"],
        "rmse_given": rmse["simulation"],
        "adequacy": adequacy,
        "noise_source": dict.fromkeys(OUTPUTS, "given"),
        "judgement": judged(rmse, "given", "fitted"),
    }


def advice(input: str, words: str) -> dict[str, Any]:
    """A step of an input, advised in these words."""
    design = ExperimentDesign((Move(input, "step", 1.0, 1.05, 0.1),))
    seen = OptimalityCriteria(1, 1.0, 0.0)
    best, none = RankedDesign(design, OUTPUTS, (), seen), FrozenMap[Any]()
    return Recommendation(best, next(iter(GAINS)), best, seen, none, none, none, (), 1, (), words).to_dict()


def _identifiability() -> dict[str, Any]:
    parameters = {
        n: {
            "name": n,
            "verdict": "identifiable",
            "reason": "It is known.",
            "value": f,
            "ci95": [0.99 * f, 1.01 * f],
            "unit": "pu/s",
            "collinearity": 1.2,
        }
        for n, (_, f, _) in GAINS.items()
    }
    return {
        "stage": "identify",
        "parameters": parameters,
        "identifiable": list(GAINS),
        "recommended_experiment": advice("Vdcref1", "Step Vdcref1 from 1 to 1.05, recording the same signals"),
    }


def _discrepancy(rmse: dict[str, Any]) -> dict[str, Any]:
    size = {"T": {"value": TAU, "ci95": [0.9 * TAU, 1.1 * TAU], "unit": "s"}}
    places = [{"at": ["P1", "Q1"], "probability": 0.6}, {"at": ["P1_m"], "probability": 0.4}]
    lag = {
        "effect": "lag",
        "at": ["P1", "Q1"],
        "text": "Each of P1 and Q1 of the plant follows that of the model with a lag of 2 ms",
    }
    finding = {
        "effect": "lag",
        "same_as": ["lag"],
        "probability": 0.97,
        "parameters": size,
        "places": places,
        "text": "A lag.",
    }
    gap = {m: {"fit": {}, "holdout": {}} for m in ("nominal", "refitted", "augmented")}
    pooled = {m: {"fit": v, "holdout": 1.2 * v} for m, v in (("nominal", 10.0), ("refitted", 4.0), ("augmented", 1.0))}
    return {
        "stage": "diagnose",
        "verdict": "named",
        "text": "A lag is missing.",
        "effects": [{**lag, "parameters": size, "chosen_from": 9}],
        "findings": [{**finding, "equivalent_delay": {"value": TAU, "ci95": None, "unit": "s"}}],
        "ambiguity": [],
        "beyond_noise": True,
        "separating_experiment": {
            "text": "record P1_m as well, and step what acts on one side of P1 and P1_m and not on the other"
        },
        "remainder": {
            "share": 0.19,
            "p": 0.01,
            "held_out": 0.3,
            "at": "P1",
            "record": "vdc-3",
            "record_units": 5.3,
            "below_tolerance": False,
        },
        "gap": {**gap, "noise_floor": dict.fromkeys(OUTPUTS, NOISE), "pooled": pooled, "shrink_holdout": 0.75},
        "parameters_before": {n: g for n, (g, _, _) in GAINS.items()},
        "parameters_refitted": {n: 1.001 * f for n, (_, f, _) in GAINS.items()},
        "parameters_after": {n: a for n, (_, _, a) in GAINS.items()},
        "estimates_after": {n: {"value": a, "ci95": [0.995 * a, 1.005 * a]} for n, (_, _, a) in GAINS.items()},
        "augmented_model": "augmented-model.toml",
        "rmse_after": rmse["discrepancy"],
        "judgement": judged(rmse, "given", "effect"),
        "notes": [],
    }
