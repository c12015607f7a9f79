"""The same study file with an FMU in it, from the command line."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from hvdc_ident import simulate
from hvdc_ident.cli import app
from hvdc_ident.data import experiment
from hvdc_ident.fmu import read_fmu
from hvdc_ident.model import save_card
from tests.fmu.c_fmu import CModel, Var, build, needs_compiler
from tests.fmu.c_models import PLAIN, TWIN, spring

pytestmark = needs_compiler

STUDY = """schema = 1
name = "spring"
[model]
source = "{source}"
{interface}
[model.values]
d = 0.5
[parameters]
d = {{start = 0.5, min = 0.1, max = 2}}
k = {{start = 8, min = 2, max = 30}}
[[experiment]]
name = "step"
data = "step.csv"
inputs = ["u"]
outputs = ["y", "twice"]
noise = {{y = 1e-3, twice = 1e-3}}
[[experiment]]
name = "back"
data = "back.csv"
inputs = ["u"]
outputs = ["y", "twice"]
noise = {{y = 1e-3, twice = 1e-3}}
role = "holdout"
[linearize]
inputs = ["u"]
outputs = ["y"]
[[sweep]]
parameter = "d"
min = 0.3
max = 0.9
points = 3
[identifiability]
[fit]
starts = 2
"""
TRUE = {"d": 0.6, "k": 9.0}


def study(folder, interface):
    """A study of the spring's FMU, or of its twin in equations, with noisy records of a spring of other values."""
    from hvdc_ident import simulate
    from hvdc_ident.data import InputSignal, experiment

    random, time = np.random.default_rng(3), np.linspace(0.0, 5.0, 101)
    for name, level in (("step", 1.0), ("back", -0.7)):
        u = InputSignal.step(1.0, 0.0, level)
        run = simulate(TWIN.with_values(TRUE), experiment(name, time, {"u": u}))
        table = np.column_stack([time, u(time), run["y"], run["twice"]])
        table[:, 2:] += 1e-3 * random.normal(size=(time.size, 2))
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header="time,u,y,twice", comments="", fmt="%.9g")
    if interface == "twin":
        source = save_card(TWIN, folder / "spring.toml").name
    else:
        source = build(spring(), folder).name
    line = "" if interface == "twin" else f'interface = "{interface}"'
    path = folder / "study.toml"
    path.write_text(STUDY.format(source=source, interface=line))
    return path


def told(*arguments):
    """The JSON a command prints."""
    result = CliRunner().invoke(app, [*map(str, arguments), "--json"])
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def every_stage(path, folder):
    """What each stage says that the study asks for."""
    return told("run", path, "--out", folder)["stages"]


@pytest.fixture(scope="module")
def stages(tmp_path_factory):
    """The results of every stage, by interface."""
    found = {}

    def of(interface):
        if interface not in found:
            folder = tmp_path_factory.mktemp(interface)
            found[interface] = every_stage(study(folder, interface), folder / "out")
        return found[interface]

    return of


@pytest.mark.parametrize("interface", ["model-exchange", "co-simulation"])
def test_every_stage_says_what_it_says_of_the_twin(stages, interface, tmp_path):
    if interface == "co-simulation":
        path = study(tmp_path, interface)
        refused = CliRunner().invoke(app, ["linearize", str(path)])
        assert refused.exit_code == 2 and "expected model exchange" in refused.output
        path.write_text(path.read_text().replace('[linearize]\ninputs = ["u"]\noutputs = ["y"]\n', ""))
        found = every_stage(path, tmp_path / "out")
    else:
        found = stages(interface)
        a, b = found["linearize"], stages("twin")["linearize"]
        assert a["method"] == "directional" and a["jacobian_error"] < 1e-6
        for key in "ABCD":
            assert np.allclose(a[key], b[key], atol=1e-9)
        assert np.allclose([m["eigenvalue"] for m in a["modes"]], [m["eigenvalue"] for m in b["modes"]], atol=1e-9)
    twin = stages("twin")
    for output in ("y", "twice"):
        for name in ("step", "back"):
            assert found["simulate"]["rmse"][output][name] == pytest.approx(
                twin["simulate"]["rmse"][output][name], rel=1e-4
            )
    for p, q in zip(found["sweep"]["points"], twin["sweep"]["points"], strict=True):
        assert p["values"] == q["values"] and p["rmse"]["y"]["step"] == pytest.approx(q["rmse"]["y"]["step"], rel=1e-4)
    assert found["identify"]["identifiable"] == twin["identify"]["identifiable"]
    for n, e in found["fit"]["estimates"].items():
        other = twin["fit"]["estimates"][n]
        assert abs(e["value"] - other["value"]) < 1e-3 * other["std"]
        assert e["std"] == pytest.approx(other["std"], rel=1e-3)


