"""A study file's text as checked tables, or one message that says which line of it is wrong and how."""

from __future__ import annotations

import math
import shlex
import tomllib
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from hvdc_ident.errors import InputError, StudyError, nearest
from hvdc_ident.formats import formats, list_signals
from hvdc_ident.study.schema import StudyFile

LARGEST = 1_000_000  # bytes; a study of a thousand experiments has a third of it

EXPECTED = {
    "missing": "this key",
    "string_type": "text in quotes",
    "float_type": "a number",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "list_type": "a list: [...]",
    "dict_type": "a table: {name = ...}",
    "model_type": "a table",
    "model_attributes_type": "a table",
    "finite_number": "a finite number",
}


def is_study_file(path: Path) -> bool:
    """Return whether a file is a study and no model card: TOML with a table [model]."""
    try:
        return isinstance(_toml(path.read_bytes(), path.name).get("model"), dict)
    except (OSError, StudyError):
        return False


def parse_study(content: bytes, path: Path) -> StudyFile:
    """The study file's tables. Raises StudyError: not text or TOML, another schema, a key or value that is wrong."""
    where = path.name
    try:
        table = _toml(content, where)
    except StudyError:
        _refuse_other_kinds(path)
        raise
    if "schema" not in table:
        raise StudyError(
            "the study does not state its schema",
            where=where,
            expected="schema = 1 in the first line",
            got="no key schema",
            hint="`hvdc-ident new DIR` writes a commented study",
        )
    if table["schema"] != 1 or isinstance(table["schema"], bool):
        raise StudyError(
            "this version of hvdc_ident does not read this schema",
            where=f"{where}, schema",
            expected="1",
            got=_shown(table["schema"]),
            hint="schema = 1, or the version of hvdc_ident that the file was written for",
        )
    return checked(table, where)


def checked(table: dict[str, Any], where: str) -> StudyFile:
    """Return a study's tables, checked. Raises StudyError for a key or a value that is wrong."""
    try:
        return StudyFile.model_validate(table)
    except ValidationError as e:
        raise _first(e, table, where) from None


def _refuse_other_kinds(path: Path) -> None:
    """Raise StudyError for an FMU and for a file of waveforms; a *.txt is one where its signals can be listed."""
    ending, typed = path.suffix.lower(), shlex.quote(str(path))
    if ending == ".fmu":
        what, hint = "an FMU", f"`hvdc-ident check {typed}` lists its variables; a study names it in [model] source"
    elif any(ending in f.SUFFIXES for f in formats().values()) and (ending != ".txt" or _lists_signals(path)):
        convert = f"`hvdc-ident convert {typed} --list ''` lists its signals"
        made = f"`hvdc-ident new DIR --from {typed} --model MODEL` writes a study of it"
        what, hint = "a file of waveforms", f"{convert}; {made}"
    else:
        return
    raise StudyError(
        f"this is {what}, not a study", where=path.name, expected="a study file (TOML)", got=f"'{ending}'", hint=hint
    )


def _lists_signals(path: Path) -> bool:
    try:
        return bool(list_signals(path))
    except InputError:
        return False


def _toml(content: bytes, where: str) -> dict[str, Any]:
    if len(content) > LARGEST:
        raise StudyError(
            "the study file is too large", where=where, expected=f"at most {LARGEST} bytes", got=str(len(content))
        )
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as e:
        hint = "save it as UTF-8 text"
        raise StudyError(f"the study file is not UTF-8 text (byte {e.start})", where=where, hint=hint) from None
    try:
        return tomllib.loads(text.replace("\r\n", "\n"))
    except tomllib.TOMLDecodeError as e:
        what = str(e)
        raise StudyError(
            f"not valid TOML: {what[:1].lower()}{what[1:]}",
            where=where,
            expected="a study file (TOML)",
            hint="mend this line; `hvdc-ident new DIR` writes a study to compare it with",
        ) from None
    except RecursionError:
        raise StudyError("not valid TOML: brackets nested too deeply", where=where) from None
    except ValueError as e:  # a number of thousands of digits, a date that does not exist
        raise StudyError(f"not valid TOML: {e}", where=where) from None


