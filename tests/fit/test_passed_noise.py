"""Noise that recorded inputs pass on to the outputs: its covariance by single rows, and what a fit makes of it by Monte Carlo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lsim
from scipy.stats import binom, chi2

import hvdc_ident as hi
from hvdc_ident.data import InputNoise, before_event, input_noise, input_signal, trajectory
from hvdc_ident.discrepancy.nominal import draws
from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.fit.noise import noise_of
from hvdc_ident.fit.passed_noise import off_the_line
from hvdc_ident.fit.residual import passed_draws
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import parse_card
from hvdc_ident.simulate import ModelSimulator

CARD = """
schema = 1
name = "regulator"
[parameters]
K = {value = 20.0}
T = {value = 1.5, unit = "s"}
D = {value = 2.0}
[inputs]
v = {value = 1.0}
y0 = {value = 3.0}
[states.x]
derivative = "(K*(r - v) - x)/T"
[states.r]
derivative = "0"
rest = "r + y0 - y"
guess = 1.0
[signals]
y = {value = "x - D*v"}
[outputs]
y = "y"
z = "2*x + 3*v"
"""
K, T, D = 20.0, 1.5, 2.0
TIME = np.arange(0.0, 6.0, 0.05)
EVENT = 1.0
NOISE = {"v": 2e-3}


def simulator() -> ModelSimulator:
    return ModelSimulator(parse_card(CARD))


def voltage(t: np.ndarray) -> np.ndarray:
    return 1.0 - 0.1 * np.interp(t, [1.0, 1.2, 3.0, 3.3], [0.0, 1.0, 1.0, 0.4])


def of_rows(rows: np.ndarray, interpolation: str = "linear", time: np.ndarray = TIME, **more) -> hi.Experiment:
    """The experiment as a study makes it of the recorded rows of v: the first row is the mean before the event."""
    signal = input_signal(time, rows, interpolation)
    level = rows[before_event(time, rows, EVENT)].mean()
    known = {n: InputNoise(s, s) for n, s in NOISE.items()}
    return hi.Experiment(
        time, inputs={"v": signal.begun_at(level)}, event=EVENT, **{"input_noise": known, "levels": ("y",), **more}
    )


def recorded(rows: np.ndarray, outputs: dict[str, np.ndarray], noise: dict[str, float], **more) -> hi.Experiment:
    return of_rows(rows, measured=trajectory(TIME, outputs), noise=noise, **more)


@pytest.mark.parametrize("interpolation", ["linear", "hold"])
@pytest.mark.parametrize(("gaps", "late"), [(False, 0.0), (True, 0.0), (False, 0.02)])
def test_the_answers_are_those_to_single_rows(interpolation, gaps, late):
    """The model is linear: a row that is off moves the outputs by what a run with that row off says, the start included; at instants
    between the rows, too, where the outputs have a clock of their own."""
    time = np.delete(TIME, [7, 40, 41, 90]) if gaps else TIME
    at = np.concatenate([time[:1], time[1:] - late, time[-1:]]) if late else time
    rng = np.random.default_rng(1)
    rows = voltage(time) + 1e-3 * rng.standard_normal(time.size)
    e = of_rows(rows, interpolation, time, measured=trajectory(time, {"y": 0 * time, "z": 0 * time}))
    problem = Problem(simulator(), (e,), (FitParameter("K", K, 5.0, 80.0),))
    blank = {"time": at, "measured": None}
    plain = hi.simulate(simulator().model, e.with_(**blank), rtol=1e-10)
    for output in ("y", "z"):
        answers = problem.passed["experiment"].answers(output, at)
        size = np.abs(answers).max()
        for k in (0, 3, 19, 20, 45, time.size - 1):
            off = rows.copy()
            off[k] += NOISE["v"]
            run = hi.simulate(simulator().model, of_rows(off, interpolation, time).with_(**blank), rtol=1e-10)
            assert answers[:, k] == pytest.approx(run[output] - plain[output], abs=2e-3 * size), k


def test_rounded_rows_before_an_event_have_their_error_in_common():
    """A still level in steps of 0.01 is off by up to half a step, and no number of rows tells how much."""
    step, rng = 0.01, np.random.default_rng(0)
    moving = voltage(TIME) + 0.3 * np.sin(3.0 * (TIME - EVENT)) * (TIME > EVENT)
    rows = np.round((moving + 1e-4 * rng.standard_normal(TIME.size)) / step) * step
    found = input_noise(TIME, rows, EVENT)
    assert found.common == pytest.approx(step / np.sqrt(12.0), rel=1e-6)
    assert found.before < 0.5 * step and found.std == pytest.approx(np.hypot(found.common, found.before))
    e = of_rows(rows, measured=trajectory(TIME, {"y": 0 * TIME}), input_noise={"v": found})
    passed = Problem(simulator(), (e,), (FitParameter("K", K, 5.0, 80.0),)).passed["experiment"]
    common = passed.answers("y", TIME)[:, -1]
    lower = of_rows(rows - found.common * (TIME >= EVENT))
    moved = (
        hi.simulate(simulator().model, lower, rtol=1e-10)["y"]
        - hi.simulate(simulator().model, of_rows(rows), rtol=1e-10)["y"]
    )
    assert common == pytest.approx(moved, abs=2e-3 * np.abs(moved).max())


def measured(rng: np.random.Generator, own: float) -> hi.Experiment:
    """A record of the plant: it answers the true voltage, by scipy's equations; the recorder adds its noise to v and to y."""
    fine = 20
    t = np.linspace(0.0, TIME[-1], (TIME.size - 1) * fine + 1)
    v = voltage(t)
    reference = v[0] + (3.0 + D * v[0]) / K
    error = K * (reference - v)
    x = lsim(([[-1.0 / T]], [[1.0 / T]], [[1.0]], [[0.0]]), error, t, X0=error[:1])[1]
    y = (x - D * v)[::fine] + own * rng.standard_normal(TIME.size)
    return recorded(voltage(TIME) + NOISE["v"] * rng.standard_normal(TIME.size), {"y": y}, {"y": own}, values=level(y))


