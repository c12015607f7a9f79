"""Shared by figure_8 and figure_9: the error of Irorder1 over KIVDC, with likelihood, verdicts and modes.

Reference waveforms come from the average-value link in the paper's case, the model under test is the phasor link.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from hvdc_ident.data import Array, Experiment, InputSignal, experiment, trajectory
from hvdc_ident.files import csv_text, json_text, write_text
from hvdc_ident.fit import FitParameter
from hvdc_ident.fit.whitening import autocorrelation
from hvdc_ident.identifiability import identifiability
from hvdc_ident.linearize import find_operating_point, loop, margins
from hvdc_ident.models import load_model
from hvdc_ident.sensitivity import SweepResult, sweep, trajectory_sensitivities
from hvdc_ident.simulate import simulate
from hvdc_ident.study.stages.sweep import sweep_axes
from hvdc_ident.study.study import Study, load_study

REFERENCE = "vsc-hvdc-avm"  # the switch: any model with the link's names
OUTPUT = "Irorder1"
EVENT, END, SAMPLE = 0.1, 0.9, 5e-4  # s
MOVES = {  # experiment: what moves at the event, from, to (pu)
    "vdc-step": ("Vdcref1", 1.0, 1.019),
    "load-step": ("Iload1", 0.0, 0.2),
}
NOISE = (1e-5, 1e-4, 1e-3, 3e-3, 1e-2, 3e-2)  # pu, standard deviation, white, every 0.5 ms
RISE = 1.92  # of the negative log-likelihood at the ends of a 95 % interval


def write_waveforms(folder: Path) -> None:
    """Write the reference waveforms into the folder, one CSV file for each experiment."""
    time = np.round(np.arange(round(END / SAMPLE) + 1) * SAMPLE, 9)
    for name, (moved, before, after) in MOVES.items():
        signal = InputSignal.step(EVENT, before, after)
        run = simulate(load_model(REFERENCE), experiment(name, time, {moved: signal}), outputs=(OUTPUT,))
        columns = np.column_stack([time, signal(time), np.round(run[OUTPUT], 9)])
        write_text(folder / f"{name}.csv", csv_text(["time", moved, OUTPUT], columns.tolist()))


def correlation(study: Study, e: Experiment, values: dict[str, float]) -> float:
    """Return the AR(1) coefficient of the residual at the values."""
    assert e.measured is not None
    run = simulate(study.model, e, values, outputs=(OUTPUT,))[OUTPUT]
    return autocorrelation([e.measured[OUTPUT] - run], 1)


def curve(study: Study, found: SweepResult, e: Experiment, noise: float = 0.0) -> dict[str, Any]:
    """Return the rise of the negative log-likelihood along the sweep, n/2 log(rmse^2/rmse_min^2), and its 95 % interval.

    n: effective number of independent samples. The misfit is correlated from row to row, the noise is white: together
    n = N (m^2 + s^2)/(m^2 (1 + rho)/(1 - rho) + s^2) for N rows, with the misfit's floor m and the noise s.
    """
    x, squares = found.values("KIVDC"), found.error(OUTPUT, e.name) ** 2
    low = int(np.argmin(squares))
    rho, floor = correlation(study, e, {"KIVDC": float(x[low])}), float(squares[low])
    n = e.time.size * (floor + noise**2) / (floor * (1 + rho) / (1 - rho) + noise**2)
    rises = 0.5 * n * np.log((squares + noise**2) / (floor + noise**2))
    return {
        "optimum": float(x[low]),
        "rmse_min": float(np.sqrt(floor + noise**2)),
        "effective_samples": float(n),
        "rise_at_ends": [float(rises[0]), float(rises[-1])],
        "interval": crossings(x, rises, low),
    }


def crossings(x: Array, rises: Array, low: int) -> list[float | None]:
    """Return the values at which the rise exceeds 1.92 below and above the minimum; None outside the sweep."""
    ends: list[float | None] = []
    for side in (range(low, 0, -1), range(low, x.size - 1)):
        step = -1 if isinstance(side, range) and side.step == -1 else 1
        hit = next((i for i in side if rises[i] <= RISE < rises[i + step]), None)
        if hit is None:
            ends.append(None)
        else:
            share = (RISE - rises[hit]) / (rises[hit + step] - rises[hit])
            ends.append(float(x[hit] + share * (x[hit + step] - x[hit])))
    return ends


def information(study: Study) -> dict[str, dict[str, float]]:
    """Return the relative 95 % half-width of KIVDC by noise level, KPVDC unknown too, for white noise alone."""
    at = {"KIVDC": 850.0, "KPVDC": 26.2}
    s = trajectory_sensitivities(study.model, study.experiments, ["KIVDC", "KPVDC"], values=at)
    j = {name: np.column_stack([s.of(name, OUTPUT, p) for p in s.parameters]) for name in MOVES}
    cases = {"vdc-step": [j["vdc-step"]], "with load step": [j["vdc-step"], j["load-step"]]}
    table = {}
    for case, rows in cases.items():
        std = float(np.sqrt(np.linalg.inv(sum(r.T @ r for r in rows))[0, 0]))
        table[case] = {f"{n:g}": 1.96 * n * std / at["KIVDC"] for n in NOISE}
    return table


def verdicts(study: Study, bounds: tuple[float, float]) -> list[dict[str, Any]]:
    """Return the identifiability verdicts on KIVDC, KPVDC unknown too, by noise level, without and with the load step."""
    free = [FitParameter("KPVDC", 20, 10, 40), FitParameter("KIVDC", min(max(750, bounds[0]), bounds[1]), *bounds)]
    found = []
    for noise in NOISE:
        random = np.random.default_rng(1)
        noisy = []
        for e in study.experiments:
            assert e.measured is not None
            seen = e.measured[OUTPUT] + noise * random.standard_normal(e.time.size)
            noisy.append(e.with_(measured=trajectory(e.time, {OUTPUT: seen}), noise={OUTPUT: noise}))
        for case, chosen in (("vdc-step", noisy[:1]), ("with load step", noisy)):
            report = identifiability(study.model, chosen, free, starts=4)
            v = report.parameters["KIVDC"]
            found.append(
                {
                    "noise": noise,
                    "experiments": case,
                    "verdict": v.verdict,
                    "value": v.value,
                    "ci95": list(v.ci95) if v.ci95 else None,
                    "misspecified": bool(report.to_dict()["misspecified"]),
                }
            )
    return found


def modes(study: Study, values: list[float]) -> list[dict[str, float | None]]:
    """Return the dc voltage mode and the margins of its loop, opened at the control error, at some values of KIVDC."""
    found = []
    for value in values:
        model = study.model.with_values({"KIVDC": value})
        opened = loop(model, "ev", find_operating_point(model))
        closed = opened.closed_poles()
        pair = [p for p in closed if 5 < abs(p) < 500 and abs(p + 30) > 1e-3]
        slow = max(pair, key=lambda p: (p.real, p.imag))
        m = margins(opened)
        found.append(
            {
                "KIVDC": value,
                "real": float(slow.real),
                "frequency_hz": float(abs(slow.imag) / (2 * np.pi)),
                "damping": float(-slow.real / abs(slow)) if slow.imag else 1.0,
                "phase_margin_deg": float(m.phase_margin.value),
                "delay_margin_s": float(m.delay.value),
                "modulus_margin": float(m.modulus.value),
            }
        )
    return found


def swept(study: Study) -> SweepResult:
    """Return the sweep that the study file defines."""
    return sweep(
        study.model, study.experiments, sweep_axes(study.settings.sweep, 0), values=study.values, want=("rmse", "poles")
    )


def draw(found: SweepResult, curves: dict[str, Any], title: str, paper: dict[float, float]) -> Any:
    """Draw RMSE over KIVDC with the paper's numbers, the rise of the negative log-likelihood, and the poles."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    x = found.values("KIVDC")
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    for name in MOVES:
        left.plot(x, found.error(OUTPUT, name), label=name)
        squares = found.error(OUTPUT, name) ** 2
        n = curves[name]["effective_samples"]
        middle.plot(x, 0.5 * n * np.log(squares / squares.min()), label=f"{name}, {n:.0f} samples")
    if paper:
        left.plot(list(paper), list(paper.values()), "k.", label="the paper (Fig. 8)")
    left.set(xlabel="KIVDC, pu/s", ylabel="RMSE of Irorder1, pu", title=title)
    left.set_ylim(bottom=0)
    middle.axhline(RISE, color="0.6", linestyle=":")
    middle.set(xlabel="KIVDC, pu/s", ylabel="rise of the negative log-likelihood", title="against the misfit floor")
    middle.set_ylim(0, 30)
    near = np.abs(found.poles) < 500
    color = np.broadcast_to(x[:, None], found.poles.shape)[near]
    dots = right.scatter(found.poles.real[near], found.poles.imag[near] / (2 * np.pi), c=color, s=5)
    figure.colorbar(dots, ax=right, label="KIVDC, pu/s")
    right.set(xlabel="real part, 1/s", ylabel="imaginary part, Hz", title="poles")
    left.legend(fontsize=8)
    middle.legend(fontsize=8)
    return figure


