"""Small FMUs written in C, compiled here: both versions of FMI, model exchange and co-simulation in one file.

A model is a few lines of C on `r`, the values by value reference (states first, then their derivatives), and the lines
of its model description. What a foreign FMU may do wrong is put in by hand.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
import zipfile
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from xml.sax.saxutils import quoteattr

import pytest

SOURCE = Path(__file__).with_name("fmu.c")
COMPILER = shutil.which("gcc") or shutil.which("cc")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler here: FMUs written in C cannot be built")
FOLDER = {2: "linux64", 3: "x86_64-linux"}
TOKEN = "{token}"


@dataclass(frozen=True)
class Var:
    """A variable: its name, value reference, causality, variability, and further attributes."""

    name: str
    reference: int
    causality: str = "local"
    variability: str = "continuous"
    more: tuple[tuple[str, str], ...] = ()
    kind: str = "Real"


@dataclass(frozen=True)
class CModel:
    """A model: C code that defines what fmu.c leaves open, its variables and how many states and indicators it has."""

    name: str
    code: str
    variables: tuple[Var, ...]
    states: int = 0
    indicators: int = 0
    directional: bool = False
    kinds: tuple[str, ...] = ("ModelExchange", "CoSimulation")
    token: str = TOKEN
    defines: tuple[str, ...] = ()
    extra: dict[str, bytes] = field(default_factory=dict, hash=False)


@cache
def library(code: str, version: int, states: int, indicators: int, defines: tuple[str, ...]) -> bytes:
    """The compiled binary, kept from one run of the tests to the next."""
    body = f'{code}\n#include "{SOURCE}"' if code else "int nothing;"
    text = f"#define FMI {version}\n#define NX {states}\n#define NZ {indicators}\n{body}\n"
    command = [str(COMPILER), "-O1", "-shared", "-fPIC", "-w", *(f"-D{d}" for d in defines)]
    key = hashlib.sha256(repr((text, SOURCE.read_bytes(), command)).encode()).hexdigest()[:24]
    kept = Path(tempfile.gettempdir(), f"hvdc_ident_test_fmus_{os.getuid()}")
    kept.mkdir(mode=0o700, exist_ok=True)
    target = kept / f"{key}.so"
    if not target.exists():
        with tempfile.TemporaryDirectory(dir=kept) as folder:  # another process may make the same
            source, made = Path(folder, "model.c"), Path(folder, "model.so")
            source.write_text(text)
            subprocess.run([*command, str(source), "-o", str(made), "-lm"], check=True)
            made.replace(target)
    return target.read_bytes()


def build(model: CModel, folder: Path, version: int = 2, **files: bytes) -> Path:
    """The path of the FMU. files: contents that replace or join those of the archive, `/` in names written as `__`."""
    path = folder / f"{model.name}{version}.fmu"
    content = {
        "modelDescription.xml": description(model, version).encode(),
        f"binaries/{FOLDER[version]}/{model.name}.so": library(
            model.code, version, model.states, model.indicators, model.defines
        ),
        **model.extra,
        **{n.replace("__", "/"): b for n, b in files.items()},
    }
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    return path


def description(model: CModel, version: int) -> str:
    """The model description."""
    return _two(model) if version == 2 else _three(model)


def _attributes(v: Var) -> str:
    return "".join(f" {k}={quoteattr(x)}" for k, x in v.more if k != "derivative")


def _two(model: CModel) -> str:
    lines, place = [], {v.name: i for i, v in enumerate(model.variables, start=1)}
    for v in model.variables:
        of = dict(v.more).get("derivative")
        of = f' derivative="{place[of]}"' if of else ""
        lines.append(
            f'<ScalarVariable name={quoteattr(v.name)} valueReference="{v.reference}" causality="{v.causality}"'
            f' variability="{v.variability}"><{v.kind}{_attributes(v)}{of}/></ScalarVariable>'
        )
    unknowns = "".join(f'<Unknown index="{place[v.name]}"/>' for v in model.variables if v.causality == "output")
    slopes = "".join(f'<Unknown index="{place[v.name]}"/>' for v in model.variables if "derivative" in dict(v.more))
    flag = ' providesDirectionalDerivative="true"' if model.directional else ""
    cs = ' canHandleVariableCommunicationStepSize="true"'
    kinds = "".join(
        f'<{k} modelIdentifier="{model.name}"{flag}{cs if k == "CoSimulation" else ""}/>' for k in model.kinds
    )
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription fmiVersion="2.0" modelName="{model.name}" '
        f'guid="{model.token}" numberOfEventIndicators="{model.indicators}">{kinds}<ModelVariables>{"".join(lines)}'
        f"</ModelVariables><ModelStructure><Outputs>{unknowns}</Outputs><Derivatives>{slopes}</Derivatives>"
        "</ModelStructure></fmiModelDescription>"
    )


def _three(model: CModel) -> str:
    lines, place = [], {v.name: v.reference for v in model.variables}
    kinds_of = {"Real": "Float64", "Integer": "Int32", "Boolean": "Boolean"}
    for v in model.variables:
        of = dict(v.more).get("derivative")
        of = f' derivative="{place[of]}"' if of else ""
        kind = kinds_of.get(v.kind, v.kind)
        lines.append(
            f'<{kind} name={quoteattr(v.name)} valueReference="{v.reference}" causality="{v.causality}"'
            f' variability="{v.variability}"{_attributes(v)}{of}/>'
        )
    outputs = "".join(f'<Output valueReference="{v.reference}"/>' for v in model.variables if v.causality == "output")
    slopes = "".join(
        f'<ContinuousStateDerivative valueReference="{v.reference}"/>'
        for v in model.variables
        if "derivative" in dict(v.more)
    )
    zeros = "".join(f'<EventIndicator valueReference="{900 + k}"/>' for k in range(model.indicators))
    lines += [
        f'<Float64 name="z{k}" valueReference="{900 + k}" causality="local" variability="continuous"/>'
        for k in range(model.indicators)
    ]
    flag = ' providesDirectionalDerivatives="true"' if model.directional else ""
    cs = ' canHandleVariableCommunicationStepSize="true"'
    kinds = "".join(
        f'<{k} modelIdentifier="{model.name}"{flag}{cs if k == "CoSimulation" else ""}/>' for k in model.kinds
    )
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription fmiVersion="3.0" modelName="{model.name}" '
        f'instantiationToken="{model.token}">{kinds}<ModelVariables>{"".join(lines)}</ModelVariables>'
        f"<ModelStructure>{outputs}{slopes}{zeros}</ModelStructure></fmiModelDescription>"
    )
