"""Effects hidden by another simulator, and their diagnoses. See README.md."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

from hidden.cases import ASKED, PARTS, Design, designs, factorial, made  # noqa: E402
from hidden.judging import summary  # noqa: E402
from hidden.plants import FIRST, PLANTS  # noqa: E402
from hidden.reporting import report  # noqa: E402

SEED = 42
"""Of the reported cases. Thresholds were settled on others (--seed 1)."""


def one(design: Design, seed: int, sindy: bool = False, budget: float | None = None) -> dict[str, Any]:
    """Return the line of one case: generated, diagnosed, compared. budget: CPU time of the diagnosis, s; None: no limit."""
    return _line(design, seed, sindy, budget) | {"budget": budget}


def _line(design: Design, seed: int, sindy: bool, budget: float | None) -> dict[str, Any]:
    from hidden.diagnosing import diagnosed

    begin = time.perf_counter()
    try:
        case = made(design, seed)
        if case is None:
            return {
                "case": design.name,
                "part": design.part,
                "plant": design.plant,
                "messy": design.messy,
                "effects": list(design.effects),
                "unreachable": True,
            }
        making = time.perf_counter() - begin
        return diagnosed(case, seed=design.number, sindy=sindy, budget=budget) | {"making": making}
    except Exception:  # a mistake in the program: a line of its own, and the others go on
        told: dict[str, Any] = {
            "case": design.name,
            "part": design.part,
            "plant": design.plant,
            "effects": list(design.effects),
        }
        told |= {
            "messy": design.messy,
            "size": design.size,
            "noise": design.noise,
            "excitation": design.excitation,
            "removed": design.removed,
        }
        return told | {"failed": traceback.format_exc(), "crash": True, "seconds": time.perf_counter() - begin}


def lines(path: Path, crashes: bool = False) -> dict[str, dict[str, Any]]:
    """Return the lines of a result file by case, without a truncated last line and, unless requested, without crashes."""
    found: dict[str, dict[str, Any]] = {}
    if path.exists():
        for text in path.read_text(encoding="utf-8").splitlines():
            try:
                line = json.loads(text)
            except json.JSONDecodeError:
                continue
            if not line.get("crash") or crashes:
                found[line["case"]] = line
    return found


def pending(
    parts: list[str],
    seed: int,
    limit: int | None,
    done: set[str],
    full: bool = False,
    least: float = 0.0,
    plants: Sequence[str] | None = None,
    messy: Sequence[bool] = (False,),
) -> Iterator[Design]:
    """Return the cases still to be done, the parts in turn, so that an early stop has cases of each.

    limit: of each part, of each kind of records, and of the first two plants (in the part `value`: of each) and each of the others;
    least: size of a hidden effect. plants: None: the first two, of the part `value` all. messy: which records.
    """
    every = [factorial(seed)]
    if not full:
        every = [designs(p, seed, g, m) for m in messy for p, g in _groups(parts, plants)]
    tables = [[d for d in table if d.size >= least or d.part == "clean"][:limit] for table in every]
    shares = [(k / len(t), n, d) for n, t in enumerate(tables) for k, d in enumerate(t)]
    for _, _, design in sorted(shares, key=lambda s: s[:2]):
        if design.name not in done:
            yield design


def _groups(parts: Sequence[str], plants: Sequence[str] | None) -> list[tuple[str, tuple[str, ...]]]:
    """Return each part with plants that are limited together: the first two, then each of the others with all parts in turn."""
    chosen = {p: plants or (tuple(PLANTS) if p == "value" else FIRST) for p in parts}
    found: list[tuple[str, tuple[str, ...]]] = []
    for group in (FIRST, *((p,) for p in PLANTS if p not in FIRST)):
        for part in parts:
            own = tuple(p for p in group if p in chosen[part])
            found += [(part, (p,)) for p in own] if part == "value" else [(part, own)] if own else []
    return found


def numbered(text: str) -> list[str]:
    """Return the plants' names from their numbers, such as "1,2,3,4"."""
    names = list(PLANTS)
    numbers = [int(n) for n in text.split(",") if n.strip().isdigit() and 0 < int(n) <= len(names)]
    if len(numbers) != len(text.split(",")):
        raise argparse.ArgumentTypeError(f"numbers from 1 to {len(names)} with commas between them, not '{text}'")
    return [names[n - 1] for n in sorted(set(numbers))]


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Return the summary; results are kept line by line, and a second call resumes the first."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=[p for p in PARTS if p not in ASKED])
    plants = ", ".join(f"{k} {n}" for k, n in enumerate(PLANTS, start=1))
    parser.add_argument("--plants", type=numbered, help=f"numbers of plants: {plants}; default 1,2, of part value all")
    parser.add_argument(
        "--messy", choices=("no", "yes", "both"), nargs="?", const="yes", default="no", help="which records"
    )
    parser.add_argument("--limit", type=int, help="cases of each part at most")
    parser.add_argument("--least", type=float, default=0.0, help="leave out smaller effects, by their size in units")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument(
        "--budget", type=float, metavar="SECONDS", help="CPU time of each diagnosis (default: no limit)"
    )
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--out", type=Path, help="folder of the results (default: seed-SEED-results beside this file)")
    parser.add_argument("--judge-only", action="store_true", help="summarise what is there")
    parser.add_argument("--sindy", action="store_true", help="run the sparse-regression baseline too (needs pysindy)")
    parser.add_argument("--full", action="store_true", help="every combination of factors for single effects: days")
    asked = parser.parse_args(arguments)
    out = asked.out or HERE / f"seed-{asked.seed}{'-full' if asked.full else ''}-results"
    out.mkdir(parents=True, exist_ok=True)
    path = out / "cases.jsonl"
    done = lines(path)
    if not asked.judge_only:
        others = {x.get("budget") for x in done.values()} - {asked.budget}
        if others:
            parser.error(
                f"--budget: {path} has cases with a budget of {_said(others)}, asked was {_said({asked.budget})}; "
                "give that budget to go on there, or another folder with --out"
            )
        messy = {"no": (False,), "yes": (True,), "both": (False, True)}[asked.messy]
        asked_for = asked.limit, set(done), asked.full, asked.least, asked.plants, messy
        todo = list(pending(asked.parts, asked.seed, *asked_for))
        _work(todo, asked, path, len(done))
    done = lines(path, crashes=True)
    found = summary(list(done.values()))
    (out / "summary.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    (out / "summary.md").write_text(report(found), encoding="utf-8")
    print(report(found))
    return found


def _said(budgets: set[float | None]) -> str:
    return " and ".join("no limit" if b is None else f"{b:g} s" for b in budgets)


def _work(todo: list[Design], asked: argparse.Namespace, path: Path, before: int) -> None:
    """Append each case's line to the file as soon as it is finished."""
    if path.exists() and path.read_bytes()[-1:] not in (b"\n", b""):
        with path.open("a", encoding="utf-8") as stream:
            stream.write("\n")
    begin = time.perf_counter()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(asked.workers, mp_context=context) as pool, path.open("a", encoding="utf-8") as stream:
        jobs = {pool.submit(one, d, asked.seed, asked.sindy, asked.budget): d for d in todo}
        for k, job in enumerate(as_completed(jobs), start=1):
            line = job.result()
            stream.write(json.dumps(line) + "\n")
            stream.flush()
            left = (time.perf_counter() - begin) / k * (len(todo) - k)
            said = line.get("verdict") or ("unreachable" if line.get("unreachable") else "failed")
            print(
                f"{before + k}/{before + len(todo)} {line['case']}: {said}; {left / 60:.0f} min left", file=sys.stderr
            )


if __name__ == "__main__":
    main()
