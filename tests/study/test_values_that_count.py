"""The values that count: those fitted with the effect that a diagnosis named, everywhere the same, and said.

The plant is a servo of two states with K = 12 and T = 50 ms. Its output y passes a transducer with a lag of 30 ms that the model
lacks; the state w before it is recorded as it is. Answers come from scipy and python-control.
"""

from __future__ import annotations

import csv
import json
import re
import tomllib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import control
import numpy as np
import pytest
from fmpy import read_model_description
from scipy.integrate import solve_ivp
from scipy.io import loadmat
from typer.testing import CliRunner

import hvdc_ident as hi
from hvdc_ident.cli import app
from hvdc_ident.errors import StudyError
from hvdc_ident.next_step import NextStep
from hvdc_ident.study.export import SSV
from hvdc_ident.study.stages.linearize import verdict
from hvdc_ident.study.value_sets import value_set
from hvdc_ident.summary import Results
from hvdc_ident.summary.decisions import counting_of
from hvdc_ident.summary.stage_results import diagnosis_of, fit_of

K, T, LAG = 12.0, 0.05, 0.03
TIME = np.arange(0.0, 1.2, 0.008)
EVENT, NOISE = 0.2, 1e-3
CARD = """schema = 1
name = "servo"
[parameters]
K = {value = 11.0, unit = "1/s", min = 0.1, max = 100}
T = {value = 0.05, unit = "s", min = 0.001, max = 1}
[inputs]
u = {value = 0.0}
[states]
x = {derivative = "K*(u - z)"}
z = {derivative = "(x - z)/T"}
[outputs]
y = "z"
w = "x"
"""
EXPERIMENT = '[[experiment]]\nname = "{0}"\ndata = "{0}.csv"\nrole = "{1}"\ninputs = ["u"]\noutputs = ["y", "w"]\n'
EXPERIMENT += 'noise = {{y = 1e-3, w = 1e-3}}\ninterpolation = "hold"\n'
STUDY = """schema = 1
name = "servos"
[model]
source = "servo.toml"
[parameters]
K = {min = 2, max = 60}
T = {min = 0.005, max = 0.2}
"""
QUESTIONS = """[linearize]
outputs = ["y"]
[fit]
starts = 2
[diagnose]
effects = ["lag", "gain"]
"""


def response(level: float, k: float = K, t: float = T, lag: float = LAG, row: int = 2) -> np.ndarray:
    """The output of the servo behind its transducer to a step at EVENT, by scipy; row 0: the state before it."""
    after = TIME[TIME >= EVENT]
    run = solve_ivp(
        lambda _, s: [k * (level - s[1]), (s[0] - s[1]) / t, (s[1] - s[2]) / lag],
        (EVENT, TIME[-1]), [0.0, 0.0, 0.0], t_eval=after, rtol=1e-10, atol=1e-12,
    )  # fmt: skip
    return np.concatenate([np.zeros(TIME.size - after.size), run.y[row]])


