"""Norms, reduction and stability between inputs and outputs where time constants lie many decades apart, against closed forms."""

from itertools import permutations

import numpy as np
import pytest

from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize import balanced, h2_norm, hinf_norm
from hvdc_ident.linearize.reduction import minimal
from hvdc_ident.linearize.transfer_function import transfer_function
from tests.linearize.helpers import linear

RATES = [(1e-6, 1e6), (1e-3, 1e9), (1.0, 1e12), (1e-6, 1e12), (1e-9, 1e-3), (1e6, 1e12)]


def cascade(rates, order=None, gain=1.0):
    """gain / ((s + r1)(s + r2)...), each lag driven by the one after it, the states in the order given; y is the first."""
    n = len(rates)
    a = np.diag(-np.array(rates, dtype=float)) + np.diag(np.ones(n - 1), 1)
    b, c = np.zeros((n, 1)), np.zeros((1, n))
    b[-1], c[0, 0] = gain, 1.0
    order = list(range(n)) if order is None else list(order)
    return a[np.ix_(order, order)], b[order], c[:, order]


@pytest.mark.parametrize("gain", [1.0, 1e-8, 1e12])
@pytest.mark.parametrize("rates", RATES)
def test_the_h2_norm_of_two_lags(rates, gain):
    """k/((s + p)(s + q)): k/sqrt(2 p q (p + q)), whichever lag comes first."""
    p, q = rates
    for order in permutations(range(2)):
        for r in (rates, rates[::-1]):
            found = h2_norm(linear(*cascade(r, order, gain)))
            assert found == pytest.approx(gain * (2 * p * q * (p + q)) ** -0.5, rel=1e-9)


@pytest.mark.parametrize("rates", [(1e-6, 1.0, 1e6), (1e-4, 1e2, 1e9), (1.0, 1e6, 1e12), (1e-9, 2e-9, 1e9)])
def test_the_h2_norm_of_three_lags(rates):
    """1/((s + p)(s + q)(s + r)): sqrt((p + q + r)/(2 p q r (p + q)(q + r)(r + p)))."""
    p, q, r = rates
    square = (p + q + r) / (2 * p * q * r * (p + q) * (q + r) * (r + p))
    for order in permutations(range(3)):
        for lags in permutations(rates):
            assert h2_norm(linear(*cascade(lags, order))) == pytest.approx(np.sqrt(square), rel=1e-8), (order, lags)


@pytest.mark.parametrize("damping", [1e-6, 1e-3, 0.5, 30.0])
@pytest.mark.parametrize("speed", [1e-4, 1.0, 1e8])
def test_the_h2_norm_of_an_oscillator(speed, damping):
    """w^2/(s^2 + 2 z w s + w^2): sqrt(w/(4 z))."""
    model = linear([[0, 1], [-(speed**2), -2 * damping * speed]], [[0], [1]], [[speed**2, 0]])
    assert h2_norm(model) == pytest.approx(np.sqrt(speed / (4 * damping)), rel=1e-6)


@pytest.mark.parametrize("turned", range(40))
def test_an_h2_norm_in_mixed_states_is_right_or_refused(turned):
    """Orthogonal states of lags a decade to 16 decades apart: rounding takes the slow rate, and that is said."""
    rng = np.random.default_rng(turned)
    fast = 10.0 ** rng.uniform(1, 16)
    a, b, c = cascade((1.0, fast))
    q = np.linalg.qr(rng.normal(size=(2, 2)))[0]
    exact = (2 * fast * (1 + fast)) ** -0.5
    try:
        found = h2_norm(linear(q @ a @ q.T, q @ b, c @ q.T))
    except LinearizationError as e:
        assert "rounding" in str(e) or "not stable" in str(e)
        assert fast > 1e6  # below, both Gramians agree to 1e-4
    else:
        assert found == pytest.approx(exact, rel=1e-2)


@pytest.mark.parametrize("rates", RATES)
def test_a_slow_mode_behind_a_fast_one_is_neither_hidden_nor_stable_where_it_grows(rates):
    slow, fast = min(rates), max(rates)
    growing = linear(*cascade((-slow, fast)))
    for norm in (h2_norm, hinf_norm):
        with pytest.raises(LinearizationError, match=r"not stable|unstable"):
            norm(growing)
    assert minimal(growing).removed == () == minimal(linear(*cascade((slow, fast)))).removed
    decaying = linear(*cascade((slow, fast)))
    assert hinf_norm(decaying).value == pytest.approx(1.0 / (slow * fast), rel=1e-9)
    assert transfer_function(decaying).dc_gain == pytest.approx(1.0 / (slow * fast), rel=1e-9)
    reduced = balanced(decaying, 1)
    assert reduced.model.poles()[0].real == pytest.approx(-slow, rel=10 * slow / fast + 1e-9)


def test_an_input_in_a_large_unit_is_one():
    """Two lags side by side, the second with an input of 1e12 of its unit: both norms are those of the larger."""
    model = linear([[-1, 0], [0, -2]], [[1, 0], [0, 1e-12]], [[1, 0], [0, 1e12]])
    assert h2_norm(model) == pytest.approx(np.sqrt(1 / 2 + 1 / 4), rel=1e-12)
    assert minimal(model).removed == ()


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e3])
def test_a_mode_that_cancels_but_for_rounding_is_hidden(unit):
    """An integrator of (0.1 + 0.2 - 0.3) x is reached by no more than rounding, in any unit: the norm is that of the lag."""
    left = (0.1 + 0.2 - 0.3) * unit
    assert left != 0.0
    model = linear([[-1, 0, 0], [left, 0, 0.5 * unit], [0, 0, -3]], [[1], [0], [0]], [[1, 1 / unit, 0]])
    assert h2_norm(model) == pytest.approx(np.sqrt(0.5), rel=1e-9)
    assert h2_norm(linear([[-1, 0], [0, 1.0]], [[1], [0]], [[1, 1]])) == pytest.approx(np.sqrt(0.5), rel=1e-12)
