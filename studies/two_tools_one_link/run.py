"""A link computed by two other tools: its card calibrated against one of them, and diagnosed without one of its parts.

python studies/two_tools_one_link/run.py [--quick] [--workers N] [--pin]

Needs the reference data beside the project (../shared/data/dynawo); says so where they are absent.
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

from hvdc_ident.data import Array, Experiment, InputSignal, Trajectory, experiment  # noqa: E402  # noqa: E402
from hvdc_ident.discrepancy import DiagnosisOptions, diagnose  # noqa: E402
from hvdc_ident.fit import FitParameter, Problem, fit  # noqa: E402
from hvdc_ident.formats import read_waveforms  # noqa: E402
from hvdc_ident.immutable import FrozenMap  # noqa: E402
from hvdc_ident.model import Model, read_card  # noqa: E402
from hvdc_ident.simulate import ModelSimulator, simulate  # noqa: E402

DATA = HERE / "../../../shared/data/dynawo"
EUROSTAG = {  # output of the card: file, column, by what it is divided to be per unit of 1000 MVA
    "Ip1": ("eurostag_vsca.csv", "VSCA-IPREF", 1.0),
    "Ip2": ("eurostag_vscb.csv", "VSCB-IPREF", 1.0),
    "P1": ("eurostag_vsca.csv", "P/VSCA", 1000.0),
    "P2": ("eurostag_vscb.csv", "P/VSCB", 1000.0),
    "Q1": ("eurostag_vsca.csv", "Q/VSCA", 1000.0),
    "Q2": ("eurostag_vscb.csv", "Q/VSCB", 1000.0),
    "U1": ("eurostag_vsca.csv", "VSCB-UDC1", 1.0),
    "U2": ("eurostag_vscb.csv", "VSCB-UDC2", 1.0),
    "V1": ("eurostag_vsca.csv", "V/BAIXAS", 1.0),
    "V2": ("eurostag_vscb.csv", "V/SLLOGAIA", 1.0),
}
DYNAWO = {  # station 1 of the card is its Conv2
    "Ip1": ("dynawo.csv", "HVDC_hvdc_Conv2_idPu", 1.0),
    "Ip2": ("dynawo.csv", "HVDC_hvdc_Conv1_idPu", 1.0),
    "P1": ("dynawo.csv", "HVDC_hvdc_Conv2_PInjPu", 10.0),
    "P2": ("dynawo.csv", "HVDC_hvdc_Conv1_PInjPu", 10.0),
    "Q1": ("dynawo.csv", "HVDC_hvdc_Conv2_QInjPu", 10.0),
    "Q2": ("dynawo.csv", "HVDC_hvdc_Conv1_QInjPu", 10.0),
    "U1": ("dynawo.csv", "HVDC_hvdc_dCLine_UDc2Pu", 1.0),
    "U2": ("dynawo.csv", "HVDC_hvdc_dCLine_UDc1Pu", 1.0),
    "V1": ("dynawo.csv", "HVDC_hvdc_Conv2_UPu", 1.0),
    "V2": ("dynawo.csv", "HVDC_hvdc_Conv1_UPu", 1.0),
}
TOOLS = {"Eurostag": EUROSTAG, "Dynawo": DYNAWO}
BEGIN, SAMPLE = 0.9025, 5e-3  # s: at rest, and no row falls on an event, where a record has two values
WINDOWS = {"P ramp": (0.9, 2.95), "Vdc step": (2.95, 4.95), "voltage steps": (4.95, 7.95)}
ROLES = {  # part left out: windows fitted, windows held out; the droop does next to nothing in the first two
    "": (("P ramp", "Vdc step"), ("voltage steps",)),
    "droop of the ac voltage controls": (("voltage steps",), ("P ramp",)),
}
COARSE = 1e-2  # s: sampling of what is diagnosed
OPTIONS = DiagnosisOptions(fallback=False)  # no form outside the catalogue is looked for
FAULT = ("fault", (7.95, 10.0))  # compared between the tools only
BANDS = {"Ip1": 1e-3, "Ip2": 1e-3, "Q1": 1e-3, "Q2": 1e-3, "U1": 2e-4, "V1": 2e-4}
"""What is compared, and what each weighs, pu: not noise, the records have none; a tenth of a per cent of the ratings."""
GAINS = ("KP1", "KI1", "KP2", "KI2", "KV")
CALIBRATED = (*GAINS, "C", "Tdc", "droop", "slew")
MEASUREMENT = "10 ms measurement of the dc voltage"
LEFT_OUT: dict[str, dict[str, float]] = {  # part of the card: the values at which it is not there
    MEASUREMENT: {"Tdc": 1e-4},
    "droop of the ac voltage controls": {"droop": 0.0},
    "slew of the power set-point": {"slew": 1000.0},
    "limit of the capacitors' current": {"Icap": 100.0},
}
DRAWN = {  # part: the output that shows it, from when to when
    MEASUREMENT: ("Ip1", 3.98, 4.25),
    "droop of the ac voltage controls": ("Q1", 4.9, 7.9),
    "slew of the power set-point": ("P2", 0.9, 3.0),
}
LISTED = ("Ip1", "P2", "Q1", "Q2", "U1", "V1")
"""The outputs in the README's table; expected.json has them all."""
DIAGNOSED = (MEASUREMENT, "droop of the ac voltage controls", "slew of the power set-point")


