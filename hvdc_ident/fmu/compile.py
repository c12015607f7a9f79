"""Shared libraries of FMUs from C sources: those of an export, and those inside an FMU that has no binary for this machine."""

from __future__ import annotations

import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hvdc_ident.errors import ComputationError, InputError, ModelError
from hvdc_ident.fmu.archive import check_archive, check_identifier, unpack
from hvdc_ident.fmu.description import has_sources, parsed

LANGUAGES = {"C89", "C90", "C99", "C11", "C17", "C23"}
SECONDS = 600  # for one binary: Dymola's are a single file of 100 000 lines


def compile_fmu(path: Path, target: Path | None = None) -> Path:
    """Return the path of a new FMU: the old one's content, and binaries of its sources for this machine.

    target: default, the name with "-compiled" beside the old file, which is never changed. The compiler runs, the FMU
    does not. Raises InputError without sources, without a compiler or where the target exists, ComputationError where
    the compiler refuses the sources.
    """
    new = target or path.with_name(f"{path.stem}-compiled.fmu")
    names = check_archive(path)
    if not has_sources(names):
        raise ModelError(
            "the FMU has no C sources to compile", where=str(path), hint="have it exported for this machine"
        )
    if new.exists():
        raise InputError("the new file is there already", where=str(new), hint="use it, or move it away")
    command = compiler()
    if command is None:
        raise InputError("no C compiler is here", where="cc, gcc, clang", hint="install gcc, or set CC to a compiler")
    given = parsed(path)
    with tempfile.TemporaryDirectory(prefix="hvdc-ident-") as place:
        at = Path(place)
        unpack(path, at)
        built = {}
        for configuration in given.buildConfigurations or [_undescribed(given, at / "sources")]:
            identifier = check_identifier(path, configuration.modelIdentifier)
            library = f"binaries/{binary_folder(given.fmiVersion)}/{identifier}{library_suffix()}"
            built[library] = _binary(command, at, configuration.sourceFileSets, path, identifier)
        _write(path, new, built)
    return new


def _undescribed(given: Any, sources: Path) -> Any:
    """Return the build of an FMU that does not describe it: every C file that no other one includes."""
    from fmpy.model_description import BuildConfiguration, SourceFileSet

    files = sorted(sources.glob("*.c"))
    text = "\n".join(f.read_text("utf-8", "replace") for f in files)
    included = set(re.findall(r'^\s*#\s*include\s*"([^"]+)"', text, re.MULTILINE))
    chosen = given.modelExchange or given.coSimulation
    names = [f.name for f in files if f.name not in included]
    return BuildConfiguration(
        modelIdentifier=chosen.modelIdentifier, sourceFileSets=[SourceFileSet(language="C99", sourceFiles=names)]
    )


def _binary(command: list[str], at: Path, sets: list[Any], path: Path, identifier: str) -> bytes:
    """Return the shared library of one identifier."""
    import fmpy

    sources, headers = at / "sources", Path(fmpy.__file__).parent / "c-code"
    if len(sets) != 1 or sets[0].language not in (None, "", *LANGUAGES):
        got = ", ".join(str(s.language) for s in sets) or "no files"
        raise ModelError("the FMU's sources are not C alone", where=str(path), expected="one set of C files", got=got)
    files = [(sources / f).resolve() for f in sets[0].sourceFiles]
    outside = next((f for f in files if not f.is_relative_to(sources.resolve()) or not f.is_file()), None)
    if outside is not None:
        raise ModelError(f"the source file '{outside.name}' is not in the FMU", where=str(path))
    folders = [sources, *(sources / d for d in sets[0].includeDirectories), headers]
    defines = [f"-D{d.name}={d.value or ''}" for d in sets[0].preprocessorDefinitions]
    standard = [f"-std=gnu{sets[0].language[1:]}"] if sets[0].language else []
    library = at / f"{identifier}.library"
    line = [*command, "-shared", "-fPIC", "-O2", "-w", *standard, *defines, *(f"-I{f}" for f in folders),
            *map(str, files), "-lm", "-o", str(library)]  # fmt: skip
    run = _run(line, at, where=shlex.join(command))
    if run.returncode or not library.is_file():
        errors = re.findall(r"error: (.*)", run.stderr) or run.stderr.strip().splitlines() or [f"code {run.returncode}"]
        raise ComputationError(
            "the C compiler refuses the FMU's sources",
            where=str(path),
            got=str(errors[0])[:300],
            hint="its maker knows which headers or compiler they need; else have it exported for this machine",
        )
    return library.read_bytes()


def _run(line: list[str], at: Path, where: str) -> subprocess.CompletedProcess[str]:
    """Return the run of the compiler in a folder, whatever its exit code. Raises ComputationError where it did not run."""
    try:
        return subprocess.run(line, cwd=at, capture_output=True, text=True, timeout=SECONDS, check=False)
    except (OSError, subprocess.TimeoutExpired) as e:
        raise ComputationError("the C compiler did not run", where=where, got=str(e)[:200]) from None


def _write(path: Path, new: Path, built: dict[str, bytes]) -> None:
    """Write the new archive: the old one's files in their order, then the binaries."""
    part = new.with_name(f".{new.name}.part")
    try:
        with zipfile.ZipFile(path) as old, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
            last = {e.filename: e for e in old.infolist()}  # of two entries of one name the last counts
            for entry in last.values():
                if entry.filename not in built:
                    archive.writestr(entry, old.read(entry))  # whole: it was unpacked before
            for name, content in built.items():
                archive.writestr(name, content)
        part.replace(new)
    except OSError as e:
        raise InputError(f"the file cannot be written: {(e.strerror or str(e)).lower()}", where=str(new)) from None
    finally:
        part.unlink(missing_ok=True)


COMPILERS = ("cc", "gcc", "clang")
FLAGS = ("-std=c99", "-O2", "-fPIC", "-shared", "-fvisibility=hidden")


def compiler() -> list[str] | None:
    """The C compiler's command: what CC names, else the first of cc, gcc, clang; None where there is none."""
    named = shlex.split(os.environ.get("CC", ""))
    if named:
        return named if shutil.which(named[0]) else None
    found = next((c for c in COMPILERS if shutil.which(c)), None)
    return [found] if found else None


def binary_folder(version: str) -> str:
    """The folder under `binaries` for this machine, as the version of the standard names it."""
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower(), platform.machine().lower())
    system = {"linux": "linux", "darwin": "darwin", "win32": "windows"}.get(sys.platform, sys.platform)
    if version == "2.0" and machine == "x86_64":
        return {"linux": "linux64", "darwin": "darwin64", "windows": "win64"}.get(system, system)
    return f"{machine}-{system}"


def library_suffix() -> str:
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
        library = at / f"{identifier}{library_suffix()}"
        files = [n for n in sources if n.endswith(".c")]
        line = [*command, *FLAGS, *shlex.split(os.environ.get("CFLAGS", "")), "-o", library.name, *files, "-lm"]
        run = _run(line, at, where=command[0])
        if run.returncode or not library.is_file():
            got = " ".join(run.stderr.split())[:300]
            raise ComputationError(
                "the C compiler did not accept the FMU's sources",
                where=" ".join(command),
                got=got or f"exit code {run.returncode}",
                hint="set CC to another compiler, or export without a binary",
            )
        return library.read_bytes()
