"""The units diagnosed from the vendor's .dyr and the record, as the commands do it. See README.md."""

from __future__ import annotations

import argparse
import json
import os
import re
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

from judge import judged  # noqa: E402
from units import PLANTS, SETS  # noqa: E402

from hvdc_ident.study.new_unit import UnitAsked, new_unit_study  # noqa: E402

RESULTS = HERE / "unit-results"
"""One file for each unit that is done; a second call goes on with the others. expected.json has all of them, by set."""
COMMAND = (sys.executable, "-c", "from hvdc_ident.cli import main; main()")
CONVENTIONS = {"genrou": "Kw = 0.0", "reeca1": "Tpfilt = 0.02", "reecb1": "Tpfilt = 0.02", "bus-frequency": "T = 0.12"}
"""What andes has otherwise than the standard, by component: the power acts as a torque, the power reference has a filter of 20 ms, the
frequency is measured behind lags of 20 and 100 ms."""


def write_study(name: str, folder: Path, dyr: str = "plant.dyr", budget: float | None = None) -> Path:
    """Write the study of a unit as `hvdc-ident new` does, with andes' conventions in its card; return the study file.

    budget: of its stage diagnose, s.
    """
    files = HERE / "recordings" / name
    shutil.rmtree(folder, ignore_errors=True)
    new_unit_study(folder, files / "event.csv", UnitAsked(files / dyr, bus=1, raw=files / "grid.raw"))
    card = folder / "unit.toml"
    text = card.read_text(encoding="utf-8")
    for source, convention in CONVENTIONS.items():
        line = f'source = "{source}"\nparameters = {{'
        text = text.replace(line, f"{line}{convention}, ")
    card.write_text(text, encoding="utf-8")
    study = folder / "study.toml"
    if budget is not None:
        text = study.read_text(encoding="utf-8")
        study.write_text(re.sub(r"(?m)^\[diagnose\].*$", rf"\g<0>\nbudget = {budget}", text), encoding="utf-8")
    return study


def one(name: str, folder: Path, budget: float | None) -> dict[str, Any]:
    """Return what the diagnosis of one unit tells beside the truth, with its CPU seconds; of one that fails, the message.

    Runs in a process of its own, without workers: its budget is of the processor's time then, whatever else the machine does.
    """
    study = write_study(name, folder, budget=budget)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([*COMMAND, "run", str(study), "--quiet", "--workers", "1"], capture_output=True, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    told: dict[str, Any] = {"unit": name, "cpu_seconds": round(seconds, 1)}
    if budget is not None:
        told["budget"] = budget
    found = judged_study(name, folder)
    return told | (found or {"failed": done.stderr.strip()[-2000:] or f"exit code {done.returncode}"})


def judged_study(name: str, folder: Path) -> dict[str, Any]:
    """Return the diagnosis of the results in a study's folder beside the truth; empty where there is none.

    One that its budget ended tells nothing: held.
    """
    results = folder / "study-results" / "discrepancy.json"
    diagnosis = json.loads(results.read_text(encoding="utf-8")) if results.exists() else {}
    return judged(PLANTS[name], diagnosis) if "verdict" in diagnosis else {}


HEADS = {
    "effects": "unit | hidden effect | told | wrong parameter | vendor | truth | estimate (95 %) | effect | parameter | CPU, s",
    "cards": "unit | card of the plant | in the .dyr | told | left of the gap, in noise | card | CPU, s",
    "values": "unit | wrong value | vendor | truth | estimate (95 %) | told | left of the gap, in noise | value | CPU, s",
}
"""Columns of the tables of the README, by set."""


def table(asked: str, results: list[dict[str, Any]]) -> str:
    """Return the table of a set in the README."""
    rows = [f"| {HEADS[asked]} |", "|---" * len(HEADS[asked].split(" | ")) + "|"]
    for r in results:
        cells = [f"failed: {r['failed']}"] if "failed" in r else CELLS[asked](r)
        cells += [""] * (len(HEADS[asked].split(" | ")) - 2 - len(cells))
        rows.append(f"| {' | '.join([r['unit'], *cells])} | {r['cpu_seconds']:.0f} |")
    return "\n".join(rows) + "\n"


def _of_effect(r: dict[str, Any]) -> list[str]:
    return [r["hidden"], _told(r), *_of_parameter(r), r["effect"], r["parameter"]]


def _of_card(r: dict[str, Any]) -> list[str]:
    return [r["true"], r["stated"] or "none", _told(r), _left(r), r["card"]]


def _of_value(r: dict[str, Any]) -> list[str]:
    return [*_of_parameter(r), _told(r), _left(r), r["named"]]


CELLS = {"effects": _of_effect, "cards": _of_card, "values": _of_value}


def _told(r: dict[str, Any]) -> str:
    also = f" (or {len(r['also'])} more)" if r["also"] else ""
    return (", ".join(r["told"]) or r["verdict"]) + also


def _of_parameter(r: dict[str, Any]) -> list[str]:
    ends = "" if not r["ci95"] or None in r["ci95"] else f" ({r['ci95'][0]:.4g} to {r['ci95'][1]:.4g})"
    return [r["wrong"], f"{r['said']:g}", f"{r['truth']:g}", "" if r["value"] is None else f"{r['value']:.4g}{ends}"]


def _left(r: dict[str, Any]) -> str:
    """Return what is left as the .dyr is, with other values of what is fitted, and with what was told."""
    sizes = (r["residual"][n] for n in ("nominal", "refitted", "augmented"))
    return ", ".join("" if s is None else f"{s:.2f}" for s in sizes)


def results(asked: str) -> list[dict[str, Any]]:
    """Return the results of a set so far, in the order of its units."""
    paths = [RESULTS / f"{n}.json" for n in SETS[asked]]
    return [json.loads(p.read_text(encoding="utf-8")) for p in paths if p.exists()]


def main(arguments: list[str] | None = None) -> None:
    """Run the units that have no result yet, each in a process of its own, and renew expected.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="UNIT", help=f"of {', '.join(PLANTS)}; default: all of the set")
    parser.add_argument("--set", choices=SETS, default="effects", help="what is wrong in the .dyr")
    parser.add_argument("--budget", type=float, metavar="SECONDS", help="of the stage diagnose; default: none")
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
        _write(one(name, asked.folder / name, asked.budget))
        return
    if asked.judge_only:
        kept = ("unit", "cpu_seconds", "budget")
        for r in results(asked.set):
            found = judged_study(r["unit"], asked.folder / r["unit"])
            _write({n: r[n] for n in kept if n in r} | found if found else r)
    else:
        _run(asked.names or list(SETS[asked.set]), asked.workers, asked.folder, asked.budget)
    expected = HERE / "expected.json"
    found = json.loads(expected.read_text(encoding="utf-8"))
    found[asked.set] = {r["unit"]: r for r in results(asked.set)}
    expected.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    print(table(asked.set, list(found[asked.set].values())))


def _write(result: dict[str, Any]) -> None:
    (RESULTS / f"{result['unit']}.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def _run(names: list[str], workers: int, folder: Path, budget: float | None) -> None:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    pending = [n for n in names if not (RESULTS / f"{n}.json").exists()]
    command = [sys.executable, str(HERE / "run.py"), "--one", "--folder", str(folder)]
    command += [] if budget is None else ["--budget", str(budget)]
    with ThreadPoolExecutor(workers) as pool:
        for name, done in zip(pending, pool.map(lambda n: subprocess.run([*command, n]), pending), strict=True):
            print(name, "done" if done.returncode == 0 else f"exit code {done.returncode}", flush=True)


if __name__ == "__main__":
    main()
