"""Fig. 7: the controllers' outputs with the gains at the ends of Table III's intervals and with the test values.

python studies/figure_7/run.py [--pin]
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
from common import ending, paper  # noqa: E402
from common.ending import markdown, number  # noqa: E402

from hvdc_ident.data import Experiment  # noqa: E402
from hvdc_ident.models import load_model  # noqa: E402
from hvdc_ident.simulate import simulate  # noqa: E402
from hvdc_ident.study.examples import Campaign, Noise, recorded  # noqa: E402

SETS = ("upper", "lower", "test")
SHOWN = 450.0  # ms of the record drawn
OTHERS = Campaign(source=paper.REFERENCE, count=2, noise=Noise(0.0), sample=paper.SAMPLE, at_rest=True, seed=7)
WHY = {
    "Irorder2": "the paper's floor is higher (Table IV)",
    "Iiorder1": "in the paper more is missing in Q than a delay (Table IV)",
    "Irorder1": "the paper's floor is higher; ours is due to the delay and the inner current loop",
}


def perturbations() -> dict[str, list[Experiment]]:
    """Return by output a step and a ramp of its set-point from the 40 MW operating point, none of them among Table III's."""
    experiments = tuple(recorded(OTHERS))
    return {c.output: list(paper.of(kind, experiments)) for kind, c in paper.CONTROLLERS.items()}


def main(ends: Mapping[str, Mapping[str, tuple[float, float]]] | None = None) -> dict[str, Any]:
    """Return the plotted gains, and the RMSE in pu by output, perturbation and set of gains.

    ends: Table III's intervals of the mean; if left out, they are computed.
    """
    pairs = (ends if ends is not None else fresh_ends())["II"]
    sets = {
        "upper": {n: pair[1] for n, pair in pairs.items()},
        "lower": {n: pair[0] for n, pair in pairs.items()},
        "test": {n: test for n, (_, _, _, test) in paper.TABLE_2.items()},
    }
    errors = {
        o: {e.name: {s: paper.rmse(e, gains)[o] for s, gains in sets.items()} for e in experiments}
        for o, experiments in perturbations().items()
    }
    return {"gains": sets, "rmse": errors}


def fresh_ends() -> Any:
    """Return Table III's intervals of the mean from the individual fits; the simultaneous ones are not plotted."""
    found = paper.values_of(paper.individual(paper.recordings()))
    return paper.intervals_of_mean(dict.fromkeys(paper.MODES.values(), found))


def tables(values: Mapping[str, Any]) -> dict[str, str]:
    """Return the README's table: shares of the test value's RMSE, by perturbation."""
    rows = []
    for o, by_experiment in values["rmse"].items():
        theirs = paper.TABLE_4[o]
        for name, e in by_experiment.items():
            paper_s = [number(theirs[f"{s} II"] / theirs["test"], 2) for s in SETS[:2]]
            ours = [number(e[s] / e["test"], 2) for s in SETS[:2]]
            cells = [*(number(e[s], 3) for s in SETS), ", ".join(paper_s), ", ".join(ours)]
            rows.append([o, name.split("-")[-1], *cells, WHY[o]])
    head = ["output", "", *SETS, "upper, lower divided by test: paper", "here", "why they differ"]
    return {"overlays": markdown(head, rows)}


def draw(values: Mapping[str, Any]) -> Any:
    """Draw each output in its step and its ramp (reference blue, ends of the interval red, test values black) and the errors."""
    from hvdc_ident.report.drawing import figure

    fig = figure(11, 9)
    grid = fig.subplots(4, 3, sharex=True)
    link = load_model(paper.LINK)
    styles = {"upper": ("#c0392b", "-"), "lower": ("#c0392b", ":"), "test": ("black", "--")}
    for column, (o, experiments) in enumerate(perturbations().items()):
        for row, e in enumerate(experiments):
            above, below = grid[2 * row, column], grid[2 * row + 1, column]
            t, measured = 1e3 * (e.time - paper.EVENT), e.measured[o]
            above.plot(t, measured, color="#1f5fa8", lw=3, alpha=0.5, label="average-value link")
            for s, gains in values["gains"].items():
                run = simulate(link, e.with_(measured=None), gains, outputs=[o])[o]
                color, style = styles[s]
                label = "test values" if s == "test" else f"{s} ends of the intervals"
                above.plot(t, run, color=color, linestyle=style, lw=1.2, label=label)
                if s != "test":
                    below.plot(t, run - measured, color=color, linestyle=style, lw=1)
            ((setpoint, signal),) = e.inputs.items()
            move = f"{setpoint} {signal.values[0]:g} to {signal.values[-1]:.4g} pu"
            above.set(title=f"{e.name.split('-')[-1]}: {move}", ylabel=f"{o}, pu")
            below.set(ylabel="error, pu", xlim=(-20, SHOWN))
            below.axhline(0, color="0.7", lw=0.5)
    for axes in grid[-1]:
        axes.set_xlabel("time after the event, ms")
    fig.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    return fig


if __name__ == "__main__":
    args = ending.arguments(__doc__)
    sys.exit(ending.ended(HERE, main(), tables, draw, pin=args.pin))