def card() -> Model:
    """Return the complete card of the link."""
    return read_card(HERE / "link.toml")


def record(tool: str, time: Array) -> dict[str, Array]:
    """Return a tool's waveforms by the card's outputs, at these instants, pu of 1000 MVA."""
    files = {name: read_waveforms(DATA / name) for name in {f for f, _, _ in TOOLS[tool].values()}}
    return {o: np.interp(time, files[f].time, files[f][c] / unit) for o, (f, c, unit) in TOOLS[tool].items()}


def inputs(model: Model) -> dict[str, InputSignal]:
    """Return the input signals (power, dc voltage and both ac voltages) that the README of the data describes."""
    at = {n: i.value for n, i in model.inputs.items()}
    up, down = at["Uref1"] + 0.0203, at["Uref2"] - 0.1016
    return {
        "Pref2": _held((1.0, -0.45), (2.0, -0.9), first=-0.9),
        "Udcref1": _held((3.0, 0.95), (4.0, 1.0), first=1.0),
        "Uref2": _held((5.0, down), (6.0, at["Uref2"]), first=at["Uref2"]),
        "Uref1": _held((7.0, up), first=at["Uref1"]),
    }


def _held(*steps: tuple[float, float], first: float) -> InputSignal:
    """Return a signal that jumps at the given times."""
    corners, value = [(0.0, first)], first
    for time, new in steps:
        corners += [(time, value), (time, new)]
        value = new
    return InputSignal.corners(tuple(corners))


def experiments(
    tool: str = "Eurostag", outputs: Sequence[str] = tuple(BANDS), sample: float = SAMPLE
) -> tuple[Experiment, ...]:
    """Return the three parts of the record, the voltage steps held out; each starts at a steady state and has its window."""
    moved = inputs(card())
    found = []
    for name, (begin, end) in WINDOWS.items():
        time = np.round(np.arange(BEGIN, end, sample), 6)
        seen = record(tool, time)
        measured = Trajectory(time, np.column_stack([seen[o] for o in outputs]), tuple(outputs), ("pu",) * len(outputs))
        plain = experiment(name, time, moved, event=1.0)
        found.append(
            plain.with_(
                measured=measured,
                noise=FrozenMap({o: BANDS.get(o, 1e-3) for o in outputs}),
                window=(begin, end),
                role="holdout" if name == "voltage steps" else "fit",
            )
        )
    return tuple(found)


def errors(model: Model, tool: str, values: Mapping[str, float] | None = None) -> dict[str, dict[str, float]]:
    """Return the RMSE in pu of every recorded signal by window, the card against a tool."""
    (run,) = (simulate(model, e.with_(measured=None), dict(values or {})) for e in experiments(tool)[-1:])
    seen = record(tool, run.trajectory.time)
    time = run.trajectory.time
    return {
        w: {o: _rms((run[o] - seen[o])[(time >= a) & (time < b)]) for o in EUROSTAG} for w, (a, b) in WINDOWS.items()
    }


def apart() -> dict[str, dict[str, float]]:
    """Return the RMS difference in pu of the two tools by window and signal."""
    time = np.round(np.arange(BEGIN, FAULT[1][1], SAMPLE), 6)
    one, other = record("Eurostag", time), record("Dynawo", time)
    windows = {**WINDOWS, FAULT[0]: FAULT[1]}
    return {
        w: {o: _rms((one[o] - other[o])[(time >= a) & (time < b)]) for o in EUROSTAG} for w, (a, b) in windows.items()
    }


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(x**2)))


def calibrated() -> dict[str, Any]:
    """Return the card's parameters from Eurostag's P ramp and dc voltage step, starts a quarter off, and the RMSE with them."""
    model = card()
    free = tuple(FitParameter(n, 1.25 * model.values[n], model.values[n] / 3, 3 * model.values[n]) for n in CALIBRATED)
    result = fit(Problem(ModelSimulator(model), experiments(), free), starts=2, seed=0)
    return {
        "status": result.status,
        "values": {n: result.values[n] for n in CALIBRATED},
        "rmse": errors(model, "Eurostag", {n: result.values[n] for n in CALIBRATED}),
    }


