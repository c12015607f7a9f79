"""What each command prints, with its exit code: of a study that runs, and of inputs that are wrong."""

from __future__ import annotations

import shutil
from collections.abc import Sequence

from runs import Item, Setting, command, settled

CATALOGUES = (("--version",), ("--help",), ("models",), ("effects",), ("formats",), *(
    (name, "--help") for name in (
        "demo", "new", "check", "run", "simulate", "sweep", "screen", "identify", "fit", "linearize", "diagnose", "app",
        "letter", "report", "compare", "export", "convert", "models", "effects", "formats",
    )
))  # fmt: skip
STUDY = "s/study.toml"
NEW = (("new", "s"),)
TRIED = '\n[diagnose]\neffects = ["lag", "delay", "gain", "limit"]\n'
"""Few effects, so that the diagnosis takes seconds."""
STAGES = (
    ("check", STUDY),
    *((stage, STUDY) for stage in ("simulate", "linearize", "identify", "fit", "diagnose", "run", "letter", "report")),
    *(("export", STUDY, "--to", f"link.{end}") for end in ("toml", "fmu", "mo", "mat", "json", "csv", "m", "tex")),
    ("export", STUDY, "--to", "given.toml", "--values", "given"),
    ("convert", "s/step-up.csv", "--to", "copy.csv"),
    ("check", "link.fmu"),
    ("fit", STUDY, "--json", "--out", "other"),
    ("compare", "s/study-results", "other"),
)
WRONG = (
    ("new", "s"),
    ("check", "absent.toml"),
    ("run", "s/ramp.csv"),
    ("sweep", STUDY),
    ("fit", STUDY, "--force", "KIVCD"),
    ("diagnose", STUDY, "--budget", "-3"),
    ("export", STUDY, "--to", "link.xyz"),
    ("export", STUDY, "--to", "link.fmu", "--values", "fited"),
    ("letter", STUDY),
    ("report", "s/study-results"),
    ("compare", "s", "absent"),
    ("convert", "s/study.toml", "--to", "copy.csv"),
    ("simulte", STUDY),
)


def _catalogues(setting: Setting) -> str:
    return _transcript(CATALOGUES, setting)


def _stages(setting: Setting) -> str:
    """Return the transcript of a new study with a short diagnosis, through every command."""
    _fresh(setting)
    begun = _transcript(NEW, setting)
    with (setting.folder / STUDY).open("a", encoding="utf-8") as stream:
        stream.write(TRIED)
    return "\n".join([begun, _transcript(STAGES, setting)])


def _wrong(setting: Setting) -> str:
    _fresh(setting)
    return "\n".join([_transcript(NEW, setting), _transcript(WRONG, setting)])


def _fresh(setting: Setting) -> None:
    shutil.rmtree(setting.folder)
    setting.folder.mkdir()


def _transcript(commands: Sequence[Sequence[str]], setting: Setting) -> str:
    """Return commands, output and exit codes, run one after the other in the setting's folder."""
    parts = []
    for arguments in commands:
        code, said, errors = command(*arguments, cwd=setting.folder)
        if "--json" in arguments:
            said = f"{len(said.splitlines())} lines\n" if said.startswith("{") else said
        told = settled("".join(f"{t.rstrip()}\n" for t in (said, errors) if t.strip()), [setting.folder])
        parts.append(f"$ hvdc-ident {' '.join(arguments)}\n{told}[{code}]\n")
    return "\n".join(parts)


ITEMS = (
    Item("catalogues", _catalogues, suffix=".txt"),
    Item("stages", _stages, suffix=".txt"),
    Item("wrong-inputs", _wrong, suffix=".txt"),
)
