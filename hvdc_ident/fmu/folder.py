"""The folder that an FMU is unpacked into: shared by the processes that use it, removed with the last of them.

Every process that uses the folder holds a lock on a file in it, which the system takes back however the process ends.
So whoever can have the lock alone removes the folder: the host when it closes, its supervisor where the host was
killed, and where both were killed the next host that unpacks an FMU.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

from hvdc_ident.fmu.archive import unpack

PREFIX = "hvdc_ident_fmu_"
LOCK = "in-use.lock"


@dataclass(eq=False)
class Folder:
    """An unpacked FMU. lock: the descriptor of its lock, shared with the processes that inherit it."""

    path: Path
    lock: int

    @property
    def binaries(self) -> Path:
        """The folder that the archive's top folder became."""
        return self.path / "fmu"

    def release(self) -> None:
        """Use it no more; remove it where nobody else does."""
        if self.lock < 0:
            return
        with contextlib.suppress(OSError):
            if _alone(self.lock):
                shutil.rmtree(self.path, ignore_errors=True)
        os.close(self.lock)
        self.lock = -1

    def disown(self) -> None:
        """Forget it in a process that was forked from a user's: it stays that user's."""
        if self.lock >= 0:
            os.close(self.lock)
            self.lock = -1


def unpacked(archive: Path) -> Folder:
    """A new folder with the archive's content. Folders that killed processes left behind are removed."""
    sweep()
    path = Path(tempfile.mkdtemp(prefix=PREFIX))
    held = path / f"{LOCK}.new"  # under its name only once it is held: before, a sweep would take it for left behind
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


def joined(path: Path) -> Folder | None:
    """The folder of another process, used here too; None where it is not there or about to go."""
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


def sweep() -> None:
    """Remove the folders whose users have all ended without removing them."""
    for lock in Path(tempfile.gettempdir()).glob(f"{PREFIX}*/{LOCK}"):
        with contextlib.suppress(OSError):  # another user's, or being removed
            Folder(lock.parent, os.open(lock, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)).release()


def _share(lock: int) -> None:
    """Hold the lock beside others. Raises OSError where somebody has it alone."""
    import fcntl

    fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)


def _alone(lock: int) -> bool:
    """Return whether nobody else holds the lock, which is then held alone."""
    import fcntl

    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
