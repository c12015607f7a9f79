"""Fig. 6: histograms of the gains from 30 experiments of each controller, fitted one by one.

python studies/figure_6/run.py [--quick] [--pin]
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
from common import ending, paper  # noqa: E402
from common.ending import interval, markdown, number  # noqa: E402

BINS = 10
ORDER = ("KIP", "KPP", "KIQ", "KPQ", "KPVDC", "KIVDC")
WHY = {
    "KIP": "no noise here: the scatter comes from the reference model",
    "KPP": "the same",
    "KIQ": "not reproduced (Table III)",
    "KPQ": "not reproduced (Table III)",
    "KPVDC": "two peaks here, steps and ramps; the mean depends on their proportion",
    "KIVDC": "steps and ramps agree; the paper's is higher, as is ours from other operating points (Table III)",
}


def main(count: int = 30) -> dict[str, Any]:
    """Return the estimates by gain and shape of the experiment."""
    found = paper.individual(paper.recordings(count))
    values = paper.values_of(found)
    names = {n: list(found[n]["experiments"]) for n in ORDER}
    return {
        n: {s: [v for v, e in zip(values[n], names[n], strict=True) if e.endswith(s)] for s in ("step", "ramp")}
        for n in ORDER
    }


def tables(values: Mapping[str, Any]) -> dict[str, str]:
    """Return the README's table."""
    rows = []
    for n in ORDER:
        steps, ramps = (np.array(values[n][s]) for s in ("step", "ramp"))
        both = np.concatenate([steps, ramps])
        theirs = paper.TABLE_3[n]["II"]
        rows.append(
            [
                n,
                number(paper.TABLE_1[n]),
                f"{number(theirs['mean'])} ± {number(theirs['std'], 2)}",
                plus(both),
                interval([both.min(), both.max()]),
                plus(steps),
                plus(ramps),
                WHY[n],
            ]
        )
    head = ["gain", "true", "paper", "here", "from, to", "15 steps", "15 ramps", "why they differ"]
    return {"histograms": markdown(head, rows)}


def plus(values: Any) -> str:
    """Return mean and std as text."""
    return f"{number(values.mean())} ± {number(values.std(ddof=1), 2)}"


def draw(values: Mapping[str, Any]) -> Any:
    """Draw six histograms, steps and ramps stacked; the titles give Table I's value and the paper's mean, outside the axes."""
    from hvdc_ident.report.drawing import figure

    fig = figure(11, 5.5)
    grid = fig.subplots(2, 3)
    for axes, n in zip(grid.flat, ORDER, strict=True):
        parts = [values[n]["step"], values[n]["ramp"]]
        axes.hist(parts, bins=BINS, stacked=True, color=["#1f5fa8", "#9cc3e6"], label=["steps", "ramps"])
        both = np.concatenate(parts)
        room = 0.15 * np.ptp(both)
        theirs = paper.TABLE_3[n]["II"]["mean"]
        axes.set(
            xlim=(both.min() - room, both.max() + room),
            xlabel=n,
            title=f"Table I {number(paper.TABLE_1[n])}, the paper's mean {number(theirs)}",
        )
        axes.title.set_fontsize(9)
        axes.locator_params(axis="x", nbins=5)
        axes.ticklabel_format(axis="x", useOffset=False)
        axes.tick_params(axis="x", labelsize=8)
    for axes in grid[:, 0]:
        axes.set_ylabel("experiments")
    fig.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    return fig


if __name__ == "__main__":
    args = ending.arguments(__doc__, quick="4 experiments instead of 30")
    found = main(4 if args.quick else 30)
    sys.exit(ending.ended(HERE, found, tables, draw, pin=args.pin, whole=not args.quick))
