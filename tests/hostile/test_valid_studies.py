"""Valid studies of unusual shape: each command ends with a result, or with a reason that says what to do."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from hvdc_ident.cli import app
from hvdc_ident.discrepancy.hypothesis import Refit, judged, slot_signals
from hvdc_ident.discrepancy.nominal import nominal
from hvdc_ident.fit import FitParameter
from hvdc_ident.fit.whitening import autoregression
from hvdc_ident.simulate import ModelSimulator, simulate
from hvdc_ident.study.study import load_study

LAG = """schema = 1
name = "lag"
[parameters]
K = {value = 2.0, min = 0.1, max = 10}
T = {value = 0.1, min = 0.01, max = 1}
idle = {value = 1.0, min = 0.1, max = 10}
r = {value = 0.5, min = 0.1, max = 10}
[inputs]
u = {value = 0.5}
[states]
x = {derivative = "(K*u - x)/T"}
ramp = {derivative = "r*u", start = 0.0}
[outputs]
y = "x"
s = "ramp"
"""
CURVE = """schema = 1
name = "curve"
[parameters]
a = {value = 2.0, min = 0.5, max = 8}
b = {value = 1.5, min = 0.1, max = 10}
[outputs]
y = "a*(1 - exp(-b*time))"
"""
T = np.arange(60) * 0.02
STEP = np.where(T >= 0.2, 1.0, 0.5)
ANSWER = 1.0 + np.where(T >= 0.2, 1.0 - np.exp(-(T - 0.2) / 0.1), 0.0)
NOISE = 1e-3 * np.random.default_rng(5).normal(size=T.size)


def study(folder: Path, card: str, columns: Mapping[str, Any], text: str) -> Path:
    """The path of a study with one recording, e.csv."""
    (folder / "m.toml").write_text(card)
    rows = zip(*columns.values(), strict=True)
    table = "\n".join(",".join(f"{v:.9g}" for v in row) for row in rows)
    (folder / "e.csv").write_text(f"{','.join(columns)}\n{table}\n")
    head = 'schema = 1\n[model]\nsource = "m.toml"\n'
    (folder / "s.toml").write_text(head + text)
    return folder / "s.toml"


def experiment(*lines: str) -> str:
    return '[[experiment]]\nname = "e"\ndata = "e.csv"\n' + "\n".join(lines) + "\n"


MOVED = experiment('inputs = ["u"]', 'outputs = ["y"]', "noise = {y = 1e-3}")
RECORD = {"time": T, "u": STEP, "y": ANSWER + NOISE}


def ran(*arguments: object) -> Result:
    return CliRunner().invoke(app, [*map(str, arguments), "--quiet"])


def found(folder: Path, file: str) -> dict[str, Any]:
    return dict(json.loads((folder / "s-results" / file).read_text()))


def test_a_model_without_states_and_inputs_is_identified_and_fitted(tmp_path: Path) -> None:
    """The curve's own parameters come back, from noise of a thousandth, within their intervals."""
    y = 3.0 * (1.0 - np.exp(-1.2 * T)) + NOISE
    text = (
        "[parameters]\na = {}\nb = {}\n" + experiment('outputs = ["y"]', "noise = {y = 1e-3}") + "[fit]\n[linearize]\n"
    )
    result = ran("run", study(tmp_path, CURVE, {"time": T, "y": y}, text))
    assert result.exit_code == 0, result.stderr
    estimates = found(tmp_path, "fit.json")["estimates"]
    for name, true in (("a", 3.0), ("b", 1.2)):
        low, high = estimates[name]["ci95"]
        assert low < true < high and high - low < 0.2 * true
    assert found(tmp_path, "linearization.json")["modes"] == []


def test_where_the_structure_leaves_nothing_to_fit_there_are_verdicts_all_the_same(tmp_path: Path) -> None:
    path = study(tmp_path, LAG, RECORD, "[parameters]\nidle = {}\nr = {}\n" + MOVED + "[fit]\n[diagnose]\n")
    result = ran("identify", path)
    assert result.exit_code == 0, result.stderr
    report = found(tmp_path, "identifiability.json")
    assert {n: v["verdict"] for n, v in report["parameters"].items()} == dict.fromkeys(
        ("idle", "r"), "structurally-unidentifiable"
    )
    assert report["identifiable"] == []
    for command in ("fit", "diagnose", "letter"):
        result = ran(command, path)
        assert result.exit_code == 1 and f"hvdc-ident identify {path}" in result.stderr, result.stderr


