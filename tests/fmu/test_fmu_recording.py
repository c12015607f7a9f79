"""Variables that no tool declared as outputs are recorded where a study names them, under names as tools write them."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from hvdc_ident import find_operating_point, linearize, load_model, simulate
from hvdc_ident.cli import app
from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.effects import apply_effects
from hvdc_ident.errors import ModelError, UnknownNameError
from tests.fmu.c_fmu import CModel, Var, build, needs_compiler
from tests.fmu.c_models import SPRING_CODE, TWIN, spring

pytestmark = needs_compiler

NAMES = {
    "x": "mass.s", "v": "mass.v", "der(x)": "der(mass.s)", "der(v)": "der(mass.v)", "m": "mass.m", "d": "damper.d",
    "k": "spring.c", "stiffness": "stiffness", "b": "b", "u": "force[1,2]", "y": None, "twice": "a[1]",
}  # fmt: skip


def closed(own: bool = True) -> CModel:
    """The spring under a Dymola user's names, none of them an output; a[1] is 2 v + b."""
    plain = spring(own=own)
    variables = tuple(
        replace(
            v,
            name=NAMES[v.name],
            causality="local" if v.causality == "output" else v.causality,
            more=tuple((k, NAMES[x] if k == "derivative" else x) for k, x in v.more),
        )
        for v in plain.variables
        if NAMES[v.name]
    )
    variables = (*variables, Var("sum", 7, "calculatedParameter", "fixed"), Var("time", 15, "independent"))
    return CModel(f"closed{own}", SPRING_CODE, variables, 2, 0, directional=own, defines=plain.defines)


@pytest.fixture(scope="module")
def step():
    return experiment("step", np.linspace(0.0, 4.0, 81), {"force[1,2]": InputSignal.step(1.0, 0.0, 1.0)})


@pytest.fixture(scope="module")
def twin():
    """The same in equations."""
    return simulate(TWIN, experiment("step", np.linspace(0.0, 4.0, 81), {"u": InputSignal.step(1.0, 0.0, 1.0)}))


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("interface", ["model-exchange", "co-simulation"])
def test_states_are_recorded_where_no_output_is_declared(fmu, step, twin, version, interface):
    model = fmu(closed(), version, interface)
    assert list(model.outputs) == ["mass.s", "mass.v"] and model.outputs["mass.s"].unit == "m"
    run = simulate(model, step)
    assert "declares none" in run.notes["outputs"]
    assert np.allclose(run["mass.s"], twin["y"], atol=2e-4)


@pytest.mark.parametrize("own", [True, False])
def test_any_variable_is_recorded_when_it_is_named(fmu, step, twin, own):
    model = fmu(closed(own))
    names = ("a[1]", "der(mass.v)", "sum", "force[1,2]")
    run = simulate(model, step, sensitivities=["damper.d"], outputs=names)
    of_twin = simulate(TWIN, step.with_(inputs={"u": step.inputs["force[1,2]"]}), sensitivities=["d"])
    assert run.trajectory.names == names and np.allclose(run["a[1]"], twin["twice"], atol=1e-4)
    assert np.allclose(run.gradient("a[1]")[:, 0], of_twin.gradient("twice")[:, 0], atol=2e-4)
    assert np.all(run["sum"] == 0.25) and np.all(run["force[1,2]"] == step.inputs["force[1,2]"](step.time))
    force = 8.0 * (run["force[1,2]"] - twin["y"]) - 0.25 * (twin["twice"] - 0.25)
    assert np.allclose(run["der(mass.v)"], force / 2.0, atol=1e-3)


@pytest.mark.parametrize("own", [True, False])
def test_a_linear_model_has_any_variable_as_output(fmu, own):
    model = fmu(closed(own))
    linear = linearize(model, find_operating_point(model), inputs="force[1,2]", outputs=["a[1]", "der(mass.v)"])
    assert np.allclose(linear.C, [[0.0, 2.0], [-4.0, -0.25]], atol=1e-6)
    assert np.allclose(linear.D, [[0.0], [4.0]], atol=1e-6)
    point = find_operating_point(model, outputs={"mass.s": 0.5}, free=["force[1,2]"])
    assert point.inputs["force[1,2]"] == pytest.approx(0.5, abs=1e-8)
    moving = find_operating_point(model, {"a[1]": 1.25}, moving=["mass.s"])  # 2 v + b, where k x + d v = 0
    assert moving.states == pytest.approx({"mass.v": 0.5, "mass.s": -0.5 * 0.5 / 8.0}, abs=1e-9)


