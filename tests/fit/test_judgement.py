"""Whether a model follows its records: by the noise, a tolerance, and the windows of a profile."""

from __future__ import annotations

import re
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from hvdc_ident.codec import plain
from hvdc_ident.data import InputSignal
from hvdc_ident.errors import InputError, StudyError, UnknownNameError
from hvdc_ident.fit import tolerance_profile
from hvdc_ident.fit.judgement import Count, event_end, judge
from hvdc_ident.fit.residual import Curve
from hvdc_ident.fit.tolerance_profile import shipped, tolerance
from tests.fit.simulators import recorded

T = np.round(np.arange(0, 4.0001, 0.01), 9)
PROFILE = tolerance()


def curve(model, measured, rows=None) -> Curve:
    rows = np.arange(T.size) if rows is None else rows
    return Curve(np.asarray(model), np.asarray(measured), rows, 1e-3, None, None)


def pulse(error, unit="pu", signal=None, event=1.0):
    """The errors of a model that is off by `error` from a reference of a pulse between 1 s and 2 s, as JSON holds them."""
    u = signal or InputSignal.corners([(1.0, 0.0), (1.0, 1.0), (2.0, 1.0), (2.0, 0.0)])
    y = u(T)
    e = recorded("e", T, rest={"inputs": {"u": u}, "event": event}, y=y)
    found = judge({"e": {"y": curve(y + error, y)}}, (e,), {"y": unit}, PROFILE)
    return plain(found.signals["y"]["e"].windows)


def test_the_shipped_limits_are_those_that_were_published():
    """RTE's open tool, set-point steps in simulation, pu: max .05/.08/.05, mean .02/.05/.02, absolute .03/.07/.03."""
    order = ("before", "during", "after")
    assert [PROFILE.limits[w]["max"] for w in order] == [0.05, 0.08, 0.05]
    assert [PROFILE.limits[w]["mean"] for w in order] == [0.02, 0.05, 0.02]
    assert [PROFILE.limits[w]["mean_absolute"] for w in order] == [0.03, 0.07, 0.03]
    assert PROFILE.version and "61400-27-2" in PROFILE.source
    assert PROFILE.name in shipped()


def test_the_three_kinds_of_error_in_the_three_windows():
    error = np.where(T < 1.0, 0.01, np.where(T < 2.0, -0.06 * np.sign(np.sin(40 * T)), 0.04))
    found = pulse(error)
    assert (found["event"], found["end"], found["end_from"]) == (1.0, 2.0, "inputs")
    before, during, after = found["before"], found["during"], found["after"]
    assert (before["from"], before["to"]) == pytest.approx((0.0, 0.95))
    assert (during["from"], during["to"]) == pytest.approx((1.02, 1.98))
    assert (after["from"], after["to"]) == pytest.approx((2.02, 3.98))
    assert before["max"] == pytest.approx(0.01) and before["mean"] == pytest.approx(0.01)
    inside = (during["from"] <= T) & (during["to"] >= T)
    assert during["max"] == pytest.approx(0.06) and during["mean_absolute"] == pytest.approx(0.06)
    assert during["mean"] == pytest.approx(error[inside].mean())
    assert (during["n"], during["limits"]["max"]) == (int(inside.sum()), 0.08)
    assert [w["within"] for w in (before, during, after)] == [True, True, False]  # 0.04 mean after the event


def test_the_sign_of_the_mean_is_model_less_reference_and_its_size_is_limited():
    found = pulse(np.full(T.size, -0.025))
    assert found["before"]["mean"] == pytest.approx(-0.025)
    assert found["before"]["within"] is False


def test_limits_hold_for_their_unit_alone():
    found = pulse(np.full(T.size, 3.0), unit="kA")
    assert found["before"]["max"] == pytest.approx(3.0)
    assert (found["before"]["limits"], found["before"]["within"]) == (None, None)


def test_what_is_not_judged_is_not_passed():
    """A boiler's power in MW, off by a half, beside a valve in pu on its record, a second valve off by a tenth, and rows of none."""
    u = InputSignal.step(1.0, 0.0, 1.0)
    y = np.where(T < 1.0, 0.0, 1.0 - np.exp(-(T - 1.0) / 0.2))
    e = recorded("e", T, rest={"inputs": {"u": u}, "event": 1.0}, P=30 * y, valve=y, spare=y, dumb=y)
    curves = {
        "P": curve(20 * y, 30 * y),
        "valve": curve(y, y),
        "spare": curve(y + 0.1, y),
        "dumb": curve(y, y, np.arange(96, 102)),
    }
    units = {"P": "MW", "valve": "p.u.", "spare": "pu", "dumb": "pu"}
    found = judge({"e": curves}, (e,), units, PROFILE, named=True)
    lines = {o: line["e"].windows for o, line in found.signals.items()}
    assert {o: a.within for o, a in lines.items()} == {"P": None, "valve": True, "spare": False, "dumb": None}
    assert lines["P"].reason == "the limits are in pu, the output is in MW"
    assert lines["dumb"].reason == "no row in any window" and lines["valve"].reason == ""
    assert found.count("windows") == Count(passed=1, failed=1, not_judged=2)
    assert (found.by, found.follows) == ("windows", False)
    kept = judge({"e": {n: curves[n] for n in ("P", "valve")}}, (e,), units, PROFILE, named=True)
    assert (kept.by, kept.follows) == ("windows", None)
    alone = judge({"e": {"P": curves["P"]}}, (e,), units, PROFILE, named=True)
    assert alone.by == "noise"  # the profile judges nothing here


