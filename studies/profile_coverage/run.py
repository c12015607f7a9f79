"""Coverage of the 95 % profile likelihood interval: 2000 noisy records of the link, two gains fitted to each.

python studies/profile_coverage/run.py [--runs 2000] [--workers 2]
"""

from __future__ import annotations

import argparse
import json
import time
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from scipy.stats import binom

from hvdc_ident import load_model, simulate
from hvdc_ident.data import InputSignal, experiment, trajectory
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.fit.profile import profiles
from hvdc_ident.identifiability.likelihood_intervals import thresholds
from hvdc_ident.identifiability.pilot_fit import pilot_fit
from hvdc_ident.simulate import ModelSimulator

TRUE = {"KPVDC": 24.0, "KIVDC": 734.7}
FREE = (FitParameter("KPVDC", 20, 10, 40), FitParameter("KIVDC", 750, 550, 950))
NOISE = 1e-2  # pu: intervals of several per cent, so that the problem is not linear over their width
TIME = np.round(np.arange(0, 0.4001, 1e-3), 9)


@cache
def plant():
    """Return the link, and the noise-free record of a step of the dc voltage set-point."""
    model = load_model("vsc-hvdc-link")
    asked = experiment("step", TIME, {"Vdcref1": InputSignal.step(0.05, 1.0, 1.019)}, event=0.05)
    return ModelSimulator(model), asked, simulate(model, asked).trajectory["Irorder1"]


def one(seed: int) -> dict[str, tuple[float, float, float]]:
    """Return the estimate and its interval by parameter, from the record with this seed's noise."""
    simulator, asked, clean = plant()
    noisy = clean + NOISE * np.random.default_rng(seed).standard_normal(clean.size)
    data = asked.with_(measured=trajectory(TIME, {"Irorder1": noisy}), noise={"Irorder1": NOISE})
    optimum, _ = pilot_fit(Problem(simulator, (data,), FREE), starts=1)
    found = profiles(optimum.problem, optimum.theta, threshold=thresholds(optimum))
    ends = {}
    for n, p in found.by_name.items():
        low, high = p.ci95
        ends[n] = (p.value, -np.inf if low is None else low, np.inf if high is None else high)
    return ends


def main(runs: int, workers: int) -> dict:
    """Return the coverage by parameter with its binomial 95 % range, and the mean half-width."""
    begun = time.monotonic()
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        rows = list(pool.map(one, range(runs), chunksize=20))
    table = {}
    for n, truth in TRUE.items():
        hits = [row[n][1] <= truth <= row[n][2] for row in rows]
        half = [0.5 * (row[n][2] - row[n][1]) for row in rows]
        table[n] = {
            "coverage": float(np.mean(hits)),
            "open": int(np.isinf(half).sum()),
            "median_half_width": float(np.median(half)),
            "half_width_of_value": float(np.median(half) / truth),
        }
    low, high = (binom.ppf([0.025, 0.975], runs, 0.95) / runs).tolist()
    return {"runs": runs, "chance": [low, high], "parameters": table, "seconds": time.monotonic() - begun}


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=2000)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    result = main(options.runs, options.workers)
    for name, line in result["parameters"].items():
        width = f"median half-width {line['median_half_width']:.3g}, {line['open']} open"
        print(f"{name}: {100 * line['coverage']:.2f} % of {result['runs']}, {width}")
    print(f"{result['seconds']:.0f} s; by chance alone {result['chance'][0]:.4f} to {result['chance'][1]:.4f}")
    seconds = result.pop("seconds")
    if options.runs == 2000:
        (Path(__file__).parent / "expected.json").write_text(json.dumps(result, indent=1) + "\n")
