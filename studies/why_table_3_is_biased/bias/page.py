"""The tables of the diagnoses and of the other causes, and the figure."""

from __future__ import annotations

from collections.abc import Mapping
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
        "gains": _gains(values["put in"]),
        "causes": _causes(values["causes"]),
    }


def _verdicts(told: Mapping[str, Any], louder: Mapping[str, Any]) -> str:
    cases = {
        f"{signals}; {noise}": found
        for signals, t in told.items()
        for noise, found in {f"{diagnosed.NOISE:g}": t, **louder.get(signals, {})}.items()
    }
    return diagnosing.findings(cases, "recorded; noise, pu")


def _gains(told: Mapping[str, Any]) -> str:
    head = ["", *diagnosed.FREE, *(f"bias removed of {n}, %" for n in diagnosed.FREE)]
    none = ["-"] * len(diagnosed.FREE)
    rows = [
        ["Table I", *(number(paper.TABLE_1[n]) for n in diagnosed.FREE), *none],
        ["the paper, Table III", *(number(paper.TABLE_3[n]["II"]["mean"]) for n in diagnosed.FREE), *none],
    ]
    for signals, t in told.items():
        gone = diagnosed.share_gone(t)
        rows.append([f"plain link: {signals}", *(number(t["refitted"][n]) for n in diagnosed.FREE), *none])
        rows.append(
            [
                "the same, with the effects found",
                *(number(t["augmented"][n]) for n in diagnosed.FREE),
                *(number(100 * gone[n], 3) for n in diagnosed.FREE),
            ]
        )
    return markdown(head, rows)


def _causes(found: Mapping[str, Any]) -> str:
    """Return the table of scores and individually fitted gains by cause, the nearest to the paper's means first."""
    scored = {name: hypotheses.scores(v)["means"] for name, v in found.items()}
    gains = {name: v["mean"]["individual"] for name, v in found.items()}
    own = ["the paper", number(0.0), *(number(paper.TABLE_3[n]["II"]["mean"]) for n in diagnosed.FREE)]
    coarse = hypotheses.coarse_solver()
    rows = [
        own,
        *(
            [n, number(scored[n], 3), *(number(gains[n][g]) for g in diagnosed.FREE)]
            for n in sorted(scored, key=lambda n: scored[n])
        ),
        [
            "implicit Euler at 3 ms in the identification (linear chain)",
            "-",
            *(number(coarse[g]) for g in diagnosed.FREE),
        ],
    ]
    return markdown(["cause in the waveforms", "twelve means, % of range", *diagnosed.FREE], rows)


def draw(values: Mapping[str, Any]) -> Any:
    """Draw the gains (left) and Fig. 8 (right) before and after the diagnosis."""
    from hvdc_ident.report.drawing import figure

    left, right = (fig := figure(12, 4.2)).subplots(1, 2)
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
    axes.margins(y=0.6)  # room for the legend
    axes.legend(fontsize=8, loc="lower left")


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
