"""Which value is which: given, start and fitted values of a study whose search begins far from the vendor's values.

The plant is a loop of two states with K = 12; the vendor says K = 11, the search begins at 30. Only K*g shows, so that g
is held: at the vendor's 1, not at the 2 where its search begins. Answers come from closed forms and scipy.
"""

from __future__ import annotations

import json
import re
import shlex
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

from hvdc_ident import export, load_study
from hvdc_ident.cli import app
from hvdc_ident.errors import InputError, StudyError
from hvdc_ident.next_step import next_phrases
from hvdc_ident.report.letter import letter_of
from hvdc_ident.study.export import SSV
from hvdc_ident.study.value_sets import value_set
from hvdc_ident.summary import Results

GIVEN = {"K": 11.0, "T": 0.05, "g": 1.0}
START = {"K": 30.0, "T": 0.02, "g": 2.0}
TRUE = {"K": 12.0, "T": 0.05, "g": 1.0}
TIME = np.arange(0.0, 1.0, 0.008)
EVENT, NOISE = 0.2, 1e-3

CARD = """schema = 1
name = "loop"
[parameters]
K = {value = 10.0, unit = "1/s", min = 0.1, max = 100}
T = {value = 0.05, unit = "s", min = 0.001, max = 1}
g = {value = 1.0, min = 0.1, max = 10}
[inputs]
u = {value = 0.0}
[states]
x = {derivative = "K*g*(u - z)"}
z = {derivative = "(x - z)/T"}
[outputs]
y = "z"
"""
CANDIDATES = """[parameters]
K = {start = 30, min = 2, max = 60, given = 11}
T = {start = 0.02, min = 0.005, max = 0.2}
g = {start = 2.0, min = 0.2, max = 5}
"""
QUESTIONS = """[linearize]
inputs = ["u"]
outputs = ["y"]
[fit]
starts = 2
[diagnose]
effects = ["lag"]
"""
EXPERIMENT = '[[experiment]]\nname = "{0}"\ndata = "{0}.csv"\nrole = "{1}"\ninputs = ["u"]\noutputs = ["y"]\n'
EXPERIMENT += 'noise = {{y = 1e-3}}\ninterpolation = "hold"\n'


def response(level: float, values: dict[str, float]) -> np.ndarray:
    """The output of the loop to a step at EVENT, by scipy."""
    gain, lag = values["K"] * values["g"], values["T"]
    after = TIME[TIME >= EVENT]
    run = solve_ivp(
        lambda _, s: [gain * (level - s[1]), (s[0] - s[1]) / lag],
        (EVENT, TIME[-1]), [0.0, 0.0], t_eval=after, rtol=1e-10, atol=1e-12,
    )  # fmt: skip
    return np.concatenate([np.zeros(TIME.size - after.size), run.y[1]])


def state_matrix(values: dict[str, float]) -> np.ndarray:
    return np.array([[0.0, -values["K"] * values["g"]], [1 / values["T"], -1 / values["T"]]])


def write_study(folder: Path, candidates: str = CANDIDATES, questions: str = QUESTIONS, model: str = "") -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "loop.toml").write_text(CARD)
    for seed, (name, level) in enumerate({"a": 1.0, "b": -0.6}.items()):
        y = response(level, TRUE) + NOISE * np.random.default_rng(seed).standard_normal(TIME.size)
        rows = np.column_stack([TIME, np.where(TIME >= EVENT, level, 0.0), y])
        np.savetxt(folder / f"{name}.csv", rows, delimiter=",", header="time,u,y", comments="")
    text = 'schema = 1\nname = "loops"\n[model]\nsource = "loop.toml"\n' + model + candidates
    text += EXPERIMENT.format("a", "fit") + EXPERIMENT.format("b", "holdout") + questions
    (folder / "s.toml").write_text(text)
    return folder / "s.toml"


def run(*arguments: Any) -> Any:
    return CliRunner().invoke(app, [str(a) for a in arguments])


