"""An experiment written into a study file's text: its other tables, its order and its comments stay as they are.

Text is changed statement by statement. What comes out is read again and has to say what was meant and nothing else, so a file
that is laid out in a way this module does not know is refused and never damaged.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from hvdc_ident.errors import StudyError
from hvdc_ident.model.card import toml_key, toml_string
from hvdc_ident.toml_tables import parsed

TABLES = ("inputs", "outputs", "columns")
"""Keys of an experiment that are tables; a list of names stands for a table of names that are their own columns."""
PLAIN = ("name", "data", "role", "event", "window")
"""The other keys that are written."""
ABOUT = {"inputs": "   # signal of the model = column", "outputs": "   # signal of the model = column"}


@dataclass(frozen=True)
class Statement:
    """Some whole lines of a TOML file. header: names in brackets; path: of the key on the left, from the last header on.

    Both are empty for comments and blank lines.
    """

    text: str
    header: tuple[str, ...] = ()
    path: tuple[str, ...] = ()


def with_experiment(text: str, name: str, keys: Mapping[str, Any], where: str) -> str:
    """Return the text of a study in which the experiment of a name has these keys; without one it is added behind the others.

    keys: of `PLAIN` and `TABLES`; None for what is not to be there. Raises StudyError where the text cannot be changed.
    """
    mark = "\ufeff" if text.startswith("\ufeff") else ""
    line_end = "\r\n" if "\r\n" in text else "\n"
    plain = text.removeprefix(mark).replace("\r\n", "\n").rstrip("\n") + "\n"
    before = _read(plain, where)
    statements = list(_statements(plain, where))
    wanted = {k: v for k, v in keys.items() if v is not None and v != {}}
    span = _span(statements, name)
    if span is None:
        at = _behind(statements)
        head, tail = ("".join(s.text for s in part) for part in (statements[:at], statements[at:]))
        changed = "\n".join([*([head] if head else []), _new(wanted)])
        changed += tail if not tail or tail.startswith("\n") else f"\n{tail}"
    else:
        block = _changed(statements[slice(*span)], keys)
        changed = "".join(s.text for s in [*statements[: span[0]], *block, *statements[span[1] :]])
    _check(before, changed, name, keys, where)
    return mark + changed.replace("\n", line_end)


def toml_value(value: Any) -> str:
    """Return a value as TOML: a text, a number, a truth value, a list, or a table in one line."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return toml_string(value)
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{toml_key(k)} = {toml_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, Sequence):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    return repr(value)


def _read(text: str, where: str) -> dict[str, Any]:
    return parsed(text, "the study file", where, StudyError, "mend this line, then write again")


def _statements(text: str, where: str) -> Iterator[Statement]:
    """Yield the statements of a valid file: each is the fewest whole lines that are TOML by themselves."""
    pending = ""
    for line in re.findall(r"[^\n]*\n", text):
        pending += line
        bare = pending.strip()
        if not bare or (bare.startswith("#") and pending == line):
            yield Statement(pending)
            pending = ""
            continue
        try:
            found = tomllib.loads(pending)
        except tomllib.TOMLDecodeError:
            continue  # goes on in the next line
        path = tuple(_path(found))
        yield Statement(pending, header=path) if bare.startswith("[") else Statement(pending, path=path)
        pending = ""
    if pending:
        raise StudyError("the file's layout is not known", where=where, hint="change it in an editor")


def _path(found: Any) -> Iterator[str]:
    """Yield the names that lead to the one value; an inline table is the value itself, with a name and no further ones."""
    while isinstance(found, list) and found and isinstance(found[0], dict):
        found = found[0]
    if isinstance(found, dict) and len(found) == 1:
        (name, inner), *_ = found.items()
        yield name
        if isinstance(inner, dict | list):
            yield from _path(inner)


def _span(statements: Sequence[Statement], name: str) -> tuple[int, int] | None:
    """Return where an experiment begins and ends; comments that stand before the next header belong to that one."""
    starts = [k for k, s in enumerate(statements) if s.header == ("experiment",)]
    for start in starts:
        end = next(
            (k for k in range(start + 1, len(statements)) if (h := statements[k].header) and not _inner(h)),
            len(statements),
        )
        for s in statements[start + 1 : end]:
            if s.header:
                break
            if s.path == ("name",) and tomllib.loads(s.text)["name"] == name:
                while end < len(statements) and not (statements[end - 1].header or statements[end - 1].path):
                    end -= 1
                return start, end
    return None


def _inner(header: tuple[str, ...]) -> bool:
    return header[0] == "experiment" and len(header) > 1


def _behind(statements: Sequence[Statement]) -> int:
    """Return the place for another experiment: behind the last one, else the end."""
    last = 0
    inside = False
    for k, s in enumerate(statements, 1):
        if s.header:
            inside = s.header[0] == "experiment"
        if inside and (s.header or s.path):
            last = k
    return last or len(statements)


