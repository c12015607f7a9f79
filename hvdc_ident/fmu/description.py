"""An FMU's model description, read once from its XML, and the checks that it can be used."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple
from xml.etree.ElementTree import Element

from hvdc_ident.data import Array
from hvdc_ident.errors import ModelError
from hvdc_ident.fmu.archive import DESCRIPTION, Folder, check_archive, check_identifier, first_bytes, machine_of, parsed
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
NO_NUMBERS = ("String", "Binary", "Clock")
IN_TWO = ("Real", "Integer", "Boolean", "String", "Enumeration")
"""Types of FMI 2.0, as elements within a variable; a variable of FMI 3.0 is the element of its type."""
ABILITIES = (
    "providesDirectionalDerivative",
    "canGetAndSetFMUstate",
    "canSerializeFMUstate",
    "canBeInstantiatedOnlyOncePerProcess",
    "needsExecutionTool",
)
STATED: Mapping[Interface, tuple[str, ...]] = {
    "model-exchange": ABILITIES,
    "co-simulation": ("canHandleVariableCommunicationStepSize", "canInterpolateInputs", *ABILITIES),
}
"""What an interface states of itself, false where it does not: attributes of FMI 2.0."""
NAMES_IN_THREE = {
    "providesDirectionalDerivative": "providesDirectionalDerivatives",
    "canGetAndSetFMUstate": "canGetAndSetFMUState",
    "canSerializeFMUstate": "canSerializeFMUState",
}
EXPERIMENT = {"start": "startTime", "stop": "stopTime", "tolerance": "tolerance", "step": "stepSize"}
TRUE = ("true", "1")
FIXED = ("parameter", "calculatedParameter", "structuralParameter")


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

    version: 2 or 3, fmi: in full. token: the GUID or instantiation token. interfaces: what each one that is offered
    states of itself, by the names of FMI 2.0. derivatives: value references in the order of the states. state_count: of
    the model structure, which co-simulation may have too. completed_step: whether it needs the calls after integrator
    steps. directional: whether it offers directional derivatives. variable_step: whether communication steps may differ.
    interpolates: whether it takes the derivatives of inputs. step: communication step that it suggests, s, or None.
    experiment: start, stop, tolerance and step of the default one, where given. tool: that generated it; needs_tool:
    whether it runs in that tool alone. variables: every scalar number by name, aliases included. arrays: sizes in words of
    those that are arrays, which stay at their start and are not recorded. unused: names of what is no number. shown: names
    recorded where none are asked for, the declared outputs or, without any, the states.
    """

    path: Path
    name: str
    version: int
    fmi: str
    interface: Interface
    identifier: str
    token: str
    interfaces: FrozenMap[FrozenMap[Any]]
    parameters: FrozenMap[Variable]
    inputs: FrozenMap[Variable]
    outputs: FrozenMap[Variable]
    states: FrozenMap[Variable]
    derivatives: tuple[int, ...]
    state_count: int
    indicators: int
    completed_step: bool
    directional: bool
    variable_step: bool
    interpolates: bool
    step: float | None
    experiment: FrozenMap[float]
    text: str
    tool: str
    needs_tool: bool
    date: str
    log_categories: tuple[str, ...]
    variables: FrozenMap[Variable]
    arrays: FrozenMap[str]
    unused: tuple[str, ...]
    shown: tuple[str, ...]

    def variable(self, name: str) -> Variable:
        """Return the variable that a recorded name stands for. Raises KeyError where there is none."""
        known = next((k for k in (self.outputs, self.states) if name in k), self.variables)
        return known[name]


Message = tuple[dict[str, Any], dict[str, Array]]
"""A request to a worker, or its answer: a heading and arrays."""


class Setup(NamedTuple):
    """Setup of a worker: an FMU's description, the folder that it is unpacked into, whose lock is inherited, the deadline of
    one run, s, and the bytes of memory that the FMU may take; None: no limit."""

    description: Description
    folder: Folder
    deadline: float
    memory: int | None


