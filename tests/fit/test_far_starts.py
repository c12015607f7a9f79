"""Descents from starting values far off: the record of a plant whose model is unstable, or slips, at most values within their bounds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hvdc_ident as hi
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.fit.descent import Descent
from hvdc_ident.fit.optimisers.trust_region import TrustRegion
from hvdc_ident.fit.problem import shortened
from hvdc_ident.model import parse_card
from hvdc_ident.simulate import ModelSimulator

SWING = """
schema = 1
name = "swing"
[parameters]
M = {value = 0.1}
K = {value = 2.0}
g = {value = 0.3}
[inputs]
u = {value = 0.0}
[states]
d = {derivative = "w", guess = 0.0}
w = {derivative = "(u - K*sin(d) + g*e - 0.4*w)/M", guess = 0.0}
e = {derivative = "(w - e)/0.4", guess = 0.0}
[outputs]
y = "d"
"""
"""A swing that a lagged feedback of its speed destabilises from some gain on."""
TIME = np.linspace(0.0, 40.0, 801)
EVENT, PUSH, NOISE = 1.0, 0.4, 1e-3
TRUE = np.array([0.1, 2.0, 0.3])


def answer() -> np.ndarray:
    m, k, g = TRUE
    after = solve_ivp(
        lambda t, x: [x[1], (PUSH - k * np.sin(x[0]) + g * x[2] - 0.4 * x[1]) / m, (x[1] - x[2]) / 0.4],
        (EVENT, TIME[-1]), [0.0, 0.0, 0.0], t_eval=TIME[TIME >= EVENT], rtol=1e-10, atol=1e-12,
    )  # fmt: skip
    return np.concatenate([np.zeros(np.count_nonzero(TIME < EVENT)), after.y[0]])


def problem(card: str = SWING) -> Problem:
    y = answer() + NOISE * np.random.default_rng(0).standard_normal(TIME.size)
    e = hi.Experiment(
        name="push", time=TIME, inputs={"u": hi.step(0.0, PUSH, at=EVENT)}, event=EVENT, noise={"y": NOISE},
        measured=hi.Trajectory(TIME, y[:, None], ("y",)),
    )  # fmt: skip
    ranges = {"M": (0.02, 0.5), "K": (0.4, 10.0), "g": (0.05, 5.0)}
    free = [FitParameter(n, v, *ranges[n]) for n, v in zip(ranges, TRUE, strict=True)]
    return Problem(ModelSimulator(parse_card(card)), (e,), free)


@pytest.mark.parametrize("start", [(0.05, 1.9, 4.6), (0.1, 0.6, 0.9), (0.02, 3.2, 2.5), (0.13, 0.9, 2.4)])
def test_a_start_that_grows_without_bounds_is_led_to_the_optimum_by_the_first_part(start: tuple[float, ...]) -> None:
    p = problem()
    whole = Descent(p, TrustRegion())
    assert whole.go(np.array(start)) == "inadmissible"
    end = TrustRegion().run(p, np.array(start))
    assert end.status == "converged" and end.evaluations < 100
    best = TrustRegion().run(p, TRUE)
    assert end.cost == pytest.approx(best.cost, rel=1e-6)
    assert end.theta == pytest.approx(TRUE, rel=0.01)


def test_a_start_at_which_nothing_can_be_simulated_fails_with_its_reason() -> None:
    p = problem(
        SWING.replace('"(w - e)/0.4"', '"(w - e)/0.4 + 1e-9*sqrt(0.2 - g)"').replace("value = 0.3", "value = 0.1")
    )
    end = TrustRegion().run(p, TRUE)
    assert end.status == "failed" and end.cost is None and "cannot be simulated" in end.message


def test_the_first_part_of_a_record_is_cut_after_its_event() -> None:
    (e,) = shortened(problem(), 0.25).experiments
    assert e.time[-1] == pytest.approx(EVENT + 0.25 * (TIME[-1] - EVENT), abs=TIME[1])
    assert e.measured.values.shape[0] == e.time.size and e.event == EVENT


def test_no_part_is_shorter_than_its_rows_can_tell_the_unknowns() -> None:
    p, cuts = problem(), 0
    while (p := shortened(p, 0.25)) is not None:
        cuts += 1
        assert np.count_nonzero(p.experiments[0].time > EVENT) >= 4 * 3
    assert cuts == 3  # 780 rows after the event: 195, 48, 12
