"""Model cards: a model as TOML text, read and written without loss."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Any

import sympy as sp

from hvdc_ident.errors import ExpressionError, InputError, ModelError, require_known, unknown_name
from hvdc_ident.expression import parse, to_text
from hvdc_ident.files import write_text
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model.check import SECTIONS, required_keys
from hvdc_ident.model.check import expression as expression_of
from hvdc_ident.model.components import PARTS, Component, ComponentEntry, Connection, assembled
from hvdc_ident.model.definition import Model, Parameterisation
from hvdc_ident.shelf import card_of, components, is_component

SCHEMA = 1
MAX_BYTES = 5_000_000

_BARE = re.compile(r"[A-Za-z0-9_-]+", re.ASCII)
_TOP = ("schema", "name", "description", "record", "also", *SECTIONS, *PARTS)
_ESCAPES = {"\\": "\\\\", '"': '\\"', "\n": "\\n", "\t": "\\t", "\r": "\\r", "\b": "\\b", "\f": "\\f"}
_SHORT = frozenset(("signals", "outputs"))


def read_card(path: str | Path, inside: tuple[Path, ...] = ()) -> Model:
    """Return the model of a card, a TOML file.

    inside: the cards that this one is a component of, the outermost first.
    Raises ModelError for a file that is missing, over 5 MB, not UTF-8 or not TOML, and ModelError, UnknownNameError
    or ExpressionError with the file and the place in it for what it says.
    """
    path = Path(path)
    try:
        with path.open("rb") as stream:
            content = stream.read(MAX_BYTES + 1)
    except (OSError, ValueError) as e:
        reason = (getattr(e, "strerror", None) or "no usable path").lower()
        raise ModelError(f"the model card cannot be read: {reason}", where=str(path)) from None
    if len(content) > MAX_BYTES:
        raise ModelError("the model card is too large", where=str(path), expected=f"at most {MAX_BYTES} bytes")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as e:
        what = f"the model card is no UTF-8 text (byte {e.start + 1})"
        raise ModelError(what, where=str(path), hint="save it as UTF-8") from None
    return parse_card(text, str(path), (*inside, path))


def parse_card(text: str, where: str = "model card", inside: tuple[Path, ...] = ()) -> Model:
    """Return the model of a card's text.

    where: what to call the card in errors, which are those of `read_card`. inside: the card itself, after those that it is a component
    of; a relative path of a component begins beside it.
    """
    try:
        card = tomllib.loads(text)
    except tomllib.TOMLDecodeError as e:
        raise ModelError(f"the model card is not TOML: {e}", where=where) from None
    except (RecursionError, ValueError):
        raise ModelError("the model card is not TOML: nested too deeply or a number too long", where=where) from None
    try:
        return _model(card, inside)
    except InputError as e:
        raise e.at(f"{where}{_line(text, e)}") from None


def _line(text: str, error: InputError) -> str:
    """Return ", line N" of the component or connection that an error is about; empty for another."""
    found = re.match(r"\[components\.([^\]]+)\]|\[connections\] '([^']+)'", error.where)
    if found is None:
        return ""
    key = re.escape(found[1] or found[2])
    begin = rf"\s*\[components\.{key}[.\]]|\s*{key}\s*=" if found[1] else rf"\s*[\"']?{key}[\"']?\s*="
    lines = text.splitlines()
    return next((f", line {n}" for n, line in enumerate(lines, 1) if re.match(begin, line)), "")


def _model(card: dict[str, Any], inside: tuple[Path, ...]) -> Model:
    for key in card:
        if key not in _TOP:
            raise unknown_name("key", key, _TOP)
    schema = card.get("schema")
    if schema != SCHEMA or isinstance(schema, bool | float):
        got = "nothing" if schema is None else repr(schema)[:40]
        raise ModelError("the card's schema is not known", expected=f"schema = {SCHEMA}", got=got)
    for key in ("name", "description"):
        if not isinstance(card.get(key, ""), str):
            raise ModelError(f"the {key} is no text", expected=f'{key} = "..."', got=repr(card[key])[:40])
    if "name" not in card:
        raise ModelError("the card has no name", expected='name = "..."')
    sections: dict[str, Any] = {s: _section(s, card[s]) for s in SECTIONS if s in card}
    _check_record(card.get("record", []), card.get("also", []), sections.get("parameters", {}))
    if "components" not in card and "connections" not in card:
        return Model(name=card["name"], description=card.get("description", ""), **sections)
    parts = {n: _component(n, c, inside) for n, c in _table(card, "components").items()}
    connections = {n: _connection(n, c) for n, c in _table(card, "connections").items()}
    return assembled(sections, parts, connections, name=card["name"], description=card.get("description", ""))


def _check_record(record: object, also: object, parameters: dict[str, Any]) -> None:
    """Refuse what is no list of names; of a record they are parameters', "-" where no parameter has the value."""
    for key, value in (("record", record), ("also", also)):
        if not isinstance(value, list) or not all(isinstance(n, str) for n in value):
            raise ModelError(f"{key} is no list of names", expected=f'{key} = ["...", "..."]', got=_kind(value))
    assert isinstance(record, list)
    require_known("parameter", [n for n in record if n != "-"], parameters, "record")