class Declared(NamedTuple):
    """A variable as it is declared. shape: of an array. derivative: text that refers to the state whose derivative it is."""

    variable: Variable
    shape: tuple[int, ...]
    derivative: str | None

    @property
    def size(self) -> str:
        """An array's size in words, "2 x 3"."""
        return " x ".join(map(str, self.shape))


@dataclass(frozen=True)
class Document:
    """modelDescription.xml, whose variables are looked at when they are asked for. version: of FMI, 2 or 3."""

    path: Path
    root: Element
    version: int

    @property
    def interfaces(self) -> dict[Interface, Mapping[str, str]]:
        """Attributes of the interfaces that are offered, model exchange first."""
        offered = {ELEMENTS[e.tag]: e.attrib for e in self.root if e.tag in ELEMENTS}
        return {k: offered[k] for k in INTERFACES if k in offered}

    @cached_property
    def variables(self) -> list[Declared]:
        """All variables in the order of the XML, then the aliases of FMI 3.0. Raises ModelError for one that makes no sense."""
        types = [
            (t.get("name"), t[0] if self.version == 2 and len(t) else t)
            for t in self.root.iterfind("TypeDefinitions/*")
        ]
        declared_types = {name: t.attrib for name, t in types}
        elements = [e for e in self.root.iterfind("ModelVariables/*") if e.get("name") is not None]
        starts = {
            e.get("valueReference"): e.get("start") for e in elements if e.get("causality") == "structuralParameter"
        }
        declared, aliases = list[Declared](), list[Declared]()
        for e in elements:
            where = f"{self.path}, variable '{e.get('name')}'"
            value = e if self.version == 3 else next((c for c in e if c.tag in IN_TWO), e)
            kind = value.get("declaredType")
            if value.tag not in (*REAL, *WHOLE, *NO_NUMBERS) or (kind is not None and kind not in declared_types):
                raise ModelError("the type of the variable is not defined", where=where, got=kind or f"<{value.tag}>")
            if value.tag == "Clock" or e.get("clocks"):
                hint = "export it without synchronous parts"
                raise ModelError("the FMU has clocks, which are not supported", where=where, hint=hint)
            variable = self._variable(e, value, declared_types.get(kind, {}), where)
            sizes = [starts.get(d.get("valueReference"), d.get("start")) for d in e if d.tag == "Dimension"]
            shape = tuple(_whole(size, "a size of the array", where) for size in sizes)
            declared.append(Declared(variable, shape, value.get("derivative")))
            for other in e:
                if other.tag == "Alias":
                    text = other.get("description", variable.description)
                    alias = replace(variable, name=other.get("name", ""), description=text)
                    aliases.append(declared[-1]._replace(variable=alias))
        return declared + aliases

    def _variable(self, e: Element, value: Element, declared: Mapping[str, str], where: str) -> Variable:
        """Return a variable, with the attributes of its declared type where it has none. value: the element of its type."""
        own = {**declared, **value.attrib} if declared else value.attrib
        kind, causality = value.tag, e.get("causality", "local")
        low, high = _number(own.get("min")), _number(own.get("max"))
        changes = "continuous" if self.version == 2 or kind in REAL else "discrete"
        return Variable(
            name=e.get("name", ""),
            reference=_whole(e.get("valueReference"), "its value reference", where),
            kind=kind,
            unit=own.get("unit", ""),
            start=_number(value.get("start")),
            nominal=abs(_number(own.get("nominal")) or 0.0) or 1.0,
            min=-math.inf if low is None else low,
            max=math.inf if high is None else high,
            description=e.get("description", own.get("description", "")),
            causality=causality,
            variability=e.get("variability", "fixed" if self.version == 3 and causality in FIXED else changes),
        )

    def derivatives(self) -> list[tuple[Variable, Declared | None]]:
        """Return the derivatives in the model structure, each with the state that it is of, None where it does not say."""
        derivatives = self._listed("Derivatives/Unknown" if self.version == 2 else "ContinuousStateDerivative")
        return [(d.variable, self._referred(d.derivative) if d.derivative is not None else None) for d in derivatives]

    def indicators(self) -> int:
        """Return the number of event indicators."""
        if self.version == 2:
            return _whole(self.root.get("numberOfEventIndicators", "0"), "numberOfEventIndicators", str(self.path))
        return sum(math.prod(d.shape) for d in self._listed("EventIndicator"))

    def _listed(self, element: str) -> list[Declared]:
        """Return the variables that the elements of the model structure refer to."""
        attribute = "index" if self.version == 2 else "valueReference"
        return [self._referred(e.get(attribute)) for e in self.root.iterfind(f"ModelStructure/{element}")]

    def _referred(self, text: str | None) -> Declared:
        """Return the variable that a text refers to: by its place, from 1, in FMI 2.0, by its value reference in FMI 3.0."""
        number = _whole(text, "a reference to a variable", where := f"{self.path}, ModelStructure")
        if number not in self._by_number:
            raise ModelError("the model structure refers to a variable that is not there", where=where, got=str(number))
        return self._by_number[number]

    @cached_property
    def _by_number(self) -> dict[int, Declared]:
        if self.version == 2:
            return dict(enumerate(self.variables, start=1))
        return {d.variable.reference: d for d in reversed(self.variables)}


