"""The demonstration: the phasor link calibrated on waveforms of the average-value link, which has physics it lacks."""

from __future__ import annotations

from pathlib import Path

from hvdc_ident.study.stage import Progress, silent
from hvdc_ident.study.waveforms import Campaign, write_waveforms


def write_demo(folder: Path, *, seed: int = 0, progress: Progress = silent) -> Path:
    """The path of the study, once it and its data are in the folder. Raises InputError where another study is there.

    Four experiments each of P, Q and Vdc, two steps and two ramps, the last of each held out.
    """
    return write_waveforms(folder, Campaign(name="demo", count=4, holdout=1, sample=1e-3, seed=seed), progress=progress)
