"""Runs that slide along the surface of a switch, against Filippov's solution written out by hand."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.errors import SimulationError
from hvdc_ident.model import Delay, Model, Sampled, State
from hvdc_ident.simulate import simulate

METHODS = ("explicit", "rosenbrock")
CLAMPED = "where(sum > top, min(Ki*e, 0), where(sum < -top, max(Ki*e, 0), Ki*e))"
IEEE = "where(sum > top, 0, where(sum < -top, 0, Ki*e))"
GAINS = {"Kp": 2.0, "Ki": 8.0, "T": 0.5, "top": 1.2, "D": 0.0}


def controller(integrator, feedthrough=False, gains=GAINS):
    """A PI controller whose integrator stops while its sum is beyond a limit, on a lag; with feedthrough, in an algebraic loop."""
    output = {"algebraic": {"c": "clip(sum, -top, top)"}} if feedthrough else {}
    signals = {"y": "p + D*c" if feedthrough else "p", "e": "r - y", "sum": "Kp*e + z"}
    if not feedthrough:
        signals["c"] = "clip(sum, -top, top)"
    names = gains if feedthrough else {n: v for n, v in gains.items() if n != "D"}
    return Model(
        "pi",
        parameters=names,
        inputs={"r": 0.0},
        states={"p": "(c - p)/T", "z": integrator},
        signals=signals,
        outputs={"y": "y", "z": "z"},
        **output,
    )


def filippov(time, Kp, Ki, T, top, D=0.0):
    """The lag's output y and the integrator z after a unit step at 0: at the limit, along it, and away from it."""
    pieces = []

    def run(field, state, start, end, stop):
        stop.terminal = True
        found = solve_ivp(
            field, (start, end), state, method="DOP853", rtol=1e-12, atol=1e-13, events=stop, dense_output=True
        )
        pieces.append((start, found.t[-1], found.sol))
        return found.y[:, -1], found.t[-1]

    def at_limit(t, s):
        return [(top - s[0]) / T, 0.0]

    def along(t, s):  # the sum stands: z' = Kp p'
        return [(top - s[0]) / T, Kp * (top - s[0]) / T]

    def inside(t, s):
        c = (Kp * (1.0 - s[0]) + s[1]) / (1.0 + Kp * D)
        return [(c - s[0]) / T, Ki * (1.0 - s[0] - D * c)]

    end = float(time[-1])
    s, t = run(at_limit, [0.0, 0.0], 0.0, end, lambda t, s: Kp * (1.0 - s[0] - D * top) + s[1] - top)
    s, t = run(along, s, t, end, lambda t, s: Kp * (top - s[0]) / T - Ki * (1.0 - s[0] - D * top))
    run(inside, s, t, end, lambda t, s: 1.0)
    p, z, c = np.empty_like(time), np.empty_like(time), np.full_like(time, top)
    for k, (start, _, solution) in enumerate(pieces):
        later = time >= start
        p[later], z[later] = solution(time[later])
        if k == 2:
            c[later] = (Kp * (1.0 - p[later]) + z[later]) / (1.0 + Kp * D)
    return p + D * c, z


def slopes(solution, values, names, shares=1e-5):
    """(time, names) central differences of an answer by its values."""
    columns = []
    for n in names:
        h = shares * values[n]
        high, low = (solution(**{**values, n: values[n] + d}) for d in (h, -h))
        columns.append((high - low) / (2 * h))
    return np.column_stack(columns)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("integrator", [CLAMPED, IEEE])
def test_a_clamped_integrator_slides_along_its_limit(integrator, method):
    model, values = controller(integrator), {n: v for n, v in GAINS.items() if n != "D"}
    names, time = tuple(values), np.linspace(0.0, 4.0, 401)
    run = experiment("step", time, {"r": InputSignal.step(0.0, 0.0, 1.0)})
    found = simulate(model, run, sensitivities=names, method=method, rtol=1e-10)
    y, z = filippov(time, **values)
    assert y.max() - 1.0 == pytest.approx(0.0158, abs=1e-4)
    np.testing.assert_allclose(found["y"][1:], y[1:], atol=1e-8)
    np.testing.assert_allclose(found["z"][1:], z[1:], atol=1e-7)
    wanted = slopes(lambda **v: filippov(time, **v)[0], values, names)
    off = np.abs(found.gradient("y") - wanted)[1:].max(axis=0) / np.abs(wanted).max(axis=0)
    assert (off < 1e-5).all(), off


