"""JSON Schemas of study files and model cards for editors, and the rows of their reference: made of the readers' classes."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hvdc_ident.files import write_text
from hvdc_ident.model.card_schema import CardFile
from hvdc_ident.study.schema import StudyFile
from hvdc_ident.toml_tables import THE_TABLE, TomlTable

FOLDER = "schema"
"""Folder beside a study in which `write_schemas` puts the schemas."""
SCHEMA_LINE = f"#:schema ./{FOLDER}/study.json"
"""First line of a study whose schema is beside it, as the TOML server of editors reads it. The path is relative: a study that is
copied or sent takes its schema along, and no file names a folder of one machine."""
FILES: dict[str, type[TomlTable]] = {"study": StudyFile, "model-card": CardFile}
_DRAFT = "https://json-schema.org/draft/2020-12/schema"


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
    for name in FILES:
        write_text(folder / FOLDER / f"{name}.json", schema_text(name))


def schema_text(name: str) -> str:
    """Return the text of the JSON Schema of a file, one of FILES."""
    schema = FILES[name].model_json_schema()
    for path, table in _tables(schema).items():
        for key in _keys(table):
            unit = f" Unit: {key.unit}." if key.unit else ""
            own = table["properties"][key.name]
            own["description"] = f"{key.text}{unit} Example: {key.example}"
            for word in ("title", "examples", "unit", "of", *(() if key.default else ("default",))):
                own.pop(word, None)
        table.pop("description", None)
        table["title"] = f"[{path}]" if path else f"{name.replace('-', ' ')} of hvdc_ident"
    placed = _with_places(_without_null(schema), schema["$defs"])
    return json.dumps({"$schema": _DRAFT, **placed}, indent=1, ensure_ascii=False) + "\n"


def reference(name: str) -> dict[str, list[Key]]:
    """Return the keys of every table of a file, one of FILES, by the table's path in it ("" for the top)."""
    schema = FILES[name].model_json_schema()
    return {path: _keys(table) for path, table in _tables(schema).items()}


def _tables(schema: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the schema of every table by its path; one that stands in several places has the first."""
    definitions, seen = schema["$defs"], set[str]()

    def visit(path: str, table: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
        yield path, table
        for key, value in table["properties"].items():
            for definition, named in _definitions_in(value):
                if definition not in seen:
                    seen.add(definition)
                    inner = ".".join(filter(None, (path, key, "NAME" if named else "")))
                    yield from visit(inner, definitions[definition])

    return dict(visit("", schema))


def _definitions_in(value: Any, named: bool = False) -> Iterator[tuple[str, bool]]:
    """Yield the tables that a value may hold, and whether they have names, as the values of a table do."""
    if "$ref" in value:
        yield value["$ref"].rpartition("/")[2], named
    for branch in value.get("anyOf", ()):
        yield from _definitions_in(branch, named)
    if "items" in value:
        yield from _definitions_in(value["items"], named)
    if item := _item(value):
        yield from _definitions_in(item, True)


def _keys(table: dict[str, Any]) -> list[Key]:
    required = table.get("required", ())
    return [
        Key(
            name=name,
            text=own["description"],
            example=own["examples"][0],
            unit=own.get("unit", ""),
            required=name in required,
            default="" if _is_absent(own.get("default")) else json.dumps(own["default"], ensure_ascii=False),
            kind=_kind(own),
        )
        for name, own in table["properties"].items()
    ]


def _is_absent(default: Any) -> bool:
    """Return whether a default says only that nothing is there: it is no value that a file could state."""
    return default is None or default in ({}, [], "") or default in (math.inf, -math.inf)


def _item(schema: dict[str, Any]) -> dict[str, Any] | None:
    """Return the schema of the values of a table with free keys, were none nested; None for another."""
    item = schema.get("additionalProperties") or next(iter(schema.get("patternProperties", {}).values()), None)
    return item.get("else", item) if isinstance(item, dict) else None


def _kind(schema: dict[str, Any]) -> str:
    """Return the type of a key in words."""
    if "$ref" in schema:
        return "table"
    if "const" in schema:
        return json.dumps(schema["const"])
    if "enum" in schema:
        return " or ".join(json.dumps(v) for v in schema["enum"])
    if "anyOf" in schema:
        branches = (s for s in schema["anyOf"] if s.get("type") != "null")
        return " or ".join(dict.fromkeys(_kind(s) for s in branches))
    if schema.get("type") == "array":
        return f"list of {_plural(_kind(schema.get('items', {})))}"
    if schema.get("type") == "object":
        item = _item(schema)
        return f"table of {_plural(_kind(item))}" if item else "table"
    words = {"string": "text", "number": "number", "integer": "whole number", "boolean": "true or false"}
    limits = {"exclusiveMinimum": "above", "minimum": "from", "maximum": "to"}
    ranges = "".join(f" {word} {schema[name]:.10g}" for name, word in limits.items() if name in schema)
    return words.get(schema.get("type", ""), "value") + ranges


def _plural(kind: str) -> str:
    return re.sub(r"\b(text|number|table)\b", r"\1s", kind)


def _without_null(schema: Any) -> Any:
    """Return a schema without the branches for null, which TOML cannot write."""
    if isinstance(schema, list):
        return [_without_null(s) for s in schema if s != {"type": "null"}]
    if not isinstance(schema, dict):
        return schema
    result = {k: _without_null(v) for k, v in schema.items()}
    branches = result.get("anyOf")
    return {**result.pop("anyOf")[0], **result} if isinstance(branches, list) and len(branches) == 1 else result


def _with_places(schema: Any, definitions: dict[str, Any], place: str = "#", table: str = "#") -> Any:
    """Return a schema in which a table of names refers to itself by its place, and shows editors the keys of its items.

    definitions: of the whole. Editors complete what stands in `properties`, and do not look into `else`.
    """
    if schema == THE_TABLE:
        return {"$ref": table}
    if isinstance(schema, list):
        return [_with_places(s, definitions, f"{place}/{k}", table) for k, s in enumerate(schema)]
    if not isinstance(schema, dict):
        return schema
    if "patternProperties" in schema:
        table = place
    result = {k: _with_places(v, definitions, f"{place}/{k}", table) for k, v in schema.items()}
    item = schema.get("else", {}).get("$ref", "").rpartition("/")[2]
    return {"properties": _without_null(definitions[item]["properties"]), **result} if item else result
