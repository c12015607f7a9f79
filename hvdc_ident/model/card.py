"""Model cards: a model as TOML text, read and written without loss."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import sympy as sp

from hvdc_ident.errors import ExpressionError, InputError, ModelError, require_known, unknown_name
from hvdc_ident.expression import parse, to_text
from hvdc_ident.files import write_text
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model.check import SECTIONS
from hvdc_ident.model.check import expression as expression_of
from hvdc_ident.model.components import Component, Connection, assembled
from hvdc_ident.model.definition import Model, Parameterisation
from hvdc_ident.shelf import card_of, components, is_component

if TYPE_CHECKING:
    from hvdc_ident.model.card_schema import ComponentEntry

SCHEMA = 1
MAX_BYTES = 5_000_000

_BARE = re.compile(r"[A-Za-z0-9_-]+", re.ASCII)
_ESCAPES = {"\\": "\\\\", '"': '\\"', "\n": "\\n", "\t": "\\t", "\r": "\\r", "\b": "\\b", "\f": "\\f"}
_SHORT = frozenset(("signals", "outputs"))


def read_card(path: str | Path, inside: tuple[Path, ...] = ()) -> Model:
    """Return the model of a card, a TOML file.

    inside: the cards that this one is a component of, the outermost first.
    Raises ModelError for a file that is missing, over 5 MB, not UTF-8 or not TOML, and ModelError, UnknownNameError
    or ExpressionError with the file and the place in it for what it says.
    """
    from hvdc_ident.toml_tables import decoded

    path = Path(path)
    try:
        with path.open("rb") as stream:
            content = stream.read(MAX_BYTES + 1)
    except (OSError, ValueError) as e:
        reason = (getattr(e, "strerror", None) or "no usable path").lower()
        raise ModelError(f"the model card cannot be read: {reason}", where=str(path)) from None
    text = decoded(content, "the model card", str(path), MAX_BYTES, ModelError)
    return parse_card(text, str(path), (*inside, path))


@cache
def shelf_model(name: str) -> Model:
    """Return a component of the shelf. Raises UnknownNameError for a name that is not there."""
    return read_card(card_of(name))


def parse_card(text: str, where: str = "model card", inside: tuple[Path, ...] = ()) -> Model:
    """Return the model of a card's text.

    where: what to call the card in errors, which are those of `read_card`. inside: the card itself, after those that it is a component
    of; a relative path of a component begins beside it.
    """
    from hvdc_ident.toml_tables import parsed

    card = parsed(text, "the model card", where, ModelError)
    try:
        return _model(card, inside)
    except InputError as e:
        raise e.at(f"{where}{_line(text, e)}") from None


def _line(text: str, error: InputError) -> str:
    """Return ", line N" of the component or connection that an error is about; empty for another."""
    match = re.match(r"\[?components\.([^\].]+)|\[connections\] '([^']+)'|connections\.(.+)", error.where)
    if match is None:
        return ""
    key = re.escape(match[1] or match[2] or match[3])
    begin = rf"\s*\[components\.{key}[.\]]|\s*{key}\s*=" if match[1] else rf"\s*[\"']?{key}[\"']?\s*="
    lines = text.splitlines()
    return next((f", line {n}" for n, line in enumerate(lines, 1) if re.match(begin, line)), "")


def _model(card: dict[str, Any], inside: tuple[Path, ...]) -> Model:
    from hvdc_ident.model.card_schema import CardFile
    from hvdc_ident.toml_tables import require_schema, validated

    require_schema(card, SCHEMA, "the card", "", ModelError)
    file = validated(CardFile, card, "", ModelError)
    require_known("parameter", [n for n in file.record if n != "-"], file.parameters, "record")
    require_known("parameter", file.power_flow, file.parameters, "power_flow")
    require_known("parameter of the record", file.asked, file.record, "asked")
    if file.exchange is not None:
        for key in ("free", "means", "takes"):
            require_known("parameter", getattr(file.exchange, key), file.parameters, f"exchange, {key}")
    sections = file.model_dump(include=set(SECTIONS), exclude_unset=True)
    if not file.components and not file.connections:
        return Model(name=file.name, description=file.description, **sections)
    parts = {n: _component(n, c, inside) for n, c in file.components.items()}
    connections = {
        n: Connection(expression_of(c.value, f"[connections] '{n}'"), c.start) for n, c in file.connections.items()
    }
    return assembled(sections, parts, connections, name=file.name, description=file.description)


def _component(name: str, entry: ComponentEntry, inside: tuple[Path, ...]) -> Component:
    """Return a component: a shipped one, or that of a card beside this one, with its values."""
    place = f"[components.{name}]"
    given = {
        n: parse(value, where=f"{place}, '{n}'") if isinstance(value, str) else float(value)
        for n, value in entry.parameters.items()
    }
    try:
        model = shelf_model(entry.source) if is_component(entry.source) else _beside(entry.source, inside)
        return Component(model, FrozenMap(given), FrozenMap(entry.names))
    except InputError as e:
        raise e.at(place) from None


def _beside(source: str, inside: tuple[Path, ...]) -> Model:
    """Return the model of a card that another one names as its component."""
    path = Path(source)
    if path.suffix != ".toml":
        raise unknown_name("shipped component", source, components())
    if not path.is_absolute() and inside:
        path = inside[-1].parent / path
    if path.resolve() in [p.resolve() for p in inside]:
        raise ModelError("the card is a component of itself", got=str(path))
    return read_card(path, inside)


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
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return _float(value)
    if isinstance(value, tuple):
        return f"[{', '.join(_float(v) for v in value)}]"
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


def toml_table(values: Mapping[str, Any]) -> str:
    """Return an inline table of texts, numbers and such tables."""

    def shown(value: Any) -> str:
        if isinstance(value, Mapping):
            return toml_table(value)
        return toml_string(value) if isinstance(value, str) else repr(value)

    return f"{{{', '.join(f'{toml_key(n)} = {shown(v)}' for n, v in values.items())}}}"


def _is_plain(character: str) -> bool:
    if "\ud800" <= character <= "\udfff":
        raise ModelError("a text of the model is no valid unicode", got=f"the surrogate U+{ord(character):04X}")
    return character >= " " and character != "\x7f"
