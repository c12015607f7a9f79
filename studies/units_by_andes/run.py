"""The ten units diagnosed from the vendor's .dyr and the record, as the commands do it. See README.md."""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

from units import PLANTS, Plant  # noqa: E402

from hvdc_ident.study.new_unit import UnitAsked, new_unit_study  # noqa: E402

RESULTS = HERE / "unit-results"
"""One file for each unit that is done; a second call goes on with the others. expected.json has all of them."""
COMMAND = (sys.executable, "-c", "from hvdc_ident.cli import main; main()")
CONVENTIONS = {"genrou": "Kw = 0.0", "reeca1": "Tpfilt = 0.02", "reecb1": "Tpfilt = 0.02", "bus-frequency": "T = 0.12"}
"""What andes has otherwise than the standard, by component: the power acts as a torque, the power reference has a filter of 20 ms, the
frequency is measured behind lags of 20 and 100 ms."""

NEAR = 0.05
"""Share of the truth within which an estimate is near it."""


def write_study(name: str, folder: Path, dyr: str = "plant.dyr") -> Path:
    """Write the study of a unit as `hvdc-ident new` does, with andes' conventions in its card; return the study file."""
    files = HERE / "recordings" / name
    shutil.rmtree(folder, ignore_errors=True)
    new_unit_study(folder, files / "event.csv", UnitAsked(files / dyr, bus=1, raw=files / "grid.raw"))
    card = folder / "unit.toml"
    text = card.read_text(encoding="utf-8")
    for source, convention in CONVENTIONS.items():
        line = f'source = "{source}"\nparameters = {{'
        text = text.replace(line, f"{line}{convention}, ")
    card.write_text(text, encoding="utf-8")
    return folder / "study.toml"


