"""What standard controllers hide (deadbands with a step, limited rates, non-windup limits), in loops, against scipy with events."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy import integrate

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.discrepancy.candidates import candidates
from hvdc_ident.effects import apply_effects, effects
from hvdc_ident.errors import ModelError
from hvdc_ident.linearize import find_operating_point, linearize
from hvdc_ident.model import Model
from hvdc_ident.simulate import simulate

TIME = np.linspace(0.0, 4.0, 1237)
STEPS = ((0.0, 0.0), (0.301, 0.3), (1.503, -0.2), (2.907, 0.05))
"""(s, value): a load or set-point; no step at a row."""


def hybrid(modes, mode, y0):
    """States (K, n) of a system that is in one mode at a time: its equations, and where it leaves for which other mode.

    modes: {name: (rhs(y, u), [(g(y, u), next)])}; a mode is left where a g rises above 0.
    """
    found, y = [np.array([y0])], np.array(y0, dtype=float)
    for (begin, level), end in pairwise([*STEPS, (TIME[-1], None)]):
        t = begin
        while t < end[0]:
            mode = next((after for g, after in modes[mode][1] if g(y, level) > 1e-13), mode)
            run = _in_one_mode(*modes[mode], y, level, t, end[0])
            rows = TIME[(t < TIME) & (run.t[-1] >= TIME)]
            found.append(run.sol(rows).T if rows.size else np.zeros((0, y.size)))
            t, y = run.t[-1], run.y[:, -1]
            if run.status == 1:
                ways = zip(modes[mode][1], run.t_events, strict=True)
                mode = next(after for (_, after), met in ways if met.size)
    return np.vstack(found)


def _in_one_mode(rhs, ways, y, level, begin, end):
    def leaving(g):
        def event(t, y):
            return g(y, level)

        event.terminal, event.direction = True, 1.0
        return event

    return integrate.solve_ivp(
        lambda t, y: rhs(y, level), (begin, end), y, "DOP853", dense_output=True, rtol=1e-12, atol=1e-13,
        events=[leaving(g) for g, _ in ways], max_step=0.02,
    )  # fmt: skip


GOVERNOR = Model(
    "governor",
    {"K": 5.0, "D": 0.5, "Tg": 0.3},
    inputs={"load": 0.0},
    states={"w": "g - load - D*w", "g": "(-K*e - g)/Tg"},
    signals={"e": "w"},
    outputs={"w": "w", "g": "g"},
)


def with_step(p):
    """The governor behind a deadband with a step."""
    width = p["width"]

    def in_mode(acts):
        return lambda y, u: [y[1] - u - p["D"] * y[0], (-p["K"] * acts * y[0] - y[1]) / p["Tg"]]

    return hybrid(
        {
            "inside": (in_mode(0.0), [(lambda y, u: y[0] - width, "above"), (lambda y, u: -y[0] - width, "below")]),
            "above": (in_mode(1.0), [(lambda y, u: width - y[0], "inside")]),
            "below": (in_mode(1.0), [(lambda y, u: width + y[0], "inside")]),
        },
        "inside",
        [0.0, 0.0],
    )


def with_rates(p):
    """The governor whose gate has limited rates."""

    def speed(y):
        return (-p["K"] * y[0] - y[1]) / p["Tg"]

    def in_mode(limit):
        return lambda y, u: [y[1] - u - p["D"] * y[0], speed(y) if limit is None else limit]

    return hybrid(
        {
            "free": (
                in_mode(None),
                [(lambda y, u: speed(y) - p["up"], "up"), (lambda y, u: -p["down"] - speed(y), "down")],
            ),
            "up": (in_mode(p["up"]), [(lambda y, u: p["up"] - speed(y), "free")]),
            "down": (in_mode(-p["down"]), [(lambda y, u: speed(y) + p["down"], "free")]),
        },
        "free",
        [0.0, 0.0],
    )


EXCITER = Model(
    "exciter",
    {"K": 8.0, "Ta": 0.4, "Tv": 0.7},
    inputs={"ref": 0.0},
    states={"field": "(K*(ref - v) - field)/Ta", "v": "(field - v)/Tv"},
    outputs={"field": "field", "v": "v"},
)
PI = Model(
    "pi",
    {"Kp": 0.6, "Ki": 4.0, "Tv": 0.7},
    inputs={"ref": 0.0},
    states={"xi": "Ki*(ref - v)", "v": "(Kp*(ref - v) + xi - v)/Tv"},
    outputs={"xi": "xi", "v": "v"},
)


def held(p, speed, other):
    """Two states, of which the first is held at its limits."""

    def in_mode(free):
        return lambda y, u: [speed(y, u) if free else 0.0, other(y, u)]

    return hybrid(
        {
            "free": (in_mode(True), [(lambda y, u: y[0] - p["high"], "high"), (lambda y, u: p["low"] - y[0], "low")]),
            "high": (in_mode(False), [(lambda y, u: -speed(y, u), "free")]),
            "low": (in_mode(False), [(lambda y, u: speed(y, u), "free")]),
        },
        "free",
        [0.0, 0.0],
    )


def held_lag(p):
    return held(p, lambda y, u: (p["K"] * (u - y[1]) - y[0]) / p["Ta"], lambda y, u: (y[0] - y[1]) / p["Tv"])


def held_integrator(p):
    return held(p, lambda y, u: p["Ki"] * (u - y[1]), lambda y, u: (p["Kp"] * (u - y[1]) + y[0] - y[1]) / p["Tv"])


CASES = {
    "deadband with a step": (GOVERNOR, "deadband-step", "e", {"width": 0.03}, with_step, 1e-4),
    "gate with limited rates": (GOVERNOR, "state-rate-limit", "g", {"up": 0.5, "down": 0.8}, with_rates, 2e-8),
    "exciter's field": (EXCITER, "non-windup-limit", "field", {"low": -0.15, "high": 0.4}, held_lag, 5e-8),
    "clamped integrator": (PI, "non-windup-limit", "xi", {"low": -0.2, "high": 0.25}, held_integrator, 5e-8),
}


@pytest.mark.parametrize("case", CASES)
def test_a_loop_runs_as_scipy_finds_it_with_events(case):
    model, effect, place, sizes, reference, accuracy = CASES[case]
    changed = apply_effects(model, [{"effect": effect, "at": place, "parameters": sizes}])
    names = [n for n in changed.parameters if n not in model.parameters]
    wanted = (*model.parameters, *names)
    moved = next(iter(model.inputs))
    corners = [c for (_, a), (t, b) in pairwise(STEPS) for c in ((t, a), (t, b))]
    record = experiment("steps", TIME, {moved: InputSignal.corners(corners)})
    run = simulate(changed, record, sensitivities=wanted, rtol=1e-9)
    values = dict(model.values) | sizes
    expected = reference(values)
    np.testing.assert_allclose(run.trajectory.values, expected, atol=accuracy)
    plain = simulate(model, record).trajectory.values
    assert np.abs(expected - plain).max() > 0.03
    for k, name in enumerate((*model.parameters, *sizes)):
        h = 1e-5 * values[name]
        slope = (reference(values | {name: values[name] + h}) - reference(values | {name: values[name] - h})) / (2 * h)
        assert np.abs(run.gradients[:, :, k] - slope).max() < max(1e-4, 100 * accuracy) * (1 + np.abs(slope).max()), (
            name
        )


def at(model, *uses):
    """The model with effects, each (name, place, values)."""
    return apply_effects(model, [{"effect": e, "at": place, "parameters": values} for e, place, values in uses])


def test_a_state_at_its_limit_is_a_steady_state_with_a_linear_model():
    """At the upper limit v follows the field alone; the integrator, held, passes nothing on."""
    limited = at(EXCITER, ("non-windup-limit", "field", {"low": -0.15, "high": 0.4}))
    assert find_operating_point(limited, {"ref": 0.04}).states == pytest.approx(
        {"field": 8 / 9 * 0.04, "v": 8 / 9 * 0.04}
    )
    for ref, level in ((2.0, 0.4), (-1.0, -0.15)):
        point = find_operating_point(limited, {"ref": ref})
        assert point.states == pytest.approx({"field": level, "v": level}, abs=1e-12)
        found = linearize(limited, point)
        np.testing.assert_allclose(found.response(np.array([0.3, 3.0])), 0.0, atol=1e-12)
        assert sorted(np.linalg.eigvals(found.A).real) == pytest.approx([-5000.0, -1 / 0.7])
    name = "non_windup_limit_field_high"
    run = simulate(limited, experiment("e", TIME[:5], {"ref": 2.0}), sensitivities=[name])
    np.testing.assert_allclose(run.gradient("v"), 1.0)
    held_by_v = at(PI, ("non-windup-limit", "xi", {"high": 0.25}))
    point = find_operating_point(held_by_v, {"ref": 1.0})
    assert point.states["v"] == pytest.approx((0.6 + 0.25) / 1.6)
    np.testing.assert_allclose(
        linearize(held_by_v, point).response(np.array([2.0]))[:, 1, 0], 0.6 / (1.6 + 1.4j), atol=1e-12
    )


def test_one_sided_limits_and_rates_leave_the_other_side_free():
    steps = [c for (_, a), (t, b) in pairwise(STEPS) for c in ((t, a), (t, b))]

    def field(*uses):
        return simulate(at(EXCITER, *uses), experiment("e", TIME, {"ref": InputSignal.corners(steps)}), rtol=1e-9)[
            "field"
        ]

    free = field()
    low, high = (field(("non-windup-limit", "field", {n: v})) for n, v in (("low", -0.15), ("high", 0.4)))
    assert free.min() < -0.3 and low.min() == pytest.approx(-0.15, abs=1e-12) and low.max() > 0.5
    assert free.max() > 0.5 and high.max() == pytest.approx(0.4, abs=1e-12) and high.min() < -0.3
    rising, falling = (np.diff(field(("state-rate-limit", "field", {n: 1.0}))) / np.diff(TIME) for n in ("up", "down"))
    assert rising.max() == pytest.approx(1.0) and rising.min() < -3.0
    assert falling.min() == pytest.approx(-1.0) and falling.max() > 3.0


def test_limits_of_one_state_work_together_and_on_the_state_that_an_effect_adds():
    both = at(
        EXCITER,
        ("state-rate-limit", "field", {"up": 1.0, "down": 2.0}),
        ("non-windup-limit", "field", {"low": -0.15, "high": 0.4}),
    )
    run = simulate(both, experiment("e", TIME, {"ref": InputSignal.step(0.301, 0.0, 0.3)}), rtol=1e-9)
    early = TIME < 1.1  # before v is so high that the field has to fall
    np.testing.assert_allclose(run["field"][early], np.clip(TIME[early] - 0.301, 0.0, 0.4), atol=1e-8)
    lag = ("lag", "ref", {"T": 0.02})
    servo, other = (
        simulate(at(EXCITER, *uses), experiment("e", TIME, {"ref": InputSignal.step(0.301, 0.0, 0.3)}), rtol=1e-9)["v"]
        for uses in (
            [lag, ("state-rate-limit", "lag_ref_y", {"up": 0.5, "down": 0.7})],
            [("servo", "ref", {"T": 0.02, "up": 0.5, "down": 0.7})],
        )
    )
    np.testing.assert_allclose(servo, other, atol=1e-8)


@pytest.mark.parametrize("effect", ["state-rate-limit", "non-windup-limit"])
def test_what_changes_a_state_s_equation_sits_at_states_and_is_tried_there(effect):
    with pytest.raises(ModelError, match=r"cannot sit at the input 'load'; expected state"):
        at(GOVERNOR, (effect, "load", dict(effects()[effect].example)))
    moved = experiment("e", TIME, {"load": InputSignal.step(1.0, 0.0, 0.1)})
    slots = [p for p in GOVERNOR.insertion_points if not p.startswith("outputs.")]
    run = simulate(GOVERNOR, moved, outputs=slots)
    tried = candidates(GOVERNOR, {p: (np.asarray(run[p]),) for p in slots}, [TIME], [effect], None)
    assert {p for c in tried for p in c.at} == set(GOVERNOR.states)
