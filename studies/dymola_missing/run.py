"""Diagnose, without hints, what the phasor link lacks on waveforms computed by Dymola, and the gap before and after.

python studies/dymola_missing/run.py [--workers N] [--pin]

Needs the reference data beside the project (../shared/data/dymola); says so where they are absent.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: threads on matrices this narrow only wait

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
from common import diagnosing, ending  # noqa: E402
from common.ending import markdown, number  # noqa: E402
from common.work import processes  # noqa: E402

from hvdc_ident import load_study, simulate  # noqa: E402
from hvdc_ident.data import Experiment, Trajectory  # noqa: E402
from hvdc_ident.discrepancy import DiagnosisOptions, diagnose  # noqa: E402
from hvdc_ident.effects import effects as catalogue  # noqa: E402
from hvdc_ident.fit import FitParameter, Problem, fit  # noqa: E402
from hvdc_ident.model import Model  # noqa: E402
from hvdc_ident.simulate import ModelSimulator  # noqa: E402

STUDY = HERE.parent / "dymola_waveform" / "study.toml"
DATA = HERE / "../../../shared/data/dymola/TwoNodePowerSystem.mat"
TRUE = {"KIP": 30.0, "KPVDC": 9.6, "KIVDC": 293.88}
SAMPLE = 1e-3  # s
LINE = 1.022 / 409.6
"""Resistance of the dc line alone, pu, as in the authors' model; the study's Rdc has both stations' resistances in it."""
DELAYED = {"effect": "delay", "at": ["Ir2"], "from": "", "parameters": {"T": 1e-3}}
"""The effect that removes most of the misfit of station 2's current order when it is inserted alone."""
SHOWN = ("Irorder1", "Irorder2", "Vdc2")
FOUND = "with the findings"


def setup() -> tuple[Model, Experiment, tuple[FitParameter, ...]]:
    """Return the link with the ratings of the authors' model, the P step on an even grid, and the gains with their starts."""
    study = load_study(STUDY)
    (given,) = study.experiments
    begin, end = given.window or (given.time[0], given.time[-1])
    # Even, and between the events: Dymola stores each of them twice.
    time = np.round(np.arange(begin + SAMPLE / 2, end, SAMPLE), 9)
    record = given.measured
    assert record is not None
    columns = np.column_stack([np.interp(time, given.time, record[o]) for o in given.outputs])
    measured = Trajectory(time, columns, given.outputs, tuple("pu" for _ in given.outputs))
    even = Experiment(time, given.name, inputs=given.inputs, measured=measured, noise=given.noise, event=given.event)
    assert isinstance(study.model, Model)
    return study.model, even, tuple(study.candidates.values())


def errors(model: Model, e: Experiment, values: Mapping[str, float]) -> dict[str, float]:
    """Return the RMSE by output, pu."""
    assert e.measured is not None
    run = simulate(model, e.with_(measured=None), values, outputs=e.outputs)
    return {o: float(np.sqrt(np.mean((run[o] - e.measured[o]) ** 2))) for o in e.outputs}


def refits(found: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return gains and RMSE with the true gains, and fitted: the link as it is, with other resistances, and with effects.

    found: the effects of the diagnosis with their sizes, as `diagnosing.told` gives them.
    """
    model, e, _ = setup()
    line = model.with_values({"Rdc": LINE})
    late = [f for f in found if catalogue()[f["effect"]].equivalent_delay is not None]
    return {
        "true gains": {"values": TRUE, "sizes": {}, "rmse": errors(model, e, TRUE)},
        "fitted": refitted(model),
        "with a delay at Ir2": refitted(model, [DELAYED]),
        FOUND: refitted(model, found),
        "Rdc of the line alone": refitted(line),
        "the same, and the found delay": refitted(line, late),
    }


def refitted(model: Model, effects: Sequence[Mapping[str, Any]] = ()) -> dict[str, Any]:
    """Return gains, sizes and RMSE of the model with these effects, the gains and every size that is not zero fitted."""
    _, e, free = setup()
    more = diagnosing.augmented(model, effects) if effects else model
    added = {n: more.values[n] for n in more.parameters if n not in model.parameters and more.values[n]}
    sizes = tuple(FitParameter(n, v, *sorted((v / 5, 5 * v))) for n, v in added.items())
    result = fit(Problem(ModelSimulator(more), (e,), (*free, *sizes)), starts=4, seed=0)
    if result.status not in ("converged", "at-bound"):
        raise RuntimeError(f"a fit ended without an estimate: {result.message}")
    values = {n: result.values[n] for n in (*TRUE, *added)}
    return {
        "values": {n: values[n] for n in TRUE},
        "sizes": {n: values[n] for n in added},
        "rmse": errors(more, e, values),
    }


def named(executor: Any = None) -> dict[str, Any]:
    """Return the diagnosis without hints: every effect at every insertion point."""
    model, e, free = setup()
    found = diagnose(
        model,
        [e],
        free,
        options=DiagnosisOptions(fallback=False),
        executor=executor,
        progress=diagnosing.on_stderr("Dymola"),
    )
    return diagnosing.told(found)


def main(workers: int = 1) -> dict[str, Any]:
    """Return the diagnosis and the refits."""
    with processes(workers) as executor:
        told = named(executor)
    return {"told nothing": told, "refits": refits(told["effects"])}


def tables(values: Mapping[str, Any]) -> dict[str, str]:
    """Return the README's tables."""
    cases, told = values["refits"], values["told nothing"]
    outputs = list(next(iter(cases.values()))["rmse"])
    gains = [
        [
            case,
            *(number(row["values"][n]) for n in TRUE),
            ", ".join(f"{n} {number(v, 3)}" for n, v in row["sizes"].items()) or "-",
            *(number(1e3 * row["rmse"][o], 3) for o in outputs),
        ]
        for case, row in cases.items()
    ]
    return {
        "verdict": f"**{told['verdict']}**. {told['text']}",
        "found": diagnosing.findings({"P step of station 2": told}, "experiment"),
        "gains": markdown(["", *TRUE, "sizes", *(f"RMSE {o}, 1e-3" for o in outputs)], gains),
    }


def draw(values: Mapping[str, Any]) -> Any:
    """Draw by output what the fitted link leaves of Dymola's record, as it is and with the findings."""
    from hvdc_ident.report.drawing import AFTER, BEFORE, figure

    model, e, _ = setup()
    assert e.measured is not None
    plain, found = values["refits"]["fitted"], values["refits"][FOUND]
    lines = {
        "fitted link": (model, plain, BEFORE),
        "fitted with the findings": (diagnosing.augmented(model, values["told nothing"]["effects"]), found, AFTER),
    }
    fig = figure(11, 3.4)
    grid = fig.subplots(1, len(SHOWN))
    for label, (drawn, row, colour) in lines.items():
        run = simulate(drawn, e.with_(measured=None), row["values"] | row["sizes"], outputs=e.outputs)
        for axes, o in zip(grid, SHOWN, strict=True):
            axes.plot(e.time, 1e3 * (run[o] - e.measured[o]), color=colour, label=label)
            axes.set(xlabel="time, s", ylabel=f"{o} minus Dymola's, 1e-3 pu")
    grid[0].legend(fontsize=8)
    return fig


if __name__ == "__main__":
    args = ending.arguments(__doc__, workers=True)
    if not DATA.exists():
        sys.exit("the reference data are not beside the project: ../shared/data/dymola is expected")
    sys.exit(ending.ended(HERE, main(args.workers), tables, draw, pin=args.pin))
