"""Table II: bounds, starts and test values of the fits, and the end points of the fits from each of them.

python studies/table_2/run.py [--quick] [--pin]
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
from common import ending, paper  # noqa: E402
from common.ending import markdown, number  # noqa: E402

from hvdc_ident.data import Array, Experiment  # noqa: E402
from hvdc_ident.errors import SimulationError  # noqa: E402
from hvdc_ident.fit import Problem  # noqa: E402
from hvdc_ident.fit.optimisers.trust_region import TrustRegion  # noqa: E402
from hvdc_ident.immutable import FrozenMap  # noqa: E402

SETUPS = {**{kind: (kind,) for kind in paper.CONTROLLERS}, "all three": tuple(paper.CONTROLLERS)}
DATA = {"the link itself": paper.LINK, "the average-value link": paper.REFERENCE}


def main(setups: Sequence[str] = tuple(SETUPS)) -> dict[str, Any]:
    """Return by data and set-up the number of starts, and the distances of their ends from each other and from Table I."""
    return {data: {setup: ends(setup, source) for setup in setups} for data, source in DATA.items()}


def problem_of(setup: str, source: str) -> Problem:
    """Return the problem of the set-up: its gains, one step of each of its controllers, equal weights."""
    kinds = SETUPS[setup]
    outputs = [paper.CONTROLLERS[k].output for k in kinds]
    experiments: list[Experiment] = [paper.step(k, source, outputs) for k in kinds]
    alike = FrozenMap(dict.fromkeys(outputs, paper.EQUAL))
    gains = [n for n in paper.TABLE_2 if any(n in paper.CONTROLLERS[k].gains for k in kinds)]
    return Problem(paper.link(), tuple(e.with_(noise=alike) for e in experiments), paper.free(gains))


def starts_of(problem: Problem) -> list[Array]:
    """Return Table II's start, every corner of its bounds, and its test values where these lie within the bounds."""
    low, high = ([getattr(f, side) for f in problem.free] for side in ("min", "max"))
    corners = [np.array(c) for c in itertools.product(*zip(low, high, strict=True))]
    test = np.array([paper.TABLE_2[f.name][3] for f in problem.free])
    inside = bool(((test >= low) & (test <= high)).all())
    return [problem.start, *corners, *([test] if inside and not any((test == c).all() for c in corners) else [])]


def ends(setup: str, source: str) -> dict[str, Any]:
    """Return the optimum and, over all starts that end there, the largest distance from it and from Table I.

    Distances are relative to the value, or to Table II's range where Table I's value is 0.
    """
    problem = problem_of(setup, source)
    starts = starts_of(problem)
    runs = [TrustRegion().run(problem, start) for start in starts]
    names = [f.name for f in problem.free]
    costs = [float(r.cost) if r.status == "converged" and r.cost is not None else np.inf for r in runs]
    best = runs[int(np.argmin(costs))]
    there = [c <= min(costs) * (1 + 1e-6) + 1e-3 for c in costs]
    arrived = [r for r, yes in zip(runs, there, strict=True) if yes]
    lost = [dict(zip(names, map(float, s), strict=True)) for s, yes in zip(starts, there, strict=True) if not yes]
    truth = np.array([paper.TABLE_1[n] for n in names])
    scale = np.where(truth > 0, truth, [f.span for f in problem.free])
    return {
        "starts": len(runs),
        "to the optimum": len(arrived),
        "elsewhere": sum(np.isfinite(costs)) - len(arrived),
        "all lost have": {n: lost[0][n] for n in names if lost and len({s[n] for s in lost}) == 1},
        "optimum": dict(zip(names, map(float, best.theta), strict=True)),
        "apart": worst((r.theta - best.theta) / scale for r in arrived),
        "off Table I": worst((r.theta - truth) / scale for r in arrived),
        "simulations": [min(r.evaluations for r in arrived), max(r.evaluations for r in arrived)],
    }


def worst(distances: Iterable[Array]) -> float:
    """Return the largest magnitude, or 0 below 1e-6, which is rounding."""
    found = max(float(np.abs(d).max()) for d in distances)
    return 0.0 if found < 1e-6 else found


NOTES = {
    "KIP": "test value on the lower bound",
    "KPP": "true value and test value on the lower bound: no value ± std there",
    "KIQ": "test value on the lower bound",
    "KPQ": "true value and test value on the lower bound: no value ± std there",
    "KPVDC": "test value on the lower bound",
    "KIVDC": "start 2 % off the true value; test value outside the bounds, so that no fit can begin there",
}


