"""`hvdc-ident export` of the model itself: FMU, Modelica text, card, parameters."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import fmpy
import pytest
from fmpy import read_model_description
from fmpy.validation import validate_fmu
from lxml import etree
from typer.testing import CliRunner

from hvdc_ident.cli import app
from hvdc_ident.errors import StudyError
from hvdc_ident.linearize import linearize
from hvdc_ident.models import load_model
from hvdc_ident.study.export import FmuOptions, write
from hvdc_ident.study.study import load_study

STUDY = """
schema = 1
name = "an export"
[model]
source = "vsc-hvdc-link"
[model.values]
Rdc = 3e-4
[[model.effect]]
effect = "lag"
at = ["Ir1", "Ir2"]
parameters = {T = 0.0016}
[parameters]
KPVDC = {given = 21.5, start = 30, min = 10, max = 40}
"""


@pytest.fixture
def study(tmp_path: Path) -> Path:
    path = tmp_path / "study.toml"
    path.write_text(STUDY)
    return path


def command(*arguments: object):
    """The result of `hvdc-ident export ...`."""
    return CliRunner().invoke(app, ["export", *map(str, arguments)])


def test_an_fmu_has_the_effects_and_the_study_s_values(study: Path, tmp_path: Path) -> None:
    done = command(study, "--to", tmp_path / "x.fmu", "--source-only")
    assert done.exit_code == 0 and "FMI 2.0" in done.stdout and "sources only, as asked" in done.stdout
    assert validate_fmu(str(tmp_path / "x.fmu")) == []
    d = read_model_description(str(tmp_path / "x.fmu"))
    start = {v.name: float(v.start) for v in d.modelVariables if v.causality == "parameter"}
    assert start["KPVDC"] == 21.5 and start["Rdc"] == 3e-4 and start["lag_Ir1_T"] == 0.0016
    assert d.modelExchange is not None and d.coSimulation is not None
    assert len(d.derivatives) == 8


def test_version_and_kind_are_chosen_by_options(study: Path, tmp_path: Path) -> None:
    done = command(study, "--to", tmp_path / "x.fmu", "--source-only", "--fmi", "3", "--kind", "cs", "--json")
    assert done.exit_code == 0 and json.loads(done.stdout)["note"].startswith("FMI 3.0, co-simulation")
    d = read_model_description(str(tmp_path / "x.fmu"))
    assert d.fmiVersion == "3.0" and d.modelExchange is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["x.fmu", "--fmi", "1"], "expected 2 or 3"),
        (["x.fmu", "--kind", "both"], "expected me or cs"),
        (["x.mo", "--fmi", "3"], "expected a file *.fmu"),
        (["x.xyz"], "expected one of .csv, .dyr, .fmu"),
    ],
)
def test_what_does_not_go_together_is_refused(study: Path, tmp_path: Path, options: list[str], message: str) -> None:
    done = command(study, "--to", tmp_path / options[0], *options[1:])
    assert done.exit_code == 2 and message in done.stderr
    assert list(tmp_path.iterdir()) == [study]


def test_without_a_compiler_the_command_says_so(study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    done = command(study, "--to", tmp_path / "x.fmu")
    assert done.exit_code == 0 and "sources only: no C compiler was there" in done.stdout


def test_modelica_is_the_model_or_its_linear_model(study: Path, tmp_path: Path) -> None:
    assert command(study, "--to", tmp_path / "Link.mo").exit_code == 0
    text = (tmp_path / "Link.mo").read_text()
    assert text.startswith("model Link ") and "clip(" not in text and "= 0.0016 " in text
    assert command(study, "--to", tmp_path / "Linear.mo", "--linear").exit_code == 0
    assert "parameter Real A[8, 8]" in (tmp_path / "Linear.mo").read_text()


def test_parameters_are_an_ssp_parameter_set(study: Path, tmp_path: Path) -> None:
    assert command(study, "--to", tmp_path / "x.ssv").exit_code == 0
    folder = Path(fmpy.__file__).parent / "ssp" / "schema"
    schema = etree.XMLSchema(etree.parse(str(folder / "SystemStructureParameterValues.xsd")))
    tree = etree.parse(str(tmp_path / "x.ssv"))
    schema.assertValid(tree)
    names = {"ssv": "http://ssp-standard.org/SSP1/SystemStructureParameterValues"}
    found = {p.get("name"): float(p[0].get("value")) for p in tree.iterfind(".//ssv:Parameter", names)}
    assert found == dict(load_study(study).model.values) | {"KPVDC": 21.5}


def test_a_model_may_be_given_in_python(tmp_path: Path) -> None:
    link = load_model("vsc-hvdc-link")
    path = write(link, tmp_path / "x.fmu", fmu=FmuOptions(version="3.0", binary=False)).path
    assert read_model_description(str(path)).fmiVersion == "3.0"
    assert write(link, tmp_path / "L.mo").path.read_text().startswith("model L ")
    assert "A[6, 6]" in write(linearize(link), tmp_path / "K.mo").path.read_text()
    with pytest.raises(StudyError, match="no export has this ending"):
        write(linearize(link), tmp_path / "x.fmu")


def test_a_study_of_an_fmu_has_no_equations_to_write(study: Path, tmp_path: Path) -> None:
    command(study, "--to", tmp_path / "x.fmu", "--source-only")
    shutil.copy(study, tmp_path / "second.toml")
    second = tmp_path / "second.toml"
    second.write_text('schema = 1\nname = "fmu"\n[model]\nsource = "x.fmu"\n')
    done = command(second, "--to", tmp_path / "y.fmu")
    assert done.exit_code == 2 and not (tmp_path / "y.fmu").exists()
