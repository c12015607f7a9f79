"""The waveforms of every experiment, one figure for each output that shows more than its noise."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np

from hvdc_ident.data import Array, recording_lines
from hvdc_ident.report.html import Section, text
from hvdc_ident.report.overlay import Overlay, Sheet, overlay_of
from hvdc_ident.summary import Results
from hvdc_ident.text import listed

FIGURES = 60
CHANCE = 0.01
"""Chance that a record of nothing but Gaussian noise is drawn all the same."""


def _render(results: Results) -> str:
    drawn: list[str] = []
    quiet: list[str] = []
    sheet, more = Sheet.new(), False
    for name in results.experiments:
        for output in results.outputs_of(name):
            overlay = overlay_of(results, name, output)
            if overlay is None:
                continue
            if _only_noise(results, overlay):
                quiet.append(f"{output} in {name}")
            elif len(drawn) < FIGURES:
                drawn.append(overlay.figure(sheet, _caption(results, overlay)))
            else:
                more = True
    if not drawn and not quiet:
        return ""
    parts = ["<p>Above, recorded and simulated; below, recorded less simulated. A dotted line marks the event.</p>"]
    parts += [f"<div class='pair'>{''.join(drawn)}</div>"]
    parts += (
        [f"<p class='small'>Not drawn, for they show nothing but noise: {text(listed(quiet))}.</p>"] if quiet else []
    )
    parts += (
        [f"<p>Only the first {FIGURES} waveforms are drawn; the CSV files beside this page hold all.</p>"]
        if more
        else []
    )
    return "".join(parts) + _recordings(results)


def _caption(results: Results, overlay: Overlay) -> str:
    about = results.experiments.get(overlay.experiment)
    role = ", held out: not used by the fit" if about is not None and about.role == "holdout" else ""
    return f"{text(overlay.output)} in {text(overlay.experiment)}{role}."


def _recordings(results: Results) -> str:
    """What was noticed about the files, each remark once with the recordings that it is about."""
    remarks: dict[str, list[str]] = {}
    for name, about in results.experiments.items():
        for line in recording_lines(about.recording) if about.recording else ():
            remarks.setdefault(str(line), []).append(name)
    every = len(results.experiments)
    lines = [
        f"<li>{'Every recording' if len(names) == every and every > 1 else text(listed(names))}: {text(line)}.</li>"
        for line, names in remarks.items()
    ]
    return f"<ul class='small'>{''.join(lines)}</ul>" if lines else ""


def _only_noise(results: Results, overlay: Overlay) -> bool:
    """True where neither the recording, about its mean, nor any run's error has a sample that noise does not explain."""
    std = results.noise(overlay.experiment, overlay.output)
    if std is None:
        return False
    record = overlay.record[f"{overlay.output}.measured"]
    shown = [record - np.nanmean(record), *(overlay.error(n) for n in overlay.runs)]
    return all(_within(values, std) for values in shown)


def _within(values: Array, std: float) -> bool:
    """True where so many samples of Gaussian noise would hardly ever go farther, and where their power is not above the noise's.

    The largest of n samples is below the quantile 1 - CHANCE/(2n) with the probability 1 - CHANCE (Bonferroni); their mean
    square has the standard deviation sqrt(2/n).
    """
    known = values[np.isfinite(values)]
    if known.size == 0:
        return True
    farthest = NormalDist().inv_cdf(1.0 - 0.5 * CHANCE / known.size)
    spread = NormalDist().inv_cdf(1.0 - CHANCE) * np.sqrt(2.0 / known.size)
    return bool(np.abs(known).max() <= farthest * std and np.mean(known**2) <= (1.0 + spread) * std**2)


SECTION = Section(
    order=40,
    title="Waveforms",
    about="Every recorded signal with the model's runs laid over it.",
    render=_render,
)
