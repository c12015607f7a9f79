"""The command line: `hvdc-ident COMMAND ...`. Exit codes: 0 done, 1 the work ran and failed, 2 the input is wrong.

Nothing heavy is imported before a command needs it, so that the help comes at once.
"""

from __future__ import annotations

import functools
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from hvdc_ident.errors import HvdcIdentError, InputError
from hvdc_ident.study.stages import Stage, StageOptions, stages

if TYPE_CHECKING:
    from hvdc_ident.study.study import Study

app = typer.Typer(
    name="hvdc-ident",
    help="Linearisation, identifiability, calibration and discrepancy diagnosis of converter models.",
    epilog="Exit codes: 0 done; 1 the work ran and a stage failed, results kept; 2 the input is wrong.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)

StudyFile = Annotated[Path, typer.Argument(metavar="STUDY", help="The study file (TOML).", show_default=False)]
Out = Annotated[
    Path | None,
    typer.Option("--out", metavar="DIR", help="Folder for results; default STUDY-results.", show_default=False),
]
Workers = Annotated[int, typer.Option("--workers", metavar="N", min=1, max=4096, help="Processes to work with.")]
Where = Annotated[
    str,
    typer.Option(
        "--executor", metavar="WHERE", help="local, or dask://HOST:PORT: where the work is done.", show_default=False
    ),
]
Seed = Annotated[int, typer.Option("--seed", metavar="N", min=0, max=2**31 - 1, help="Seed of every random number.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result's JSON on stdout and nothing else.")]
Budget = Annotated[
    float | None,
    typer.Option(
        "--budget",
        metavar="SECONDS",
        min=0.001,
        help="Stop after so long; what was finished by then is kept, and the same command goes on.",
        show_default=False,
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", help="Say nothing but errors.")]
Trust = Annotated[bool, typer.Option("--trust", help="Run the code of a model that is a Python file.")]
Deadline = Annotated[
    float | None,
    typer.Option(
        "--deadline", metavar="S", help="Of an FMU: seconds one run may take; default 60.", show_default=False
    ),
]
Load = Annotated[
    float | None,
    typer.Option(
        "--load", metavar="S", help="Of an FMU: seconds it may take to begin; default 60.", show_default=False
    ),
]
Memory = Annotated[
    float | None,
    typer.Option("--memory", metavar="MIB", help="Of an FMU: MiB it may take; default 2048.", show_default=False),
]
Force = Annotated[
    list[str] | None,
    typer.Option("--force", metavar="NAME", help="Fit this candidate whatever the verdict on it; may be repeated."),
]


class _Failed(Exception):
    """The work ran and failed; what it found is written."""


class _BudgetSpent(KeyboardInterrupt):
    """The time that the work may take is over; it ends as by an interrupt."""


@contextmanager
def _within(budget: float | None) -> Iterator[None]:
    """Interrupt what is inside after so many seconds. Raises InputError where the system has no such timer."""
    if budget is None:
        yield
        return
    if not hasattr(signal, "setitimer"):
        raise InputError("this system has no timer for --budget", hint="leave it out, and interrupt the command")

    def stop(*_: object) -> NoReturn:
        raise _BudgetSpent(f"the {budget:g} s of --budget are over")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, budget)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def guarded(command: Callable[..., None]) -> Callable[..., None]:
    """The command with every exception turned into one message and an exit code, never a traceback."""

    @functools.wraps(command)
    def run(*arguments: Any, **named: Any) -> None:
        def end(code: int, message: str) -> NoReturn:
            _end(code, _pasteable(message, named.get("study"), named.get("out"), named.get("trust", False)))

        try:
            command(*arguments, **named)
            sys.stdout.flush()
        except typer.Exit:
            raise
        except HvdcIdentError as e:
            end(2 if isinstance(e, InputError) else 1, str(e))
        except _Failed as e:
            end(1, str(e))
        except _BudgetSpent as e:
            end(1, f"{e}; what was finished is kept, and the same command goes on from there")
        except KeyboardInterrupt:
            _end(130, "interrupted; what was finished is kept, and the same command goes on from there")
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(1) from None
        except MemoryError:
            _end(1, "not enough memory for this study")
        except Exception as e:
            if os.environ.get("HVDC_IDENT_DEBUG") == "1":
                traceback.print_exc()
            what = " ".join(f"{type(e).__name__}: {e}".split())[:300]
            _end(
                1,
                f"a bug in hvdc-ident, not in your study: {what}. Try: HVDC_IDENT_DEBUG=1 shows where, for a report",
            )

    return run


def _end(code: int, message: str) -> NoReturn:
    typer.echo(f"{'interrupted' if code == 130 else 'error'}: {message.removeprefix('interrupted; ')}", err=True)
    raise typer.Exit(code)


def _pasteable(text: str, study: Path | None, out: Path | None, trust: bool) -> str:
    """The text with the commands in it as they are to be typed here, by the arguments of the command that says it."""
    from hvdc_ident.text import with_study

    options = [*(("--out", str(out)) if out else ()), *(("--trust",) if trust else ())]
    return text if study is None else with_study(text, str(study), *options)


def _limits(deadline: float | None, load: float | None, memory: float | None) -> dict[str, float]:
    """The limits of an FMU that the command line states, by the keys of a study."""
    stated = {"deadline": deadline, "load": load, "memory": memory}
    return {name: value for name, value in stated.items() if value is not None}


def _say(text: str, *, json: bool, quiet: bool) -> None:
    """Text for people: on stdout, unless that is asked to hold JSON or to stay empty."""
    if not (json or quiet):
        typer.echo(text)


def _announcer(*, json: bool, quiet: bool) -> Callable[[Sequence[str]], None]:
    """Who says what to know before the work begins: on stderr where stdout is asked to hold JSON."""

    def announce(lines: Sequence[str]) -> None:
        for line in () if quiet else lines:
            typer.echo(line, err=json)

    return announce


def _print_json(value: Any) -> None:
    from hvdc_ident.files import json_pieces

    for piece in json_pieces(value):
        typer.echo(piece, nl=False)


@app.callback(invoke_without_command=True)
def _top(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        from importlib.metadata import version as installed

        typer.echo(f"hvdc-ident {installed('hvdc_ident')}")
        raise typer.Exit


@app.command()
@guarded
def demo(
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for study, data, results and report.")
    ] = Path("hvdc-ident-demo"),
    workers: Workers = 1,
    executor: Where = "",
    seed: Seed = 0,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Calibrate the shipped link on recordings made here."""
    from hvdc_ident.executor import progress_bar
    from hvdc_ident.study.examples import write_demo
    from hvdc_ident.study.study import load_study

    with progress_bar(quiet or json) as told:
        study = load_study(write_demo(out, seed=seed, progress=told))
        announce = _announcer(json=json, quiet=quiet)
        done = _run_all(study, out, StageOptions(workers, seed, told, executor=executor, announce=announce))
    _tell_run(study, out, done, lambda line: _pasteable(line, study.path, out, False), json=json, quiet=quiet)


@app.command()
@guarded
def new(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder to make; it must not hold a study.", show_default=False)
    ],
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Write a commented study, with data, to start from."""
    from hvdc_ident.study.examples import write_starter

    path = write_starter(folder)
    if json:
        _print_json({"schema": 1, "study": path.as_posix()})
    _say(f"{path} is written. Next: hvdc-ident run {path}", json=json, quiet=quiet)


@app.command()
@guarded
def check(
    study: Annotated[
        Path, typer.Argument(metavar="STUDY|FMU", help="A study file (TOML), or an FMU.", show_default=False)
    ],
    find: Annotated[
        str, typer.Option("--find", metavar="TEXT", help="Of an FMU: variables with TEXT.", show_default=False)
    ] = "",
    all_: Annotated[bool, typer.Option("--all", help="Of an FMU: every variable.")] = False,
    build: Annotated[
        bool, typer.Option("--compile", help="Of an FMU: compile the C sources in it into a new file beside it.")
    ] = False,
    seed: Seed = 0,
    json: Json = False,
    quiet: Quiet = False,
    trust: Trust = False,
    out: Out = None,
    deadline: Deadline = None,
    load: Load = None,
    memory: Memory = None,
) -> None:
    """Validate study, model and data, and compare the levels before each event; run no stage.

    Of an FMU: list its variables, what it offers, and what a short run finds.
    """
    if study.suffix.lower() == ".fmu":
        limits = _limits(deadline, load, memory)
        _check_fmu(study, find, limits, every=all_ or bool(find), build=build, json=json, quiet=quiet)
        return
    if find or all_ or build:
        raise InputError("--find, --all and --compile are about an FMU", where=str(study), expected="a path to an .fmu")
    from hvdc_ident.study.study import load_study
    from hvdc_ident.study.summary import Summary

    found = Summary.of(load_study(study, trust, _limits(deadline, load, memory)), seed)
    if json:
        _print_json(found.to_dict())
    _say(str(found), json=json, quiet=quiet)


def _check_fmu(
    path: Path, find: str, limits: Mapping[str, float], *, every: bool, build: bool, json: bool, quiet: bool
) -> None:
    """Print what an FMU holds and offers; where it cannot run here, that is the error, after the list."""
    from hvdc_ident.fmu.capabilities import read_capabilities, tried
    from hvdc_ident.models import load_model

    if build:
        from hvdc_ident.fmu.compile import compile_fmu

        path = compile_fmu(path)
        _say(f"compiled: {path} is written; name it in the study's [model] source", json=json, quiet=quiet)
    found = read_capabilities(path)
    found = found if found.problem else tried(load_model(path, limits=limits), found)  # type: ignore[arg-type]
    shown = found.matching(find) if find else found
    if json:
        _print_json(shown.to_dict())
    _say(shown.text(None) if every else shown.text(), json=json, quiet=quiet)
    if found.problem:
        load_model(path)  # raises, with the way out


@app.command("run")
@guarded
def run_(
    study: StudyFile,
    out: Out = None,
    workers: Workers = 1,
    executor: Where = "",
    seed: Seed = 0,
    json: Json = False,
    quiet: Quiet = False,
    trust: Trust = False,
    deadline: Deadline = None,
    load: Load = None,
    memory: Memory = None,
) -> None:
    """Every stage the study asks for, then the report.

    A second run redoes only what changed; after a kill it goes on.
    """
    from hvdc_ident.executor import progress_bar
    from hvdc_ident.study.study import load_study

    loaded = load_study(study, trust, _limits(deadline, load, memory))
    folder = out or loaded.folder
    with progress_bar(quiet or json) as told:
        announce = _announcer(json=json, quiet=quiet)
        done = _run_all(loaded, folder, StageOptions(workers, seed, told, executor=executor, announce=announce))
    _tell_run(loaded, folder, done, lambda line: _pasteable(line, study, out, trust), json=json, quiet=quiet)


def _run_all(study: Study, folder: Path, options: StageOptions) -> list[Any]:
    from hvdc_ident.report.page import write_report
    from hvdc_ident.study.pipeline import heading_of, run_all, write_run

    done = run_all(study, folder, options)
    write_run(folder, heading_of(study, options.seed), done)
    options.progress(len(done), len(done) + 1, "report")
    write_report(folder)
    return done


def _tell_run(
    study: Study, folder: Path, done: list[Any], typed: Callable[[str], str], *, json: bool, quiet: bool
) -> None:
    """Tell how the stages of a run went. typed: a line with the commands in it as they are to be typed here."""
    if json:
        from hvdc_ident.study.pipeline import heading_of

        seed = done[0].data["seed"] if done else 0
        _print_json(
            {**heading_of(study, seed), "stages": {d.stage.name: d.data for d in done}, "report": "report.html"}
        )
    for line in dict.fromkeys(line for d in done for line in d.data.get("steady_state", ())):
        _say(f"steady state, {line}", json=json, quiet=quiet)
    for d in done:
        state = "failed" if d.failed else "done" if d.fresh else "kept from before"
        # A fit that ended on a bound or found two optima is done, but not by that word alone.
        status = d.data.get("status")
        rest = f", {status}" if status in ("at-bound", "two-optima") and not d.failed else ""
        if (d.data.get("adequacy") or {}).get("verdict") == "does-not-fit" and not d.failed:
            rest += f", but the model does not fit; next: {d.data['adequacy']['next']}"
        _say(typed(f"{d.stage.name}: {state}{rest}"), json=json, quiet=quiet)
    _say(f"report: {folder / 'report.html'}", json=json, quiet=quiet)
    failures = [f"{d.stage.name}: {d.failed}" for d in done if d.failed]
    if failures:
        raise _Failed("; ".join(failures))


def _run_one(
    stage: Stage,
    study: Path,
    out: Path | None,
    options: StageOptions,
    limits: Mapping[str, float],
    *,
    budget: float | None,
    json: bool,
    quiet: bool,
    trust: bool,
) -> None:
    """Run one stage of a study, and those it builds on, and tell how it went. budget: s, for the work."""
    from dataclasses import replace

    from hvdc_ident.executor import progress_bar
    from hvdc_ident.study.pipeline import run_stage
    from hvdc_ident.study.study import load_study

    loaded = load_study(study, trust, limits)
    folder = out or loaded.folder
    announce = _announcer(json=json, quiet=quiet)
    with _within(budget), progress_bar(quiet or json) as told:
        done = run_stage(loaded, stage.name, folder, replace(options, progress=told, announce=announce))
    if json:
        _print_json(done.data)
    for line in done.data.get("steady_state", ()):
        _say(f"steady state, {line}", json=json, quiet=quiet)
    for line in () if done.failed else stage.tell(done.data):
        _say(_pasteable(line, study, out, trust), json=json, quiet=quiet)
    _say(f"{stage.name}: {'failed' if done.failed else 'done'}; {folder / stage.file}", json=json, quiet=quiet)
    if done.failed:
        raise _Failed(f"{stage.name}: {done.failed}")


def _add_stage(stage: Stage) -> None:
    """Registers one stage as a command of its name."""

    def command(
        study: StudyFile,
        out: Out = None,
        workers: Workers = 1,
        executor: Where = "",
        seed: Seed = 0,
        budget: Budget = None,
        json: Json = False,
        quiet: Quiet = False,
        trust: Trust = False,
        deadline: Deadline = None,
        load: Load = None,
        memory: Memory = None,
    ) -> None:
        options = StageOptions(workers, seed, executor=executor)
        limits = _limits(deadline, load, memory)
        _run_one(stage, study, out, options, limits, budget=budget, json=json, quiet=quiet, trust=trust)

    def forcing(
        study: StudyFile,
        force: Force = None,
        out: Out = None,
        workers: Workers = 1,
        executor: Where = "",
        seed: Seed = 0,
        budget: Budget = None,
        json: Json = False,
        quiet: Quiet = False,
        trust: Trust = False,
        deadline: Deadline = None,
        load: Load = None,
        memory: Memory = None,
    ) -> None:
        options = StageOptions(workers, seed, force=tuple(dict.fromkeys(force or ())), executor=executor)
        limits = _limits(deadline, load, memory)
        _run_one(stage, study, out, options, limits, budget=budget, json=json, quiet=quiet, trust=trust)

    made = forcing if "force" in stage.takes else command
    made.__doc__ = stage.summary
    app.command(stage.name)(guarded(made))


for _stage in stages():
    _add_stage(_stage)


@app.command()
@guarded
def letter(
    study: StudyFile,
    out: Out = None,
    workers: Workers = 1,
    executor: Where = "",
    seed: Seed = 0,
    json: Json = False,
    quiet: Quiet = False,
    trust: Trust = False,
    deadline: Deadline = None,
    load: Load = None,
    memory: Memory = None,
) -> None:
    """One page for the owner of the model: what it misses, why, and what is attached."""
    from hvdc_ident.executor import progress_bar
    from hvdc_ident.study.export import letter as write
    from hvdc_ident.study.study import load_study

    loaded = load_study(study, trust, _limits(deadline, load, memory))
    folder = out or loaded.folder
    with progress_bar(quiet or json) as told:
        announce = _announcer(json=json, quiet=quiet)
        page, done = write(loaded, folder, StageOptions(workers, seed, told, executor=executor, announce=announce))
    if json:
        _print_json({"schema": 1, "file": page.as_posix(), "verdict": done.data.get("verdict")})
    _say(f"letter: {page}", json=json, quiet=quiet)


@app.command()
@guarded
def report(
    source: Annotated[
        Path, typer.Argument(metavar="STUDY|DIR", help="A study, or a folder of results.", show_default=False)
    ],
    out: Out = None,
    pdf: Annotated[bool, typer.Option("--pdf", help="Write report.pdf too; needs the extra 'pdf'.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    trust: Trust = False,
    deadline: Deadline = None,
    load: Load = None,
    memory: Memory = None,
) -> None:
    """Build the page again from the results in DIR."""
    from hvdc_ident.report.page import write_report

    if source.is_dir():
        folder = source
    elif not source.exists():
        raise InputError(
            "no such study, and no such folder",
            where=str(source),
            expected="a study file, or a folder that a run wrote its results into",
            hint="`hvdc-ident run STUDY` writes such a folder, STUDY-results",
        )
    else:
        from hvdc_ident.study.study import load_study

        folder = out or load_study(source, trust, _limits(deadline, load, memory)).folder
    page = write_report(folder)
    if pdf:
        from hvdc_ident.report.page import write_pdf

        _say(f"report: {write_pdf(page)}", json=json, quiet=quiet)
    if json:
        _print_json({"schema": 1, "report": page.as_posix(), "bytes": page.stat().st_size})
    _say(f"report: {page}", json=json, quiet=quiet)


@app.command()
@guarded
def export(
    study: StudyFile,
    to: Annotated[
        Path,
        typer.Option(
            "--to",
            metavar="FILE",
            help=".fmu .mo .toml (the model); .ssv (its parameters); .mat .json .csv .m .tex .zpk (the linear model).",
            show_default=False,
        ),
    ],
    linear: Annotated[
        bool, typer.Option("--linear", help="The linear model, where the ending has both (.mo).")
    ] = False,
    fmi: Annotated[
        str | None, typer.Option("--fmi", metavar="2|3", help="Version of an FMU; default 2.", show_default=False)
    ] = None,
    kind: Annotated[
        str | None, typer.Option("--kind", metavar="me|cs", help="One kind of FMU; default both.", show_default=False)
    ] = None,
    reduced: Annotated[
        bool, typer.Option("--reduced", help="The reduced linear model that [linearize] reduce asks for.")
    ] = False,
    source_only: Annotated[bool, typer.Option("--source-only", help="An FMU of sources, without a binary.")] = False,
    values: Annotated[
        str | None,
        typer.Option(
            "--values",
            metavar="given|start|fitted",
            help="Which values; default the fitted ones where a fit stands in the results, else the given ones.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder of results with the fit; default STUDY-results."),
    ] = None,
    json: Json = False,
    quiet: Quiet = False,
    trust: Trust = False,
    deadline: Deadline = None,
    load: Load = None,
    memory: Memory = None,
) -> None:
    """Write the model or its linear model in the format of FILE's ending."""
    from hvdc_ident.study.export import fmu_options, write
    from hvdc_ident.study.study import load_study

    written = write(
        load_study(study, trust, _limits(deadline, load, memory)),
        to,
        linear,
        fmu_options(fmi, kind, source_only),
        values,
        out,
        reduced=reduced,
    )
    size = written.path.stat().st_size
    if json:
        about = {"bytes": size, "values": written.values, "note": written.note}
        _print_json({"schema": 1, "file": written.path.as_posix(), **about})
    _say(f"{written.path}: {size} bytes" + (f"; {written.note}" if written.note else ""), json=json, quiet=quiet)


@app.command()
@guarded
def convert(
    data: Annotated[
        Path, typer.Argument(metavar="DATA", help="A file of waveforms in any known format.", show_default=False)
    ],
    to: Annotated[
        Path | None,
        typer.Option("--to", metavar="FILE.csv", help="The CSV or Parquet file to write.", show_default=False),
    ] = None,
    signal: Annotated[
        list[str] | None, typer.Option("--signal", metavar="NAME", help="A signal wanted; default all.")
    ] = None,
    window: Annotated[
        tuple[float, float] | None,
        typer.Option("--window", metavar="FROM TO", help="Only the rows within these times, in s.", show_default=False),
    ] = None,
    search: Annotated[
        str | None,
        typer.Option(
            "--list", metavar="TEXT", help="List the signals whose name has TEXT ('' for all).", show_default=False
        ),
    ] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Any waveform format to CSV or Parquet; or, with --list, what a file holds."""
    from hvdc_ident.formats import convert as to_csv
    from hvdc_ident.formats import list_signals

    if (search is None) == (to is None):
        raise InputError(
            "convert needs one of --to and --list",
            where="the command line",
            hint="--to FILE.csv, or --list '' to see the signals",
        )
    if window is not None and to is None:
        raise InputError("--window cuts what --to writes", where="the command line", hint="--to FILE.csv beside it")
    if search is not None:
        found = list_signals(data, search)
        if json:
            _print_json({"schema": 1, "signals": [{"name": n, "unit": u} for n, u in found]})
        _say("\n".join(f"{n} [{u}]" if u else n for n, u in found) or "no such signal", json=json, quiet=quiet)
        return
    assert to is not None
    written = to_csv(data, to, signal, window)
    gaps = {n: k for n in written.names if (k := written.gaps(n))}
    start, end = float(written.time[0]), float(written.time[-1])
    if json:
        _print_json(
            {
                "schema": 1, "file": to.as_posix(), "rows": len(written), "signals": list(written.names),
                "rows_in_file": written.origin.rows or len(written), "dropped": written.origin.dropped, "time": [start, end],
                "not_recorded": gaps,
            }
        )  # fmt: skip
    total, left = written.origin.rows, written.origin.dropped
    rows = f"{len(written)} rows" if len(written) == total else f"{len(written)} of {total} rows"
    dropped = f" ({left} of the file dropped: a third of one instant, or outside another record)" if left else ""
    _say(f"{to}: {rows}{dropped}, {start:g} to {end:g} s, {len(written.names)} signals", json=json, quiet=quiet)
    for name, number in gaps.items():
        _say(f"{name}: {number} of {len(written)} rows not recorded", json=json, quiet=quiet)


@app.command()
@guarded
def models(json: Json = False, quiet: Quiet = False) -> None:
    """The shipped models, one line each."""
    from hvdc_ident.models import summaries

    _catalogue("models", summaries(), json=json)


@app.command()
@guarded
def effects(json: Json = False, quiet: Quiet = False) -> None:
    """The catalogue of effects, one line each, with sizes that show on a per-unit signal. Those that `diagnose` tries
    only where they are named say so."""
    from hvdc_ident.effects import Effect
    from hvdc_ident.effects import effects as known

    def line(e: Effect) -> str:
        return f"{e.summary}; {e.shown}" + ("" if e.sought else " (diagnose: tried where it is named)")

    _catalogue("effects", {name: e.summary if json else line(e) for name, e in known().items()}, json=json)


@app.command()
@guarded
def formats(json: Json = False, quiet: Quiet = False) -> None:
    """The waveform formats, one line each."""
    from hvdc_ident.formats import formats as known

    _catalogue("formats", {name: f"{f.SUMMARY} ({', '.join(f.SUFFIXES)})" for name, f in known().items()}, json=json)


def _catalogue(kind: str, lines: dict[str, str], *, json: bool) -> None:
    if json:
        _print_json({"schema": 1, kind: lines})
        return
    width = max((len(n) for n in lines), default=0)
    typer.echo("\n".join(f"{name:<{width}}  {text}" for name, text in lines.items()))


def main() -> None:
    """Nothing; the process ends with the command's exit code."""
    # The matrices are narrow: threads of the linear algebra would cost more than they save. Workers inherit this.
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    app()
