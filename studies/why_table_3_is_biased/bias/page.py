"""The tables of the diagnoses and of the other causes, and the figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from common import diagnosing, paper
from common.ending import markdown, number

from bias import diagnosed, hypotheses

COLOURS = ("#1f5fa8", "#3a9d5d", "#a03a8c")
"""Of the augmented links, by what was asked."""


def tables(values: Mapping[str, Any]) -> dict[str, str]:
    """Return the README's tables by name."""
    told = values["told nothing"] | values["finer"]
    return {
        "verdicts": _verdicts(told, values["louder"]),
        "places": "\n\n".join(f"{signals}:\n\n{_places(t)}" for signals, t in told.items()),
        "gains": _gains(values["put in"]),
        "figure-8": _figure_8(values["figure 8"]),
        "causes": _causes(values["causes"]),
        "means": _means(values["causes"]),
    }


def _verdicts(told: Mapping[str, Any], louder: Mapping[str, Any]) -> str:
    head = [
        "recorded",
        "noise, pu",
        "verdict",
        "inserted effects",
        "their delay, ms",
        "equivalents",
        "held-out gap: given, refitted, with them",
        "improvement, %",
    ]
    rows = []
    for signals, t in told.items():
        for noise, found in {f"{diagnosed.NOISE:g}": t, **louder.get(signals, {})}.items():
            delay = diagnosed.delay(diagnosed.sized(found))
            rows.append(
                [
                    signals,
                    noise,
                    found["verdict"],
                    diagnosing.effects_of(found),
                    number(1e3 * delay, 3) if found["effects"] else "-",
                    str(sum(len(g) - 1 for g in found["ambiguity"])),
                    ", ".join(number(found["pooled"][m]["holdout"], 3) for m in ("nominal", "refitted", "augmented")),
                    number(None if found["shrink_holdout"] is None else 100 * found["shrink_holdout"], 3),
                ]
            )
    return markdown(head, rows)


def _places(t: Mapping[str, Any]) -> str:
    """Return the table of the best effects of the first round, before any is in the model."""
    best = t["first round"][0]["delta_bic"]
    rows = [
        [diagnosing.label(c), number(c["delta_bic"] - best, 3), number(c["holdout"], 4)] for c in t["first round"][:8]
    ]
    return markdown(["first round", "delta BIC to the best", "held-out gap, noise units"], rows)


def _gains(told: Mapping[str, Any]) -> str:
    head = ["", "Table I", "paper, Table III"]
    columns = []
    for signals, t in told.items():
        head += [f"plain link: {signals}", f"with {diagnosing.effects_of(t)}", "bias removed, %"]
        columns.append((t, diagnosed.share_gone(t)))
    rows = [
        [
            n,
            number(paper.TABLE_1[n]),
            number(paper.TABLE_3[n]["II"]["mean"]),
            *(
                x
                for t, gone in columns
                for x in (number(t["refitted"][n]), number(t["augmented"][n]), number(100 * gone[n], 3))
            ),
        ]
        for n in diagnosed.FREE
    ]
    return markdown(head, rows)


def _figure_8(lines: Mapping[str, Any]) -> str:
    at = ("550", "650", "700", "725", "750", "775", "800", "850", "950")
    rows = [
        [f"{signals}: {name}", *(number(1e3 * line[k], 3) for k in at)]
        for signals, by in lines.items()
        for name, line in by.items()
    ]
    return markdown(["RMSE of Irorder1, 1e-3 pu, at KIVDC", *at], rows)


def _causes(found: Mapping[str, Any]) -> str:
    """Return the table of scores by cause, the nearest to the paper's means first."""
    scored = {name: hypotheses.scores(v) for name, v in found.items()}
    names = sorted(scored, key=lambda n: scored[n]["means"])
    keys = ("means", "spreads", "ratios", "figure 8")
    head = [
        "cause in the waveforms",
        "twelve means, % of range",
        "spreads, decades",
        "RMSE fitted/test, decades",
        "Fig. 8, decades",
    ]
    return markdown(head, [[n, *(number(scored[n][k], 3) for k in keys)] for n in names])


