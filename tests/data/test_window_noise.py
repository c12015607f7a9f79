"""The window of a recorder, told by noise that scipy filters make."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from hvdc_ident.data import Array
from hvdc_ident.data.window_noise import window_rows

Noise = Callable[[np.random.Generator, int], Array]


def filtered(b: Array, a: Array) -> Noise:
    return lambda random, n: np.asarray(lfilter(b, a, random.standard_normal(n + 400))[400:])


def mean_over(rows: int) -> Noise:
    return filtered(np.ones(rows) / rows, np.ones(1))


def told(noise: Noise, rows: int, records: int = 20) -> list[int | None]:
    time, random = np.arange(rows + 40) * 0.01, np.random.default_rng(3)
    return [window_rows(time, noise(random, rows + 40), rows * 0.01) for _ in range(records)]


@pytest.mark.parametrize("rows", [2, 4, 9])
def test_the_length_of_a_window_is_told_by_its_noise(rows: int) -> None:
    found = told(mean_over(rows), 400)
    assert found.count(rows) >= 18 and set(found) <= {rows, None}


@pytest.mark.parametrize(
    "noise",
    [
        pytest.param(lambda random, n: random.standard_normal(n), id="white"),
        pytest.param(filtered(np.ones(1), np.array([1.0, -0.6])), id="first order"),
        pytest.param(filtered(np.ones(1), np.array([1.0, -0.95])), id="slow first order"),
        pytest.param(filtered(*butter(2, 0.2)), id="second order"),
        pytest.param(filtered(np.array([1.0, 2.0, 3.0, 4.0, 3.0, 2.0, 1.0]), np.ones(1)), id="triangle"),
    ],
)
def test_other_noise_is_no_windows(noise: Noise) -> None:
    assert set(told(noise, 200)) == {None}


def test_a_record_without_rows_at_rest_tells_no_window() -> None:
    assert window_rows(np.arange(100.0), np.ones(100), 80.0) is None
    assert window_rows(np.arange(100.0), mean_over(3)(np.random.default_rng(1), 100), None) is None
