"""Stages put to work on a study: what runs first, what is written, what need not be done again."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hvdc_ident.budget import Budget, BudgetSpent, Known
from hvdc_ident.codec import plain
from hvdc_ident.errors import ComputationError, HvdcIdentError, InputError
from hvdc_ident.executor import Progress, StageProgress
from hvdc_ident.files import digest, json_pieces, json_text, write_text
from hvdc_ident.model import is_white_box
from hvdc_ident.study.checks import steady_notes
from hvdc_ident.study.executors import open_executor
from hvdc_ident.study.heading import heading_of, version
from hvdc_ident.study.initial_values import initial_values
from hvdc_ident.study.plausibility import violations
from hvdc_ident.study.stages import UNFINISHED, Stage, StageOptions, StageResult, stage, stages
from hvdc_ident.study.store import CachingExecutor, Store, exclusive, source_hash
from hvdc_ident.study.study import Study
from hvdc_ident.summary import Results, RunSummary, summarise
from hvdc_ident.summary.decisions import SUMMARISED
from hvdc_ident.summary.levels import InitialValue
from hvdc_ident.text import listed

if TYPE_CHECKING:
    from hvdc_ident.parallel import OpenPool, PatientPool
    from hvdc_ident.study.dask_executor import DaskExecutor


FIRST = "first-answer"
"""Status of a result that an interrupted stage left: it stands under `first`, and the stage has not come to its end."""


@dataclass(frozen=True)
class Done:
    """A stage that ran.

    data: its JSON. failed: why it did not come to its end, empty where it did. fresh: not kept from before.
    """

    stage: Stage
    data: Mapping[str, Any]
    failed: str
    fresh: bool

    @property
    def unfinished(self) -> bool:
        """True where its budget ended it."""
        return self.data.get("status") == UNFINISHED or "not_tried" in self.data


def run_stage(study: Study, name: str, folder: Path, options: StageOptions) -> Done:
    """The stage's result, written to the folder together with those of the stages it builds on.

    Those are taken as they stand in the folder for the same study, software and seed, whatever their other options and their end;
    the stage itself runs anew. Raises InputError, with nothing written, or ComputationError.
    """
    wanted = stage(name)
    with exclusive(folder):
        done = _run_after(study, wanted, folder, options, {}, _rest_of(study, options))
        write_summary(folder, heading_of(study, options.seed))
        return done


def have_stage(study: Study, name: str, folder: Path, options: StageOptions) -> Done:
    """The stage's result as it stands in the folder, whatever its seed, its other options and its end; run only where there is none.

    One of another state of the study, its files or the software is none.
    """
    wanted = stage(name)
    with exclusive(folder):
        kept = _ended(study, wanted, folder)
        if kept is not None:
            return kept
        done = _run_after(study, wanted, folder, options, {}, _rest_of(study, options))
        write_summary(folder, heading_of(study, options.seed))
        return done


def run_all(study: Study, folder: Path, options: StageOptions) -> list[Done]:
    """Every stage the study asks for, in order, written to the folder; those that stand there unchanged are kept.

    A stage that fails ends the run of those that build on it, but for one that asks why (`Stage.despite`); the others run. One that
    the study does not fit (an InputError) fails so, too, unless no other stage has a result: then the error is raised.
    """
    done: dict[str, Done] = {}
    refused: dict[str, InputError] = {}
    rest = _rest_of(study, options)
    asked = [s for s in stages() if s.wanted(study)]
    with exclusive(folder):
        for number, wanted in enumerate(asked, 1):
            numbered = replace(options, progress=_numbered(options.progress, number, len(asked)))
            if options.budget is not None and options.budget.spent and _kept(study, wanted, folder, options) is None:
                done[wanted.name] = _written(study, wanted, folder, options, _not_tried(options.budget), ())
                continue
            ended = {b for b in wanted.after if b in done and done[b].failed and b not in wanted.despite}
            if ended or any(b in refused for b in wanted.after):
                continue
            try:
                done[wanted.name] = _kept_or_run(study, wanted, folder, numbered, done, rest)
            except InputError as error:
                refused[wanted.name] = error
        if refused and all(d.failed for d in done.values()):
            raise next(iter(refused.values()))
        for name, reason in refused.items():
            done[name] = _written(study, stage(name), folder, options, _failed(reason), rest())
    return [done[s.name] for s in stages() if s.name in done]


def run_study(study: Study, folder: Path, options: StageOptions) -> list[Done]:
    """Run every stage that the study asks for and return them, with `run.json` and the report written to the folder.

    Raises as `run_all`.
    """
    from hvdc_ident.report.page import write_report  # the templates are of use to a whole run alone

    done = run_all(study, folder, options)
    heading = heading_of(study, options.seed)
    write_run(folder, heading, done)
    write_summary(folder, heading)
    options.progress(0, 1, "report: writing the page")
    write_report(folder)
    return done


def _numbered(progress: Progress, number: int, count: int) -> Progress:
    """Return progress that says before each text which of so many stages it is."""
    return lambda done, total, text: progress(done, total, f"{number} of {count}, {text}")


def write_run(folder: Path, heading: Mapping[str, Any], done: Sequence[Done]) -> None:
    """Write `run.json`, which says what a run did: the heading, and each stage with its outcome."""
    rows = {d.stage.name: {"file": d.stage.file, "failed": d.failed} for d in done}
    write_text(folder / "run.json", json_text({**heading, "stages": rows}))


def write_summary(folder: Path, heading: Mapping[str, Any]) -> RunSummary:
    """Return the summary of the results in a folder, written there as `summary.json`. heading: of the run."""
    stages = {name: data for name in SUMMARISED if (data := _read(folder / f"{name}.json"))}
    summary = summarise(stages, Results(folder).swing, heading)
    write_text(folder / "summary.json", json_text(summary.to_dict()))
    return summary


Rest = Callable[[], tuple[InitialValue, ...]]


def _rest_of(study: Study, options: StageOptions) -> Rest:
    """A function that returns the recorded rest against the model's; it is compared, and announced, when first asked for.

    So it is told before the work of the first stage that is not kept, and once.
    """

    @cache
    def rest() -> tuple[InitialValue, ...]:
        values = initial_values(study)
        options.announce(values.lines)
        return values.all

    return rest


def _kept_or_run(
    study: Study, wanted: Stage, folder: Path, options: StageOptions, done: Mapping[str, Done], rest: Rest
) -> Done:
    """The stage's result, kept where it stands as it is asked for. done: the stages of this run so far."""
    kept = _kept(study, wanted, folder, options)
    if kept is not None:
        return Done(wanted, kept, "", fresh=False)
    return _run_after(study, wanted, folder, options, done, rest)


