"""Noise of played inputs that a model follows: by Monte Carlo, and by the answers to single rows."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.fit.followed_noise import DRAWS, followed_noise, follows_noise, unbiased
from hvdc_ident.fit.residual import passed_draws
from tests.fit.test_passed_noise import TIME, D, K, measured, simulator

OWN = 2e-4
"""Noise of the outputs' own: far less than what the model passes on."""


def problem(seed: int) -> Problem:
    return Problem(simulator(), (measured(np.random.default_rng(seed), OWN),), (FitParameter("D", D, 0.5, 8.0),))


def sums(of: Problem, value: float) -> tuple[float, float]:
    """The sum of squared residuals, and that of the noise that is followed."""
    theta = np.array([value])
    return sum(b.chi2 for b in of.blocks(theta, derivatives=False)), followed_noise(of, theta)


def lowest(values: list[float], costs: list[float]) -> float:
    """Where the parabola through three points is lowest."""
    a, b, _ = np.polyfit(values, costs, 2)
    return float(-b / (2.0 * a))


def test_less_the_noise_that_is_followed_the_sum_of_squares_is_least_at_the_truth() -> None:
    """The outputs are driven by a voltage without noise, and the model by the recorded one: a gain is estimated too small."""
    values = [0.9 * D, D, 1.1 * D]
    plain, corrected = [], []
    for seed in range(40):
        of = problem(seed)
        each = [sums(of, v) for v in values]
        plain.append(lowest(values, [squares for squares, _ in each]))
        corrected.append(lowest(values, [squares - followed for squares, followed in each]))
    error = np.std(corrected) / np.sqrt(len(corrected))
    assert np.mean(corrected) == pytest.approx(D, abs=3.0 * error)
    assert np.mean(plain) < D - 6.0 * np.std(plain) / np.sqrt(len(plain))


def test_one_step_takes_the_bias_off_an_estimate() -> None:
    """Of forty records: the mean of the estimates is off by many standard errors before, and by chance after."""
    before, after = [], []
    for seed in range(40):
        of = problem(seed)
        found = fit(of, starts=1, assess=False)
        theta = np.array([found.estimates["D"].value])
        before.append(float(theta[0]))
        after.append(float(unbiased(of, theta)[0]))
    error = np.std(after) / np.sqrt(len(after))
    assert np.mean(after) == pytest.approx(D, abs=3.0 * error)
    assert np.mean(before) < D - 6.0 * np.std(before) / np.sqrt(len(before))


def test_what_is_followed_is_what_draws_of_the_noise_make_of_the_residuals() -> None:
    """Two ways: runs with noisier inputs, and the model's answers to steps."""
    of = problem(0)
    blocks = of.blocks(np.array([D]), derivatives=False)
    made = passed_draws(blocks, [TIME[b.rows] for b in blocks], of.treatment, 400, np.random.default_rng(1))
    white = of.residuals(np.column_stack([np.zeros(made.shape[0]), made])) - of.residuals(np.zeros((made.shape[0], 1)))
    expected = np.sum(white**2) / 400
    assert followed_noise(of, np.array([D])) == pytest.approx(expected, rel=3.0 * np.sqrt(2.0 / (DRAWS * expected)))


def test_inputs_without_noise_are_not_followed() -> None:
    e = measured(np.random.default_rng(0), OWN).with_(input_noise={})
    of = Problem(simulator(), (e,), (FitParameter("K", K, 5.0, 80.0),))
    assert not follows_noise(of) and followed_noise(of, np.array([K])) == 0.0
