"""Finished work kept in the folder of results, so that a second run does only what is missing.

One sqlite file (write-ahead log) holds bytes by job and key. A job is a hash of all that decides its results: model,
data, settings, code. Every piece is a transaction of its own, which the operating system has when `put` returns: a kill
at any instant loses nothing of it. No disk is waited for, so that costs 17 us of processor time a piece more than many
pieces at a time. The disk has it when the log is merged, every 4 MB and at the end: a power cut may take the last of it,
never the file. One process at a time works in a folder: the operating system's lock, which ends with the process.
"""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import importlib
import itertools
import json
import math
import os
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from hvdc_ident.errors import ComputationError, InputError
from hvdc_ident.executor import Identified, Outcome, TolerantExecutor, in_order
from hvdc_ident.files import digest, make_folder
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.next_step import NextStep

FOLDER, FILE = ".store", "results.sqlite"
MOST_KEYS = 500  # of one query
CHUNK = 4096
"""Items that are looked up, and given to a pool, at a time."""
SCHEMA = 1
PRAGMAS = (
    "page_size = 1024",  # what a small piece writes to the log
    "journal_mode = WAL",
    "synchronous = NORMAL",  # the disk is waited for when the log is merged, not at each piece
    "wal_autocheckpoint = 4000",  # pages, 4 MB
)

_HELD: dict[Path, list[int]] = {}
"""Folders this process holds: [handle, how often it was asked for]."""


@contextmanager
def exclusive(folder: Path) -> Iterator[None]:
    """Keep other processes out of the folder while inside. Made where missing, removed again where left empty.

    Raises InputError where another one does. May be nested within a process. The lock lies on the folder itself and
    ends with the process, however that ends.
    """
    made = not folder.exists()
    make_folder(folder)
    place = folder.resolve()
    if place not in _HELD:
        _HELD[place] = [_locked(place), 0]
    _HELD[place][1] += 1
    try:
        yield
    finally:
        _HELD[place][1] -= 1
        if _HELD[place][1] == 0:
            os.close(_HELD.pop(place)[0])
        if made:
            with contextlib.suppress(OSError):
                folder.rmdir()


def _locked(folder: Path) -> int:
    """A handle that holds the lock of a folder."""
    try:
        import fcntl
    except ImportError:  # not a POSIX system: no lock is taken
        return os.open(os.devnull, os.O_RDONLY)
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise InputError(
            "another run is at work in this folder",
            where=str(folder),
            expected="one run at a time in a folder of results",
            hint="wait for it to end, or end it",
            next=(NextStep("folder"),),
        ) from None
    except OSError:  # a file system without locks
        pass
    return handle