def done(*arguments: Any) -> str:
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert result.exit_code == 0, result.output
    return str(result.output)


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The study with everything that it asks for done."""
    folder = tmp_path_factory.mktemp("servo")
    (folder / "servo.toml").write_text(CARD)
    text = STUDY
    for seed, (name, level, role) in enumerate((("a", 1.0, "fit"), ("b", -0.6, "holdout"))):
        clean = np.array([response(level), response(level, row=0)])
        y, w = clean + NOISE * np.random.default_rng(seed).standard_normal(clean.shape)
        rows = np.column_stack([TIME, np.where(TIME >= EVENT, level, 0.0), y, w])
        np.savetxt(folder / f"{name}.csv", rows, delimiter=",", header="time,u,y,w", comments="")
        text += EXPERIMENT.format(name, role)
    (folder / "s.toml").write_text(text + QUESTIONS)
    done("run", folder / "s.toml", "--quiet")
    return folder / "s.toml"


@pytest.fixture(scope="module")
def results(study: Path) -> dict[str, Any]:
    return {p.stem: json.loads(p.read_text()) for p in (study.parent / "s-results").glob("*.json")}


@pytest.fixture(scope="module")
def values(results: dict[str, Any]) -> dict[str, float]:
    """K, T and the lag, as the diagnosis found them, near the truth."""
    found = results["discrepancy"]
    assert found["verdict"] == "named" and found["effects"][0]["effect"] == "lag"
    lag = found["effects"][0]["parameters"]["T"]["value"]
    k, t = (found["parameters_after"][n] for n in ("K", "T"))
    assert [k, t, lag] == pytest.approx([K, T, LAG], rel=0.02)
    assert abs(results["fit"]["values"]["T"] / T - 1.0) > 0.1  # it makes up for the lag
    return {"K": k, "T": t, "lag": lag}


def changed(study: Path, folder: Path, **changes: Any) -> Path:
    """A copy of the folder of results whose diagnosis has some fields changed."""
    folder.mkdir()
    for path in (study.parent / "s-results").iterdir():
        if path.is_file():
            (folder / path.name).write_bytes(path.read_bytes())
    data = json.loads((folder / "discrepancy.json").read_text())
    (folder / "discrepancy.json").write_text(json.dumps({**data, **changes}))
    return folder


def table_of(folder: Path) -> dict[str, dict[str, str]]:
    """The rows of fitted-values.csv by parameter."""
    with (folder / "fitted-values.csv").open(encoding="utf-8", newline="") as file:
        return {r["parameter"]: r for r in csv.DictReader(file)}


def servo_behind_lag(v: dict[str, float]) -> control.TransferFunction:
    """The linear model by python-control: the closed loop in series with the lag."""
    loop = control.feedback(control.tf([v["K"]], [v["T"], 1.0, 0.0]), 1)
    return control.series(loop, control.tf([1.0], [v["lag"], 1.0]))


def test_the_exported_card_is_the_model_with_the_effect(study: Path, tmp_path: Path, values: dict[str, float]) -> None:
    told = done("export", study, "--to", tmp_path / "x.toml")
    head = (tmp_path / "x.toml").read_text().splitlines()[0]
    for text in (told, head):
        assert "fitted values of study 'servos', with lag at" in text and "as the diagnosis named it" in text
    u = hi.step(0.0, 1.0, at=EVENT)
    run = hi.simulate(tmp_path / "x.toml", TIME, inputs={"u": u}, outputs="y")["y"]
    assert np.abs(run - response(1.0, values["K"], values["T"], values["lag"])).max() < 1e-6
    augmented = np.genfromtxt(study.parent / "s-results/discrepancy.a.csv", delimiter=",", names=True)
    assert np.abs(run - augmented["y"]).max() < 1e-9


def test_an_fmu_and_modelica_text_hold_the_effect_and_say_so(
    study: Path, tmp_path: Path, values: dict[str, float]
) -> None:
    done("export", study, "--to", tmp_path / "x.fmu", "--source-only")
    d = read_model_description(str(tmp_path / "x.fmu"))
    start = {v.name: float(v.start) for v in d.modelVariables if v.causality == "parameter"}
    lag = next(v for n, v in start.items() if n.startswith("lag_"))
    assert [start["K"], start["T"], lag] == [values["K"], values["T"], values["lag"]] and len(d.derivatives) == 3
    assert "with lag at" in d.description
    done("export", study, "--to", tmp_path / "x.mo")
    text = (tmp_path / "x.mo").read_text()
    assert repr(values["lag"]) in text and "with lag at" in text.splitlines()[0]


def test_the_linear_model_is_that_of_the_servo_behind_the_lag(
    study: Path, tmp_path: Path, values: dict[str, float], results: dict[str, Any]
) -> None:
    want = servo_behind_lag(values)
    done("export", study, "--to", tmp_path / "x.mat")
    found = loadmat(tmp_path / "x.mat", squeeze_me=True)
    for a in (found["A"], np.array(results["linearization"]["fitted"]["A"])):
        np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(a)), np.sort_complex(want.poles()), rtol=1e-9)
    assert "with lag at" in str(found["provenance"]["values"])
    done("export", study, "--to", tmp_path / "x.csv")
    table = np.genfromtxt(tmp_path / "x.csv", delimiter=",", names=True)
    np.testing.assert_allclose(
        table["re_y_from_u"] + 1j * table["im_y_from_u"], want(1j * table["omega"]), rtol=1e-8, atol=1e-12
    )
    fitted = results["linearization"]["fitted"]
    assert (results["linearization"]["set"], fitted["set"], fitted["values"]) == ("given", "effect", "fitted")
    assert "with lag at" in results["linearization"]["fitted_note"]
    slowest = np.linalg.eigvals(np.array(fitted["A"])).real.max()
    assert verdict(results["linearization"]).startswith(
        f"with the effect: stable, rightmost eigenvalue {slowest:.4g} 1/s"
    )


@pytest.mark.parametrize(("name", "poles"), [("effect", 3), ("fit", 2), ("fitted", 3), ("given", 2)])
def test_either_set_is_had_by_its_name(
    study: Path, tmp_path: Path, values: dict[str, float], results: dict[str, Any], name: str, poles: int
) -> None:
    told = json.loads(done("export", study, "--to", tmp_path / "x.json", "--values", name, "--json"))
    assert told["values"] == name and told["set"] == {"fitted": "effect"}.get(name, name)
    data = json.loads((tmp_path / "x.json").read_text())
    assert len(data["A"]) == poles and data["provenance"]["values"] == told["note"]
    k = {"fit": results["fit"]["values"]["K"], "given": 11.0}.get(name, values["K"])
    hi.export(study, tmp_path / "x.toml", values=name)
    card = tomllib.loads((tmp_path / "x.toml").read_text())
    assert card["parameters"]["K"]["value"] == k and ("with lag at" in told["note"]) == (name != "given")
    assert ("without an effect" in told["note"]) == (name == "fit")


def test_the_files_of_fitted_values_make_a_study_with_the_effect(
    study: Path, tmp_path: Path, values: dict[str, float]
) -> None:
    folder = study.parent / "s-results"
    text = (folder / "fitted-values.toml").read_text()
    assert "set 'effect'" in text.splitlines()[0]
    (tmp_path / "servo.toml").write_text(CARD)
    (tmp_path / "pasted.toml").write_text(f'schema = 1\n[model]\nsource = "servo.toml"\n{text}')
    run = hi.simulate(tmp_path / "pasted.toml", TIME, inputs={"u": hi.step(0.0, 1.0, at=EVENT)}, outputs="y")["y"]
    assert np.abs(run - response(1.0, values["K"], values["T"], values["lag"])).max() < 1e-6
    rows = table_of(folder)
    lag = next(n for n in rows if n.startswith("lag_"))
    assert {n: float(r["value"]) for n, r in rows.items()} == {
        "K": values["K"], "T": values["T"], lag: values["lag"]
    }  # fmt: skip
    assert {r["set"] for r in rows.values()} == {"effect"}
    assert all(float(r["ci95_low"]) < float(r["value"]) < float(r["ci95_high"]) for r in rows.values())
    root = ET.parse(folder / "fitted-values.ssv").getroot()
    reals = {p.get("name"): float(p[0].get("value", "")) for p in root.iter(f"{{{SSV}}}Parameter")}
    assert reals == {n: float(r["value"]) for n, r in rows.items()}
    assert "set 'effect'" in root.get("description", "")


def test_the_files_follow_whichever_result_came_last(study: Path, tmp_path: Path) -> None:
    """A fit that runs anew leaves the values of the diagnosis that stands; without it they are the fit's."""
    folder = changed(study, tmp_path / "r")
    before = (folder / "fitted-values.csv").read_text()
    done("fit", study, "--out", folder, "--quiet")
    assert (folder / "fitted-values.csv").read_text() == before
    (folder / "discrepancy.json").unlink()
    done("fit", study, "--out", folder, "--quiet")
    fit = json.loads((folder / "fit.json").read_text())
    rows = table_of(folder)
    assert {n: float(r["value"]) for n, r in rows.items()} == fit["values"]
    assert {r["set"] for r in rows.values()} == {"fit"} and "set 'fit'" in (folder / "fitted-values.toml").read_text()


