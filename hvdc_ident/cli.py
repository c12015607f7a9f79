"""The command line: `hvdc-ident COMMAND ...`. Exit codes: 0 done, 1 the work ran and failed, 2 the input is wrong.

Nothing heavy is imported before a command needs it, so that the help comes at once.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hvdc_ident import run_commands
from hvdc_ident.command import (
    OWN_PROCESS,
    Access,
    Console,
    FmuFormat,
    Open,
    Out,
    PsseUnit,
    Seed,
    StudyFile,
    WithinBudget,
    Work,
    command,
    echo,
    open_address,
    open_page,
    option,
    pasteable,
)
from hvdc_ident.errors import InputError
from hvdc_ident.study.stages import stages

if TYPE_CHECKING:
    from hvdc_ident.study.new_study import NewStudy

app = typer.Typer(
    name="hvdc-ident",
    help="Linearisation, identifiability, calibration and discrepancy diagnosis of converter models.",
    epilog="Exit codes: 0 done; 1 the work ran and a stage failed, results kept; 2 the input is wrong.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)


@app.callback(invoke_without_command=True)
def _top(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        from importlib.metadata import version as installed

        typer.echo(f"hvdc-ident {installed('hvdc_ident')}")
        raise typer.Exit


def new(
    *,
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder to make; it must not hold a study.", show_default=False)
    ],
    recordings: Annotated[
        list[Path] | None,
        option("--from", "FILE", "A recording to make an experiment of, of any waveform format; may be repeated."),
    ] = None,
    model: Annotated[str | None, option("--model", "MODEL", "With --from: a shipped model, or a path.")] = None,
    unit: PsseUnit,
    console: Console,
    access: Access,
) -> None:
    """Write a commented study to start from: an example with data, or one of recordings and a model.

    With --from and --model, columns are mapped to the model's inputs and outputs by name and unit. With --dyr and --bus in
    place of --model, the model is the unit of that bus, played back: recorded V and theta or f give P and Q.
    """
    if unit.dyr is not None or unit.bus is not None:
        _tell_new(console, _new_unit(folder, recordings or [], model, unit))
        return
    if (recordings is None) != (model is None):
        raise InputError(
            "--from and --model go together",
            where="the command line",
            expected="recordings and their model, or neither for an example",
            got="--from alone" if recordings else "--model alone",
            hint="--from recording.csv --model card.toml; `hvdc-ident models` lists the shipped ones",
        )
    if recordings and model:
        from hvdc_ident.study.new_study import new_study

        _tell_new(console, new_study(folder, recordings, model, trust=access.trust, limits=access.limits))
        return
    from hvdc_ident.study.examples import write_starter

    path = write_starter(folder)
    console.print_json({"schema": 1, "study": path.as_posix()})
    console.say(f"{path} is written. Next: hvdc-ident run {path}")


def _new_unit(folder: Path, recordings: list[Path], model: str | None, unit: PsseUnit) -> NewStudy:
    """Return the study of a unit of a .dyr file. Raises InputError where an option is missing, or one of another kind of study is there."""
    from hvdc_ident.study.new_unit import UnitAsked, new_unit_study

    if unit.dyr is None or unit.bus is None or not recordings or model is not None:
        given = {"--dyr": unit.dyr, "--bus": unit.bus, "--from": recordings or None, "--model": model}
        raise InputError(
            "--dyr, --bus and --from go together, without --model",
            where="the command line",
            expected="a .dyr file, the unit's bus and recordings at its terminals",
            got=", ".join(n for n, v in given.items() if v is not None),
            hint="--dyr plant.dyr --raw grid.raw --bus 101 --from event.csv",
        )
    return new_unit_study(folder, recordings, UnitAsked(**vars(unit)))


def _tell_new(console: Console, study: NewStudy) -> None:
    console.print_json(study.to_dict())
    console.say(*replace(study, door="shell").lines)


def check(
    *,
    study: Annotated[
        Path, typer.Argument(metavar="STUDY|FMU", help="A study file (TOML), or an FMU.", show_default=False)
    ],
    find: Annotated[str, option("--find", "TEXT", "List only the variables of an FMU that contain TEXT.")] = "",
    all_: Annotated[bool, typer.Option("--all", help="List every variable of an FMU.")] = False,
    build: Annotated[
        bool, typer.Option("--compile", help="Compile the C sources of an FMU into a new file beside it.")
    ] = False,
    seed: Seed = 0,
    console: Console,
    access: Access,
    out: Out = None,
) -> None:
    """Validate study, model and data; run no stage.

    The levels before each event are compared with the model's. What would hinder a run is told at the end.

    For an FMU, list its variables and what it offers, and report what a short run finds.
    """
    if study.suffix.lower() == ".fmu":
        _check_fmu(study, find, access.limits, console, every=all_ or bool(find), build=build)
        return
    if find or all_ or build:
        raise InputError("--find, --all and --compile are about an FMU", where=str(study), expected="a path to an .fmu")
    from hvdc_ident.study.summary import Summary

    summary = Summary.of(access.study(study), seed)
    console.print_json(summary.to_dict())
    console.say(*(pasteable(line, study, out, access) for line in str(summary).splitlines()))


def _check_fmu(
    path: Path, find: str, limits: Mapping[str, float], console: Console, *, every: bool, build: bool
) -> None:
    """Print what an FMU holds and offers; where it cannot run here, that is the error, after the list."""
    from hvdc_ident.fmu import read_capabilities, tested_capabilities
    from hvdc_ident.models import load_model

    if not path.is_file():
        beside = sorted(p.name for p in path.parent.glob("*.fmu"))[:5] if path.parent.is_dir() else []
        raise InputError(
            "no such FMU",
            where=str(path),
            expected="a path to an .fmu",
            hint=f"{', '.join(beside)} in the same folder"
            if beside
            else "the path as `ls` shows it, or another folder",
        )
    if build:
        from hvdc_ident.fmu import compile_fmu

        path = compile_fmu(path)
        console.say(f"compiled: {path} is written; name it in the study's [model] source")
    capabilities = read_capabilities(path)
    if not capabilities.problem:
        capabilities = tested_capabilities(load_model(path, limits=limits), capabilities)  # type: ignore[arg-type]
    shown = capabilities.matching(find) if find else capabilities
    console.print_json(shown.to_dict())
    listed = shown.text(None) if every else shown.text()
    console.say(listed)
    if listed != shown.text(None):
        console.say("", "--all shows every variable, --find TEXT those with TEXT in them")
    if capabilities.problem:
        load_model(path)  # raises, with the way out


def letter(
    *,
    study: StudyFile,
    out: Out = None,
    open_: Open = False,
    work: Work,
    budget: WithinBudget = None,
    console: Console,
    access: Access,
) -> None:
    """Write one page for the model's owner. It states what the model misses, why, and what is attached."""
    from hvdc_ident.study.export import letter as write

    loaded = access.study(study)
    with console.progress() as progress:
        page, done = write(loaded, out or loaded.folder, work.options(console, progress, budget))
    console.print_json({"schema": 1, "file": page.as_posix(), "verdict": done.data.get("verdict")})
    console.say(f"letter: {page}")
    if loaded.settings.letter is None:
        console.say(
            "It names no author, addressee or plant: [letter] in the study takes author, to, plant, version, date."
        )
    if open_:
        open_page(page)


