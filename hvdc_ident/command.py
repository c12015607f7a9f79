"""Groups of options as dataclasses, and the end of a command: all that the commands share.

A command is a function of keyword arguments; an argument whose type is one of the groups stands for the group's options.
"""

from __future__ import annotations

import functools
import inspect
import math
import os
import shutil
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, get_type_hints

import typer

from hvdc_ident.budget import Budget, BudgetSpent
from hvdc_ident.errors import HvdcIdentError, InputError, one_line
from hvdc_ident.executor import Progress, progress_bar
from hvdc_ident.study.stages import StageOptions

if TYPE_CHECKING:
    from hvdc_ident.study.export import FmuOptions
    from hvdc_ident.study.study import Study


def _number(option: str, unit: str, example: str, low: float, high: float = math.inf, *, whole: bool = False) -> Any:
    """Return the parser of an option's number within bounds; its message ends with an example to try."""
    expected = f"{'a whole number' if whole else unit} from {low:g} to {high:.0f}" if high < math.inf else unit

    def number(text: Any) -> float:
        try:
            value = int(text) if whole else float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise typer.BadParameter(f"expected {expected}, got {str(text)!r}. Try: {option} {example}")
        return value

    return number


def option(flag: str, metavar: str, text: str, **settings: Any) -> Any:
    return typer.Option(flag, metavar=metavar, help=text, **{"show_default": False, **settings})


def _limit(flag: str, metavar: str, unit: str, example: str, text: str) -> Any:
    """Return an option that takes a number above 0."""
    return option(flag, metavar, text, parser=_number(flag, f"{unit} above 0", example, 1e-9))


def echo(text: str, *, err: bool = False) -> None:
    """Print text for people: folded at words to the width of a terminal, as it is where it goes elsewhere."""
    from hvdc_ident.text import folded

    stream = sys.stderr if err else sys.stdout
    typer.echo(folded(text, shutil.get_terminal_size().columns) if stream.isatty() else text, err=err)


def open_page(page: Path) -> None:
    """Open a page in the browser; where there is none, say on stderr where the page is."""
    open_address(page.resolve().as_uri())


def open_address(address: str) -> None:
    """Open an address in the browser; where there is none, say so on stderr."""
    import webbrowser

    try:
        if webbrowser.get().open(address):
            return
        why = "the browser did not open the page"
    except webbrowser.Error:
        why = "no browser was found on this machine"
    echo(f"--open: {why}. Try: {address} in a browser", err=True)


StudyFile = Annotated[Path, typer.Argument(metavar="STUDY", help="The study file (TOML).", show_default=False)]
Out = Annotated[Path | None, option("--out", "DIR", "Folder for results; default STUDY-results.")]
Open = Annotated[bool, typer.Option("--open", help="Open the page in the browser.")]


OWN_PROCESS = "own process"
"""Object of the context of a command line that has a process for itself."""


def _budget(text: Any) -> Budget:
    """Return a budget that begins now."""
    return Budget.of(_number("--budget", "seconds, at least 0.001", "600", 0.001)(text))


WithinBudget = Annotated[
    Budget | None,
    option(
        "--budget",
        "SECONDS",
        "End after so long with what is known by then, and with what was not tried. What was finished is kept, and the same command "
        "goes on.",
        parser=_budget,
    ),
]
Seed = Annotated[
    int,
    option(
        "--seed",
        "N",
        "Seed of every random number, below 2^31.",
        show_default=True,
        parser=_number("--seed", "", "0", 0, 2**31 - 1, whole=True),
    ),
]


