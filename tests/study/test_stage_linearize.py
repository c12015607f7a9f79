"""The stage `linearize` and the command `export`, through the command line."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from hvdc_ident.cli import app

SMIB = """schema = 1
name = "smib"
[parameters]
H = {value = 3.148}
D = {value = 2.0}
Pmax = {value = 2.98094}
wb = {value = 376.99111843}
[inputs]
Pm = {value = 0.5}
[states]
delta = {derivative = "wb*(w - 1)", start = 0.1}
w = {derivative = "(Pm - Pe - D*(w - 1))/(2*H)", start = 1.0}
[signals]
Pe = "Pmax*sin(delta)"
[outputs]
Pe = "Pe"
"""


@pytest.fixture
def study(tmp_path):
    (tmp_path / "smib.toml").write_text(SMIB)
    path = tmp_path / "study.toml"
    path.write_text(
        'schema = 1\nname = "smib"\n[model]\nsource = "smib.toml"\n'
        '[parameters]\nH = {start = 3.148, min = 1, max = 10}\n[linearize]\ninputs = ["Pm"]\noutputs = ["Pe"]\n'
    )
    return path


def run(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_linearization_json_keeps_its_contract(study, tmp_path):
    result = run("linearize", study, "--out", tmp_path / "r", "--quiet")
    assert result.exit_code == 0, result.output
    data = json.loads((tmp_path / "r/linearization.json").read_text())
    for key in ("schema", "study", "model", "software", "seed", "A", "B", "C", "D", "method", "jacobian_error"):
        assert key in data, key
    assert {"states", "inputs", "outputs", "residual", "active_limits"} <= set(data["operating_point"])
    assert data["state_names"] == ["delta", "w"] and data["input_names"] == ["Pm"] and data["output_names"] == ["Pe"]
    assert data["method"] == "symbolic" and data["jacobian_error"] < 1e-14
    for mode in data["modes"]:
        assert {"eigenvalue", "frequency_hz", "damping", "participation"} <= set(mode)
    k = np.sqrt(2.98094**2 - 0.25)
    want = np.sort_complex(np.roots([1, 2 / 6.296, 376.99111843 * k / 6.296]))
    got = np.sort_complex([complex(*m["eigenvalue"]) for m in data["modes"]])
    np.testing.assert_allclose(got, want, atol=1e-10)
    (f,) = data["transfer_functions"]
    assert {"input", "output", "zeros", "poles", "gain"} <= set(f)
    assert set(data["modes"][0]["sensitivity"]) == {"H"}
    assert "null" not in json.dumps(data)


def test_at_start_uses_the_given_start(study, tmp_path):
    study.write_text(study.read_text() + 'at = "start"\n')
    assert run("linearize", study, "--out", tmp_path / "r", "--quiet").exit_code == 0
    point = json.loads((tmp_path / "r/linearization.json").read_text())["operating_point"]
    assert point["states"] == {"delta": 0.1, "w": 1.0} and point["at"] == "start"


@pytest.mark.parametrize("ending", ["mat", "json", "m", "mo", "csv", "tex", "zpk", "toml"])
def test_export_by_ending(study, tmp_path, ending):
    path = tmp_path / f"out.{ending}"
    result = run("export", study, "--to", path)
    assert result.exit_code == 0, result.output
    assert path.stat().st_size > 50


def test_the_exported_card_is_the_model(study, tmp_path):
    from hvdc_ident import load_model

    run("export", study, "--to", tmp_path / "out.toml")
    assert load_model(tmp_path / "out.toml").states == load_model(tmp_path / "smib.toml").states


@pytest.mark.parametrize("to", ["out.xyz", "out", "out.docx"])
def test_an_unknown_ending_is_bad_input(study, tmp_path, to):
    result = run("export", study, "--to", tmp_path / to)
    assert result.exit_code == 2 and "expected one of" in result.output
    assert not (tmp_path / to).exists()


def test_a_model_without_rest_is_bad_input(study, tmp_path):
    (tmp_path / "smib.toml").write_text(SMIB.replace("value = 0.5", "value = 5.0"))
    result = run("linearize", study, "--out", tmp_path / "r")
    assert result.exit_code == 2 and "d(w)/dt" in result.output and "Traceback" not in result.output
