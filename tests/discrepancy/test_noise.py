"""The noise of records: known processes come back, and what is no noise is left out."""

from __future__ import annotations

import numpy as np
import pytest
from cases import SIGMA, TIME, experiments

from hvdc_ident.discrepancy.record_noise import noise_of, without_tone


def test_white_noise_stands_as_given() -> None:
    found = noise_of(experiments())
    assert found["w"].std == SIGMA["w"]
    assert found["w"].source == "given"


def test_coloured_noise_is_told_from_before_the_event() -> None:
    rho = [
        n.model[0]
        for seed in range(6)
        for n in noise_of(experiments(noise="ar", seed=seed)).values()
        if len(n.model) == 1
    ]
    assert np.mean(rho) == pytest.approx(0.9, abs=0.06)


def test_noise_that_is_larger_than_given_is_seen() -> None:
    louder = [e.with_(noise={n: s / 3 for n, s in SIGMA.items()}) for e in experiments()]
    found = noise_of(louder)["torque"]
    assert found.std == pytest.approx(SIGMA["torque"], rel=0.2)
    assert "noisier" in found.source


def test_noise_below_a_quantiser_is_read_from_its_flicker() -> None:
    found = noise_of(experiments(noise="quantised"))["w"]
    step = SIGMA["w"] * np.sqrt(12.0)
    assert found.step == pytest.approx(step, rel=1e-6)
    assert found.std == pytest.approx(step * np.sqrt(1 / 12 + 0.25**2), rel=0.2)


def test_a_sine_of_common_phase_is_no_noise_and_noise_is_no_sine() -> None:
    random = np.random.default_rng(3)
    times = [TIME[:60]] * 3
    noise = [random.standard_normal(60) for _ in times]
    tone = 3.0 * np.sin(2 * np.pi * 17.0 * TIME[:60] + 0.4)
    left = without_tone(times, [n + tone for n in noise])
    assert np.std(np.concatenate(left)) == pytest.approx(1.0, abs=0.15)
    assert all(np.array_equal(a, b) for a, b in zip(without_tone(times, noise), noise, strict=True))
