"""The first answer of a long assessment: right where the model is linear, and left behind by an interrupt."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import hvdc_ident.identifiability as identifiability
from hvdc_ident.cli import app
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.identifiability.pilot_fit import cramer_rao_bounds
from hvdc_ident.study.stages import identify
from tests.identifiability.cases import T, closed, measured, product

TRUTH, NOISE = {"a": 2.0, "b": 3.0, "c": 0.5}, 0.01


def look(*names: str) -> Any:
    simulator = closed(product, **TRUTH)
    record = measured(simulator, TRUTH, NOISE)
    return cramer_rao_bounds(Problem(simulator, (record,), tuple(FitParameter(n, TRUTH[n], 0.1, 10.0) for n in names)))


def test_what_is_told_apart_has_the_standard_deviation_of_linear_regression() -> None:
    """y = a b t + c with b known: numpy's least squares on the columns b t and 1."""
    columns = np.column_stack([TRUTH["b"] * T, np.ones_like(T)])
    expected = NOISE * np.sqrt(np.diag(np.linalg.inv(columns.T @ columns)))
    found = look("a", "c")
    assert [found.parameters["a"].std, found.parameters["c"].std] == pytest.approx(expected, rel=1e-6)
    assert found.chi2_per_dof == pytest.approx(1.0, abs=0.4) and found.combinations == ()


def test_a_product_is_named_and_a_factor_is_told_with_the_other_held() -> None:
    found = look("a", "b", "c")
    (words,) = found.combinations
    assert "only a*b is seen" in words
    (held,) = [n for n, p in found.parameters.items() if p.std is None]
    other = {"a": "b", "b": "a"}[held]
    assert found.parameters[other].conditional_on == (held,)
    alone = look(other, "c")
    assert found.parameters[other].std == pytest.approx(alone.parameters[other].std, rel=1e-6)
    assert any("with" in line and "held" in line for line in found.lines)


CARD = """schema = 1
name = "lag"
[parameters]
T = {value = 0.3, unit = "s", min = 0.05, max = 2}
[inputs]
u = {value = 0.0}
[states]
x = {derivative = "(u - x)/T"}
[outputs]
y = "x"
"""
STUDY = """schema = 1
[model]
source = "lag.toml"
[parameters]
T = {min = 0.1, max = 1}
[[experiment]]
name = "a"
data = "a.csv"
inputs = ["u"]
outputs = ["y"]
noise = {y = 1e-3}
interpolation = "hold"
[identifiability]
"""


def test_an_interrupt_leaves_the_first_answer_marked_as_such_and_never_instead_of_a_whole_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    t = np.arange(0.0, 2.0, 0.02)
    y = np.where(t < 0.5, 0.0, 1.0 - np.exp(-np.maximum(t - 0.5, 0.0) / 0.36))
    y += 1e-3 * np.random.default_rng(0).standard_normal(t.size)
    rows = np.column_stack([t, t >= 0.5, y])
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header="time,u,y", comments="")
    (tmp_path / "lag.toml").write_text(CARD)
    study = tmp_path / "s.toml"
    study.write_text(STUDY)

    def run(command: str, *options: str) -> Any:
        return CliRunner().invoke(app, [command, str(study), *options])

    def stands() -> dict[str, Any]:
        found: dict[str, Any] = json.loads((tmp_path / "s-results" / "identifiability.json").read_text())
        return found

    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(identify, "SOON", 0.0)
    with monkeypatch.context() as patch:
        patch.setattr(identifiability, "identifiability", interrupted)
        result = run("identify")
        assert result.exit_code == 130 and "First answer" in result.output and "determined there" in result.output
        left = stands()
        assert left["status"] == "first-answer" and left["fingerprint"] == "" and "parameters" not in left
        assert left["first"]["parameters"]["T"]["value"] == 0.3 and left["first"]["parameters"]["T"]["std"] > 0.0
        assert run("report").exit_code == 0
        assert "irst answer" in (tmp_path / "s-results" / "report.html").read_text()
        patch.setattr(identifiability, "identifiability", lambda *_, **__: signal.pause())
        result = run("identify", "--budget", "5")
        assert result.exit_code == 1 and "identify: ended by the budget of 5 s at: first answer" in result.output
        ended = stands()
        assert ended["status"] == "unfinished" and ended["fingerprint"] == "" and ended["first"] == left["first"]
        assert "the profiles, on which the verdicts rest" in ended["not_tried"]
    assert run("identify").exit_code == 0
    whole = stands()
    assert whole["parameters"]["T"]["verdict"] == "identifiable" and "first" not in whole
    monkeypatch.setattr(identifiability, "identifiability", interrupted)
    assert run("identify").exit_code == 130 and stands() == whole
