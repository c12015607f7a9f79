"""Runs of a study that the workbench has started, one at a time in a folder of results, and how its stages stand there."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal

import hvdc_ident as hi
from hvdc_ident.app.study_folder import stamp
from hvdc_ident.errors import HvdcIdentError, InputError
from hvdc_ident.executor import finish_of, times_of
from hvdc_ident.parallel import Child
from hvdc_ident.study.pipeline import FIRST, standing
from hvdc_ident.study.stages import Stage, stages
from hvdc_ident.summary import Results

State = Literal["not run", "done", "stale", "failed", "interrupted"]
Outcome = Literal["running", "done", "failed", "cancelled"]
_STAGE = re.compile(r"^(?:\d+ of \d+, )?([a-z]+): ")
EVERYTHING, LETTER = "run", "letter"
"""Names of work beside those of the stages: every stage that the study asks for, and the letter."""
OFTEN = 0.1
"""Seconds between two messages of progress: the eye reads no more."""

Tell = Callable[[Mapping[str, Any]], None]


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
    folders = result_folders(study)
    return next((p for p in folders if _holds_results(p)), folders[0])


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


class ToldProgress:
    """Progress that is told as it comes, but not more often than `OFTEN`."""

    def __init__(self, tell: Tell) -> None:
        self._tell, self._last = tell, -OFTEN

    def __call__(self, done: int, total: int, text: str) -> None:
        """Tell that so much is done."""
        now = time.monotonic()
        if now - self._last >= OFTEN:
            self._last = now
            self._tell({"done": done, "total": total, "text": text})


def work(connection: Connection, _: memoryview[float], study_file: Path, folder: Path, what: str, trust: bool) -> None:
    """Do the work in a process of its own and tell what happens, at the end why it did not come to its end, "" where it did.

    what: a stage, `EVERYTHING` or `LETTER`.
    """
    try:
        end = _done(connection.send, study_file, folder, what, trust)
    except HvdcIdentError as error:
        end = str(error)
    except MemoryError:
        end = "not enough memory for this study"
    connection.send({"end": end})


def _done(tell: Tell, study_file: Path, folder: Path, what: str, trust: bool) -> str:
    from hvdc_ident.study.export import letter
    from hvdc_ident.study.pipeline import run_stage, run_study
    from hvdc_ident.study.stages import StageOptions
    from hvdc_ident.study.study import load_study

    def announce(lines: Sequence[str]) -> None:
        tell({"say": list(lines)})

    options = StageOptions(progress=ToldProgress(tell), announce=announce)
    study = load_study(study_file, trust)
    if what == EVERYTHING:
        done = run_study(study, folder, options)
    elif what == LETTER:
        done = [letter(study, folder, options)[1]]
    else:
        done = [run_stage(study, what, folder, options)]
    return "; ".join(f"{d.stage.name}: {d.failed}" for d in done if d.failed)


class StudyRun:
    """Work on a study in a process of its own, followed by a thread that takes in what it tells.

    A process and not a thread: the page stays alive while it computes, and cancelling ends it at once. The store keeps what
    was finished. what: a stage, or all of them, or the letter. done, total, text: its progress. said: what to know, in
    lines. outcome, message: how it ended, and why where it is not done.
    """

    def __init__(self, study_file: Path, folder: Path, what: str, trust: bool) -> None:
        self.folder, self.what = folder, what
        self.done, self.total, self.text = 0, 0, "starting"
        self.said: list[str] = []
        self.outcome: Outcome = "running"
        self.message = ""
        self._stage_begun = self._told = time.monotonic()
        self._cancelled = threading.Event()
        self._child = Child(work, study_file, folder, what, trust)
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._thread.start()

    @property
    def stage(self) -> str:
        """The stage that is at work; "" where none has said so yet."""
        match = _STAGE.match(self.text)
        return match[1] if match else ""

    @property
    def share(self) -> float:
        """The share of the stage that is done."""
        return self.done / self.total if self.total > 1 else 0.0

    @property
    def times(self) -> str:
        """The time that the stage has taken, and how much longer it takes."""
        finish = finish_of(self._stage_begun, self._told, self.done, self.total)
        return times_of(self._stage_begun, finish, time.monotonic())

    def cancel(self) -> None:
        """End the work; what was finished is kept."""
        self._cancelled.set()

    def wait(self, seconds: float | None = None) -> Outcome:
        """Return how the work ended, once it has; "running" where it has not within so many seconds."""
        self._thread.join(seconds)
        return self.outcome

    def _follow(self) -> None:
        """Take in what the process tells until it ends."""
        end: str | None = None
        try:
            while end is None and not self._cancelled.is_set():
                if self._child.connection.poll(OFTEN):
                    told = self._child.connection.recv()
                    end = told.get("end")
                    self.said += told.get("say", ())
                    if "text" in told:
                        self._take(told)
        except (EOFError, OSError):
            pass  # it has ended without saying so
        words = self._child.printed
        ending = self._child.end()
        if end is not None:
            self.message = end
        elif not self._cancelled.is_set():
            self.message = f"the process {ending or 'is gone'}: {words or 'without a word'}"
        cancelled = self._cancelled.is_set() and end is None
        self.outcome = "cancelled" if cancelled else "failed" if self.message else "done"

    def _take(self, told: Mapping[str, Any]) -> None:
        before = self.stage
        self._told = time.monotonic()
        self.done, self.total, self.text = told["done"], told["total"], told["text"]
        if self.stage != before:
            self._stage_begun = self._told


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