def read_document(path: Path) -> Document:
    """Return the model description of a checked archive. Raises ModelError for a version of FMI that is not read."""
    root = parsed(path, DESCRIPTION)
    fmi, tool = root.get("fmiVersion", ""), root.get("generationTool", "")
    if RELEASED.fullmatch(fmi):
        return Document(path, root, int(fmi[0]))
    raise ModelError(
        "this version of FMI is not read",
        where=str(path),
        expected="FMI 2.0 or 3.0, as they were released",
        got=f"FMI {fmi}" if fmi else "no fmiVersion",
        hint=f"export it again as FMI 2.0 {f'from {tool}' if tool else 'from the tool it comes from'}; the results of"
        " another simulator, as a CSV file, can be an experiment's data",
    )


def read_description(path: Path, interface: Interface | None = None, *, binary: bool = True) -> Description:
    """Check an FMU and return its description; model exchange where it offers both interfaces and none is named.

    binary: whether it must have one for this machine. Raises ModelError where the archive is refused, the XML makes no
    sense, or something that is needed is missing.
    """
    names, document = check_archive(path), read_document(path)
    root, version, interfaces = document.root, document.version, document.interfaces
    kind = _interface(path, tuple(interfaces), interface)
    chosen, exchange = interfaces[kind], kind == "model-exchange"
    identifier = check_identifier(path, chosen.get("modelIdentifier"))
    if binary:
        check_binary(path, names, version, identifier)
    declared, derivatives = document.variables, document.derivatives()
    states = _states(path, derivatives, "co-simulation" in interfaces) if exchange else FrozenMap()
    numbers = [d for d in declared if d.variable.kind not in NO_NUMBERS]
    variables = FrozenMap({d.variable.name: d.variable for d in numbers if not d.shape})
    by_causality = {c: [v for v in variables.values() if v.causality == c] for c in ("parameter", "input", "output")}
    outputs = FrozenMap({v.name: v for v in by_causality["output"]})
    named_states = [s.variable.name for _, s in derivatives if s is not None and s.variable.name in variables]
    experiment = next((_numbers(e.attrib, EXPERIMENT) for e in root.iterfind("DefaultExperiment")), {})
    stated = {k: _stated(k, attributes, version) for k, attributes in interfaces.items()}
    if version == 2:
        completes = chosen.get("completedIntegratorStepNotNeeded") not in TRUE
    else:
        completes = chosen.get("needsCompletedIntegratorStep") in TRUE
    return Description(
        path=path,
        name=root.get("modelName") or path.stem,
        version=version,
        fmi=root.get("fmiVersion", ""),
        interface=kind,
        identifier=identifier,
        token=root.get("guid" if version == 2 else "instantiationToken", ""),
        interfaces=FrozenMap({str(k): s for k, s in stated.items()}),
        parameters=_merged(v for v in by_causality["parameter"] if v.variability != "constant"),
        inputs=_merged(by_causality["input"]),
        outputs=outputs,
        states=states,
        derivatives=tuple(d.reference for d, _ in derivatives) if exchange else (),
        state_count=len(derivatives),
        indicators=document.indicators(),
        completed_step=exchange and completes,
        directional=stated[kind]["providesDirectionalDerivative"],
        variable_step=stated[kind].get("canHandleVariableCommunicationStepSize", True),
        interpolates=version == 2 and stated[kind].get("canInterpolateInputs", False),
        step=stated[kind].get("fixedInternalStepSize") or experiment.get("step"),
        experiment=FrozenMap(experiment),
        text=root.get("description", ""),
        tool=root.get("generationTool", ""),
        needs_tool=stated[kind]["needsExecutionTool"],
        date=root.get("generationDateAndTime", ""),
        log_categories=tuple(c.get("name", "") for c in root.iterfind("LogCategories/Category")),
        variables=variables,
        arrays=FrozenMap({d.variable.name: d.size for d in numbers if d.shape}),
        unused=tuple(d.variable.name for d in declared if d.variable.kind in NO_NUMBERS),
        shown=tuple(outputs) or tuple(dict.fromkeys(named_states)),
    )


