"""A study file's text as checked tables, or one message that says which line of it is wrong and how."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hvdc_ident.errors import InputError, StudyError
from hvdc_ident.formats import formats, list_signals
from hvdc_ident.next_step import NextStep
from hvdc_ident.study.schema import StudyFile
from hvdc_ident.toml_tables import decoded, parsed, require_schema, validated

FILE_BYTES = 1_000_000  # bytes; a study of a thousand experiments has a third of it


def is_study_file(path: Path) -> bool:
    """Return whether a file is a study and no model card: TOML with a table [model], or what was to be that."""
    try:
        content = path.read_bytes()
        return isinstance(_toml(content, path.name).get("model"), dict)
    except OSError:
        return False
    except StudyError:
        return b"[model" in content


def parse_study(content: bytes, path: Path) -> StudyFile:
    """The study file's tables. Raises StudyError: not text or TOML, another schema, a key or value that is wrong."""
    where = path.name
    try:
        table = _toml(content, where)
    except StudyError:
        _refuse_other_kinds(path)
        raise
    require_schema(table, 1, "the study", where, StudyError)
    return checked(table, where)


def checked(table: dict[str, Any], where: str) -> StudyFile:
    """Return a study's tables, checked. Raises StudyError for a key or a value that is wrong."""
    return validated(StudyFile, table, where, StudyError)


def _refuse_other_kinds(path: Path) -> None:
    """Raise StudyError for an FMU and for a file of waveforms; a *.txt is one where its signals can be listed."""
    ending, steps = path.suffix.lower(), tuple[NextStep, ...]()
    if ending == ".fmu":
        what, steps = "an FMU", (NextStep("variables", str(path)),)
    elif any(ending in f.SUFFIXES for f in formats().values()) and (ending != ".txt" or _lists_signals(path)):
        what, steps = "a file of waveforms", (NextStep("signals", str(path)), NextStep("new-from", str(path)))
    else:
        return
    raise StudyError(
        f"this is {what}, not a study", where=path.name, expected="a study file (TOML)", got=f"'{ending}'", next=steps
    )


def _lists_signals(path: Path) -> bool:
    try:
        return bool(list_signals(path))
    except InputError:
        return False


def _toml(content: bytes, where: str) -> dict[str, Any]:
    text = decoded(content, "the study file", where, FILE_BYTES, StudyError)
    return parsed(text, "the study file", where, StudyError, "mend this line")
