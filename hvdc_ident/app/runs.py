"""Runs of a study that the workbench has started, one at a time in a folder of results, and how its stages stand there."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import hvdc_ident as hi
from hvdc_ident.app.study_folder import stamp
from hvdc_ident.app.worker import EVERYTHING, GRACE
from hvdc_ident.errors import InputError
from hvdc_ident.executor import times_of
from hvdc_ident.study.pipeline import FIRST, standing
from hvdc_ident.study.stages import Stage, stages
from hvdc_ident.summary import Results

State = Literal["not run", "done", "stale", "failed", "interrupted"]
Outcome = Literal["running", "done", "failed", "cancelled"]
_STAGE = re.compile(r"^(?:\d+ of \d+, )?([a-z]+): ")
LAST_WORDS = 2000
"""Characters of what a process printed last that are told where it ended without a word of its own."""


@dataclass(frozen=True)
class StageStanding:
    """How a stage stands in a folder of results. asked: the study asks for it. why: it is not done. data: its JSON."""

    stage: Stage
    asked: bool
    state: State
    why: str
    data: Mapping[str, Any]


def standings(study: hi.Study, folder: Path) -> tuple[StageStanding, ...]:
    """Return how every stage stands in a folder, in the order of a run."""
    return tuple(_standing(study, folder, s) for s in stages())


def _standing(study: hi.Study, folder: Path, stage: Stage) -> StageStanding:
    data, why = standing(study, stage.name, folder)
    state: State = "done"
    if not data:
        state = "not run"
    elif why and data.get("sources") == dict(study.sources) and not data.get("fingerprint"):
        state = "interrupted" if data.get("status") == FIRST else "failed"
        why = str(data.get("message") or "; ".join(data.get("implausible", ())) or why)
    elif why:
        state = "stale"
        same = data.get("sources") == dict(study.sources)
        why = "by another version of hvdc_ident" if same else "the study or one of its files has changed since"
    return StageStanding(stage, stage.wanted(study), state, why, data)


def result_folders(study: hi.Study) -> tuple[Path, ...]:
    """Return the folders that may hold results of a study: its own first, then those beside it that hold some.

    Those are the study's folder, into which `demo` and `--out` write, and the folders in it; links that lead out of it are
    left out.
    """
    home = study.path.resolve().parent
    inside = sorted(p for p in home.iterdir() if p.is_dir() and p.resolve().parent == home)
    others = [p for p in (home, *inside) if p != _own(study) and _holds_results(p)]
    return (_own(study), *others)


def _own(study: hi.Study) -> Path:
    return study.path.resolve().parent / study.folder.name


def first_folder(study: hi.Study) -> Path:
    """Return the folder whose results the page opens with: the study's own, or one beside it where that has none."""
    found = result_folders(study)
    return next((p for p in found if _holds_results(p)), found[0])


def _holds_results(folder: Path) -> bool:
    try:
        return bool(Results(folder).stages)
    except InputError:
        return False


def folder_name(study: hi.Study, folder: Path) -> str:
    """Return what a folder of results is called on the page."""
    home = study.path.resolve().parent
    return f"{folder.name} (the study's folder)" if folder == home else folder.name


def signature(study: hi.Study, folder: Path) -> tuple[tuple[int, int, int] | None, ...]:
    """Return what changes whenever a file of the study or a stage's result does: their stamps."""
    files = [study.path.parent / name for name in study.sources] + [folder / s.file for s in stages()]
    return tuple(stamp(f) for f in files)


