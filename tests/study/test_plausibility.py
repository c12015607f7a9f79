"""What a stage may tell: each way in which a result contradicts itself makes the stage fail."""

from __future__ import annotations

import copy
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hvdc_ident.codec import plain
from hvdc_ident.discrepancy import Diagnosis
from hvdc_ident.discrepancy.result import EffectSize, FoundEffect
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.study import pipeline
from hvdc_ident.study.pipeline import run_stage
from hvdc_ident.study.plausibility import violations
from hvdc_ident.study.stages import StageOptions, stage
from hvdc_ident.study.study import load_study


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A first-order lag, its step response with noise, and a fit of its time constant."""
    folder = tmp_path_factory.mktemp("plausible")
    t = np.linspace(0.0, 1.0, 101)
    u = np.where(t >= 0.2, 1.0, 0.0)
    y = np.where(t >= 0.2, 1.0 - np.exp(-(t - 0.2) / 0.1), 0.0) + 0.01 * np.random.default_rng(1).standard_normal(
        t.size
    )
    np.savetxt(folder / "d.csv", np.c_[t, u, y], delimiter=",", header="time,u,y", comments="")
    (folder / "m.toml").write_text(
        'schema = 1\nname = "lag"\n[parameters]\nT = {value = 0.2, min = 0.01, max = 2}\n[inputs]\nu = {value = 0}\n'
        '[states]\nx = {derivative = "(u - x)/T"}\n[outputs]\ny = "x"\n'
    )
    (folder / "s.toml").write_text(
        'schema = 1\n[model]\nsource = "m.toml"\n[parameters]\nT = {}\n[[experiment]]\nname = "e"\ndata = "d.csv"\n'
        'inputs = ["u"]\noutputs = ["y"]\nnoise = {y = 0.01}\n[fit]\nstarts = 3\n[linearize]\ninputs = ["u"]\noutputs = ["y"]\n'
    )
    return folder / "s.toml"


@pytest.fixture(scope="module")
def results(study: Path) -> dict[str, dict[str, Any]]:
    """The JSON of each stage of the study."""
    loaded = load_study(study)
    return {n: dict(run_stage(loaded, n, loaded.folder, StageOptions()).data) for n in ("linearize", "identify", "fit")}


def test_a_right_result_passes(results):
    assert results["fit"]["status"] == "converged" and results["fit"]["adequacy"]["verdict"] == "fits"
    low, high = results["fit"]["estimates"]["T"]["ci95"]
    assert low < 0.1 < high
    assert {n: violations(n, r) for n, r in results.items()} == {"linearize": [], "identify": [], "fit": []}


def lower_start(fit):
    fit["starts"][1]["cost"] = fit["cost"] - 100.0


def interval_elsewhere(fit):
    fit["estimates"]["T"]["ci95"] = [0.5, 0.6]


def no_chi2(fit):
    fit["adequacy"]["chi2_per_dof"] = None


def no_verdict(fit):
    fit["adequacy"] = None


def nothing_to_do(fit):
    fit["adequacy"] |= {"verdict": "does-not-fit", "text": "", "next": []}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lower_start, "a start reached a cost 100 below the one told"),
        (interval_elsewhere, "estimates T = 0.1.* lies outside its own interval 0.5 to 0.6"),
        (no_chi2, "the intervals of T stand without chi2/dof"),
        (no_verdict, "without a verdict on the residuals"),
        (nothing_to_do, "neither by how much nor what to do"),
    ],
)
def test_each_contradiction_of_a_fit_is_found(results, change, words):
    fit = copy.deepcopy(results["fit"])
    change(fit)
    (found,) = violations("fit", fit)
    assert re.search(words, found)


def test_other_stages_are_asked_too(results):
    identify, linear = copy.deepcopy(results["identify"]), copy.deepcopy(results["linearize"])
    identify["pilot"]["chi2_per_dof"] = None
    identify["parameters"]["T"]["ci95"] = [1.0, None]
    assert len(violations("identify", identify)) == 2
    identify["parameters"]["T"]["ci95"] = None
    assert violations("identify", identify) == []
    grouped = copy.deepcopy(results["identify"])
    grouped["pilot"] = {"groups": [grouped["pilot"]]}
    assert violations("identify", grouped) == []
    linear["operating_point"] |= {"branch": "other", "notes": []}
    (found,) = violations("linearize", linear)
    assert "another branch" in found
    linear["operating_point"]["notes"] = ["This is not the model's own steady state."]
    assert violations("linearize", linear) == []
    lag = FoundEffect("lag", ("u",), FrozenMap({"T": EffectSize(3.0, (1.0, 2.0))}))
    diagnosis = plain(Diagnosis("named", effects=(lag,)))
    assert violations("diagnose", diagnosis) == ["effects parameters T = 3 lies outside its own interval 1 to 2"]


def test_a_violation_makes_the_stage_fail_and_keeps_what_it_found(study, tmp_path, monkeypatch):
    real = stage("fit")

    def wrong(*arguments):
        outcome = real.run(*arguments)
        data = copy.deepcopy(dict(outcome.data))
        data["cost"] += 1000.0
        return replace(outcome, data=data)

    monkeypatch.setattr(pipeline, "stage", lambda name: replace(real, run=wrong) if name == "fit" else stage(name))
    loaded = load_study(study)
    done = run_stage(loaded, "fit", tmp_path, StageOptions())
    assert "not plausible" in done.failed and "a start reached a cost" in done.failed
    written = json.loads((tmp_path / "fit.json").read_text())
    assert written["implausible"] and written["fingerprint"] == "" and "T" in written["estimates"]
