"""The recorded angle of a voltage beside its recorded frequency: the derivative of one is the other."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident.data import Array
from hvdc_ident.data.turning import agreement

TIME = np.arange(0.0, 20.0, 0.02)


def record(swing: float, seed: int = 1) -> tuple[Array, Array]:
    """Angle in rad and frequency in Hz of a swing of 0.5 Hz with some amplitude in Hz, with the noise of a PMU."""
    random = np.random.default_rng(seed)
    since = np.clip(TIME - 2.0, 0.0, None)
    angle = 2.0 * np.pi * swing * (1.0 - np.cos(np.pi * since)) / np.pi
    frequency = 50.0 + swing * np.sin(np.pi * since)
    return angle + 3e-4 * random.standard_normal(TIME.size), frequency + 1e-3 * random.standard_normal(TIME.size)


@pytest.mark.parametrize("swing", [0.0, 0.001, 0.01, 0.1, 1.0])
def test_an_angle_and_its_frequency_agree(swing: float) -> None:
    assert all(agreement(TIME, *record(swing, seed), 50.0).holds for seed in range(10))


@pytest.mark.parametrize("swing", [0.0, 0.01, 0.1])
def test_an_angle_whose_clock_drifts_disagrees(swing: float) -> None:
    angle, frequency = record(swing)
    assert not agreement(TIME, angle + 1.5 * np.clip(TIME - 3.0, 0.0, None), frequency, 50.0).holds


def test_a_frequency_of_another_plant_disagrees_with_an_angle_that_stands_still() -> None:
    assert not agreement(TIME, record(0.0)[0], record(0.1)[1], 50.0).holds


def test_a_frequency_that_never_changes_has_unknown_digits_and_says_nothing() -> None:
    assert agreement(TIME, record(0.02)[0], np.full(TIME.size, 50.0), 50.0).holds