class StudyRun:
    """Work on a study in a process of its own, followed by a thread that reads what it tells.

    what: a stage, or all of them, or the letter. done, total, text: its progress. said: what to know, in lines. outcome,
    message: how it ended, and why where it is not done.
    """

    def __init__(self, study_file: Path, folder: Path, what: str, trust: bool) -> None:
        self.folder, self.what = folder, what
        self.done, self.total, self.text = 0, 0, "starting"
        self.said: list[str] = []
        self.outcome: Outcome = "running"
        self.message = ""
        self._begun = self._stage_begun = time.monotonic()
        self._cancelled = False
        self._last_words = tempfile.TemporaryFile()  # noqa: SIM115 - closed when the process has ended
        threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # as the command line does
        self._process = subprocess.Popen(
            [sys.executable, "-m", "hvdc_ident.app.worker", str(study_file), str(folder), what, str(int(trust))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._last_words,
            env={**threads, **os.environ},
            start_new_session=True,  # Ctrl-C at the server's terminal ends the server, and so the work
        )
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._thread.start()

    @property
    def stage(self) -> str:
        """The stage that is at work; "" where none has said so yet."""
        found = _STAGE.match(self.text)
        return found[1] if found else ""

    @property
    def share(self) -> float:
        """The share of the stage that is done."""
        return self.done / self.total if self.total > 1 else 0.0

    @property
    def times(self) -> str:
        """The time that the stage has taken, and how much longer it takes."""
        now = time.monotonic()
        finish = now + (now - self._stage_begun) * (1.0 - self.share) / self.share if self.share else None
        return times_of(self._stage_begun, finish, now)

    def cancel(self) -> None:
        """End the work; what was finished is kept."""
        self._cancelled = True
        if self._process.stdin is not None:
            self._process.stdin.close()

    def wait(self, seconds: float | None = None) -> Outcome:
        """Return how the work ended, once it has; "running" where it has not within so many seconds."""
        self._thread.join(seconds)
        return self.outcome

    def _follow(self) -> None:
        """Take in what the process tells until it ends."""
        assert self._process.stdout is not None
        end: str | None = None
        for line in self._process.stdout:
            told = json.loads(line)
            end = told.get("end", end)
            self.said += told.get("say", ())
            if "text" in told:
                self._take(told)
        code = self._ended()
        self._last_words.seek(0)
        words = self._last_words.read().decode("utf-8", "replace").strip()
        self._last_words.close()
        if end is not None:
            self.message = end
        elif not self._cancelled:
            self.message = f"the process ended with code {code}: {words[-LAST_WORDS:] or 'without a word'}"
        cancelled = self._cancelled and end is None
        self.outcome = "cancelled" if cancelled else "failed" if self.message else "done"

    def _take(self, told: Mapping[str, Any]) -> None:
        before = self.stage
        self.done, self.total, self.text = told["done"], told["total"], told["text"]
        if self.stage != before:
            self._stage_begun = time.monotonic()

    def _ended(self) -> int:
        """Return the process's exit code; it is killed where it has closed its mouth and stays, which costs no result."""
        try:
            return self._process.wait(2.0 * GRACE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()
        finally:
            for pipe in (self._process.stdin, self._process.stdout):
                if pipe is not None:
                    pipe.close()


class Runs:
    """Runs that this server has started, the last one of each folder. All browsers share them."""

    def __init__(self) -> None:
        self._runs: dict[Path, StudyRun] = {}
        self._lock = threading.Lock()

    def of(self, folder: Path) -> StudyRun | None:
        """Return the run of a folder that is at work, or the last one; None where this server has started none."""
        return self._runs.get(folder.resolve())

    def start(self, study: hi.Study, folder: Path, what: str = EVERYTHING, *, trust: bool = False) -> StudyRun:
        """Start work on a study. Raises InputError where this server is at work in the folder already.

        Another process there is found by the store's lock: then the run fails with that reason.
        """
        place = folder.resolve()
        with self._lock:
            before = self._runs.get(place)
            if before is not None and before.outcome == "running":
                raise InputError(
                    f"'{before.what}' is at work in this folder",
                    where=str(folder),
                    expected="one run at a time in a folder of results",
                    hint="wait for it to end, or cancel it",
                )
            self._runs[place] = StudyRun(study.path.resolve(), place, what, trust)
            return self._runs[place]


RUNS = Runs()
"""The runs of this server."""