def test_a_run_goes_on_without_the_linear_model_that_there_is_none_of(tmp_path: Path) -> None:
    """The ramp never rests; the fit of the lag beside it needs no rest."""
    path = study(tmp_path, LAG, RECORD, "[parameters]\nK = {}\nT = {}\n" + MOVED + "[fit]\n[linearize]\n")
    result = ran("run", path)
    assert result.exit_code == 1
    assert "linearize: " in result.stderr and 'at = "start"' in result.stderr
    assert found(tmp_path, "linearization.json")["status"] == "failed"
    assert found(tmp_path, "fit.json")["estimates"]["T"]["value"] == pytest.approx(0.1, rel=0.01)
    assert (tmp_path / "s-results" / "report.html").is_file()
    path.write_text(path.read_text() + 'at = "start"\n')
    assert ran("run", path).exit_code == 0


def test_a_run_of_which_nothing_can_be_done_is_refused(tmp_path: Path) -> None:
    path = study(tmp_path, LAG, RECORD, "[linearize]\n")
    result = ran("run", path)
    assert result.exit_code == 2
    assert not (tmp_path / "s-results").exists()


def test_the_noise_model_of_a_record_shorter_than_its_order_is_that_of_the_record_with_zeros_behind() -> None:
    """Sums of products over a record are those over the record followed by zeros; their count cancels in Yule-Walker."""
    rng = np.random.default_rng(3)
    long = np.convolve(rng.normal(size=400), [1.0, 0.8, 0.5])[:400]
    short = [0.3, -0.2]
    for most in (2, 4):
        found = autoregression([long, np.array(short)], most)
        assert len(found) == most
        assert found == pytest.approx(autoregression([long, np.array(short + [0.0] * 10)], most), rel=1e-12)
    # A single coefficient is told beside a line in each record, of which two rows tell nothing.
    assert autoregression([long, np.array(short)], 1) == pytest.approx(autoregression([long], 1), rel=1e-12)


def test_a_power_of_a_signal_that_rests_at_0_has_the_sensitivity_of_its_closed_form(tmp_path: Path) -> None:
    """d/dn u^n = u^n log(u), which is 0 at u = 0."""
    card = LAG[: LAG.index("[states]")] + '[outputs]\ny = "u**r"\n'
    u = np.maximum(STEP - 0.5, 0.0)
    loaded = load_study(study(tmp_path, card, {"time": T, "u": u, "y": ANSWER}, MOVED))
    run = simulate(loaded.model, loaded.experiments[0], {}, sensitivities=["r"], outputs=["y"])
    closed = np.where(u > 0, np.sqrt(u) * np.log(np.where(u > 0, u, 1.0)), 0.0)
    assert run.gradient("y")[:, 0] == pytest.approx(closed, rel=1e-9, abs=1e-12)


def test_an_infinite_slope_at_rest_does_not_end_a_diagnosis(tmp_path: Path) -> None:
    """asin is upright at 1, where this input comes to rest; the gain before it is found all the same."""
    card = LAG[: LAG.index("[outputs]")] + '[signals]\nangle = "asin(clip(u, -1, 1))"\n[outputs]\ny = "x"\n'
    text = "[parameters]\nT = {}\n" + MOVED + '[fit]\nstarts = 2\n[diagnose]\neffects = ["offset"]\n'
    result = ran("diagnose", study(tmp_path, card, {**RECORD, "y": ANSWER + 0.1 + NOISE}, text))
    assert result.exit_code == 0, result.stderr
    named = found(tmp_path, "discrepancy.json")["effects"]
    assert [e["effect"] for e in named] == ["offset"]


def test_nothing_is_looked_for_inside_an_instrument(tmp_path: Path) -> None:
    text = MOVED + "instrument = {y = {window-mean = 0.05, delay = 0.001}}\n"
    loaded = load_study(study(tmp_path, LAG, RECORD, text))
    free = (FitParameter("T", 0.1, 0.01, 1.0),)
    start, _ = nominal(
        ModelSimulator(loaded.model), loaded.experiments, free, {}, None, starts=1, seed=0, executor=None
    )
    first = judged(Refit(loaded.model, (), start.problem, start.noise, start.theta))
    assert {*slot_signals(first)} == {"u", "x", "ramp", "y"}
