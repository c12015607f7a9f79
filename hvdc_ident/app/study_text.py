"""An experiment written into a study file's text: its other tables, its order and its comments stay as they are.

A table that goes takes its comments along. What comes out is read again and has to say what was meant and nothing else, so a file
that cannot be changed is refused and never damaged.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from typing import Any

import tomlkit
from tomlkit.container import Container
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT, InlineTable, Table, Trivia, Whitespace

from hvdc_ident.errors import StudyError
from hvdc_ident.toml_tables import parsed, with_dots

TABLES = ("inputs", "outputs", "columns")
"""Keys of an experiment that are tables; a list of names stands for a table of names that are their own columns."""
EXPERIMENT = re.compile(r"^(?=[ \t]*\[\[[ \t]*experiment[ \t]*\]\])", re.MULTILINE)
"""Where an experiment begins. The file is cut there, as tomlkit moves tables of one array together."""


def with_experiment(text: str, name: str, keys: Mapping[str, Any], where: str) -> str:
    """Return the text of a study in which the experiment of a name has these keys; without one it is added behind the others.

    keys: None and empty tables for what is not to be there. Raises StudyError where the text cannot be changed.
    """
    mark = "\ufeff" if text.startswith("\ufeff") else ""
    line_end = "\r\n" if "\r\n" in text else "\n"
    plain = text.removeprefix(mark).replace("\r\n", "\n").rstrip("\n") + "\n"
    meant = parsed(plain, "the study file", where, StudyError, "mend this line, then write again")
    experiments = meant.setdefault("experiment", [])
    place = next((k for k, e in enumerate(experiments) if e.get("name") == name), len(experiments))
    experiments[place : place + 1] = [{**e, **keys} for e in experiments[place : place + 1] or [{}]]
    try:
        changed = _changed(EXPERIMENT.split(plain), name, keys)
        done = _meaning(tomllib.loads(changed)) == _meaning(meant)
    except (TOMLKitError, tomllib.TOMLDecodeError):
        done = False
    if not done:
        raise StudyError(
            f"experiment '{name}' cannot be changed in this file without touching the rest",
            where=where,
            expected="a table [[experiment]], and all that is inside it before another table",
            hint="lay the experiment out like this in an editor; the file is as it was",
        )
    return mark + changed.replace("\n", line_end)


def _changed(parts: list[str], name: str, keys: Mapping[str, Any]) -> str:
    """Return the text of parts of a study, with these keys in the experiment of the name, else in a new one in the last part."""
    names = [[e.get("name") for e in tomllib.loads(part).get("experiment", ())] for part in parts]
    place = next((k for k, inside in enumerate(names) if name in inside), -1)
    document = tomlkit.parse(parts[place])
    if tomlkit.dumps(document) != parts[place]:
        raise TOMLKitError("the order of the tables would not stay")
    experiment = next((e for e in document.get("experiment", ()) if e.get("name") == name), None)
    headed: list[tuple[Trivia, str]] = []
    rest = _cut_comments(document, "", headed) if "experiment" in document else ""
    new = _plain(keys)
    if experiment is None:
        document.setdefault("experiment", tomlkit.aot()).append(_table(new))
    else:
        old = _plain(experiment.unwrap())
        for key in (k for k in keys if old.get(k) != new.get(k)):
            _put(experiment, key, new.get(key))
    for trivia, comments in headed:
        trivia.indent = comments + trivia.indent
    parts[place] = tomlkit.dumps(document) + rest
    return "".join(parts)


def _cut_comments(container: Container, above: str, headed: list[tuple[Trivia, str]]) -> str:
    """Take comments and blank lines off the ends of tables, where new keys would stand below them, and return the last ones.

    above: those before the container. headed: gets those before a header, with the header's place.
    """
    loose: list[int] = []

    def cut() -> str:
        text = "".join(container.body[k][1].as_string() for k in loose)
        for k in loose:
            container.body[k] = (None, Whitespace(""))
        loose.clear()
        return text

    for k, (key, item) in enumerate(container.body):
        if key is None:
            loose.append(k)
        elif key.is_dotted() or not isinstance(item, AoT | Table):
            loose.clear()
        else:
            above += cut()
            for table in item.body if isinstance(item, AoT) else [item]:
                if not table.is_super_table():
                    headed.append((table.trivia, above))
                    above = ""
                above = _cut_comments(table.value, above, headed)
    return above + cut()


def _table(keys: Mapping[str, Any]) -> Table:
    """Return a new experiment, its tables last."""
    table = tomlkit.table()
    table.trivia.indent = "\n"
    for key in sorted(keys, key=TABLES.__contains__):
        if isinstance(keys[key], Mapping):
            table[key] = tomlkit.table()
            if key != "columns":
                table[key].comment("signal of the model = column").trivia.comment_ws = "   "
        _put(table, key, keys[key])
    return table


def _put(table: Any, key: str, wanted: Any) -> None:
    """Give a key of a table another value, None for none; what says the same within a table stays letter for letter."""
    old = table.get(key)
    if old == wanted:
        return
    if wanted is None:
        del table[key]
    elif not isinstance(wanted, Mapping):
        table[key] = wanted
    elif isinstance(old, dict) and not isinstance(old, InlineTable):
        nested = _nested(wanted, old)
        for name in {**nested, **old}:
            _put(table[key], name, nested.get(name))  # tomlkit's view of dotted keys holds for one change
    else:
        table[key] = tomlkit.inline_table()
        table[key].update(wanted)


def _nested(wanted: Mapping[str, Any], old: Mapping[str, Any]) -> dict[str, Any]:
    """Return names with those of components nested where they were: `gen.P` is P in a table gen."""
    nested: dict[str, Any] = {}
    for name, value in wanted.items():
        part, _, inner = name.partition(".")
        if inner and part not in wanted and isinstance(old.get(part), dict):
            nested.setdefault(part, {})[inner] = value
        else:
            nested[name] = value
    return nested


def _meaning(study: Mapping[str, Any]) -> dict[str, Any]:
    return {**study, "experiment": [_plain(e) for e in study.get("experiment", ())]}


def _plain(experiment: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys that an experiment states, its tables with one key for each signal."""
    found = dict(experiment)
    for key in (k for k in TABLES if k in found):
        names = found[key]
        found[key] = with_dots({n: n for n in names} if isinstance(names, list) else names, tables=key == "columns")
    return {k: v for k, v in found.items() if v is not None and v != {}}
