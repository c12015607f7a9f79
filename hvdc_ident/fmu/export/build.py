"""The binary of an exported FMU: the C compiler where there is one."""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from hvdc_ident.errors import ComputationError

COMPILERS = ("cc", "gcc", "clang")
FLAGS = ("-std=c99", "-O2", "-fPIC", "-shared", "-fvisibility=hidden")
SECONDS = 600


def compiler() -> list[str] | None:
    """The C compiler's command: what CC names, else the first of cc, gcc, clang; None where there is none."""
    named = shlex.split(os.environ.get("CC", ""))
    if named:
        return named if shutil.which(named[0]) else None
    found = next((c for c in COMPILERS if shutil.which(c)), None)
    return [found] if found else None


def folder(version: str) -> str:
    """The folder under `binaries` for this machine, as the version of the standard names it."""
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower(), platform.machine().lower())
    system = {"linux": "linux", "darwin": "darwin", "win32": "windows"}.get(sys.platform, sys.platform)
    if version == "2.0" and machine == "x86_64":
        return {"linux": "linux64", "darwin": "darwin64", "windows": "win64"}.get(system, system)
    return f"{machine}-{system}"


def suffix() -> str:
    """Ending of a shared library's name on this system."""
    return {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")


def compiled(command: list[str], sources: Mapping[str, str], identifier: str) -> bytes:
    """The shared library made of the sources ({name: text}); CFLAGS is obeyed.

    Raises ComputationError with the compiler's first words.
    """
    with tempfile.TemporaryDirectory(prefix="hvdc-ident-") as place:
        at = Path(place)
        for name, text in sources.items():
            (at / name).write_text(text, encoding="utf-8")
        library = at / f"{identifier}{suffix()}"
        files = [n for n in sources if n.endswith(".c")]
        line = [*command, *FLAGS, *shlex.split(os.environ.get("CFLAGS", "")), "-o", library.name, *files, "-lm"]
        try:
            run = subprocess.run(line, cwd=at, capture_output=True, text=True, timeout=SECONDS, check=False)
        except (OSError, subprocess.TimeoutExpired) as e:
            raise ComputationError("the C compiler did not run", where=command[0], got=str(e)[:200]) from None
        if run.returncode or not library.is_file():
            got = " ".join(run.stderr.split())[:300]
            raise ComputationError(
                "the C compiler did not accept the FMU's sources",
                where=" ".join(command),
                got=got or f"exit code {run.returncode}",
                hint="set CC to another compiler, or export without a binary",
            )
        return library.read_bytes()
