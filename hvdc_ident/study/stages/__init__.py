"""Stages: questions that a study can ask, each answered by one JSON and some files. A stage is one file in `stages/`.

A stage's file has `STAGE = Stage(...)` and imports numpy and the like inside its functions, for the command line
lists the stages before it knows which one will run.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hvdc_ident.budget import Budget, Known
from hvdc_ident.errors import unknown_name
from hvdc_ident.executor import Progress, silent

if TYPE_CHECKING:
    from hvdc_ident.study.study import Study


UNFINISHED = "unfinished"
"""Status of a result whose stage its budget has ended."""


def unkept(data: Mapping[str, Any]) -> None:
    """Drop a first answer, where nothing is written."""


def unheard(lines: Sequence[str]) -> None:
    """Drop lines that nobody reads."""


@dataclass(frozen=True)
class StageOptions:
    """Options of a run. workers: processes, None for one on each available core where the work is long enough; seed: of every
    random number; progress: who is told.

    announce: who is told, in lines, what to know before the work begins, or while a long one goes on.
    keep: who writes a first answer, so that it stands where the work is interrupted; the stage runner sets it.
    force: candidates to fit whatever the verdict on them. folder: where results go and finished work is kept;
    None: nothing is kept. executor: where the work is done, "" for this machine. budget: of the whole run; None: no limit but those
    that the study states.
    """

    workers: int | None = 1
    seed: int = 0
    progress: Progress = silent
    force: tuple[str, ...] = ()
    folder: Path | None = None
    executor: str = ""
    budget: Budget | None = None
    announce: Callable[[Sequence[str]], None] = unheard
    keep: Callable[[Mapping[str, Any]], None] = unkept


@dataclass(frozen=True)
class StageResult:
    """The result of a stage. data: the JSON without its heading. files: text by name, written beside it.

    failed: why the work did not come to an end, empty where it did; what there is, is kept all the same. unfinished: whether that is
    its budget, so that the same stage is to go on another time.
    """

    data: Mapping[str, Any]
    files: Mapping[str, str] = field(default_factory=dict)
    failed: str = ""
    unfinished: bool = False


def no_lines(data: Mapping[str, Any]) -> Sequence[str]:
    """Return no lines, for a result that is told by where it stands."""
    return ()


def no_verdict(data: Mapping[str, Any]) -> str:
    """Return no verdict."""
    return ""


def nothing_known(study: Study, known: Sequence[Known], options: StageOptions) -> Mapping[str, Any]:
    """Return no JSON, for a stage whose parts are of no use before its end."""
    return {}


def no_files(study: Study, folder: Path, data: Mapping[str, Any]) -> dict[str, str]:
    """Return no files, for a result on which no file of another stage rests."""
    return {}


@dataclass(frozen=True)
class Stage:
    """One stage.

    name: its command. file: its JSON in DIR. run: the work, given the study, the options and the data of the stages it
    builds on, by name; what the study lacks for it is a StudyError. wanted: whether `run STUDY` includes it.
    after: the stages it builds on; they run first. despite: those of them whose failure does not end it, for it asks why. order: place
    among the stages of a run.
    uses: stages whose result it takes where one stands in the folder; they run before it in a run, never because of it.
    takes: names of `StageOptions` that only some stages have and that decide its result. tell: the result in lines for people,
    from its JSON; told_in_part: also where a part of the work failed. verdict: the same in one phrase, for the screen of a run.
    searches: whether it also runs at the start values, where a search begins; all run at the given ones. parts: what it does, in
    order: how the texts of its progress begin, and in words; none of a stage that does one thing. counted: how the texts begin while
    the last thing is counted after which little is left; None where there is no such thing. so_far: the JSON of what its parts had come
    to where its budget ended it; what runs the model has no time left. follow: the files that rest on its result and on those beside
    it in the folder, whatever its end was, given the study, the folder and its JSON.
    """

    name: str
    file: str
    summary: str
    run: Callable[[Study, StageOptions, Mapping[str, Any]], StageResult]
    wanted: Callable[[Study], bool]
    order: int
    after: tuple[str, ...] = ()
    despite: tuple[str, ...] = ()
    uses: tuple[str, ...] = ()
    takes: tuple[str, ...] = ()
    tell: Callable[[Mapping[str, Any]], Sequence[str]] = no_lines
    verdict: Callable[[Mapping[str, Any]], str] = no_verdict
    searches: bool = False
    told_in_part: bool = False
    parts: Mapping[str, str] = field(default_factory=dict)
    counted: str | None = ""
    so_far: Callable[[Study, Sequence[Known], StageOptions], Mapping[str, Any]] = nothing_known
    follow: Callable[[Study, Path, Mapping[str, Any]], Mapping[str, str]] = no_files


@cache
def stages() -> tuple[Stage, ...]:
    """Every stage, in the order of a run, found by walking `stages/`."""
    from hvdc_ident.study import stages as folder

    every = [
        importlib.import_module(f"{folder.__name__}.{m.name}").STAGE for m in pkgutil.iter_modules(folder.__path__)
    ]
    return tuple(sorted(every, key=lambda s: (s.order, s.name)))


def stage(name: str) -> Stage:
    """The stage of that name. Raises UnknownNameError."""
    for each in stages():
        if each.name == name:
            return each
    raise unknown_name("stage", name, [s.name for s in stages()])
