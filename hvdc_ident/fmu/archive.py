"""An FMU's archive: checked before anything of it is run, its XML, and the folder that it is unpacked into.

The checks, and the process that the FMU runs in, contain accidents: damaged archives, crashes, endless loops. They do
not contain malice: load only FMUs you trust.

The folder is shared by the processes that use the FMU and removed with the last of them. Each holds a lock on a file in
it, which the system releases however the process ends. Whoever can lock that file alone removes the folder: the pool of
workers when it closes, its supervisor where the pool's process was killed, and the next pool where both were killed.
"""

from __future__ import annotations

import contextlib
import lzma
import os
import re
import shutil
import stat
import tempfile
import zipfile
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal
from xml.etree import ElementTree

from hvdc_ident.errors import ModelError

MOST_ENTRIES = 10_000  # in an archive
MOST_BYTES = 2**30  # unpacked
MOST_RATIO = 200  # of unpacked to packed bytes; a zip bomb reaches 1000
MOST_LEVELS = 100  # of elements in each other; a description has six
MOST_XML = 64 * 2**20  # bytes of a model description; a hundred thousand variables take half of it
DESCRIPTION = "modelDescription.xml"
BUILDS = "sources/buildDescription.xml"
ROOTS = {DESCRIPTION: "fmiModelDescription", BUILDS: "fmiBuildDescription"}
"""Files that are read as XML, and the elements that they are."""
DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    NotImplementedError,
    RuntimeError,
    EOFError,
    OSError,
    ValueError,
)
"""Errors that reading a damaged archive raises."""


def check_archive(path: Path) -> tuple[str, ...]:
    """Check that an archive may be unpacked; return the names in it. Raises ModelError where it may not."""
    with _opened(path) as archive:
        entries = archive.infolist()
        if len(entries) > MOST_ENTRIES:
            raise _refused(path, "the FMU has too many files", f"at most {MOST_ENTRIES}", str(len(entries)))
        for entry in entries:
            _check_entry(path, entry)
        total, packed = sum(e.file_size for e in entries), max(path.stat().st_size, 1)
        if total > MOST_BYTES:
            raise _refused(path, "the FMU unpacks to too much", f"at most {MOST_BYTES} bytes", f"{total} bytes")
        if total > MOST_RATIO * packed:
            raise _refused(
                path,
                "the FMU looks like a zip bomb",
                f"at most {MOST_RATIO} times its size",
                f"{total / packed:.0f} times",
            )
    names = tuple(dict.fromkeys(e.filename for e in entries))
    _check_doubles(path, entries)
    if DESCRIPTION not in names:
        raise _refused(path, "the archive is no FMU", f"a file {DESCRIPTION} in it", ", ".join(names[:5]) or "nothing")
    return names


def check_identifier(path: Path, identifier: str | None) -> str:
    """Return a model identifier that is a plain file name. Raises ModelError for any other.

    The standard asks for an identifier of C, which not every tool exports; only the library's name is made of it.
    """
    if identifier is None or not re.fullmatch(r"\w[\w .-]*", identifier):
        raise _refused(
            path,
            "the model identifier is no name of a file",
            "letters, digits, '_', '-', '.' and blanks, a letter, a digit or '_' first",
            repr(identifier)[:80],
        )
    return identifier


def machine_of(library: bytes) -> str:
    """Return the machine that a shared library is for, "x86_64 Linux", by its first bytes; "" where these do not tell.

    ELF: bytes 4 (1: 32 bits, 2: 64 bits) and 18 (the machine) of its header; Windows begins with MZ, macOS with Mach-O.
    """
    if library[:4] == b"\x7fELF" and len(library) >= 20:
        bits = {1: 32, 2: 64}.get(library[4], 0)
        order: Literal["little", "big"] = "big" if library[5] == 2 else "little"
        number = int.from_bytes(library[18:20], order)
        known = {3: "x86", 62: "x86_64", 40: "arm", 183: "aarch64", 243: "riscv"}
        return f"{known.get(number, f'machine {number}')} Linux, {bits} bits"
    if library[:2] == b"MZ":
        return "Windows"
    return "macOS" if library[:4] in (b"\xcf\xfa\xed\xfe", b"\xca\xfe\xba\xbe", b"\xce\xfa\xed\xfe") else ""


