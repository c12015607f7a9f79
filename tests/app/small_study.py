"""A small study of a card of its own: a few rows, so that a run takes seconds."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

import hvdc_ident as hi

SECONDS = 120.0  # that a run may take on a busy machine before a test gives up
CARD = """\
schema = 1
name = "lag"
[parameters]
k = {value = 4.0, unit = "1/s", min = 0.001, max = 1000.0}
[inputs]
u = {value = 0.0}
[states]
x = {derivative = "k*(2.0*u - x)"}
[outputs]
y = {value = "x", unit = "MW"}
"""
STUDY = """\
schema = 1
name = "small"
[model]
source = "lag.toml"
[parameters]
k = {min = 0.5, max = 20}
[fit]
starts = 1
[diagnose]
effects = ["lag", "gain"]
most = 1
"""
LATE = 0.03
"""Time constant of the plant's sensor, s, which the card lacks."""


def write_small_study(folder: Path, late: float = LATE) -> Path:
    """A lag of 5 1/s, recorded late by another lag, twice with noise. late: time constant of that, s; 0: none."""
    time = np.arange(201) * 0.01
    random = np.random.default_rng(3)
    text = STUDY
    (folder / "lag.toml").write_text(CARD)
    missing = {"effect": "lag", "at": "u", "parameters": {"T": late}}
    plant = hi.apply_effects(hi.load_model(folder / "lag.toml"), [missing] if late else [])
    for name, to in (("up", 1.0), ("down", -0.5)):
        y = hi.simulate(plant, time, {"k": 5.0}, inputs={"u": hi.step(0.0, to, at=0.5)})["y"]
        rows = np.column_stack([time, np.where(time >= 0.5, to, 0.0), y + 0.005 * random.standard_normal(201)])
        np.savetxt(folder / f"{name}.csv", rows, delimiter=",", header="time,u,y", comments="")
        text += (
            f'[[experiment]]\nname = "{name}"\ndata = "{name}.csv"\ninputs = ["u"]\noutputs = ["y"]\nevent = 0.5\n'
            'interpolation = "hold"\nnoise = {y = 0.005}\n'
        )
    (folder / "study.toml").write_text(text)
    return folder / "study.toml"


def hold(study: Path) -> Path:
    """Make the model of a small study wait in the worker, at a pipe that nobody writes to; return the file that, removed, ends that."""
    held, pipe = study.parent / "hold", study.parent / "pipe"
    os.mkfifo(pipe)
    held.touch()
    (study.parent / "held.py").write_text(
        "import sys\nfrom pathlib import Path\nfrom hvdc_ident.models import load_model\n"
        'SUMMARY = "held"\n'
        "def model():\n"
        f"    if Path(sys.argv[0]).name == 'worker.py' and Path({str(held)!r}).exists():\n"
        f"        open({str(pipe)!r}).read()\n"
        f"    return load_model({str(study.parent / 'lag.toml')!r})\n"
    )
    study.write_text(study.read_text().replace("lag.toml", "held.py"))
    return held
