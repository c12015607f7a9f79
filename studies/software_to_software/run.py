"""The average-value link against Dymola, and the phasor link against the average-value link.

    python studies/software_to_software/run.py [folder for the plots, default study-results/ beside this file]

The first part needs the reference data beside the project (../shared/data/dymola); without them it is left out.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from hvdc_ident.data import InputSignal, Trajectory, experiment, trajectory
from hvdc_ident.formats import read_waveforms
from hvdc_ident.models import load_model
from hvdc_ident.simulate import simulate

HERE = Path(__file__).resolve().parent
DATA = HERE.parents[2] / "shared" / "data" / "dymola" / "TwoNodePowerSystem.mat"
FROM, STEP = 0.6, 0.8  # s: the start-up before 0.6 s is no test; P* goes from 1 to 0.5 at 0.8 s
P, V = "vSC_MMC_AVMP", "vSC_MMC_AVMVDC"  # Dymola's station P (station 2 here) and station Vdc (station 1)

SIGNALS = {  # here: (Dymola's name, factor to per unit, what it is)
    "P2": (f"{P}.upperLevel.p_Controller.P", 1.0, "P, station P"),
    "Irorder2": (f"{P}.upperLevel.innerControl.Id_ref", 1.0, "Id_ref, station P"),
    "Ir2": (f"{P}.upperLevel.innerControl.Id", 1.0, "Id, station P"),
    "Q2": (f"{P}.upperLevel.q_Controller.Q", 1.0, "Q, station P"),
    "Vc2": (f"{P}.aVM.capacitor.v", -1 / 640e3, "capacitor voltage, station P"),
    "Irorder1": (f"{V}.upperLevel.innerControl.Id_ref", 1.0, "Id_ref, station Vdc"),
    "Ir1": (f"{V}.upperLevel.innerControl.Id", 1.0, "Id, station Vdc"),
    "Q1": (f"{V}.upperLevel.q_Controller.Q", 1.0, "Q, station Vdc"),
    "Vc1": (f"{V}.aVM.capacitor.v", -1 / 640e3, "capacitor voltage, station Vdc"),
    "Vdc1": (f"{V}.upperLevel.vDC_Controller.u", 1.0, "Vdc controller's input"),
    "yv": (f"{V}.upperLevel.vDC_Controller.y", 1.0, "Vdc controller's output"),
    "Idc": ("resistor.i", 640e3 / 1e9, "dc line current"),
}

STEPS = {  # the paper's Fig. 3: one step of each set-point
    "P step 0.4 to 0.5": ("Pref2", 0.4, 0.5),
    "Q step 0 to 0.1": ("Qref1", 0.0, 0.1),
    "Vdc step 1 to 1.019": ("Vdcref1", 1.0, 1.019),
}
SHOWN = ("P1", "Q1", "Vdc1", "P2", "Q2", "Vdc2", "Irorder1", "Iiorder1", "Irorder2", "Iiorder2")


def against_dymola() -> tuple[Trajectory, Trajectory]:
    """Return Dymola's waveforms and those of the average-value link, pu, under this project's names, from 0.6 s on."""
    recorded = read_waveforms(DATA, [name for name, _, _ in SIGNALS.values()])
    recorded = recorded.rows(recorded.time >= FROM)
    theirs = {here: recorded[name] * factor for here, (name, factor, _) in SIGNALS.items()}
    step = experiment("p-step", recorded.time, {"Pref2": InputSignal.step(STEP, 1.0, 0.5)})
    ours = simulate(load_model("vsc-hvdc-avm-authors"), step, outputs=list(SIGNALS)).trajectory
    return trajectory(recorded.time, theirs), ours


def ripple(recorded: Trajectory) -> dict[str, float]:
    """Return the RMS of each signal about its mean from 0.7 to 0.8 s, before the event, in % of its range.

    Dymola integrates rotating three-phase quantities, so that its solver's errors appear as a ripple.
    """
    quiet = (recorded.time >= 0.7) & (recorded.time < STEP)
    return {n: float(100 * recorded[n][quiet].std() / np.ptp(recorded[n])) for n in recorded.names}


def phasor_against_avm() -> dict[str, tuple[Trajectory, Trajectory]]:
    """Return by step the outputs of the average-value link (with its filters) and of the phasor link, pu, 0.9 s from steady state."""
    time = np.round(np.arange(1801) * 5e-4, 9)
    found = {}
    for label, (moved, before, after) in STEPS.items():
        step = experiment("step", time, {moved: InputSignal.step(0.1, before, after)})
        pair = [simulate(load_model(m), step, outputs=SHOWN).trajectory for m in ("vsc-hvdc-avm", "vsc-hvdc-link")]
        found[label] = (pair[0], pair[1])
    return found


def errors(reference: Trajectory, other: Trajectory) -> dict[str, dict[str, float]]:
    """Return RMSE and largest error in % of the range, and RMSE and range in pu, by signal; constant signals are left out."""
    found = {}
    for name in reference.names:
        gap, span = other[name] - reference[name], float(np.ptp(reference[name]))
        if span < 1e-3:
            continue
        rmse, most = float(np.sqrt(np.mean(gap**2))), float(np.abs(gap).max())
        found[name] = {"rmse_%": 100 * rmse / span, "max_%": 100 * most / span, "rmse": rmse, "range": span}
    return found


def plot(
    pairs: dict[str, tuple[Trajectory, Trajectory]], signals: tuple[str, ...], words: tuple[str, str], to: Path
) -> None:
    """Write a figure of overlaid waveforms, one row for each signal and one column for each case."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    size = (4.2 * len(pairs) + 2, 1.7 * len(signals) + 0.6)
    figure, axes = plt.subplots(
        len(signals), len(pairs), sharex="col", squeeze=False, figsize=size, layout="constrained"
    )
    for column, (label, (reference, other)) in enumerate(pairs.items()):
        axes[0, column].set_title(label)
        for row, name in enumerate(signals):
            for data, line in ((reference, "-"), (other, "--")):
                axes[row, column].plot(data.time, data[name], line, linewidth=1.2)
            axes[row, column].set_ylabel(f"{name}, pu")
        axes[-1, column].set_xlabel("time, s")
    axes[0, 0].legend(words)
    to.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(to, dpi=80)
    plt.close(figure)


