"""One thing to run and compare, and the commands of the package under test."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Setting:
    """Where and with how many processes an item runs."""

    folder: Path
    workers: int


@dataclass(frozen=True)
class Item:
    """One frozen document: text, or plain numbers and words.

    run: returns the document. full: True if it takes too long for the quick comparison. missing: returns what it needs and
    is not there, "" if nothing. compare: returns the differences as lines; None: as any document. beside: lines that are shown
    and never count as a difference. suffix: ".txt" for text.
    """

    name: str
    run: Callable[[Setting], Any]
    full: bool = False
    missing: Callable[[], str] = str
    compare: Callable[[Any, Any], list[str]] | None = None
    beside: Callable[[Any, Any], list[str]] | None = None
    suffix: str = ".json"


def python(*arguments: str | Path, cwd: Path, check: bool = True) -> str:
    """Return what a Python program prints on stdout. Raises RuntimeError with its last words where it fails and `check`."""
    done = subprocess.run(
        [sys.executable, *map(str, arguments)], cwd=cwd, capture_output=True, text=True, env=environment()
    )
    if check and done.returncode:
        words = (done.stderr.strip() or done.stdout.strip()).splitlines()[-8:]
        raise RuntimeError(f"{' '.join(map(str, arguments))}: exit {done.returncode}\n" + "\n".join(words))
    return done.stdout


def command(*arguments: str | Path, cwd: Path) -> tuple[int, str, str]:
    """Return exit code, stdout and stderr of `hvdc-ident ...`."""
    entry = "import sys; sys.argv[0] = 'hvdc-ident'; from hvdc_ident.cli import main; main()"
    call = [sys.executable, "-c", entry, *map(str, arguments)]
    done = subprocess.run(call, cwd=cwd, capture_output=True, text=True, env=environment())
    return done.returncode, done.stdout, done.stderr


def environment() -> dict[str, str]:
    """Return the environment of every run: one thread of linear algebra, plain text of 100 columns."""
    fixed = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}
    return {**os.environ, **fixed}


def settled(text: str, folders: Sequence[Path]) -> str:
    """Return the text without what differs from run to run: folders, dates, durations, versions, hashes."""
    for folder in folders:
        text = text.replace(str(folder), "FOLDER")
    text = re.sub(r"\b20\d\d-\d\d-\d\d([ T]\d\d:\d\d(:\d\d)?)?\b", "DATE", text)
    text = re.sub(r"\b\d+ (January|February|March|April|May|June|July|August|September|October|November|December) 20\d\d\b",
                  "DATE", text)  # fmt: skip
    text = re.sub(r"hvdc_ident \d+\.\d+\.\d+\S*", "hvdc_ident VERSION", text)
    text = re.sub(r"\b(in|after|took) \d+(\.\d+)? (s|min)\b", r"\1 TIME", text)
    text = re.sub(r", \d+(\.\d+)? s from ", ", TIME from ", text)
    return re.sub(r"\b[0-9a-f]{40,64}\b", "HASH", text)
