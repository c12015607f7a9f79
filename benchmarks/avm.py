"""The average-value link: time to machine code and to one run, with and without sensitivities.

    python benchmarks/avm.py

1.2 s, steps of Pref2 and Vdcref1, 1201 points, rtol 1e-6. Times are the minimum of several runs on one core; a compile
counts everything from the model's definition to the first steady start.
"""

from __future__ import annotations

import time

import numpy as np

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.models import load_model
from hvdc_ident.simulate import Engine, simulate

GAINS = ("KPVDC", "KIVDC", "KPP", "KIP", "KPQ", "KIQ", "KPQ2", "KIQ2")
NAMES = ("vsc-hvdc-avm", "vsc-hvdc-avm-unfiltered", "vsc-hvdc-avm-authors")


def case(model):
    """1.2 s with steps of 10 % in power and 1.9 % in dc voltage."""
    power = model.inputs["Pref2"].value
    steps = {"Pref2": InputSignal.step(0.6, power, power - 0.1), "Vdcref1": InputSignal.step(0.1, 1.0, 1.019)}
    return experiment("steps", np.linspace(0.0, 1.2, 1201), steps)


def compiled(model, sensitivities):
    """Seconds from the model to its first steady start, with all the code a run needs, at best of three."""
    p = np.array(list(model.values.values()))
    u = np.array([i.value for i in model.inputs.values()])
    times = []
    for _ in range(3):
        start = time.perf_counter()
        code = Engine(model, sensitivities)
        code.start(p, u)
        if model.algebraic:  # the Rosenbrock method, whose own code is compiled with its first run
            code._state(rosenbrock=True)
        times.append(time.perf_counter() - start)
    return min(times)


def run(model, sensitivities):
    """Seconds of one run, at best of ten, and its statistics."""
    experiment_, times = case(model), []
    result = simulate(model, experiment_, None, sensitivities, rtol=1e-6)
    for _ in range(10):
        start = time.perf_counter()
        result = simulate(model, experiment_, None, sensitivities, rtol=1e-6)
        times.append(time.perf_counter() - start)
    return min(times), result.statistics


if __name__ == "__main__":
    simulate(load_model("vsc-hvdc-link"), experiment("warm", np.linspace(0.0, 0.1, 3)), None, ("KIP",))
    for name in NAMES:
        model = load_model(name)
        print(f"{name}: {len(model.states)} states, {len(model.algebraic)} unknowns")
        for label, parameters in (("states only", ()), ("8 sensitivities", GAINS)):
            seconds = compiled(model, parameters)
            took, how = run(model, parameters)
            print(
                f"  {label:16s} compile {seconds:5.2f} s, run {took * 1e3:6.1f} ms   {how.accepted} steps, {how.method}"
            )
