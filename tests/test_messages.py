"""Messages of the library name arguments and keys of TOML; the words of the shell are added where a command is read."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import hvdc_ident as hi
from hvdc_ident.errors import InputError
from hvdc_ident.next_step import ON_DASK, NextStep, next_phrase
from hvdc_ident.study.executors import check_executor

PACKAGE = Path(hi.__file__).parent
SPEAK_TO_THE_SHELL = ("cli.py", "command.py", "run_commands.py", "next_step.py", "app/", "report/", "summary/")
"""Views and commands, and the one table of words."""
WRITE_FOR_THE_SHELL = (
    "study/examples.py", "study/new_study.py", "study/schema.py", "study/value_files.py",  # comments in files, and a file's reference
    "study/stages/", "study/summary.py",  # screens of commands
    "study/dask_executor.py",  # a command of dask's
    "text.py",  # patterns of commands
)  # fmt: skip
SHELL = re.compile(r"(?<![-\w,])--(?!force-reinstall)[a-z]{2}|hvdc-ident [a-z]+")  # pip has options of its own


def strings(path: Path) -> Iterator[ast.Constant]:
    """The texts of a module that are no docstrings."""
    tree = ast.parse(path.read_text("utf-8"))
    alone = {id(n.value) for n in ast.walk(tree) if isinstance(n, ast.Expr)}
    yield from (
        n for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str) and id(n) not in alone
    )


def test_no_message_of_the_library_speaks_of_a_command() -> None:
    found = []
    for path in PACKAGE.rglob("*.py"):
        name = path.relative_to(PACKAGE).as_posix()
        if not name.startswith((*SPEAK_TO_THE_SHELL, *WRITE_FOR_THE_SHELL)):
            found += [f"{name}:{s.lineno}: {s.value}" for s in strings(path) if SHELL.search(s.value)]
    assert not found, "\n".join(found)


def test_an_argument_is_named_as_it_is_given() -> None:
    step = NextStep("option", "source_only = True", "writes the sources alone")
    assert next_phrase(step, "shell") == "`--source-only` writes the sources alone"
    assert next_phrase(step, "python") == "`source_only=True` writes the sources alone"
    assert next_phrase(step, "page") == "`source_only = True` writes the sources alone"
    assert next_phrase(ON_DASK, "shell").startswith("`--executor dask://HOST:PORT` ")
    assert next_phrase(ON_DASK, "python").startswith('`executor="dask://HOST:PORT"` ')


def test_a_wrong_executor_is_told_in_the_words_of_the_reader() -> None:
    with pytest.raises(InputError) as caught:
        check_executor("spark://h:1")
    assert str(caught.value.read_in("python")).endswith("does it where a `dask scheduler` runs")
    assert "`workers=2` does the work on this machine" in str(caught.value) and "--" not in str(caught.value)
    assert "`--workers 2`" in str(caught.value.read_in("shell"))