def _new(wanted: Mapping[str, Any]) -> str:
    """Return the text of a new experiment."""
    lines = ["[[experiment]]", *(f"{k} = {toml_value(wanted[k])}" for k in PLAIN if k in wanted)]
    for table in (t for t in TABLES if t in wanted):
        lines += ["", f"[experiment.{table}]{ABOUT.get(table, '')}"]
        lines += [f"{toml_key(k)} = {toml_value(v)}" for k, v in wanted[table].items()]
    return "\n".join(lines) + "\n"


def _changed(block: Sequence[Statement], keys: Mapping[str, Any]) -> list[Statement]:
    """Return the statements of one experiment with other values; those that say the same stay letter for letter."""
    found = list(block)
    table = _experiment_of(block)
    for key in (k for k in (*PLAIN, *TABLES) if k in keys):
        wanted = None if keys[key] == {} else keys[key]
        if _same(table.get(key), wanted):
            continue
        own = ("experiment", key)
        if isinstance(wanted, Mapping) and any(s.header == own for s in found) and not _deeper(found, own):
            found = _changed_table(found, own, wanted)
        else:
            found = _replaced(found, key, wanted)
    return found


def _experiment_of(block: Sequence[Statement]) -> dict[str, Any]:
    return dict(tomllib.loads("".join(s.text for s in block))["experiment"][0])


def _deeper(statements: Sequence[Statement], own: tuple[str, ...]) -> bool:
    return any(s.header[:2] == own and len(s.header) > 2 for s in statements)


def _changed_table(block: Sequence[Statement], own: tuple[str, ...], wanted: Mapping[str, Any]) -> list[Statement]:
    """Return the statements with other lines below the header `own`; the lines that stay keep their order and comments."""
    found: list[Statement] = []
    header: tuple[str, ...] = ()
    left = dict(wanted)
    last = 0
    for s in block:
        header = s.header or header
        if header == own and s.path:
            value = tomllib.loads(s.text)[s.path[0]]
            if s.path[0] not in left:
                continue
            new = left.pop(s.path[0])
            s = s if value == new else replace(s, text=_pair(s.path[0], new, s.text))
        found.append(s)
        if header == own and (s.header or s.path):
            last = len(found)
    return [*found[:last], *(Statement(_pair(k, v)) for k, v in left.items()), *found[last:]]


def _replaced(block: Sequence[Statement], key: str, wanted: Any) -> list[Statement]:
    """Return the statements with one that states the key among the plain ones, and without any other that does."""
    found: list[Statement] = []
    header: tuple[str, ...] = ()
    place = 1  # behind the header of the experiment
    done = wanted is None
    for s in block:
        header = s.header or header
        if header[:2] == ("experiment", key):
            if s.header or s.path:
                continue
        elif header == ("experiment",) and s.path[:1] == (key,):
            if done:
                continue
            s, done = Statement(_pair(key, wanted, s.text)), True
        found.append(s)
        if header == ("experiment",) and (s.header or s.path):
            place = len(found)
    return found if done else [*found[:place], Statement(_pair(key, wanted)), *found[place:]]


def _pair(key: str, value: Any, old: str = "") -> str:
    """Return the line of a key, with the comment that stood behind its old value."""
    return f"{toml_key(key)} = {toml_value(value)}{_comment(old)}\n"


def _comment(statement: str) -> str:
    """Return the comment behind a value with the blanks before it: the first # without which the statement says the same."""
    body = statement.rstrip("\n")
    for k, letter in enumerate(body):
        if letter == "#":
            try:
                if tomllib.loads(body[:k]) == tomllib.loads(body):
                    value = body[:k].rstrip()
                    return body[len(value) :] if "\n" not in body[k:] else ""
            except tomllib.TOMLDecodeError:
                continue  # this one stands in a text
    return ""


def _as_table(value: Any) -> Any:
    return {name: name for name in value} if isinstance(value, list) and value and isinstance(value[0], str) else value


def _same(old: Any, new: Any) -> bool:
    return bool(_as_table(old) == _as_table(new))


def _check(before: Mapping[str, Any], changed: str, name: str, keys: Mapping[str, Any], where: str) -> None:
    """Raise StudyError where a changed text does not say what was meant, or says anything else than before."""
    meant = dict(before)
    experiments = [dict(e) for e in before.get("experiment", ())]
    place = next((k for k, e in enumerate(experiments) if e.get("name") == name), len(experiments))
    old = experiments[place] if place < len(experiments) else {}
    new = {k: v for k, v in {**old, **keys}.items() if v is not None and v != {}}
    meant["experiment"] = [*experiments[:place], new, *experiments[place + 1 :]]
    try:
        found = tomllib.loads(changed)
        told = _normal(found) == _normal(meant)
    except tomllib.TOMLDecodeError:
        told = False
    if not told:
        raise StudyError(
            f"experiment '{name}' cannot be changed in this file without touching the rest",
            where=where,
            expected="a table [[experiment]] with a key a line",
            hint="write the experiment as [[experiment]] in an editor; the file is as it was",
        )


def _normal(study: Mapping[str, Any]) -> dict[str, Any]:
    """Return the study with lists of names as the tables they stand for."""
    experiments = [
        {k: _as_table(v) if k in TABLES else v for k, v in e.items()} if isinstance(e, dict) else e
        for e in study.get("experiment", ())
    ]
    return {**study, "experiment": experiments}
