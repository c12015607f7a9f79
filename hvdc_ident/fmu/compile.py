"""Shared libraries of FMUs from C sources: those of an export, and those inside an FMU that has no binary for this machine."""

from __future__ import annotations

import contextlib
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

from hvdc_ident.errors import ComputationError, InputError, ModelError
from hvdc_ident.fmu.archive import BUILDS, check_archive, check_identifier, parsed, unpack
from hvdc_ident.fmu.description import Document, has_sources, read_document

LIBRARY = "compiled.library"
COMPILERS = ("cc", "gcc", "clang")
EXPORT_FLAGS = ("-std=c99", "-O2", "-fPIC", "-shared", "-fvisibility=hidden")
LANGUAGES = {"C89", "C90", "C99", "C11", "C17", "C23"}
TIME_LIMIT = 600  # s for one binary: Dymola's sources are a single file of 100 000 lines
PLAIN_NAMES = ("-DFMI2_FUNCTION_PREFIX=", "-DFMI2_OVERRIDE_FUNCTION_PREFIX", "-DFMI3_OVERRIDE_FUNCTION_PREFIX")
"""Definitions that give functions the names of a shared library, fmi2DoStep. Sources are meant to be linked with others
too, where the functions' names begin with the model's."""
UNDEFINED = re.compile(r"undefined (?:reference to|symbol:?) [`'\"]?_?(\w+)")
"""A symbol that the linker did not find, in the words of GNU, LLVM and Apple."""


def compiler() -> list[str] | None:
    """Return the C compiler's command: what CC names, else the first of cc, gcc, clang; None where there is none."""
    named = shlex.split(os.environ.get("CC", ""))
    if named:
        return named if shutil.which(named[0]) else None
    command = next((c for c in COMPILERS if shutil.which(c)), None)
    return [command] if command else None


def binary_folder(version: int) -> str:
    """Return the folder under `binaries` for this machine, as the version of the standard names it: 2 or 3."""
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower(), platform.machine().lower())
    system = {"linux": "linux", "darwin": "darwin", "win32": "windows"}.get(sys.platform, sys.platform)
    if version == 2 and machine == "x86_64":
        return {"linux": "linux64", "darwin": "darwin64", "windows": "win64"}.get(system, system)
    return f"{machine}-{system}"


