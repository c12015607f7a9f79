"""Any sympy model as an FMU: model exchange and co-simulation, FMI 2.0 or 3.0, plain C inside."""

from __future__ import annotations

import contextlib
import io
import re
import uuid
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path

import numpy as np

from hvdc_ident.data import Experiment
from hvdc_ident.errors import HvdcIdentError, ModelError
from hvdc_ident.files import write_bytes
from hvdc_ident.fmu.compile import binary_folder, compiled, compiler, library_suffix
from hvdc_ident.fmu.export.c_model import CModel
from hvdc_ident.fmu.export.model_description import KINDS, ExportedVariables, build_description, description
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, used_names, without_delays
from hvdc_ident.simulate import core_sources, engine_of, simulate

VERSIONS = ("2.0", "3.0")
_SHELL = ("fmu.c", "instance.c", "start.c", "progress.c", "values.c", "snapshot.c", "fmi.c", "internal.h", "fmi.h")
_TO_COMPILE = "fmu.c"
"""The one file to compile, which includes the others."""
_NAMESPACE = uuid.UUID("4f1f2a5e-6d0b-5a43-9f0e-3d5c1f6e7a90")
_DATE = (1980, 1, 1, 0, 0, 0)  # the same model gives the same file


@dataclass(frozen=True)
class FmuFile:
    """An FMU that was written. binary: the folder of its binary, None where it holds sources only. note: for the user."""

    path: Path
    version: str
    kinds: tuple[str, ...]
    binary: str | None
    note: str


def export_fmu(
    model: Model | CModel,
    path: str | Path,
    *,
    version: str = "2.0",
    kinds: Sequence[str] = tuple(KINDS),
    binary: bool | None = None,
    stop: float = 1.0,
    experiments: Sequence[Experiment] = (),
) -> FmuFile:
    """Write a model as an FMU to path; return what was written.

    model: the model, or its equations as C, where several FMUs are made of them. kinds: "model-exchange", "co-simulation"
    or both. binary: True needs a C compiler, False leaves the sources alone, None compiles where there is a compiler.
    stop: end of the default experiment, s. experiments: where a run of one slides along a limit, so can the co-simulation, for
    each such limit with as much code again as the model has; along others it stops with an error.

    The FMU starts from the steady state of the inputs and parameters given to it before its initialisation ends (states
    with a start of their own from that), with exact derivatives of that start. A delay that is 0 at the model's values is left
    out, with the parameters that nothing else uses. Raises ModelError for options that are
    not known and for True without a compiler, ComputationError where the compiler refuses the sources.
    """
    chosen = tuple(k for k in KINDS if k in kinds)
    if version not in VERSIONS:
        raise ModelError("this version of FMI cannot be written", expected=" or ".join(VERSIONS), got=repr(version))
    if not chosen or set(kinds) - set(KINDS):
        raise ModelError("this kind of FMU is not known", expected=" or ".join(KINDS), got=", ".join(kinds) or "none")
    command = None if binary is False else compiler()
    if binary and command is None:
        raise ModelError(
            "there is no C compiler",
            where=str(path),
            expected="cc, gcc, clang or what CC names",
            hint="leave the binary out",
        )
    code = model if isinstance(model, CModel) else _code(model, experiments)
    identifier = identifier_of(code.model.name)
    content = _content(code, version, chosen, identifier, stop)
    folder = None
    note = "sources only, as asked" if binary is False else "sources only: no C compiler was there"
    if command:
        folder = binary_folder(int(version[0]))
        sources = {n.removeprefix("sources/"): t.decode() for n, t in content.items() if n.startswith("sources/")}
        content[f"binaries/{folder}/{identifier}{library_suffix()}"] = compiled(command, sources, _TO_COMPILE)
        note = f"binary for {folder}, and sources"
    return FmuFile(write_bytes(Path(path), _zipped(content)), version, chosen, folder, note)


def _code(model: Model, experiments: Sequence[Experiment]) -> CModel:
    """Return the model as C, with the slides that runs of the experiments get into, as far as they run."""
    whole = _without_zero_delays(model)
    if not experiments or not engine_of(whole).structure.sizes.ns:  # without a switch nothing slides
        return CModel(whole)
    for experiment in experiments:
        with contextlib.suppress(HvdcIdentError):  # such an experiment is no reason not to export the model
            simulate(whole, experiment, outputs=tuple(whole.outputs))
    return CModel(whole, engine_of(whole).slides)


def _without_zero_delays(model: Model) -> Model:
    """Return the model without the delays that are 0 at its values and the parameters that stood in their times alone.

    The core keeps a delayed signal's history, which a delay of 0 has none of.
    """
    if not model.delays:
        return model
    times, _ = engine_of(model).delay_times(np.array(list(model.values.values())))
    zero = [n for n, t in zip(model.delays, times, strict=True) if t == 0.0]
    if not zero:
        return model
    made = without_delays(model, zero)
    gone = {s.name for n in zero for s in model.delays[n].time.free_symbols} - used_names(made)
    return replace(made, parameters=FrozenMap({n: p for n, p in made.parameters.items() if n not in gone}))


def identifier_of(name: str) -> str:
    """Return a model's name as an identifier of C."""
    text = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return text if re.match(r"[A-Za-z_]", text) else f"m_{text}"


def _content(code: CModel, version: str, kinds: Sequence[str], identifier: str, stop: float) -> dict[str, bytes]:
    """Return the FMU's files but for the binary, by name."""
    shell = resources.files("hvdc_ident.fmu.export") / "runtime"
    variables = ExportedVariables(code)
    files = {n: (shell / n).read_text("utf-8") for n in (*_SHELL, f"fmi{version[0]}.c")}
    files |= core_sources() | {"model.c": code.source}

    def described(token: str) -> str:
        return description(variables, token, version, identifier, kinds, [_TO_COMPILE], stop)

    # The token is a digest of the content: an importer's stored state of another model is refused.
    everything = [described(""), code.header("", version), *(files[n] for n in sorted(files))]
    token = f"{{{uuid.uuid5(_NAMESPACE, ''.join(everything))}}}"
    files["model.h"] = code.header(token, version)
    content = {"modelDescription.xml": described(token)}
    content |= {f"sources/{n}": t for n, t in files.items()}
    if version == "3.0":
        content["sources/buildDescription.xml"] = build_description(identifier, [_TO_COMPILE])
    return {n: t.encode() for n, t in content.items()}


def _zipped(content: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            entry = zipfile.ZipInfo(name, _DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = (0o755 if name.startswith("binaries/") else 0o644) << 16
            archive.writestr(entry, data)
    return stream.getvalue()
