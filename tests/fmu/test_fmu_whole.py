"""A whole study on an FMU of our own making, with something missing from it: from the command line to the page."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from typer.testing import CliRunner

from hvdc_ident import load_model, simulate
from hvdc_ident.cli import app
from hvdc_ident.data import InputSignal, Trajectory, experiment
from hvdc_ident.discrepancy import diagnose
from hvdc_ident.effects import apply_effects
from hvdc_ident.fit import FitParameter
from hvdc_ident.fmu.export import export_fmu
from hvdc_ident.model import parse_card
from tests.fmu.c_fmu import needs_compiler

pytestmark = needs_compiler

CARD = """schema = 1
name = "pi loop"
[parameters]
kp = {value = 2.0, min = 0.1, max = 20.0}
ki = {value = 10.0, unit = "1/s", min = 0.1, max = 100.0}
T = {value = 0.1, unit = "s", min = 0.01, max = 1.0}
[inputs]
r = {value = 0.0}
[states]
z = {derivative = "ki*(r - y)"}
y = {derivative = "(kp*(r - y) + z - y)/T"}
[outputs]
y = "y"
c = "kp*(r - y) + z"
"""
STUDY = """schema = 1
name = "pi"
[model]
source = "pi.fmu"
[parameters]
kp = {start = 2.5, min = 0.5, max = 8}
ki = {start = 8.0, min = 2, max = 40}
[[experiment]]
name = "up"
data = "up.csv"
inputs = ["r"]
outputs = ["y", "c"]
noise = {y = 5e-3, c = 5e-3}
[[experiment]]
name = "down"
data = "down.csv"
inputs = ["r"]
outputs = ["y", "c"]
noise = {y = 5e-3, c = 5e-3}
role = "holdout"
[linearize]
inputs = ["r"]
outputs = ["y"]
[[sweep]]
parameter = "kp"
min = 1.0
max = 3.0
points = 3
[identifiability]
[fit]
starts = 2
[diagnose]
effects = ["lag", "gain", "offset"]
"""
LAG = 0.06


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder with the results of `run` on recordings whose y went through a lag that the FMU has not."""
    folder = tmp_path_factory.mktemp("whole")
    model, random, time = parse_card(CARD), np.random.default_rng(4), np.linspace(0.0, 3.0, 121)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CFLAGS", "-O0")
        export_fmu(model, folder / "pi.fmu")
    lagging = apply_effects(model, [{"effect": "lag", "at": "outputs.y", "parameters": {"T": LAG}}])
    for name, level in (("up", 1.0), ("down", -0.6)):
        r = InputSignal.corners([(0, 0), (0.5, 0), (0.5, level), (1.7, level), (1.7, -level / 2)])
        run = simulate(lagging, experiment(name, time, {"r": r}))
        table = np.column_stack([time, r(time), run["y"], run["c"]])
        table[:, 2:] += 5e-3 * random.normal(size=(time.size, 2))
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header="time,r,y,c", comments="", fmt="%.9g")
    (folder / "study.toml").write_text(STUDY)
    result = CliRunner().invoke(app, ["run", str(folder / "study.toml"), "--out", str(folder / "out"), "--quiet"])
    assert result.exit_code == 0, result.output
    return folder / "out"


def test_diagnosis_names_what_is_missing_and_says_what_could_not_be_tried(whole):
    found = json.loads((whole / "discrepancy.json").read_text())
    (effect,) = found["effects"]
    assert found["verdict"] == "named" and effect["effect"] == "lag" and effect["at"] == ["y"]
    low, high = effect["parameters"]["T"]["ci95"]
    assert low < LAG < high and high - low < 0.1 * LAG
    assert found["parameters_after"]["kp"] == pytest.approx(2.0, rel=0.02)
    assert found["parameters_after"]["ki"] == pytest.approx(10.0, rel=0.02)
    assert found["gap"]["shrink_holdout"] > 0.8 and found["remaining"]["adequate"]
    assert {(c["effect"], *c["at"]) for c in found["candidates"]} <= {
        (e, p) for e in ("lag", "gain", "offset") for p in ("r", "y", "c")
    }
    (note,) = found["notes"]
    assert "closed inside" in note and "signals, states and loops were not" in note
    assert found["augmented_model"] is None


def test_the_page_has_every_stage_and_its_figures(whole):
    page = (whole / "report.html").read_text()
    sections = re.findall(r"<h2[^>]*>([^<]*)", page)
    figures = {}
    for name, part in zip(sections, re.split(r"<h2", page)[1:], strict=True):
        figures[name] = part.count("<svg") + part.count("<canvas")
    for name in (
        "What the recordings determine",
        "What the model lacks",
        "Linear model",
        "Sweep",
        "Waveforms",
    ):
        assert figures[name] > 0, name
    assert {"Parameters", "Errors", "Provenance"} <= set(sections)
    for words in (
        "From perfect data of these signals every candidate could be told (numerical, local)",
        "y of the plant follows that of the model with a first-order lag",
        "The model is closed inside",
        "Adding it shrinks the error on",
        "differs from central differences by",
    ):
        assert words in re.sub(r"<[^>]+>", "", page), words


def test_what_is_missing_at_an_input_is_found_there(whole):
    """The signal of that place is the experiment's own input, which no FMU gives as an output."""
    model, random, time = parse_card(CARD), np.random.default_rng(4), np.linspace(0.0, 3.0, 121)
    lagging = apply_effects(model, [{"effect": "lag", "at": "r", "parameters": {"T": LAG}}])
    records = []
    for name, level in (("up", 1.0), ("down", -0.6)):
        r = InputSignal.corners([(0, 0), (0.5, 0), (0.5, level), (1.7, level), (1.7, -level / 2)])
        run = simulate(lagging, experiment(name, time, {"r": r}))
        seen = np.column_stack([run[o] for o in ("y", "c")]) + 5e-3 * random.normal(size=(time.size, 2))
        measured = Trajectory(time, seen, ("y", "c"), ("", ""))
        records.append(experiment(name, time, {"r": r}, measured=measured, noise={"y": 5e-3, "c": 5e-3}))
    free = [FitParameter("kp", 2.5, 0.5, 8.0), FitParameter("ki", 8.0, 2.0, 40.0)]
    found = diagnose(load_model(whole.parent / "pi.fmu"), records, free, effects=["lag"], places=["r"])
    (effect,) = found.effects
    low, high = effect.parameters["T"].ci95
    assert effect.at == ("r",) and low < LAG < high < 1.3 * LAG
