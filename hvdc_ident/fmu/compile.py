"""A binary for this machine, compiled from the C sources inside an FMU, in a new file beside the old one."""

from __future__ import annotations

import re
import shlex
import subprocess
import tempfile
import zipfile
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
    from hvdc_ident.fmu.export.build import compiler, folder, suffix

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
            library = f"binaries/{folder(given.fmiVersion)}/{identifier}{suffix()}"
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
    try:
        run = subprocess.run(line, cwd=at, capture_output=True, text=True, timeout=SECONDS, check=False)
    except (OSError, subprocess.TimeoutExpired) as e:
        raise ComputationError("the C compiler did not run", where=shlex.join(command), got=str(e)[:200]) from None
    if run.returncode or not library.is_file():
        errors = re.findall(r"error: (.*)", run.stderr) or run.stderr.strip().splitlines() or [f"code {run.returncode}"]
        raise ComputationError(
            "the C compiler refuses the FMU's sources",
            where=str(path),
            got=str(errors[0])[:300],
            hint="its maker knows which headers or compiler they need; else have it exported for this machine",
        )
    return library.read_bytes()


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
