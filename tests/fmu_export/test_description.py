"""What an exported FMU says of itself, and what it is made of."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

import pytest
from fmpy import read_model_description
from fmpy.validation import validate_fmu

from hvdc_ident.errors import ComputationError, ModelError
from hvdc_ident.fmu.export import export_fmu
from hvdc_ident.fmu.export.c_model import CModel
from hvdc_ident.model import Model
from hvdc_ident.models import load_model, shipped_models
from tests.fmu_export import cases

ALL = {
    **{n: (lambda n=n: load_model(n)) for n in shipped_models()},
    **{n: getattr(cases, n) for n in ("zoo", "augmented", "remembering", "punctual")},
}


@pytest.mark.parametrize("name", sorted(ALL))
def test_the_validator_finds_nothing(tmp_path: Path, name: str) -> None:
    program = CModel(ALL[name]())  # the same for both versions
    for version in ("2.0", "3.0"):
        for kinds in (("model-exchange", "co-simulation"), ("model-exchange",), ("co-simulation",)):
            path = export_fmu(program, tmp_path / "x.fmu", version=version, kinds=kinds, binary=False).path
            assert validate_fmu(str(path)) == [], (version, kinds)


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_it_says_what_the_model_is(tmp_path: Path, version: str) -> None:
    model = cases.zoo()
    d = read_model_description(str(export_fmu(model, tmp_path / "x.fmu", version=version, binary=False).path))
    by_name = {v.name: v for v in d.modelVariables}
    assert [v.name for v in d.modelVariables if v.causality == "input"] == ["u", "d"]
    # An output that is a state is that variable; one whose name is an input's is told apart, as slots are.
    assert [v.name for v in d.modelVariables if v.causality == "output"] == [
        "x",
        "v",
        "outputs.u",
        "held",
        "late",
        "clock",
    ]
    states = [u.variable.derivative for u in d.derivatives]
    assert [v.name for v in states] == ["x", "states.v", "f", "q"]
    assert [v.initial for v in states] == ["approx", "calculated", "calculated", "approx"]
    parameters = {v.name: v for v in d.modelVariables if v.causality == "parameter"}
    assert list(parameters) == list(model.parameters)
    assert {n for n, v in parameters.items() if v.variability == "fixed"} == {"T", "Ts"}
    assert parameters["a"].unit == "1/s" and float(parameters["a"].start) == 20.0 and float(parameters["a"].min) == 0.0
    assert by_name["level"].description == "of the limit & more <than> that"
    assert all(float(v.nominal or 1.0) > 0.0 for v in states)
    with zipfile.ZipFile(tmp_path / "x.fmu") as archive:
        text = archive.read("modelDescription.xml").decode()
    attributes = (
        ("providesDirectionalDerivative", "canGetAndSetFMUstate", "canSerializeFMUstate")
        if version == "2.0"
        else ("providesDirectionalDerivatives", "canGetAndSetFMUState", "canSerializeFMUState")
    )
    assert [text.count(f'{a}="true"') for a in attributes] == [2, 2, 2]
    assert d.modelExchange.needsCompletedIntegratorStep  # it keeps a history


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_dependencies_name_what_moves_an_unknown(tmp_path: Path, version: str) -> None:
    d = read_model_description(str(export_fmu(cases.zoo(), tmp_path / "x.fmu", version=version, binary=False).path))
    by_unknown = {u.variable.name: {v.name for v in u.dependencies} for u in (*d.outputs, *d.derivatives)}
    assert by_unknown["x"] == {"x"}
    assert by_unknown["outputs.u"] == {"u"}
    assert by_unknown["der(x)"] == {"x", "u", "d"}  # d by a condition alone
    assert by_unknown["der(f)"] == {"f", "u"}  # u by its sign alone
    assert by_unknown["der(q)"] == {"x", "d", "q", "time"}  # through the unknown z; the delayed value moves with time
    assert by_unknown["held"] == {"time"}


def test_kinds_can_be_chosen(tmp_path: Path) -> None:
    for kind in ("model-exchange", "co-simulation"):
        d = read_model_description(str(export_fmu(cases.zoo(), tmp_path / "x.fmu", kinds=[kind], binary=False).path))
        assert (d.modelExchange is not None) == (kind == "model-exchange")
        assert (d.coSimulation is not None) == (kind == "co-simulation")


def test_the_same_model_gives_the_same_file(tmp_path: Path) -> None:
    a, b = (export_fmu(cases.zoo(), tmp_path / n, binary=False).path.read_bytes() for n in ("a.fmu", "b.fmu"))
    assert a == b
    other = export_fmu(cases.zoo().with_values({"a": 21.0}), tmp_path / "c.fmu", binary=False).path
    tokens = [read_model_description(str(p)).guid for p in (tmp_path / "a.fmu", other)]
    assert tokens[0] != tokens[1]


def test_without_a_compiler_the_sources_alone_are_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    written = export_fmu(cases.zoo(), tmp_path / "x.fmu")
    assert written.binary is None and "no C compiler" in written.note
    names = zipfile.ZipFile(written.path).namelist()
    assert not [n for n in names if n.startswith("binaries/")]
    text = zipfile.ZipFile(written.path).read("modelDescription.xml").decode()
    listed = set(re.findall(r'<File name="([^"]+)"', text))
    assert listed == {"fmu.c"}
    sources = [zipfile.ZipFile(written.path).read(n).decode() for n in names if n.startswith("sources/")]
    included = set(re.findall(r'#include "([^"]+)"', "\n".join(sources)))
    assert "model.c" in included and {f"sources/{n}" for n in listed | included} - {"sources/fmi3.c"} <= set(names)
    with pytest.raises(ModelError, match="no C compiler"):
        export_fmu(cases.zoo(), tmp_path / "y.fmu", binary=True)
    assert not (tmp_path / "y.fmu").exists()


def test_a_compiler_that_fails_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "false")
    with pytest.raises(ComputationError, match="did not accept") as e:
        export_fmu(cases.zoo(), tmp_path / "x.fmu")
    assert "CC" in e.value.hint and not (tmp_path / "x.fmu").exists()


def test_options_that_are_not_known_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="version"):
        export_fmu(cases.zoo(), tmp_path / "x.fmu", version="1.0")
    with pytest.raises(ModelError, match="kind"):
        export_fmu(cases.zoo(), tmp_path / "x.fmu", kinds=["scheduled"])


def test_a_model_without_states_or_inputs_is_exported_too(tmp_path: Path) -> None:
    bare = Model(name="1 bare", parameters={"g": 2.0}, outputs={"y": "3*g + sin(time)"})
    path = export_fmu(bare, tmp_path / "x.fmu", binary=False).path
    assert validate_fmu(str(path)) == []
    assert read_model_description(str(path)).coSimulation.modelIdentifier == "m_1_bare"
