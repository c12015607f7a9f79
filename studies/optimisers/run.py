"""RaPId's optimisers on the link: evaluations, time and final cost of each from Table II's start.

python studies/optimisers/run.py [--budget 5000] [--only NAME ...] [--write]
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from hvdc_ident import load_model, simulate
from hvdc_ident.data import InputSignal, experiment, trajectory
from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.fit.optimisers import catalogue, is_global, optimiser
from hvdc_ident.simulate import ModelSimulator

TRUE = {"KIP": 30.0, "KPP": 0.0, "KIQ": 30.0, "KPQ": 0.0, "KPVDC": 24.0, "KIVDC": 734.7}
FREE = (
    FitParameter("KIP", 25, 5, 50),
    FitParameter("KPP", 5, 0, 10),
    FitParameter("KIQ", 25, 10, 50),
    FitParameter("KPQ", 5, 0, 10),
    FitParameter("KPVDC", 20, 10, 40),
    FitParameter("KIVDC", 750, 550, 950),
)
STEPS = {"Pref2": (0.4, 0.5), "Qref1": (0.0, 0.1), "Vdcref1": (1.0, 1.019)}
OUTPUTS = ("Irorder1", "Irorder2", "Iiorder1")
TIME = np.round(np.arange(0, 0.8001, 2e-3), 9)
NOISE = 1e-3  # pu
SEED = 1
HERE = Path(__file__).parent


@cache
def problem() -> Problem:
    """Return the problem: three set-point steps of the link with its true gains and white noise, six gains to estimate."""
    model = load_model("vsc-hvdc-link")
    random = np.random.default_rng(SEED)
    data = []
    for setpoint, (before, after) in STEPS.items():
        asked = experiment(f"step of {setpoint}", TIME, {setpoint: InputSignal.step(0.1, before, after)}, event=0.1)
        run = simulate(model, asked, TRUE, outputs=OUTPUTS).trajectory
        seen = {o: run[o] + NOISE * random.standard_normal(TIME.size) for o in OUTPUTS}
        data.append(asked.with_(measured=trajectory(TIME, seen), noise=dict.fromkeys(OUTPUTS, NOISE)))
    return Problem(ModelSimulator(model), tuple(data), FREE)


def one(name: str, budget: int) -> dict[str, Any]:
    """Return status, evaluations, cost and CPU seconds of the named method alone, without refinement."""
    method = replace(optimiser(name, SEED), max_evaluations=budget)
    begun = time.process_time()
    run = method.run(problem(), problem().start)
    return {
        "kind": "whole range" if is_global(name) else "local",
        "status": run.status,
        "evaluations": run.evaluations,
        "cost": run.cost,
        "seconds": time.process_time() - begun,
        "message": run.message,
    }


def main(names: list[str] | None = None, budget: int = 5000) -> dict[str, Any]:
    """Return effort and result by method; `best` is the cost of the package's multistart, `above` the cost beyond it."""
    problem().residual(problem().start)
    problem().cost(problem().start)  # both kinds of machine code are made before the clock runs
    best = fit(problem(), starts=8, assess=False)
    table = {n: one(n, budget) for n in (names or list(catalogue()))}
    for line in table.values():
        line["above"] = line["cost"] - best.cost
    errors = {n: (best.values[n] - v) / best.estimates[n].std for n, v in TRUE.items() if best.estimates[n].std}
    return {"best": best.cost, "status": best.status, "sigmas from the truth": errors, "methods": table}


def shown(found: dict[str, Any]) -> str:
    """Return the table of the README."""
    lines = [
        "| method | searches | status | evaluations | CPU time, s | cost above the best |",
        "|---|---|---|---|---|---|",
    ]
    for name, r in sorted(found["methods"].items(), key=lambda item: item[1]["evaluations"]):
        above = f"{max(r['above'], 0.0):.1e}"
        lines.append(f"| {name} | {r['kind']} | {r['status']} | {r['evaluations']} | {r['seconds']:.2f} | {above} |")
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--budget", type=int, default=5000, help="evaluations a method may take")
    parser.add_argument("--only", nargs="*", metavar="NAME")
    parser.add_argument("--write", action="store_true", help="write expected.json")
    options = parser.parse_args()
    result = main(options.only, options.budget)
    print(f"best cost {result['best']:.6f} ({result['status']})\n{shown(result)}")
    if options.write:
        kept = ("kind", "status", "evaluations", "cost", "above")
        slim = {n: {k: r[k] for k in kept} for n, r in result["methods"].items()}
        text = json.dumps({**result, "methods": slim}, indent=1)
        (HERE / "expected.json").write_text(text + "\n", encoding="utf-8")
