"""The variables of an exported FMU, and the XML files that describe it in FMI 2.0 and 3.0."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from xml.etree import ElementTree as ET

from hvdc_ident.expression import symbol
from hvdc_ident.fmu.export.c_model import TOLERANCE, CModel


@dataclass(frozen=True)
class ExportedVariable:
    """One scalar variable; all are of type Real. derivative: reference of the state it is the derivative of."""

    name: str
    reference: int
    causality: str
    variability: str
    initial: str = ""
    start: float | None = None
    unit: str = ""
    description: str = ""
    min: float | None = None
    max: float | None = None
    nominal: float | None = None
    derivative: int | None = None


@dataclass(frozen=True, eq=False)
class ExportedVariables:
    """All variables in the ranges of value references that internal.h names.

    A name stands once in an FMU. An output that is a state or an input of its name is that variable where it is a state;
    any other output whose name is taken becomes outputs.NAME, as insertion points are named.
    """

    code: CModel

    @cached_property
    def all(self) -> tuple[ExportedVariable, ...]:
        """Every variable as listed: time, inputs, outputs in the model's order, other states, derivatives, parameters."""
        states, outputs = list(self._states()), list(self._outputs())
        shown = {v.name: v for v in states if v.causality == "output"} | {v.name: v for v in outputs}
        ordered = [shown[self._output_name(n)] for n in self.code.model.outputs]
        inner = [v for v in states if v.causality != "output"]
        return (*self._time(), *self._inputs(), *ordered, *inner, *self._rates(), *self._parameters())

    @cached_property
    def first(self) -> dict[str, int]:
        """The first value reference of each range."""
        m, s = self.code.model, self.code.structure.sizes
        counts = {
            "time": 1,
            "inputs": len(m.inputs),
            "states": s.nx,
            "rates": s.nx,
            "outputs": s.no,
            "parameters": len(m.parameters),
            "indicators": s.ns,
        }
        return dict(zip(counts, accumulate(counts.values(), initial=0), strict=False))

    @property
    def derivatives(self) -> tuple[ExportedVariable, ...]:
        """The states' derivatives, in order."""
        return tuple(v for v in self.all if v.derivative is not None)

    @property
    def outputs(self) -> tuple[ExportedVariable, ...]:
        """The outputs, in the model's order."""
        return tuple(v for v in self.all if v.causality == "output")

    @property
    def unknown_at_start(self) -> tuple[ExportedVariable, ...]:
        """Variables that initialisation computes: outputs, states and derivatives."""
        states = range(self.first["states"], self.first["outputs"])
        return tuple(v for v in self.all if v.causality == "output" or v.reference in states)

    @cached_property
    def output_states(self) -> frozenset[str]:
        """Outputs that are the state of their own name."""
        m = self.code.model
        return frozenset(n for n, o in m.outputs.items() if n in m.states and o.value == symbol(n))

    def dependencies(self, variable: ExportedVariable) -> tuple[int, ...]:
        """References of the time, inputs and states that an output or a derivative may depend on, ascending."""
        s, first = self.code.structure, self.first
        if first["states"] <= variable.reference < first["rates"]:
            return (variable.reference,)
        node = (
            s.derivatives[variable.reference - first["rates"]]
            if variable.derivative is not None
            else s.observed[variable.reference - first["outputs"]]
        )
        return self._references(node)

    def indicator_dependencies(self, index: int) -> tuple[int, ...]:
        """References of the time, inputs and states that an event indicator may depend on, ascending."""
        return self._references(self.code.structure.graph.switches[index])

    def _references(self, node: int) -> tuple[int, ...]:
        leaves, unknowns = self._leaves(node)
        if unknowns:
            leaves = leaves.union(*(self._leaves(r)[0] for r in self.code.structure.residuals))
        return tuple(sorted(leaves))

    def _leaves(self, node: int) -> tuple[frozenset[int], bool]:
        """Return the references that a node depends on, through conditions too, and whether it depends on an algebraic unknown."""
        s, first = self.code.structure, self.first
        graph, nx, nu = s.graph, s.sizes.nx, s.sizes.nu
        seen: set[int] = set()
        stack, references, unknowns = [node], set(), False
        while stack:
            n = stack.pop()
            if n in seen:
                continue
            seen.add(n)
            key = graph.nodes[n]
            stack.extend((graph.switches[key[1]],) if key[0] == "switch" else graph.arguments(n))
            if key[0] == "leaf" and key[1] == "y":
                unknowns = unknowns or key[2] >= nx
                references |= {first["states"] + key[2]} if key[2] < nx else set()
            elif key[0] == "leaf" and key[1] == "w":
                references.add(key[2] if key[2] <= nu else 0)  # delayed and sampled signals change with time
        return frozenset(references), unknowns

    # --- the ranges ---

    def _time(self) -> Iterator[ExportedVariable]:
        yield ExportedVariable("time", 0, "independent", "continuous", unit="s", description="simulation time")

    def _inputs(self) -> Iterator[ExportedVariable]:
        for k, (name, i) in enumerate(self.code.model.inputs.items()):
            yield ExportedVariable(
                name, self.first["inputs"] + k, "input", "continuous", "", i.value, i.unit, i.description
            )  # fmt: skip

    def _state_name(self, name: str) -> str:
        m = self.code.model
        return f"states.{name}" if name in m.outputs and name not in self.output_states else name

    def _output_name(self, name: str) -> str:
        m = self.code.model
        return f"outputs.{name}" if name in m.inputs or name in m.parameters else name

    def _states(self) -> Iterator[ExportedVariable]:
        for k, (name, state) in enumerate(self.code.model.states.items()):
            searched = state.start is None
            yield ExportedVariable(
                self._state_name(name),
                self.first["states"] + k,
                "output" if name in self.output_states else "local",
                "continuous",
                "approx" if searched else "calculated",
                float(self.code.rest[k]) if searched else None,
                state.unit,
                state.description,
                nominal=float(self.code.nominals[k]),
            )

    def _rates(self) -> Iterator[ExportedVariable]:
        for k, (name, state) in enumerate(self.code.model.states.items()):
            unit = f"{state.unit}/s" if state.unit and "/" not in state.unit else ""
            yield ExportedVariable(
                f"der({self._state_name(name)})",
                self.first["rates"] + k,
                "local",
                "continuous",
                "calculated",
                unit=unit,
                derivative=self.first["states"] + k,
            )

    def _outputs(self) -> Iterator[ExportedVariable]:
        m = self.code.model
        for k, (name, output) in enumerate(m.outputs.items()):
            if name in self.output_states:
                continue
            yield ExportedVariable(
                self._output_name(name),
                self.first["outputs"] + k,
                "output",
                "continuous",
                "calculated",
                None,
                output.unit,
                output.description,
            )

    def _parameters(self) -> Iterator[ExportedVariable]:
        fixed = self.code.fixed
        for k, (name, q) in enumerate(self.code.model.parameters.items()):
            yield ExportedVariable(
                name,
                self.first["parameters"] + k,
                "parameter",
                "fixed" if name in fixed else "tunable",
                "exact",
                q.value,
                q.unit,
                q.description,
                q.min if abs(q.min) < float("inf") else None,
                q.max if abs(q.max) < float("inf") else None,
            )


