"""Two results side by side, as a user compares them."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm
from typer.testing import CliRunner, Result

import hvdc_ident as hi
from hvdc_ident.cli import app
from hvdc_ident.study.comparison import ComparedValue, distance

CARD = """\
schema = 1
name = "lag"
[parameters]
k = {value = 1.0, unit = "1/s", min = 0.001, max = 1000.0}
g = {value = 2.0}
[inputs]
u = {value = 0.0}
[states]
x = {derivative = "k*(g*u - x)"}
[outputs]
y = {value = "x", unit = "MW"}
"""


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(a) for a in arguments])


def write_study(
    folder: Path, rate: float, *, gain: float = 2.0, seed: int = 1, names: tuple[str, ...] = ("step",)
) -> Path:
    """A lag of that rate, 1/s, recorded with noise of 0.01 MW."""
    folder.mkdir()
    time = np.arange(201) * 0.01
    random = np.random.default_rng(seed)
    text = (
        f'schema = 1\nname = "{folder.name}"\n[model]\nsource = "lag.toml"\n[model.values]\ng = {gain}\n'
        "[parameters]\nk = {start = 3, min = 0.5, max = 20}\n[fit]\nstarts = 2\n"
    )
    (folder / "lag.toml").write_text(CARD)
    for name in names:
        u = np.where(time >= 0.5, 1.0, 0.0)
        y = gain * np.where(time >= 0.5, 1.0 - np.exp(-rate * (time - 0.5)), 0.0) + 0.01 * random.standard_normal(201)
        np.savetxt(folder / f"{name}.csv", np.column_stack([time, u, y]), delimiter=",", header="time,u,y", comments="")
        text += f'[[experiment]]\nname = "{name}"\ndata = "{name}.csv"\ninputs = ["u"]\noutputs = ["y"]\nnoise = {{y = 0.01}}\n'
    (folder / "study.toml").write_text(text)
    assert call("run", folder / "study.toml", "--quiet").exit_code == 0
    return folder / "study.toml"


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two plants of 5 and 6 1/s; the second has a recording more and another gain."""
    folder = tmp_path_factory.mktemp("pair")
    second = write_study(folder / "b", 6.0, gain=2.5, seed=2, names=("step", "again"))
    return write_study(folder / "a", 5.0), second


def ends(value: float, std: float) -> tuple[float, float]:
    return value - norm.isf(0.025) * std, value + norm.isf(0.025) * std


def test_the_distance_of_equal_values_is_above_1_in_5_percent_of_cases() -> None:
    random = np.random.default_rng(5)
    draws = random.standard_normal((20_000, 2)) * (0.3, 0.7)
    apart = [distance((a, b), (ends(a, 0.3), ends(b, 0.7))) for a, b in draws]
    share = np.mean([a is not None and a > 1.0 for a in apart])
    assert share == pytest.approx(0.05, abs=4.0 * math.sqrt(0.05 * 0.95 / len(draws)))


@pytest.mark.parametrize(
    ("values", "intervals", "apart"),
    [
        ((1.0, 2.0), ((0.0, 1.3), (1.6, 9.0)), 2.0),  # 3-4-5
        ((2.0, 1.0), ((1.6, 9.0), (0.0, 1.3)), 2.0),
        ((1.0, 2.0), ((0.0, None), (1.6, 9.0)), None),
        ((1.0, 2.0), (None, (1.6, 9.0)), None),
        ((1.0, None), ((0.0, 1.3), None), None),
        ((1.0, 1.0), ((1.0, 1.0), (1.0, 1.0)), 0.0),
        ((1.0, 2.0), ((1.0, 1.0), (2.0, 2.0)), None),
    ],
)
def test_the_halves_that_face_each_other_count(values: Any, intervals: Any, apart: float | None) -> None:
    assert distance(values, intervals) == (apart if apart is None else pytest.approx(apart))


@pytest.mark.parametrize(
    ("value", "ci95", "shown"),
    [
        (12345.0, [12195.0, 12495.0], "12345 (12195 to 12495)"),
        (5.0204, [5.0001, 5.0407], "5.020 (5.000 to 5.041)"),
        (183000.0, [180000.0, 189000.0], "183000 (180000 to 189000)"),
        (18.0, [17.9, None], "18 (above 17.9)"),
        (0.002, [0.0019, 0.0021], "0.00200 (0.00190 to 0.00210)"),
    ],
)
def test_values_below_ten_million_have_no_exponent(value: float, ci95: list[float | None], shown: str) -> None:
    """The figures of an interval end where two of its half are told."""
    both, ends = (value, value), (ci95[0], ci95[1])
    line = ComparedValue("k", "", both, both, (ends, ends), False, ("", ""), None, None, (None, None), (None, None))
    assert line.texts == (shown, shown)


