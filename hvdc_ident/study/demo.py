"""The demonstration: the phasor link calibrated on waveforms of the average-value link, which has physics it lacks.

The whole chain of the paper, and what it leaves open: errors and poles along KIVDC, what the recordings tell about each
gain, the fit, and what is missing from the model.
"""

from __future__ import annotations

from pathlib import Path

from hvdc_ident.executor import Progress
from hvdc_ident.files import write_text
from hvdc_ident.study.stage import silent
from hvdc_ident.study.waveforms import Campaign, write_waveforms

QUESTIONS = """
[linearize]
inputs = ["Vdcref1", "Pref2"]
outputs = ["Irorder1", "Irorder2"]

# Figs. 8 and 9 of the paper: the error is flat in KIVDC, and yet it is identified.
[[sweep]]
parameter = "KIVDC"
min = 250
max = 1500
points = 51
want = ["rmse", "poles"]

# What the phasor link lacks beside these recordings. Three effects and one at most, to be quick: without these two lines
# the whole catalogue is tried, and up to three effects beside each other.
[diagnose]
effects = ["lag", "delay", "second-order"]
most = 1
"""


def write_demo(folder: Path, *, seed: int = 0, progress: Progress = silent) -> Path:
    """The path of the study, once it and its data are in the folder. Raises InputError where another study is there.

    Three experiments each of P, Q and Vdc, two steps and a ramp, the last of each held out.
    """
    campaign = Campaign(name="demo", count=3, holdout=1, sample=1e-3, seed=seed)
    study = write_waveforms(folder, campaign, progress=progress)
    write_text(study, study.read_text("utf-8") + QUESTIONS)
    return study