def main(folder: Path, title: str, at: tuple[float, ...], paper: dict[float, float]) -> dict[str, Any]:
    """Write result.json and figure.svg into the folder and return the numbers of the README."""
    write_waveforms(folder)
    study = load_study(folder / "study.toml")
    found = swept(study)
    x = found.values("KIVDC")
    bounds = (float(x[0]), float(x[-1]))
    errors = sweep(study.model, study.experiments, {"KIVDC": at})
    emtp = sweep(study.model, study.experiments[:1], {"KPVDC": [24.0], "KIVDC": [734.7]})
    by_name = {e.name: e for e in study.experiments}
    curves = {name: curve(study, found, by_name[name]) for name in MOVES}
    result = {
        "rmse": {name: dict(zip(map(str, at), errors.error(OUTPUT, name).tolist(), strict=True)) for name in MOVES},
        "rmse with the true gains": float(emtp.rmse[0, 0]),
        "curves": curves,
        "curves with noise": {f"{n:g}": curve(study, found, by_name["vdc-step"], n) for n in NOISE},
        "first order": information(study),
        "verdicts": verdicts(study, bounds),
        "modes": modes(study, list(at)),
    }
    write_text(folder / "result.json", json_text(result))
    figure = draw(found, curves, title, paper)
    import matplotlib

    with matplotlib.rc_context({"svg.hashsalt": title, "svg.fonttype": "none"}):
        figure.savefig(folder / "figure.svg", metadata={"Date": None})
    return result


