"""What to do next, as a value: results carry it, and each view says it in the words of the place where it is read."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

Door = Literal["shell", "python", "page"]
"""Places where a sentence is read: each has its own name for a thing to do."""
NextKind = Literal[
    "diagnose",
    "separate",
    "letter",
    "narrow",
    "export",
    "identify",
    "fit",
    "force",
    "given",
    "raise-noise",
    "lower-noise",
    "values",
    "folder",
    "run",
    "new",
    "new-from",
    "new-unit",
    "signals",
    "variables",
    "find",
    "compile",
    "check",
    "option",
]
TO_DO: dict[str, dict[Door, str]] = {
    "diagnose": {"shell": "`hvdc-ident diagnose STUDY`", "python": "`hi.diagnose(...)`", "page": "the stage diagnose"},
    "identify": {"shell": "`hvdc-ident identify STUDY`", "python": "`hi.identify(...)`", "page": "the stage identify"},
    "fit": {"shell": "`hvdc-ident fit STUDY`", "python": "`values=hi.fit(...)`", "page": "the stage fit"},
    "given": {"shell": "`--values given`", "python": '`values="given"`', "page": "the given values"},
    "values": {"shell": "`--values {}`", "python": '`values="{}"`', "page": "the values “{}”"},
    "force": {"shell": "`--force NAME`", "python": '`force=["NAME"]`', "page": "a fit with `--force NAME`"},
    "letter": {"shell": "`hvdc-ident letter STUDY`", "python": "`hvdc-ident letter`", "page": "the button Letter"},
    "export": {
        "shell": "`hvdc-ident export STUDY --to FILE`",
        "python": "`hi.export(...)`",
        "page": "a button below Take away",
    },
    "folder": {"shell": "`--out DIR`", "python": "another folder", "page": "another folder"},
    "run": {"shell": "`hvdc-ident run STUDY`", "python": "`hvdc_ident.study.run_all(...)`", "page": "the tab Run"},
    "new": {
        "shell": "`hvdc-ident new DIR`",
        "python": "`hvdc_ident.study.write_starter(DIR)`",
        "page": "the tab Recording",
    },
    "new-from": {
        "shell": "`hvdc-ident new DIR --from {} --model MODEL`",
        "python": "`hi.new_study(DIR, {!r}, MODEL)`",
        "page": "the tab Recording",
    },
    "new-unit": {
        "shell": "`hvdc-ident new DIR --dyr plant.dyr --bus 101 --from event.csv`",
        "python": "`hvdc-ident new DIR --dyr plant.dyr --bus 101 --from event.csv` in a shell",
        "page": "`hvdc-ident new DIR --dyr plant.dyr --bus 101 --from event.csv` in a shell",
    },
    "signals": {
        "shell": "`hvdc-ident convert {} --list ''`",
        "python": "`hvdc_ident.formats.list_signals({!r})`",
        "page": "the tab Recording",
    },
    "variables": {
        "shell": "`hvdc-ident check {}`",
        "python": "`print(hi.load_model({!r}).capabilities)`",
        "page": "`hvdc-ident check {}` in a shell",
    },
    "find": {
        "shell": "`hvdc-ident check {} --find TEXT`",
        "python": "`print(hi.load_model({!r}).capabilities)`",
        "page": "`hvdc-ident check {} --find TEXT` in a shell",
    },
    "check": {
        "shell": "`hvdc-ident check {}`",
        "python": "`hi.check({!r})`",
        "page": "`hvdc-ident check {}` in a shell",
    },
    "compile": {
        "shell": "`hvdc-ident check {} --compile`",
        "python": "`hvdc_ident.fmu.compile_fmu({!r})`",
        "page": "`hvdc-ident check {} --compile` in a shell",
    },
}
"""By kind, what to do; {} is the text of the step, the path of a file or the name of a set of values."""
PURPOSES = {
    "diagnose": "looks for what the model lacks",
    "identify": "says why of each, and what to measure next",
    "fit": "estimates what the recordings determine",
    "given": "takes those that the model came with",
    "force": "fits one all the same",
    "letter": "writes one page on this for the model's owner",
    "export": "writes the model with the values that count (.fmu, .mo, .toml)",
    "folder": "that can be written to and no other run is at work in",
    "run": "runs the study and keeps its results in STUDY-results",
    "new": "writes a study to start from",
    "new-from": "writes a study of it",
    "new-unit": "writes a study that says so",
    "signals": "lists its signals",
    "variables": "lists its variables; a study names it in [model] source",
    "find": "lists its variables",
    "check": "says what a run would stumble over",
    "compile": "compiles the C sources in it, into a new file",
}
VALUES = {
    "effect": "takes those with the effect",
    "fit": "takes those of the fit without the effect",
    "fitted": "takes the best of them",
}
"""By name of a set of values, what taking it does."""


@dataclass(frozen=True)
class NextStep:
    """Step to take next.

    kind: run the diagnosis; record what tells likely effects apart ("separate"); write the letter to the model's owner; record what
    narrows the intervals; export the values; see why nothing is estimated; fit; fit a parameter against its verdict; take the given
    values; state a larger noise, or a smaller one; take another set of values; take another folder; run the study; write a study to
    start from, one of a recording, one of a unit of PSS/E; list the signals of a recording, the variables of an FMU; compile its
    sources; check a study; give an argument ("option").
    text: of a recording, what to record; of a noise, its standard deviations by output; of values, their name; of a file, its path;
    of an argument, its name and value as `workers = 1`. why: what that argument does.
    """

    kind: NextKind
    text: str = ""
    why: str = field(default="", metadata={"json": "why", "optional": True})


IN_THIS_PROCESS = NextStep("option", "workers = 1", "does the work in this process")
ON_DASK = NextStep("option", 'executor = "dask://HOST:PORT"', "does it where a `dask scheduler` runs")


def next_phrase(step: NextStep, door: Door = "shell") -> str:
    """Return what to do, as a clause."""
    if step.kind == "raise-noise":
        return f"state noise = {{{step.text}}} if the instrument may be as noisy as that"
    if step.kind == "lower-noise":
        return f"state noise = {{{step.text}}}, or leave it out to have it estimated: the intervals are too wide as they are"
    if step.kind == "option":
        return f"`{_option(step.text, door)}` {step.why}"
    told = shlex.quote(step.text) if door == "shell" else step.text
    return (
        f"{TO_DO[step.kind][door].format(told)} {VALUES[step.text] if step.kind == 'values' else PURPOSES[step.kind]}"
    )


def _option(text: str, door: Door) -> str:
    """Return an argument as it is given: `--workers 1` on a command line, `workers=1` in Python, `workers = 1` elsewhere."""
    name, value = text.split(" = ", 1)
    if door == "page":
        return text
    if door == "python":
        return f"{name}={value}"
    flag = f"--{name.replace('_', '-')}"
    return flag if value == "True" else f"{flag} {value.strip(chr(34))}"


def next_sentence(step: NextStep, door: Door = "shell") -> str:
    """Return what to do, as a sentence for a terminal, a notebook or the workbench."""
    if step.kind in ("separate", "narrow"):
        return f"Measure next: {step.text}"
    return f"Next: {next_phrase(step, door)}."


def next_phrases(steps: Iterable[NextStep], door: Door = "shell") -> str:
    """Return several things to try, the first thing first, in one text."""
    return "; else ".join(next_phrase(step, door) for step in steps)
