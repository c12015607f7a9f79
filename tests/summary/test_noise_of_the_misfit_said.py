"""A run whose records tell no noise says so wherever a verdict is told, in one sentence."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hvdc_ident import apply_effects, simulate
from hvdc_ident.data import InputSignal
from hvdc_ident.fit.noise import misfit_sentence
from hvdc_ident.model import parse_card
from hvdc_ident.report.first_screen import first_screen
from hvdc_ident.report.letter import letter_of
from hvdc_ident.study import StageOptions, load_study
from hvdc_ident.study.comparison import compare_runs
from hvdc_ident.study.pipeline import run_study
from hvdc_ident.study.stages import stages
from hvdc_ident.summary import Results

CARD = """
schema = 1
name = "drive"
[parameters]
Kp = {value = 2.0, min = 0.0}
Ki = {value = 12.0, min = 0.0}
[inputs]
ref = {value = 1.0}
load = {value = 0.0}
[states]
w = {derivative = "(torque - 0.3*w - load) / 0.2", guess = 1.0}
x = {derivative = "Ki * err", guess = 0.3}
[signals]
wm = "w"
err = "ref - wm"
torque = "Kp*err + x"
[outputs]
w = "w"
torque = "torque"
"""
STUDY = """
schema = 1
[model]
source = "drive.toml"
[parameters]
Kp = {start = 2.4, min = 0.4, max = 10}
Ki = {start = 10, min = 2, max = 60}
[fit]
starts = 2
[diagnose]
effects = ["lag"]
"""
EXPERIMENT = """
[[experiment]]
name = "{0}"
data = "{0}.csv"
inputs = ["{0}"]
outputs = ["w", "torque"]
interpolation = "hold"
event = 0.2
"""
NOISE = {"w": 2e-4, "torque": 4e-4}
SAID = misfit_sentence([*NOISE])


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """Results of a study whose records have seven rows before the event, and a lag that the model lacks."""
    folder, model = tmp_path_factory.mktemp("unknown"), parse_card(CARD)
    plant = apply_effects(model, [{"effect": "lag", "at": ["wm"], "parameters": {"T": 0.03}}])
    time, random = np.arange(38) * 0.032, np.random.default_rng(1)
    for name, before, after in (("ref", 1.0, 1.6), ("load", 0.0, 0.5)):
        step = InputSignal.step(0.2, before, after)
        run = simulate(plant, time, inputs={name: step})
        columns = [time, step(time), *(run[o] + s * random.standard_normal(time.size) for o, s in NOISE.items())]
        header = ",".join(["time", name, *NOISE])
        np.savetxt(folder / f"{name}.csv", np.column_stack(columns), "%.17g", ",", header=header, comments="")
    (folder / "drive.toml").write_text(CARD, "utf-8")
    (folder / "study.toml").write_text(STUDY + "".join(EXPERIMENT.format(n) for n in ("ref", "load")), "utf-8")
    study = load_study(folder / "study.toml")
    run_study(study, folder / "study-results", StageOptions())
    return Results(folder / "study-results")


def test_the_study_has_a_record_of_unknown_noise(results: Results) -> None:
    assert results.summary.noise_from_misfit == tuple(NOISE)


@pytest.mark.parametrize("stage", ["identify", "fit", "diagnose"])
def test_each_stage_says_so_on_its_screen_and_in_its_verdict(results: Results, stage: str) -> None:
    own = next(s for s in stages() if s.name == stage)
    data = results.get(Path(own.file).stem)
    assert "\n".join(own.tell(data)).count(SAID) == 1
    assert own.verdict is not None and SAID.rstrip(".") in own.verdict(data)


def plain(shown: object) -> str:
    """What is shown, in one line."""
    return " ".join(str(shown).split())


def test_the_summary_the_first_screen_the_letter_and_a_comparison_say_so(results: Results) -> None:
    kept = json.loads((results.folder / "summary.json").read_text("utf-8"))
    assert kept["noise_from_misfit"] == [*NOISE]
    assert SAID in plain(results.summary)
    assert SAID in first_screen(results)
    assert sum(sentence.count(SAID) for sentence in letter_of(results).sentences) == 1
    assert SAID.rstrip(".") in plain(compare_runs(results.folder, results.folder))


def test_no_effect_is_told_anywhere(results: Results) -> None:
    s = results.summary
    assert (s.diagnosis, s.effects, s.stand_ins, s.counting.kind) == ("no-evidence", (), (), "")
    assert all(f.effect == "parameter" for f in s.findings)
