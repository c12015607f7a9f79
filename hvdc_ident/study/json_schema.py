"""JSON Schemas of study files and model cards, for editors that complete and check TOML.

They are made of the classes that the readers check with, when they are asked for: no copy is kept that could be out of date.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
import typing
from collections.abc import Iterator
from dataclasses import MISSING, Field, dataclass, fields
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from hvdc_ident.files import write_text
from hvdc_ident.model.card import SCHEMA
from hvdc_ident.model.check import EXPRESSIONS, SECTIONS, keys_of
from hvdc_ident.model.components import PARTS
from hvdc_ident.study.schema import StudyFile

FOLDER = "schema"
"""Folder beside a study in which `write_schemas` puts the schemas."""
SCHEMA_LINE = f"#:schema ./{FOLDER}/study.json"
"""First line of a study whose schema is beside it, as the TOML server of editors reads it. The path is relative: a study that is
copied or sent takes its schema along, and no file names a folder of one machine."""
NAMES = ("study", "model-card")
_DRAFT = "https://json-schema.org/draft/2020-12/schema"
_SHORT = ("signals", "outputs", "connections")


@dataclass(frozen=True)
class Key:
    """One key of a file: its text, unit and example, whether it has to be there, and its default as TOML ("" if left out)."""

    name: str
    text: str
    example: str
    unit: str
    required: bool
    default: str
    kind: str


def write_schemas(folder: Path) -> None:
    """Write the schemas of studies and model cards into the folder FOLDER of a folder."""
    for name in NAMES:
        write_text(folder / FOLDER / f"{name}.json", schema_text(name))


def schema_text(name: str) -> str:
    """Return the text of a schema, one of NAMES, as the readers of this version have it."""
    schema = {"study": study_schema, "model-card": card_schema}[name]()
    return json.dumps(_without_null(schema), indent=1, ensure_ascii=False) + "\n"


# --- studies ---


def study_tables() -> dict[str, type[BaseModel]]:
    """Return the class of every table of a study file by its path ("" for the top); a class in several places has the first."""
    found: dict[str, type[BaseModel]] = {}

    def visit(path: str, table: type[BaseModel]) -> None:
        if table in found.values():
            return
        found[path] = table
        for key, field in _fields_of(table):
            for inner, named in _tables_in(field.annotation):
                visit(".".join(filter(None, (path, key, "NAME" if named else ""))), inner)

    visit("", StudyFile)
    return found


def study_keys() -> dict[str, list[Key]]:
    """Return the keys of every table of a study file, by the table's path ("study" for the top), with their texts."""
    texts = key_texts("study")
    definitions = StudyFile.model_json_schema(by_alias=True, mode="validation")["$defs"]
    result = {}
    for path, table in study_tables().items():
        own = StudyFile.model_json_schema() if table is StudyFile else definitions[table.__name__]
        result[path or "study"] = [
            _key(key, texts[path or "study"][key], field.is_required(), field.default, own["properties"][key])
            for key, field in _fields_of(table)
        ]
    return result


def study_schema() -> dict[str, Any]:
    """Return the JSON Schema of a study file."""
    schema = StudyFile.model_json_schema(by_alias=True, mode="validation")
    titles = {table.__name__: path for path, table in study_tables().items()}
    keys = study_keys()
    for name, definition in [*schema["$defs"].items(), ("StudyFile", schema)]:
        for key in keys[titles[name] or "study"]:
            _describe(definition["properties"][key.name], key)
        definition["title"] = f"[{titles[name]}]" if titles[name] else "study of hvdc_ident"
        definition.pop("description", None)
    return {"$schema": _DRAFT, **schema}


def _fields_of(table: type[BaseModel]) -> Iterator[tuple[str, Any]]:
    yield from ((field.alias or name, field) for name, field in table.model_fields.items())


def _tables_in(annotation: Any, named: bool = False) -> Iterator[tuple[type[BaseModel], bool]]:
    """Yield the tables in a type, and whether they have names, as the values of a table do."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation, named
        return
    is_mapping = typing.get_origin(annotation) is dict
    for part in typing.get_args(annotation):
        yield from _tables_in(part, named or is_mapping)


# --- model cards ---

CARD = {**SECTIONS, **PARTS}
"""Sections of a card with their entries' classes."""


def card_keys() -> dict[str, list[Key]]:
    """Return the keys of every section of a model card, by the section's name ("card" for the top), with their texts."""
    texts = key_texts("model-card")
    top = [_key(key, text, key in ("schema", "name"), MISSING, _top_kind(key)) for key, text in texts["card"].items()]
    return {"card": top} | {
        section: [
            _key(f.name, texts[section][f.name], keys_of(kind)[f.name], f.default, _card_value(section, f))
            for f in fields(kind)
        ]
        for section, (kind, _, _) in CARD.items()
    }


def card_schema() -> dict[str, Any]:
    """Return the JSON Schema of a model card."""
    properties: dict[str, Any] = {}
    for key in card_keys()["card"]:
        properties[key.name] = _describe(_top_kind(key.name), key)
    return {
        "$schema": _DRAFT,
        "title": "model card of hvdc_ident",
        "type": "object",
        "additionalProperties": False,
        "required": ["schema", "name"],
        "properties": properties,
        "$defs": {section: _card_item(section) for section in CARD},
    }