@dataclass(frozen=True)
class Console:
    """The command's output: text on stdout, or JSON there and nothing else; progress goes to stderr."""

    json: Annotated[bool, typer.Option("--json", help="Print the result's JSON on stdout and nothing else.")] = False
    quiet: Annotated[bool, typer.Option("--quiet", help="Print errors only.")] = False

    def say(self, *lines: str) -> None:
        """Print lines for people, unless stdout is asked to hold JSON or to stay empty."""
        for line in () if self.json or self.quiet else lines:
            echo(line)

    def announce(self, lines: Sequence[str]) -> None:
        """Print what to know before the work begins: on stderr where stdout is asked to hold JSON."""
        for line in () if self.quiet else lines:
            echo(line, err=self.json)

    def print_json(self, value: Any) -> None:
        """Print JSON where it is asked for."""
        from hvdc_ident.files import json_pieces

        for piece in json_pieces(value) if self.json else ():
            typer.echo(piece, nl=False)

    def progress(self) -> AbstractContextManager[Progress]:
        """Return the progress bar, as a context."""
        return progress_bar(self.quiet or self.json)


@dataclass(frozen=True)
class PsseUnit:
    """Options that name a unit of PSS/E's files."""

    dyr: Annotated[Path | None, option("--dyr", "FILE", "PSS/E's dynamic data; with --bus and --from.")] = None
    bus: Annotated[int | None, option("--bus", "N", "With --dyr: the unit's bus.")] = None
    machine: Annotated[str | None, option("--machine", "ID", "With --dyr: the machine, where the bus has several.")] = (
        None
    )
    raw: Annotated[
        Path | None, option("--raw", "FILE", "With --dyr: PSS/E's power flow, which has the machine's base.")
    ] = None
    base: Annotated[
        float | None,
        option(
            "--base",
            "MVA",
            "With --dyr: the machine's base, in place of the power flow's.",
            parser=_number("--base", "MVA", "250", 0, 1e9),
        ),
    ] = None
    frequency: Annotated[
        float | None,
        option(
            "--frequency",
            "HZ",
            "With --dyr: the nominal frequency, in place of what --raw or the recordings show.",
            parser=_number("--frequency", "Hz", "60", 0, 1e4),
        ),
    ] = None


@dataclass(frozen=True)
class Work:
    """Options of the stages' work."""

    workers: Annotated[
        int | None,
        option(
            "--workers",
            "N",
            "Processes to work with, at most 4096; default one for each core, once the work has taken longer than their start.",
            parser=_number("--workers", "", "2", 1, 4096, whole=True),
        ),
    ] = None
    executor: Annotated[str, option("--executor", "WHERE", "local, or dask://HOST:PORT: where the work is done.")] = ""
    seed: Seed = 0

    def options(self, console: Console, progress: Progress, budget: Budget | None = None) -> StageOptions:
        """Return the stages' options. Raises InputError for an executor of an unknown name."""
        from hvdc_ident.study.executors import check_executor

        check_executor(self.executor)
        told = console.announce
        return StageOptions(self.workers, self.seed, progress, executor=self.executor, budget=budget, announce=told)


@dataclass(frozen=True)
class FitWork(Work):
    """Options of the fit's work, and what is fitted against the verdicts."""

    force: Annotated[
        list[str] | None,
        typer.Option("--force", metavar="NAME", help="Fit this candidate whatever the verdict on it; may be repeated."),
    ] = None

    def options(self, console: Console, progress: Progress, budget: Budget | None = None) -> StageOptions:
        """Return the stages' options."""
        return replace(super().options(console, progress, budget), force=tuple(dict.fromkeys(self.force or ())))


@dataclass(frozen=True)
class Access:
    """Options of loading the study's model: whether its code may run, and the limits of an FMU."""

    trust: Annotated[bool, typer.Option("--trust", help="Run the code of a model that is a Python file.")] = False
    deadline: Annotated[
        float | None,
        _limit("--deadline", "S", "seconds", "300", "Seconds that one run of an FMU may take; default 60."),
    ] = None
    load: Annotated[
        float | None, _limit("--load", "S", "seconds", "300", "Seconds that an FMU may take to begin; default 60.")
    ] = None
    memory: Annotated[
        float | None, _limit("--memory", "MIB", "MiB", "4096", "MiB of memory that an FMU may take; default 2048.")
    ] = None

    @property
    def limits(self) -> dict[str, float]:
        """The limits of an FMU that are given, by the keys of a study."""
        stated = {"deadline": self.deadline, "load": self.load, "memory": self.memory}
        return {name: value for name, value in stated.items() if value is not None}

    def study(self, path: Path) -> Study:
        """Return the study of a file."""
        from hvdc_ident.study.study import load_study

        return load_study(path, self.trust, self.limits)

    @property
    def typed(self) -> list[str]:
        """The options that were given, as they are typed."""
        limits = [part for name, value in self.limits.items() for part in (f"--{name}", f"{value:g}")]
        return [*(("--trust",) if self.trust else ()), *limits]