KINDS = {"model-exchange": "ModelExchange", "co-simulation": "CoSimulation"}
SI: Mapping[str, Mapping[str, int]] = {
    "s": {"s": 1},
    "1/s": {"s": -1},
    "Hz": {"s": -1},
    "rad": {"rad": 1},
    "rad/s": {"rad": 1, "s": -1},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "A": {"A": 1},
    "W": {"kg": 1, "m": 2, "s": -3},
    "N.m": {"kg": 1, "m": 2, "s": -2},
    "kg.m2": {"kg": 1, "m": 2},
    "m": {"m": 1},
    "m/s": {"m": 1, "s": -1},
    "K": {"K": 1},
    "kg": {"kg": 1},
}


def description(
    variables: ExportedVariables,
    token: str,
    version: str,
    identifier: str,
    kinds: Sequence[str],
    sources: Sequence[str],
    stop: float,
) -> str:
    """The text of modelDescription.xml. version: "2.0" or "3.0"; kinds: keys of KINDS; stop: of the default experiment, s."""
    model = variables.code.model
    root = ET.Element(
        "fmiModelDescription",
        {
            "fmiVersion": version,
            "modelName": model.name,
            ("guid" if version == "2.0" else "instantiationToken"): token,
            **({"description": " ".join(model.description.split())} if model.description else {}),
            "generationTool": "hvdc_ident",
            "variableNamingConvention": "structured",
        },
    )
    count = variables.code.structure.sizes.ns
    if version == "2.0":
        root.set("numberOfEventIndicators", str(count))
    for kind in kinds:
        _interface(root, version, kind, identifier, sources, bool(model.delays))
    _units(root, variables)
    ET.SubElement(
        ET.SubElement(root, "LogCategories"), "Category", name="logStatusError", description="why a call failed"
    )
    ET.SubElement(
        root,
        "DefaultExperiment",
        startTime="0",
        stopTime=repr(stop),
        tolerance=repr(TOLERANCE),
        stepSize=repr(stop / 500),
    )
    _variables(ET.SubElement(root, "ModelVariables"), variables, version)
    _structure(ET.SubElement(root, "ModelStructure"), variables, version)
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def build_description(identifier: str, sources: Sequence[str]) -> str:
    """The text of sources/buildDescription.xml, which FMI 3.0 asks for."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(root, "BuildConfiguration", modelIdentifier=identifier)
    files = ET.SubElement(configuration, "SourceFileSet", language="C99")
    for name in sources:
        ET.SubElement(files, "SourceFile", name=name)
    ET.SubElement(configuration, "Library", name="m")
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _interface(
    root: ET.Element, version: str, kind: str, identifier: str, sources: Sequence[str], remembers: bool
) -> None:
    element = ET.SubElement(root, KINDS[kind], modelIdentifier=identifier)
    second = version == "2.0"
    element.set("canGetAndSetFMUstate" if second else "canGetAndSetFMUState", "true")
    element.set("canSerializeFMUstate" if second else "canSerializeFMUState", "true")
    element.set("providesDirectionalDerivative" if second else "providesDirectionalDerivatives", "true")
    if second:
        element.set("canNotUseMemoryManagementFunctions", "true")
    if kind == "model-exchange":
        if second:
            element.set("completedIntegratorStepNotNeeded", str(not remembers).lower())
        else:
            element.set("needsCompletedIntegratorStep", str(remembers).lower())
    else:
        element.set("canHandleVariableCommunicationStepSize", "true")
        if second:
            element.set("canInterpolateInputs", "true")
    if second:
        files = ET.SubElement(element, "SourceFiles")
        for name in sources:
            ET.SubElement(files, "File", name=name)


def _units(root: ET.Element, variables: ExportedVariables) -> None:
    names = dict.fromkeys(v.unit for v in variables.all if v.unit)
    if not names:
        return
    units = ET.SubElement(root, "UnitDefinitions")
    for name in names:
        unit = ET.SubElement(units, "Unit", name=name)
        if name in SI:
            ET.SubElement(unit, "BaseUnit", {n: str(e) for n, e in SI[name].items()})


def _numbers(v: ExportedVariable) -> dict[str, str]:
    given = {"min": v.min, "max": v.max, "nominal": v.nominal, "start": v.start}
    return {n: repr(float(x)) for n, x in given.items() if x is not None}


def _labels(v: ExportedVariable) -> dict[str, str]:
    labels = {"causality": v.causality, "variability": v.variability, "initial": v.initial}
    return {n: t for n, t in labels.items() if t} | ({"description": v.description} if v.description else {})


def _variables(parent: ET.Element, variables: ExportedVariables, version: str) -> None:
    number = {v.reference: k + 1 for k, v in enumerate(variables.all)}
    for v in variables.all:
        unit = {"unit": v.unit} if v.unit else {}
        common = {"name": v.name, "valueReference": str(v.reference), **_labels(v)}
        if version == "2.0":
            real = unit | _numbers(v)
            if v.derivative is not None:
                real["derivative"] = str(number[v.derivative])
            ET.SubElement(ET.SubElement(parent, "ScalarVariable", common), "Real", real)
        else:
            derivative = {} if v.derivative is None else {"derivative": str(v.derivative)}
            ET.SubElement(parent, "Float64", common | unit | _numbers(v) | derivative)
    if version == "3.0":
        for k in range(variables.code.structure.sizes.ns):
            ET.SubElement(
                parent,
                "Float64",
                name=f"indicators.switch_{k + 1}",
                valueReference=str(variables.first["indicators"] + k),
                causality="local",
                variability="continuous",
                initial="calculated",
            )


def _structure(parent: ET.Element, variables: ExportedVariables, version: str) -> None:
    """Add the unknowns with their dependencies: by the variables' numbers in FMI 2.0, by their references in FMI 3.0."""
    second = version == "2.0"
    number = {v.reference: k + 1 for k, v in enumerate(variables.all)}

    def unknown(parent: ET.Element, element: str, reference: int, dependencies: Sequence[int] | None) -> None:
        shown = number if second else {r: r for r in (reference, *(dependencies or ()))}
        attributes = {"index" if second else "valueReference": str(shown[reference])}
        if dependencies is not None:
            attributes["dependencies"] = " ".join(str(shown[r]) for r in dependencies)
            attributes["dependenciesKind"] = " ".join("dependent" for _ in dependencies)
        ET.SubElement(parent, "Unknown" if second else element, attributes)

    for group, element, members in (
        ("Outputs", "Output", variables.outputs),
        ("Derivatives", "ContinuousStateDerivative", variables.derivatives),
        ("InitialUnknowns", "InitialUnknown", variables.unknown_at_start),
    ):
        holder = ET.SubElement(parent, group) if second and members else parent
        for v in members:
            dependencies = None if element == "InitialUnknown" else variables.dependencies(v)
            unknown(holder, element, v.reference, dependencies)
    if not second:
        for k in range(variables.code.structure.sizes.ns):
            dependencies = variables.indicator_dependencies(k)
            unknown(parent, "EventIndicator", variables.first["indicators"] + k, dependencies)
