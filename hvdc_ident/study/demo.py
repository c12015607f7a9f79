"""The demonstration: the shipped link calibrated on waveforms of a link that lags, and what the missing lag does."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hvdc_ident.errors import InputError
from hvdc_ident.experiment import InputSignal, experiment
from hvdc_ident.files import write_text
from hvdc_ident.model.definition import Model
from hvdc_ident.models import load_model
from hvdc_ident.simulate import simulate
from hvdc_ident.study.stage import Progress, silent
from hvdc_ident.study.tables import csv_text

EVENT = 0.1  # s
END = 0.9  # s
SAMPLE = 5e-4  # s
NOISE = 1e-4  # pu, standard deviation
LAG = 0.0016  # s
OUTPUTS = ("Irorder1", "Irorder2", "Iiorder1")
RAMP = 0.3  # s
FIRST_LINE = "# The demonstration of hvdc-ident."

STEPS = {
    "vdc-step": ("Vdcref1", InputSignal.step(EVENT, 1.0, 1.019)),
    "vdc-ramp": ("Vdcref1", InputSignal.ramp(EVENT, 1.0, EVENT + RAMP, 1.019)),
    "p-step": ("Pref2", InputSignal.step(EVENT, 0.4, 0.5)),
    "p-ramp": ("Pref2", InputSignal.ramp(EVENT, 0.4, EVENT + RAMP, 0.5)),
    "q-step": ("Qref1", InputSignal.step(EVENT, 0.0, 0.1)),
}

STUDY = f"""{FIRST_LINE}
# The recordings come from the link with a lag of {LAG * 1e3:g} ms on all four currents and noise of {NOISE:g} pu.
# The model fitted here has no such lag: watch the gains make up for it. True: KIP 30, KPVDC 24, KIVDC 734.7, KIQ 30.
schema = 1
name = "demo"

[model]
source = "vsc-hvdc-link"

[parameters]
KIP = {{start = 25, min = 5, max = 50}}
KPVDC = {{start = 20, min = 10, max = 40}}
KIVDC = {{start = 750, min = 550, max = 950}}
KIQ = {{start = 25, min = 10, max = 50}}

[fit]
"""


def write_demo(folder: Path, *, seed: int = 0, progress: Progress = silent) -> Path:
    """The path of the study, once it and its data are in the folder. Raises InputError where another study is there."""
    path = folder / "study.toml"
    if path.exists() and FIRST_LINE not in path.read_text(encoding="utf-8", errors="replace")[:200]:
        raise InputError("another study is in the folder", where=str(path), hint="--out with a folder of its own")
    model = load_model("vsc-hvdc-link").with_effects(
        [{"effect": "lag", "at": ["Ir1", "Ii1", "Ir2", "Ii2"], "parameters": {"T": LAG}}]
    )
    random = np.random.default_rng(seed)
    tables = {}
    for done, (name, (moved, signal)) in enumerate(STEPS.items()):
        progress(done, len(STEPS), f"recording '{name}'")
        tables[name] = recording(model, name, moved, signal, OUTPUTS, random)
    for name, table in tables.items():
        write_text(folder / f"{name}.csv", table)
    return write_text(path, STUDY + "".join(_lines(name, moved) for name, (moved, _) in STEPS.items()))


def recording(
    model: Model, name: str, moved: str, signal: InputSignal, outputs: tuple[str, ...], random: np.random.Generator
) -> str:
    """CSV text of an experiment on the model: time, the input that moved, and the outputs with noise."""
    time = np.round(np.arange(round(END / SAMPLE) + 1) * SAMPLE, 9)
    run = simulate(model, experiment(name, time, {moved: signal})).trajectory
    noisy = [run[o] + NOISE * random.standard_normal(time.size) for o in outputs]
    columns = [time.tolist(), signal(time).tolist(), *(np.round(c, 8).tolist() for c in noisy)]
    return csv_text(["time", moved, *outputs], [list(row) for row in zip(*columns, strict=True)])


def _lines(name: str, moved: str) -> str:
    outputs = ", ".join(f'"{o}"' for o in OUTPUTS)
    signals = f'inputs = ["{moved}"]\noutputs = [{outputs}]'
    return f'\n[[experiment]]\nname = "{name}"\ndata = "{name}.csv"\n{signals}\nevent = {EVENT}\n'