def report(
    *,
    source: Annotated[
        Path, typer.Argument(metavar="STUDY|DIR", help="A study, or a folder of results.", show_default=False)
    ],
    out: Out = None,
    pdf: Annotated[bool, typer.Option("--pdf", help="Write report.pdf too; needs the extra 'pdf'.")] = False,
    open_: Open = False,
    console: Console,
    access: Access,
) -> None:
    """Build the report again from the results in DIR."""
    from hvdc_ident.report.page import write_pdf, write_report

    if not source.exists():
        raise InputError(
            "no such study, and no such folder",
            where=str(source),
            expected="a study file, or a folder that a run wrote its results into",
            hint="`hvdc-ident run STUDY` writes such a folder, STUDY-results",
        )
    page = write_report(source if source.is_dir() else out or access.study(source).folder)
    if pdf:
        console.say(f"report: {write_pdf(page)}")
    console.print_json({"schema": 1, "report": page.as_posix(), "bytes": page.stat().st_size})
    console.say(f"report: {page}")
    if open_:
        open_page(page)


def compare(
    *,
    first: Annotated[
        Path, typer.Argument(metavar="RUN", help="A folder of results, or a study with results.", show_default=False)
    ],
    second: Annotated[Path, typer.Argument(metavar="RUN", help="The other one.", show_default=False)],
    out: Annotated[Path | None, option("--out", "DIR", "Folder to write the page compare.html into.")] = None,
    open_: Open = False,
    console: Console,
) -> None:
    """Compare two results: values and how far apart they are, gaps, verdicts, findings, inputs."""
    from hvdc_ident.files import write_text
    from hvdc_ident.study.comparison import compare_runs

    if open_ and out is None:
        raise InputError(
            "--open has no page to open", where="the command line", hint="--out DIR, which writes the page"
        )
    comparison = compare_runs(first, second)
    console.print_json(comparison.to_dict())
    console.say(*comparison.lines)
    if out is not None:
        page = write_text(out / "compare.html", comparison.page)
        console.say(f"page: {page}")
        if open_:
            open_page(page)


