"""Models exported as FMUs and imported again: trajectories, linear models, identifiable sets and estimates.

    python studies/fmu_round_trip/run.py            (every model and effect, and the full studies)
    python studies/fmu_round_trip/run.py --quick    (the link and three effects; one full study)

Each model is exported, loaded again as an FMU in a process of its own, and compared with the sympy model it came from.
Needs a C compiler. Exit code 1 where a number is beyond its limit in expected.json.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hvdc_ident.data import Experiment, InputSignal, experiment
from hvdc_ident.effects import EffectUse, apply_effects, effects
from hvdc_ident.files import csv_text, json_text, write_text
from hvdc_ident.fmu.export import export_fmu
from hvdc_ident.linearize import linearize
from hvdc_ident.model import Model, save_card
from hvdc_ident.models import load_model, shipped_models
from hvdc_ident.simulate import simulate
from hvdc_ident.study.pipeline import run_stage
from hvdc_ident.study.stages import StageOptions
from hvdc_ident.study.study import load_study

HERE = Path(__file__).resolve().parent
KINDS = {"ME": "model-exchange", "CS": "co-simulation"}
SLOT, STATE, SOURCE = "P2_m", "xp", "Vdc2"
QUICK = ("vsc-hvdc-link", "lag", "limit", "delay")
RTOL = 1e-9
PARTS = ("agreement", "studies")
NOISE = 1e-4  # pu, standard deviation of the studies' recordings


def models(quick: bool) -> Iterator[tuple[str, Model]]:
    """Return every shipped model, and the link with each effect of the catalogue in its P loop."""
    for name in shipped_models():
        if not quick or name in QUICK:
            yield name, load_model(name)
    link = load_model("vsc-hvdc-link")
    for name, effect in effects().items():
        if quick and name not in QUICK:
            continue
        use = EffectUse(
            name,
            (STATE if effect.of_derivative else SLOT,),
            effect.example,
            source=SOURCE if effect.needs_source else "",
            expression=f"k*{SOURCE}**2" if effect.needs_expression else "",
        )
        yield f"link, {name}", apply_effects(link, [use])


def case(model: Model) -> Experiment:
    """Return steps of the first power and voltage set-points; no row coincides with a sampling instant."""
    rows = np.concatenate([[0.0], np.linspace(0.00057, 0.3, 211)])
    moved = [n for n in model.inputs if n.startswith("Pref")][:1] + [n for n in model.inputs if n.startswith("Vdcref")][
        :1
    ]
    inputs = {}
    for k, name in enumerate(moved):
        at = model.inputs[name].value
        inputs[name] = InputSignal.step(0.0501 + 0.1 * k, at, at + (0.1, 0.01)[k])
    return experiment("case", rows, inputs)


def worst(found: Any, expected: Any, names: Mapping[str, Any]) -> float:
    """Return the largest difference of two runs, relative to each output's largest magnitude (at least 1e-3)."""
    return max(float(np.abs(found[n] - expected[n]).max() / (np.abs(expected[n]).max() + 1e-3)) for n in names)


def agreement(model: Model, folder: Path) -> dict[str, float]:
    """Return differences between the model and its FMUs: trajectories by version and kind, and A, B, C, D."""
    e, row = case(model), {}
    reference = simulate(model, e, rtol=1e-3 * RTOL)
    for version in ("2.0", "3.0"):
        path = export_fmu(model, folder / f"fmi{version[0]}.fmu", version=version, binary=True).path
        for short, kind in KINDS.items():
            fmu = load_model(path, interface=kind)
            row[f"{short} {version[0]}"] = worst(simulate(fmu, e, rtol=RTOL), reference, model.outputs)
    if not (model.delays or model.sampled):
        ours, theirs = linearize(model), linearize(load_model(folder / "fmi2.fmu", interface="model-exchange"))
        pairs = [(getattr(ours, m), getattr(theirs, m)) for m in "ABCD"]
        scale = max(1.0, *(float(np.abs(a).max()) for a, _ in pairs))
        row["A, B, C, D"] = max(float(np.abs(a - b).max()) for a, b in pairs) / scale
    return row


