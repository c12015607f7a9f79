"""RaPId's optimisers on the link: evaluations, time and final cost of each from Table II's start.

The package's own methods, and RaPId's methods without derivatives by scipy and pyswarms, on the same cost.

python studies/optimisers/run.py [--budget 5000] [--only NAME ...] [--write]
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from contextlib import chdir
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import differential_evolution, dual_annealing, minimize

from hvdc_ident import load_model, simulate
from hvdc_ident.data import InputSignal, experiment, trajectory
from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.fit.optimisers import catalogue, optimiser
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


class BudgetSpentError(Exception):
    """The method has used the evaluations it may take."""


@dataclass
class UnitCube:
    """The cost over the unit cube of Table II's bounds, counted; the lowest that was seen, and the evaluations it may take."""

    limit: int
    evaluations: int = 0
    cost: float = np.inf
    start: Any = field(default_factory=lambda: np.array([(f.start - f.min) / (f.max - f.min) for f in FREE]))

    def __call__(self, shares: Any) -> float:
        """Return the cost at a point of the cube, (6,); outside of it at the nearest point inside."""
        if self.evaluations >= self.limit:
            raise BudgetSpentError
        self.evaluations += 1
        inside = np.clip(shares, 0.0, 1.0)
        value = problem().cost(np.array([f.min + s * (f.max - f.min) for f, s in zip(FREE, inside, strict=True)]))
        self.cost = min(self.cost, value)
        return value


CUBE = [(0.0, 1.0)] * len(FREE)


def _nelder_mead(cost: UnitCube) -> bool:
    settings = {"fatol": 1e-10, "xatol": 1e-10, "maxfev": 10**6, "maxiter": 10**6, "adaptive": True}
    return bool(minimize(cost, cost.start, method="Nelder-Mead", bounds=CUBE, options=settings).success)


def _differential_evolution(cost: UnitCube) -> bool:
    settings: dict[str, Any] = {"popsize": 10, "atol": 1e-10, "tol": 1e-8, "maxiter": 10**6, "polish": False}
    return bool(differential_evolution(cost, CUBE, x0=cost.start, rng=np.random.default_rng(SEED), **settings).success)


def _dual_annealing(cost: UnitCube) -> bool:
    dual_annealing(cost, CUBE, x0=cost.start, maxiter=10**6, maxfun=10**9, rng=np.random.default_rng(SEED))
    return True


def _particle_swarm(cost: UnitCube) -> bool:
    """Kennedy and Eberhart's swarm with Clerc and Kennedy's constants; it has converged where the best cost stands still."""
    with tempfile.TemporaryDirectory() as folder, chdir(folder):  # the package writes a log file where it is imported
        import pyswarms

        np.random.seed(SEED)
        first = np.vstack([cost.start, np.random.random((19, len(FREE)))])
        swarm = pyswarms.single.GlobalBestPSO(
            20,
            len(FREE),
            {"c1": 1.49618, "c2": 1.49618, "w": 0.7298},
            bounds=(np.zeros(len(FREE)), np.ones(len(FREE))),
            bh_strategy="nearest",
            ftol=1e-10,
            ftol_iter=20,
            init_pos=first,
        )
        swarm.optimize(lambda points: np.array([cost(x) for x in points]), 10**6, verbose=False)
    return True


WITHOUT_DERIVATIVES: dict[str, tuple[str, Callable[[UnitCube], bool]]] = {
    "nelder-mead": ("local", _nelder_mead),
    "differential-evolution": ("whole range", _differential_evolution),
    "dual-annealing": ("whole range", _dual_annealing),
    "particle-swarm": ("whole range", _particle_swarm),
}
"""RaPId's methods that the package does without: where each searches, and the run, which returns whether it converged."""


def one(name: str, budget: int) -> dict[str, Any]:
    """Return status, evaluations, cost and CPU seconds of the named method alone, without refinement."""
    begun = time.process_time()
    if name in WITHOUT_DERIVATIVES:
        kind, run_of = WITHOUT_DERIVATIVES[name]
        cost = UnitCube(budget)
        try:
            status = "converged" if run_of(cost) else "stopped"
        except BudgetSpentError:
            status = "max-evaluations"
        found: dict[str, Any] = {"kind": kind, "status": status, "evaluations": cost.evaluations, "cost": cost.cost}
    else:
        run = replace(optimiser(name), max_evaluations=budget).run(problem(), problem().start)
        found = {"kind": "local", "status": run.status, "evaluations": run.evaluations, "cost": run.cost}
    return {**found, "seconds": time.process_time() - begun}


def main(names: list[str] | None = None, budget: int = 5000) -> dict[str, Any]:
    """Return effort and result by method; `best` is the cost of the package's multistart, `above` the cost beyond it."""
    problem().residual(problem().start)
    problem().cost(problem().start)  # both kinds of machine code are made before the clock runs
    best = fit(problem(), starts=8, assess=False)
    table = {n: one(n, budget) for n in (names or [*catalogue(), *WITHOUT_DERIVATIVES])}
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