def named(part: str, executor: Any = None) -> dict[str, Any]:
    """Return the diagnosis of the card without a part, without hints; the gains start at the card's."""
    model = card().with_values(LEFT_OUT[part])
    free = tuple(FitParameter(n, model.values[n], model.values[n] / 3, 3 * model.values[n]) for n in GAINS)
    fitted, held_out = ROLES.get(part, ROLES[""])
    chosen = [
        e.with_(role="fit" if e.name in fitted else "holdout")
        for e in experiments(sample=COARSE)
        if e.name in (*fitted, *held_out)
    ]
    found = diagnose(model, chosen, free, options=OPTIONS, executor=executor, progress=diagnosing.on_stderr(part))
    return diagnosing.told(found)


def main(parts: Sequence[str] = DIAGNOSED, workers: int = 1) -> dict[str, Any]:
    """Return the card against both tools, its calibration, the tools against each other, and the diagnoses part by part."""
    values: dict[str, Any] = {
        "as described": {tool: errors(card(), tool) for tool in TOOLS},
        "calibrated": calibrated(),
        "Dynawo without the measurement": errors(card().with_values(LEFT_OUT[MEASUREMENT]), "Dynawo"),
        "tools apart": apart(),
        "left out": {part: errors(card().with_values(v), "Eurostag") for part, v in LEFT_OUT.items()},
    }
    with processes(workers) as executor:
        values["named"] = {part: named(part, executor) for part in parts}
    return values


def tables(values: Mapping[str, Any]) -> dict[str, str]:
    """Return the README's tables."""
    return {
        "rmse": _by_window(
            {
                "card and Eurostag": values["as described"]["Eurostag"],
                "card and Dynawo": values["as described"]["Dynawo"],
                "card without the 10 ms measurement and Dynawo": values["Dynawo without the measurement"],
                "Eurostag and Dynawo": values["tools apart"],
            }
        ),
        "named": markdown(
            ["removed part", "verdict", "inserted effects", "held-out gap: refitted, with them"],
            [_told(part, v) for part, v in values["named"].items()],
        ),
    }


def _told(part: str, v: Mapping[str, Any]) -> list[str]:
    held = ", ".join(number(v["pooled"][m]["holdout"], 3) for m in ("refitted", "augmented"))
    return [part, v["verdict"], diagnosing.effects_of(v), held]


def _by_window(cases: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    rows = [
        [f"{case}: {w}", *(number(1e3 * row[o], 2) for o in LISTED)]
        for case, by_window in cases.items()
        for w, row in by_window.items()
    ]
    return markdown(["RMS, 1e-3 pu", *LISTED], rows)


def draw(values: Mapping[str, Any]) -> Any:
    """Draw both tools and the card without each part, its gains refitted, and with what was found, where the part matters."""
    from hvdc_ident.report.drawing import AFTER, BEFORE, MARK, MEASURED, figure

    whole = experiments()[-1].with_(measured=None)
    time = whole.time
    seen = {tool: record(tool, time) for tool in TOOLS}
    fig = figure(12, 3.8)
    for axes, (part, (output, begin, end)) in zip(fig.subplots(1, len(DRAWN)), DRAWN.items(), strict=True):
        told, without = values["named"][part], card().with_values(LEFT_OUT[part])
        with_it = diagnosing.augmented(without, told["effects"])
        rows = (time >= begin) & (time < end)
        axes.plot(time[rows], seen["Dynawo"][output][rows], color=MARK, lw=1.2, label="Dynawo")
        axes.plot(time[rows], seen["Eurostag"][output][rows], color=MEASURED, lw=2.5, label="Eurostag")
        for model, key, colour, words in (
            (without, "refitted", BEFORE, "card without the part, refitted"),
            (with_it, "augmented", AFTER, "with the effects found"),
        ):
            run = simulate(model, whole, {n: told[key][n] for n in GAINS})
            axes.plot(time[rows], run[output][rows], color=colour, lw=1.2, ls="--", label=words)
        axes.set(xlabel="time, s", ylabel=f"{output}, pu")
        axes.set_title(f"without {part}", fontsize=9)
        axes.legend(fontsize=7)
    return fig


if __name__ == "__main__":
    args = ending.arguments(__doc__, quick="without the diagnoses", workers=True)
    if not DATA.exists():
        sys.exit("the reference data are not beside the project: ../shared/data/dynawo is expected")
    found = main(() if args.quick else DIAGNOSED, args.workers)
    sys.exit(ending.ended(HERE, found, tables, draw, pin=args.pin, whole=not args.quick))
