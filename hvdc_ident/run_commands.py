"""The commands that run stages: `demo`, `run`, and one for each stage; and the screens they end with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hvdc_ident.command import (
    Access,
    CommandFailed,
    Console,
    FitWork,
    Open,
    Out,
    StudyFile,
    WithinBudget,
    Work,
    open_page,
    pasteable,
)
from hvdc_ident.errors import require_known
from hvdc_ident.study.stages import Stage

if TYPE_CHECKING:
    from hvdc_ident.study.pipeline import Done
    from hvdc_ident.study.study import Study
    from hvdc_ident.summary import RunSummary


def demo(
    *,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for study, data, results and report.")
    ] = Path("hvdc-ident-demo"),
    open_: Open = False,
    work: Work,
    console: Console,
) -> None:
    """Calibrate the shipped link on recordings made here."""
    from hvdc_ident.study.examples import write_demo, write_truth
    from hvdc_ident.study.pipeline import run_study
    from hvdc_ident.study.study import load_study
    from hvdc_ident.summary import Results
    from hvdc_ident.summary.truth import truth_lines

    with console.progress() as progress:
        options = work.options(console, progress)
        study = load_study(write_demo(out, seed=work.seed, progress=progress))
        truth = write_truth(out, study, seed=work.seed)
        done = run_study(study, out, options)
    compared = truth_lines(truth, Results(out).summary)
    _tell_run(
        study, out, done, console, lambda line: pasteable(line, study.path, out, None), truth=compared, opens=open_
    )


def run(
    *,
    study: StudyFile,
    out: Out = None,
    open_: Open = False,
    work: Work,
    budget: WithinBudget = None,
    console: Console,
    access: Access,
) -> None:
    """Run every stage that the study asks for, then write the report.

    A second run redoes only what changed; after a kill it goes on.
    """
    from hvdc_ident.study.pipeline import run_study

    loaded = access.study(study)
    folder = out or loaded.folder
    with console.progress() as progress:
        done = run_study(loaded, folder, work.options(console, progress, budget))
    _tell_run(loaded, folder, done, console, lambda line: pasteable(line, study, out, access), opens=open_)


def _tell_run(
    study: Study,
    folder: Path,
    done: list[Done],
    console: Console,
    typed: Callable[[str], str],
    truth: Sequence[str] = (),
    opens: bool = False,
) -> None:
    """Tell how the stages of a run went. typed: returns a line with the commands in it as they are to be typed here.

    truth: lines with the values beside the true ones, in place of the table of values. opens: the report, in the browser.
    """
    from hvdc_ident.study.heading import heading_of
    from hvdc_ident.summary import Results

    seed = done[0].data["seed"] if done else 0
    by_stage = {d.stage.name: d.data for d in done}
    console.print_json({**heading_of(study, seed), "stages": by_stage, "report": "report.html"})
    console.say(*map(typed, run_lines(done, Results(folder).summary if done else None, truth)))
    console.say(f"report: {folder / 'report.html'}")
    if opens:
        open_page(folder / "report.html")
    failures = [f"{d.stage.name}: {d.failed}" for d in done if d.failed]
    if failures:
        raise CommandFailed("; ".join(failures))


def run_lines(done: Sequence[Done], summary: RunSummary | None, truth: Sequence[str] = ()) -> list[str]:
    """Return the screen of a run: for each stage its state and verdict, then what the results say.

    truth: lines that hold the values beside the true ones, where these are known, in place of the table of values.
    """
    from hvdc_ident.summary.screen import lines_of

    lines = [f"steady state, {line}" for line in dict.fromkeys(n for d in done for n in d.data.get("steady_state", ()))]
    for d in done:
        state = state_of(d)
        verdict = d.failed or d.stage.verdict(d.data)
        if "not_tried" in d.data and (known := d.stage.verdict(d.data)) and known != verdict:
            verdict = f"{verdict}; {known}"
        lines.append(f"{d.stage.name}: {state}; {verdict}" if verdict else f"{d.stage.name}: {state}")
    if summary is None:
        return lines
    return [*lines, "", *lines_of(summary, truth)]


def state_of(done: Done) -> str:
    """Return in words how a stage ended."""
    if done.unfinished:
        return "unfinished"
    return "failed" if done.failed else "done" if done.fresh else "kept from before"


def stage_command(stage: Stage) -> Callable[..., None]:
    """Return the command that runs one stage of a study, and those it builds on, and tells how it went."""

    def one_stage(
        *, study: StudyFile, out: Out = None, work: Work, budget: WithinBudget = None, console: Console, access: Access
    ) -> None:
        from hvdc_ident.study.pipeline import run_stage

        loaded = access.study(study)
        folder = out or loaded.folder
        with console.progress() as progress:
            options = work.options(console, progress, budget)
            hint = "NAME = {min = ..., max = ...} in [parameters], which makes a parameter a candidate"
            require_known("candidate", options.force, loaded.candidates, "--force", hint)
            done = run_stage(loaded, stage.name, folder, options)
        console.print_json(done.data)
        console.say(*(f"steady state, {line}" for line in done.data.get("steady_state", ())))
        silent = (done.failed and not (stage.told_in_part or done.unfinished)) or console.json or console.quiet
        ended = done.data.get("done", ()) if done.unfinished else ()
        lines = () if silent else (*ended, *stage.tell(done.data))
        console.say(*(pasteable(line, study, out, access) for line in lines))
        console.say(f"{stage.name}: {state_of(done)}; {folder / stage.file}")
        if done.failed:
            raise CommandFailed(f"{stage.name}: {done.failed}")

    one_stage.__doc__ = stage.summary
    if "force" in stage.takes:
        one_stage.__annotations__["work"] = FitWork
    return one_stage