class Store:
    """The kept work of a folder. Use it as a context; inside it the folder is exclusive.

    Raises InputError where the folder cannot be written to, another process works in it, or the file is no store.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / FOLDER / FILE
        self._stack = contextlib.ExitStack()
        self._base: sqlite3.Connection | None = None
        self._folder = folder

    def __enter__(self) -> Store:
        self._stack.enter_context(exclusive(self._folder))
        try:
            make_folder(self.path.parent)
            self._base = self._connected()
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        try:
            if self._base is not None:
                with self._clear():
                    self._base.close()
        finally:
            self._base = None
            self._stack.close()

    def job(self, *parts: str) -> Job:
        """The part of the store for one kind of work; parts: texts that decide its results, beside the code."""
        return Job(self, digest("\n".join([code_version(), *parts]).encode()))

    def _connected(self) -> sqlite3.Connection:
        with self._clear():
            base = sqlite3.connect(self.path, isolation_level=None)
            try:
                for pragma in PRAGMAS:
                    base.execute(f"PRAGMA {pragma}")
                version = base.execute("PRAGMA user_version").fetchone()[0]
                if version not in (0, SCHEMA):
                    raise InputError("the store is of another version", where=str(self.path), hint="remove this file")
                base.execute(
                    "CREATE TABLE IF NOT EXISTS kept (job TEXT, key BLOB, value BLOB, PRIMARY KEY (job, key)) WITHOUT ROWID"
                )
                base.execute(f"PRAGMA user_version = {SCHEMA}")
            except BaseException:
                base.close()
                raise
        return base

    @contextmanager
    def _clear(self) -> Iterator[None]:
        """Raise a database error inside as an InputError."""
        try:
            yield
        except sqlite3.DatabaseError as e:
            text, hint, steps = str(e), "", tuple[NextStep, ...]()
            if "is full" in text or "disk I/O" in text:
                hint = "free some space; what was kept is intact, and the same command goes on from there"
            elif "readonly" in text or "unable to open" in text:
                steps = (NextStep("folder"),)
            else:
                hint = "remove this file: what it keeps can be computed again"
            raise InputError(f"the store cannot be used: {text}", where=str(self.path), hint=hint, next=steps) from None

    def execute(self, statement: str, values: Sequence[Any]) -> list[Any]:
        """Return the rows of an SQL statement. Raises InputError where the store cannot be used."""
        assert self._base is not None
        with self._clear():
            return self._base.execute(statement, values).fetchall()


class Job:
    """Bytes by key of one kind of work in a store."""

    def __init__(self, store: Store, name: str) -> None:
        self._store, self.name = store, name

    def get(self, keys: Sequence[bytes]) -> Mapping[bytes, bytes]:
        """Return what is kept under the keys; a key without a result is missing."""
        kept: dict[bytes, bytes] = {}
        for start in range(0, len(keys), MOST_KEYS):
            part = keys[start : start + MOST_KEYS]
            marks = ",".join("?" * len(part))
            select = f"SELECT key, value FROM kept WHERE job = ? AND key IN ({marks})"
            kept.update((bytes(k), bytes(v)) for k, v in self._store.execute(select, [self.name, *part]))
        return kept

    def put(self, key: bytes, value: bytes) -> None:
        """Keep the value: a kill of this process at any instant afterwards does not lose it."""
        self._store.execute("INSERT OR REPLACE INTO kept VALUES (?, ?, ?)", (self.name, key, value))


class CachingExecutor:
    """The `map` and `run` of a pool, or of this process where there is none, whose results are kept and not computed again.

    A stage does the same work in the same order whenever it is given the same study, seed and software, whatever executor
    it has. So the place of an item in that order, with a digest of the item itself where it has one, is its key. by_item: the key is
    the digest of the item and of the function's `identity`, a value that decides its results, whatever else is done; so work goes on
    where the study asks for more of the same.
    """

    def __init__(self, job: Job, pool: TolerantExecutor | None = None, *, by_item: bool = False) -> None:
        self._job, self._pool, self._calls, self._by_item = job, pool, 0, by_item

    def map(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Any]:
        """Return the function's results in the items' order, those of an earlier run not computed again.

        Raises ComputationError where an item has no result in the pool; in this process, what the function raises.
        """
        return in_order(self.run(function, items))

    def run(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Outcome]:
        """Yield the outcome of each item, as they come. Raises, in this process, what the function raises."""
        self._calls += 1
        key_of = self._keys(function)
        source, begun = iter(items), 0
        while chunk := list(itertools.islice(source, CHUNK)):
            keys = [key_of(begun + index, item) for index, item in enumerate(chunk)]
            for outcome in self._outcomes(function, chunk, keys):
                yield replace(outcome, index=begun + outcome.index)
            begun += len(chunk)

    def _keys(self, function: Callable[[Any], Any]) -> Callable[[int, Any], bytes]:
        """Return the function that gives an item its key, by its place and content."""
        if self._by_item:
            assert isinstance(function, Identified)
            work = _short_digest(function.identity)
            return lambda index, item: f"{work}/{_short_digest(item)}".encode()
        call = self._calls
        return lambda index, item: f"{call}/{index}/{_item_digest(item)}".encode()

    def _outcomes(self, function: Callable[[Any], Any], items: list[Any], keys: list[bytes]) -> Iterator[Outcome]:
        stored = self._job.get(keys)
        yield from (Outcome(index, unpacked(stored[key])) for index, key in enumerate(keys) if key in stored)
        missing = [index for index, key in enumerate(keys) if key not in stored]
        todo = [items[index] for index in missing]
        if self._pool is not None and len(missing) > 1:
            outcomes = self._pool.run(function, todo)
        else:
            outcomes = (Outcome(k, function(item)) for k, item in enumerate(todo))
        for outcome in outcomes:
            index = missing[outcome.index]
            if not outcome.failure:
                self._put(keys[index], outcome.value)
            yield replace(outcome, index=index)

    def _put(self, key: bytes, value: Any) -> None:
        try:
            content = packed(value)
        except TypeError as error:
            raise ComputationError("a result cannot be kept", got=str(error)) from None
        self._job.put(key, content)


def _item_digest(item: Any) -> str:
    """Return a digest of an item, so that a result is never taken for another's; empty where it has no text form."""
    try:
        return _short_digest(item)
    except TypeError:
        return ""


def _short_digest(value: Any) -> str:
    """Return a digest of 64 bits. Raises TypeError where the value has no text form."""
    return digest(_text(value, _array_digest))[:16]


@cache
def code_version() -> str:
    """A hash of the package's source and of the versions of what its numbers rest on."""
    parts = [source_hash()]
    for name in ("numpy", "scipy", "sympy", "llvmlite"):
        with contextlib.suppress(metadata.PackageNotFoundError):
            parts.append(f"{name} {metadata.version(name)}")
    return digest("\n".join(parts).encode())


@cache
def source_hash() -> str:
    """A hash of the package's own source: another state of it may find other numbers."""
    root = Path(__file__).resolve().parents[1]
    files = sorted(p for p in root.rglob("*.py"))
    return digest("\n".join(f"{p.relative_to(root).as_posix()} {digest(p.read_bytes())}" for p in files).encode())


