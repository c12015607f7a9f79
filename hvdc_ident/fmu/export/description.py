"""modelDescription.xml of FMI 2.0 and 3.0, and the build description of FMI 3.0's sources."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from xml.etree import ElementTree as ET

from hvdc_ident.fmu.export.program import TOLERANCE
from hvdc_ident.fmu.export.variables import Variable, Variables

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
    variables: Variables,
    token: str,
    version: str,
    identifier: str,
    kinds: Sequence[str],
    sources: Sequence[str],
    stop: float,
) -> str:
    """The text of modelDescription.xml. version: "2.0" or "3.0"; kinds: keys of KINDS; stop: of the default experiment, s."""
    model = variables.program.model
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
    count = variables.program.structure.sizes.ns
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
    structure = ET.SubElement(root, "ModelStructure")
    if version == "2.0":
        _structure_2(structure, variables)
    else:
        _structure_3(structure, variables)
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


def _units(root: ET.Element, variables: Variables) -> None:
    names = dict.fromkeys(v.unit for v in variables.all if v.unit)
    if not names:
        return
    units = ET.SubElement(root, "UnitDefinitions")
    for name in names:
        unit = ET.SubElement(units, "Unit", name=name)
        if name in SI:
            ET.SubElement(unit, "BaseUnit", {n: str(e) for n, e in SI[name].items()})


def _numbers(v: Variable) -> dict[str, str]:
    given = {"min": v.min, "max": v.max, "nominal": v.nominal, "start": v.start}
    return {n: repr(float(x)) for n, x in given.items() if x is not None}


def _labels(v: Variable) -> dict[str, str]:
    labels = {"causality": v.causality, "variability": v.variability, "initial": v.initial}
    return {n: t for n, t in labels.items() if t} | ({"description": v.description} if v.description else {})


def _variables(parent: ET.Element, variables: Variables, version: str) -> None:
    place = {v.reference: k + 1 for k, v in enumerate(variables.all)}
    for v in variables.all:
        unit = {"unit": v.unit} if v.unit else {}
        common = {"name": v.name, "valueReference": str(v.reference), **_labels(v)}
        if version == "2.0":
            real = unit | _numbers(v)
            if v.derivative is not None:
                real["derivative"] = str(place[v.derivative])
            ET.SubElement(ET.SubElement(parent, "ScalarVariable", common), "Real", real)
        else:
            derivative = {} if v.derivative is None else {"derivative": str(v.derivative)}
            ET.SubElement(parent, "Float64", common | unit | _numbers(v) | derivative)
    if version == "3.0":
        for k in range(variables.program.structure.sizes.ns):
            ET.SubElement(
                parent,
                "Float64",
                name=f"indicators.switch_{k + 1}",
                valueReference=str(variables.first["indicators"] + k),
                causality="local",
                variability="continuous",
                initial="calculated",
            )


def _dependent(places: Sequence[int]) -> dict[str, str]:
    return {"dependencies": " ".join(map(str, places)), "dependenciesKind": " ".join("dependent" for _ in places)}


def _structure_2(structure: ET.Element, variables: Variables) -> None:
    place = {v.reference: k + 1 for k, v in enumerate(variables.all)}
    for group, members in (("Outputs", variables.outputs), ("Derivatives", variables.derivatives)):
        if not members:
            continue
        parent = ET.SubElement(structure, group)
        for v in members:
            known = _dependent([place[r] for r in variables.dependencies(v)])
            ET.SubElement(parent, "Unknown", {"index": str(place[v.reference]), **known})
    if variables.unknown_at_start:
        parent = ET.SubElement(structure, "InitialUnknowns")
        for v in variables.unknown_at_start:
            ET.SubElement(parent, "Unknown", index=str(place[v.reference]))


def _structure_3(structure: ET.Element, variables: Variables) -> None:
    def unknowns(kind: str, members: Sequence[Variable]) -> Iterator[None]:
        for v in members:
            known = _dependent(variables.dependencies(v))
            yield ET.SubElement(structure, kind, {"valueReference": str(v.reference), **known})  # type: ignore[misc]

    list(unknowns("Output", variables.outputs))
    list(unknowns("ContinuousStateDerivative", variables.derivatives))
    for v in variables.unknown_at_start:
        ET.SubElement(structure, "InitialUnknown", valueReference=str(v.reference))
    for k in range(variables.program.structure.sizes.ns):
        known = _dependent(variables.indicator_dependencies(k))
        ET.SubElement(structure, "EventIndicator", {"valueReference": str(variables.first["indicators"] + k), **known})
