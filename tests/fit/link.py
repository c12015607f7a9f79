"""The shipped link as a plant: records without noise from known gains, for fits of the same model."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from hvdc_ident import load_model, simulate
from hvdc_ident.data import Experiment, InputSignal, experiment, trajectory
from hvdc_ident.simulate import ModelSimulator

TRUTH = {"KIP": 30.0, "KPP": 0.0, "KIQ": 30.0, "KPQ": 0.0, "KPVDC": 24.0, "KIVDC": 734.7}
TIME = np.round(np.arange(0, 0.6001, 2e-3), 9)
STEPS = {"Pref2": (0.4, 0.5), "Qref1": (0.0, 0.1), "Vdcref1": (1.0, 1.019)}
OUTPUTS = ("Irorder1", "Irorder2", "Iiorder1")


@cache
def link() -> ModelSimulator:
    """The link's simulator; one for all tests, so that its code is made once."""
    return ModelSimulator(load_model("vsc-hvdc-link"))


def step(
    setpoint: str, outputs: tuple[str, ...] = OUTPUTS, noise: float = 0.0, seed: int = 0, **rest: Any
) -> Experiment:
    """A step of a set-point, recorded with the true gains; `hidden` are changes of the run that the record does not tell.

    hidden: fields of the experiment, such as offsets. values: parameters other than the truth.
    """
    hidden = rest.pop("hidden", {})
    values = {**TRUTH, **rest.pop("truth", {})}
    before, after = STEPS[setpoint]
    asked = experiment(f"step of {setpoint}", TIME, {setpoint: InputSignal.step(0.1, before, after)}, event=0.1, **rest)
    plain = asked.with_(nuisance=(), role="fit", **hidden)
    run = simulate(link().model, plain, values, outputs=outputs).trajectory
    random = np.random.default_rng(seed)
    seen = {o: run[o] + noise * random.standard_normal(TIME.size) for o in outputs}
    return asked.with_(measured=trajectory(TIME, seen), noise=dict.fromkeys(outputs, noise) if noise else {})