class Case(NamedTuple):
    """A full study: a model, its experiment and its fit parameters."""

    model: Callable[[], Model]
    candidates: Mapping[str, tuple[float, float, float]]  # start, min, max
    output: str
    amplitude: float = 0.019


CASES = {
    "link": Case(
        lambda: load_model("vsc-hvdc-link"), {"KPVDC": (20.0, 10.0, 40.0), "KIVDC": (650.0, 550.0, 950.0)}, "Irorder1"
    ),
    "link with a lag": Case(
        lambda: apply_effects(
            load_model("vsc-hvdc-link"), [{"effect": "lag", "at": ["Ir1", "Ir2"], "parameters": {"T": 0.0016}}]
        ),
        {"KPVDC": (20.0, 10.0, 40.0), "KIVDC": (650.0, 550.0, 950.0), "lag_Ir1_T": (0.001, 1e-4, 0.01)},
        "Irorder1",
    ),
    "average-value link": Case(
        lambda: load_model("vsc-hvdc-avm"), {"KPVDC": (20.0, 10.0, 40.0), "KIVDC": (650.0, 550.0, 950.0)}, "Irorder1"
    ),
}


def full_study(chosen: Case, folder: Path, kinds: Mapping[str, str]) -> dict[str, Any]:
    """Return the identifiable sets of the model and its FMUs, and the differences of the estimates in standard deviations."""
    model = chosen.model()
    folder.mkdir(parents=True, exist_ok=True)
    save_card(model, folder / "model.toml")
    export_fmu(model, folder / "model.fmu", binary=True)
    rows, noise = np.arange(0.0, 0.5, 1e-3), np.random.default_rng(1)
    step = InputSignal.step(0.1, 1.0, 1.0 + chosen.amplitude)
    clean = simulate(model, experiment("record", rows, {"Vdcref1": step}))[chosen.output]
    table = np.column_stack([rows, step(rows), clean + NOISE * noise.standard_normal(rows.size)])
    write_text(folder / "step.csv", csv_text(["time", "Vdcref1", chosen.output], table.tolist()))
    results = {}
    for label, (source, kind) in {
        "sympy": ("model.toml", ""),
        **{k: ("model.fmu", v) for k, v in kinds.items()},
    }.items():
        path = folder / f"{label}.toml"
        write_text(path, _study_text(chosen, source, kind))
        done = run_stage(
            load_study(path), "fit", folder / f"{label}-results", StageOptions(folder=folder / f"{label}-results")
        )
        if done.failed:
            raise SystemExit(f"{path}: {done.failed}")
        identified = json.loads((folder / f"{label}-results" / "identifiability.json").read_text(encoding="utf-8"))
        results[label] = (identified["identifiable"], done.data["estimates"])
    own_set, own = results.pop("sympy")
    report: dict[str, Any] = {"identifiable": own_set, "std": {n: e["std"] for n, e in own.items()}}
    for label, (found_set, found) in results.items():
        gaps = {n: abs(found[n]["value"] - own[n]["value"]) / own[n]["std"] for n in own_set}
        report[label] = {"identifiable": found_set, "share of std": max(gaps.values())}
    return report


def _study_text(chosen: Case, source: str, kind: str) -> str:
    free = "\n".join(f"{n} = {{start = {s}, min = {a}, max = {b}}}" for n, (s, a, b) in chosen.candidates.items())
    interface = f'interface = "{kind}"\n' if kind else ""
    return (
        f'schema = 1\nname = "round trip"\n[model]\nsource = "{source}"\n{interface}[parameters]\n{free}\n'
        f'[[experiment]]\nname = "step"\ndata = "step.csv"\ninputs = ["Vdcref1"]\noutputs = ["{chosen.output}"]\n'
        f'noise = {{{chosen.output} = {NOISE}}}\ninterpolation = "hold"\n[fit]\nstarts = 2\n'
    )