def _means(found: Mapping[str, Any]) -> str:
    head = ["cause in the waveforms", *(f"{n} {label}" for n in paper.GAINS for label in paper.MODES)]
    theirs = [number(paper.TABLE_3[n][label]["mean"]) for n in paper.GAINS for label in paper.MODES]
    rows = [["the paper", *theirs]]
    for name, v in found.items():
        rows.append([name, *(number(v["mean"][m][n]) for n in paper.GAINS for m in paper.MODES.values())])
    coarse = hypotheses.coarse_solver()
    dash = [number(coarse[n]) if n in coarse and label == "II" else "-" for n in paper.GAINS for label in paper.MODES]
    return markdown(head, [*rows, ["implicit Euler at 3 ms in the identification (linear chain)", *dash]])


def draw(values: Mapping[str, Any], by_case: Mapping[str, Mapping[str, float]], gains: Sequence[str]) -> Any:
    """Draw the bias of each gain by part switched off (left), and the gains and Fig. 8 before and after the diagnosis (right)."""
    from hvdc_ident.report.drawing import figure

    fig = figure(13, 9)
    upper, lower = fig.subfigures(2, 1, height_ratios=[3, 2])
    places = np.arange(len(by_case))
    grid = upper.subplots(1, 3, sharey=True)
    for axes, n in zip(grid, gains, strict=True):
        bias = [100 * (v[n] / paper.TABLE_1[n] - 1) for v in by_case.values()]
        axes.barh(places, bias, color=["#1f5fa8" if b > 0 else "#9cc3e6" for b in bias])
        paper_s = 100 * (paper.TABLE_3[n]["II"]["mean"] / paper.TABLE_1[n] - 1)
        axes.axvline(paper_s, color="#d08020", label="the paper (Table III)")
        axes.axvline(0, color="black", lw=0.8)
        axes.set(xlabel=f"bias of {n}, %", yticks=places, yticklabels=list(by_case))
        axes.tick_params(axis="y", labelsize=8)
    grid[0].invert_yaxis()
    grid[0].legend(fontsize=8, loc="lower right")
    left, right = lower.subplots(1, 2)
    _bias(left, values["put in"])
    _curves(right, values["figure 8"])
    return fig


def _bias(axes: Any, told: Mapping[str, Any]) -> None:
    first = next(iter(told.values()))
    series = {"the paper": {n: paper.TABLE_3[n]["II"]["mean"] for n in diagnosed.FREE}, "plain link": first["refitted"]}
    series |= {f"augmented: {signals}": t["augmented"] for signals, t in told.items()}
    width = 0.8 / len(series)
    for k, ((name, gains), colour) in enumerate(zip(series.items(), ("#d08020", "#888888", *COLOURS), strict=True)):
        bias = [100 * (gains[n] / paper.TABLE_1[n] - 1) for n in diagnosed.FREE]
        axes.bar(np.arange(len(bias)) + k * width, bias, width, label=name, color=colour)
    axes.axhline(0, color="black", lw=0.8)
    axes.set(ylabel="off Table I, %")
    axes.set_xticks(np.arange(len(diagnosed.FREE)) + (len(series) - 1) / 2 * width, diagnosed.FREE)
    axes.margins(y=0.5)  # room for the legend
    axes.legend(fontsize=8, loc="upper left")


def _curves(axes: Any, lines: Mapping[str, Any]) -> None:
    plain = next(iter(lines.values()))["plain link"]
    axes.plot([float(k) for k in plain], [1e3 * v for v in plain.values()], color="#888888", label="plain link")
    for (signals, by), colour in zip(lines.items(), COLOURS, strict=True):
        line = by["augmented link"]
        axes.plot(
            [float(k) for k in line], [1e3 * v for v in line.values()], color=colour, label=f"augmented: {signals}"
        )
    theirs = hypotheses.PAPER_8
    axes.plot(list(theirs), [1e3 * v for v in theirs.values()], "o", color="#d08020", label="the paper")
    axes.axvline(paper.TABLE_1["KIVDC"], color="black", lw=0.8, ls=":")
    axes.set(xlabel="KIVDC", ylabel="RMSE of Irorder1, 1e-3 pu")
    axes.legend(fontsize=8)
