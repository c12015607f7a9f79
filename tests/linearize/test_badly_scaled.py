"""Zeros, norms and reduction of badly scaled systems, against the same systems well scaled and by other means."""

import numpy as np
import pytest
import scipy.linalg
from scipy.optimize import linear_sum_assignment, minimize_scalar

from hvdc_ident.linearize import balanced, h2_norm, linf_norm
from hvdc_ident.linearize.zeros import zeros
from tests.linearize.helpers import linear


def random_system(seed):
    """Return matrices with poles over four decades in orthogonal states, and the same with states in units of 1e-4 to 1e4."""
    rng = np.random.default_rng(seed)
    n, inputs = int(rng.integers(2, 31)), int(rng.integers(1, 4))
    outputs = inputs if seed % 2 == 0 else int(rng.integers(1, 4))
    blocks = []
    while sum(len(b) for b in blocks) < n:
        size, damping = 10 ** rng.uniform(-1, 3), rng.uniform(0.02, 1)
        turning = size * np.sqrt(1 - damping**2)
        pair = np.array([[-damping * size, turning], [-turning, -damping * size]])
        blocks.append(pair if rng.random() < 0.6 and sum(map(len, blocks)) + 2 <= n else np.array([[-size]]))
    q = np.linalg.qr(rng.normal(size=(n, n)))[0]
    a = q @ scipy.linalg.block_diag(*blocks) @ q.T
    b, c = rng.normal(size=(n, inputs)), rng.normal(size=(outputs, n))
    d = rng.normal(size=(outputs, inputs)) if seed % 3 == 0 else np.zeros((outputs, inputs))
    unit = 10 ** rng.uniform(-4, 4, n)
    return (a, b, c, d), (a * unit / unit[:, None], b / unit[:, None], c * unit, d)


def zeros_of_the_pencil(a, b, c, d):
    """Finite eigenvalues of [A - s, B; C, D] of a square system; a rectangular one has none in general."""
    n, m = b.shape
    left, right = np.block([[a, b], [c, d]]), scipy.linalg.block_diag(np.eye(n), np.zeros((m, m)))
    alpha, beta = scipy.linalg.eigvals(left, right, homogeneous_eigvals=True)
    return alpha[abs(beta) > 1e-9 * abs(alpha)] / beta[abs(beta) > 1e-9 * abs(alpha)]


def largest_gain(model, w):
    def gain(x):
        return np.linalg.svd(model.response(np.exp(np.atleast_1d(x))), compute_uv=False)[:, 0]

    x = np.log(w)
    found = gain(x)
    tops = np.argsort(-found)[:3]
    peaks = [
        -minimize_scalar(lambda v: -gain(v)[0], bounds=(x[k] - 0.01, x[k] + 0.01), method="bounded",
                         options={"xatol": 1e-12}).fun
        for k in tops
    ]  # fmt: skip
    return max(
        *peaks, found.max(), np.linalg.svd(model.response([0.0])[0], compute_uv=False)[0], np.linalg.norm(model.D, 2)
    )


@pytest.mark.parametrize("block", range(10))
def test_badly_scaled_systems_have_what_well_scaled_ones_have(block):
    for seed in range(10 * block, 10 * block + 10):
        good, bad = random_system(seed)
        well, model = linear(*good), linear(*bad)
        if good[1].shape[1] == good[2].shape[0]:
            want, found = zeros_of_the_pencil(*good), zeros(*bad)
            assert found.size == want.size, seed
            apart = (
                np.abs(want[:, None] - found) / np.maximum(np.abs(want), 1e-3 * np.abs(want).max(initial=0.0))[:, None]
            )
            assert apart[linear_sum_assignment(apart)].max(initial=0.0) < 1e-6, seed
        if not good[3].any():
            gramian = scipy.linalg.solve_continuous_lyapunov(good[0], -good[1] @ good[1].T)
            assert h2_norm(model) == pytest.approx(np.sqrt(np.trace(good[2] @ gramian @ good[2].T)), rel=1e-6), seed
        peak = largest_gain(well, np.geomspace(1e-2, 1e4, 2000))
        assert linf_norm(model).value == pytest.approx(peak, rel=1e-6), seed
        order = max(1, len(good[0]) // 2)
        w = np.geomspace(1e-3, 1e5, 200)
        both = [balanced(m, order).model.response(w) for m in (well, model)]
        assert np.abs(both[0] - both[1]).max() < 1e-6 * peak, seed


@pytest.mark.parametrize("order", [2, 3, 4, 6])
def test_the_error_of_a_reduced_chain_of_integrators(order):
    """Poles from 6e-5 to 600 rad/s in a companion form, whose entries span 20 decades: the error is what the responses differ by."""
    poles = -np.geomspace(6e-5, 6e2, 12)
    top = np.poly(-np.geomspace(2e-3, 40.0, 11))
    a = np.diag(np.ones(11), 1)
    a[-1] = -np.poly(poles)[:0:-1]
    b, c = np.zeros((12, 1)), 1e9 * top[::-1][None, :]
    b[-1] = 1.0
    model = linear(a, b, c)
    found = balanced(model, order)
    w = np.concatenate([[0.0], np.geomspace(1e-8, 1e4, 20_001)])
    apart = np.abs(model.response(w) - found.model.response(w)).max()
    assert found.error.value == pytest.approx(apart, rel=1e-4)
    assert found.error.value <= found.bound * (1.0 + 1e-3)