def test_check_runs_nothing_and_tells_what_is_there(tmp_path):
    found = told("check", study(tmp_path, "model-exchange"))
    assert found["sizes"] == {"states": 2, "parameters": 4, "inputs": 1, "outputs": 2}
    assert list(found["candidates"]) == ["d", "k"]


def test_an_fmu_with_effects_runs_from_the_study(tmp_path):
    path = study(tmp_path, "co-simulation")
    effect = '[[model.effect]]\neffect = "lag"\nat = ["y"]\nparameters = {T = 0.05}\n[parameters]\n'
    path.write_text(path.read_text().replace("[parameters]\n", effect))
    assert told("simulate", path)["rmse"]["y"]["step"] > 0.0


def test_wrong_studies_are_one_message(tmp_path):
    path = study(tmp_path, "model-exchange")
    text = path.read_text()
    for old, new, message in (
        ('source = "spring2.fmu"', 'source = "none.fmu"', "no model file 'none.fmu'"),
        ('interface = "model-exchange"', 'interface = "scheduled"', "model.interface"),
        ("d = 0.5", "dd = 0.5", "no parameter or input 'dd'"),
        ('inputs = ["u"]', 'inputs = ["uu"]', "no input 'uu'"),
    ):
        path.write_text(text.replace(old, new, 1))
        result = CliRunner().invoke(app, ["check", str(path)])
        assert result.exit_code == 2 and message in result.output and "Traceback" not in result.output
    (tmp_path / "spring2.fmu").write_bytes(b"no archive")
    path.write_text(text)
    result = CliRunner().invoke(app, ["check", str(path)])
    assert result.exit_code == 2 and "no zip archive" in result.output


def test_a_flipped_column_is_told_before_anything_is_fitted(tmp_path):
    """y rests at 0, so its movement tells; `twice` rests at b = 0.25, and its sign shows there."""
    path = study(tmp_path, "model-exchange")
    assert told("check", path)["rest_lines"] == []
    for name in ("step", "back"):
        table = np.loadtxt(tmp_path / f"{name}.csv", delimiter=",", skiprows=1)
        table[:, 2:] *= -1.0
        np.savetxt(tmp_path / f"{name}.csv", table, delimiter=",", header="time,u,y,twice", comments="", fmt="%.9g")
    found = told("check", path)["rest_levels"]
    assert {(line["experiment"], line["output"]) for line in found} == {
        (e, o) for e in ("step", "back") for o in ("y", "twice")
    }
    assert all(line["suggestion"] == "sign" and line["factor"] == -1.0 for line in found)
    assert all(abs(line["model"] - 0.25) < 1e-6 for line in found if line["output"] == "twice")


# T x' = 2 s - x, where s is switched off above 1 and on below 0.5, at the ends of the FMU's own steps only.
STEPPED_THERMOSTAT = CModel(
    "thermostat",
    PLAIN
    + """
#define NR 4
static void start(double *r) { r[2] = 0.5; r[3] = 1; }
static void equations(double *r, double t) { r[1] = (2 * r[3] - r[0]) / r[2]; }
static int switched(double *r) { if (r[0] > 1) r[3] = 0; if (r[0] < 0.5) r[3] = 1; return 0; }
#define EVENT(r, t, next, timed) switched(r)
""",
    (
        Var("x", 0),
        Var("der(x)", 1, more=(("derivative", "x"),)),
        Var("T", 2, "parameter", "tunable", (("start", "0.5"),)),
        Var("y", 0, "output"),
    ),
    1,
    kinds=("CoSimulation",),
)


def test_a_fit_of_runs_that_jump_with_the_parameter_holds_its_value_and_is_plausible(tmp_path):
    """Its lag moves each switching from one own step to the next: chi-square jumps, and the trend of it is what counts."""
    true, noise, instants = 0.5123, 0.02, np.linspace(0.0, 4.0, 161)
    model = read_fmu(build(STEPPED_THERMOSTAT, tmp_path))
    rows = simulate(model, experiment("run", instants), {"T": true})["y"]
    rows = rows + noise * np.random.default_rng(3).standard_normal(instants.size)
    np.savetxt(tmp_path / "run.csv", np.column_stack([instants, rows]), delimiter=",", header="time,y", comments="")
    path = tmp_path / "study.toml"
    path.write_text(
        f'schema = 1\n[model]\nsource = "{model.fmu.path.name}"\n[parameters]\nT = {{given = 0.5, min = 0.3, max = 0.8}}\n'
        f'[[experiment]]\nname = "run"\ndata = "run.csv"\noutputs = ["y"]\nnoise = {{y = {noise}}}\n[fit]\n'
    )
    model.pool.close()
    result = CliRunner().invoke(app, ["fit", str(path), "--json"])
    assert result.exit_code == 0, result.stderr
    found = json.loads(result.stdout)
    low, high = found["estimates"]["T"]["ci95"]
    assert low <= true <= high and high - low < 0.01
    assert found["roughness"]["delta_chi2"] > 0.0 and "implausible" not in found
