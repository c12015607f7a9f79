"""A sweep's rows: exact numbers, failures with reasons, one order whatever runs them."""

from __future__ import annotations

import csv
import io
import json

import numpy as np
import pytest

from hvdc_ident.data import InputSignal, experiment, trajectory
from hvdc_ident.effects import apply_effects
from hvdc_ident.errors import InputError, StudyError, UnknownNameError
from hvdc_ident.executor import Outcome
from hvdc_ident.files import Rows, csv_cell, csv_name, json_text
from hvdc_ident.model import parse_card
from hvdc_ident.models import load_model
from hvdc_ident.sensitivity import Quantities, grid, latin_hypercube, listed, sweep
from hvdc_ident.study.store import CachingExecutor
from tests.effort import calls

CARD = """
schema = 1
name = "lag"
[parameters]
k = {value = 2.0, unit = "1/s", min = 0.0, max = 1000.0}
g = {value = 1.0, min = -10.0, max = 10.0}
[inputs]
u = {value = 0.0}
w = {value = 1.0}
[states]
x = {derivative = "u + w - k*x"}
[outputs]
y = "g*x"
"""
TIME = np.arange(101) * 0.01
MODEL = parse_card(CARD)
STEP = experiment("step", TIME, {"u": InputSignal.step(0.0, 0.0, 1.0)})


def response(k, g=1.0):
    """y after u has gone from 0 to 1 at t = 0, from rest."""
    return g * (2 - np.exp(-k * TIME)) / k


RECORDED = STEP.with_(measured=trajectory(TIME, {"y": response(3.0)}))


def test_errors_are_those_of_the_closed_solution():
    found = sweep(MODEL, [RECORDED], listed("k", [1, 3, 5]))
    want = [np.sqrt(np.mean((response(k) - response(3.0)) ** 2)) for k in (1, 3, 5)]
    assert np.allclose(found.error("y", "step"), want, atol=1e-8)
    assert found.best("y", "step") == {"k": 3.0} and not found.failed


def test_against_the_base_and_against_another_model():
    base = sweep(MODEL, [STEP], grid("k", 1, 3, 3), against="base")
    assert base.error("y", "step")[1] == 0.0 and base.base["k"] == 2.0
    other = sweep(MODEL, [STEP], listed("k", [2, 4]), against=MODEL.with_values({"k": 4}))
    assert other.error("y", "step")[1] < 1e-9 < other.error("y", "step")[0]


def test_the_window_and_the_base_values_count():
    windowed = RECORDED.with_(window=(0.5, 1.0))
    found = sweep(MODEL, [windowed], listed("k", [1.0]), values={"g": 2.0})
    rows = windowed.compared
    assert found.rmse[0, 0] == pytest.approx(np.sqrt(np.mean((response(1, 2) - response(3))[rows] ** 2)), abs=1e-8)


def test_a_failed_point_is_a_row_with_a_reason_and_no_number():
    found = sweep(MODEL, [RECORDED], listed("k", [1, 0, 3]), want=("rmse", "poles"))
    assert list(found.failed) == [1] and "steady state" in found.failed[1]
    rows = list(csv.DictReader(io.StringIO(found.to_csv())))
    assert [r["status"] for r in rows] == ["done", "failed", "done"]
    assert rows[1]["rmse.y.step"] == "" and "steady state" in rows[1]["reason"]
    point = found.to_dict()["points"][1]
    assert point["rmse"] == {"y": {"step": None}} and point["poles"] is None and point["reason"]
    assert str(found.to_xarray()["status"].values[1]) == "failed"


def test_poles_and_response_at_each_point():
    omega = np.array([0.1, 10.0])
    found = sweep(MODEL, [], listed("k", [1, 5]), want=Quantities(("poles", "bode"), ["u"], ["y"], omega))
    assert np.allclose(found.poles[:, 0], [-1, -5])
    assert np.allclose(found.response[:, :, 0, 0], [[1 / (1j * w + k) for w in omega] for k in (1, 5)])
    assert found.to_dict()["points"][0]["bode"]["y"]["u"][0] == pytest.approx([1 / 1.01, -0.1 / 1.01])


def test_the_phase_at_each_point_counts_the_turns_of_a_delay():
    late = apply_effects(MODEL, [{"effect": "delay", "at": ["y"], "parameters": {"T": 0.5}}])
    omega = np.array([0.1, 3.0, 200.0])
    found = sweep(late, [], listed("k", [1, 5]), want=Quantities(("bode",), ["u"], ["y"], omega))
    want = [-np.degrees(np.arctan(omega / k) + 0.5 * omega) for k in (1, 5)]
    np.testing.assert_allclose(found.phase_deg[:, :, 0, 0], want, atol=1e-6)
    back = type(found).from_dict(json.loads(json_text(found.to_dict())))
    np.testing.assert_array_equal(back.phase_deg, found.phase_deg)
    np.testing.assert_array_equal(found.to_xarray()["phase"].values, found.phase_deg)


def test_a_grid_of_two_and_an_input_as_an_axis():
    found = sweep(MODEL, [STEP], [grid("k", 1, 3, 3), listed("w", [0, 1])], against="base")
    dataset = found.to_xarray()
    assert dataset["rmse"].dims == ("k", "w", "output", "experiment") and dataset["rmse"].shape == (3, 2, 1, 1)
    assert float(dataset["rmse"].sel(k=2, w=1).squeeze()) == 0.0
    assert found.row(3)["values"] == {"k": 2.0, "w": 1.0}
    with pytest.raises(StudyError, match="moved by experiment"):
        sweep(MODEL, [STEP], listed("u", [1]), against="base")