def done(*arguments: Any) -> str:
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    return str(result.output)


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The study with everything that it asks for done."""
    path = write_study(tmp_path_factory.mktemp("values"))
    done("run", path, "--quiet")
    return path


@pytest.fixture(scope="module")
def results(study: Path) -> dict[str, Any]:
    return {p.stem: json.loads(p.read_text()) for p in (study.parent / "s-results").glob("*.json")}


@pytest.fixture(scope="module")
def fitted(results: dict[str, Any]) -> dict[str, float]:
    return dict(results["fit"]["values"])


LEVER = """schema = 1
name = "lever"
[parameters]
a = {{value = {given}, min = -10, max = 10}}
[inputs]
u = {{value = 1.0}}
[states]
x = {{derivative = "a*x + u"}}
[outputs]
y = "x"
"""


@pytest.mark.parametrize("given, start, at_given, at_start", [(-2, 0.5, False, True), (0.5, -2, True, False)])
def test_a_start_is_judged_at_the_values_that_a_stage_runs_at(
    tmp_path: Path, given: float, start: float, at_given: bool, at_start: bool
) -> None:
    """x' = a x + u rests at -u/a, where it is stable for a < 0 only."""
    (tmp_path / "lever.toml").write_text(LEVER.format(given=given))
    t = np.linspace(0.0, 2.0, 101)
    # From rest at u = 1 the input falls to 0.9 at 0.5 s; a is -1.
    y = np.where(t < 0.5, 1.0, 0.9 + 0.1 * np.exp(-np.maximum(t - 0.5, 0.0)))
    rows = np.column_stack([t, np.where(t < 0.5, 1.0, 0.9), y])
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header="time,u,y", comments="")
    (tmp_path / "s.toml").write_text(
        'schema = 1\n[model]\nsource = "lever.toml"\n[identifiability]\n'
        + f"[parameters]\na = {{start = {start}, min = -4, max = 1}}\n"
        + EXPERIMENT.format("a", "fit")
    )

    def unstable(command: str) -> set[str]:
        """Where an unstable steady state is said to lie."""
        lines = json.loads(run(command, tmp_path / "s.toml", "--json").stdout)["steady_state"]
        return {line.split(":")[0] for line in lines if "Unstable" in line}

    given_places = {"model", "experiment a"} if at_given else set()
    start_places = {f"{w}, at the start values" for w in ("model", "experiment a")} if at_start else set()
    assert unstable("simulate") == given_places
    assert unstable("check") == unstable("identify") == given_places | start_places