def test_an_ambiguous_diagnosis_decides_nothing(study: Path, tmp_path: Path, results: dict[str, Any]) -> None:
    folder = changed(study, tmp_path / "r", verdict="ambiguous")
    loaded, fit = hi.load_study(study), results["fit"]["values"]
    for wanted in (None, "fitted"):
        found = value_set(loaded, wanted, folder)
        assert (found.name, found.of, found.model) == ("fitted", "fit", None) and dict(found.values) == fit
        assert "without an effect" in found.note and "the diagnosis is ambiguous" in found.note
        assert found.next == (NextStep("values", "effect"),) and "with lag at" in found.note
    asked = value_set(loaded, "effect", folder)
    assert asked.of == "effect" and "not certain: the diagnosis is ambiguous" in asked.note
    summary = Results(folder).summary
    assert {p.name: p.value for p in summary.parameters} == fit
    # Without the effect the model does not fit.
    assert next(p.interval for p in summary.parameters if p.name == "K") is None
    assert results["fit"]["estimates"]["K"]["ci95"] is None
    done("report", folder, "--quiet")
    page = (folder / "report.html").read_text()
    assert "Fitted without an effect: the diagnosis is ambiguous" in page


def test_the_report_and_the_screen_take_the_set_that_is_exported(
    study: Path, values: dict[str, float], results: dict[str, Any]
) -> None:
    summary = Results(study.parent / "s-results").summary
    assert {p.name: p.value for p in summary.parameters} == {n: values[n] for n in ("K", "T")}
    told = done("run", study)
    assert "The values that count are those with lag at" in told
    assert results["discrepancy"]["residual_tests_after"]["y"]["a"]["ljung_box"]["p"] > 0.001
    assert results["fit"]["residual_tests"]["y"]["a"]["ljung_box"]["p"] < 1e-6
    page = (study.parent / "s-results/report.html").read_text()
    assert "With the effect, at the values that count" in page


