"""The files of one study as the page uses them: recordings that are dropped and chosen, and the study file, which is the truth.

Nothing outside the study's folder is written or can be chosen. The study file is written whole, and only where it is still as it
was read: of two browsers the second is told.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from hvdc_ident.data import Trajectory
from hvdc_ident.errors import InputError, StudyError
from hvdc_ident.files import digest, make_folder, write_text
from hvdc_ident.formats import files_of, formats, read_waveforms

MOST_BYTES = 512 * 1024**2
"""Largest upload: a recording of 1e6 rows and 20 signals as text."""
LONGEST_NAME = 100
"""Characters of a file name; file systems take 255 bytes, and a character has up to 4."""
DEEPEST = 2
"""Folders below the study's in which recordings are looked for."""

_WRITING = threading.RLock()


@dataclass(frozen=True)
class Seen:
    """A study file as it was when it was read; text None where there was none."""

    path: Path
    text: str | None

    @classmethod
    def now(cls, path: Path) -> Seen:
        """Return the file as it is. Raises StudyError where it cannot be read as text."""
        try:
            return cls(path, path.read_bytes().decode("utf-8"))
        except FileNotFoundError:
            return cls(path, None)
        except (OSError, UnicodeDecodeError) as error:
            raise StudyError("the study file cannot be read", where=path.name, got=str(error)) from None

    @property
    def digest(self) -> str:
        """The hash of the text; "" where there is none."""
        return "" if self.text is None else digest(self.text.encode())


def stamp(path: Path) -> tuple[int, int, int] | None:
    """Return what tells cheaply that a file is another one than before; None where there is none."""
    try:
        stat = path.stat()
    except OSError:
        return None
    return stat.st_mtime_ns, stat.st_size, stat.st_ino


def write_study(seen: Seen, text: str) -> Seen:
    """Write a study file that still is as it was seen, whole or not at all, and return it as it is then.

    Raises StudyError where it was changed or removed since, or made where there was none.
    """
    with _alone(make_folder(seen.path.parent)):
        now = Seen.now(seen.path)
        if now != seen:
            what = "was removed" if now.text is None else "was made" if seen.text is None else "was changed"
            raise StudyError(
                f"the file {what} by someone else since this page read it; nothing was written",
                where=seen.path.name,
                hint="'Keep mine' writes this recording into the file as it is now, 'Show the file's' drops what was changed here",
            )
        write_text(seen.path, text)
        return Seen(seen.path, text)


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Let no other thread, and on POSIX no other workbench, write studies into the folder meanwhile."""
    with _WRITING:
        try:
            import fcntl
        except ImportError:
            yield
            return
        handle = os.open(folder, os.O_RDONLY)
        try:
            with contextlib.suppress(OSError):  # a file system without locks
                fcntl.flock(handle, fcntl.LOCK_EX)
            yield
        finally:
            os.close(handle)


def safe_name(name: str) -> str:
    """Return a file name without folders, control characters and leading dots. Raises InputError where nothing is left."""
    last = re.split(r"[\\/]", name)[-1]
    clean = re.sub(r"[^\w .+-]", "-", last).strip(" .").lstrip("+-")
    stem, dot, ending = clean.rpartition(".")
    if dot and len(ending) < LONGEST_NAME // 2:
        clean = f"{stem[: LONGEST_NAME - 1 - len(ending)].rstrip(' .')}.{ending}"
    clean = clean[:LONGEST_NAME]
    if not clean.rpartition(".")[0 if "." in clean else 2]:
        raise InputError("the file has no usable name", where=repr(name[:80]), expected="a name like step.csv")
    return clean


def keep_recordings(folder: Path, arrived: Path) -> tuple[list[str], Trajectory]:
    """Move recordings that arrived in a folder of their own into the study's, and return their paths from there.

    Each is read first, and one that cannot be read is not kept; the waveforms of the first are returned too. A file of
    the same name and content that is there already is used; of another content, the new one goes into a folder of its own.
    Raises InputError: the message of the reader.
    """
    kept: list[str] = []
    first: Trajectory | None = None
    done: set[Path] = set()
    for file in sorted(arrived.iterdir(), key=lambda p: (p.suffix.lower() not in _endings(), p.suffix.lower(), p.name)):
        if file in done:
            continue
        try:
            record = read_waveforms(file)
            group = files_of(file)
        except InputError as error:
            raise _without_folder(error, arrived) from None
        done |= set(group)
        kept.append(_moved(folder, group))
        first = first or record
    if first is None:
        raise InputError("no file arrived", where="the upload", hint="drop the file once more")
    return kept, first


def _endings() -> tuple[str, ...]:
    return tuple(s for f in formats().values() for s in f.SUFFIXES)


def _without_folder(error: InputError, folder: Path) -> InputError:
    """Return the error with names of files in place of their paths in a folder that a reader of the page does not know."""
    texts = (error.what, error.where, error.expected, error.got, error.hint)
    what, where, expected, got, hint = (t.replace(f"{folder}{os.sep}", "") for t in texts)
    return type(error)(what, where=where, expected=expected, got=got, hint=hint)


def _moved(folder: Path, group: Sequence[Path]) -> str:
    """Return the path, from the study's folder, of the first of some files that are there now."""
    with _alone(make_folder(folder)):
        stem, number = group[0].stem, 1
        target = folder
        while any((target / f.name).exists() and not _alike(f, target / f.name) for f in group) or (
            number > 1 and target.exists() and not target.is_dir()
        ):
            number += 1
            target = folder / f"{stem}-{number}"
        make_folder(target)
        for file in group:
            if not (target / file.name).exists():
                part = target / f".{file.name}.part"
                shutil.move(file, part)
                part.replace(target / file.name)
        return (target / group[0].name).relative_to(folder).as_posix()


def _alike(one: Path, other: Path) -> bool:
    return one.stat().st_size == other.stat().st_size and one.read_bytes() == other.read_bytes()


def recordings_in(folder: Path) -> list[str]:
    """Return the files in the study's folder that may be recordings, by their endings, as paths from there.

    Folders of results, and those whose names begin with a dot, are left out.
    """
    endings = _endings()
    paths = []
    for place, folders, files in os.walk(folder):
        here = Path(place)
        folders[:] = [f for f in folders if not f.endswith("-results") and not f.startswith(".")]
        if len(here.relative_to(folder).parts) >= DEEPEST:
            folders.clear()
        paths += [here / f for f in files if Path(f).suffix.lower() in endings and not f.startswith(".")]
    return sorted(p.relative_to(folder).as_posix() for p in paths)


def chosen_recording(folder: Path, name: str) -> Path:
    """Return the path of a recording in the study's folder. Raises InputError for one that lies elsewhere, links followed."""
    path = folder / name
    inside = folder.resolve()
    if not path.resolve().is_relative_to(inside):
        raise InputError(
            "a recording outside the study's folder",
            where=name[:200],
            expected=f"a file in {inside.name}",
            hint="drop the file on the page, which copies it there",
        )
    return path
