"""The curves of other sizes of what was found: those that the model runs at."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hvdc_ident import Experiment, InputSignal
from hvdc_ident.data import Trajectory
from hvdc_ident.discrepancy import diagnose
from hvdc_ident.fit import FitParameter
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import parse_card
from hvdc_ident.study.size_curves import size_curves

LOOP = parse_card("""
schema = 1
name = "loop"
[parameters]
T = {value = 0.1, min = 0.01, max = 1}
[inputs]
r = {value = 1.0}
[states]
x = {derivative = "4*(r - y)", guess = 1.0}
y = {derivative = "(u - y)/T", guess = 1.0}
[signals]
u = "x + r - y"
[outputs]
y = "y"
""")


def record(levels, role, seed):
    """The loop with u limited to 1.2, by scipy: from its rest at the first level, a step every 0.7 s."""
    time, state, parts = np.arange(0, 0.7, 0.01), [levels[0], levels[0]], []
    for level in levels:

        def rates(t, v, r=level):
            return [4 * (r - v[1]), (np.clip(v[0] + r - v[1], -1.2, 1.2) - v[1]) / 0.1]

        run = solve_ivp(rates, (0, 0.7), state, t_eval=[*time, 0.7], rtol=1e-9, atol=1e-11, max_step=0.01)
        state = run.y[:, -1]
        parts.append(run.y[1, :-1])
    y = np.concatenate(parts) + 1e-3 * np.random.default_rng(seed).standard_normal(time.size * len(levels))
    t = np.round(np.arange(y.size) * 0.01, 9)
    edges = np.arange(1, len(levels)) * 0.7
    signal = InputSignal(np.array([0.0, *np.repeat(edges, 2), t[-1]]), np.repeat(levels, 2).astype(float), edges)
    measured = Trajectory(t, y[:, None], ("y",), ("",))
    return Experiment(
        t, f"{role}{seed}", inputs=FrozenMap({"r": signal}), measured=measured, noise=FrozenMap({"y": 1e-3}), role=role
    )


def test_a_size_that_leaves_no_steady_state_is_left_out():
    """The records rest at 1.0 to 1.1; a limit of 1.2 divided by 1.25 or more is below that, and nothing balances there."""
    data = [
        record([1.0, 1.3, 0.6, 1.0], "fit", 1),
        record([1.05, 0.5, 1.15, 1.3], "fit", 2),
        record([1.1, 1.35, 0.8], "holdout", 3),
    ]
    found = diagnose(LOOP, data, (FitParameter("T", 0.08, 0.01, 1.0),), effects=["limit", "lag", "gain"])
    assert [(e.effect, e.at) for e in found.effects] == [("limit", ("u",))], found.text
    shown = size_curves(LOOP, data, found)
    assert shown is not None and shown.chosen is not None
    assert shown.shares == (0.0, 0.25, 0.5, 0.75, 1.0)


def filtered(levels, role, seed):
    """The loop with its output read through a first-order filter of 0.15 s, by scipy."""
    time, state, parts = np.arange(0, 0.8, 0.02), [levels[0], levels[0], levels[0]], []
    for level in levels:

        def rates(t, v, r=level):
            return [4 * (r - v[1]), (v[0] + r - v[1] - v[1]) / 0.1, (v[1] - v[2]) / 0.15]

        run = solve_ivp(rates, (0, 0.8), state, t_eval=[*time, 0.8], rtol=1e-9, atol=1e-11, max_step=0.02)
        state = run.y[:, -1]
        parts.append(run.y[2, :-1])
    y = np.concatenate(parts) + 1e-3 * np.random.default_rng(seed).standard_normal(time.size * len(levels))
    t = np.round(np.arange(y.size) * 0.02, 9)
    edges = np.arange(1, len(levels)) * 0.8
    signal = InputSignal(np.array([0.0, *np.repeat(edges, 2), t[-1]]), np.repeat(levels, 2).astype(float), edges)
    measured = Trajectory(t, y[:, None], ("y",), ("",))
    return Experiment(
        t, f"{role}{seed}", inputs=FrozenMap({"r": signal}), measured=measured, noise=FrozenMap({"y": 1e-3}), role=role
    )


def test_a_size_that_the_effect_cannot_have_is_left_out():
    """A filter is a lead-lag whose lead ends on its lower bound, near 0: from 1.25 times the way there is no such lead."""
    data = [filtered([1.0, 1.3, 0.6], "fit", 1), filtered([1.0, 0.5, 1.2], "holdout", 2)]
    found = diagnose(LOOP, data, (FitParameter("T", 0.1, 0.05, 0.2),), effects=["lead-lag"], places=["outputs.y"])
    assert [e.effect for e in found.effects] == ["lead-lag"], found.text
    sizes = found.effects[0].parameters
    assert sizes["T2"].value == pytest.approx(0.15, rel=0.05) and sizes["T1"].value < 0.02
    shown = size_curves(LOOP, data, found)
    assert shown is not None and shown.chosen is not None
    assert shown.parameter == "T1" and shown.shares == (0.0, 0.25, 0.5, 0.75, 1.0)