def library_suffix() -> str:
    """Return the ending of a shared library's name on this system."""
    return {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")


def compiled(command: list[str], sources: Mapping[str, str], main: str) -> bytes:
    """Return the shared library made of the sources ({name: text}), with the flags of CFLAGS. main: the one that includes the others.

    Raises ComputationError with the compiler's first error.
    """
    with tempfile.TemporaryDirectory(prefix="hvdc-ident-") as place:
        for name, text in sources.items():
            Path(place, name).write_text(text, encoding="utf-8")
        flags = [*EXPORT_FLAGS, *shlex.split(os.environ.get("CFLAGS", ""))]
        hint = "set CC to another compiler, or export without a binary"
        refusal = "the C compiler did not accept the FMU's sources", shlex.join(command), hint
        return _library(command, [*flags, main], Path(place), refusal)


def compile_fmu(path: Path, target: Path | None = None) -> Path:
    """Return the path of a new FMU: the old one's content, and binaries of its sources for this machine.

    target: default, the name with "-compiled" beside the old file, which is never changed. The compiler runs, the FMU
    does not. Raises InputError without sources, without a compiler or where the target exists, ComputationError where
    the compiler refuses the sources, or the binary made of them lacks functions of FMI.
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
    document = read_document(path)
    described = _described_builds(document, parsed(path, BUILDS) if BUILDS in names and document.version == 3 else None)
    with tempfile.TemporaryDirectory(prefix="hvdc-ident-") as place:
        unpack(path, Path(place))
        binaries = {}
        for build in described or [_default_build(document, Path(place, "sources"))]:
            identifier = check_identifier(path, build.identifier)
            library = f"binaries/{binary_folder(document.version)}/{identifier}{library_suffix()}"
            binaries[library] = _binary(command, Path(place), build, path, _functions(document, identifier))
        _write(path, new, binaries)
    return new


@dataclass(frozen=True)
class Build:
    """A library to be made. languages: of its sets of files. files, includes: paths below `sources`. defines: of a preprocessor."""

    identifier: str | None
    languages: tuple[str, ...]
    files: tuple[str, ...]
    includes: tuple[str, ...] = ()
    defines: tuple[str, ...] = ()


def _described_builds(document: Document, builds: Element | None) -> list[Build]:
    """Return the builds that an FMU describes, one for each model identifier. builds: root of its description in FMI 3.0."""
    if document.version == 2:
        by_identifier: dict[str | None, Build] = {}
        for kind in ("ModelExchange", "CoSimulation"):
            for element in document.root.iterfind(kind):
                identifier, files = element.get("modelIdentifier"), _named(element, "SourceFiles/File")
                if files:
                    by_identifier.setdefault(identifier, Build(identifier, ("",), files))
        return list(by_identifier.values())
    return [
        Build(
            b.get("modelIdentifier"),
            tuple(s.get("language", "") for s in b.iterfind("SourceFileSet")),
            _named(b, "SourceFileSet/SourceFile"),
            _named(b, "SourceFileSet/IncludeDirectory"),
            tuple(f"{d.get('name')}={d.get('value', '')}" for d in b.iterfind("SourceFileSet/PreprocessorDefinition")),
        )
        for b in (() if builds is None else builds.iterfind("BuildConfiguration"))
    ]


def _named(element: Element, below: str) -> tuple[str, ...]:
    return tuple(e.get("name", "") for e in element.iterfind(below))


def _default_build(document: Document, sources: Path) -> Build:
    """Return the build of an FMU that does not describe it: every C file that no other one includes."""
    files = sorted(sources.glob("*.c"))
    text = "\n".join(f.read_text("utf-8", "replace") for f in files)
    included = set(re.findall(r'^\s*#\s*include\s*"([^"]+)"', text, re.MULTILINE))
    first = next(iter(document.interfaces.values()), {})
    return Build(first.get("modelIdentifier"), ("C99",), tuple(f.name for f in files if f.name not in included))


def _functions(document: Document, identifier: str) -> list[str]:
    """Return the functions of FMI that the library of a model identifier has to have: those that FMPy binds."""
    from hvdc_ident.fmu.fmi import binding

    offered = [k for k, attributes in document.interfaces.items() if attributes.get("modelIdentifier") == identifier]
    names = {n for k in offered for n in dir(binding(document.version, k))}
    return sorted(n for n in names if n.startswith(f"fmi{document.version}"))


def _binary(command: list[str], folder: Path, build: Build, path: Path, needed: Sequence[str]) -> bytes:
    """Return the shared library of an unpacked FMU's build, with the functions that are needed."""
    import fmpy

    sources, headers = folder / "sources", Path(fmpy.__file__).parent / "c-code"
    if len(build.languages) != 1 or build.languages[0] not in ("", *LANGUAGES):
        got = ", ".join(build.languages) or "no files"
        raise ModelError("the FMU's sources are not C alone", where=str(path), expected="one set of C files", got=got)
    files = [(sources / f).resolve() for f in build.files]
    outside = next((f for f in files if not f.is_relative_to(sources.resolve()) or not f.is_file()), None)
    if outside is not None:
        raise ModelError(f"the source file '{outside.name}' is not in the FMU", where=str(path))
    includes = [f"-I{f}" for f in (sources, *(sources / d for d in build.includes), headers)]
    defines = [f"-D{d}" for d in build.defines]
    standard = [f"-std=gnu{build.languages[0][1:]}"] if build.languages[0] else []
    flags = ["-shared", "-fPIC", "-O2", "-w", *standard, *PLAIN_NAMES, *defines, *includes]
    hint = "its maker knows which headers or compiler they need; else have it exported for this machine"
    refusal = "the C compiler refuses the FMU's sources", str(path), hint
    arguments = [*flags, *map(str, files)]
    library = _library(command, arguments, folder, refusal)
    lacking = _lacking(command, folder, needed)
    if lacking and set(lacking) <= set(needed):  # sources that define the prefix themselves: plain names beside theirs
        aliases = [f"-Wl,--defsym,{n}={build.identifier}_{n}" for n in lacking]
        with contextlib.suppress(ComputationError):  # there are no such functions either
            library = _library(command, [*arguments, *aliases], folder, refusal)
            lacking = _lacking(command, folder, needed)
    if lacking:
        some = ", ".join(lacking[:4]) + (f" and {len(lacking) - 4} more" if len(lacking) > 4 else "")
        raise ComputationError(
            "the binary made of the FMU's sources cannot be loaded",
            where=str(path),
            expected=f"the {len(needed)} functions of FMI that its interfaces have, and all that its own code calls",
            got=f"without {some}",
            hint="its maker knows which files and libraries they are in; else have it exported for this machine",
        )
    return library


def _lacking(command: list[str], folder: Path, needed: Sequence[str]) -> list[str]:
    """Return the symbols that the library just made lacks: functions that are needed, or that it calls itself.

    The linker tells; nothing of the library is run.
    """
    if not needed:
        return []
    lines = [*(f"void {n}(void);" for n in needed), f"void (*needed[])(void) = {{{', '.join(needed)}}};"]
    (folder / "needed.c").write_text("\n".join([*lines, "int main(void) { return needed[0] == 0; }"]) + "\n")
    line = [*command, "needed.c", LIBRARY, "-lm", "-o", "needed"]
    run = _compiler_run(line, folder)
    if run.returncode == 0:
        return []
    return list(dict.fromkeys(UNDEFINED.findall(run.stderr))) or [_first_error(run)]


def _library(command: list[str], arguments: list[str], folder: Path, refusal: tuple[str, str, str]) -> bytes:
    """Return the shared library that the compiler makes. refusal: what, where and hint of the error where it makes none."""
    library = folder / LIBRARY
    run = _compiler_run([*command, *arguments, "-lm", "-o", library.name], folder)
    if run.returncode or not library.is_file():
        what, where, hint = refusal
        raise ComputationError(what, where=where, got=_first_error(run), hint=hint)
    return library.read_bytes()


def _compiler_run(line: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Return a finished run of the compiler in a folder. Raises ComputationError where it does not run."""
    try:
        return subprocess.run(line, cwd=folder, capture_output=True, text=True, timeout=TIME_LIMIT, check=False)
    except (OSError, subprocess.TimeoutExpired) as e:
        raise ComputationError("the C compiler did not run", where=line[0], got=str(e)[:200]) from None


def _first_error(run: subprocess.CompletedProcess[str]) -> str:
    """Return the first error that a compiler has told."""
    errors = re.findall(r"error: (.*)", run.stderr) or run.stderr.strip().splitlines()
    return str(errors[0])[:300] if errors else f"exit code {run.returncode}"


def _write(path: Path, new: Path, binaries: dict[str, bytes]) -> None:
    """Write the new archive: the old one's files in their order, then the binaries."""
    part = new.with_name(f".{new.name}.part")
    try:
        with zipfile.ZipFile(path) as old, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
            last = {e.filename: e for e in old.infolist()}  # of two entries of one name the last counts
            for entry in last.values():
                if entry.filename not in binaries:
                    archive.writestr(entry, old.read(entry))  # whole: it was unpacked before
            for name, content in binaries.items():
                archive.writestr(name, content)
        part.replace(new)
    except OSError as e:
        raise InputError(f"the file cannot be written: {(e.strerror or str(e)).lower()}", where=str(new)) from None
    finally:
        part.unlink(missing_ok=True)