@dataclass(frozen=True)
class FmuFormat:
    """The kind of FMU that is written."""

    fmi: Annotated[str | None, option("--fmi", "2|3", "Version of an FMU; default 2.")] = None
    kind: Annotated[str | None, option("--kind", "me|cs", "One kind of FMU; default both.")] = None
    source_only: Annotated[bool, typer.Option("--source-only", help="An FMU of sources, without a binary.")] = False

    def options(self) -> FmuOptions | None:
        """Return the options of the export; None where none is given."""
        from hvdc_ident.study.export import fmu_options

        return fmu_options(self.fmi, self.kind, self.source_only)


class CommandFailed(Exception):
    """The work ran and failed; what it found is written."""


def command(function: Callable[..., None]) -> Callable[..., None]:
    """Return the function with its groups as options, and every exception as one message and an exit code."""
    parameters: list[inspect.Parameter] = []
    groups: dict[str, Any] = {}
    hints = get_type_hints(function, include_extras=True)
    for parameter in inspect.signature(function).parameters.values():
        kind = hints[parameter.name]
        if not is_dataclass(kind):
            parameters.append(parameter.replace(annotation=kind, kind=inspect.Parameter.KEYWORD_ONLY))
            continue
        groups[parameter.name] = kind
        members = get_type_hints(kind, globals(), include_extras=True)
        parameters += [
            inspect.Parameter(f.name, inspect.Parameter.KEYWORD_ONLY, default=f.default, annotation=members[f.name])
            for f in fields(kind)
        ]

    parameters.append(inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context))

    @functools.wraps(function)
    def run(context: typer.Context, **given: Any) -> None:
        if given.get("budget") is not None and context.find_root().obj == OWN_PROCESS:
            given["budget"] = Budget.of_process(given["budget"].seconds)
        made = {n: kind(**{f.name: given.pop(f.name) for f in fields(kind)}) for n, kind in groups.items()}
        given |= made

        def end(code: int, message: str) -> NoReturn:
            text = pasteable(message, given.get("study"), given.get("out"), given.get("access"))
            echo(f"{'interrupted' if code == 130 else 'error'}: {text}", err=True)
            raise typer.Exit(code)

        try:
            function(**given)
            sys.stdout.flush()
        except typer.Exit:
            raise
        except HvdcIdentError as e:
            end(2 if isinstance(e, InputError) else 1, str(e.read_in("shell")))
        except CommandFailed as e:
            end(1, str(e))
        except BudgetSpent as e:
            end(1, f"{e}; what was finished is kept, and the same command goes on from there")
        except KeyboardInterrupt:
            end(130, "what was finished is kept, and the same command goes on from there")
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(1) from None
        except MemoryError:
            end(1, "not enough memory for this study")
        except ImportError as e:
            end(
                1,
                f"the installation is incomplete: {one_line(e, 300)}. Try: `pip install --force-reinstall hvdc_ident`",
            )
        except Exception as e:
            if os.environ.get("HVDC_IDENT_DEBUG") == "1":
                traceback.print_exc()
            what = one_line(e, 300)
            report = "HVDC_IDENT_DEBUG=1 shows where, for a report"
            end(1, f"a bug in hvdc-ident, not in your study: {what}. Try: {report}")

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    del run.__wrapped__
    return run


def pasteable(text: str, study: Path | None, out: Path | None, access: Access | None) -> str:
    """Return the text with the commands in it as they are to be typed here, by the options of the command that says it."""
    from hvdc_ident.text import with_study

    options = [*(("--out", str(out)) if out else ()), *(access.typed if access else ())]
    return text if study is None else with_study(text, str(study), *options)