def level(y: np.ndarray) -> dict[str, float]:
    return {"y0": float(y[before_event(TIME, y, EVENT)].mean())}


def test_intervals_hold_the_truth_and_residuals_are_white_where_inputs_are_noisy():
    """Of 120 records: the interval of each parameter holds its value 19 times in 20, and chi2 is that of white noise. It is not where
    the noise of v is not counted."""
    fits, own = 120, 5e-3
    free = (FitParameter("K", 25.0, 5.0, 80.0), FitParameter("T", 1.2, 0.2, 9.0))
    hits, total, blind, rows = {"K": 0, "T": 0}, 0.0, 0.0, fits * (TIME.size - 3)
    records = [measured(np.random.default_rng(seed), own) for seed in range(fits)]
    truth = tuple(replace(f, start=v) for f, v in zip(free, (K, T), strict=True))
    passed = Problem(simulator(), records[:1], truth).passed
    for e in records:
        found = fit(Problem(simulator(), (e,), free, passed=passed), starts=1, assess=False)
        for name, value in (("K", K), ("T", T)):
            low, high = found.estimates[name].ci95
            hits[name] += low <= value <= high
        total += 2.0 * found.cost
        blind += 2.0 * fit(Problem(simulator(), (e.with_(input_noise={}),), free), starts=1, assess=False).cost
    low, high = binom.ppf([0.001, 0.9995], fits, 0.95)
    assert all(low <= n <= high for n in hits.values()), hits
    assert chi2.ppf(0.001, rows) < total < chi2.ppf(0.999, rows)
    assert blind > 2.0 * rows


