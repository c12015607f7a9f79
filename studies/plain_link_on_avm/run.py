"""The phasor link, which has no delay, fitted to single steps of the average-value link.

python studies/plain_link_on_avm/run.py
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from hvdc_ident.data import Experiment, InputSignal, experiment
from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.models import load_model
from hvdc_ident.simulate import ModelSimulator, simulate

HERE = Path(__file__).resolve().parent
EVENT, END, SAMPLE = 0.1, 0.9, 5e-4  # s

STEPS = {  # set-point, before, after, recorded output, gains fitted to it with the start and bounds of the search
    "vdc-step": ("Vdcref1", 1.0, 1.019, "Irorder1", {"KPVDC": (20, 5, 60), "KIVDC": (750, 100, 2000)}),
    "p-step": ("Pref2", 0.4, 0.5, "Irorder2", {"KIP": (25, 5, 60), "KPP": (0, 0, 2)}),
    "q-step": ("Qref1", 0.0, 0.1, "Iiorder1", {"KIQ": (25, 5, 60), "KPQ": (0, 0, 2)}),
}
CASES = {"with filters": "vsc-hvdc-avm", "without filters": "vsc-hvdc-avm-unfiltered"}


def recording(source: str, step: str) -> Experiment:
    """Return one step recorded on an average-value link: 0.9 s from steady state, every 0.5 ms, no noise."""
    moved, before, after, output, _ = STEPS[step]
    time = np.round(np.arange(round(END / SAMPLE) + 1) * SAMPLE, 9)
    plain = experiment(step, time, {moved: InputSignal.step(EVENT, before, after)}, event=EVENT)
    return plain.with_(measured=simulate(load_model(source), plain, outputs=[output]).trajectory)


def fitted(source: str) -> dict[str, float]:
    """Return the gains of the phasor link fitted to each step separately, and the RMSE of the output in pu."""
    simulator = ModelSimulator(load_model("vsc-hvdc-link"))
    found: dict[str, float] = {}
    for step, (_, _, _, output, gains) in STEPS.items():
        free = tuple(FitParameter(name, start, low, high) for name, (start, low, high) in gains.items())
        result = fit(Problem(simulator, (recording(source, step),), free), starts=3, seed=0)
        found |= {name: result.estimates[name].value for name in gains}
        found[f"rmse {output}"] = result.rmse[output][step] or 0.0
    return found


def main() -> dict[str, dict[str, float]]:
    """Return the fitted gains by case."""
    return {case: fitted(source) for case, source in CASES.items()}


if __name__ == "__main__":
    expected = json.loads((HERE / "expected.json").read_text(encoding="utf-8"))["gains"]
    for case, values in main().items():
        print(case)
        for name, value in values.items():
            known = expected[case].get(name)
            print(f"  {name:14s}{value:12.6g}" + (f"   expected {known:g}" if known else ""))
