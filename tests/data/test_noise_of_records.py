"""The noise that a record shows by itself: known processes come back, as well known as is said."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom, chi2, t

from hvdc_ident.data import noise_estimate, quiet_rows, without_line
from hvdc_ident.data.level_steps import without_steps
from hvdc_ident.data.noise import ESTIMATED, ROUNDED, SCATTER, FirstOrder
from hvdc_ident.data.rounding import resolution
from hvdc_ident.data.trajectory import Array

AFTER = 120


def record(rows: int, seed: int, rho: float = 0.0, spikes: int = 0, step: float = 0.0) -> tuple[Array, Array, float]:
    """Noise of variance 1 on a level, and an answer after an event; with spikes of 20, or rounded. Times, values, event."""
    random = np.random.default_rng([rows, seed])
    count = rows + AFTER
    noise = lfilter([np.sqrt(1.0 - rho**2)], [1.0, -rho], random.standard_normal(count + 300))[300:]
    noise[random.choice(rows, spikes, replace=False)] += 20.0 * random.choice([-1.0, 1.0], spikes)
    time = np.arange(count) * 0.01
    answer = np.where(np.arange(count) >= rows, 30.0 * (1.0 - np.exp(-(np.arange(count) - rows) / 40.0)), 0.0)
    values = random.uniform(-5.0, 5.0) + noise + answer
    return time, np.round(values / step) * step if step else values, rows * 0.01


@pytest.mark.parametrize(
    ("rows", "process"),
    [
        (8, {}),
        (20, {}),
        (250, {}),
        (20, {"rho": 0.6}),
        (50, {"rho": 0.9}),
        (250, {"rho": 0.9}),
        (20, {"spikes": 1}),
        (250, {"spikes": 10}),
        (50, {"step": 1.0}),
        (50, {"step": 3.0}),
    ],
)
def test_the_standard_deviation_is_known_as_well_as_its_degrees_of_freedom_say(rows: int, process: dict) -> None:
    """The interval of a chi-square with so many degrees of freedom holds the true variance in 19 of 20 records."""
    count, hits, logs = 25, 0, []
    true = np.sqrt(1.0 + process.get("step", 0.0) ** 2 / 12.0)
    for seed in range(count):
        found = noise_estimate(*record(rows, seed, **process))
        low, high = chi2.ppf([0.025, 0.975], found.freedom)
        hits += low <= found.freedom * (found.std / true) ** 2 <= high
        logs.append(np.log(found.std / true))
    assert hits >= binom.ppf(1e-3, count, 0.95)
    assert abs(np.median(logs)) < 0.05 + 2.0 * np.std(logs) / np.sqrt(count)


def test_the_source_says_which_rows_tell_of_the_noise() -> None:
    assert noise_estimate(*record(50, 1)).source == ESTIMATED
    assert noise_estimate(*record(50, 1, step=3.0)).source == ROUNDED
    time, values, _ = record(50, 1)
    assert noise_estimate(time, values, None).source == SCATTER
    still = noise_estimate(time, np.where(time < 0.5, 1.0, 1.0 + time), 0.5)
    assert (still.std, still.source) == (0.0, ESTIMATED)
    swing = np.exp(-time) * np.cos(20.0 * time)
    assert noise_estimate(time, swing, 0.5).std == 0.0 and noise_estimate(time, swing, 0.5).source == SCATTER
    random = np.random.default_rng(0)
    walk = np.exp(-time) + 0.01 * np.cumsum(np.cumsum(random.standard_normal(time.size)))
    assert noise_estimate(time, walk, 0.5).source == ""


def test_the_limit_of_outliers_is_what_normal_noise_exceeds_in_one_record_of_a_hundred() -> None:
    for rows, rho in ((8, 0.0), (20, 0.0), (60, 0.9)):
        lost = sum(
            not without_line(np.arange(float(rows)), record(rows, seed, rho)[1][:rows])[1].all() for seed in range(250)
        )
        assert lost <= binom.ppf(0.9999, 250, 0.015)


def test_rows_of_different_noise_are_compared_each_with_its_own() -> None:
    """A record whose noise is stated row by row: a tenth of it before the event, as instruments of a percentage have it."""
    time, values, event = record(200, 3)
    profile = np.where(time < event - 1e-9, 0.1, 1.0)
    rows = quiet_rows(time, values * profile, event, profile=profile)
    assert rows.rows.size >= 195
    assert np.std(rows.values) == pytest.approx(1.0, rel=0.15)


def test_rows_on_the_event_and_those_not_recorded_are_no_quiet_rows() -> None:
    time, values, event = record(60, 5)
    values[10:20] = np.nan
    rows = quiet_rows(time, values, event).rows
    assert rows.size == 50 and rows.max() == 59
    assert not quiet_rows(time, values, None).rows.size
    assert not quiet_rows(time, values, time[7]).rows.size


def test_the_level_of_white_noise_that_cannot_be_correlated_is_that_of_students_t() -> None:
    """Of many rows the weights of correlated noise vanish, and the standard deviation is the plain one of the rows less a line."""
    random = np.random.default_rng(2)
    rows = random.standard_normal(2000)
    rows -= np.polyval(np.polyfit(np.arange(2000.0), rows, 1), np.arange(2000.0))
    std, freedom = FirstOrder.of(np.split(rows, 4)).level
    assert std == pytest.approx(np.std(rows, ddof=2), rel=3e-3)
    assert t.ppf(0.975, freedom) == pytest.approx(t.ppf(0.975, 1992), rel=1e-3)


def test_the_resolution_is_that_of_the_rounding() -> None:
    random = np.random.default_rng(1)
    values = np.round(random.standard_normal(100) / 0.25) * 0.25
    values[3] = np.nan
    assert resolution(values) == pytest.approx(0.25, rel=1e-12)
    assert resolution(random.standard_normal(100)) == 0.0


@pytest.mark.parametrize("digits", [1e-1, 1e-2, 1e-3])
def test_a_recorders_step_is_seen_through_the_digits_of_its_file(digits: float) -> None:
    """A step of 0.1831 with two decimals makes levels 0.18 and 0.19 apart; both round, so that their errors add up."""
    step = 750.0 / 4096.0
    values = np.round((200.0 + 4.0 * np.random.default_rng(2).standard_normal(400)) / step) * step
    assert resolution(np.round(values / digits) * digits) == pytest.approx(np.hypot(step, digits), rel=1e-2)
    assert resolution(values.astype(np.float32).astype(float)) == pytest.approx(step, rel=1e-2)


@pytest.mark.parametrize("noise", [0.3, 0.6, 1.2])
def test_rounded_rows_show_their_noise_though_most_lie_on_one_level(noise: float) -> None:
    step, found = 750.0 / 4096.0, []
    for seed in range(20):
        time, values, event = record(50, seed)
        seen = np.round(np.round(200.0 / step + noise * values) * step, 2)
        found.append(noise_estimate(time, seen, event).std)
    assert min(found) > 0.0
    assert np.median(found) == pytest.approx(np.hypot(step, 0.01) * np.hypot(noise, 1.0 / np.sqrt(12.0)), rel=0.12)


def test_a_step_of_the_level_is_no_noise() -> None:
    for rho, rows in ((0.0, 60), (0.6, 200)):
        stepped, plain = [], []
        for seed in range(10):
            time, values, event = record(rows, seed, rho)
            plain.append(noise_estimate(time, values, event).std)
            stepped.append(noise_estimate(time, values + 8.0 * (time > 0.4 * event), event).std)
        assert np.median(np.array(stepped) / np.array(plain)) == pytest.approx(1.0, abs=0.05)


def test_noise_is_seldom_taken_for_steps_of_the_level() -> None:
    for rho in (0.0, 0.6, 0.9):
        seen = 0
        for seed in range(60):
            rows = without_line(np.arange(60.0), record(60, seed, rho)[1][:60])[0]
            seen += not np.array_equal(without_steps(rows), rows)
        assert seen <= binom.ppf(0.999, 60, 0.03)


def test_a_value_that_differs_by_the_rounding_of_floats_alone_has_no_step() -> None:
    values = 200.0 + np.spacing(200.0) * (np.arange(60) % 3)
    assert resolution(values) == 0.0


def test_levels_far_apart_but_for_two_have_no_step_and_take_no_memory() -> None:
    """Two levels that are a millionth of the others' distance apart would ask for millions of steps to be tried."""
    values = np.random.default_rng(5).standard_normal(40)
    values[7] = values[3] + 1e-6
    tracemalloc.start()
    assert resolution(values) == 0.0
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10e6


def test_a_step_is_seen_beside_a_level_far_off() -> None:
    random = np.random.default_rng(6)
    step = 750.0 / 4096.0
    values = np.round((200.0 + 2.0 * random.standard_normal(300)) / step) * step
    values[100:104] = np.round(-6e3 / step) * step
    assert resolution(np.round(values, 2)) == pytest.approx(np.hypot(step, 0.01), rel=1e-2)
