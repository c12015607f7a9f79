"""The residual of a rounded record: against the probability itself, its limits, and what simulated rounding gives."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from hvdc_ident.fit.likelihood import QuantisedNoise

MISFITS = np.array([-3.0, -1.2, -0.5, -0.3, -0.01, 0.02, 0.4, 0.5, 0.9, 2.5])


def test_its_squares_are_the_deviance_of_an_interval() -> None:
    g, _ = QuantisedNoise(0.8, 0.3).residual(MISFITS)

    def chance(z: float) -> float:
        return quad(lambda e: norm.pdf(e, scale=0.3), z - 0.4, z + 0.4, epsabs=0.0, epsrel=1e-11)[0]

    expected = [-2.0 * np.log(chance(float(z)) / chance(0.0)) for z in MISFITS]
    np.testing.assert_allclose(g**2, expected, rtol=1e-6)
    assert (np.sign(g) == np.sign(MISFITS)).all()


def test_noise_far_above_the_step_hides_it() -> None:
    g, slope = QuantisedNoise(0.1, 2.0).residual(MISFITS)
    std = np.hypot(2.0, 0.1 / np.sqrt(12.0))
    np.testing.assert_allclose(g, MISFITS / std, rtol=1e-5)
    np.testing.assert_allclose(slope, 1.0 / std, rtol=1e-5)


def test_without_noise_everything_within_half_a_step_is_as_good() -> None:
    inside, slope = QuantisedNoise(1.0, 0.01).residual(np.array([-0.4, 0.0, 0.3, 0.42]))
    np.testing.assert_allclose(inside, 0.0, atol=1e-5)
    np.testing.assert_allclose(slope, 0.0, atol=1e-2)
    g, slope = QuantisedNoise(1.0, 0.01).residual(np.array([-40.5, 1.5, 3.5]))
    np.testing.assert_allclose(g, [-4000.0, 100.0, 300.0], rtol=1e-3)
    np.testing.assert_allclose(slope, 100.0, rtol=1e-3)


@pytest.mark.parametrize("noise", [0.03, 0.1, 0.25, 0.6, 1.0])
def test_the_slope_is_the_derivative(noise: float) -> None:
    r, h = QuantisedNoise(1.0, noise), 1e-5
    z = np.concatenate([MISFITS, [50.0, -2e4]])
    z = z[np.abs(r.residual(z)[0]) > 1e-3]  # below, differences of g have no digits
    numeric = (r.residual(z + h)[0] - r.residual(z - h)[0]) / (2.0 * h)
    np.testing.assert_allclose(r.residual(z)[1], numeric, rtol=1e-3)


def test_the_tangent_at_no_misfit_continues_the_curve() -> None:
    r = QuantisedNoise(1.0, 0.25)
    g, slope = r.residual(np.array([0.0, 1e-6, 2.4e-5, 2.6e-5, 1e-3]))
    assert g[0] == 0.0
    np.testing.assert_allclose(slope, slope[0], rtol=1e-4)
    np.testing.assert_allclose(g[1:], slope[0] * np.array([1e-6, 2.4e-5, 2.6e-5, 1e-3]), rtol=1e-4)


@pytest.mark.parametrize("noise", [0.1, 0.25, 0.5])
def test_squares_of_rounded_noise_have_the_mean_that_is_told(noise: float) -> None:
    random = np.random.default_rng(1)
    levels = np.linspace(0.0, 1.0, 400, endpoint=False)[:, None] * 0.7
    e = random.standard_normal((400, 2000)) * noise * 0.7
    g, slope = QuantisedNoise(0.7, noise * 0.7).residual(np.round((levels + e) / 0.7) * 0.7 - levels)
    assert np.mean(g**2) + QuantisedNoise(0.7, noise * 0.7).spare == pytest.approx(1.0, abs=0.01)
    # whatever the level: the likelihood's derivative has mean 0, though the residual's own mean has not
    score = (g * slope).mean(axis=1) * 0.7
    assert np.abs(score).max() < 5.0 * (g * slope * 0.7).std(axis=1).max() / np.sqrt(2000)


@pytest.mark.parametrize("noise", [0.05, 0.25, 1.0])
def test_far_off_it_goes_on_as_a_line_to_any_size(noise: float) -> None:
    r = QuantisedNoise(1.0, noise)
    edge = 0.5 + 1e3 * noise
    near = r.residual(edge * np.array([1.0 - 1e-6, 1.0 + 1e-6]))
    np.testing.assert_allclose(near[0][1] - near[0][0], 2e-6 * edge / noise, rtol=1e-3)
    np.testing.assert_allclose(near[1], 1.0 / noise, rtol=1e-4)
    g, slope = r.residual(np.array([-1e9, 1e155, -1e300]) * noise)
    np.testing.assert_allclose(g, [-1e9, 1e155, -1e300], rtol=1e-8 / noise)
    np.testing.assert_allclose(slope, 1.0 / noise, rtol=1e-8)
