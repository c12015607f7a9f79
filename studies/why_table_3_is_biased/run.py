"""Why the gains of Table III differ from Table I: a missing delay, the diagnoses without hints, and other causes.

python studies/why_table_3_is_biased/run.py [--quick] [--workers N] [--pin]
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
sys.path[:0] = [str(HERE), str(HERE.parent)]
from bias import diagnosed, hypotheses, page  # noqa: E402
from common import ending, paper  # noqa: E402
from common.ending import markdown, number  # noqa: E402
from common.work import processes  # noqa: E402

from hvdc_ident.data import Experiment, InputSignal, experiment  # noqa: E402
from hvdc_ident.effects import apply_effects  # noqa: E402
from hvdc_ident.fit import FitParameter, Problem, fit  # noqa: E402
from hvdc_ident.immutable import FrozenMap  # noqa: E402
from hvdc_ident.model import Model  # noqa: E402
from hvdc_ident.models import load_model, vsc_hvdc_avm  # noqa: E402
from hvdc_ident.simulate import ModelSimulator, simulate  # noqa: E402

LAG = 1.6e-3  # s, planted
LAGGED = {"effect": "lag", "at": ["Ir1", "Ii1", "Ir2", "Ii2"], "parameters": {"T": LAG}}
LAG_NAME = "lag_Ir1_T"  # what the model calls it
PLANTED = {  # experiment: set-point, its course; the ramps take 0.1 s
    "vdc-step": ("Vdcref1", InputSignal.step(0.1, 1.0, 1.019)),
    "vdc-ramp": ("Vdcref1", InputSignal.ramp(0.1, 1.0, 0.2, 1.019)),
    "p-step": ("Pref2", InputSignal.step(0.1, 0.4, 0.5)),
    "p-ramp": ("Pref2", InputSignal.ramp(0.1, 0.4, 0.2, 0.5)),
    "q-step": ("Qref1", InputSignal.step(0.1, 0.0, 0.1)),
}
MOVED = ("KIP", "KIVDC", "KPVDC", "KIQ")
KNOWN = {"KIP": 31.3, "KIVDC": 896.0, "KPVDC": 25.3}  # independent computation, other window and sampling

FILTERED = ("P", "Q", "Vdc")
FEWER = (
    10.0  # a tenth of the reactances and ten times the integral gain: the loop ten times as fast, its voltages as large
)
FAST = 100.0  # a part that is made so many times faster or smaller is as good as not there
PARTS: dict[str, dict[str, float]] = {  # part of the average-value link: by what its parameters are multiplied
    "dc-side inductance": {"Ls": 1 / FAST},
    "inner current loop's time": {"XT": 1 / FEWER, "XA": 1 / FEWER, "KX": 1 / FEWER, "KII": FEWER},
    "lag of the voltage feed-forward": {"FF": FAST},
    "Bessel filter on the ac voltage": {"FV": FAST},
    "PLL's window of a cycle": {"Tpll": 1 / FAST},
    "losses": {"RT": 1 / FAST, "Rs": 1 / FAST},
}

LISTED = ("no inner current loop's time", "all of these off")
"""The parts switched off that the README's table has beside the filters; the others change little."""


def main(parts: Sequence[str] = tuple(PARTS), workers: int = 1) -> dict[str, Any]:
    """Return the mechanism, the diagnoses and their effect, the bias by part of the reference, and the causes' scores.

    With fewer parts there are no diagnoses, which take most of the time.
    """
    filters = {name: vsc_hvdc_avm.model(chosen) for name, chosen in filter_choices().items()}
    values: dict[str, Any] = {
        "planted": planted(),
        "filters": {name: fitted(model) for name, model in filters.items()},
        "parts off, with filters": switched_off(filters["P, Q, Vdc"], parts),
        "parts off, without filters": switched_off(filters["none"], parts),
    }
    with processes(workers) as executor:
        values["causes"] = causes(executor=executor)
        if len(parts) == len(PARTS):
            values |= told_nothing(executor)
    return values


def causes(names: Sequence[str] = (), count: int = hypotheses.RUNS, executor: Any = None) -> dict[str, Any]:
    """Return Table III and Fig. 8 for each cause, or for the causes named."""
    chosen = {n: c for n, c in hypotheses.causes().items() if not names or n in names}
    found = {}
    for name, cause in chosen.items():
        hypotheses.on_stderr(f"cause: {name}")
        found[name] = hypotheses.judged(cause, count, executor)
    return found


def told_nothing(executor: Any = None) -> dict[str, Any]:
    """Return the diagnoses of ASKED, also with more noise, and Fig. 8 with the inserted effects."""
    found, finer = (
        {name: diagnosed.diagnosis(name, executor=executor) for name in asked}
        for asked in (diagnosed.TOLD_NOTHING, diagnosed.FINER)
    )
    louder = {
        name: {f"{noise:g}": diagnosed.diagnosis(name, noise=noise, executor=executor) for noise in diagnosed.LOUDER}
        for name in found
    }
    return {"told nothing": found, "louder": louder, "finer": finer} | after(found | finer)


def after(found: Mapping[str, Any]) -> dict[str, Any]:
    """Return the gains and Fig. 8 with the named effects, or with the best of the first round, for each of ASKED."""
    put_in = {name: diagnosed.put_in(told, name) for name, told in found.items()}
    return {"put in": put_in, "figure 8": {name: diagnosed.figure_8(told) for name, told in put_in.items()}}


