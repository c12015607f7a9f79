"""Input signals, events and noise from rows."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from hvdc_ident.data import (
    InputSignal,
    at_rest,
    event_time,
    input_signal,
    noise_estimate,
    noise_floor,
    row_scatter,
)
from hvdc_ident.data.noise import FirstOrder, common_colours
from hvdc_ident.errors import WaveformError

T = np.arange(501) * 1e-3


def test_step_lies_at_first_row_with_new_value() -> None:
    signal = input_signal(T, np.where(T >= 0.1, 1.019, 1.0))
    assert signal.breaks.tolist() == [0.1]
    assert signal.times.tolist() == [0.0, 0.1, 0.1]
    assert signal.values.tolist() == [1.0, 1.0, 1.019]
    assert float(signal(0.0999)) == 1.0
    assert float(signal(0.1)) == 1.019


def test_hold_makes_stairs_of_what_linear_joins() -> None:
    time, values = [0.0, 1.0, 2.0, 3.0], [0.0, 1.0, 2.0, 2.0]
    held, joined = input_signal(time, values, "hold"), input_signal(time, values, "linear")
    assert float(held(0.5)) == 0.0
    assert float(joined(0.5)) == 0.5
    assert held.breaks.tolist() == [1.0, 2.0]
    assert joined.breaks.tolist() == [2.0]
    assert joined.times.tolist() == [0.0, 2.0, 3.0]


def test_no_interpolation_given_takes_hold_from_nine_tenths_equal_rows() -> None:
    values = np.zeros(101)
    values[-10:] = np.arange(1, 11)
    assert float(input_signal(np.arange(101.0), values)(91.5)) == 1.0  # 90 of 100 changes are zero: held
    values[-11:] = np.arange(1, 12)
    assert float(input_signal(np.arange(101.0), values)(91.5)) == 2.5  # 89: joined


@pytest.mark.parametrize("interpolation", [None, "hold", "linear"])
def test_two_rows_at_one_time_are_a_jump(interpolation: str | None) -> None:
    signal = input_signal([0.0, 0.1, 0.1, 0.3], [1.0, 1.0, 2.0, 2.0], interpolation)  # type: ignore[arg-type]
    assert signal.breaks.tolist() == [0.1]
    assert signal([0.05, 0.1, 0.2]).tolist() == [1.0, 2.0, 2.0]


def test_two_rows_at_one_time_of_a_held_signal_leave_no_third_value() -> None:
    signal = input_signal([0.0, 0.1, 0.1, 0.3], [1.0, 1.5, 2.0, 2.0], "hold")
    assert signal.values.tolist() == [1.0, 1.0, 2.0]


def test_jump_at_the_first_row() -> None:
    signal = input_signal([0.0, 0.0, 1.0], [1.0, 2.0, 2.0], "hold")
    assert signal.times.tolist() == [0.0, 0.0]
    assert signal.values.tolist() == [1.0, 2.0]
    assert signal.breaks.tolist() == [0.0]


def test_equal_rows_at_one_time_are_no_jump() -> None:
    assert input_signal([0.0, 1.0, 1.0, 2.0], [0.0, 1.0, 1.0, 2.0], "linear").breaks.size == 0


def test_ramp_keeps_its_corners_only() -> None:
    signal = input_signal(T, np.interp(T, [0.1, 0.4], [0.4, 0.5]))
    assert np.allclose(signal.times, [0, 0.1, 0.4, 0.5], atol=1e-12)
    assert np.allclose(signal.breaks, [0.1, 0.4], atol=1e-12)


def test_trapezoid_written_with_few_digits_keeps_four_breaks() -> None:
    values = np.round(np.interp(T, [0.1, 0.2, 0.35, 0.45], [0.0, 1.0, 1.0, 0.0]), 6)
    assert np.allclose(input_signal(T, values, "linear").breaks, [0.1, 0.2, 0.35, 0.45], atol=1e-3)


def test_jump_in_a_noisy_recording_is_the_only_break() -> None:
    values = np.where(T >= 0.2, 1.02, 1.0) + 1e-4 * np.random.default_rng(1).standard_normal(T.size)
    signal = input_signal(T, values)
    assert signal.breaks.tolist() == [0.2]
    assert abs(float(signal(0.19999)) - 1.0) < 1e-3
    assert float(signal(0.2)) == values[200]
    assert np.array_equal(signal(T), values)


def test_explicit_lines_have_no_found_jumps() -> None:
    values = np.where(T >= 0.2, 1.02, 1.0) + 1e-4 * np.random.default_rng(1).standard_normal(T.size)
    assert input_signal(T, values, "linear").breaks.size == 0


def test_curved_signal_has_no_breaks_and_stays_what_it_was() -> None:
    t = np.linspace(0, 1, 100_001)
    v = np.sin(40 * t)
    signal = input_signal(t, v)
    assert signal.breaks.size == 0
    assert np.abs(signal(t) - v).max() < 3e-9
    assert signal.times.size < t.size


def test_constant_is_one_point() -> None:
    for interpolation in (None, "hold", "linear"):
        signal = input_signal(T, np.full(T.size, 0.4), interpolation)  # type: ignore[arg-type]
        assert signal.is_constant
        assert signal.times.size == 1
    assert input_signal([0.0], [2.0]).is_constant


@given(
    st.lists(st.tuples(st.sampled_from([0.0, 0.1, 0.5]), st.floats(-10, 10, width=32)), min_size=1, max_size=40),
    st.sampled_from(["hold", "linear"]),
)
def test_a_signal_passes_through_its_rows(rows: list[tuple[float, float]], interpolation: str) -> None:
    steps, values = np.array(rows).T
    time = np.cumsum(steps)
    keep = np.append(np.diff(time) > 0, True) | np.append(True, np.diff(time) > 0)
    time, values = time[keep], values[keep]
    signal = input_signal(time, values, interpolation)  # type: ignore[arg-type]
    last = np.append(np.diff(time) > 0, True)
    assert np.allclose(signal(time[last]), values[last], rtol=0, atol=1e-8 * max(1.0, np.ptp(values)))
    assert np.isin(signal.breaks, time).all()


@pytest.mark.parametrize(
    ("time", "values"),
    [
        ([0, 1], [0, math.nan]),
        ([0, math.inf], [0, 1]),
        ([1, 0], [0, 1]),
        ([0, 0, 0], [1, 2, 3]),
        ([0, 1], [1]),
        ([], []),
    ],
)
def test_rows_that_are_no_signal(time: list[float], values: list[float]) -> None:
    with pytest.raises(WaveformError):
        input_signal(time, values)


def test_unknown_interpolation() -> None:
    with pytest.raises(WaveformError, match="expected 'hold' or 'linear'"):
        input_signal([0, 1], [0, 1], "cubic")  # type: ignore[arg-type]


def test_event_is_the_first_change_of_any_input() -> None:
    step, ramp = InputSignal.step(0.3, 1.0, 1.1), InputSignal.ramp(0.2, 0.0, 0.4, 1.0)
    flat_first = InputSignal.corners([(0.0, 1.0), (0.5, 1.0), (0.5, 2.0)])
    assert event_time({"a": step, "b": ramp, "c": InputSignal.constant(3.0)}) == 0.2
    assert event_time({"c": flat_first}) == 0.5
    assert event_time({"c": InputSignal.constant(3.0)}) is None
    assert event_time({}) is None


def test_event_of_a_noisy_recording() -> None:
    noise = 1e-4 * np.random.default_rng(2).standard_normal(T.size)
    assert event_time({"u": input_signal(T, 1 + noise)}) is None
    assert event_time({"u": input_signal(T, np.where(T >= 0.2, 1.02, 1.0) + noise)}) == 0.2
    slow = input_signal(T, 1 + np.clip(T - 0.2, 0, None) ** 2 + noise)
    found = event_time({"u": slow})
    assert found is not None
    assert 0.2 < found < 0.25


def test_noise_of_white_and_coloured_records() -> None:
    rng = np.random.default_rng(3)
    t = np.arange(4000) * 1e-3
    white = 2e-3 * rng.standard_normal(t.size)
    response = np.where(t >= 2, 1 - np.exp(-5 * (t - 2)), 0)
    assert noise_estimate(t, 0.4 + 0.01 * t + white + response, 2.0).std == pytest.approx(2e-3, rel=0.1)
    assert noise_estimate(t, 0.4 + white + response, None).std == pytest.approx(2e-3, rel=0.1)
    assert noise_estimate(t, 0.4 + white + response, 0.0).std == pytest.approx(2e-3, rel=0.1)
    coloured = np.zeros(t.size)
    for i in range(1, t.size):
        coloured[i] = 0.9 * coloured[i - 1] + white[i]
    assert noise_estimate(t, coloured, 4.0).std == pytest.approx(2e-3 / math.sqrt(1 - 0.81), rel=0.2)
    assert common_colours([FirstOrder.of([coloured])])[0].rho == pytest.approx(0.9, abs=0.03)
    assert abs(common_colours([FirstOrder.of([white])])[0].rho) < 0.05


def test_a_motion_before_the_event_is_no_noise() -> None:
    """A record that is still settling, or swings, before its event has the noise that was put on it."""
    t = np.arange(1500) * 0.01
    noise = 2e-3 * np.random.default_rng(8).standard_normal(t.size)
    settling = 0.1 * np.exp(-0.5 * t)
    swinging = 0.05 * np.exp(-0.2 * t) * np.cos(3.0 * t)
    after = np.where(t >= 4.0, 0.3 * (1.0 - np.exp(-(t - 4.0))), 0.0)
    for motion in (settling, swinging):
        assert noise_estimate(t, motion + after + noise, 4.0).std == pytest.approx(2e-3, rel=0.1)
        assert not at_rest((motion + noise)[:400])


def test_noise_of_any_correlation_time_is_no_motion() -> None:
    """Whatever the colour, alone or beside white noise, or rounded: at most one record in a thousand would be taken for one."""
    rng = np.random.default_rng(9)
    for n in (8, 25, 200):
        for rho in (0.0, 0.6, 0.9, 0.98):
            slow = lfilter([math.sqrt(1.0 - rho**2)], [1.0, -rho], rng.standard_normal((3, n + 600)))[:, 600:]
            white = 0.3 * rng.standard_normal((3, n))
            assert all(at_rest(r) for r in (*slow, *(slow + white), *np.round(slow + white)))
    assert at_rest(np.full(50, 0.3))
    assert at_rest(0.3 + 1e-3 * np.arange(50))
    assert at_rest([1.0, 2.0])


def test_noise_ignores_outliers() -> None:
    v = 1e-3 * np.random.default_rng(4).standard_normal(500)
    v[::50] += 1.0
    assert noise_estimate(np.arange(500.0), v, 500.0).std < 2e-3


@pytest.mark.parametrize("event", [None, 0.0, 0.25])
def test_deterministic_records_have_no_noise(event: float | None) -> None:
    response = np.where(T >= 0.25, 1 - np.exp(-20 * (T - 0.25)), 0.0)
    assert noise_estimate(T, response, event).std == 0.0
    assert noise_estimate(T, np.exp(-8 * T), event).std == 0.0
    uneven = np.cumsum(np.geomspace(1e-4, 1e-2, 200))
    assert noise_estimate(uneven, np.exp(-uneven), event).std == 0.0
    assert noise_estimate(T[:3], response[:3], event).std == 0.0


def test_floor_is_a_millionth_of_the_range_of_unquantised_values() -> None:
    assert noise_floor(5 * np.sin(40 * T)) == pytest.approx(1e-6 * np.ptp(5 * np.sin(40 * T)))
    assert noise_floor(np.linspace(0, 1, 101)) == pytest.approx(1e-6)
    assert noise_floor(np.where(T > 0.2, 1.0, 0.4)) == pytest.approx(0.6e-6)
    assert noise_floor([]) == 0.0
    assert noise_floor([1.0]) == 0.0


@pytest.mark.parametrize("step", [1e-3, 0.01, 1 / 4096])
def test_floor_knows_the_resolution(step: float) -> None:
    assert noise_floor(step * np.round(np.sin(40 * T) / step)) == pytest.approx(step / math.sqrt(12), rel=1e-6)
    flicker = 0.4 + step * np.random.default_rng(5).integers(0, 2, 400)
    assert noise_floor(flicker) == pytest.approx(step / math.sqrt(12), rel=1e-6)


def test_a_line_and_two_rows_hold_no_noise() -> None:
    t = np.linspace(0, 1, 100)
    for values in (np.full(100, 0.3), t, [1.0, 2.0]):
        assert noise_estimate(t[: len(values)], values, 2.0).std == 0.0


def test_the_scatter_from_row_to_row_is_told_where_rows_follow_the_signal_and_only_there() -> None:
    rng = np.random.default_rng(4)
    for t in (np.linspace(0, 1, 400), np.sort(rng.random(400))):
        found = [row_scatter(t, np.sin(6 * t) + 0.01 * rng.standard_normal(t.size)) for _ in range(40)]
        told = [f for f in found if f is not None]
        assert len(told) >= 39 and np.mean(told) == pytest.approx(0.01, rel=0.05)
    slow = np.linspace(0, 1, 60)
    assert row_scatter(slow, np.sin(6 * slow)) is None  # no noise at all
    assert row_scatter(slow, np.sin(90 * slow)) is None  # rows hardly follow it
    assert row_scatter(slow[:20], rng.standard_normal(20)) is None  # too few to tell
    walk = np.cumsum(rng.standard_normal(2000))
    assert row_scatter(np.linspace(0, 1, 2000), walk) is None  # no white noise


def test_what_moves_before_a_later_break_is_an_event_already() -> None:
    time = np.arange(200.0)
    ramp = np.where(time < 100, 0.001 * time, 1.0)
    sorted_runs = np.concatenate([np.geomspace(14.0, 850.0, 80), np.geomspace(20.0, 860.0, 120)])
    for course in (ramp, sorted_runs):
        assert event_time({"u": input_signal(time, course)}) == 0.0
    noisy_step = 1.0 + 1e-3 * np.random.default_rng(0).standard_normal(200) + 0.2 * (time >= 100)
    assert event_time({"u": input_signal(time, noisy_step)}) == 100.0