def _run_after(
    study: Study, wanted: Stage, folder: Path, options: StageOptions, done: Mapping[str, Done], rest: Rest
) -> Done:
    """The stage, run after those that it builds on, each of which runs only where it has not for this study and seed."""
    earlier: dict[str, Any] = {}
    for name in wanted.after:
        before = done.get(name) or _ended(study, stage(name), folder)
        if before is None or before.data["seed"] != options.seed or (before.unfinished and name not in done):
            before = _run_after(study, stage(name), folder, options, done, rest)
        earlier[name] = before.data
    return _run(study, wanted, folder, options, earlier, rest)


def _run(
    study: Study, wanted: Stage, folder: Path, options: StageOptions, earlier: Mapping[str, Any], rest: Rest
) -> Done:
    levels: tuple[InitialValue, ...] = ()
    so_far = _SoFar(options.progress)

    def keep(first: Mapping[str, Any]) -> None:
        """Write a first answer, marked as such, unless the folder holds the whole one from before."""
        so_far.first = first
        if _kept(study, wanted, folder, options) is None:
            _written(study, wanted, folder, options, StageResult({"status": FIRST, **first}, failed=FIRST), levels)

    budget = options.budget
    limit: dict[str, Any] = {} if budget is None else {"limit": lambda: budget.left}
    progress: Progress = StageProgress(so_far.progress, wanted.name, wanted.counted, **limit)
    inside = replace(
        options, folder=folder, keep=keep, progress=progress if budget is None else budget.watched(progress)
    )
    try:
        with nullcontext() if budget is None else budget.timed():
            if budget is not None and budget.spent:  # what this stage builds on has taken all of it
                raise BudgetSpent(f"{budget.text} is over")
            levels = rest()
            outcome = wanted.run(study, inside, earlier)
    except ComputationError as error:
        outcome = _failed(error)
    except BudgetSpent as end:
        assert budget is not None
        outcome = so_far.ended_by(budget, wanted, end.known, wanted.so_far(study, end.known, inside))
    if outcome.unfinished and _kept(study, wanted, folder, options) is not None:  # the whole one from before stays
        return Done(wanted, {**heading_of(study, options.seed), **plain(outcome.data)}, outcome.failed, fresh=True)
    return _written(study, wanted, folder, options, outcome, levels)