def main(results: Path = HERE / "study-results", plots: bool = True) -> dict[str, Any]:
    """Write the plots into `results` and return the errors by comparison and signal."""
    pairs = phasor_against_avm()
    found: dict[str, Any] = {"phasor against average-value": {k: errors(*v) for k, v in pairs.items()}}
    if plots:
        plot(pairs, ("P2", "Q1", "Vdc1", "Irorder1"), ("average-value", "phasor"), results / "phasor.png")
    if DATA.exists():
        both = against_dymola()
        table = errors(*both)
        found["average-value against Dymola"] = {n: e | {"ripple_%": ripple(both[0])[n]} for n, e in table.items()}
        if plots:
            case = {"P* from 1 to 0.5 at 0.8 s, authors' rating": both}
            plot(case, tuple(SIGNALS), ("Dymola", "average-value"), results / "dymola.png")
    return found


def show(table: dict[str, dict[str, float]], words: dict[str, str]) -> None:
    """Print the table."""
    print(f"  {'signal':10s}{'RMSE, %':>10s}{'max, %':>10s}{'ripple, %':>11s}{'range, pu':>11s}")
    for name, e in table.items():
        own = f"{e['ripple_%']:11.3f}" if "ripple_%" in e else " " * 11
        print(f"  {name:10s}{e['rmse_%']:10.3f}{e['max_%']:10.3f}{own}{e['range']:11.5f}  {words.get(name, '')}")


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "study-results"
    result = main(folder)
    for comparison, table in result.items():
        if comparison.startswith("phasor"):
            for label, inner in table.items():
                print(f"{comparison}: {label}")
                show(inner, {})
        else:
            print(comparison)
            show(table, {n: text for n, (_, _, text) in SIGNALS.items()})
    if not DATA.exists():
        print(f"reference data not found beside the project ({DATA.name}): the comparison with Dymola is left out")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "result.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(f"plots and numbers: {folder}")