def _interface(path: Path, offered: Sequence[Interface], asked: Interface | None) -> Interface:
    """Return the interface to use. Raises ModelError where it is not offered."""
    if asked in offered or (asked is None and offered):
        return asked or offered[0]
    raise ModelError(
        "the FMU does not offer what is asked for",
        where=str(path),
        expected=asked or "model exchange or co-simulation",
        got=", ".join(offered) or "neither",
    )


def _stated(kind: Interface, attributes: Mapping[str, str], version: int) -> FrozenMap[Any]:
    """Return what an interface states of itself, by the names of FMI 2.0."""
    names = {n: NAMES_IN_THREE.get(n, n) if version == 3 else n for n in STATED[kind]}
    flags = {n: attributes.get(name) in TRUE for n, name in names.items()}
    return FrozenMap({**flags, **_numbers(attributes, {"fixedInternalStepSize": "fixedInternalStepSize"})})


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


def _states(
    path: Path, derivatives: Sequence[tuple[Variable, Declared | None]], co_simulation: bool
) -> FrozenMap[Variable]:
    """Return the states. Raises ModelError where they are not usable."""
    states: dict[str, Variable] = {}
    for derivative, state in derivatives:
        if state is None:
            what = f"the derivative '{derivative.name}' does not say of which state it is"
            raise ModelError(what, where=f"{path}, ModelStructure")
        name = state.variable.name
        if state.shape:
            raise ModelError(
                "a state of the FMU is an array, which is not supported",
                where=f"{path}, variable '{name}'",
                expected="scalar states",
                got=f"an array of {state.size}",
                hint=f"{'use its co-simulation (interface), or ' if co_simulation else ''}export its elements as scalars",
            )
        if name in states:
            raise ModelError(f"the state '{name}' has two derivatives", where=f"{path}, ModelStructure")
        states[name] = state.variable
    return FrozenMap(states)


def _whole(text: str | None, what: str, where: str) -> int:
    """Return the whole number in a text of the XML. Raises ModelError where there is none."""
    try:
        return int(text or "")
    except ValueError:
        expected, got = f"a whole number as {what}", repr(text)[:80]
        raise ModelError("the model description makes no sense", where=where, expected=expected, got=got) from None


def _numbers(attributes: Mapping[str, str], names: Mapping[str, str]) -> dict[str, float]:
    """Return the numbers among attributes, by the keys of their names."""
    numbers = {key: _number(attributes.get(name)) for key, name in names.items()}
    return {key: x for key, x in numbers.items() if x is not None}


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
