"""Fig. 5: the set-up of a fit as study files, one for each controller and one for all three.

python studies/figure_5/run.py [--quick] [--pin]
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
from common import ending, paper  # noqa: E402
from common.ending import markdown, number  # noqa: E402

from hvdc_ident.files import csv_text, write_text  # noqa: E402
from hvdc_ident.simulate import simulate  # noqa: E402
from hvdc_ident.study.pipeline import run_stage  # noqa: E402
from hvdc_ident.study.stages import StageOptions  # noqa: E402
from hvdc_ident.study.study import load_study  # noqa: E402

SETUPS = {"P": "p.toml", "Q": "q.toml", "Vdc": "vdc.toml", "all three": "simultaneous.toml"}
WHY = {
    "P": "a text file instead of a Simulink container",
    "Q": "the same",
    "Vdc": "the container of Fig. 5 itself",
    "all three": "the same; each output is compared in every experiment, weighted by its own misfit",
}


def write_waveforms() -> None:
    """Write the reference's response to one step of each set-point into the folder, all three outputs."""
    for kind, c in paper.CONTROLLERS.items():
        e = paper.step(kind)
        recorded = [np.round(e.measured[o], 9) for o in e.outputs]
        columns = np.column_stack([e.time, e.inputs[c.setpoint](e.time), *recorded])
        write_text(HERE / f"{kind.lower()}-step.csv", csv_text(["time", c.setpoint, *e.outputs], columns.tolist()))


def main(setups: Sequence[str] = tuple(SETUPS)) -> dict[str, Any]:
    """Return the result of `hvdc-ident fit` by set-up: status, estimates and held parameters."""
    found = {}
    for setup in setups:
        study = load_study(HERE / SETUPS[setup])
        with tempfile.TemporaryDirectory() as folder:
            fit = run_stage(study, "fit", Path(folder), StageOptions()).data
        found[setup] = {
            "status": fit["status"],
            "played in": sorted({n for e in study.experiments for n in e.inputs}),
            "compared": list(study.experiments[0].outputs),
            "estimates": {n: {"value": e["value"], "ci95": e["ci95"]} for n, e in fit["estimates"].items()},
            "held": {n: why for n, why in fit["held"].items() if n in study.candidates},
        }
    return found


def tables(values: Mapping[str, Any]) -> dict[str, str]:
    """Return the README's table."""
    rows = []
    for setup, v in values.items():
        estimates = [f"{n} {number(e['value'])} ({ends(e['ci95'])})" for n, e in v["estimates"].items()]
        held = [f"{n}: {why}" for n, why in v["held"].items()]
        theirs = "one set-up, not drawn" if setup == "all three" else "one of three set-ups, the Vdc one drawn"
        here = f"`{SETUPS[setup]}`: {', '.join(v['played in'])} in, {', '.join(v['compared'])} compared"
        rows.append([setup, theirs, here, WHY[setup], "; ".join(estimates), "; ".join(held) or "nothing"])
    head = ["fitted", "paper", "here", "why they differ", "estimates (95 %)", "held"]
    return {"set-ups": markdown(head, rows)}


def ends(ci: Sequence[float | None] | None) -> str:
    """Return both ends of an interval as text, a dash for an unknown one."""
    return "no interval" if ci is None else " to ".join(number(v) for v in ci)


def draw(values: Mapping[str, Any]) -> Any:
    """Draw the container of the Vdc controller: recorded inputs, the model with its unknowns, compared outputs."""
    from hvdc_ident.report.drawing import figure

    study = load_study(HERE / SETUPS["Vdc"])
    (e,) = study.experiments
    fig = figure(11, 3.2)
    left, middle, right = fig.subplots(1, 3, width_ratios=[1, 1.4, 1])
    ((name, signal),) = e.inputs.items()
    left.plot(1e3 * e.time, signal(e.time), color="black")
    left.set(title=f"played in: {name}, pu", xlabel="time, ms", xlim=(0, 400))
    middle.axis("off")
    unknowns = [f"{n}: {f.min:g} to {f.max:g}, start {f.start:g}" for n, f in study.candidates.items()]
    others = ", ".join(n for n in study.model.inputs if n not in e.inputs)
    text = "\n".join([study.model.name, "", *unknowns, "", "at rest:", others])
    box = {"boxstyle": "round,pad=0.8", "fc": "white", "ec": "0.3"}
    middle.text(0.5, 0.58, text, ha="center", va="center", bbox=box, fontsize=9)
    for x0, x1 in ((-0.05, 0.1), (0.9, 1.05)):
        middle.annotate("", (x1, 0.58), (x0, 0.58), arrowprops={"arrowstyle": "->"}, annotation_clip=False)
    middle.text(0.5, 0.02, "the unknowns move until the sum\nof squared differences is least", ha="center", fontsize=8)
    (output,) = e.outputs
    fitted = {n: v["value"] for n, v in values["Vdc"]["estimates"].items()}
    start = {n: f.start for n, f in study.candidates.items()}
    right.plot(1e3 * e.time, e.measured[output], color="#1f5fa8", lw=3, alpha=0.5, label="recorded")
    for label, gains, color in (("at the start", start, "0.4"), ("fitted", fitted, "#c0392b")):
        run = simulate(study.model, e.with_(measured=None), gains, outputs=[output])
        right.plot(1e3 * e.time, run[output], color=color, lw=1, label=label)
    right.set(title=f"compared: {output}, pu", xlabel="time, ms", xlim=(0, 400))
    right.legend(fontsize=8)
    return fig


if __name__ == "__main__":
    args = ending.arguments(__doc__, quick="the Vdc controller's set-up only")
    if args.pin:
        write_waveforms()
    found = main(("Vdc",)) if args.quick else main()
    sys.exit(ending.ended(HERE, found, tables, draw, pin=args.pin, whole=not args.quick))