def test_a_comparison_takes_the_values_that_count(
    study: Path, tmp_path: Path, values: dict[str, float], results: dict[str, Any]
) -> None:
    other = changed(study, tmp_path / "r", verdict="ambiguous")
    data = json.loads(done("compare", study, other, "--json"))
    k = next(v for v in data["values"] if v["parameter"] == "K")
    assert k["values"] == [values["K"], results["fit"]["values"]["K"]] and k["with_effect"] == [values["K"]] * 2
    assert k["ci95"][0] == results["discrepancy"]["estimates_after"]["K"]["ci95"]
    assert [s["name"] for s in data["sets"]] == ["effect", "fit"]
    told = done("compare", study, other)
    assert "values of the first: fitted with lag at" in told
    assert "values of the second: fitted without an effect; the diagnosis is ambiguous" in told
    assert "No value has an interval in both, by which to judge it." in told


def test_without_a_diagnosis_there_are_no_values_with_an_effect(study: Path, tmp_path: Path) -> None:
    loaded, folder = hi.load_study(study), changed(study, tmp_path / "r")
    (folder / "discrepancy.json").unlink()
    assert value_set(loaded, None, folder).of == "fit"
    with pytest.raises(StudyError, match="no diagnose has run"):
        value_set(loaded, "effect", folder)
    (folder / "discrepancy.json").write_text(
        json.dumps({**json.loads((study.parent / "s-results/discrepancy.json").read_text()), "sources": {}})
    )
    found = value_set(loaded, "fitted", folder)
    assert found.of == "fit" and "the diagnose in" in found.note and "earlier state" in found.note


@pytest.mark.parametrize(
    ("verdict", "name", "doubt"),
    [
        ("named", "effect", ""),
        ("ambiguous", "fit", "the diagnosis is ambiguous"),
        ("unnameable", "fit", "something is missing that the diagnosis cannot name"),
        ("no-evidence", "fit", ""),
    ],
)
def test_one_function_decides(verdict: str, name: str, doubt: str) -> None:
    effect = {"effect": "lag", "at": ["y"], "parameters": {"T": {"value": 0.03, "unit": "s"}}}
    diagnosis = diagnosis_of({"verdict": verdict, "effects": [] if verdict == "no-evidence" else [effect]})
    converged, failed = fit_of({"status": "converged"}), fit_of({"status": "failed"})
    found = counting_of(converged, diagnosis)
    assert (found.name, found.doubt) == (name, doubt)
    assert counting_of(failed, diagnosis).name == ("effect" if name == "effect" else "")
    assert counting_of(converged, None).name == "fit"
    assert re.fullmatch(r"(lag at y \(T = 30 ms\))?", found.added)
