"""Sign, weight, window, whitening and nuisance of residuals, with derivatives against differences."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident.data import InputSignal
from hvdc_ident.errors import InputError, SimulationError, SteadyStateError, StudyError
from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.fit.residual import whitened
from tests.fit.simulators import Closed, coloured, decay, line, parameters, recorded, step_response

T = np.linspace(0.0, 2.0, 41)
FREE = (FitParameter("a", 2.0, 0.5, 4.0), FitParameter("k", 1.0, 0.1, 5.0))
DECAY = Closed(parameters(a=2.0, k=1.0), {"y": decay})


def slopes(problem: Problem, theta: np.ndarray) -> np.ndarray:
    """dr/dtheta by central differences."""
    columns = []
    for i, u in enumerate(problem.unknowns):
        h = 1e-6 * u.span * np.eye(theta.size)[i]
        columns.append((problem.residual(theta + h)[0] - problem.residual(theta - h)[0]) / (2 * h[i]))
    return np.column_stack(columns)


def test_a_residual_is_measured_less_simulated_in_sigmas():
    problem = Problem(DECAY, (recorded("e", T, {"y": 0.5}, y=2.0 * np.exp(-T) + 1.0),), FREE)
    r, jacobian = problem.residual(problem.start)
    assert r == pytest.approx(np.full(T.size, 2.0))
    assert jacobian[:, 0] == pytest.approx(-np.exp(-T) / 0.5)
    assert problem.cost(problem.start) == pytest.approx(0.5 * 4.0 * T.size)


@pytest.mark.parametrize("rho", [0.0, 0.7])
def test_the_jacobian_is_the_residuals_derivative(rho):
    two = Closed(parameters(a=2.0, k=1.0, b=0.3), {"y": decay, "z": line})
    two.outputs["y"] = lambda t, p: with_zero(decay(t, p), "b", t)
    two.outputs["z"] = lambda t, p: with_zero(line(t, p), "k", t)
    first = recorded("one", T, {"y": 0.1, "z": 0.2}, y=T, z=T**2)
    second = recorded("two", T[::2], {"y": 0.3}, {"window": (0.5, 1.5)}, y=np.cos(T[::2]))
    free = (*FREE, FitParameter("b", 0.3, -1, 1))
    problem = Problem(two, (first, second), free, rho={"y": rho})
    r, jacobian = problem.residual(problem.start)
    assert r.size == 2 * T.size + int(((T[::2] >= 0.5) & (T[::2] <= 1.5)).sum())
    assert jacobian == pytest.approx(slopes(problem, problem.start), abs=1e-6)


def with_zero(found, name, t):
    y, gradients = found
    return y, {**gradients, name: np.zeros_like(t)}


def test_whitening_makes_ar1_noise_white():
    noise = coloured(np.random.default_rng(3), 20000, 0.9)
    white = whitened(noise, (0.9,))
    assert white.std() == pytest.approx(1.0, abs=0.03)
    assert abs(white[1:] @ white[:-1] / (white @ white)) < 0.02
    with pytest.raises(StudyError, match="-1 < rho < 1"):
        whitened(noise, (1.0,))


def test_rows_without_a_measurement_are_left_out():
    y = 2.0 * np.exp(-T)
    y[3] = np.nan
    problem = Problem(DECAY, (recorded("e", T, {"y": 0.5}, y=y),), FREE)
    assert problem.residual(problem.start)[0].size == T.size - 1
    with pytest.raises(StudyError, match="no row of 'y' can be compared"):
        Problem(DECAY, (recorded("e", T, {"y": 1.0}, {"window": (5, 6)}, y=y),), FREE).residual(problem.start)


def test_held_out_experiments_only_appear_in_the_table_of_errors():
    held_out = recorded("h", T, {"y": 0.5}, {"role": "holdout"}, y=2.0 * np.exp(-T) + 3.0)
    problem = Problem(DECAY, (recorded("e", T, {"y": 0.5}, y=2.0 * np.exp(-T)), held_out), FREE)
    assert problem.residual(problem.start)[0].size == T.size
    assert problem.rmse(problem.start)["y"] == pytest.approx({"e": 0.0, "h": 3.0})


def test_a_value_that_is_not_finite_is_a_failed_simulation():
    broken = Closed(parameters(a=1.0), {"y": lambda t, p: (np.full_like(t, np.inf), {"a": t})})
    problem = Problem(broken, (recorded("e", T, y=T),), (FitParameter("a", 1.0, 0, 2),))
    with pytest.raises(SimulationError, match="not finite"):
        problem.residual(problem.start)
    assert problem.rmse(problem.start) == {"y": {"e": None}}


def test_a_missing_steady_start_is_a_failed_simulation():
    def lost(t, p):
        raise SteadyStateError("no steady state")

    problem = Problem(Closed(parameters(a=1.0), {"y": lost}), (recorded("e", T, y=T),), (FitParameter("a", 1.0, 0, 2),))
    result = fit(problem, starts=2)
    assert result.status == "failed"
    assert "no steady start" in result.starts[0].message


def second_order(shift: float, nuisance: tuple[str, ...] = ("time-shift",)):
    """A second-order step response recorded by a clock that is late by `shift` seconds."""
    simulator = Closed(parameters(w=12.0, z=0.4, gain=1.5), {"y": step_response})
    t = np.linspace(0.0, 1.5, 301)
    y, _ = step_response(t - shift, {"w": 12.0, "z": 0.4, "gain": 1.5})
    rest = {"inputs": {"u": InputSignal.step(0.1, 0.0, 1.0)}, "nuisance": nuisance}
    free = (FitParameter("w", 10.0, 5, 30), FitParameter("z", 0.5, 0.1, 0.9), FitParameter("gain", 1.0, 0.2, 5))
    return Problem(simulator, (recorded("e", t, rest=rest, y=y),), free)


@pytest.mark.parametrize("shift", [0.0, 0.0073, -0.0121])
def test_a_clock_offset_is_found_together_with_the_parameters(shift):
    result = fit(second_order(shift), starts=3)
    found = result.nuisance["e"]["time-shift"]
    assert result.status == "converged"
    assert found.value == pytest.approx(shift, abs=1e-8)
    assert found.unit == "s"
    assert [e.value for e in result.estimates.values()] == pytest.approx([12.0, 0.4, 1.5], rel=1e-6)


def test_the_derivative_by_the_clock_offset_follows_the_slope():
    problem = second_order(0.0)
    theta = np.array([12.0, 0.4, 1.5, 0.004])
    _, jacobian = problem.residual(theta)
    assert jacobian == pytest.approx(slopes(problem, theta), abs=0.01 * np.abs(jacobian).max())


def test_a_nuisance_that_is_not_known_is_refused():
    with pytest.raises(StudyError, match="nuisance 'u' cannot be estimated"):
        fit(second_order(0.0, ("u",)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"free": (FitParameter("c", 1.0),)}, "no parameter 'c'"),
        ({"held": {"a": 1.0}}, "stands twice"),
        ({"free": ()}, "nothing to fit"),
        ({"experiments": (recorded("e", T, y=T), recorded("e", T, y=T))}, "two experiments of one name"),
        ({"experiments": (recorded("e", T, rest={"role": "holdout"}, y=T),)}, "nothing to fit"),
    ],
)
def test_a_problem_whose_parts_do_not_fit_is_refused(change, message):
    parts = {"simulator": DECAY, "experiments": (recorded("e", T, y=T),), "free": FREE}
    with pytest.raises(InputError, match=message):
        Problem(**(parts | change))


def test_bounds_that_do_not_hold_the_start_are_refused():
    with pytest.raises(
        StudyError, match=r"search for 'a' begins outside its bounds; expected a finite start in \[0, 1\], got 5"
    ):
        FitParameter("a", 5.0, 0.0, 1.0)
    with pytest.raises(StudyError, match="the noise of 'y' is wrong"):
        fit(Problem(DECAY, (recorded("e", T, {"y": -1.0}, y=T),), FREE))
