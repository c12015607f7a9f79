"""Compare a checkout's behaviour with the frozen one, before a room is rebuilt and after.

    python scripts/acceptance                        # quick: some ten minutes on two cores
    python scripts/acceptance --full                 # everything: an hour and more
    python scripts/acceptance --only transcripts     # one part of it
    PYTHONPATH=OTHER python scripts/acceptance       # the package of another checkout
    python scripts/acceptance --freeze               # keep what the runs give as the behaviour to compare with

Parts: `golden` (the JSON of every stage of eight studies, and of studies beside the project where they are), `transcripts`
(what each command prints), `diagnoses` (effects hidden by another simulator), `studies` (the executed studies of missing
effects), `speed` (benchmarks/engine.py; shown, never compared). Finished runs are kept in `acceptance-results/COMMIT` and not
repeated; a checkout with uncommitted changes begins afresh. Exit code 1 where anything differs.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import diagnoses
import difference
import golden
import programs
import transcripts
from runs import ROOT, Item, Setting

FROZEN = Path(__file__).resolve().parent / "frozen"
PARTS = {
    "golden": golden.ITEMS,
    "transcripts": transcripts.ITEMS,
    "diagnoses": diagnoses.ITEMS,
    "studies": programs.STUDIES,
    "speed": programs.SPEED,
}


def main() -> int:
    """Run, compare or freeze; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="the long runs too")
    parser.add_argument("--only", nargs="+", choices=list(PARTS), default=list(PARTS), metavar="PART")
    parser.add_argument("--items", nargs="+", metavar="NAME", help="some items of these parts")
    parser.add_argument("--freeze", action="store_true", help=f"write {FROZEN.relative_to(ROOT)} instead of comparing")
    parser.add_argument("--workers", type=int, default=2, help="processes of one run (default 2)")
    asked = parser.parse_args()
    kept = ROOT / "acceptance-results" / _checkout()
    if kept.name.endswith("-changed"):
        shutil.rmtree(kept, ignore_errors=True)
    differs = False
    for part in asked.only:
        for item in PARTS[part]:
            if (item.full and not asked.full) or (asked.items and item.name not in asked.items):
                continue
            differs |= _one(part, item, kept, asked.workers, asked.freeze)
    return int(differs)


def _one(part: str, item: Item, kept: Path, workers: int, freeze: bool) -> bool:
    """Run one item unless its result is kept, compare or freeze it, and return True if it differs."""
    missing = item.missing()
    if missing:
        print(f"{part}/{item.name}: skipped, {missing}", flush=True)
        return False
    path = kept / part / f"{item.name}{item.suffix}"
    begin = time.perf_counter()
    if not path.exists():
        work = kept / "work" / part / item.name
        work.mkdir(parents=True, exist_ok=True)
        _write(path, item.run(Setting(work, workers)))
    took = f"{time.perf_counter() - begin:.0f} s"
    frozen = FROZEN / part / path.name
    if freeze:
        frozen.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, frozen)
        print(f"{part}/{item.name}: frozen, {took}", flush=True)
        return False
    if not frozen.exists():
        print(f"{part}/{item.name}: nothing frozen to compare with, {took}", flush=True)
        return True
    old, new = _read(frozen), _read(path)
    lines = item.compare(old, new) if item.compare else difference.lines(old, new)
    print(f"{part}/{item.name}: {'as frozen' if not lines else 'differs'}, {took}", flush=True)
    for line in lines:
        print(f"    {line}")
    for line in item.beside(old, new) if item.beside else ():
        print(f"    {line}")
    return bool(lines)


def _write(path: Path, document: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    text = document if isinstance(document, str) else json.dumps(document, indent=1, ensure_ascii=False) + "\n"
    path.write_text(text, encoding="utf-8")


def _read(path: Path) -> Any:
    text = path.read_text(encoding="utf-8")
    return json.loads(text) if path.suffix == ".json" else text


def _checkout() -> str:
    """Return the commit of the package under test, with "-changed" where files differ from it."""
    where = subprocess.run(
        [sys.executable, "-c", "import hvdc_ident, pathlib; print(pathlib.Path(hvdc_ident.__file__).parents[1])"],
        capture_output=True, text=True, check=True,
    ).stdout.strip()  # fmt: skip

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", "-C", where, *arguments], capture_output=True, text=True, check=True
        ).stdout.strip()

    return git("rev-parse", "--short", "HEAD") + ("-changed" if git("status", "--porcelain", "hvdc_ident") else "")


if __name__ == "__main__":
    sys.exit(main())