def test_two_plants_are_told_apart(pair: tuple[Path, Path], tmp_path: Path) -> None:
    result = call("compare", pair[0], pair[1].parent, "--out", tmp_path / "page")
    assert result.exit_code == 0, result.output
    data = json.loads(call("compare", *pair, "--json").stdout)
    (value,) = data["values"]
    first, second = (json.loads((p.parent / "study-results/fit.json").read_text())["estimates"]["k"] for p in pair)
    assert value["values"] == [first["value"], second["value"]] and value["unit"] == "1/s"
    widths = (first["ci95"][1] - first["value"], second["value"] - second["ci95"][0])
    assert value["apart"] == pytest.approx((second["value"] - first["value"]) / math.hypot(*widths))
    assert value["apart"] > 5.0 and value["change_percent"] == pytest.approx(20.0, abs=3.0)
    assert "Apart beyond both intervals: k." in result.stdout
    assert data["given_values"] == {"g": [2.0, 2.5]} and "given value of g: 2 and 2.5" in result.stdout
    assert data["sources"] == {"differ": ["study.toml", "step.csv"], "first": [], "second": ["again.csv"]}
    assert data["differing"] == {"study": ["a", "b"]}
    page = (tmp_path / "page" / "compare.html").read_text()
    assert "<!doctype html>" in page.lower() and "a and b" in page and "inputs of the second alone: again.csv" in page
    assert f"page: {tmp_path / 'page' / 'compare.html'}" in result.stdout


def test_gaps_are_those_of_the_recordings_that_both_have(pair: tuple[Path, Path]) -> None:
    """At the given rate of 1/s the RMSE is that of two exponentials."""
    data = hi.compare_runs(*pair).to_dict()
    given = next(g for g in data["gaps"] if g["at"] == "given")
    assert given["recordings"] == 1 and list(given["by_recording"]) == ["step"] and given["unit"] == "MW"
    for path, rmse, gain in zip(pair, given["rmse"], (2.0, 2.5), strict=True):
        time, u, y = np.loadtxt(path.parent / "step.csv", delimiter=",", skiprows=1).T
        model = gain * np.where(u > 0, 1.0 - np.exp(-(time - 0.5)), 0.0)
        assert rmse == pytest.approx(np.sqrt(np.mean((y - model) ** 2)), rel=1e-6)
    fitted = next(g for g in data["gaps"] if g["at"] == "fitted")
    assert fitted["rmse"] == pytest.approx([0.01, 0.01], rel=0.2)


def test_a_result_compared_with_itself_differs_in_nothing(pair: tuple[Path, Path]) -> None:
    found = hi.compare_runs(pair[0], pair[0].parent / "study-results")
    data = found.to_dict()
    assert [v["apart"] for v in data["values"]] == [0.0] and {g["ratio"] for g in data["gaps"]} == {1.0}
    assert "inputs, software, model and given values: the same" in found.lines
    assert "fit: the same: converged" in found.lines and found.lines[-1].startswith("No value differs")
    assert found._repr_html_().count("<table>") == 2


def test_findings_stand_beside_each_other(pair: tuple[Path, Path], tmp_path: Path) -> None:
    """A folder with a finding against one whose diagnosis found nothing."""
    for name, findings in (
        ("one", [{"effect": "lag", "probability": 0.9, "text": "T = 2 ms", "places": []}]),
        ("none", []),
    ):
        folder = tmp_path / name
        folder.mkdir()
        heading = {"schema": 1, "study": name, "model": "m", "software": "s", "seed": 0, "fingerprint": "x"}
        found = {"verdict": "named" if findings else "no-evidence", "text": name, "findings": findings}
        (folder / "discrepancy.json").write_text(json.dumps({**heading, **found}))
    result = call("compare", tmp_path / "one", tmp_path / "none", "--out", tmp_path)
    assert "missing, first: lag (90 %): T = 2 ms" in result.stdout
    assert (
        "missing, second: nothing was found" in result.stdout and "missing: different effects in both" in result.stdout
    )
    assert "No value was fitted in both." in result.stdout
    assert "T = 2 ms" in (tmp_path / "compare.html").read_text()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("nowhere",), "no such study, and no such folder"),
        (("empty",), "no results in the folder"),
        (("a", "--open"), "--open has no page to open"),
    ],
)
def test_what_cannot_be_compared_is_refused(
    pair: tuple[Path, Path], tmp_path: Path, more: tuple[str, ...], words: str
) -> None:
    (tmp_path / "empty").mkdir()
    result = call("compare", pair[0], tmp_path / more[0], *more[1:])
    assert result.exit_code == 2 and words in result.stderr and ". Try: " in result.stderr
