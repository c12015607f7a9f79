"""Records that do not begin at rest: unknown starts are eliminated exactly where the model is linear in them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import least_squares

from hvdc_ident import Model, simulate
from hvdc_ident.data import InputSignal, experiment, trajectory
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.fit.residual import with_best_start
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.simulate import ModelSimulator

TIME = np.linspace(0.0, 3.0, 61)
SPRING = Model(
    name="spring",
    parameters={"k": 4.0, "d": 0.8},
    inputs={"u": 1.0},
    states={"x": {"derivative": "v"}, "v": {"derivative": "k*(u - x) - d*v"}},
    outputs={"x": "x", "v": "v"},
)


def problem(coloured: bool = False, **more) -> Problem:
    """Two noisy records that begin off rest by different amounts."""
    rng = np.random.default_rng(3)
    found = []
    for name, starts, to in (("a", {"x": 1.3, "v": -0.4}, 2.0), ("b", {"x": 0.8, "v": 0.9}, 0.5)):
        e = experiment(name, TIME, {"u": InputSignal.step(1.0, 1.0, to)}, noise={"x": 0.02, "v": 0.05})
        run = simulate(SPRING, e.with_(starts=starts), {"k": 4.4, "d": 0.7})
        noisy = {o: run[o] + e.noise[o] * rng.standard_normal(TIME.size) for o in ("x", "v")}
        found.append(e.with_(measured=trajectory(TIME, noisy)))
    rho = FrozenMap({"x": 0.5, "v": 0.3} if coloured else {})
    free = (FitParameter("k", 4.0, 1.0, 9.0), FitParameter("d", 0.8, 0.1, 3.0))
    return Problem(ModelSimulator(SPRING), tuple(found), free, rho=rho, **more)


@pytest.mark.parametrize("coloured", [False, True])
def test_what_is_left_is_what_a_fit_of_the_starts_leaves(coloured):
    free_start = problem(coloured, free_initial_states=True)
    theta = np.array([4.4, 0.7])
    blocks = free_start.blocks(theta)
    named = problem(coloured)
    named = named.with_(experiments=[e.with_(nuisance=("x", "v")) for e in named.experiments])
    fitted = least_squares(lambda s: named.residual(np.concatenate([theta, s]))[0], np.zeros(4), x_scale=1.0)
    at_best = named.blocks(np.concatenate([theta, fitted.x]))
    for own, other in zip(blocks, at_best, strict=True):
        np.testing.assert_allclose(own.residual, other.residual, atol=2e-5)
        np.testing.assert_allclose(own.misfit, other.misfit, atol=2e-6)
    assert [b.taken for b in blocks] == [2, 0, 2, 0]
    settled = problem(coloured).cost(theta)
    assert settled > 5 * free_start.cost(theta), "taken for a record that begins at rest it fits badly"


def test_the_jacobian_is_that_of_the_eliminated_residual():
    """Kaufman's: its gradient is exact, itself is short of a part across the residual."""
    free_start = problem(free_initial_states=True)
    theta = np.array([4.1, 0.9])
    r, jacobian = free_start.residual(theta)
    for i, h in enumerate((1e-4, 1e-4)):
        step = h * np.eye(2)[i]
        slope = (free_start.cost(theta + step) - free_start.cost(theta - step)) / (2 * h)
        assert jacobian[:, i] @ r == pytest.approx(slope, rel=1e-4, abs=1e-3)
    starts = free_start.initial_state_jacobian(theta)
    assert starts.shape == (r.size, 4)
    assert np.abs(starts.T @ r).max() < 1e-6 * np.abs(starts).max() * np.linalg.norm(r)
    assert np.abs(starts.T @ jacobian).max() < 1e-6 * np.linalg.norm(starts) * np.linalg.norm(jacobian)


def test_a_start_that_is_given_or_estimated_is_not_eliminated():
    base = problem(free_initial_states=True)
    known = [e.with_(starts={"x": 1.0, "v": 0.0}) for e in base.experiments]
    plain = problem().with_(experiments=known)
    theta = np.array([4.1, 0.9])
    np.testing.assert_array_equal(base.with_(experiments=known).residual(theta)[0], plain.residual(theta)[0])
    half = base.with_(experiments=[e.with_(nuisance=("v",)) for e in base.experiments])
    assert [b.taken for b in half.blocks(np.array([4.1, 0.9, 0.0, 0.0]))] == [1, 0, 1, 0]


def test_starts_that_the_records_show_alike_and_strongly_are_shared_between_them():
    column = 1e12 * np.linspace(1.0, 2.0, 20)
    jacobian = np.column_stack([column, column])
    block = SimpleNamespace(jacobian=jacobian, residual=-jacobian @ [0.5, 0.5])
    e = experiment("e", np.array([0.0, 1.0])).with_(starts=FrozenMap({"a": 1.0, "b": 1.0}))
    moved = with_best_start(e, [block], ("a", "b"))
    assert moved.starts["a"] == pytest.approx(1.5)
    assert moved.starts["b"] == pytest.approx(1.5)