def first_bytes(path: Path, name: str, count: int = 64) -> bytes:
    """Return the first bytes of a file in the archive. Raises ModelError where it is damaged."""
    try:
        with _opened(path) as archive, archive.open(name) as file:
            return file.read(count)
    except (*DAMAGE, KeyError) as e:
        raise _damaged(path, name, e) from None


def unpack(path: Path, folder: Path) -> None:
    """Unpack a checked archive into the folder. Raises ModelError where a file is damaged."""
    with _opened(path) as archive:
        for entry in archive.infolist():
            target = folder.joinpath(*PurePosixPath(_plain(entry.filename)).parts)
            try:
                if entry.is_dir():
                    target.mkdir(parents=True, exist_ok=True)
                    continue
                target.parent.mkdir(parents=True, exist_ok=True)
                with archive.open(entry) as source, target.open("wb") as sink:
                    while block := source.read(1 << 20):
                        sink.write(block)
            except DAMAGE as e:
                raise _damaged(path, entry.filename, e) from None


def _damaged(path: Path, name: str, error: Exception) -> ModelError:
    return ModelError(f"'{name[:80]}' in the FMU cannot be unpacked: {_said(error)}", where=str(path))


def _said(error: Exception) -> str:
    """Return the reason of an error, without the folder that it was unpacked to."""
    return (error.strerror or type(error).__name__) if isinstance(error, OSError) else str(error)


def _opened(path: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path)
    except FileNotFoundError:
        raise ModelError("the model file is not there", where=str(path)) from None
    except OSError as e:
        raise ModelError(f"the file cannot be read: {(e.strerror or str(e)).lower()}", where=str(path)) from None
    except DAMAGE as e:
        why = str(e).removeprefix("File is not a zip file")
        raise ModelError(
            f"the file is no zip archive{f': {why}' if why else ''}", where=str(path), expected="an FMU, which is one"
        ) from None


def _check_entry(path: Path, entry: zipfile.ZipInfo) -> None:
    name = _plain(entry.filename)
    parts = PurePosixPath(name).parts
    if name.startswith("/") or re.match(r"[A-Za-z]:", name) or ".." in parts or not parts or "\0" in name:
        raise _refused(
            path, "a path in the FMU leads out of it", "paths below its top folder", repr(entry.filename)[:80]
        )
    kind = stat.S_IFMT(entry.external_attr >> 16)
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        what = "a link" if kind == stat.S_IFLNK else "neither a file nor a folder"
        raise _refused(path, f"'{entry.filename}' in the FMU is {what}", "plain files", "")
    if entry.flag_bits & 1:
        raise _refused(path, f"'{entry.filename}' in the FMU is encrypted", "plain files", "")


def _check_doubles(path: Path, entries: Iterable[zipfile.ZipInfo]) -> None:
    """Raise ModelError where two files of one name differ and one of them is run, read by the FMU, or parsed.

    Anywhere else, as in `extra`, the last one counts, as it does for every unzip.
    """
    seen: dict[str, tuple[int, int]] = {}
    for entry in entries:
        name, content = _plain(entry.filename), (entry.file_size, entry.CRC)
        used = name in ROOTS or name.startswith(("binaries/", "resources/"))
        if used and seen.setdefault(name, content) != content:
            raise _refused(path, "the FMU has two different files of one name", "one of each", name)


def _plain(name: str) -> str:
    """Return the name with the slashes of the zip standard; some tools write backslashes."""
    return name.replace("\\", "/")


def parsed(path: Path, name: str) -> ElementTree.Element:
    """Return the root of an XML file in a checked archive.

    Raises ModelError where it is too large or deep, not well-formed, another document, or has a DOCTYPE, which could
    define entities.
    """
    where = f"{path}, {name}"
    parser = ElementTree.XMLParser(target=_CheckedTree(where, ROOTS[name]))
    try:
        with _opened(path) as archive:
            size = archive.getinfo(name).file_size
            if size > MOST_XML:
                limit = f"at most {MOST_XML} bytes"
                raise ModelError("the XML is too large", where=where, expected=limit, got=f"{size} bytes")
            with archive.open(name) as source:
                while block := source.read(1 << 16):
                    parser.feed(block)
        root: ElementTree.Element = parser.close()
    except ElementTree.ParseError as e:
        raise ModelError(f"the XML is not well-formed: {e}", where=where) from None
    except (*DAMAGE, LookupError) as e:
        raise ModelError(f"the XML cannot be read: {e}", where=where) from None
    return root