_OfArray = Callable[["np.ndarray[Any, Any]", bool], dict[str, Any]]
PACKAGE = "hvdc_ident"
_KIND = "!"


def packed(value: Any) -> bytes:
    """The value as bytes. Raises TypeError for what is no number, text, array, collection or dataclass of here."""
    return _text(value, _array)


def _text(value: Any, array: _OfArray) -> bytes:
    return json.dumps(_plain(value, array), ensure_ascii=False, separators=(",", ":")).encode()


def unpacked(content: bytes) -> Any:
    """The value again. Raises ComputationError where the bytes are none that `packed` made, or one of another release did."""
    try:
        return _value(json.loads(content))
    except (ValueError, KeyError, TypeError, IndexError, ImportError) as error:
        raise ComputationError(
            "a kept result cannot be read", got=f"{type(error).__name__}: {error}", hint="remove the folder .store"
        ) from None


def _plain(value: Any, array: _OfArray) -> Any:
    """The value as JSON holds it, each of its arrays as `array` gives it."""
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, int) and not isinstance(value, np.generic):
        return value
    if isinstance(value, float) and not isinstance(value, np.generic):
        return value if math.isfinite(value) else {_KIND: "f", "v": repr(value)}
    if isinstance(value, bytes):
        return {_KIND: "b", "v": base64.b64encode(value).decode()}
    if isinstance(value, complex) and not isinstance(value, np.generic):
        return {_KIND: "c", "v": [_plain(value.real, array), _plain(value.imag, array)]}
    if isinstance(value, np.ndarray | np.generic):
        return array(np.asarray(value), isinstance(value, np.generic))
    if isinstance(value, list):
        return [_plain(v, array) for v in value]
    if isinstance(value, tuple):
        return {_KIND: "t", "v": [_plain(v, array) for v in value]}
    if isinstance(value, Mapping):
        kind = "m" if isinstance(value, FrozenMap) else "d"
        return {_KIND: kind, "v": [[_plain(k, array), _plain(v, array)] for k, v in value.items()]}
    if dataclasses.is_dataclass(value) and type(value).__module__.split(".")[0] == PACKAGE:
        made = {f.name: _plain(getattr(value, f.name), array) for f in dataclasses.fields(value) if f.init}
        return {_KIND: "o", "of": f"{type(value).__module__}:{type(value).__qualname__}", "v": made}
    raise TypeError(f"{type(value).__module__}.{type(value).__qualname__} cannot be kept")


def _array(value: np.ndarray[Any, Any], scalar: bool) -> dict[str, Any]:
    return _described(value, scalar, base64.b64encode(_content(value)).decode())


def _array_digest(value: np.ndarray[Any, Any], scalar: bool) -> dict[str, Any]:
    """As `_array`, the content by its digest only: the text of many megabytes takes longer than what is kept for it."""
    return _described(value, scalar, digest(_content(value)))


def _content(value: np.ndarray[Any, Any]) -> bytes:
    if value.dtype.kind not in "biufc":
        raise TypeError(f"an array of {value.dtype} cannot be kept")
    return np.ascontiguousarray(value).tobytes()


def _described(value: np.ndarray[Any, Any], scalar: bool, content: str) -> dict[str, Any]:
    return {_KIND: "s" if scalar else "a", "type": value.dtype.str, "shape": list(value.shape), "v": content}


def _value(plain: Any) -> Any:
    if isinstance(plain, list):
        return [_value(v) for v in plain]
    if not isinstance(plain, dict):
        return plain
    kind, content = plain[_KIND], plain["v"]
    if kind == "f":
        return float(content)
    if kind == "b":
        return base64.b64decode(content, validate=True)
    if kind == "c":
        return complex(*map(_value, content))
    if kind in "as":
        array = (
            np.frombuffer(base64.b64decode(content, validate=True), np.dtype(plain["type"]))
            .reshape(plain["shape"])
            .copy()
        )
        return array[()] if kind == "s" else array
    if kind == "t":
        return tuple(map(_value, content))
    if kind in "md":
        mapping = {_value(k): _value(v) for k, v in content}
        return FrozenMap(mapping) if kind == "m" else mapping
    if kind == "o":
        return _class(plain["of"])(**{name: _value(v) for name, v in content.items()})
    raise ValueError(f"no kind '{kind}'")


@cache
def _class(name: str) -> Any:
    """A dataclass of this package by module and name; ValueError for anything else."""
    module, _, qualified = name.partition(":")
    if module.split(".")[0] != PACKAGE or "." in qualified:
        raise ValueError(f"'{name}' is no class of {PACKAGE}")
    cls = getattr(importlib.import_module(module), qualified, None)
    if not (isinstance(cls, type) and dataclasses.is_dataclass(cls) and cls.__module__ == module):
        raise ValueError(f"'{name}' is no dataclass of {PACKAGE}")
    return cls