def test_a_step_is_over_where_the_reference_has_settled():
    u = InputSignal.step(1.0, 0.0, 1.0)
    y = np.where(T < 1.0, 0.0, 1.0 - np.exp(-(T - 1.0) / 0.2))
    e = recorded("e", T, rest={"inputs": {"u": u}, "event": 1.0}, y=y)
    end, source = event_end(e, y, 0.05)
    assert source == "settling"
    assert end == pytest.approx(1.0 + 0.2 * np.log(20), abs=0.011)  # exp(-t/0.2) = 5 %
    assert event_end(e, np.zeros(T.size), 0.05) == (1.0, "settling")


def test_a_window_without_rows_and_an_experiment_without_event_have_no_errors():
    still = pulse(np.zeros(T.size), signal=InputSignal.constant(1.0), event=None)
    assert still == {"event": None, "within": None, "reason": "no event: no input moves and none is given"}
    late = pulse(np.zeros(T.size), signal=InputSignal.step(3.995, 0.0, 1.0), event=3.995)
    assert (late["after"]["n"], late["after"]["max"], late["after"]["within"]) == (0, None, None)


def test_rows_that_are_not_compared_are_not_counted():
    u = InputSignal.step(1.0, 0.0, 1.0)
    y = u(T)
    e = recorded("e", T, rest={"inputs": {"u": u}, "event": 1.0}, y=y)
    error = np.where(T < 0.5, 5.0, 0.0)
    rows = np.flatnonzero(T >= 0.5)
    found = judge({"e": {"y": curve(y + error, y, rows)}}, (e,), {"y": "pu"}, PROFILE)
    assert found.signals["y"]["e"].windows.before.max == 0.0


def test_a_profile_of_ones_own_is_a_file(tmp_path):
    text = (files("hvdc_ident.fit") / "tolerances" / "set-point-step-simulation.toml").read_text(encoding="utf-8")
    (tmp_path / "mine.toml").write_text(text.replace("max = 0.08", "max = 0.5"), encoding="utf-8")
    assert tolerance("mine.toml", tmp_path).limits["during"]["max"] == 0.5
    with pytest.raises(UnknownNameError, match="did you mean 'set-point-step-simulation'"):
        tolerance("set-point-steps-simulation")
    with pytest.raises(StudyError, match="cannot be read"):
        tolerance("absent.toml", tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("schema = 1", "schema = 2", "expected schema = 1, got 2"),
        ("max = 0.08", "max = -0.08", r"limits\.during\.max: .*expected a number of at least 0, got -0.08"),
        ("max = 0.08", 'max = "a"', r"limits\.during\.max: .*expected a number, got \"a\""),
        ("max = 0.08", "most = 0.08", "limits.during: unknown key 'most'"),
        ("[windows]", "[windows", "not valid TOML"),
        ("settling = 0.05", "settling = inf", r"windows\.settling: .*expected a finite number, got inf"),
    ],
)
def test_a_profile_that_is_wrong_is_refused(tmp_path, old, new, message):
    text = (files("hvdc_ident.fit") / "tolerances" / "set-point-step-simulation.toml").read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "bad.toml").write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError, match=message):
        tolerance("bad.toml", tmp_path)


def test_nobody_is_told_to_comply():
    texts = [f.read_text(encoding="utf-8") for f in (files("hvdc_ident.fit") / "tolerances").iterdir()]
    texts.append(Path(tolerance_profile.__file__).read_text(encoding="utf-8"))
    assert texts and not any(re.search("complian|comply", t, re.IGNORECASE) for t in texts)


def noisy(sigma, seed=0, n=T.size):
    return sigma * np.random.default_rng(seed).standard_normal(n)


def on_noise(error, stated):
    """Whether a straight record that the model misses by an error is followed to the noise stated, if any."""
    y = 1.0 + 0.1 * T
    e = recorded("e", T, None if stated is None else {"y": stated}, y=y + error)
    sigma = np.nan if stated is None else stated
    run = Curve(y, y + error, np.arange(T.size), sigma, None, None)
    return judge({"e": {"y": run}}, (e,), {"y": "pu"}, PROFILE)


def test_the_noise_judges_each_signal():
    assert on_noise(noisy(0.01), 0.01).follows is True
    assert on_noise(noisy(0.01) + 0.02, 0.01).follows is False
    assert on_noise(noisy(0.03), 0.01).follows is False
    found = on_noise(noisy(0.01) + 0.02, 0.01).signals["y"]["e"]
    assert (found.noise, found.rmse) == (0.01, pytest.approx(np.hypot(0.01, 0.02), rel=0.05))
    assert found.peak == pytest.approx(np.abs(noisy(0.01) + 0.02).max())
    unstated = on_noise(noisy(0.01), None)
    assert unstated.follows is True and unstated.signals["y"]["e"].noise == pytest.approx(0.01, rel=0.2)
    assert on_noise(noisy(0.01) + 0.03, None).follows is False
    assert on_noise(0.01 * np.sin(T), None).follows is None  # rows that show no noise


def test_a_tolerance_that_a_study_states_is_what_judges():
    y = 1.0 + 0.1 * T
    e = recorded("e", T, {"y": 0.01, "z": 0.01}, y=y, z=y)
    curves = {"e": {n: Curve(y, y + noisy(0.05), np.arange(T.size), 0.01, None, None) for n in ("y", "z")}}
    units = {"y": "pu", "z": "pu"}
    assert judge(curves, (e,), units, PROFILE).follows is False
    kept = judge(curves, (e,), units, PROFILE, tolerance={"y": 0.1}, named=True)
    assert (kept.by, kept.follows) == ("tolerance", None)  # z has none
    assert judge(curves, (e,), units, PROFILE, tolerance={"y": 0.1, "z": 0.1}).follows is True
    assert judge(curves, (e,), units, PROFILE, tolerance={"y": 0.1, "z": 0.01}).follows is False
