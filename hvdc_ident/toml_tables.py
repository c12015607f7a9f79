"""Tables of TOML files as classes: type, meaning, unit, example and default of a key stand in one place.

Readers validate with them; the JSON Schemas, the reference, and the keys that messages suggest are made of them. This module
imports pydantic: it is imported where a file is read, not with the package.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, ClassVar, TypeVar

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    StringConstraints,
    ValidationError,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, PydanticCustomError, PydanticUndefined, core_schema

from hvdc_ident.errors import InputError, UnknownNameError, nearest, require_known

Name = Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$")]

NotNegative = Annotated[FiniteFloat, Field(ge=0)]


def key(
    text: str,
    example: str,
    unit: str = "",
    *,
    default: Any = PydanticUndefined,
    alias: str | None = None,
    of: str = "",
) -> Any:
    """Return the field of a key that has to be given: its meaning, an example as TOML, its unit.

    of: the kind of names that the key holds, for `check_names`.
    """
    extra: dict[str, Any] = {k: v for k, v in (("unit", unit), ("of", of)) if v}
    return Field(default, alias=alias, description=text, examples=[example], json_schema_extra=extra or None)


def optional(text: str, example: str, unit: str = "", *, default: Any = None, **more: Any) -> Any:
    """Return the field of a key that may be left out. more: as of `key`."""
    return key(text, example, unit, default=default, **more)


class TomlTable(BaseModel):
    """A table: an unknown key, a text for a number and a number that is not finite are refused."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, populate_by_name=False, protected_namespaces=())
    ELSEWHERE: ClassVar[Mapping[str, str]] = {}
    """Words of other programs for a key of this table: what to try in their place."""

    @model_validator(mode="before")
    @classmethod
    def _keys(cls, table: Any) -> Any:
        """Refuse a key that is not known, then the lack of one that has to be given."""
        known = keys_of(cls)
        if not isinstance(table, dict):
            raise wrong(f"a table: {{{next(iter(known))} = ...}}")
        for name in table:
            if name not in known:
                context = {"key": str(name), "known": list(known), "hint": cls.ELSEWHERE.get(str(name), "")}
                raise PydanticCustomError("unknown_key", "unknown key", context)
        for name, field in known.items():
            if field.is_required() and name not in table:
                raise PydanticCustomError(
                    "missing_key", "missing", {"key": name, "example": (field.examples or [""])[0]}
                )
        return table


def keys_of(table: type[BaseModel]) -> dict[str, FieldInfo]:
    """Return the fields of a table by their keys in the file."""
    return {field.alias or name: field for name, field in table.model_fields.items()}


def wrong(expected: str, what: str = "a value of the wrong kind", hint: str = "") -> PydanticCustomError:
    """Return the error of a validator for a value: `validated` adds the place and the value."""
    return PydanticCustomError("wrong", "wrong", {"what": what, "expected": expected, "hint": hint})


# --- names ---


def check_names(table: TomlTable, known: Mapping[str, Collection[str]], place: str) -> None:
    """Raise UnknownNameError for the first name in a table, or in one inside it, that is not known.

    known: by kind of names, as keys state it by `of`; names of a kind that is not listed are left alone. place: what stands
    before a key.
    """
    for name, field in type(table).model_fields.items():
        value, inner = getattr(table, name), f"{place}{field.alias or name}"
        extra = field.json_schema_extra
        kind = extra.get("of") if isinstance(extra, dict) else None
        if isinstance(kind, str) and kind in known:
            require_known(kind, [value] if isinstance(value, str) else value, known[kind], inner)
        for number, item in enumerate(value if isinstance(value, list) else [value], start=1):
            if isinstance(item, TomlTable):
                called = f" '{item.name}'" if hasattr(item, "name") else f" number {number}"
                check_names(item, known, f"{inner}{called if isinstance(value, list) else ''}.")


THE_TABLE = {"$comment": "the table itself"}
"""In the JSON Schema of `ByName`: the table of names itself, whose place only the schema of the whole file tells."""


