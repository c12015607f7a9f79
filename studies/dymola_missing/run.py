"""Diagnose, without hints, what the phasor link lacks on waveforms computed by Dymola, and the gap before and after.

python studies/dymola_missing/run.py [--workers N] [--pin]

Needs the reference data beside the project (../shared/data/dymola); says so where they are absent.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
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
from hvdc_ident.effects import apply_effects  # noqa: E402
from hvdc_ident.fit import FitParameter, Problem, fit  # noqa: E402
from hvdc_ident.model import Model  # noqa: E402
from hvdc_ident.simulate import ModelSimulator  # noqa: E402

STUDY = HERE.parent / "dymola_waveform" / "study.toml"
DATA = HERE / "../../../shared/data/dymola/TwoNodePowerSystem.mat"
TRUE = {"KIP": 30.0, "KPVDC": 9.6, "KIVDC": 293.88}
SAMPLE = 1e-3  # s
LISTED = 12
TRIED = {  # the effect that explains most, at each of the places where it does, refitted by itself: name of it, slots
    "delay": {"Ir2": ["Ir2"], "P2": ["P2"], "all currents": ["Ir1", "Ii1", "Ir2", "Ii2"]},
    "lag": {"Ir2": ["Ir2"], "P2": ["P2"], "all currents": ["Ir1", "Ii1", "Ir2", "Ii2"]},
}


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


def refits() -> dict[str, Any]:
    """Return gains and RMSE of the plain link, with the true gains and fitted, and of the link fitted with one effect."""
    model, e, free = setup()
    plain = fit(Problem(ModelSimulator(model), (e,), free), starts=4, seed=0)
    found: dict[str, Any] = {
        "true gains": {"values": TRUE, "rmse": errors(model, e, TRUE)},
        "fitted": _row(model, e, plain),
    }
    for effect, places in TRIED.items():
        for place, at in places.items():
            more = apply_effects(model, [{"effect": effect, "at": at, "parameters": {"T": 1e-3}}])
            (name,) = (n for n in more.parameters if n not in model.parameters)
            result = fit(
                Problem(ModelSimulator(more), (e,), (*free, FitParameter(name, 1e-3, 1e-4, 1e-2))), starts=4, seed=0
            )
            found[f"{effect} at {place}"] = _row(more, e, result, name)
    return found


def _row(model: Model, e: Experiment, result: Any, own: str = "") -> dict[str, Any]:
    if result.status not in ("converged", "at-bound"):
        raise RuntimeError(f"a fit ended without an estimate: {result.message}")
    values = {n: result.values[n] for n in (*TRUE, *([own] if own else []))}
    return {"values": {("T" if n == own else n): v for n, v in values.items()}, "rmse": errors(model, e, values)}


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
    lines = sorted((c for c in found.candidates if c.delta_bic is not None), key=lambda c: -(c.delta_bic or 0.0))
    told = diagnosing.told(found)
    told["refitted candidates"] = [
        {"effect": c.effect, "at": list(c.at), "from": c.source, "parameters": {}, "delta_bic": c.delta_bic,
         "holdout": c.holdout_rmse}
        for c in lines[:LISTED]
    ]  # fmt: skip
    return told


def main(workers: int = 1) -> dict[str, Any]:
    """Return the refits and the diagnosis."""
    with processes(workers) as executor:
        return {"refits": refits(), "told nothing": named(executor)}


def tables(values: Mapping[str, Any]) -> dict[str, str]:
    """Return the README's tables."""
    told, cases = values["told nothing"], values["refits"]
    outputs = list(next(iter(cases.values()))["rmse"])
    gains = [
        [
            case,
            *(number(row["values"].get(n)) for n in TRUE),
            number(1e3 * row["values"]["T"], 3) if "T" in row["values"] else "-",
            *(number(1e3 * row["rmse"][o], 3) for o in outputs),
        ]
        for case, row in cases.items()
    ]
    listed = [
        [diagnosing.label(c), number(c["delta_bic"], 4), number(c["holdout"], 4)] for c in told["refitted candidates"]
    ]
    return {
        "verdict": f"**{told['verdict']}**. {told['text']}",
        "listed": markdown(["candidate", "delta BIC over the plain link", "held-out gap, in weights"], listed),
        "gains": markdown(["", *TRUE, "T, ms", *(f"RMSE {o}, 1e-3" for o in outputs)], gains),
    }


if __name__ == "__main__":
    args = ending.arguments(__doc__, workers=True)
    if not DATA.exists():
        sys.exit("the reference data are not beside the project: ../shared/data/dymola is expected")
    sys.exit(ending.ended(HERE, main(args.workers), tables, None, pin=args.pin))