class _CheckedTree(ElementTree.TreeBuilder):
    """Maker of a tree that refuses what no FMU needs."""

    def __init__(self, where: str, root: str) -> None:
        super().__init__()
        self._where, self._root, self._depth = where, root, 0

    def doctype(self, *_: object) -> None:
        hint = "none: no FMU needs one, and entity bombs come that way"
        raise ModelError("the XML has a DOCTYPE", where=self._where, expected=hint)

    def start(self, tag: str, attrs: dict[str, str]) -> ElementTree.Element:
        self._depth += 1
        if self._depth == 1 and tag != self._root:
            raise ModelError("the XML is another document", where=self._where, expected=self._root, got=tag[:80])
        if self._depth > MOST_LEVELS:
            limit = f"at most {MOST_LEVELS} levels"
            raise ModelError("the XML is nested too deep", where=self._where, expected=limit)
        return super().start(tag, attrs)

    def end(self, tag: str) -> ElementTree.Element:
        self._depth -= 1
        return super().end(tag)


def _refused(path: Path, what: str, expected: str, got: str) -> ModelError:
    return ModelError(what, where=str(path), expected=expected, got=got)


PREFIX = "hvdc_ident_fmu_"
LOCK = "in-use.lock"


@dataclass(eq=False)
class Folder:
    """An unpacked FMU. lock: the descriptor of its lock, shared with the processes that inherit it."""

    path: Path
    lock: int

    @property
    def binaries(self) -> Path:
        """Folder with the archive's files."""
        return self.path / "fmu"

    def release(self) -> None:
        """Stop using it; remove it where nobody else uses it."""
        if self.lock < 0:
            return
        with contextlib.suppress(OSError):
            if _alone(self.lock):
                shutil.rmtree(self.path, ignore_errors=True)
        os.close(self.lock)
        self.lock = -1

    def disown(self) -> None:
        """Forget it in a process that was forked from one that uses it."""
        if self.lock >= 0:
            os.close(self.lock)
            self.lock = -1


def unpacked_folder(archive: Path) -> Folder:
    """Return a new folder with the archive's content. Folders that killed processes left behind are removed."""
    remove_abandoned_folders()
    path = Path(tempfile.mkdtemp(prefix=PREFIX))
    held = path / f"{LOCK}.new"  # renamed once it is held: before, it would count as abandoned
    lock = os.open(held, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    _share(lock)
    held.rename(path / LOCK)
    folder = Folder(path, lock)
    try:
        folder.binaries.mkdir()
        unpack(archive, folder.binaries)
    except BaseException:
        folder.release()
        raise
    return folder


def shared_folder(path: Path) -> Folder | None:
    """Return the folder of another process, to be shared with it; None where it is removed or being removed."""
    try:
        lock = os.open(path / LOCK, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:
        return None
    try:
        _share(lock)
        if os.fstat(lock).st_uid == os.getuid() and os.path.samestat(os.fstat(lock), os.stat(path / LOCK)):
            return Folder(path, lock)
    except OSError:
        pass  # the last user is just removing it
    os.close(lock)
    return None


def remove_abandoned_folders() -> None:
    """Remove the folders whose users have all ended without removing them."""
    for lock in Path(tempfile.gettempdir()).glob(f"{PREFIX}*/{LOCK}"):
        with contextlib.suppress(OSError):  # another user's, or being removed
            Folder(lock.parent, os.open(lock, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)).release()


def _share(lock: int) -> None:
    """Take the lock beside others. Raises OSError where another process holds it alone."""
    import fcntl

    fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)


def _alone(lock: int) -> bool:
    """Take the lock alone; return whether nobody else holds it."""
    import fcntl

    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
