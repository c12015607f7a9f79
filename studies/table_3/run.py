"""Table III: 30 experiments for each controller, individually and simultaneously, and the meaning of the intervals.

python studies/table_3/run.py [--quick] [--workers N] [--pin]
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: threads on matrices this narrow only wait

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
from common import ending, paper  # noqa: E402
from common.ending import interval, markdown, number  # noqa: E402
from common.work import processes  # noqa: E402

from hvdc_ident.fit.partial_fits import half_width, spread  # noqa: E402

FULL, QUICK = 30, 4
STARTS = {n: start for n, (_, _, start, _) in paper.TABLE_2.items()}


def main(count: int = FULL, workers: int = 1) -> dict[str, Any]:
    """Return the estimates of every run by mode and gain; with all 30 also the other numbers of the README."""
    with processes(workers) as executor:
        paper.step("P", paper.LINK)  # the integrators are compiled once for an installation: not timed
        begun = time.perf_counter()
        experiments = paper.recordings(count)
        alone = paper.individual(experiments, executor=executor)
        all_six = paper.simultaneous(experiments, executor=executor)
        values: dict[str, Any] = {"individual": paper.values_of(alone), "simultaneous": paper.values_of(all_six)}
        print(
            f"3 x {count} individual and {count} simultaneous fits, waveforms included: "
            f"{time.perf_counter() - begun:.1f} s, {workers} process(es), load {os.getloadavg()[0]:.1f}\n"
        )
        if count < FULL:
            return values
        values["on a bound"] = {
            mode: {n: found[n]["on_bound"] for n in paper.GAINS}
            for mode, found in (("individual", alone), ("simultaneous", all_six))
        }
        values["std a run claims"] = {n: median_std(alone[n]) for n in paper.GAINS}
        values["together"] = paper.together(experiments)
        fewer = paper.without("Irorder1", "P", experiments)
        values["simultaneous, P experiments without Irorder1"] = statistics(
            paper.values_of(paper.simultaneous(fewer, executor=executor))
        )
        held = paper.individual(experiments, held=STARTS, executor=executor)
        values["individual, others at Table II's starts"] = statistics(paper.values_of(held))
        for what, choice in (
            ("other operating points", {"at_rest": False}),
            ("reference without filters", {"source": "vsc-hvdc-avm-unfiltered"}),
        ):
            others = paper.recordings(count, **choice)
            values[what] = {
                "individual": statistics(paper.values_of(paper.individual(others, executor=executor))),
                "simultaneous": statistics(paper.values_of(paper.simultaneous(others, executor=executor))),
            }
    return values


def median_std(row: Mapping[str, Any]) -> float | None:
    """Return the median of the standard deviations of the single fits."""
    known = [r["std"] for r in row["experiments"].values() if r["std"] is not None]
    return float(np.median(known)) if known else None


def statistics(values: Mapping[str, list[float]]) -> dict[str, dict[str, float]]:
    """Return mean and std by gain."""
    found = {n: spread(np.array(v)) for n, v in values.items()}
    return {n: {"mean": s["mean"], "std": s["std"]} for n, s in found.items()}


WHY = {
    (
        "KIVDC",
        "II",
    ): "both far above 734.7: the fit compensates for a delay. The amount depends on the steps and ramps, "
    "which the paper does not list; {elsewhere} from other operating points (last table)",
    (
        "KIVDC",
        "SI",
    ): "the same decrease and widening. Here the only cause is that Irorder1 is compared in the P experiments too",
    ("KPVDC", "II"): "steps give higher values than ramps (Fig. 6); the proportion is ours",
    ("KPVDC", "SI"): "here it decreases and widens with KIVDC; the paper's does not",
    ("KIP", "II"): "nearly the same delay; ours is the 1.46 ms of the measurement filters",
    ("KIP", "SI"): "here Irorder1 in the P experiments affects KIP too; the paper's does not change",
    ("KPP", "II"): "true value 0",
    ("KPP", "SI"): "0 in the paper; here on this bound in {on_bound} of {runs} runs",
    (
        "KIQ",
        "II",
    ): "not reproduced: the paper's is below 30 and scatters, ours behaves as KIP. Something in the paper's Q loop "
    "opposes the delay",
    ("KIQ", "SI"): "the same",
    ("KPQ", "II"): "true value 0",
    ("KPQ", "SI"): "not reproduced: the paper's 0.26 belongs to its KIQ",
}


def tables(values: Mapping[str, Any]) -> dict[str, str]:
    """Return the README's tables."""
    return {
        "table-iii": table_iii(values),
        "intervals": intervals(values),
        "variation": variation(values),
        "choices": choices(values),
    }


def table_iii(values: Mapping[str, Any]) -> str:
    """Return the table of mean, std, variance and interval of the mean, paper and here."""
    rows = []
    ends = paper.intervals_of_mean(values)
    for n in paper.GAINS:
        for label, mode in paper.MODES.items():
            theirs, here = paper.TABLE_3[n][label], spread(np.array(values[mode][n]))
            why = WHY[n, label].format(
                on_bound=values["on a bound"][mode][n],
                runs=len(values[mode][n]),
                elsewhere=number(values["other operating points"][mode][n]["mean"], 3),
            )
            cells = [f"{number(theirs[k])} / {number(here[k])}" for k in ("mean", "std", "variance")]
            cells.append(f"{interval(theirs['ci'], 5)} / {interval(ends[label][n], 5)}")
            rows.append([n, label, *cells, why])
    head = ["mean", "std", "variance", "CI (95 %)"]
    return markdown(["gain", "", *(f"{h}: paper / here" for h in head), "why they differ"], rows)