def one(name: str, folder: Path) -> dict[str, Any]:
    """Return what the diagnosis of one unit tells beside the truth, with its CPU seconds; of one that fails, the message.

    Runs in a process of its own: the CPU seconds are those of its children.
    """
    study = write_study(name, folder)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([*COMMAND, "run", str(study), "--quiet"], capture_output=True, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    told: dict[str, Any] = {"unit": name, "cpu_seconds": round(seconds, 1)}
    if done.returncode != 0:
        return told | {"failed": done.stderr.strip()[-2000:] or f"exit code {done.returncode}"}
    return told | judged_study(name, folder)


def judged_study(name: str, folder: Path) -> dict[str, Any]:
    """Return the diagnosis of the results in a study's folder beside the truth."""
    text = (folder / "study-results" / "discrepancy.json").read_text(encoding="utf-8")
    return judged(PLANTS[name], json.loads(text))


def judged(plant: Plant, diagnosis: dict[str, Any]) -> dict[str, Any]:
    """Return the diagnosis beside the truth.

    effect: named, place (the effect at another place), covered (among the likely places or in the ambiguity set), wrong, or held (no
    name: the text says why). parameter: found (the 95 % interval has the truth in it), near (the value is within `NEAR` of it), or wrong.
    """
    findings = diagnosis["findings"]
    effects = [f for f in findings if f["effect"] != "parameter"]
    told = [
        (n, p) for f in effects for n in f["same_as"] or [f["effect"]] for place in f["places"] for p in place["at"]
    ]
    others = [(r["effect"], p) for group in diagnosis["ambiguity"] for r in group for p in r["at"]]
    first = [(f["effect"], p) for f in effects for p in f["places"][0]["at"]]
    size = _value(plant, diagnosis, effects)
    return {
        "effect": _effect_outcome(plant, diagnosis["verdict"], first, told + others),
        "parameter": _parameter_outcome(plant, size),
        "verdict": diagnosis["verdict"],
        "text": diagnosis["text"],
        "hidden": plant.hidden.told,
        "told": sorted({f"{e} at {p}" for e, p in first}),
        "also": sorted({f"{e} at {p}" for e, p in {*told, *others} - {*first}}),
        "wrong": plant.wrong,
        "said": plant.said(),
        "truth": plant.truth(),
        "value": size["value"],
        "ci95": size["ci95"],
        "residual": {n: diagnosis["gap"]["pooled"][n]["fit"] for n in ("nominal", "refitted", "augmented")},
        "doubt": diagnosis["doubt"],
    }


def _value(plant: Plant, diagnosis: dict[str, Any], effects: list[dict[str, Any]]) -> dict[str, Any]:
    """Return value and interval of the wrong parameter with what was found, None for what is not told."""
    sources = [f["places"][0]["values"] for f in effects] + [f["parameters"] for f in diagnosis["findings"]]
    found = next((v[plant.wrong] for v in sources if plant.wrong in v), None)
    found = found or diagnosis.get("estimates_after", {}).get(plant.wrong)
    value = diagnosis["parameters_after"].get(plant.wrong)
    return {"value": value, "ci95": None} if found is None else {n: found.get(n) for n in ("value", "ci95")}


def _effect_outcome(plant: Plant, verdict: str, first: list[tuple[str, str]], told: list[tuple[str, str]]) -> str:
    right = [plant.hidden.right(e, p) for e, p in first]
    if verdict == "named" and right and all(right):
        return "named"
    if any(plant.hidden.right(e, p) for e, p in told):
        return "covered" if len(first) < 2 or verdict == "ambiguous" or all(right) else "covered, with another"
    if not first:
        return "held"
    return "place" if all(e in plant.hidden.effects for e, _ in first) else "wrong"


def _parameter_outcome(plant: Plant, size: dict[str, Any]) -> str:
    value, ends = size["value"], size["ci95"]
    if value is None:
        return "held"
    truth = plant.truth()
    low, high = ends if ends is not None else (None, None)
    if low is not None and high is not None and low <= truth <= high:
        return "found"
    return "near" if abs(value - truth) <= NEAR * truth else "wrong"


def table(results: list[dict[str, Any]]) -> str:
    """Return the table of the README."""
    rows = [
        "| unit | hidden effect | told | wrong parameter | vendor | truth | estimate (95 %) | effect | parameter | CPU, s |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in results:
        if "failed" in r:
            rows.append(
                f"| {r['unit']} | {PLANTS[r['unit']].hidden.told} | failed: {r['failed']} | | | | | | | {r['cpu_seconds']:.0f} |"
            )
            continue
        told = ", ".join(r["told"]) or r["verdict"]
        also = f" (or {len(r['also'])} more)" if r["also"] else ""
        ends = "" if not r["ci95"] or None in r["ci95"] else f" ({r['ci95'][0]:.4g} to {r['ci95'][1]:.4g})"
        value = "" if r["value"] is None else f"{r['value']:.4g}{ends}"
        cells = (
            r["unit"],
            r["hidden"],
            told + also,
            r["wrong"],
            f"{r['said']:g}",
            f"{r['truth']:g}",
            value,
            r["effect"],
            r["parameter"],
        )
        rows.append(f"| {' | '.join(cells)} | {r['cpu_seconds']:.0f} |")
    return "\n".join(rows) + "\n"


def results() -> list[dict[str, Any]]:
    """Return the results so far, in the order of the units."""
    paths = [RESULTS / f"{n}.json" for n in PLANTS]
    return [json.loads(p.read_text(encoding="utf-8")) for p in paths if p.exists()]


def main(arguments: list[str] | None = None) -> None:
    """Run the units that have no result yet, each in a process of its own, and write results.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="UNIT", help=f"of {', '.join(PLANTS)}; default: all")
    parser.add_argument("--workers", type=int, default=1, help="units at a time")
    parser.add_argument(
        "--folder", type=Path, default=HERE / "studies-results", help="where the studies are written to"
    )
    parser.add_argument(
        "--judge-only", action="store_true", help="compare the results that are there with the truth anew"
    )
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args(arguments)
    RESULTS.mkdir(exist_ok=True)
    if asked.one:
        (name,) = asked.names
        _write(one(name, asked.folder / name))
        return
    if asked.judge_only:
        for r in results():
            _write({n: r[n] for n in ("unit", "cpu_seconds")} | judged_study(r["unit"], asked.folder / r["unit"]))
    else:
        _run(asked.names or list(PLANTS), asked.workers, asked.folder)
    found = {"units": {r["unit"]: r for r in results()}}
    (HERE / "expected.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    print(table(list(found["units"].values())))


def _write(result: dict[str, Any]) -> None:
    (RESULTS / f"{result['unit']}.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def _run(names: list[str], workers: int, folder: Path) -> None:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    pending = [n for n in names if not (RESULTS / f"{n}.json").exists()]
    command = [sys.executable, str(HERE / "run.py"), "--one", "--folder", str(folder)]
    with ThreadPoolExecutor(workers) as pool:
        for name, done in zip(pending, pool.map(lambda n: subprocess.run([*command, n]), pending), strict=True):
            print(name, "done" if done.returncode == 0 else f"exit code {done.returncode}", flush=True)


if __name__ == "__main__":
    main()
