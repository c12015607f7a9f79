"""Figures of a diagnosis: the gap before and after, and the candidates; they compute nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from hvdc_ident.discrepancy.findings.result import Diagnosis

SHOWN = 10


def overview(diagnosis: Diagnosis) -> Figure:
    """The pooled gap of the three models on fitted and held-out data, and the BIC of the best candidates."""
    from matplotlib.figure import Figure

    fig = Figure(figsize=(10.0, 4.2), layout="constrained")
    left, right = fig.subplots(1, 2, width_ratios=[1.0, 1.4])
    names = ["nominal", "refitted", "augmented"]
    width = 0.38
    for k, (part, label) in enumerate((("fit", "fitted"), ("holdout", "held out"))):
        values = [diagnosis.gap.pooled[n][part] for n in names]
        at = np.arange(3) + (k - 0.5) * width
        left.bar(at, [np.nan if v is None else v for v in values], width, label=label, color=("#1f5fa8", "#d08020")[k])
    left.axhline(1.0, color="#222222", linewidth=1.0, linestyle=":", label="noise")
    left.set_yscale("log")
    left.set_xticks(range(3), ["given gains", "refitted", "with effect"])
    left.set_ylabel("residual in noise units")
    left.legend(fontsize="small")
    refitted = [c for c in diagnosis.candidates if c.delta_bic is not None and c.round == 1]
    best = sorted(refitted, key=lambda c: -(c.delta_bic or 0.0))[:SHOWN][::-1]
    if best:
        right.barh(range(len(best)), [c.delta_bic or 0.0 for c in best], color="#1f5fa8")
        labels = [f"{c.effect} at {', '.join(c.at)}" + (f" from {c.source}" if c.source else "") for c in best]
        right.set_yticks(range(len(best)), labels, fontsize="small")
        right.set_xlabel("gain in BIC over the refitted model")
    else:
        right.set_axis_off()
        right.text(0.5, 0.5, "no candidate was refitted", ha="center", va="center", transform=right.transAxes)
    fig.suptitle(
        f"{diagnosis.verdict}: {', '.join(e.text for e in diagnosis.effects) or diagnosis.text}",
        fontsize="medium",
        wrap=True,
    )
    return fig
