"""An FMU's model description: its variables and capabilities, read from its XML, and the checks that it can be used."""

from __future__ import annotations

import math
import re
import sys
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from hvdc_ident.data import Array
from hvdc_ident.errors import ModelError, one_line
from hvdc_ident.fmu.archive import DESCRIPTION, Folder, check_archive, check_identifier, first_bytes, machine_of
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.next_step import NextStep

Interface = Literal["model-exchange", "co-simulation"]
INTERFACES: tuple[Interface, ...] = ("model-exchange", "co-simulation")
ELEMENTS: Mapping[str, Interface] = {"ModelExchange": "model-exchange", "CoSimulation": "co-simulation"}
"""Interfaces by their element of the model description."""
RELEASED = re.compile(r"2\.0|3\.\d+(\.\d+)?")
"""Versions that are read: those before a release, 3.0-beta.2, have other functions and attributes."""
REAL = ("Real", "Float64", "Float32")
WHOLE = ("Integer", "Enumeration", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64", "Boolean")


@dataclass(frozen=True)
class Variable:
    """One variable. kind: its type in the FMI version. start: None where the FMU does not give it. nominal: above 0.

    causality, variability: in FMI's words. also: aliases, which are other names of the same value reference.
    """

    name: str
    reference: int
    kind: str
    unit: str = ""
    start: float | None = None
    nominal: float = 1.0
    min: float = -math.inf
    max: float = math.inf
    description: str = ""
    causality: str = "local"
    variability: str = "continuous"
    also: tuple[str, ...] = ()

    @property
    def tunable(self) -> bool:
        """Return whether it may be set during a run."""
        return self.variability == "tunable"

    @property
    def continuous(self) -> bool:
        """Return whether it may change at any instant, not at events alone."""
        return self.variability == "continuous"

    @property
    def recordable(self) -> bool:
        """Return whether a run can record it; a parameter stays where it is put."""
        return self.causality not in ("parameter", "structuralParameter")

    @property
    def whole(self) -> bool:
        """True where only whole numbers can be set; a Boolean is 0 or 1."""
        return self.kind in WHOLE


@dataclass(frozen=True)
class Description:
    """The model description of an FMU.

    version: 2 or 3. token: the GUID or instantiation token. derivatives: value references in the order of the states.
    variables: every scalar number by name, aliases included. arrays: sizes in words of those that are arrays, which
    stay at their start and are not recorded. shown: names recorded where none are asked for, the declared outputs or,
    without any, the states. tool: that generated it; needs_tool: whether it runs in that tool alone. completed_step:
    whether it needs the calls after integrator steps. directional: whether it offers directional derivatives.
    variable_step: whether communication steps may differ. interpolates: whether it takes the derivatives of inputs.
    step: communication step that it suggests, s, or None.
    """

    path: Path
    name: str
    version: int
    interface: Interface
    identifier: str
    token: str
    parameters: FrozenMap[Variable]
    inputs: FrozenMap[Variable]
    outputs: FrozenMap[Variable]
    states: FrozenMap[Variable]
    derivatives: tuple[int, ...] = ()
    indicators: int = 0
    completed_step: bool = False
    directional: bool = False
    variable_step: bool = True
    interpolates: bool = False
    step: float | None = None
    text: str = ""
    tool: str = ""
    needs_tool: bool = False
    variables: FrozenMap[Variable] = field(default_factory=FrozenMap)
    arrays: FrozenMap[str] = field(default_factory=FrozenMap)
    shown: tuple[str, ...] = ()

    def variable(self, name: str) -> Variable:
        """Return the variable that a recorded name stands for. Raises KeyError where there is none."""
        known = next((k for k in (self.outputs, self.states) if name in k), self.variables)
        return known[name]


class Header(NamedTuple):
    """What stands in a model description before its variables: quick to read, however many these are.

    attributes: of the whole. interfaces: attributes of each one that is offered.
    """

    attributes: Mapping[str, str]
    interfaces: Mapping[Interface, Mapping[str, str]]

    @property
    def version(self) -> int:
        """Return 2 or 3."""
        return int(self.attributes["fmiVersion"].partition(".")[0])


Message = tuple[dict[str, Any], dict[str, Array]]
"""A request to a worker, or its answer: a heading and arrays."""


class Setup(NamedTuple):
    """Setup of a worker: an FMU's description, the folder that it is unpacked into, whose lock is inherited, the deadline of
    one run, s, and the bytes of memory that the FMU may take; None: no limit."""

    description: Description
    folder: Folder
    deadline: float
    memory: int | None


def read_description(
    path: Path, interface: Interface | None = None, *, binary: bool = True, known: Any = None
) -> Description:
    """Check an FMU and return its description; model exchange where it offers both interfaces and none is named.

    binary: whether it must have one for this machine. known: its model description, where it is `parsed` already.
    Raises ModelError where the archive is refused, the XML makes no sense, or something that is needed is missing.
    """
    names = check_archive(path)
    header = read_header(path)
    kind = _interface(path, header, interface)
    identifier = check_identifier(path, header.interfaces[kind].get("modelIdentifier"))
    if binary:
        check_binary(path, names, header.version, identifier)
    given = known or parsed(path)
    chosen = given.modelExchange if kind == "model-exchange" else given.coSimulation
    _refuse_clocks(path, given.modelVariables)
    states, derivatives = _states(path, given) if kind == "model-exchange" else (FrozenMap(), ())
    numbers = [v for v in given.modelVariables if v.type in (*REAL, *WHOLE)]
    variables = FrozenMap({v.name: _variable(v) for v in numbers if not v.dimensions})
    by_causality = {c: [v for v in variables.values() if v.causality == c] for c in ("parameter", "input", "output")}
    outputs = FrozenMap({v.name: v for v in by_causality["output"]})
    experiment = given.defaultExperiment
    return Description(
        path=path,
        name=given.modelName or path.stem,
        version=given.fmiMajorVersion,
        interface=kind,
        identifier=identifier,
        token=given.instantiationToken or "",
        parameters=_merged(by_causality["parameter"]),
        inputs=_merged(by_causality["input"]),
        outputs=outputs,
        states=states,
        derivatives=derivatives,
        indicators=int(given.numberOfEventIndicators),
        completed_step=bool(getattr(chosen, "needsCompletedIntegratorStep", False)),
        directional=bool(chosen.providesDirectionalDerivative),
        variable_step=bool(getattr(chosen, "canHandleVariableCommunicationStepSize", True)),
        interpolates=bool(getattr(chosen, "canInterpolateInputs", False)) and given.fmiMajorVersion == 2,
        step=_number(getattr(chosen, "fixedInternalStepSize", None))
        or _number(experiment.stepSize if experiment else None),
        text=given.description or "",
        tool=given.generationTool or "",
        needs_tool=bool(getattr(chosen, "needsExecutionTool", False)),
        variables=variables,
        arrays=FrozenMap({v.name: _size(v) for v in numbers if v.dimensions}),
        shown=tuple(outputs) or _named_states(given, variables),
    )


def read_header(path: Path) -> Header:
    """Return the header of a checked archive's model description. Raises ModelError for a version that is not read."""
    from xml.etree import ElementTree

    first: Mapping[str, str] | None = None
    interfaces: dict[Interface, Mapping[str, str]] = {}
    with zipfile.ZipFile(path) as archive, archive.open(DESCRIPTION) as text:
        for _, element in ElementTree.iterparse(text, events=("start",)):
            if element.tag == "ModelVariables":
                break
            first = dict(element.attrib) if first is None else first
            kind = ELEMENTS.get(element.tag)
            if kind is not None:
                interfaces[kind] = dict(element.attrib)
    attributes = first or {}
    version, tool = attributes.get("fmiVersion", ""), attributes.get("generationTool", "")
    if not RELEASED.fullmatch(version):
        raise ModelError(
            "this version of FMI is not read",
            where=str(path),
            expected="FMI 2.0 or 3.0, as they were released",
            got=f"FMI {version}" if version else "no fmiVersion",
            hint=f"export it again as FMI 2.0 {f'from {tool}' if tool else 'from the tool it comes from'}; the results of"
            " another simulator, as a CSV file, can be an experiment's data",
        )
    return Header(attributes, interfaces)


def parsed(path: Path) -> Any:
    """Return the model description as FMPy reads it, without its validation, which refuses what can be used, as a missing start.

    FMI 3.0 calls one attribute otherwise than FMI 2.0, and FMPy reads it under the old name alone: the new one is put there.
    """
    from fmpy import read_model_description
    from lxml import etree

    header = read_header(path)
    try:
        given = read_model_description(str(path), validate=False)
    except (etree.LxmlError, ValueError, TypeError, KeyError, IndexError, AttributeError) as e:
        raise ModelError(f"the model description makes no sense: {one_line(e, 300)}", where=str(path)) from None
    except Exception as e:  # FMPy raises bare Exceptions for what it does not support
        if type(e).__module__ not in ("builtins", "fmpy.model_description"):
            raise
        why = one_line(e, 300).removeprefix("Exception: ").rstrip(".")
        raise ModelError(
            f"the model description cannot be used: {why}",
            where=str(path),
            hint=f"export it again from its tool, or mend its {DESCRIPTION}: the standard forbids what is said there",
        ) from None
    if header.version == 3:
        for kind, interface in zip(INTERFACES, (given.modelExchange, given.coSimulation), strict=True):
            if interface is not None:
                said = header.interfaces.get(kind, {}).get("providesDirectionalDerivatives")
                interface.providesDirectionalDerivative = said in ("true", "1")
    return given


def _interface(path: Path, header: Header, asked: Interface | None) -> Interface:
    """Return the interface to use. Raises ModelError where it is not offered."""
    offered = [k for k in INTERFACES if k in header.interfaces]
    wanted = asked or next(iter(offered), None)
    if wanted is None or wanted not in offered:
        expected = asked or "model exchange or co-simulation"
        raise ModelError(
            "the FMU does not offer what is asked for",
            where=str(path),
            expected=expected,
            got=", ".join(offered) or "scheduled execution only",
        )
    return wanted


def has_sources(names: Iterable[str]) -> bool:
    """Return whether an FMU of these files has C sources."""
    return any(n.startswith("sources/") and n.endswith(".c") for n in names)


def platforms(names: Iterable[str]) -> dict[str, list[str]]:
    """Return the libraries in an FMU by the folder of their platform; empty folders too."""
    folders: dict[str, list[str]] = {}
    for name in names:
        parts = name.replace("\\", "/").split("/")
        if parts[0] == "binaries" and len(parts) > 2:
            libraries = folders.setdefault(parts[1], [])
            if len(parts) == 3 and parts[2].endswith((".so", ".dll", ".dylib")):
                libraries.append(parts[2])
    return {p: folders[p] for p in sorted(folders)}


def check_binary(path: Path, names: Iterable[str], version: int, identifier: str) -> None:
    """Raise ModelError where there is no binary that this machine can load."""
    from fmpy import platform, platform_tuple, sharedLibraryExtension

    folder = platform if version == 2 else platform_tuple
    file, have = f"{identifier}{sharedLibraryExtension}", platforms(names)
    expected = f"binaries/{folder}/{file}"
    hint = "have it exported for this machine by the tool it comes from"
    steps = (NextStep("compile", path.name),) if has_sources(names) else ()
    if file in have.get(folder, ()):
        with Path(sys.executable).open("rb") as interpreter:
            machine, local = machine_of(first_bytes(path, expected)), machine_of(interpreter.read(64))
        if not machine or machine == local:
            return
        what, expected, got = f"the FMU's binary {expected} is for another machine", local, machine
    else:
        what, got = "the FMU has no binary for this machine", _in_its_place(folder, have, has_sources(names))
    raise ModelError(what, where=str(path), expected=expected, got=got, hint=hint, next=steps)


def _in_its_place(folder: str, have: Mapping[str, list[str]], sources: bool) -> str:
    """Return in words what an FMU has instead of a binary for this machine."""
    filled = [p for p, libraries in have.items() if libraries and p != folder]
    others = f"; binaries for {', '.join(filled)}" if filled else ""
    if folder not in have:
        return others.removeprefix("; ") or ("C sources only" if sources else "no binaries at all")
    if have[folder]:
        return f"{', '.join(have[folder])} in that folder{others}"
    return f"an empty folder binaries/{folder}{others}"


def _refuse_clocks(path: Path, variables: Iterable[Any]) -> None:
    for v in variables:
        if v.type == "Clock" or v.clocks:
            raise ModelError(
                "the FMU has clocks, which are not supported",
                where=f"{path}, variable '{v.name}'",
                hint="export it without synchronous parts",
            )


def _size(v: Any) -> str:
    """Return an array's size in words, "2 x 3"."""
    return " x ".join(str(n) for n in v.shape or ())


def _named_states(given: Any, variables: FrozenMap[Variable]) -> tuple[str, ...]:
    """Return the names of the scalar states in the model structure, which co-simulation FMUs may have too."""
    states = (u.variable.derivative for u in given.derivatives)
    return tuple(dict.fromkeys(s.name for s in states if s is not None and getattr(s, "name", None) in variables))


def _states(path: Path, given: Any) -> tuple[FrozenMap[Variable], tuple[int, ...]]:
    """Return the states, and the value references of their derivatives. Raises ModelError where they are not usable."""
    states: dict[str, Variable] = {}
    derivatives = []
    first = {v.valueReference: v for v in reversed(given.modelVariables)} if given.fmiMajorVersion == 3 else {}
    for unknown in given.derivatives:
        derivative = unknown.variable
        state = derivative.derivative
        if state is None or isinstance(state, str):
            raise ModelError(
                f"the derivative '{derivative.name}' does not say of which state it is", where=f"{path}, ModelStructure"
            )
        state = first.get(state.valueReference, state)  # where an output has the reference too, FMPy takes the last
        if state.dimensions:
            raise ModelError(
                "a state of the FMU is an array, which is not supported",
                where=f"{path}, variable '{state.name}'",
                expected="scalar states",
                got=f"an array of {_size(state)}",
                hint=f"{'use its co-simulation (interface), or ' if given.coSimulation else ''}export its elements as scalars",
            )
        if state.name in states:
            raise ModelError(f"the state '{state.name}' has two derivatives", where=f"{path}, ModelStructure")
        states[state.name] = _variable(state)
        derivatives.append(int(derivative.valueReference))
    return FrozenMap(states), tuple(derivatives)


def _variable(v: Any) -> Variable:
    """Return a variable with the attributes of its declared type where it has none of its own."""
    declared = v.declaredType

    def attribute(name: str) -> Any:
        value = getattr(v, name, None)
        return value if value is not None else getattr(declared, name, None)

    nominal = abs(_number(attribute("nominal")) or 0.0)
    low, high = _number(attribute("min")), _number(attribute("max"))
    return Variable(
        name=v.name,
        reference=int(v.valueReference),
        kind=v.type,
        unit=attribute("unit") or "",
        start=_number(v.start),
        nominal=nominal or 1.0,
        min=-math.inf if low is None else low,
        max=math.inf if high is None else high,
        description=attribute("description") or "",
        causality=v.causality or "local",
        variability=v.variability or ("continuous" if v.type in REAL else "discrete"),
    )


def _number(text: object) -> float | None:
    """Return the finite number in a text of the XML, else None."""
    if text is None:
        return None
    words = str(text).strip()
    if words in ("true", "false"):
        return float(words == "true")
    try:
        value = float(words)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _merged(variables: Iterable[Variable]) -> FrozenMap[Variable]:
    """Return variables by name, one for each value reference, with the other names of it as aliases."""
    merged: dict[tuple[int, bool], Variable] = {}
    for v in variables:
        key = (v.reference, v.kind in REAL)
        first = merged.get(key)
        if first is None:
            merged[key] = v
            continue
        start = first.start if first.start is not None else v.start
        merged[key] = replace(first, also=(*first.also, v.name), start=start, unit=first.unit or v.unit)
    return FrozenMap({v.name: v for v in merged.values()})
