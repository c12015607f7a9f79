"""The phasor link calibrated against waveforms computed by Dymola: the table of this folder's README.

    python studies/dymola_waveform/run.py

Needs the reference data beside the project (../shared/data/dymola); says so where they are absent.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from hvdc_ident import load_study, simulate
from hvdc_ident.effects import apply_effects
from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.simulate import ModelSimulator

HERE = Path(__file__).parent
DATA = HERE / "../../../shared/data/dymola/TwoNodePowerSystem.mat"
TRUE = {"KIP": 30.0, "KPVDC": 9.6, "KIVDC": 293.88}


def errors(study, values):
    """Return the RMSE by output at the gains."""
    (experiment,) = study.experiments
    run = simulate(study.model, experiment, values).trajectory
    rows = experiment.compared
    return {o: float(np.sqrt(np.mean((experiment.measured[o] - run[o])[rows] ** 2))) for o in experiment.outputs}


def main() -> dict:
    """Return gains and RMSE by output: at the start, at the true gains, fitted, and fitted with one lag on all currents."""
    study = load_study(HERE / "study.toml")
    free = tuple(study.candidates.values())
    plain = fit(Problem(ModelSimulator(study.model), study.experiments, free), starts=8, seed=0)
    lag = {"effect": "lag", "at": ["Ir1", "Ii1", "Ir2", "Ii2"], "parameters": {"T": 1e-3}}
    lagged_model = apply_effects(study.model, [lag])
    more = (*free, FitParameter("lag_Ir1_T", 1e-3, 1e-4, 1e-2))
    lagged = fit(Problem(ModelSimulator(lagged_model), study.experiments, more), starts=4, seed=0)
    start = {n: f.start for n, f in study.candidates.items()}
    return {
        "gains": {
            "true": TRUE,
            "start": start,
            "fitted": {n: plain.values[n] for n in TRUE},
            "fitted with a lag": {n: lagged.values[n] for n in (*TRUE, "lag_Ir1_T")},
        },
        "rmse": {
            "start": errors(study, start),
            "true gains": errors(study, TRUE),
            "fitted": {o: v["p-step"] for o, v in plain.rmse.items()},
            "fitted with a lag": {o: v["p-step"] for o, v in lagged.rmse.items()},
        },
    }


if __name__ == "__main__":
    if not DATA.exists():
        sys.exit(f"the reference data are not beside the project: {DATA.name} is expected in ../shared/data/dymola")
    result = main()
    print("gains")
    for label, values in result["gains"].items():
        print(f"  {label:18s}", "  ".join(f"{n} {v:.6g}" for n, v in values.items()))
    print("RMSE, pu")
    for label, values in result["rmse"].items():
        print(f"  {label:18s}", "  ".join(f"{n} {v:.5f}" for n, v in values.items()))
    (HERE / "result.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