def intervals(values: Mapping[str, Any]) -> str:
    """Return the table of the different 95 % intervals and the true value."""
    rows = []
    for n in paper.GAINS:
        s = spread(np.array(values["individual"][n]))
        six = half_width(s["std"], 6)
        whole = values["together"][n]
        rows.append(
            [
                n,
                number(paper.TABLE_1[n]),
                interval(s["ci95_of_mean"], 5),
                interval([s["mean"] - six, s["mean"] + six], 5),
                interval(s["ci95"], 5),
                f"{number(whole['value'], 5)} ({interval(whole['ci'], 5)})",
                number(values["std a run claims"][n], 3),
            ]
        )
    head = [
        "gain",
        "true",
        "mean, n = 30",
        "mean, n = 6",
        "one more experiment",
        "all 30 in one fit",
        "std of one fit (median)",
    ]
    return markdown(head, rows)


def variation(values: Mapping[str, Any]) -> str:
    """Return the table of coefficients of variation in %, and of std over Table II's range for means near 0."""
    rows = []
    for n in paper.GAINS:
        width = paper.TABLE_2[n][1] - paper.TABLE_2[n][0]
        relative, ranged = [], []
        for label, mode in paper.MODES.items():
            theirs, here = paper.TABLE_3[n][label], spread(np.array(values[mode][n]))
            cv = theirs["std"] / theirs["mean"] if theirs["mean"] else None
            relative.append(f"{percent(cv)} / {percent(here['cv'])}")
            ranged.append(f"{percent(theirs['std'] / width)} / {percent(here['std'] / width)}")
        rows.append([n, *relative, *ranged])
    head = ["cv, II", "cv, SI", "std over range, II", "std over range, SI"]
    return markdown(["gain", *(f"{h}, %: paper / here" for h in head)], rows)


def percent(share: float | None) -> str:
    """Return the share in % as text; a dash for None."""
    return "-" if share is None else number(100 * share, 2)


def choices(values: Mapping[str, Any]) -> str:
    """Return the table of mean and std of the gains by the choices that the paper does not specify."""
    lines: dict[str, dict[str, Any]] = {
        "as above": {m: statistics(values[m]) for m in paper.MODES.values()},
        "Irorder1 not compared in the P experiments": {
            "simultaneous": values["simultaneous, P experiments without Irorder1"]
        },
        "the other controllers' gains at Table II's starts": {
            "individual": values["individual, others at Table II's starts"]
        },
        "random operating points instead of 40 MW": values["other operating points"],
        "reference without measurement filters": values["reference without filters"],
    }
    rows = [["the paper", label, *(plus(paper.TABLE_3[n][label]) for n in paper.GAINS)] for label in paper.MODES]
    for what, by_mode in lines.items():
        for label, mode in paper.MODES.items():
            if mode in by_mode:
                rows.append([what, label, *(plus(by_mode[mode][n]) for n in paper.GAINS)])
    return markdown(["", "", *paper.GAINS], rows)


def plus(s: Mapping[str, float]) -> str:
    """Return mean and std as text."""
    return f"{number(s['mean'])} ± {number(s['std'], 2)}"


def draw(values: Mapping[str, Any]) -> Any:
    """Draw every run's estimate by gain, both modes, with means, the paper's mean and std, and the true gain."""
    from hvdc_ident.report.drawing import figure

    fig = figure(11, 5.5)
    known = {}
    for axes, n in zip(fig.subplots(2, 3).flat, paper.GAINS, strict=True):
        for place, (label, mode) in enumerate(paper.MODES.items()):
            v, theirs = np.array(values[mode][n]), paper.TABLE_3[n][label]
            spots = place - 0.12 + 0.24 * np.arange(v.size) / (v.size - 1)
            axes.plot(spots, v, ".", color="#1f5fa8", ms=4, label="here, one run")
            axes.plot([place - 0.2, place + 0.2], [v.mean()] * 2, color="#1f5fa8", label="here, mean")
            axes.errorbar(
                place + 0.32, theirs["mean"], theirs["std"], fmt="o", color="#d08020", ms=4, label="paper, mean and std"
            )
        axes.axhline(paper.TABLE_1[n], color="0.5", linestyle=":", label="in the reference (Table I)")
        axes.set(title=n, xticks=[0, 1], xticklabels=list(paper.MODES.values()), xlim=(-0.5, 1.6))
        handles, labels = axes.get_legend_handles_labels()
        known |= dict(zip(labels, handles, strict=True))
    fig.legend(list(known.values()), list(known), loc="outside lower center", ncols=4, fontsize=8)
    return fig


if __name__ == "__main__":
    args, begun = ending.arguments(__doc__, quick="4 experiments instead of 30", workers=True), time.perf_counter()
    found = main(QUICK if args.quick else FULL, args.workers)
    sys.exit(ending.ended(HERE, found, tables, draw, pin=args.pin, begun=begun, whole=not args.quick))