def export(
    *,
    study: StudyFile,
    to: Annotated[
        Path,
        option(
            "--to",
            "FILE",
            ".fmu .mo .toml (the model); .ssv (its parameters); .mat .json .csv .m (the linear model).",
        ),
    ],
    linear: Annotated[
        bool, typer.Option("--linear", help="The linear model, where the ending has both (.mo).")
    ] = False,
    fmu: FmuFormat,
    reduced: Annotated[
        bool, typer.Option("--reduced", help="The reduced linear model that [linearize] reduce asks for.")
    ] = False,
    values: Annotated[
        str | None,
        option(
            "--values",
            "given|start|fitted|effect|fit",
            "Which values; default the fitted ones that count where a fit stands in the results, else the given ones. effect: with "
            "the effect that a diagnosis found; fit: of the fit without one.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder of results; default STUDY-results."),
    ] = None,
    console: Console,
    access: Access,
) -> None:
    """Write the model or its linear model. The ending of FILE selects the format."""
    from hvdc_ident.next_step import next_phrases
    from hvdc_ident.study.export import write

    written = write(access.study(study), to, linear, fmu.options(), values, out, reduced=reduced)
    size = written.path.stat().st_size
    about = {"bytes": size, "values": written.values, "set": written.of, "note": written.note}
    console.print_json({"schema": 1, "file": written.path.as_posix(), **about})
    said = [f"{size} bytes", written.note, next_phrases(written.next)]
    console.say(f"{written.path}: {'; '.join(filter(None, said))}")


def convert(
    *,
    data: Annotated[
        Path, typer.Argument(metavar="DATA", help="A file of waveforms in any known format.", show_default=False)
    ],
    to: Annotated[Path | None, option("--to", "FILE.csv", "The CSV or Parquet file to write.")] = None,
    signal: Annotated[
        list[str] | None, typer.Option("--signal", metavar="NAME", help="A signal wanted; default all.")
    ] = None,
    window: Annotated[
        tuple[float, float] | None, option("--window", "FROM TO", "Only the rows within these times, in s.")
    ] = None,
    search: Annotated[
        str | None, option("--list", "TEXT", "List the signals whose name has TEXT ('' for all).")
    ] = None,
    console: Console,
) -> None:
    """Convert waveforms of any format to CSV or Parquet. With --list, list a file's signals."""
    from hvdc_ident.formats import convert as to_csv
    from hvdc_ident.formats import list_signals

    if (search is None) == (to is None):
        raise InputError(
            "convert needs one of --to and --list",
            where="the command line",
            hint="--to FILE.csv, or --list '' to see the signals",
        )
    if to is None:
        if window is not None:
            raise InputError("--window cuts what --to writes", where="the command line", hint="--to FILE.csv beside it")
        signals = list_signals(data, search or "")
        console.print_json({"schema": 1, "signals": [{"name": n, "unit": u} for n, u in signals]})
        console.say("\n".join(f"{n} [{u}]" if u else n for n, u in signals) or "no such signal")
        return
    written = to_csv(data, to, signal, window)
    gaps = {n: k for n in written.names if (k := written.gaps(n))}
    start, end = float(written.time[0]), float(written.time[-1])
    total, omitted = written.origin.rows, written.origin.dropped
    console.print_json(
        {
            "schema": 1, "file": to.as_posix(), "rows": len(written), "signals": list(written.names),
            "rows_in_file": total or len(written), "dropped": omitted, "time": [start, end], "not_recorded": gaps,
            "notes": list(written.origin.notes),
        }
    )  # fmt: skip
    rows = f"{len(written)} rows" if len(written) == total else f"{len(written)} of {total} rows"
    dropped = f" ({omitted} of the file dropped: a third of one instant)" if omitted else ""
    console.say(f"{to}: {rows}{dropped}, {start:g} to {end:g} s, {len(written.names)} signals")
    console.say(*(f"{name}: {number} of {len(written)} rows not recorded" for name, number in gaps.items()))
    console.say(*written.origin.notes)


