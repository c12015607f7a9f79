"""An experiment, or values and bounds of parameters, written into a study file's text: all else stays as it is, comments too.

A table that goes takes its comments along. What comes out is read again and has to say what was meant and nothing else, so a file
that cannot be changed is refused and never damaged.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import tomlkit
from tomlkit import TOMLDocument
from tomlkit.container import Container
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT, InlineTable, Table, Trivia, Whitespace

from hvdc_ident.errors import StudyError
from hvdc_ident.toml_tables import parsed, with_dots

TABLES = ("inputs", "outputs", "columns")
"""Keys of an experiment that are tables; a list of names stands for a table of names that are their own columns."""
EXPERIMENT = re.compile(r"^(?=[ \t]*\[\[[ \t]*experiment[ \t]*\]\])", re.MULTILINE)
"""Where an experiment begins. The file is cut there, as tomlkit moves tables of one array together."""
AS_IT_WAS = "lay it out like this in an editor; the file is as it was"


def with_experiment(text: str, name: str, keys: Mapping[str, Any], where: str) -> str:
    """Return the text of a study in which the experiment of a name has these keys; without one it is added behind the others.

    keys: None and empty tables for what is not to be there. Raises StudyError where the text cannot be changed.
    """
    meant = parsed(_plain_text(text), "the study file", where, StudyError, "mend this line, then write again")
    experiments = meant.setdefault("experiment", [])
    place = next((k for k, e in enumerate(experiments) if e.get("name") == name), len(experiments))
    experiments[place : place + 1] = [{**e, **keys} for e in experiments[place : place + 1] or [{}]]

    def holds(part: Mapping[str, Any]) -> bool:
        return any(e.get("name") == name for e in part.get("experiment", ()))

    def edit(document: Any) -> None:
        experiment = next((e for e in document.get("experiment", ()) if e.get("name") == name), None)
        new = _plain(keys)
        if experiment is None:
            document.setdefault("experiment", tomlkit.aot()).append(_table(new))
            return
        old = _plain(experiment.unwrap())
        for key in (k for k in keys if old.get(k) != new.get(k)):
            _put(experiment, key, new.get(key))

    what = f"experiment '{name}' cannot be changed in this file without touching the rest"
    expected = "a table [[experiment]], and all that is inside it before another table"
    return _edited(text, meant, [(holds, -1, edit)], StudyError(what, where=where, expected=expected, hint=AS_IT_WAS))


def with_parameters(
    text: str,
    parameters: Mapping[str, Mapping[str, float] | None],
    values: Mapping[str, float],
    added: Sequence[Mapping[str, Any]],
    where: str,
) -> str:
    """Return the text of a study with other candidates, values and effects.

    parameters: by name the keys of [parameters] that are to be there, beside those that stand; None takes the name out. values: for
    [model.values]. added: tables for [[model.effect]]. Raises StudyError where the text cannot be changed.
    """
    meant = parsed(_plain_text(text), "the study file", where, StudyError, "mend this line, then write again")

    def candidates(study: Any) -> None:
        table = study.setdefault("parameters", {})
        for name, keys in parameters.items():
            inside, key = _place_of(table, name)
            if keys is None:
                inside.pop(key, None)
            elif key in inside:
                for k, v in keys.items():
                    inside[key][k] = v
            else:
                inside[key] = _inline(keys, study)

    def model(study: Any) -> None:
        if values:
            table = study["model"].setdefault("values", _inline({}, study))
            for name, value in values.items():
                inside, key = _place_of(table, name)
                inside[key] = value
        for use in added:
            written = isinstance(study, TOMLDocument)
            study["model"].setdefault("effect", tomlkit.aot() if written else []).append(_effect(use, study))

    edits = [("parameters", candidates)] * bool(parameters) + [("model", model)] * bool(values or added)
    for _, edit in edits:
        edit(meant)
    what = "parameters, values or effects cannot be changed in this file without touching the rest"
    expected = "tables [parameters] and [model], each before another one begins"
    steps = [((lambda part, key=key: key in part), 0, edit) for key, edit in edits]
    return _edited(text, meant, steps, StudyError(what, where=where, expected=expected, hint=AS_IT_WAS))


def _place_of(table: Any, name: str) -> tuple[Any, str]:
    """Return the table and the key under which a name stands, or is to stand: `gen.H` may be H in a table gen."""
    part, _, inner = name.partition(".")
    if name not in table and inner and isinstance(table.get(part), dict):
        return _place_of(table[part], inner)
    return table, name


def _inline(keys: Mapping[str, Any], study: Any) -> Any:
    """Return the keys as a table in one line, of the kind that the study is of."""
    if not isinstance(study, TOMLDocument):
        return dict(keys)
    table = tomlkit.inline_table()
    table.update(keys)
    return table


def _effect(use: Mapping[str, Any], study: Any) -> Any:
    if not isinstance(study, TOMLDocument):
        return dict(use)
    table = tomlkit.table()
    for key, value in use.items():
        table[key] = _inline(value, study) if isinstance(value, Mapping) else value
    return table


def _plain_text(text: str) -> str:
    return text.removeprefix("\ufeff").replace("\r\n", "\n").rstrip("\n") + "\n"


Edit = tuple[Callable[[Mapping[str, Any]], bool], int, Callable[[Any], None]]
"""What tells the part of a study that an edit is made in, the part otherwise, and what is done to it."""


def _edited(text: str, meant: Mapping[str, Any], edits: Sequence[Edit], refusal: StudyError) -> str:
    """Return the text after edits, with its line ends; raise the refusal where it would not say what is meant."""
    mark = "\ufeff" if text.startswith("\ufeff") else ""
    line_end = "\r\n" if "\r\n" in text else "\n"
    parts = EXPERIMENT.split(_plain_text(text))
    try:
        for holds, otherwise, edit in edits:
            place = next((k for k, part in enumerate(parts) if holds(tomllib.loads(part))), otherwise)
            parts[place] = _part_edited(parts[place], edit)
        changed = "".join(parts)
        done = _meaning(tomllib.loads(changed)) == _meaning(meant)
    except (TOMLKitError, tomllib.TOMLDecodeError):
        done = False
    if not done:
        raise refusal
    return mark + changed.replace("\n", line_end)


def _part_edited(part: str, edit: Callable[[Any], None]) -> str:
    document = tomlkit.parse(part)
    if tomlkit.dumps(document) != part:
        raise TOMLKitError("the order of the tables would not stay")
    headed: list[tuple[Trivia, str]] = []
    rest = _cut_comments(document, "", headed) if any(key is not None for key, _ in document.body) else ""
    edit(document)
    for trivia, comments in headed:
        trivia.indent = comments + trivia.indent
    return tomlkit.dumps(document) + rest


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
    keys = dict(experiment)
    for key in (k for k in TABLES if k in keys):
        names = keys[key]
        keys[key] = with_dots({n: n for n in names} if isinstance(names, list) else names, tables=key == "columns")
    return {k: v for k, v in keys.items() if v is not None and v != {}}