@dataclass(frozen=True)
class ByName:
    """Marks a table of items by name, in which TOML nests the names of components: `gen.H` is H in a table gen.

    own: keys by which a table is an item. tables: whether items are tables, so that one that holds anything but tables is an
    item too.
    """

    own: tuple[str, ...] = ()
    tables: bool = False

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        flat = partial(with_dots, own=self.own, tables=self.tables)
        return core_schema.no_info_before_validator_function(flat, handler(source))

    def __get_pydantic_json_schema__(self, inner: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        schema = handler(inner)
        nested: dict[str, Any] = {"type": "object", "minProperties": 1}
        if self.own:
            nested["not"] = {"anyOf": [{"required": [k]} for k in self.own]}
        if self.tables:
            nested["additionalProperties"] = {"type": "object"}
        (pattern, item), *_ = schema["patternProperties"].items()
        return {**schema, "patternProperties": {pattern: {"if": nested, "then": THE_TABLE, "else": item}}}


def with_dots(value: Any, own: Sequence[str] = (), tables: bool = False) -> Any:
    """Return a table with one key for each item, where it nests the names of components; anything else as it is."""
    if not isinstance(value, dict):
        return value
    flat: dict[Any, Any] = {}
    for name, item in value.items():
        inner = with_dots(item, own, tables)
        nests = isinstance(inner, dict) and bool(inner) and not any(k in inner for k in own)
        if nests and not (tables and not all(isinstance(v, dict) for v in inner.values())):
            flat |= {f"{name}.{n}": v for n, v in inner.items()}
        else:
            flat[name] = item
    return flat


# --- reading ---


def decoded(content: bytes, what: str, where: str, most: int, error: type[InputError]) -> str:
    """Return the text of a file. Raises an error of the class for more than `most` bytes and for what is no UTF-8."""
    if len(content) > most:
        raise error(f"{what} is too large", where=where, expected=f"at most {most} bytes", got=f"{len(content)}")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as e:
        raise error(f"{what} is not UTF-8 text (byte {e.start + 1})", where=where, hint="save it as UTF-8") from None


def parsed(text: str, what: str, where: str, error: type[InputError], hint: str = "") -> dict[str, Any]:
    """Return the tables of a TOML text. Raises an error of the class that shows the line, once it is not TOML."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as e:
        place = re.search(r"at line (\d+)", str(e))
        line = text.splitlines()[int(place[1]) - 1].strip() if place else ""
        why = f"{str(e)[:1].lower()}{str(e)[1:]}"
        path = re.search(r'"([^"]*\\[^"]*)"', line)
        if path and re.match(r"Invalid hex value|Unescaped|Escaped character is not", str(e)):
            why = f"\\ begins an escape sequence in double quotes: {why}"
            hint = f"'{path[1]}' in single quotes, or \"{path[1].replace(chr(92), '/')}\""
        elif comma := re.search(r"=\s*([+-]?\d+),(\d+)\s*([}#]|$)", line):
            hint = f"a decimal point: {comma[1]}.{comma[2]}"
        elif word := re.search(r"=\s*([^\s\"'#{}\[\],]*[A-Za-z./-][^\s\"'#{}\[\],]*)", line):
            hint = f'text in quotes: "{word[1]}"'
    except RecursionError:
        line, why = "", "nested too deeply"
    except ValueError as e:  # a number of thousands of digits, a date that does not exist
        line, why = "", str(e)
    raise error(f"{what} is not valid TOML: {why}", where=where, expected="TOML", got=line[:80], hint=hint) from None


def require_schema(table: Mapping[str, Any], version: int, what: str, where: str, error: type[InputError]) -> None:
    """Raise an error of the class where a file does not state the version of its format that is read."""
    stated = table.get("schema")
    if stated != version or isinstance(stated, bool | float):
        raise error(
            f"the schema of {what} is not known",
            where=where,
            expected=f"schema = {version}",
            got="nothing" if stated is None else shown(stated),
            hint=f"schema = {version} in the first line, or the version of hvdc_ident that the file was written for",
        )


Table = TypeVar("Table", bound=TomlTable)

EXPECTED = {
    "string_type": "text in quotes",
    "float_type": "a number",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "list_type": "a list: [...]",
    "dict_type": "a table: {{name = ...}}",
    "finite_number": "a finite number",
    "greater_than": "a number above {gt:g}",
    "greater_than_equal": "a number of at least {ge:g}",
    "less_than_equal": "a number of at most {le:g}",
    "literal_error": "one of {expected}",
    "too_short": "{min_length} or more entries",
    "too_long": "{max_length} entries or fewer",
    "string_too_short": "a name",
    "string_too_long": "at most {max_length} characters",
}
"""Words for what was expected, by pydantic's kind of error and with its numbers."""


def validated(kind: type[Table], table: dict[str, Any], where: str, error: type[InputError]) -> Table:
    """Return the table of a file as its class. Raises an error of the class given, or UnknownNameError, of the first problem.

    An unknown key is told before a missing one, which it explains, and that before a wrong value. where: what comes before
    the place in the file; "" for nothing.
    """
    try:
        return kind.model_validate(table)
    except ValidationError as e:
        order = {"unknown_key": 0, "missing_key": 1}
        problem: Any = min(e.errors(include_url=False), key=lambda p: order.get(p["type"], 2))
    loc = [part for part in problem["loc"] if not _is_branch(part)]
    what, expected, got, hint = _told(problem)
    inner, _, rest = what.partition(": ")
    if problem["type"] == "value_error" and rest and inner.replace("-", "_").isidentifier():
        what, loc = rest, loc if loc and inner == loc[-1] else [*loc, inner]
    place = ", ".join(filter(None, (where, _place(loc, table))))
    kind_of_error = UnknownNameError if problem["type"] == "unknown_key" else error
    raise kind_of_error(what, where=place, expected=expected, got=got, hint=hint) from None


def _told(problem: Mapping[str, Any]) -> tuple[str, str, str, str]:
    """Return what is wrong, what was expected, what was found and what to try."""
    kind, got, ctx = problem["type"], problem["input"], problem.get("ctx") or {}
    if kind == "unknown_key":
        near = nearest(ctx["key"], ctx["known"])
        meant = f"did you mean {' or '.join(repr(n) for n in near)}?" if near else ""
        return f"unknown key '{ctx['key']}'", f"one of {', '.join(ctx['known'])}", "", ctx["hint"] or meant
    if kind == "missing_key":
        return f"'{ctx['key']}' is missing", ctx["example"], "", ""
    if kind == "value_error":
        text, _, hint = str(ctx["error"]).partition(". Try: ")
        return text, "", "", hint
    if kind == "wrong":
        return ctx["what"], ctx["expected"], shown(got), ctx["hint"]
    what = "a value of the wrong kind" if kind.endswith("_type") else "a value that does not fit"
    expected, hint = EXPECTED.get(kind, kind.replace("_", " ")).format(**ctx), ""
    if kind == "literal_error":
        expected = expected.replace(" or ", ", ")
    if kind == "float_type" and hasattr(got, "isoformat"):  # a date or time of day of TOML
        hint = "a time in s, as the time in the data counts"
    if kind == "string_pattern_mismatch":
        is_file = "\\w" in ctx["pattern"]
        expected = "letters, digits, blanks and - + . _ only, for files are named after it"
        expected = expected if is_file else "a name without control characters"
        if not is_file and re.search(r"[\t\n\r\f\b]", got):
            hint = "a path in single quotes or with /: in double quotes \\t is a tab and \\n a line break"
    return what, expected, shown(got), hint


def _is_branch(part: int | str) -> bool:
    """Return whether a part of pydantic's place is the name of a union's branch, not a key."""
    return isinstance(part, str) and part.startswith(("literal[", "dict[", "list[", "constrained-", "function-"))


def _place(loc: Sequence[int | str], table: Any) -> str:
    """Return a place in the words of the file: `experiment 'step-up'.window`."""
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


def shown(value: Any) -> str:
    """Return a value as a TOML file writes it, cut where it is long."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, Mapping):
        return "a table"
    text = json.dumps(value, ensure_ascii=False) if isinstance(value, str) else str(value)
    return text if len(text) <= 60 else text[:57] + "..."