def models(*, console: Console) -> None:
    """List the shipped models, one a line."""
    from hvdc_ident.models import summaries

    _catalogue("models", summaries(), console)


def effects(*, console: Console) -> None:
    """List the effects that a model may lack. Each has sizes that show on a per-unit signal; those that `diagnose` does not
    try at once say where it does."""
    from hvdc_ident.effects import Effect
    from hvdc_ident.effects import effects as known

    def line(e: Effect) -> str:
        tried = "tried where no other effect explains the records" if e.outside else "tried where it is named"
        tried = f"at states; diagnose: {tried}" if e.of_derivative else f"diagnose: {tried}"
        return f"{e.summary}; {e.example_text}" + ("" if e.tried_by_default else f" ({tried})")

    _catalogue("effects", {name: e.summary if console.json else line(e) for name, e in known().items()}, console)


def formats(*, console: Console) -> None:
    """List the waveform formats, one a line."""
    from hvdc_ident.formats import formats as known

    _catalogue("formats", {name: f"{f.SUMMARY} ({', '.join(f.SUFFIXES)})" for name, f in known().items()}, console)


def _catalogue(kind: str, lines: dict[str, str], console: Console) -> None:
    console.print_json({"schema": 1, kind: lines})
    width = max((len(n) for n in lines), default=0)
    for name, text in lines.items() if not console.json else ():
        typer.echo(f"{name:<{width}}  {text}")


def workbench(
    *,
    source: Annotated[
        str | None,
        typer.Argument(
            metavar="STUDY|MODEL|RECORDING",
            help="A study, a shipped model, a card, an FMU or a recording; default vsc-hvdc-link.",
            show_default=False,
        ),
    ] = None,
    port: Annotated[
        int, typer.Option("--port", metavar="N", help="Port to listen at; 0 is any that is free.", min=0, max=65535)
    ] = 0,
    host: Annotated[str, option("--host", "NAME", "Address to listen at.", show_default=True)] = "127.0.0.1",
    quiet_browser: Annotated[bool, typer.Option("--no-open", help="Print the address, and open no browser.")] = False,
    trust: Annotated[bool, typer.Option("--trust", help="Run the code of a model that is a Python file.")] = False,
) -> None:
    """Open the workbench in the browser, where a model answers while a slider moves. Ctrl-C ends it."""
    from hvdc_ident.app import serve

    def ready(address: str) -> None:
        echo(f"workbench: {address}\nCtrl-C ends it.")
        if not quiet_browser:
            open_address(address)

    serve(source, host=host, port=port, trust=trust, ready=ready)


_COMMANDS: dict[str, Callable[..., None]] = {
    "demo": run_commands.demo,
    "new": new,
    "check": check,
    "run": run_commands.run,
    **{stage.name: run_commands.stage_command(stage) for stage in stages()},
    "app": workbench,
    "letter": letter,
    "report": report,
    "compare": compare,
    "export": export,
    "convert": convert,
    "models": models,
    "effects": effects,
    "formats": formats,
}
for _name, _function in _COMMANDS.items():
    app.command(_name)(command(_function))


def main() -> None:
    """Run the command line and end the process with the command's exit code."""
    # The matrices are narrow: threads of the linear algebra would cost more than they save. Workers inherit this.
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    app(obj=OWN_PROCESS)