class Backwards:
    """Runs the last item first, as workers may."""

    def run(self, function, items):
        for index, item in reversed(list(enumerate(items))):
            yield (
                Outcome(index, function(item)) if index % 7 else Outcome(index, None, "its worker was ended by SIGSEGV")
            )


def test_rows_stand_where_their_points_stand():
    axis = latin_hypercube({"k": (1, 9), "g": (1, 2)}, 30, seed=1)
    plain = sweep(MODEL, [RECORDED], axis)
    found = sweep(MODEL, [RECORDED], axis, executor=Backwards())
    failed = list(found.failed)
    assert failed == list(range(0, 30, 7)) and set(found.failed.values()) == {"its worker was ended by SIGSEGV"}
    kept = [i for i in range(30) if i not in failed]
    assert np.array_equal(found.rmse[kept], plain.rmse[kept])


class Shelf(dict):
    def get(self, keys):
        return {k: self[k] for k in keys if k in self}

    def put(self, key, value):
        assert key not in self  # nothing is computed twice
        self[key] = value


def test_what_is_kept_is_not_run_again_and_what_differs_is_elsewhere():
    shelf = Shelf()

    def kept(model, record, points, **more):
        return sweep(model, [record], grid("k", 0, 4, points), executor=CachingExecutor(shelf, by_item=True), **more)

    first = kept(MODEL, RECORDED, 5)
    again = kept(MODEL, RECORDED, 9)
    assert len(shelf) == 9 and again.to_csv().splitlines()[1] == first.to_csv().splitlines()[1]
    assert np.array_equal(kept(MODEL, RECORDED, 9).rmse, again.rmse, equal_nan=True) and len(shelf) == 9
    assert again.failed and kept(MODEL, RECORDED, 9).failed == again.failed  # the reasons are kept as well
    kept(MODEL.with_values({"g": 1.5}), RECORDED, 5)
    kept(MODEL, RECORDED.with_(window=(0, 0.5)), 5)
    kept(MODEL, RECORDED, 5, values={"w": 2.0})
    both = kept(MODEL, RECORDED, 5, want=("rmse", "poles", "bode"))
    assert len(shelf) == 9 + 4 * 5
    back = kept(MODEL, RECORDED, 5, want=("rmse", "poles", "bode"))
    assert np.array_equal(back.response, both.response, equal_nan=True)
    assert np.array_equal(back.poles, both.poles, equal_nan=True)


def test_text_that_a_spreadsheet_would_calculate_is_quoted():
    assert [csv_cell(t) for t in ("=1+1", "+a", "-a", "@a", "\ta", "plain", "two\nlines")] == [
        "'=1+1", "'+a", "'-a", "'@a", "'\ta", "plain", "two lines",
    ]  # fmt: skip
    assert [csv_name(csv_cell(t)) for t in ("=1+1", "'=1", "plain", "'quoted'")] == ["=1+1", "=1", "plain", "'quoted'"]
    odd = RECORDED.with_(name="=cmd()")
    assert "rmse.y.=cmd()" in sweep(MODEL, [odd], listed("k", [1])).to_csv()
    assert sweep(MODEL, [odd], listed("k", [-0.0])).to_csv().splitlines()[1].startswith("-0.0,")


@pytest.mark.parametrize(
    ("arguments", "named", "kind"),
    [
        (([RECORDED], listed("q", [1])), {}, UnknownNameError),
        (([RECORDED], listed("k", [1])), {"values": {"q": 1}}, UnknownNameError),
        (([RECORDED], listed("k", [1])), {"want": ("poels",)}, UnknownNameError),
        (([RECORDED], listed("k", [-1])), {}, StudyError),
        (([], listed("k", [1])), {}, StudyError),
        (([STEP], listed("k", [1])), {}, StudyError),
        (([RECORDED, RECORDED], listed("k", [1])), {}, StudyError),
        (([RECORDED], listed("k", [1])), {"against": "datum"}, StudyError),
    ],
)
def test_what_does_not_fit_is_said_before_anything_runs(arguments, named, kind):
    with pytest.raises(kind) as error:
        sweep(MODEL, *arguments, **named)
    assert isinstance(error.value, InputError) and str(error.value)


def test_json_of_rows_made_one_by_one_is_json():
    found = sweep(MODEL, [RECORDED], listed("k", [1, 0]))
    data = {**found.heading, "points": Rows(found.rows, len(found)), "none": Rows(list, 0)}
    read = json.loads(json_text(data))
    assert read.pop("none") == [] and read == json.loads(json_text(found.to_dict()))


def test_it_draws_and_tells():
    import matplotlib.pyplot as plt

    found = sweep(MODEL, [RECORDED], listed("k", [1, 3]))
    assert found.plot().get_xlabel() == "k, 1/s"
    plt.close("all")
    assert "k = 3" in str(found) and "<table>" in found._repr_html_()


def test_a_further_point_of_a_sweep_is_a_simulation_and_no_more():
    link, times = load_model("vsc-hvdc-link"), np.arange(1001) * 1e-3
    step = experiment("v", times, {"Vdcref1": InputSignal.step(0.1, 1, 1.019)})

    def points(number):
        return sweep(link, [step], grid("KIVDC", 250, 1500, number), against="base", outputs=["Irorder1"])

    points(2)
    assert calls(lambda: points(51)) < 500 * 51 and not points(51).failed