def tell(folder: Path, result: dict[str, Any]) -> None:
    """Print the numbers beside the expected ones."""
    expected = json.loads((folder / "expected.json").read_text(encoding="utf-8"))
    for name, line in result["rmse"].items():
        print(f"RMSE of {OUTPUT}, {name}, pu")
        for value, error in line.items():
            known = expected["rmse"].get(name, {}).get(value)
            print(f"  KIVDC {float(value):7.1f}  {error:.5f}" + (f"   expected {known:g}" if known else ""))
    print(f"with the true gains {result['rmse with the true gains']:.5f}")
    for name, c in {**result["curves"], **{f"noise {n}": c for n, c in result["curves with noise"].items()}}.items():
        ends = ", ".join("-" if v is None else f"{v:.0f}" for v in c["interval"])
        rises = ", ".join(f"{r:.3g}" for r in c["rise_at_ends"])
        n = c["effective_samples"]
        print(f"{name:12s} optimum {c['optimum']:.0f}, {n:.0f} samples, 95 %: {ends}; at the ends {rises}")
    for case, line in result["first order"].items():
        print(case, {k: f"{100 * v:.3g} %" for k, v in line.items()})
    for v in result["verdicts"]:
        ci = "-" if v["ci95"] is None else " to ".join("-" if c is None else f"{c:.0f}" for c in v["ci95"])
        print(
            f"noise {v['noise']:g}, {v['experiments']:14s} {v['verdict']:28s} {v['value']:.0f} ({ci}) misspecified {v['misspecified']}"
        )
    for m in result["modes"]:
        print("  ".join(f"{k} {v:.4g}" for k, v in m.items()))