def _first(error: ValidationError, table: dict[str, Any], where: str) -> StudyError:
    """The problem to tell first: an unknown key explains a missing one."""
    problems = error.errors(include_url=False)
    order = {"extra_forbidden": 0, "missing": 1}
    problem = min(problems, key=lambda p: order.get(p["type"], 2))
    kind, loc = problem["type"], [part for part in problem["loc"] if not _is_branch(part)]
    place = f"{where}, {_place(loc, table)}" if loc else where
    if kind == "extra_forbidden":
        return _unknown_key(str(loc[-1]), tuple(loc[:-1]), table, where)
    if kind == "missing":
        outer = _place(loc[:-1], table)
        return StudyError(
            f"'{loc[-1]}' is missing", where=f"{where}, {outer}" if outer else where, expected=_describe_key(loc)
        )
    got = _shown(problem["input"])
    if kind in EXPECTED:
        what = "a value that does not fit" if kind == "finite_number" else "a value of the wrong kind"
        return StudyError(what, where=place, expected=EXPECTED[kind], got=got)
    if kind == "value_error":
        text, _, hint = str(problem["ctx"]["error"]).partition(". Try: ")
        key, _, rest = text.partition(": ")
        if rest and key.isidentifier() and key != loc[-1]:
            return StudyError(rest, where=f"{place}.{key}" if loc else f"{where}, {key}", hint=hint)
        return StudyError(rest if key == loc[-1] else text, where=place, hint=hint)
    expected, got = _wanted(kind, problem.get("ctx", {}), got)
    return StudyError("a value that does not fit", where=place, expected=expected, got=got)


def _wanted(kind: str, ctx: dict[str, Any], got: str) -> tuple[str, str]:
    match kind:
        case "literal_error":
            return f"one of {ctx['expected']}".replace(" or ", ", "), got
        case "greater_than":
            return f"a number above {ctx['gt']:g}", got
        case "greater_than_equal":
            return f"a number of at least {ctx['ge']:g}", got
        case "less_than_equal":
            return f"a number of at most {ctx['le']:g}", got
        case "too_short":
            return f"at least {ctx['min_length']} entries" if ctx["min_length"] > 1 else "at least one entry", got
        case "too_long":
            return f"{ctx['max_length']} entries", got
        case "string_too_short":
            return "a name", "an empty text"
        case "string_too_long":
            return f"at most {ctx['max_length']} characters", got
        case "string_pattern_mismatch" if "\\w" in ctx["pattern"]:
            return "letters, digits, blanks and - + . _ only, for files are named after it", got
        case "string_pattern_mismatch":
            return "a name without control characters", got
    return kind.replace("_", " "), got


def _is_branch(part: int | str) -> bool:
    """Return whether a part of pydantic's place is the name of a union's branch, not a key."""
    return isinstance(part, str) and (part.startswith(("literal[", "dict[", "list[", "constrained-", "function-")))


def _place(loc: typing.Sequence[int | str], table: Any) -> str:
    """`experiment 'step-up'.window`: the place in the words of the file."""
    text, inner = "", table
    for part in loc:
        if isinstance(inner, dict):
            inner = inner.get(part)
        else:
            inner = inner[part] if isinstance(inner, list) and isinstance(part, int) and part < len(inner) else None
        if isinstance(part, int):
            name = inner.get("name") if isinstance(inner, dict) else None
            text += f" '{name}'" if isinstance(name, str) else f" number {part + 1}"
        elif part != "[key]":
            text += f".{part}" if text else str(part)
    return text


def _unknown_key(key: str, outer: tuple[int | str, ...], table: dict[str, Any], where: str) -> StudyError:
    kind = _table_at(outer)
    known = [field.alias or name for name, field in kind.model_fields.items()] if kind else []
    near = nearest(key, known)
    hint = f"did you mean {' or '.join(repr(n) for n in near)}?" if near else ""
    place = _place(outer, table)
    full = f"{where}, {place}" if place else where
    return StudyError(
        f"unknown key '{key}'",
        where=full,
        expected=f"one of {', '.join(known)}" if known else "no keys at all",
        hint=hint,
    )


def _describe_key(loc: typing.Sequence[int | str]) -> str:
    examples = {
        "source": 'source = "vsc-hvdc-link", or a path',
        "model": '[model] with source = "..."',
        "data": 'data = "file.csv"',
        "name": 'name = "..."',
    }
    key = str(loc[-1])
    return examples.get(key, f"{key} = ...")


def _table_at(outer: tuple[int | str, ...]) -> type[BaseModel] | None:
    """The table type at a place, found by walking the types of the schema."""
    kind: Any = StudyFile
    for part in outer:
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            field = next((f for n, f in kind.model_fields.items() if part in (n, f.alias)), None)
            kind = field.annotation if field else None
        else:
            inner = [a for a in typing.get_args(kind) if a is not str]
            kind = inner[-1] if inner else None
        if typing.get_origin(kind) in (types.UnionType, typing.Union):
            members = [a for a in typing.get_args(kind) if a is not type(None)]
            kind = members[-1] if members else None
    return kind if isinstance(kind, type) and issubclass(kind, BaseModel) else None


def _shown(value: Any) -> str:
    """A value as the study file would write it, cut where it is long."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, Mapping):
        return "a table"
    text = f'"{value}"' if isinstance(value, str) else str(value)
    return text if len(text) <= 60 else text[:57] + "..."