def _table(card: dict[str, Any], section: str) -> dict[str, Any]:
    found = card.get(section, {})
    if not isinstance(found, dict):
        raise ModelError(f"'{section}' is no table", expected=f"[{section}]", got=_kind(found))
    return found


def _component(name: str, item: object, inside: tuple[Path, ...]) -> Component:
    """Return a component: a shipped one, or that of a card beside this one, with its values."""
    place = f"[components.{name}]"
    if not isinstance(item, dict) or not isinstance(item.get("source"), str):
        raise ModelError("the component has no source", where=place, expected='source = "genrou" or a card\'s path')
    required_keys(item, ComponentEntry, place)
    source, values = item["source"], item.get("parameters", {})
    if not isinstance(values, dict):
        raise ModelError("its parameters are no table", where=place, expected="{H = 4.2}", got=_kind(values))
    given: dict[str, float | sp.Expr] = {}
    for n, value in values.items():
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise ModelError(
                f"the value of '{n}' is of the wrong kind", where=place, expected="a number or text", got=_kind(value)
            )
        given[n] = parse(value, where=f"{place}, '{n}'") if isinstance(value, str) else float(value)
    path = card_of(source) if is_component(source) else Path(source)
    if path.suffix != ".toml":
        raise unknown_name("shipped component", source, components(), where=place)
    if not path.is_absolute() and inside:
        path = inside[-1].parent / path
    if path.resolve() in [p.resolve() for p in inside]:
        raise ModelError("the card is a component of itself", where=place, got=str(path))
    names = _names(item.get("names", {}), place)
    try:
        return Component(read_card(path, inside), FrozenMap(given), names)
    except InputError as e:
        raise e.at(place) from None


def _names(names: object, place: str) -> FrozenMap[str]:
    """Return the patterns by which a component's variables are called; a text is one for all of them."""
    table = {"*": names} if isinstance(names, str) else names
    if not isinstance(table, dict):
        raise ModelError("its names are no pattern", where=place, expected='"*1" or {"*" = "*1"}', got=_kind(names))
    for n, value in table.items():
        if not isinstance(value, str):
            raise ModelError(f"the name of '{n}' is no text", where=place, expected='"*1"', got=_kind(value))
    return FrozenMap(table)


def _connection(name: str, item: object) -> Connection:
    """Return a connection: an expression, or {value = expression, start = number} where it is an unknown of a circle."""
    place = f"[connections] '{name}'"
    table = item if isinstance(item, dict) else {"value": item}
    required_keys(table, Connection, place)
    value, start = table.get("value"), table.get("start")
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise ModelError("the connection is no expression", where=place, expected='"bus.V"', got=_kind(value))
    if start is not None and (isinstance(start, bool) or not isinstance(start, int | float)):
        raise ModelError("the start is no number", where=place, expected="start = 1.0", got=_kind(start))
    return Connection(expression_of(value, place), None if start is None else float(start))


def _section(section: str, table: object) -> dict[str, Any]:
    kind, _, noun = SECTIONS[section]
    if not isinstance(table, dict):
        raise ModelError(f"'{section}' is no table", expected=f"[{section}]", got=_kind(table))
    for name, item in table.items():
        place = f"[{section}] {noun} '{name}'"
        if isinstance(item, dict):
            required_keys(item, kind, place)
            _check_values(item, place)
        elif section not in _SHORT or not isinstance(item, str | int | float) or isinstance(item, bool):
            raise ModelError(
                "its value is of the wrong kind", where=place, expected=_expected(section), got=_kind(item)
            )
    return table