def test_the_slide_is_the_limit_of_small_euler_steps():
    time = np.linspace(0.0, 4.0, 401)
    h, p, z, found = 1e-5, 0.0, 0.0, []
    for k in range(400_001):
        if k % 1000 == 0:
            found.append(p)
        e = 1.0 - p
        total = GAINS["Kp"] * e + z
        rate = GAINS["Ki"] * e if abs(total) <= GAINS["top"] else 0.0
        p += h * (min(max(total, -GAINS["top"]), GAINS["top"]) - p) / GAINS["T"]
        z += h * rate
    run = simulate(controller(IEEE), experiment("step", time, {"r": InputSignal.step(0.0, 0.0, 1.0)}))
    np.testing.assert_allclose(run["y"], found, atol=1e-5)
    assert run["y"].max() == pytest.approx(max(found), abs=1e-5)


def test_a_limit_in_an_algebraic_loop_slides_too():
    """The limit opens the loop: the sum falls 1 + Kp D times faster on its side than on the other."""
    values, time = {**GAINS, "D": 0.3, "top": 0.85}, np.linspace(0.0, 4.0, 401)
    model = controller(IEEE, feedthrough=True, gains=values)
    names = tuple(values)
    run = experiment("step", time, {"r": InputSignal.step(0.0, 0.0, 1.0)})
    found = simulate(model, run, sensitivities=names, rtol=1e-10)
    y, z = filippov(time, **values)
    np.testing.assert_allclose(found["y"][1:], y[1:], atol=1e-8)
    np.testing.assert_allclose(found["z"][1:], z[1:], atol=1e-7)
    wanted = slopes(lambda **v: filippov(time, **v)[0], values, names)
    off = np.abs(found.gradient("y") - wanted)[1:].max(axis=0) / np.abs(wanted).max(axis=0)
    assert (off < 1e-5).all(), off


# --- dry friction ---

FRICTION = {"mass": 2.0, "Fc": 1.0, "A": 1.5, "w": 3.0}


def block(**parts):
    """m v' = A sin(w t) - Fc sign(v), from rest."""
    states = {"v": State("(A*sin(w*time) - Fc*sign(v))/mass", start=0), "x": State("v", start=0)}
    return Model(
        "block",
        parameters={**FRICTION, **parts.pop("parameters", {})},
        states=states | parts.pop("states", {}),
        outputs={"v": "v", "x": "x", "friction": "Fc*sign(v)"} | parts.pop("outputs", {}),
        **parts,
    )


def stick_slip(time, mass, Fc, A, w):
    """The velocity: it begins where |A sin(w t)| passes Fc, and ends where its integral is 0 again."""
    v = np.zeros_like(time)
    for k in range(int(w * time[-1] / np.pi) + 1):
        side, start = (-1.0) ** k, (np.arcsin(Fc / A) + k * np.pi) / w

        def speed(t, side=side, start=start):
            return (A / w * (np.cos(w * start) - np.cos(w * t)) - side * Fc * (t - start)) / mass

        end = brentq(speed, start + 0.3 * np.pi / w, start + np.pi / w)
        assert end < start + np.pi / w  # it comes to rest before it begins to move back
        moving = (time > start) & (time < end)
        v[moving] = speed(time[moving])
    return v


@pytest.mark.parametrize("method", METHODS)
def test_dry_friction_sticks_and_slips(method):
    """Six times it begins and ends to move; at rest the friction is the force."""
    time, names = np.linspace(0.0, 6.0, 603), tuple(FRICTION)
    found = simulate(block(), experiment("force", time), sensitivities=names, method=method, rtol=1e-10)
    v = stick_slip(time, **FRICTION)
    np.testing.assert_allclose(found["v"], v, atol=1e-9)
    wanted = slopes(lambda **values: stick_slip(time, **values), FRICTION, names)
    off = np.abs(found.gradient("v") - wanted).max(axis=0) / np.abs(wanted).max(axis=0)
    assert (off < 1e-5).all(), off
    rest = np.flatnonzero((v == 0.0) & (np.abs(1.5 * np.sin(3.0 * time)) < 0.99))
    assert len(rest) > 100
    np.testing.assert_allclose(found["friction"][rest], 1.5 * np.sin(3.0 * time[rest]), atol=1e-7)