class _SoFar:
    """What a stage under way has told so far, from which a result is made where its budget ends it.

    first: its first answer. last: the last text of its progress, without the stage's name.
    """

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self.first: Mapping[str, Any] = {}
        self.last = ""

    def progress(self, done: int, total: int, text: str) -> None:
        """Pass on progress and remember its text."""
        self.last = text.partition(": ")[2]
        self._progress(done, total, text)

    def ended_by(self, budget: Budget, wanted: Stage, known: Sequence[Known], data: Mapping[str, Any]) -> StageResult:
        """Return the result of a stage that its budget has ended: what it had come to, and what was not tried.

        known: what its parts had come to; data: the JSON that the stage makes of it.
        """
        parts = list(wanted.parts.items())
        at = next((k for k, (begins, _) in enumerate(parts) if self.last.startswith(begins)), -1)
        rest = [w for k in known for w in k.not_tried] or ([f"the rest of {parts[at][1]}"] if at >= 0 else [])
        not_tried = [*rest, *(words for _, words in parts[at + 1 :]), *(w for k in known for w in k.later)]
        message = f"ended by {budget.text}" + (f" at: {self.last}" if self.last else "")
        message += f"; not tried: {listed(not_tried)}" if not_tried else ""
        done = [line for k in known for line in k.done]
        about = {"message": message, "done": done, "not_tried": not_tried}
        return StageResult({**self.first, "status": UNFINISHED, **data, **about}, failed=message, unfinished=True)


def _not_tried(budget: Budget) -> StageResult:
    """Return the result of a stage that was not begun."""
    message = f"not tried: {budget.text} was over"
    return StageResult({"status": UNFINISHED, "message": message}, failed=message, unfinished=True)


def _failed(error: HvdcIdentError) -> StageResult:
    return StageResult({"status": "failed", "message": str(error)}, failed=str(error))


def _written(
    study: Study,
    wanted: Stage,
    folder: Path,
    options: StageOptions,
    outcome: StageResult,
    levels: tuple[InitialValue, ...],
) -> Done:
    heading = heading_of(study, options.seed)
    wrong = [] if outcome.failed else violations(wanted.name, plain(outcome.data))
    if wrong:
        outcome = replace(
            outcome, failed=f"what it found is not plausible, and is kept but no result: {'; '.join(wrong)}"
        )
    mark = _mark(study, wanted, folder, options)
    about = {
        "stage": wanted.name,
        "fingerprint": "" if outcome.failed else mark,
        "attempt": mark,
        "failed": outcome.failed,
        "files": list(outcome.files),
        "rest_levels": levels,
        "steady_state": () if outcome.unfinished else steady_notes(study, searches=wanted.searches),
    }
    taken = {"options": {n: getattr(options, n) for n in wanted.takes}} if wanted.takes else {}
    implausible = {"implausible": wrong} if wrong else {}
    data = plain({**heading, **about, **taken, **outcome.data, **implausible})
    for name, text in outcome.files.items():
        write_text(folder / name, text)
    for name, text in wanted.follow(study, folder, data).items():
        write_text(folder / name, text)
    write_text(folder / wanted.file, json_pieces(data))
    return Done(wanted, data, outcome.failed, fresh=True)


def _kept(study: Study, wanted: Stage, folder: Path, options: StageOptions) -> dict[str, Any] | None:
    """The stage's JSON in the folder, where it is whole and nothing that decides it has changed."""
    data = _read(folder / wanted.file)
    if not data.get("fingerprint") or data["fingerprint"] != _mark(study, wanted, folder, options):
        return None
    files = data.get("files")
    return data if isinstance(files, list) and all((folder / str(f)).is_file() for f in files) else None