def planted() -> dict[str, Any]:
    """Return the gains of the plain link, and of the link with a lag, fitted to the link with a lag of 1.6 ms on all currents."""
    lagged = apply_effects(load_model(paper.LINK), [LAGGED])
    experiments = [recorded(lagged, name) for name in PLANTED]
    plain = fit(Problem(paper.link(), tuple(experiments), paper.free(MOVED)), starts=4)
    begun = (*paper.free(MOVED), FitParameter(LAG_NAME, 5e-4, 1e-5, 1e-2))
    whole = fit(Problem(ModelSimulator(lagged), tuple(experiments), begun), starts=4)
    return {
        "plain link": {n: plain.values[n] for n in MOVED} | {"status": plain.status},
        "with the lag": {n: whole.values[n] for n in (*MOVED, LAG_NAME)} | {"status": whole.status},
    }


def recorded(model: Model, name: str) -> Experiment:
    """Return one of the planted experiments, 0.9 s every 0.5 ms, with equal weights on all three outputs."""
    setpoint, course = PLANTED[name]
    time = np.round(np.arange(round(paper.END / paper.SAMPLE) + 1) * paper.SAMPLE, 9)
    plain = experiment(name, time, {setpoint: course}, event=paper.EVENT)
    alike = FrozenMap(dict.fromkeys(paper.OUTPUTS, paper.EQUAL))
    return plain.with_(measured=simulate(model, plain, outputs=paper.OUTPUTS).trajectory, noise=alike)


def filter_choices() -> dict[str, tuple[Any, ...]]:
    """Return the sets of filtered measurements: all, each left out, none."""
    left_out = {f"without {m}'s": tuple(k for k in FILTERED if k != m) for m in FILTERED}
    return {", ".join(FILTERED): FILTERED, **left_out, "none": ()}


def switched_off(model: Model, parts: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return the fitted gains with each part of the average-value link switched off separately, and with all of them off."""
    found = {}
    for part in parts:
        found[part] = fitted(without(model, PARTS[part]))
    if len(parts) == len(PARTS):
        found["all of these"] = fitted(without(model, {n: by for part in PARTS.values() for n, by in part.items()}))
    return found


def without(model: Model, factors: Mapping[str, float]) -> Model:
    """Return the model with some parameters multiplied."""
    return model.with_values({n: model.values[n] * by for n, by in factors.items()})


def fitted(model: Model) -> dict[str, float]:
    """Return the phasor link's gains, each controller separately, on its own output in one step of its set-point."""
    found: dict[str, float] = {}
    for kind, c in paper.CONTROLLERS.items():
        problem = Problem(paper.link(), (paper.step(kind, model, [c.output]),), wide(c.gains))
        result = fit(problem, starts=2)
        if result.status not in ("converged", "at-bound"):
            raise RuntimeError(f"the fit of {kind} ended without an estimate: {result.message}")
        found |= {n: result.values[n] for n in c.gains}
    return found


def wide(names: Sequence[str]) -> tuple[FitParameter, ...]:
    """Return Table II's starts with bounds that no result here reaches."""
    return tuple(FitParameter(n, paper.TABLE_2[n][2], 0.0, 4.0 * paper.TABLE_2[n][1]) for n in names)


def tables(values: Mapping[str, Any]) -> dict[str, str]:
    """Return the README's tables."""
    p = values["planted"]
    plant = [
        [
            n,
            number(paper.TABLE_1[n]),
            number(paper.TABLE_3[n]["II"]["mean"]),
            number(KNOWN[n], 3) if n in KNOWN else "-",
            number(p["plain link"][n]),
            number(p["with the lag"][n], 5),
        ]
        for n in MOVED
    ]
    plant.append(["lag, ms", number(1e3 * LAG), "-", "-", "-", number(1e3 * p["with the lag"][LAG_NAME], 5)])
    head = [
        "",
        "planted",
        "paper, Table III",
        "plain link, independent computation",
        "plain link",
        "lag added, all refitted",
    ]
    rows = [[name, *row(v)] for name, v in cases(values).items() if name.startswith("filters") or name.endswith(LISTED)]
    return {
        "planted": markdown(head, plant),
        "parts": markdown(["average-value link", *MOVED, *(f"bias of {n}, %" for n in MOVED[:3])], rows),
    } | page.tables(values)


def cases(values: Mapping[str, Any]) -> dict[str, Mapping[str, float]]:
    """Return the fitted gains by variant of the average-value link."""
    found = {f"filters: {n}": v for n, v in values["filters"].items()}
    for base in ("with filters", "without filters"):
        for part, v in values[f"parts off, {base}"].items():
            found[f"{base}, {part} off" if part.startswith("all") else f"{base}, no {part}"] = v
    return found


def row(v: Mapping[str, float]) -> list[str]:
    """Return the gains and their bias as text."""
    bias = [f"{100 * (v[n] / paper.TABLE_1[n] - 1):+.1f}" for n in MOVED[:3]]
    return [*(number(v[n]) for n in MOVED), *bias]


if __name__ == "__main__":
    args = ending.arguments(
        __doc__, quick="without most parts of the average-value link, and without the diagnoses", workers=True
    )
    parts = tuple(PARTS)[:1] if args.quick else tuple(PARTS)
    found = main(parts, args.workers)
    sys.exit(ending.ended(HERE, found, tables, page.draw, pin=args.pin, whole=not args.quick))