def test_breaks_within_a_slide_leave_it_as_it_is():
    """A sample every 0.02 s, a delayed speed, and an input with corners: x(t - T) has the slope -v(t - T) by T."""
    time = np.linspace(0.0, 6.0, 603)
    more = block(
        parameters={"T": 0.25, "Ts": 0.02},
        inputs={"u": 0.0},
        states={"y": State("held + late + u", start=0)},
        sampled={"held": Sampled("x", "Ts", 0)},
        delays={"late": Delay("x", "T")},
        outputs={"late": "late"},
    )
    wave = InputSignal.corners([(0.0, 0.0), (0.7, 1.0), (1.4, 0.0), (1.45, 2.0), (2.2, 0.0)])
    found = simulate(more, experiment("breaks", time, {"u": wave}), sensitivities=("A", "T"), rtol=1e-10)
    plain = simulate(block(), experiment("plain", time), sensitivities=("A",), rtol=1e-10)
    for output in ("v", "x", "friction"):
        np.testing.assert_allclose(found[output], plain[output], atol=1e-7)
        np.testing.assert_allclose(found.gradient(output)[:, 0], plain.gradient(output)[:, 0], atol=1e-6)
    wanted = -stick_slip(time - 0.25, **FRICTION)
    np.testing.assert_allclose(found.gradient("late")[:, 1], wanted, atol=1e-7)


def test_an_unknown_that_jumps_at_the_switch_is_known_on_both_sides():
    """z = Fc sign(v) + sin(z)/5 is +-N: friction of the force N, whose slope by Fc is 1/(1 - cos(N)/5)."""
    time, names = np.linspace(0.0, 6.0, 603), ("Fc", "A", "w")
    states = {"v": State("A*sin(w*time) - z", start=0)}
    model = Model(
        "loop",
        parameters={n: FRICTION[n] for n in names},
        states=states,
        algebraic={"z": "Fc*sign(v) + 0.2*sin(z)"},
        outputs={"v": "v", "z": "z"},
    )
    found = simulate(model, experiment("force", time), sensitivities=names, rtol=1e-10)
    force = brentq(lambda z: z - 1.0 - 0.2 * np.sin(z), 1.0, 2.0)
    values = {**FRICTION, "mass": 1.0, "Fc": force}
    v = stick_slip(time, **values)
    np.testing.assert_allclose(found["v"], v, atol=1e-9)
    wanted = slopes(lambda **given: stick_slip(time, **given), values, names)
    wanted[:, 0] /= 1.0 - 0.2 * np.cos(force)
    off = np.abs(found.gradient("v") - wanted).max(axis=0) / np.abs(wanted).max(axis=0)
    assert (off < 1e-5).all(), off
    rest = (v == 0.0) & (np.abs(1.5 * np.sin(3.0 * time)) < 0.99 * force)
    assert rest.sum() > 100
    np.testing.assert_allclose(found["z"][rest], 1.5 * np.sin(3.0 * time[rest]), atol=1e-7)


def test_a_switch_on_an_unknown_slides():
    """The unknown s, of v = s - 0.3 sin(s), has the sign of v: the friction is that of v."""
    time, names = np.linspace(0.0, 6.0, 603), ("Fc", "A", "w")
    model = Model(
        "measured",
        parameters={n: FRICTION[n] for n in names},
        states={"v": State("A*sin(w*time) - Fc*sign(s)", start=0)},
        algebraic={"s": "v + 0.3*sin(s)"},
        outputs={"v": "v"},
    )
    found = simulate(model, experiment("force", time), sensitivities=names, rtol=1e-10)
    values = {**FRICTION, "mass": 1.0}
    np.testing.assert_allclose(found["v"], stick_slip(time, **values), atol=1e-9)
    wanted = slopes(lambda **given: stick_slip(time, **given), values, names)
    off = np.abs(found.gradient("v") - wanted).max(axis=0) / np.abs(wanted).max(axis=0)
    assert (off < 1e-5).all(), off