def _check_values(item: dict[str, Any], place: str) -> None:
    """Refuse values of TOML that no field takes; the model checks the kinds of the rest."""
    for key, value in item.items():
        if isinstance(value, dict):
            if key not in ("parameters", "replaces"):
                raise ModelError(
                    f"its {key} is of the wrong kind", where=place, expected="a number or text", got="a table"
                )
        elif isinstance(value, bool) or not isinstance(value, str | int | float):
            raise ModelError(
                f"its {key} is of the wrong kind", where=place, expected="a number or text", got=_kind(value)
            )


def _expected(section: str) -> str:
    return "a text or a table {value = ...}" if section in _SHORT else f"a table {{{SECTIONS[section][1]} = ...}}"


def _kind(value: object) -> str:
    names = {
        dict: "a table",
        list: "a list",
        str: "a text",
        bool: "a truth value",
        int: "an integer",
        float: "a number",
    }
    return names.get(type(value), f"a {type(value).__name__}")


def write_card(model: Model) -> str:
    """Return the text of the model's card: `parse_card(write_card(m)) == m`, every number to the last bit.

    Raises ExpressionError with the place for an expression that the card's grammar has no words for.
    """
    lines = [f"schema = {SCHEMA}", f"name = {toml_string(model.name)}"]
    if model.description:
        lines.append(f"description = {toml_string(model.description)}")
    for section in SECTIONS:
        items: Mapping[str, Any] = getattr(model, section)
        place = f"model '{model.name}', {SECTIONS[section][2]}"
        if section == "parameterisations":
            for name, item in items.items():
                lines += _parameterisation(name, item, f"{place} '{name}'")
        elif items:
            lines += ["", f"[{section}]"]
            for name, item in items.items():
                written = _item(item, section, f"{place} '{name}'")
                lines.append(f"{toml_key(name)} = {written}")
    return "\n".join(lines) + "\n"


def save_card(model: Model, path: str | Path) -> Path:
    """Return the path, once the model's card is written there whole: the file is the old one or the new one, never a part."""
    return write_text(Path(path), write_card(model))


def _parameterisation(name: str, item: Parameterisation, place: str) -> Iterator[str]:
    head = f"parameterisations.{toml_key(name)}"
    yield from ("", f"[{head}]")
    if item.description:
        yield f"description = {toml_string(item.description)}"
    yield from ("", f"[{head}.parameters]")
    for new, parameter in item.parameters.items():
        yield f"{toml_key(new)} = {_item(parameter, 'parameters', place)}"
    yield from ("", f"[{head}.replaces]")
    for replaced, expression in item.replaces.items():
        text = _value(expression, f"{place}, replaced '{replaced}'")
        yield f"{toml_key(replaced)} = {text}"


def _item(item: Any, section: str, place: str) -> str:
    given = [(f.name, getattr(item, f.name)) for f in fields(item) if _is_given(f, getattr(item, f.name))]
    if section in _SHORT and len(given) == 1:
        return _value(given[0][1], place)
    return "{" + ", ".join(f"{key} = {_value(value, f'{place}, {key}')}" for key, value in given) + "}"


def _is_given(field: Field[Any], value: Any) -> bool:
    """True for what has to be written: all but defaults; by repr, as -0.0 is no 0.0."""
    return field.name == "value" or field.default is MISSING or repr(field.default) != repr(value)


def _value(value: Any, place: str) -> str:
    if isinstance(value, str):
        return toml_string(value)
    if isinstance(value, float):
        return _float(value)
    if isinstance(value, sp.Expr):
        try:
            return toml_string(to_text(value))
        except ExpressionError as e:
            raise e.at(place) from None
    raise ModelError("the value cannot be written to a card", where=place, got=type(value).__name__)


def _float(value: float) -> str:
    return ("inf" if value > 0 else "-inf") if math.isinf(value) else repr(value)


def toml_key(name: str) -> str:
    return name if _BARE.fullmatch(name) else toml_string(name)


def toml_string(text: str) -> str:
    return '"' + "".join(_ESCAPES.get(c) or (c if _is_plain(c) else f"\\u{ord(c):04x}") for c in text) + '"'


def _is_plain(character: str) -> bool:
    if "\ud800" <= character <= "\udfff":
        raise ModelError("a text of the model is no valid unicode", got=f"the surrogate U+{ord(character):04X}")
    return character >= " " and character != "\x7f"