def test_the_command_that_is_offered_next_works_where_it_is_pasted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From another folder, with a blank in a name and another folder of results; the JSON knows no place."""
    folder = tmp_path / "my studies"
    path = write_study(folder, questions="[fit]\nstarts = 1\n")
    rows = np.loadtxt(folder / "a.csv", delimiter=",", skiprows=1)
    rows[:, 2] += np.where(TIME < EVENT, 0.0, 0.01 * np.sin(2 * np.pi * 5.0 * TIME))  # no gain makes such a tone
    np.savetxt(folder / "a.csv", rows, delimiter=",", header="time,u,y", comments="")
    monkeypatch.chdir(tmp_path)
    for command in ("identify", "fit"):
        result = run(command, path.relative_to(tmp_path), "--out", "other results")
        assert result.exit_code == 0
        line = next(n for n in result.output.splitlines() if "hvdc-ident diagnose" in n)
        typed = shlex.split(line[line.index("hvdc-ident diagnose") :].partition("`")[0])
        assert typed[1:3] == ["diagnose", "my studies/s.toml"] and typed[3:5] == ["--out", "other results"]
        assert load_study(typed[2]).path.resolve() == path.resolve()
    for file in ("fit", "identifiability"):
        told = (tmp_path / "other results" / f"{file}.json").read_text()
        assert '"kind": "diagnose"' in told and "hvdc-ident diagnose" not in told


# What is given.


@pytest.mark.parametrize(
    "model, line, given, start, told",
    [
        ("", "", 10.0, 10.0, "; given 10 1/s (the model)"),
        ("", "start = 30", 10.0, 30.0, "from 30 within [2, 60] 1/s; given 10 1/s (the model)"),
        (
            "[model.values]\nK = 9\n",
            "start = 30",
            9.0,
            30.0,
            "from 30 within [2, 60] 1/s; given 9 1/s ([model.values])",
        ),
        ("", "given = 11", 11.0, 11.0, "; given 11 1/s ([parameters])"),
        (
            "[model.values]\nK = 9\n",
            "given = 11, start = 30",
            11.0,
            30.0,
            "; given 11 1/s ([parameters], not 9 of [model.values])",
        ),
    ],
)
def test_given_is_stated_or_the_models_and_start_is_stated_or_given(
    tmp_path: Path, model: str, line: str, given: float, start: float, told: str
) -> None:
    body = ", ".join(t for t in (line, "min = 2, max = 60") if t)
    path = write_study(tmp_path, f"[parameters]\nK = {{{body}}}\n", "", model)
    study = load_study(path)
    assert (study.given["K"], study.start["K"]) == (given, start)
    assert (study.candidates["K"].given, study.candidates["K"].start) == (given, start)
    assert study.model.values["K"] == given
    assert told in done("check", path)


def test_the_given_value_may_lie_outside_the_search_but_not_outside_the_model(tmp_path: Path) -> None:
    study = load_study(write_study(tmp_path, "[parameters]\nK = {given = 1.5, start = 30, min = 2, max = 60}\n", ""))
    assert study.given["K"] == 1.5
    with pytest.raises(InputError, match=r"parameters\.K\.given.*bounds"):
        load_study(write_study(tmp_path, "[parameters]\nK = {given = 101, start = 30, min = 2, max = 60}\n", ""))
    with pytest.raises(StudyError, match="nor a given value"):
        load_study(write_study(tmp_path, '[parameters]\nK = {given = 11, tie = "2*T"}\n', ""))


def test_a_parameter_of_each_experiment_is_simulated_at_its_given_value(tmp_path: Path) -> None:
    line = "[parameters]\nK = {per-experiment = true, start = 30, min = 20, max = 60}\n"
    study = load_study(write_study(tmp_path, line, ""))
    assert study.model.values["K"] == study.given["K"] == 10.0
    assert study.start["K"] == 30.0
    assert [e.search["K"] for e in study.experiments] == [(30.0, 20.0, 60.0)] * 2


def test_given_values_that_cannot_rest_do_not_keep_a_fit_from_running(tmp_path: Path) -> None:
    path = write_study(
        tmp_path, "[parameters]\nq = {given = -1.0, start = 1.0, min = 0.1, max = 5}\n", "[fit]\nstarts = 1\n"
    )
    (tmp_path / "loop.toml").write_text(
        'schema = 1\nname = "root"\n[parameters]\nq = {value = 1.0}\n[inputs]\nu = {value = 0.0}\n'
        '[states]\nr = {derivative = "q - r**2", guess = 1.0}\nx = {derivative = "12*r*(u - z)"}\n'
        'z = {derivative = "(x - z)/0.05"}\n[outputs]\ny = "z"\n'
    )
    result = run("simulate", path)
    assert result.exit_code == 1 and "at the given values" in result.output
    assert re.search(r"^q +-1 ", done("fit", path), flags=re.MULTILINE)


# What every stage does with it.


def test_simulation_and_errors_before_the_fit_are_at_the_given_values(results: dict[str, Any]) -> None:
    noise = np.random.default_rng(0).standard_normal(TIME.size) * NOISE
    want = float(np.sqrt(np.mean((response(1.0, TRUE) + noise - response(1.0, GIVEN)) ** 2)))
    assert results["simulation"]["values"] == GIVEN
    assert results["simulation"]["rmse"]["y"]["a"] == pytest.approx(want, rel=1e-4)
    assert results["fit"]["rmse_given"]["y"]["a"] == pytest.approx(want, rel=1e-4)
    begun = response(1.0, {**START, "g": 1.0})  # g is held, at what was given
    far = float(np.sqrt(np.mean((response(1.0, TRUE) + noise - begun) ** 2)))
    assert results["fit"]["rmse_start"]["y"]["a"] == pytest.approx(far, rel=1e-4)


def test_what_cannot_be_told_is_held_at_the_given_value(results: dict[str, Any], fitted: dict[str, float]) -> None:
    assert results["identifiability"]["held"]["g"]["value"] == 1.0
    assert results["fit"]["fitted"] == ["K", "T"] and fitted["g"] == 1.0
    assert fitted["K"] == pytest.approx(12.0, rel=5e-3) and fitted["T"] == pytest.approx(0.05, rel=5e-3)


def test_candidates_carry_all_of_it(study: Path, results: dict[str, Any]) -> None:
    want = {"given": 11.0, "start": 30.0, "min": 2.0, "max": 60.0, "unit": "1/s"}
    for stage in ("fit", "identifiability"):
        found = results[stage]["candidates"]["K"]
        assert {k: found[k] for k in want} == want
    assert re.search(r"^K +1/s +11 +1[12]\.\d+ ", done("fit", study), flags=re.MULTILINE)


def test_the_diagnosis_compares_with_the_given_values(results: dict[str, Any]) -> None:
    found = results["discrepancy"]
    assert found["parameters_before"] == GIVEN
    noise = np.random.default_rng(0).standard_normal(TIME.size) * NOISE
    off = response(1.0, TRUE) + noise - response(1.0, GIVEN)
    off = off[np.abs(TIME - EVENT) > 1e-9]  # rows on a jump are left out
    assert found["gap"]["nominal"]["fit"]["y"]["a"] == pytest.approx(float(np.sqrt(np.mean(off**2))), rel=1e-3)


def test_letter_and_report_speak_of_the_given_values(study: Path, fitted: dict[str, float]) -> None:
    told = " ".join(letter_of(Results(study.parent / "s-results")).sentences)
    change = 100 * (fitted["K"] / 11.0 - 1.0)
    assert f"in place of 11 ({change:+.1f} %)" in told
    page = (study.parent / "s-results/report.html").read_text()
    assert "start values" not in page and "given values" in page
    for heading in ("<h2>The values</h2>", "<h2>Parameters</h2>"):
        row = re.search(r"<tr><td>(?:<strong>)?K(?:</strong>)?(?:, 1/s)?</td>(.*?)</tr>", page.split(heading)[1])
        assert row is not None
        cells = re.findall(r"<td[^>]*>(.*?)</td>", row[1])
        assert cells[0] == "11" and cells[3] == f"{change:+.1f} %"


def test_the_linear_model_is_at_the_given_values_with_the_fitted_ones_beside_it(
    study: Path, results: dict[str, Any], fitted: dict[str, float]
) -> None:
    data = results["linearization"]
    for block, name, values in ((data, "given", GIVEN), (data["fitted"], "fitted", fitted)):
        assert block["values"] == name and block["parameters"] == values
        np.testing.assert_allclose(block["A"], state_matrix(values), rtol=1e-12)
        poles = [complex(*m["eigenvalue"]) for m in block["modes"]]
        np.testing.assert_allclose(
            np.sort_complex(poles), np.sort_complex(np.linalg.eigvals(state_matrix(values))), rtol=1e-9
        )
    page = (study.parent / "s-results/report.html").read_text()
    for words in ("<td>given</td>", "<td>fitted</td>", "u to y, fitted", "u to y, given"):
        assert words in page


def test_the_linear_model_takes_in_a_fit_that_came_later(tmp_path: Path) -> None:
    path = write_study(tmp_path, questions='[linearize]\ninputs = ["u"]\noutputs = ["y"]\n[fit]\nstarts = 1\n')
    told = done("linearize", path)
    first = json.loads((tmp_path / "s-results/linearization.json").read_text())
    assert "fitted" not in first and "no fit has run" in told
    done("fit", path, "--quiet")
    done("report", path, "--quiet")
    assert "A fit has run since" in (tmp_path / "s-results/report.html").read_text()
    done("run", path, "--quiet")
    second = json.loads((tmp_path / "s-results/linearization.json").read_text())
    assert second["fitted"]["values"] == "fitted" and second["A"] == first["A"]


# What is written for other tools.


def values_of(name: str, fitted: dict[str, float]) -> dict[str, float]:
    return {"given": GIVEN, "start": START, "fitted": fitted}[name]


SETS = pytest.mark.parametrize("name", ["given", "start", "fitted"])


def exported(study: Path, folder: Path, ending: str, name: str, *more: str) -> Path:
    path = folder / f"{name}{ending}"
    told = done("export", study, "--to", path, "--values", name, *more)
    assert f"{name} values of study 'loops'" in told
    return path


@SETS
def test_linear_models_of_each_set(study: Path, tmp_path: Path, fitted: dict[str, float], name: str) -> None:
    want, said = state_matrix(values_of(name, fitted)), f"{name} values of study 'loops'"
    found = loadmat(exported(study, tmp_path, ".mat", name), squeeze_me=True)
    np.testing.assert_allclose(found["A"], want, rtol=1e-14)
    assert str(found["provenance"]["values"]).startswith(said)
    data = json.loads(exported(study, tmp_path, ".json", name).read_text())
    np.testing.assert_allclose(data["A"], want, rtol=1e-14)
    assert data["provenance"]["values"].startswith(said)
    for ending, comment, more in ((".m", "% ", ()), (".mo", "// ", ("--linear",))):
        text = exported(study, tmp_path, ending, name, *more).read_text()
        assert f"{comment}values: {said}" in text
    rows = re.search(r"^A = \[(.*)\];$", (tmp_path / f"{name}.m").read_text(), flags=re.MULTILINE)
    assert rows is not None
    np.testing.assert_allclose([[float(v) for v in r.split()] for r in rows[1].split(";")], want, rtol=1e-14)


@SETS
def test_frequency_response_of_each_set(study: Path, tmp_path: Path, fitted: dict[str, float], name: str) -> None:
    path = exported(study, tmp_path, ".csv", name)
    table = np.genfromtxt(path, delimiter=",", names=True)
    values = values_of(name, fitted)
    b = np.array([[values["K"] * values["g"]], [0.0]])
    plant = control.ss(state_matrix(values), b, [[0.0, 1.0]], [[0.0]])
    want = plant(1j * table["omega"])
    np.testing.assert_allclose(table["re_y_from_u"] + 1j * table["im_y_from_u"], want, rtol=1e-9, atol=1e-12)
    assert f"# values: {name} values of study 'loops'" in path.read_text()


@SETS
def test_models_of_each_set(study: Path, tmp_path: Path, fitted: dict[str, float], name: str) -> None:
    want, said = values_of(name, fitted), f"{name} values of study 'loops'"
    text = exported(study, tmp_path, ".toml", name).read_text()
    assert {n: p["value"] for n, p in tomllib.loads(text)["parameters"].items()} == want
    assert text.startswith(f"# {said}")
    described = read_model_description(str(exported(study, tmp_path, ".fmu", name, "--source-only")))
    assert {v.name: float(v.start) for v in described.modelVariables if v.name in want} == want
    assert said in described.description
    modelica = exported(study, tmp_path, ".mo", name).read_text()
    found = dict(re.findall(r"parameter Real (\w+)\([^)]*\) = ([^; ]+);", modelica))
    assert {n: float(v) for n, v in found.items()} == want
    assert said in modelica.splitlines()[0]
    root = ET.parse(exported(study, tmp_path, ".ssv", name)).getroot()
    reals = {p.get("name"): float(p[0].get("value", "")) for p in root.iter(f"{{{SSV}}}Parameter")}
    assert reals == want and root.get("description", "").startswith(said)


def test_the_fitted_values_are_the_default_where_a_fit_stands(
    study: Path, tmp_path: Path, fitted: dict[str, float]
) -> None:
    told = done("export", study, "--to", tmp_path / "x.toml")
    assert "fitted values of study 'loops' (fit converged, chi2/dof" in told and "held: g" in told
    assert tomllib.loads((tmp_path / "x.toml").read_text())["parameters"]["K"]["value"] == fitted["K"]
    assert json.loads(done("export", study, "--to", tmp_path / "x.toml", "--json"))["values"] == "fitted"
    export(load_study(study), tmp_path / "y.toml", values="given")
    assert tomllib.loads((tmp_path / "y.toml").read_text())["parameters"]["K"]["value"] == 11.0
    with pytest.raises(StudyError, match="one set of values"):
        export(load_study(study).model, tmp_path / "z.toml", values="given")  # type: ignore[arg-type]
    with pytest.raises(StudyError, match="no such set"):
        export(load_study(study), tmp_path / "z.toml", values="best")


def changed(study: Path, folder: Path, **changes: Any) -> Any:
    """The study loaded, and a folder that holds its fit with some fields changed."""
    data = json.loads((study.parent / "s-results/fit.json").read_text())
    folder.mkdir(exist_ok=True)
    for name in data["files"]:
        (folder / name).write_text("")
    (folder / "fit.json").write_text(json.dumps({**data, **changes}))
    return load_study(study)


@pytest.mark.parametrize(
    "changes, why",
    [
        ({"status": "not-converged", "message": "it stopped", "fingerprint": ""}, "ended as not-converged: it stopped"),
        ({"status": "failed", "message": "no run", "fingerprint": ""}, "ended as failed: no run"),
        ({"sources": {"s.toml": "0"}}, "is of an earlier state of the study or its files"),
        ({"fingerprint": "0"}, "is of another version of hvdc_ident"),
    ],
)
def test_a_fit_that_does_not_stand_is_not_used_and_that_is_said(
    study: Path, tmp_path: Path, changes: dict[str, Any], why: str
) -> None:
    loaded = changed(study, tmp_path, **changes)
    found = value_set(loaded, None, tmp_path)
    assert found.name == "given" and dict(found.values) == GIVEN and why in found.note
    with pytest.raises(StudyError, match="there are no fitted values") as caught:
        value_set(loaded, "fitted", tmp_path)
    assert why in str(caught.value) and "--values given" in str(caught.value)


def test_one_of_two_optima_is_taken_only_where_it_is_asked_for(
    study: Path, tmp_path: Path, fitted: dict[str, float]
) -> None:
    loaded = changed(study, tmp_path, status="two-optima", message="K = 12 or 3")
    found = value_set(loaded, None, tmp_path)
    assert found.name == "given" and "two-optima: K = 12 or 3" in found.note
    assert "--values fitted" in next_phrases(found.next)
    asked = value_set(loaded, "fitted", tmp_path)
    assert dict(asked.values) == fitted and "fit two-optima" in asked.note


def test_without_a_fit_the_given_values_are_written_and_nothing_is_missed(study: Path, tmp_path: Path) -> None:
    told = done("export", study, "--to", tmp_path / "x.mat", "--out", tmp_path / "none")
    assert "given values of study 'loops'" in told and "fit" not in told.split(";", 1)[1]
    result = run("export", study, "--to", tmp_path / "x.mat", "--out", tmp_path / "none", "--values", "fitted")
    assert result.exit_code == 2 and "no fit has run" in result.output


def test_a_fit_with_another_seed_and_a_forced_one_stand_too(tmp_path: Path) -> None:
    path = write_study(tmp_path, questions="[fit]\nstarts = 1\n")
    done("fit", path, "--seed", 3, "--force", "g", "--quiet")
    found = value_set(load_study(path), None)
    assert found.name == "fitted", found.note