def tables(values: Mapping[str, Any]) -> dict[str, str]:
    """Return the README's tables."""
    bounds = [[n, *(number(v) for v in row), number(paper.TABLE_1[n]), NOTES[n]] for n, row in paper.TABLE_2.items()]
    rows = []
    for data, setup in itertools.product(DATA, SETUPS):
        v = values[data][setup]
        low, high = v["simulations"]
        optimum = ", ".join(f"{n} {number(x if x > 1e-6 else 0.0)}" for n, x in v["optimum"].items())
        cells = [f"{v['to the optimum']} of {v['starts']}", lost(v), share(v["apart"]), share(v["off Table I"])]
        rows.append([data, setup, *cells, optimum, f"{low} to {high}"])
    head = [
        "starts that end at the optimum",
        "other starts",
        "largest distance from it",
        "distance from Table I",
        "optimum",
        "simulations",
    ]
    return {
        "bounds": markdown(["gain", "min", "max", "start", "test", "true", "here"], bounds),
        "ends": markdown(["waveforms of", "fitted", *head], rows),
    }


def lost(v: Mapping[str, Any]) -> str:
    """Return, as text, the outcome of the other starts and the values that they have in common."""
    stopped = v["starts"] - v["to the optimum"] - v["elsewhere"]
    parts = [f"{stopped} not simulated"] if stopped else []
    parts += [f"{v['elsewhere']} elsewhere"] if v["elsewhere"] else []
    common = ", ".join(f"{n} = {number(x)}" for n, x in v["all lost have"].items())
    return "; ".join(parts) + (f" (all with {common})" if common else "") or "-"


def share(value: float) -> str:
    """Return the share in % as text."""
    return "under 1e-6" if value == 0 else f"{number(100 * value, 2)} %"


def draw(values: Mapping[str, Any]) -> Any:
    """Draw the RMSE of each controller's output over the bounds of Table II, with starts, test value, Table I and optimum."""
    from matplotlib.patches import Rectangle

    from hvdc_ident.report.drawing import figure

    fig = figure(11, 3.8)
    for axes, (kind, c) in zip(fig.subplots(1, 3), paper.CONTROLLERS.items(), strict=True):
        recorded = paper.step(kind, outputs=[c.output])
        pair = sorted(c.gains)  # integral, proportional
        low, high = (np.array([paper.TABLE_2[n][i] for n in pair]) for i in (0, 1))
        room = 0.05 * (high - low)
        left = np.maximum(np.minimum(low, [paper.TABLE_2[n][3] for n in pair]) - room, 0.0)
        x, y = (np.linspace(a, b, 25) for a, b in zip(left, high + room, strict=True))
        z = [[misfit(recorded, {pair[0]: a, pair[1]: b}) for a in x] for b in y]
        lines = axes.contourf(x, y, np.log10(z), levels=15, cmap="Blues_r")
        fig.colorbar(lines, ax=axes, label=f"log10 RMSE of {c.output}, pu")
        axes.add_patch(Rectangle(tuple(low), *(high - low), fill=False, linestyle="--", color="0.4", clip_on=False))
        best = values["the average-value link"][kind]["optimum"]
        for label, at, mark, color in (
            ("start", [paper.TABLE_2[n][2] for n in pair], "s", "black"),
            ("test value", [paper.TABLE_2[n][3] for n in pair], "X", "black"),
            ("Table I", [paper.TABLE_1[n] for n in pair], "o", "#d08020"),
            ("optimum", [best[n] for n in pair], "*", "red"),
        ):
            axes.plot(*at, mark, label=label, clip_on=False, color=color, ms=7, linestyle="")
        axes.set(xlabel=f"{pair[0]}, pu/s", ylabel=f"{pair[1]}, pu", title=f"{kind} controller")
    fig.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    return fig


def misfit(recorded: Experiment, gains: Mapping[str, float]) -> float:
    """Return the RMSE of the output; NaN (blank in the figure) where the link cannot be simulated."""
    try:
        return paper.rmse(recorded, gains)[recorded.outputs[0]]
    except SimulationError:
        return float("nan")


if __name__ == "__main__":
    args = ending.arguments(__doc__, quick="one controller at a time only")
    found = main(tuple(paper.CONTROLLERS)) if args.quick else main()
    sys.exit(ending.ended(HERE, found, tables, draw, pin=args.pin, whole=not args.quick))