def _top_kind(key: str) -> dict[str, Any]:
    if key == "schema":
        return {"const": SCHEMA, "type": "integer"}
    if key in ("record", "also"):
        return {"type": "array", "items": {"type": "string"}}
    if key not in CARD:
        return {"type": "string"}
    item: dict[str, Any] = {"$ref": f"#/$defs/{key}"}
    if key in _SHORT:
        item = {"anyOf": [{"type": "string"}, {"type": "number"}, item]}
    return {"type": "object", "additionalProperties": item}


def _card_item(section: str) -> dict[str, Any]:
    kind = CARD[section][0]
    keys = {k.name: k for k in card_keys()[section]}
    return {
        "type": "object",
        "additionalProperties": False,
        "required": [k.name for k in keys.values() if k.required],
        "properties": {f.name: _describe(_card_value(section, f), keys[f.name]) for f in fields(kind)},
    }


def _card_value(section: str, field: Field[Any]) -> dict[str, Any]:
    """Return the JSON type of a field: an expression is a text or a number, as is a state's start."""
    if field.name in ("unit", "description", "source"):
        return {"type": "string"}
    if (section, field.name) == ("components", "parameters"):
        return {"type": "object", "additionalProperties": {"type": ["string", "number"]}}
    if field.name == "names":
        text = {"type": "string"}
        return {"anyOf": [text, {"type": "object", "additionalProperties": text}]}
    if field.name in ("parameters", "replaces"):
        item = {"$ref": "#/$defs/parameters"} if field.name == "parameters" else {"type": ["string", "number"]}
        return {"type": "object", "additionalProperties": item}
    if field.name in ("min", "max"):
        return {"type": ["number", "null"]}  # taplo takes TOML's inf for null
    is_number = section in ("parameters", "inputs") or (section, field.name) in (
        ("algebraic", "start"),
        ("connections", "start"),
    )
    if (
        is_number
        or field.name == "guess"
        or (field.name not in EXPRESSIONS and field.name not in ("value", "start", "rest", "vanishes"))
    ):
        return {"type": "number"}
    return {"type": ["string", "number"]}


# --- both ---


@cache
def key_texts(name: str) -> dict[str, dict[str, dict[str, str]]]:
    """Return text, unit and example by table and key, as they are shipped; one of NAMES."""
    return tomllib.loads(resources.files(__package__).joinpath("schemas", f"{name}-keys.toml").read_text("utf-8"))


def _key(name: str, text: dict[str, str], required: bool, default: Any, schema: dict[str, Any]) -> Key:
    shown = "" if required or _is_absent(default) else json.dumps(_plain(default), ensure_ascii=False)
    return Key(name, text["text"], text["example"], text.get("unit", ""), required, shown, kind_of(schema))


def _plain(default: Any) -> Any:
    return default if isinstance(default, bool | int | float | str | list) else str(default)


def _is_absent(default: Any) -> bool:
    """Return whether a default says only that nothing is there: it is no value that a file could state."""
    return default is MISSING or default is None or default in ({}, [], "") or default in (math.inf, -math.inf)


def kind_of(schema: dict[str, Any]) -> str:
    """Return the type of a key in words, from its JSON Schema."""
    if "$ref" in schema:
        return "table"
    if "const" in schema:
        return json.dumps(schema["const"])
    if "enum" in schema:
        return " or ".join(json.dumps(v) for v in schema["enum"])
    if "anyOf" in schema:
        return " or ".join(dict.fromkeys(kind_of(s) for s in schema["anyOf"] if s.get("type") != "null"))
    kind = schema.get("type")
    if isinstance(kind, list):
        return " or ".join(kind_of({"type": k}) for k in kind if k != "null")
    if kind == "array":
        return f"list of {_plural(kind_of(schema.get('items', {})))}"
    if kind == "object":
        inner = schema.get("additionalProperties") or next(iter(schema.get("patternProperties", {}).values()), None)
        return f"table of {_plural(kind_of(inner))}" if isinstance(inner, dict) else "table"
    words = {"string": "text", "number": "number", "integer": "whole number", "boolean": "true or false"}
    return words[kind] + _range(schema) if kind in words else "value"


def _without_null(schema: Any) -> Any:
    """Return a schema without the branches for null, which TOML cannot write."""
    if isinstance(schema, list):
        return [_without_null(s) for s in schema if s != {"type": "null"}]
    if not isinstance(schema, dict):
        return schema
    result = {k: _without_null(v) for k, v in schema.items()}
    branches = result.get("anyOf")
    return {**result.pop("anyOf")[0], **result} if isinstance(branches, list) and len(branches) == 1 else result


def _plural(kind: str) -> str:
    return re.sub(r"\b(text|number|table)\b", r"\1s", kind)


def _range(schema: dict[str, Any]) -> str:
    words = {"exclusiveMinimum": "above", "minimum": "from", "maximum": "to"}
    return "".join(f" {word} {schema[name]:.10g}" for name, word in words.items() if name in schema)


def _describe(schema: dict[str, Any], key: Key) -> dict[str, Any]:
    """Give a key's schema its text, unit and example; return it."""
    unit = f" Unit: {key.unit}." if key.unit else ""
    schema.pop("title", None)
    if schema.get("default", MISSING) is not MISSING and _is_absent(schema["default"]):
        del schema["default"]
    if key.default:
        schema["default"] = json.loads(key.default)
    schema["description"] = f"{key.text}{unit} Example: {key.example}"
    return schema
