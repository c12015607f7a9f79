"""Table IV: RMSE of the controllers' outputs with the gains at the ends of Table III's intervals, EMTP's, and test values.

python studies/table_4/run.py [--pin]
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

ROWS = ("Irorder2", "Iiorder1", "Irorder1")  # the paper's order
COLUMNS = ("upper II", "upper SI", "lower II", "lower SI", "EMTP", "test")
WHY = {
    "Irorder2": "the RMSE of the test value suggests a larger step than ours or a shorter record; relative to it the paper's floor is "
    "{ratio} ours",
    "Iiorder1": "the same; relative to the test value's RMSE the paper's floor is {ratio} ours: more is missing in Q than a delay",
    "Irorder1": "the RMSE of the test value suggests a longer record than ours; relative to it the paper's floor is {ratio} ours",
}
Ends = Mapping[str, Mapping[str, tuple[float, float]]]


def gain_sets(ends: Ends) -> dict[str, dict[str, float]]:
    """Return the sets of gains in Table IV by their names in the paper. ends: Table III's intervals of the mean."""
    sets = {
        f"{side} {mode}": {n: max(float(pair[place]), 0.0) for n, pair in ends[mode].items()}
        for side, place in (("upper", 1), ("lower", 0))
        for mode in ("II", "SI")
    }
    sets["EMTP"] = dict(paper.TABLE_1)
    sets["test"] = {n: test for n, (_, _, _, test) in paper.TABLE_2.items()}
    sets["mean II, the paper's"] = {n: row["II"]["mean"] for n, row in paper.TABLE_3.items()}
    return sets


def main(ends: Ends | None = None) -> dict[str, Any]:
    """Return the RMSE in pu by output and set of gains, each output in the step of its own set-point.

    ends: Table III's intervals of the mean; if left out, they are computed.
    """
    sets = gain_sets(ends if ends is not None else fresh_ends())
    recorded = {c.output: paper.step(kind, outputs=[c.output]) for kind, c in paper.CONTROLLERS.items()}
    return {o: {name: paper.rmse(recorded[o], gains)[o] for name, gains in sets.items()} for o in ROWS}


def fresh_ends() -> Ends:
    """Return Table III's intervals of the mean, from the fits."""
    experiments = paper.recordings()
    found = {"individual": paper.individual(experiments), "simultaneous": paper.simultaneous(experiments)}
    return paper.intervals_of_mean({mode: paper.values_of(f) for mode, f in found.items()})


def tables(values: Mapping[str, Any]) -> dict[str, str]:
    """Return the README's tables."""
    rows, shares = [], []
    for o in ROWS:
        theirs, ours = paper.TABLE_4[o], values[o]
        times = theirs["upper II"] / theirs["test"] / (ours["upper II"] / ours["test"])
        cells = [f"{number(theirs[c], 3)} / {number(ours[c], 3)}" for c in COLUMNS]
        rows.append([o, *cells, WHY[o].format(ratio=f"{number(times, 2)} times")])
        pairs = [f"{number(theirs[c] / theirs['test'], 2)} / {number(ours[c] / ours['test'], 2)}" for c in COLUMNS[:-1]]
        shares.append([o, *pairs, number(ours["mean II, the paper's"] / ours["test"], 2)])
    last = "here, with the paper's own mean II"
    return {
        "rmse": markdown(["output", *(f"{c}: paper / here" for c in COLUMNS), "why they differ"], rows),
        "shares": markdown(
            ["divided by the test value's", *(f"{c}: paper / here" for c in COLUMNS[:-1]), last], shares
        ),
    }


def draw(values: Mapping[str, Any]) -> Any:
    """Draw the RMSE divided by that of the test values, paper and here, on a logarithmic axis."""
    from hvdc_ident.report.drawing import figure

    fig = figure(10, 3.4)
    places = list(range(len(COLUMNS)))
    grid = fig.subplots(1, 3, sharey=True)
    for axes, o in zip(grid, ROWS, strict=True):
        for label, table, color, mark in (
            ("paper", paper.TABLE_4[o], "#d08020", "o"),
            ("here", values[o], "#1f5fa8", "s"),
        ):
            axes.plot([table[c] / table["test"] for c in COLUMNS], places, mark, color=color, label=label, ms=5)
        axes.set(xscale="log", title=o, yticks=places, yticklabels=COLUMNS, xlabel="RMSE over the test value's")
        axes.grid(axis="x", color="0.9")
    grid[0].invert_yaxis()
    grid[0].legend(fontsize=8)
    return fig


if __name__ == "__main__":
    args = ending.arguments(__doc__)
    sys.exit(ending.ended(HERE, main(), tables, draw, pin=args.pin))