def test_draws_of_noise_are_white_once_whitened():
    e = measured(np.random.default_rng(3), 5e-3)
    problem = Problem(simulator(), (e,), (FitParameter("K", K, 5.0, 80.0),))
    blocks = problem.blocks(problem.start)
    added = passed_draws(blocks, [TIME], problem.treatment, 4000, np.random.default_rng(0))
    assert added.std() > 2.0  # of the noise of y itself
    own = {"y": replace(noise_of([e])["y"], std=5e-3, freedom=0, model=(), step=0.0)}
    (drawn,) = draws(problem, blocks, own, [np.zeros(TIME.size)], 4000, 0)
    covariance = drawn @ drawn.T / 4000.0
    assert np.abs(covariance - np.eye(TIME.size)).max() < 6.0 / np.sqrt(4000.0)


def jumping(rng: np.random.Generator, own: float) -> hi.Experiment:
    """A record of the plant whose voltage falls and comes back at once, at instants of which the rows do not know."""
    fine = 50
    t = np.linspace(0.0, TIME[-1], (TIME.size - 1) * fine + 1)
    fall, back = EVENT + TIME[1] * rng.uniform(0.0, 1.0), 3.0 + TIME[1] * rng.uniform(0.0, 1.0)
    v = 1.0 - 0.1 * ((t >= fall) & (t < back))
    error = K * (v[0] + (3.0 + D * v[0]) / K - v)
    x = lsim(([[-1.0 / T]], [[1.0 / T]], [[1.0]], [[0.0]]), error, t, X0=error[:1], interp=False)[1]
    y = (x - D * v)[::fine] + own * rng.standard_normal(TIME.size)
    rows = v[::fine] + NOISE["v"] * rng.standard_normal(TIME.size)
    return recorded(rows, {"y": y}, {"y": own}, values=level(y))


def test_what_lies_between_the_rows_of_a_jump_is_noise_of_the_input():
    """Of 60 records whose voltage jumps between rows: with what the rows leave open the residual is that of noise, or less, and the
    intervals hold the truth; taken for certain, the lines leave more than noise at the truth itself."""
    count, own = 60, 2e-3
    free = (FitParameter("K", 25.0, 5.0, 80.0), FitParameter("T", 1.2, 0.2, 9.0))
    hits, total, certain, rows = {"K": 0, "T": 0}, 0.0, 0.0, count * TIME.size
    for seed in range(count):
        e = jumping(np.random.default_rng(seed), own)
        found = fit(Problem(simulator(), (e,), free), starts=1, assess=False)
        for name, value in (("K", K), ("T", T)):
            low, high = found.estimates[name].ci95
            hits[name] += low <= value <= high
        total += 2.0 * found.cost
        problem = Problem(simulator(), (e,), free)
        passed = problem.passed["experiment"]
        certain_rows = replace(passed, between=np.zeros_like(passed.between))
        lines = replace(problem, passed=FrozenMap({"experiment": certain_rows}))
        certain += 2.0 * lines.cost(np.array([K, T]))
    low = binom.ppf(0.001, count, 0.95)
    assert all(n >= low for n in hits.values()), hits
    assert total < chi2.ppf(0.999, rows)
    assert certain > chi2.ppf(1.0 - 1e-9, rows)


def test_only_bends_beyond_the_noise_leave_something_open_between_rows():
    rng, time = np.random.default_rng(7), np.arange(0.0, 20.0, 0.02)
    still = off_the_line(time, 1.0 + 1e-3 * rng.standard_normal(time.size), 1e-3)
    assert np.count_nonzero(still) == 0
    ramp = off_the_line(time, 0.3 * time, 0.0)
    assert ramp == pytest.approx(0.0, abs=1e-12)


def test_the_mean_between_two_rows_is_off_the_line_by_the_rule_of_a_jump_at_any_instant():
    """By sampling the instant of a jump by 1: the standard deviation of its mean less that of the line is 1/sqrt(12)."""
    time = np.arange(0.0, 1.0, 0.1)
    found = off_the_line(time, (time > 0.45).astype(float), 0.0)
    place = (np.arange(10_000) + 0.5) / 10_000
    assert found[4] == pytest.approx(np.std((1.0 - place) - 0.5) * 1.0, rel=1e-6)
    assert found[[3, 5]] == pytest.approx(found[4] / np.sqrt(2.0))
    assert found[[0, 1, 2, 6, 7, 8]] == pytest.approx(0.0)