# --- limits that move, surfaces that bend ---


@pytest.mark.parametrize("method", METHODS)
def test_a_state_follows_its_limit_upwards(method):
    """x' = rate from 0; the limit rises from 0.5 by 0.2/s, then by 3/s from t = 2 on, which x no longer follows."""
    model = Model(
        "limited",
        parameters={"rate": 1.0, "floor": 0.5},
        inputs={"rise": 0.0},
        states={"x": State("nonwindup(rate, x, -1, floor + rise)", start=0)},
        outputs={"x": "x"},
    )
    time = np.linspace(0.0, 3.0, 301)
    rise = InputSignal.corners([(0.0, 0.0), (2.0, 0.4), (3.0, 3.4)])
    found = simulate(model, experiment("ramp", time, {"rise": rise}), sensitivities=("rate", "floor"), method=method)
    limit = 0.5 + 0.2 * time
    wanted = np.where(time > 2.0, 0.9 + (time - 2.0), np.minimum(time, limit))
    np.testing.assert_allclose(found["x"], wanted, atol=1e-7)
    free, held = time < 0.625, (time > 0.625) & (time < 2.0)
    by_rate = np.where(free, time, np.where(held, 0.0, time - 2.0))
    np.testing.assert_allclose(found.gradient("x")[:, 0][time != 0.625], by_rate[time != 0.625], atol=1e-6)
    np.testing.assert_allclose(found.gradient("x")[:, 1], np.where(free, 0.0, 1.0), atol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_a_slide_stays_on_a_circle(method):
    """Fields that lead to the circle of radius a from both sides, with a turn of w: x = a cos(w t) once it is there."""
    to_circle = "where(x**2 + y**2 > a**2, -1, 1)"
    model = Model(
        "circle",
        parameters={"w": 2.0, "a": 1.5},
        states={"x": State(f"-w*y + {to_circle}*x", start=1), "y": State(f"w*x + {to_circle}*y", start=0)},
        outputs={"x": "x", "y": "y"},
    )
    time = np.linspace(0.0, 60.0, 601)
    found = simulate(model, experiment("turns", time), sensitivities=("w", "a"), method=method)
    there = time > np.log(1.5)
    cos, sin = np.cos(2 * time[there]), np.sin(2 * time[there])
    np.testing.assert_allclose(np.hypot(found["x"], found["y"])[there], 1.5, atol=1e-9)
    np.testing.assert_allclose(found["x"][there], 1.5 * cos, atol=1e-5)
    np.testing.assert_allclose(found.gradient("x")[there], np.column_stack([-1.5 * time[there] * sin, cos]), atol=1e-4)


# --- what is no slide ---


def test_a_narrow_hysteresis_is_no_slide():
    """z is -1 above 1e-9 and 1 below -1e-9, and either in between: it switches a thousand million times a second."""
    model = Model(
        "relay",
        parameters={},
        states={"x": State("z", start=-1)},
        algebraic={"z": "where(x - 1e-9*z > 0, -1, 1)"},
        outputs={"x": "x"},
    )
    with pytest.raises(SimulationError, match="chatter"):
        simulate(model, experiment("relay", np.linspace(0.0, 10.0, 11)))


def test_a_field_that_leads_away_is_crossed():
    model = Model("away", parameters={}, states={"x": State("where(x > 0.5, 2, 1)", start=0)}, outputs={"x": "x"})
    time = np.linspace(0.0, 1.0, 11)
    found = simulate(model, experiment("away", time))
    np.testing.assert_allclose(found["x"], np.where(time > 0.5, 2 * time - 0.5, time), atol=1e-9)
    assert found.statistics.events == 1


def test_two_slides_at_once_are_refused():
    states = {n: State(f"-sign({n} - {end})", start=0) for n, end in (("x", 0.4), ("y", 0.6))}
    model = Model("both", parameters={}, states=states, outputs={"x": "x"})
    with pytest.raises(SimulationError, match="two-slides") as error:
        simulate(model, experiment("both", np.linspace(0.0, 1.0, 11)))
    assert "two limits are held at once" in str(error.value)
