"""`check` ends with what a run would stumble over: a sign, a start without rest, a model that runs away, a value out of bounds.

The plant is a tank that fills with u and empties through a valve of conductance k: h' = u - k h, by its closed form.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

import hvdc_ident as hi
from hvdc_ident.cli import app

TIME = np.arange(0.0, 4.0, 0.02)
EVENT, K = 1.0, 1.5
EQUATION = "u - k*h"
CARD = """schema = 1
name = "tank"
[parameters]
k = {{value = 1.4, unit = "1/s", min = 0.01, max = 90}}
[inputs]
u = {{value = 1.0}}
[states]
h = {{derivative = "{equation}", guess = 0.7}}
[outputs]
level = "h"
"""
STUDY = """schema = 1
name = "tanks"
[model]
source = "tank.toml"
[parameters]
k = {line}
[fit]
starts = 1
[[experiment]]
name = "step"
data = "step.csv"
inputs = ["u"]
outputs = ["level"]
noise = {{level = 1e-3}}
"""
GOOD = "{start = 2.0, min = 0.5, max = 5}"


def write(folder: Path, equation: str = EQUATION, line: str = GOOD, sign: float = 1.0) -> Path:
    """The study of a record from rest at u = 1 to u = 2. sign: of the recorded level."""
    after = np.clip(TIME - EVENT, 0.0, None)
    level = (2.0 - np.exp(-K * after)) / K + 1e-3 * np.random.default_rng(4).standard_normal(TIME.size)
    rows = np.column_stack([TIME, np.where(TIME >= EVENT, 2.0, 1.0), sign * level])
    np.savetxt(folder / "step.csv", rows, delimiter=",", header="time,u,level", comments="")
    (folder / "tank.toml").write_text(CARD.format(equation=equation))
    (folder / "s.toml").write_text(STUDY.format(line=line))
    return folder / "s.toml"


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_a_study_without_a_hindrance_is_good_and_next_is_a_run(tmp_path: Path) -> None:
    path = write(tmp_path)
    lines = call("check", path).stdout.splitlines()
    assert lines[0] == "study tanks: good" and lines[-1] == f"Next: `hvdc-ident run {path}`"
    assert json.loads(call("check", path, "--json").stdout)["hindrances"] == []


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"sign": -1.0}, "sign?"),
        ({"sign": 100.0}, "in per cent?"),  # within k's bounds the level of other units can be reached too
        ({"equation": "u + h**2 + k"}, "no steady state was found"),
        # Above k = 2.2 the root has no value.
        ({"equation": "sqrt(2.2 - k) + u - k*h", "line": "{start = 4, min = 0.5, max = 5}"}, "at the start values"),
        ({"equation": "u - k*h + 40*(h - 0.71)**3 + 9*h**2*(u - 1)"}, "stopped"),
        ({"equation": "u - k*h + 20*(h - 1/1.4)"}, "runs away"),
        ({"line": "{start = 2.0, min = 1.5, max = 5}"}, "the given value 1.4 lies outside the bounds of the search, 1.5 to 5"),
    ],
    ids=["sign", "unit", "rest", "start", "stop", "away", "given"],
)  # fmt: skip
def test_what_a_run_would_stumble_over_is_the_end_of_the_check(
    tmp_path: Path, changes: dict[str, object], said: str
) -> None:
    path = write(tmp_path, **changes)  # type: ignore[arg-type]
    result = call("check", path)
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert not lines[0].endswith("good") and "`hvdc-ident run" not in result.stdout
    end = lines[lines.index("before a run:") + 1 :]
    assert said in end[0]
    assert end[-1] == f"Next: answer or mend what stands above, then `hvdc-ident check {path}`"
    assert result.stdout.count(end[0]) == 1
    found = json.loads(call("check", path, "--json").stdout)["hindrances"]
    assert found == end[:-1]
    assert str(hi.check(path)).splitlines()[-1].endswith("`hi.check(...)`")


@pytest.mark.parametrize(
    "changes",
    [
        {"equation": "sqrt(2.2 - k) + u - k*h", "line": "{start = 4, min = 0.5, max = 5}"},
        {"equation": "u - k*h + 40*(h - 0.71)**3 + 9*h**2*(u - 1)"},
        {"equation": "u + h**2 + k"},
    ],
    ids=["start", "stop", "rest"],
)
def test_a_run_does_stumble_there(tmp_path: Path, changes: dict[str, str]) -> None:
    assert call("run", write(tmp_path, **changes), "--quiet").exit_code != 0


def test_an_experiment_without_a_recording_is_run_too(tmp_path: Path) -> None:
    write(tmp_path, equation="u - k*h + 40*(h - 0.71)**3 + 9*h**2*(u - 1)")
    bare = hi.Experiment(TIME, "bare", inputs={"u": hi.step(1.0, 2.0, at=EVENT)})
    (line,) = hi.check(tmp_path / "tank.toml", bare).to_dict()["hindrances"]
    assert line.startswith("bare: ") and "stopped" in line


def test_a_remark_on_several_recordings_is_told_once_with_their_number(tmp_path: Path) -> None:
    path = write(tmp_path)
    text = path.read_text()
    table = text[text.index("[[experiment]]") :]
    path.write_text(text + table.replace('"step"', '"second"') + table.replace('"step"', '"third"'))
    shown = str(hi.check(path))
    assert "experiment step: the file does not say the unit of its time: taken as s (and so in 2 more)" in shown
    assert shown.count("the unit of its time") == 1
