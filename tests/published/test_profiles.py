"""Profiles of functions whose intervals are known in closed form.

LikelihoodProfiler.jl, models/AnalyticFuncs (https://github.com/insysbio/LikelihoodProfiler.jl); the function rises by 4
at the ends. Costs here are half a sum of squares, so the threshold is 2.
"""

from __future__ import annotations

from math import log, sqrt

import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar
from scipy.stats import chi2

from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import FitParameter
from hvdc_ident.fit.profile import profiles
from hvdc_ident.fit.profile_path import ProfileOptions
from tests.fit.simulators import LeastSquares

EXACT = ProfileOptions(tolerance=1e-10)


def free(*names):
    return tuple(FitParameter(n, 0.0) for n in names)


def quadratic(t):
    return np.array([t[0] - 3, t[0] - t[1] - 1]), np.array([[1.0, 0, 0], [1, -1, 0]])


def exponential(t):
    return np.exp(t) - 1, np.exp(t)[:, None]


def rosenbrock(t):
    return np.array([1 - t[0], 10 * (t[1] - t[0] ** 2)]), np.array([[-1.0, 0], [-20 * t[0], 10]])


def ends(residual, names, start):
    found = profiles(LeastSquares(free(*names), residual), np.array(start, float), threshold=2.0, options=EXACT)
    assert found.restarts == ()
    return {n: p.ci95 for n, p in found.by_name.items()}, found


def test_quadratic_with_a_parameter_that_is_not_there() -> None:
    ci, found = ends(quadratic, ["x1", "x2", "x3"], [3, 2, 0])
    assert ci["x1"] == pytest.approx((1, 5), abs=1e-8)
    assert ci["x2"] == pytest.approx((2 - 2 * sqrt(2), 2 + 2 * sqrt(2)), abs=1e-8)
    assert ci["x3"] == (None, None)
    assert {found.by_name["x3"].lower.status, found.by_name["x3"].upper.status} == {"not-found"}


def test_exponential_is_open_below() -> None:
    ci, found = ends(exponential, ["x"], [0.0])
    assert ci["x"][1] == pytest.approx(log(3), abs=1e-9)
    assert ci["x"][0] is None and "no crossing" in found.by_name["x"].lower.reason


def test_rosenbrock() -> None:
    ci, _ = ends(rosenbrock, ["x1", "x2"], [1, 1])
    assert ci["x1"] == pytest.approx((-1, 3), abs=1e-8)

    def best(x2):
        return min(
            minimize_scalar(lambda a: (1 - a) ** 2 + 100 * (x2 - a * a) ** 2, bounds=b, options={"xatol": 1e-12}).fun
            for b in ((-4, 0), (0, 4))
        )

    low = brentq(lambda v: best(v) - 4, -0.5, 0.0)
    high = brentq(lambda v: best(v) - 4, 8.0, 10.0)
    assert ci["x2"] == pytest.approx((low, high), abs=1e-6)
    assert ci["x2"] == pytest.approx((-0.174, 9.0), abs=5e-3)  # as published


def test_bounds_open_a_profile_and_physical_ones_end_it() -> None:
    unknowns = (FitParameter("x", 0.0, -0.5, 5.0),)
    found = profiles(LeastSquares(unknowns, exponential), np.zeros(1), threshold=2.0, options=EXACT).by_name["x"]
    assert found.lower.status == "open-at-bound" and found.lower.limit is None
    assert found.upper.limit == pytest.approx(log(3), abs=1e-9)
    own = {"x": (True, False)}
    found = profiles(LeastSquares(unknowns, exponential), np.zeros(1), threshold=2.0, physical=own).by_name["x"]
    assert found.lower.status == "closed" and found.lower.limit == -0.5


def test_at_a_bound_the_limit_is_one_sided() -> None:
    unknowns = (FitParameter("x", 0.0, 0.0, 50.0),)

    def line(t):
        return t + 1.0, np.ones((1, 1))  # would like to be at -1

    found = profiles(LeastSquares(unknowns, line), np.zeros(1), options=EXACT).by_name["x"]
    assert found.one_sided and found.lower.status == "open-at-bound"
    assert found.upper.limit == pytest.approx(sqrt(1 + chi2.ppf(0.90, 1)) - 1, rel=1e-9)


def test_a_crossing_that_leans_on_a_search_bound_does_not_count() -> None:
    def pair(t):
        return np.array([10 * (t[0] - t[1]), 0.01 * t[1]]), np.array([[10.0, -10], [0, 0.01]])

    unknowns = (FitParameter("x", 0.0, -20, 20), FitParameter("y", 0.0, -1, 1))
    found = profiles(LeastSquares(unknowns, pair), np.zeros(2), ["x"]).by_name["x"]
    assert found.upper.status == "not-found" and "y cannot leave the bounds" in found.upper.reason
    found = profiles(LeastSquares(unknowns, pair), np.zeros(2), ["x"], physical={"y": (True, True)}).by_name["x"]
    assert found.closed


def test_a_better_optimum_on_the_way_starts_all_over_and_is_told() -> None:
    def wells(t):
        x, y = t
        r = np.array([4.0 * (x * x - 1.0), 0.7 * (x + 1.0), y - x])
        return r, np.array([[8.0 * x, 0.0], [0.7, 0.0], [-1.0, 1.0]])

    unknowns = (FitParameter("x", 1.0, -3, 3), FitParameter("y", 1.0, -3, 3))
    found = profiles(LeastSquares(unknowns, wells), np.array([1.0, 1.0]), ["x"], threshold=20.0)
    assert found.theta[0] < -0.9 and len(found.restarts) == 1 and "profile of x" in found.restarts[0]


def test_many_parameters_cost_few_evaluations() -> None:
    rng = np.random.default_rng(0)
    a = rng.normal(size=(40, 6))

    def linear(t):
        return a @ t, a

    found = profiles(LeastSquares(tuple(FitParameter(f"p{i}", 0.0, -9, 9) for i in range(6)), linear), np.zeros(6))
    inverse = np.linalg.inv(a.T @ a)
    for i, p in enumerate(found.by_name.values()):
        assert p.ci95[1] == pytest.approx(sqrt(2 * 1.92 * inverse[i, i]), rel=1e-3)
        assert p.evaluations <= 16


def test_a_profile_follows_a_valley_off_which_nothing_can_be_simulated():
    """The tangent leaves b = sin 3a at once: each step begins with some that fail, and the ends are those of the parabola."""

    def valley(theta):
        a, b = theta
        off = b - np.sin(3.0 * a)
        if abs(off) > 0.02:
            raise SimulationError("off the valley")
        return np.array([(a - 5.0) / 0.8, 100.0 * off]), np.array([[1.25, 0.0], [-300.0 * np.cos(3.0 * a), 100.0]])

    unknowns = (FitParameter("a", 5.0, 0.0, 10.0), FitParameter("b", 0.6, -2.0, 2.0))
    found = profiles(LeastSquares(unknowns, valley), np.array([5.0, np.sin(15.0)]), ["a"]).by_name["a"]
    half = 0.8 * np.sqrt(2.0 * 1.92)
    assert found.ci95 == pytest.approx((5.0 - half, 5.0 + half), rel=1e-3)