def standing(study: Study, name: str, folder: Path) -> tuple[dict[str, Any], str]:
    """The stage's JSON in the folder whatever its seed and options were, and why it does not stand; "" where it does.

    Nothing is run. Without a result there the JSON is empty.
    """
    wanted = stage(name)
    data = _read(folder / wanted.file)
    if not data:
        return {}, f"no {name} has run"
    if data.get("sources") != dict(study.sources):
        return data, f"the {name} in {folder} is of an earlier state of the study or its files"
    if not data.get("fingerprint"):
        end = str(data.get("message") or data.get("failed") or "no reason is kept").rstrip(".")
        return data, f"the {name} in {folder} ended as {data.get('status', 'failed')}: {end}"
    if _kept(study, wanted, folder, _asked_before(wanted, data)) is None:
        return data, f"the {name} in {folder} is of another version of hvdc_ident, or not whole"
    return data, ""


def _ended(study: Study, wanted: Stage, folder: Path) -> Done | None:
    """The stage as it ended in the folder, whole or not, whatever its seed and options; None where it has not on this study, its files
    and this software."""
    data = _read(folder / wanted.file)
    known = _asked_before(wanted, data)
    if not data.get("attempt") or data["attempt"] != _mark(study, wanted, folder, known) or data.get("status") == FIRST:
        return None
    if not data.get("failed") and _kept(study, wanted, folder, known) is None:
        return None  # some of its files are gone
    return Done(wanted, data, str(data.get("failed", "")), fresh=False)


def _asked_before(wanted: Stage, data: Mapping[str, Any]) -> StageOptions:
    """The options that decided a stage's JSON: its seed, and those that it alone takes."""
    known: Mapping[str, Any] = data["options"] if isinstance(data.get("options"), dict) else {}
    taken: dict[str, Any] = {n: tuple(known[n]) for n in wanted.takes if isinstance(known.get(n), list)}
    taken |= {n: known[n] for n in wanted.takes if isinstance(known.get(n), float)}
    return StageOptions(seed=int(data.get("seed") or 0), **taken)


def _read(path: Path) -> dict[str, Any]:
    """The JSON object of a file; empty where there is none."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return data if isinstance(data, dict) else {}


def _mark(study: Study, wanted: Stage, folder: Path, options: StageOptions) -> str:
    """A hash of all that decides a stage's result: the study, its files, the seed, this software, the results it uses."""
    parts = [wanted.name, *(f"{n}={h}" for n, h in study.sources.items()), str(options.seed), version(), source_hash()]
    parts += [f"{name}={getattr(options, name)}" for name in wanted.takes if getattr(options, name)]
    for name in wanted.uses:
        data, why = standing(study, name, folder)
        parts.append(f"{name}={why or data['fingerprint']}")
    return digest("\n".join(parts).encode())


@contextmanager
def workers_of(study: Study, options: StageOptions) -> Iterator[OpenPool | PatientPool | DaskExecutor | None]:
    """The pool the options ask for; None where the work stays in this process.

    An FMU has processes of its own, which share the cores; some FMUs run in one process only. More are started where they
    are asked for.
    """
    workers = 1 if options.workers is None and not is_white_box(study.model) else options.workers
    with open_executor(options.executor, workers) as pool:
        yield pool


@contextmanager
def executor_of(
    study: Study, options: StageOptions, name: str
) -> Iterator[CachingExecutor | OpenPool | PatientPool | DaskExecutor | None]:
    """An executor for a stage's work of that name, whose finished pieces are kept where the options name a folder.

    The name tells apart the kinds of work of a study; the study's files, the seed and what is forced tell apart its
    states.
    """
    with ExitStack() as stack:
        pool = stack.enter_context(workers_of(study, options))
        if options.folder is None:
            yield pool
            return
        store = stack.enter_context(Store(options.folder))
        decided = json_text({"sources": dict(study.sources), "seed": options.seed, "force": list(options.force)})
        yield CachingExecutor(store.job(name, decided), pool)
