"""Effects on recorded signals against scipy's linear simulation and plain formulas."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lsim

from hvdc_ident.discrepancy.signatures.block import block, parameter

T = np.linspace(0.0, 0.5, 1001)
U = np.interp(T, [0.0, 0.1, 0.15, 0.3, 0.5], [0.2, 0.2, 0.9, -0.4, -0.4])


def _run(effect: str, values: dict[str, list[float]], source: np.ndarray | None = None) -> np.ndarray:
    found = block(effect, tuple(values), source is not None)
    own = {parameter(n): np.array(v) for n, v in values.items()}
    count = len(next(iter(values.values())))
    brought = None if source is None else np.repeat(source[:, None], count, 1)
    return found.run(own, T, np.repeat(U[:, None], count, 1), brought)


# A lag shorter than a step is passed over in one: right at its ends, less so on the corner between.
@pytest.mark.parametrize(("time", "error"), [(2e-4, 3e-4), (5e-3, 2e-5), (0.1, 2e-5)])
def test_a_lag_is_what_lsim_gives(time: float, error: float) -> None:
    expected = lsim(([1.0], [time, 1.0]), U - U[0], T)[1] + U[0]
    assert _run("lag", {"T": [time]})[:, 0] == pytest.approx(expected, abs=error)


def test_a_second_order_is_what_lsim_gives() -> None:
    wn, zeta = 80.0, 0.3
    expected = lsim(([wn**2], [1.0, 2 * zeta * wn, wn**2]), U - U[0], T)[1] + U[0]
    assert _run("second-order", {"wn": [wn], "zeta": [zeta]})[:, 0] == pytest.approx(expected, abs=2e-5)


def test_columns_are_independent_of_each_other() -> None:
    both = _run("lag", {"T": [1e-3, 2e-2]})
    assert both[:, 0] == pytest.approx(_run("lag", {"T": [1e-3]})[:, 0], abs=1e-14)
    assert both[:, 1] == pytest.approx(_run("lag", {"T": [2e-2]})[:, 0], abs=1e-14)


def test_a_delay_is_the_signal_earlier() -> None:
    assert _run("delay", {"T": [0.02]})[:, 0] == pytest.approx(np.interp(T - 0.02, T, U), abs=1e-9)


def test_a_window_mean_is_the_mean_over_the_window() -> None:
    window, fine = 0.02, np.linspace(-0.02, 0.5, 52001)
    whole = np.concatenate([[0.0], np.cumsum(np.interp(fine, T, U)[1:]) * (fine[1] - fine[0])])
    expected = (np.interp(T, fine, whole) - np.interp(T - window, fine, whole)) / window
    assert _run("window-mean", {"T": [window]})[:, 0] == pytest.approx(expected, abs=2e-3)


def test_limits_deadbands_and_quantisers_are_their_formulas() -> None:
    assert _run("limit", {"level": [0.3]})[:, 0] == pytest.approx(np.clip(U, -0.3, 0.3), abs=1e-12)
    assert _run("deadband", {"width": [0.1]})[:, 0] == pytest.approx(U - np.clip(U, -0.1, 0.1), abs=1e-12)


def test_a_coupling_counts_from_the_start_of_the_other_signal() -> None:
    other = np.cos(20 * T)
    assert _run("coupling", {"k": [0.3]}, other)[:, 0] == pytest.approx(U + 0.3 * (other - other[0]), abs=1e-12)


def test_what_is_proportional_to_its_size_is_known() -> None:
    assert block("coupling", ("k",), True).linear((parameter("k"),))
    assert block("gain", ("k",), False).linear((parameter("k"),))
    assert not block("lag", ("T",), False).linear((parameter("T"),))
    assert not block("limit", ("level",), False).linear((parameter("level"),))
    assert not block("disturbance", ("amplitude", "frequency", "phase"), False).linear((parameter("frequency"),))