def beyond(values: Mapping[str, Any], limits: Mapping[str, float]) -> list[str]:
    """Return the numbers beyond their limits, as text."""
    found = []
    for model, row in values["agreement"].items():
        for what, value in row.items():
            limit = limits["matrices" if what.startswith("A") else "trajectories"]
            if not value <= limit:
                found.append(f"{model}, {what}: {value:.2g}, limit {limit:g}")
    for name, row in values["studies"].items():
        for label in (k for k in row if k in KINDS):
            if row[label]["identifiable"] != row["identifiable"]:
                found.append(f"{name}, {label}: identifiable {row[label]['identifiable']}, not {row['identifiable']}")
            if not row[label]["share of std"] <= limits["share of std"]:
                found.append(f"{name}, {label}: estimates {row[label]['share of std']:.2g} std apart")
    return found


def table(values: Mapping[str, Any]) -> str:
    """Return the README's two tables."""
    columns = ["ME 2", "CS 2", "ME 3", "CS 3", "A, B, C, D"]
    lines = [f"| model | {' | '.join(columns)} |", "|---" * 6 + "|"]
    for model, row in values["agreement"].items():
        lines.append(f"| {model} | {' | '.join(f'{row[c]:.1e}' if c in row else '' for c in columns)} |")
    lines += ["", "| study | identifiable | ME: apart, std | CS: apart, std |", "|---|---|---|---|"]
    for name, row in values["studies"].items():
        cells = [f"{row[k]['share of std']:.1e}" if k in row else "" for k in KINDS]
        lines.append(f"| {name} | {', '.join(row['identifiable'])} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main(quick: bool = False, parts: Collection[str] = PARTS, say: Callable[[str], None] = print) -> dict[str, Any]:
    """Return all numbers: differences by model, and the studies' sets and estimates."""
    values: dict[str, Any] = {"agreement": {}, "studies": {}}
    with tempfile.TemporaryDirectory(prefix="round-trip-") as place:
        for k, (name, model) in enumerate(models(quick)) if "agreement" in parts else ():
            values["agreement"][name] = agreement(model, Path(place) / f"model-{k}")
            say(f"{name}: " + ", ".join(f"{w} {v:.1e}" for w, v in values["agreement"][name].items()))
        for name, chosen in CASES.items() if "studies" in parts else ():
            if quick and name != "link":
                continue
            # The average-value link's equations are stiff and its delay needs an event a period: co-simulation alone.
            kinds = {k: v for k, v in KINDS.items() if k == "CS" or not chosen.model().delays}
            values["studies"][name] = full_study(chosen, Path(place) / name.replace(" ", "-"), kinds)
            say(f"{name}: {values['studies'][name]}")
    return values


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the link and three effects, one full study")
    parser.add_argument("--only", choices=PARTS, help="one of the two parts")
    parser.add_argument("--pin", action="store_true", help="write the numbers into expected.json and the README")
    chosen = parser.parse_args()
    begun = time.perf_counter()
    parts = (chosen.only,) if chosen.only else PARTS
    numbers = main(chosen.quick, parts, lambda text: print(text, flush=True))
    expected = json.loads((HERE / "expected.json").read_text(encoding="utf-8"))
    over = beyond(numbers, expected["limits"])
    numbers = {p: numbers[p] if p in parts else expected["values"].get(p, {}) for p in PARTS}
    print(f"\n{table(numbers)}\n\n{time.perf_counter() - begun:.0f} s")
    print("\n".join(over) or "all within the limits")
    if chosen.pin and not over:
        write_text(HERE / "expected.json", json_text({**expected, "values": numbers}))
        readme = (HERE / "README.md").read_text(encoding="utf-8").split("<!-- table -->")[0]
        write_text(HERE / "README.md", f"{readme}<!-- table -->\n\n{table(numbers)}\n")
    sys.exit(1 if over else 0)
