"""The study that `new` writes: every table explained, with data that runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.errors import InputError
from hvdc_ident.files import write_text
from hvdc_ident.models import load_model
from hvdc_ident.simulate import simulate
from hvdc_ident.study.tables import csv_text

NOISE = 1e-4  # pu, standard deviation
SIGNALS = {  # name of the recording: set-point of the dc voltage
    "step-up": InputSignal.step(0.1, 1.0, 1.019),
    "ramp": InputSignal.ramp(0.1, 1.0, 0.4, 1.019),
}

TEXT = """\
# A study: which model, which recordings, which questions. Check it with `hvdc-ident check study.toml`,
# run it with `hvdc-ident run study.toml`; the report is then study-results/report.html.
schema = 1
name = "my-study"

[model]
source = "vsc-hvdc-link"          # a shipped model (`hvdc-ident models`), or the path of a model card: "model.toml"
# parameterisation = "physical"   # the gains of the dc-voltage loop as J and Ts
# [model.values]                  # values that differ from the model's
# Zg = 0.02
# [[model.effect]]                # an effect the plant is known to have (`hvdc-ident effects`)
# effect = "lag"
# at = ["Ir1", "Ir2"]
# parameters = {T = 0.0016}

# What may be estimated: where to begin and where to look. All other parameters stay at the model's values.
# given = ... states the vendor's value; if left out, the model's. Results are compared with it, never with start.
[parameters]
KPVDC = {start = 20, min = 10, max = 40}
KIVDC = {start = 650, min = 550, max = 950}

# One table for each recording. The first column of the file is the time in s.
[[experiment]]
name = "step-up"
data = "step-up.csv"
inputs = ["Vdcref1"]              # or {Vdcref1 = "column name"}; inputs not named stay at the model's value
outputs = ["Irorder1"]            # or {Irorder1 = "column name"}
# noise = {Irorder1 = 1e-4}       # standard deviation; if left out, estimated before the event
# event = 0.1                     # s; if left out, found from the inputs
# window = [0.0, 0.8]             # s: what is compared; if left out, all of it
# values = {Pref2 = 0.5}          # inputs held at another value than the model's
# columns = {Irorder1 = {name = "I:REG:1", unit = "kA", scale = 5.54}}   # value in the model = scale x recorded
# nuisance = ["time-shift", "Pref2"]   # unknown in this recording alone: its clock's offset, an input's offset

[[experiment]]
name = "ramp"
data = "ramp.csv"
role = "holdout"                  # not used by the fit: it shows whether the estimates hold elsewhere
inputs = ["Vdcref1"]
outputs = ["Irorder1"]

# The questions. A stage runs where its table stands here.
[fit]
starts = 4                        # runs of the optimiser, from places spread over the bounds
# optimiser = "trust-region"      # or least-squares, l-bfgs-b, nelder-mead, differential-evolution, dual-annealing, ...
# loss = "huber"                  # outliers count less; whiten = true where samples are not independent
"""


def write_starter(folder: Path) -> Path:
    """The path of a commented study, once it and its data are in the folder. Raises InputError where one is there."""
    path = folder / "study.toml"
    for taken in (path, *(folder / f"{name}.csv" for name in SIGNALS)):
        if taken.exists():
            raise InputError("the folder already holds a file of this name", where=str(taken), hint="a new folder")
    random = np.random.default_rng(1)
    tables = {name: _recording(name, signal, random) for name, signal in SIGNALS.items()}
    for name, table in tables.items():
        write_text(folder / f"{name}.csv", table)
    return write_text(path, TEXT)


def _recording(name: str, signal: InputSignal, random: np.random.Generator) -> str:
    """CSV text: time, the set-point, and the order of the dc voltage control with noise."""
    time = np.round(np.arange(1801) * 5e-4, 9)
    run = simulate(load_model("vsc-hvdc-link"), experiment(name, time, {"Vdcref1": signal})).trajectory
    noisy = np.round(run["Irorder1"] + NOISE * random.standard_normal(time.size), 8)
    return csv_text(["time", "Vdcref1", "Irorder1"], np.column_stack([time, signal(time), noisy]).tolist())
