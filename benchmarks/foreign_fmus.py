"""FMUs of other tools, against FMPy: runs, second runs, speed, a planted parameter, a hidden lag, delay and gain.

    python benchmarks/foreign_fmus.py FOLDER... [--json FILE] [--only NAME] [--parts simulation,...]
                                      [--jobs 2] [--limit S] [--again] [--report]

Every FMU below the folders, every interface it offers, every part in a process of its own with a time limit: a crash or a
hang costs one line. FILE gets a JSON line a part; a second run goes on where the first stopped (`--again` repeats what is
chosen, `--report` only prints). Of what FMPy itself cannot run only the message counts and how soon it comes.

Targets: within 1e-5 of FMPy over the range, or within three times what FMPy differs by from itself at another tolerance
(model exchange) or communication step; a second run equal to the first; at most 1.3 times FMPy's time; a planted parameter
inside its 95 % interval; a fit of four parameters at most six runs an iteration; what is hidden named or in the set; what
cannot be done said in one sentence within 10 s.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

LIMITS = {
    "simulation": 150.0,
    "uneven": 150.0,
    "values": 150.0,
    "second": 150.0,
    "speed": 150.0,
    "fit": 600.0,
    "runs": 600.0,
    "lag": 600.0,
    "delay": 600.0,
    "gain": 600.0,
}  # s
DIAGNOSE = ("lag", "delay", "gain")
STUDIES = ("fit", "runs", *DIAGNOSE)
CLOSE, EQUAL, SLOW, SOON = 1e-5, 1e-9, 1.3, 10.0
INTERFACES = ("model-exchange", "co-simulation")
SHORT = {"model-exchange": "ME", "co-simulation": "CS"}


@dataclass(frozen=True)
class Row:
    """One FMU and interface. name: the path below the folder that was given."""

    path: Path
    name: str
    interface: str


def rows(folders: Sequence[Path], only: str) -> Iterator[Row]:
    """Every FMU and interface; of one whose description says none, model exchange, so that its message is seen."""
    for folder in folders:
        for path in sorted(folder.rglob("*.fmu")):
            name = f"{folder.name}/{path.relative_to(folder)}"
            if only in name:
                yield from (Row(path, name, interface) for interface in offered(path))


def offered(path: Path) -> list[str]:
    import zipfile
    from xml.etree import ElementTree

    tags = {"ModelExchange": "model-exchange", "CoSimulation": "co-simulation", "Implementation": "co-simulation"}
    try:
        with zipfile.ZipFile(path) as archive, archive.open("modelDescription.xml") as text:
            found = {e.tag for _, e in ElementTree.iterparse(text, events=("start",))}
    except (zipfile.BadZipFile, KeyError, ElementTree.ParseError):
        return [INTERFACES[0]]
    return sorted({tags[t] for t in found & set(tags)}, key=INTERFACES.index) or [INTERFACES[0]]


def measured(row: Row, part: str, limit: float) -> dict[str, Any]:
    """What one process told, with its end."""
    with tempfile.TemporaryDirectory(prefix="foreign-") as folder:
        told, said = Path(folder) / "told", Path(folder) / "said"
        told.touch()
        command = [sys.executable, __file__, "--child", str(row.path), row.interface, part, str(told)]
        begin = time.perf_counter()
        with said.open("wb") as log:
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True, cwd=folder
            )
            try:
                code = process.wait(limit)
            except subprocess.TimeoutExpired:
                code = None
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        found: dict[str, Any] = {"fmu": row.name, "interface": row.interface, "part": part}
        for line in told.read_text().splitlines():
            found.update(json.loads(line))
        found["wall"] = time.perf_counter() - begin
        if code is None:
            found["error"] = f"no end after {limit:g} s"
        elif code != 0:
            last = said.read_text("utf-8", "replace").strip()[-300:]
            found["error"] = f"the process ended with {code}: {' '.join(last.split())}"
        return {**found, **judged(found)}


def child(path: str, interface: str, part: str, told: str) -> None:
    """One part; an exception is what was found, and told as such."""
    import foreign_cases
    import foreign_studies

    since = time.perf_counter()

    def tell(facts: Mapping[str, Any]) -> None:
        nonlocal since
        if facts.get("stage") in ("load", "run"):  # FMPy's time is none of ours
            since = time.perf_counter()
        with open(told, "a", encoding="utf-8") as file:
            file.write(json.dumps(dict(facts), default=float) + "\n")

    try:
        getattr(foreign_studies if part in STUDIES else foreign_cases, part)(Path(path), interface, tell)
    except Exception as e:
        from hvdc_ident.errors import HvdcIdentError

        own = isinstance(e, HvdcIdentError)
        text = str(e) if own else f"{type(e).__name__}: {e}"
        tell({"error": text, "told": own, "after": time.perf_counter() - since})
        if not own:
            tell({"traceback": traceback.format_exc()[-1500:]})
    sys.stdout.flush()
    os._exit(0)  # an FMU's library may hang in its own clean-up


# --- verdicts ---


def judged(f: Mapping[str, Any]) -> dict[str, Any]:
    """verdict: ok, or what is wrong in a word or two; fmpy: whether FMPy itself ran the FMU."""
    ran = f.get("stage") != "fmpy"
    if "not_applicable" in f:
        return {"verdict": "-", "fmpy": True}
    if not ran:
        return {"verdict": "FMPy fails", "fmpy": False}
    if "error" in f:
        kind = "refused" if f.get("told") and f["stage"] == "load" else "failed" if f.get("told") else "crash"
        return {"verdict": "timeout" if "no end after" in f["error"] else kind, "fmpy": True}
    near = dict.fromkeys(("simulation", "uneven", "values"), _simulation)
    judge = {**near, "second": _second, "speed": _speed, **dict.fromkeys(STUDIES, _told)}[f["part"]]
    return {"verdict": judge(f), "fmpy": True}


def _simulation(f: Mapping[str, Any]) -> str:
    if f["largest"] <= CLOSE:
        return "ok"
    return "explained" if f["beyond_gap"] <= max(CLOSE, 3.0 * f["beyond_self"]) else "differs"


def _second(f: Mapping[str, Any]) -> str:
    return "ok" if f["largest"] <= EQUAL else "differs"


def _speed(f: Mapping[str, Any]) -> str:
    return "ok" if f["ratio"] <= SLOW else "slow"


def _told(f: Mapping[str, Any]) -> str:
    return str(f["outcome"])


GOOD = ("ok", "explained", "-", "FMPy fails")


def shown(f: Mapping[str, Any]) -> str:
    """A cell of the table."""
    verdict = f["verdict"]
    if verdict == "explained":
        return f"{f['beyond_gap']:.0e} (self {f['beyond_self']:.0e})"
    if f["part"] in ("simulation", "uneven", "values", "second") and "largest" in f and "error" not in f:
        return f"{f['largest']:.0e}" + ("" if verdict in GOOD else f" {verdict}")
    if f["part"] == "speed" and "ratio" in f:
        return f"{f['ratio']:.2f}" + ("" if verdict in GOOD else " slow")
    if f["part"] == "runs" and "each" in f:
        return f"{f['each']:.1f}" + ("" if verdict in GOOD else " more")
    return verdict + (f" {f['wall']:.0f} s" if f["part"] in STUDIES and verdict != "-" else "")


def why(f: Mapping[str, Any]) -> str:
    """What misses, in one line."""
    if "error" in f:
        return str(f["error"])
    if f["part"] in ("simulation", "uneven", "values"):
        at = f" ('{f['output']}' by {f['largest']:.2g} at {f['at']:.6g} s)" if "at" in f else ""
        return f"'{f['beyond']}' is off by {f['beyond_gap']:.2g} of its range, FMPy from itself by {f['beyond_self']:.2g}{at}"
    if f["part"] == "second":
        return f"'{f['output']}' differs by {f['largest']:.2g} of its range (the run right after the first: {f['again']:.2g})"
    if f["part"] == "speed":
        return f"{f['here_ms']:.3g} ms here, {f['fmpy_ms']:.3g} ms with FMPy"
    return str(f.get("detail", ""))


def report(found: Sequence[Mapping[str, Any]], parts: Sequence[str]) -> None:
    """The table, what misses the targets, and the refusals that came late or are no sentence."""
    by = {(f["fmu"], f["interface"], f["part"]): f for f in found}
    keys = list(dict.fromkeys((f["fmu"], f["interface"]) for f in found))
    print("| FMU | | " + " | ".join(parts) + " |\n|---|---|" + "---|" * len(parts))
    for name, interface in keys:
        cells = [shown(by[name, interface, p]) if (name, interface, p) in by else "" for p in parts]
        print(f"| {name} | {SHORT[interface]} | " + " | ".join(cells) + " |")
    for part in parts:
        own = [f for f in found if f["part"] == part and f["fmpy"] and f["verdict"] != "-"]
        missed = [f for f in own if f["verdict"] not in GOOD]
        print(f"\n{part}: {len(own) - len(missed)} of {len(own)} that FMPy runs")
        for f in missed:
            print(f"  {f['verdict']}: {f['fmu']} {SHORT[f['interface']]}: {why(f)}")
    late = [f for f in found if f.get("told") and (f["after"] > SOON or "\n" in f["error"] or len(f["error"]) > 500)]
    for f in late:
        print(f"late or long: {f['fmu']} {SHORT[f['interface']]} {f['part']}: {f['after']:.1f} s: {f['error'][:200]}")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path, metavar="FOLDER")
    parser.add_argument("--json", type=Path, help="where lines are kept; without it a second run begins anew")
    parser.add_argument("--only", default="", help="FMUs whose path has this in it")
    parser.add_argument("--interface", choices=INTERFACES, help="this one alone")
    parser.add_argument("--parts", default=",".join(LIMITS))
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time; the speed of two disturbs both")
    parser.add_argument("--limit", type=float, help="s for one part, instead of its own limit")
    parser.add_argument("--again", action="store_true", help="repeat what is chosen")
    parser.add_argument("--report", action="store_true", help="print what is kept")
    parser.add_argument("--child", nargs=4, help=argparse.SUPPRESS)
    asked = parser.parse_args(arguments)
    if asked.child:
        child(*asked.child)
    parts = [p for given in asked.parts.split(",") for p in (DIAGNOSE if given == "diagnose" else (given,))]
    if not set(parts) <= set(LIMITS):
        parser.error(f"--parts: of {', '.join(LIMITS)}")
    kept: dict[tuple[str, str, str], dict[str, Any]] = {}
    if asked.json and asked.json.is_file():
        for line in asked.json.read_text().splitlines():
            f = json.loads(line)
            if f["verdict"] != "-":
                kept[f["fmu"], f["interface"], f["part"]] = f
    chosen = [r for r in rows(asked.folders, asked.only) if asked.interface in (None, r.interface)]
    lock = Lock()

    def work(row: Row) -> None:
        """The parts of a row, one after the other: what FMPy cannot run or we refuse needs no more than the first."""
        for part in parts:
            if not asked.again and (row.name, row.interface, part) in kept:
                continue
            ran = kept.get((row.name, row.interface, "simulation"), {})
            if part != "simulation" and ran.get("verdict") in ("FMPy fails", "refused", "-"):
                f = {**ran, "part": part, "not_applicable": ran["verdict"], "verdict": "-", "wall": 0.0}
            else:
                f = measured(row, part, asked.limit or LIMITS[part])
            line = f"{f['wall']:6.1f} s  {part:10} {SHORT[row.interface]} {row.name}: {shown(f)}"
            with lock:
                kept[row.name, row.interface, part] = f
                print(line if f["verdict"] in GOOD else f"{line}: {why(f)}", file=sys.stderr, flush=True)
                if asked.json and f["verdict"] != "-":  # what hangs on another part is told anew each time
                    with asked.json.open("a") as file:
                        file.write(json.dumps(f) + "\n")

    with ThreadPoolExecutor(asked.jobs) as pool:
        list(pool.map(work, [] if asked.report else chosen))
    own = {(r.name, r.interface) for r in chosen}
    report([f for key, f in sorted(kept.items()) if key[:2] in own and key[2] in parts], parts)


if __name__ == "__main__":
    main()
