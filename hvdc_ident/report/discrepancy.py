"""Figures of a diagnosis: the gap of three models, and their frequency responses with the records'."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.report.drawing import AFTER, BEFORE, MARK, MEASURED, figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CHANNELS = 3
"""Channels that are drawn, those in which the record tells most frequencies: more would be too small to read."""


def gap_bars(pooled: Mapping[str, Mapping[str, Any]]) -> Figure:
    """The pooled residual of given gains, refitted and augmented model, on fitted and on held-out data."""
    fig = figure(7.4, 2.8, {"left": 0.1, "right": 0.99, "bottom": 0.1, "top": 0.97})
    axes = fig.subplots()
    names = [n for n in ("nominal", "refitted", "augmented") if n in pooled]
    for k, (part, label, colour) in enumerate((("fit", "fitted", AFTER), ("holdout", "held out", BEFORE))):
        values = [pooled[n].get(part) for n in names]
        axes.bar(
            np.arange(len(names)) + (k - 0.5) * 0.38, [v or np.nan for v in values], 0.38, label=label, color=colour
        )
    axes.axhline(1.0, color=MEASURED, linestyle=":", linewidth=1.0, label="noise")
    axes.set_yscale("log")
    axes.set_xticks(
        range(len(names)), [{"nominal": "given gains", "augmented": "with effect"}.get(n, n) for n in names]
    )
    axes.set_ylabel("residual, in noise units")
    axes.legend(fontsize="small")
    return fig


def hidden_curve(at: str, curve: Mapping[str, Any]) -> Figure:
    """Figure of the signal added at a slot, over time or over a signal, with its 95 % band where that is known."""
    fig = figure(7.4, 2.6, {"left": 0.12, "right": 0.98, "bottom": 0.2, "top": 0.97})
    axes = fig.subplots()
    x, y = np.array(curve["at"]), np.array(curve["value"])
    wide = 1.96 * np.array([np.nan if s is None else s for s in curve["std"]])
    axes.fill_between(x, y - wide, y + wide, color=AFTER, alpha=0.25, linewidth=0.0)
    axes.plot(x, y, color=AFTER, linewidth=1.4, marker=".", markersize=5)
    # A level that the records hardly visit has a band that would hide all others.
    known = y[np.isfinite(wide) & (wide < np.ptp(y))] if np.ptp(y) > 0 else y
    room = 0.3 * max(float(np.ptp(known)) if known.size else 0.0, 1e-12)
    if known.size:
        axes.set_ylim(float(known.min()) - room, float(known.max()) + room)
    axes.set_xlabel("time, s" if curve["over"] == "time" else str(curve["over"]))
    axes.set_ylabel(f"added to {at}")
    return fig


def bode(channels: Sequence[Mapping[str, Any]]) -> Figure:
    """Gain above phase over frequency for each channel, beside each other: the record, the nominal and the augmented model."""
    most = sorted((c for c in channels if c.get("omega")), key=lambda c: -len(c["omega"]))[:CHANNELS]
    shown = [c for c in channels if c in most]
    wide = 3.2 * max(len(shown), 1)
    edges = {"left": 0.62 / wide, "right": 1.0 - 0.1 / wide, "wspace": 0.2, "bottom": 0.11, "top": 0.93, "hspace": 0.08}
    fig = figure(wide, 4.6, edges)
    for k, c in enumerate(shown):
        above = fig.add_subplot(2, len(shown), k + 1)
        below = fig.add_subplot(2, len(shown), len(shown) + k + 1, sharex=above)
        _channel(above, below, c)
        if k == 0:
            above.legend(fontsize="small")
            for axes, label in ((above, "gain, dB"), (below, "phase, degrees")):
                axes.set_ylabel(label)
                axes.yaxis.set_label_coords(-0.17, 0.5)
    return fig


def _channel(above: Axes, below: Axes, c: Mapping[str, Any]) -> None:
    """Draw one channel's gain and phase."""
    looks = (("data", MEASURED, "record"), ("nominal", BEFORE, "refitted"), ("augmented", AFTER, "with effect"))
    f = np.array(c["omega"]) / (2 * np.pi)
    for key, colour, label in looks:
        if not c.get(key):
            continue
        h = np.array(c[key])[:, 0] + 1j * np.array(c[key])[:, 1]
        style: dict[str, Any] = (
            {"linestyle": "none", "marker": ".", "markersize": 4} if key == "data" else {"linewidth": 1.3}
        )
        keep = np.abs(h) > 0
        above.semilogx(f[keep], 20 * np.log10(np.abs(h[keep])), color=colour, label=label, **style)
        below.semilogx(f[keep], np.degrees(np.unwrap(np.angle(h[keep]))), color=colour, **style)
    above.set_title(f"{c['input']} to {c['output']}", fontsize="small")
    above.tick_params(labelbottom=False)
    below.set_xlabel("frequency, Hz")
    for axes in (above, below):
        axes.grid(True, color=MARK, alpha=0.3)
        axes.tick_params(labelsize=7)
        axes.minorticks_off()  # over three decades nobody reads them, and they take half of the time to draw