def test_an_effect_sits_at_what_is_recorded(fmu, step, twin):
    model = fmu(closed())
    lag = {"effect": "gain", "at": ["a[1]"], "parameters": {"k": 3.0}}
    with pytest.raises(UnknownNameError, match=r"a\[1\]"):
        apply_effects(model, [lag])
    effective = apply_effects(model.recording(["a[1]"]), [lag])
    assert "gain_a_1_k" in effective.parameters
    assert np.allclose(simulate(effective, step)["a[1]"], 3.0 * twin["twice"], atol=1e-3)
    delayed = step.with_(instrument={"a[1]": {"delay": 0.5}})
    assert simulate(model, delayed, outputs=["a[1]"])["a[1]"][30:] == pytest.approx(twin["twice"][20:-10], abs=1e-3)


def test_what_cannot_be_recorded(fmu):
    model = fmu(closed())
    with pytest.raises(ModelError, match=r"'mass.m' is a parameter"):
        model.recording(["mass.m"])
    with pytest.raises(UnknownNameError, match=r"no output 'a\[2\]'.*did you mean 'a\[1\]'"):
        model.recording(["a[2]"])


def test_an_unknown_name_among_thousands_is_one_short_message(tmp_path):
    plain = spring()
    many = tuple(Var(f"machine[{k}].stator.winding.i", 10) for k in range(5000))
    path = build(replace(plain, name="many", variables=(*plain.variables, *many)), tmp_path)
    model = load_model(path)
    for name in ("machine[7].stator.windng.i", "Winding.i"):
        with pytest.raises(UnknownNameError) as caught:
            model.recording([name])
        message = str(caught.value)
        assert len(message) < 400 and "machine[" in message and "`hvdc-ident check many2.fmu --find TEXT`" in message


STUDY = """schema = 1
[model]
source = "{source}"
[parameters]
"damper.d" = {{start = 0.5, min = 0.1, max = 2}}
"spring.c" = {{start = 8, min = 2, max = 30}}
[[experiment]]
name = "step"
data = "step.csv"
inputs = ["force[1,2]"]
outputs = ["mass.s", "der(mass.v)", "a[1]"]
noise = {{"mass.s" = 1e-3, "der(mass.v)" = 1e-3, "a[1]" = 1e-3}}
[linearize]
inputs = ["force[1,2]"]
outputs = ["a[1]"]
[[sweep]]
parameter = "damper.d"
values = [0.4, 0.6]
want = ["rmse", "bode"]
[identifiability]
[fit]
starts = 1
"""


def told(*arguments):
    result = CliRunner().invoke(app, [*map(str, arguments), "--json"])
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def test_a_study_names_variables_as_the_tool_writes_them(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(STUDY.format(source=build(closed(), tmp_path).name))
    model = load_model(tmp_path / "closedTrue2.fmu")
    e = experiment("step", np.linspace(0.0, 5.0, 101), {"force[1,2]": InputSignal.step(1.0, 0.0, 1.0)})
    names = ("mass.s", "der(mass.v)", "a[1]")
    run = simulate(model, e, {"damper.d": 0.6, "spring.c": 9.0}, outputs=names)
    noise = 1e-3 * np.random.default_rng(4).normal(size=(e.time.size, 3))
    with (tmp_path / "step.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["time", "force[1,2]", *names])
        rows.writerows(np.column_stack([e.time, e.inputs["force[1,2]"](e.time), run.trajectory.values + noise]))
    done = told("run", path)["stages"]
    assert list(done["simulate"]["rmse"]) == list(names)
    assert done["linearize"]["transfer_functions"][0]["output"] == "a[1]"
    assert "rmse.der(mass.v).step" in (tmp_path / "study-results" / "sweep.csv").read_text().splitlines()[0]
    estimates = done["fit"]["estimates"]
    for name, value in (("damper.d", 0.6), ("spring.c", 9.0)):
        assert abs(estimates[name]["value"] - value) < 4.0 * estimates[name]["std"]
    path.write_text(path.read_text().replace('"der(mass.v)", "a[1]"]', '"der(mass.w)", "a[1]"]'))
    refused = CliRunner().invoke(app, ["check", str(path)])
    assert refused.exit_code == 2 and "experiment 'step'.outputs" in refused.output
    assert "did you mean 'der(mass.v)'" in refused.output.replace("\n", " ")
