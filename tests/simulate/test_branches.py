"""Plants with several equilibria: whatever is put in or changed, a run starts from the one connected with the model's own."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from hvdc_ident import find_operating_point, simulate
from hvdc_ident.data import experiment
from hvdc_ident.effects import EffectUse, apply_effects, effects
from hvdc_ident.errors import SteadyStateError
from hvdc_ident.linearize import linearize
from hvdc_ident.model import parse_card, write_card
from hvdc_ident.models import load_model
from hvdc_ident.simulate import equilibria, with_guesses

# A load that raises its conductance until it has its power, behind a reactance: it has none above E^2 / 2X, and below it
# two conductances, of which the larger one is unstable (voltage collapse).
LOAD = parse_card("""
schema = 1
name = "load"
[parameters]
E = {value = 1.0}
X = {value = 0.5}
T = {value = 0.1}
[inputs]
P0 = {value = 0.6}
[states]
g = {derivative = "(order - P)/T", guess = 0.7}
m = {derivative = "(V - m)/0.05"}
[signals]
order = "P0"
V = "E/sqrt(1 + (g*X)**2)"
P = "g*V**2"
[outputs]
g = "g"
V = "m"
""")

# A generator behind a reactance: torque angle delta or pi - delta, and every turn more.
SWING = parse_card("""
schema = 1
name = "swing"
[parameters]
H = {value = 4.0, min = 0.5}
K = {value = 20.0}
[inputs]
Pm = {value = 0.8}
Vref = {value = 1.0}
[states]
delta = {derivative = "314.0*w", guess = 0.5}
w = {derivative = "(Pm - Pe - 2*w)/(2*H)"}
E = {derivative = "(efd - E - 0.7*(E - cos(delta))/0.6)/8"}
efd = {derivative = "(clip(K*err, -5, 5) - efd)/0.05"}
[signals]
Pe = "E*sin(delta)/0.6"
Vm = "sqrt((0.3*sin(delta))**2 + (0.3*cos(delta) + 0.3*E)**2)/0.6"
err = "Vref + 0.1 - Vm"
[outputs]
delta = "delta"
Vm = "Vm"
""")


def conductance(power, e=1.0, x=0.5):
    """The stable root of g E^2 / (1 + (g X)^2) = P."""
    ratio = 2 * x * power / e**2
    return e**2 / (2 * x**2 * power) * (1 - math.sqrt(1 - ratio**2))


def start(model, **values):
    p = np.array([values.get(n, q.value) for n, q in model.parameters.items()], dtype=float)
    u = np.array([values.get(n, i.value) for n, i in model.inputs.items()], dtype=float)
    found = equilibria(model).start(model, p, u)
    return dict(zip(model.states, found.y.tolist(), strict=False)), found.branch


KEEPING = ["lag", "delay", "second-order", "lead-lag", "inductance", "inner-loop", "window-mean", "sample-hold"]
KEEPING += ["rate-limit", "backlash", "coupling", "droop"]


@pytest.mark.parametrize("effect", KEEPING)
def test_an_effect_that_keeps_the_rest_keeps_the_branch(effect):
    """At every place and for values up to the collapse the load's conductance is the smaller root."""
    random = np.random.default_rng(1)
    source = "m" if effects()[effect].needs_source else ""
    for place in ("V", "P", "order", "P0", "g"):
        use = EffectUse(effect, (place,), effects()[effect].example, source=source)
        model = apply_effects(LOAD, [use])
        for _ in range(5):
            e, x = random.uniform(0.7, 1.3), random.uniform(0.2, 0.9)
            power = random.uniform(0.1, 0.98) * e**2 / (2 * x)
            found, branch = start(model, E=e, X=x, P0=power)
            assert found["g"] == pytest.approx(conductance(power, e, x), rel=1e-8) and branch == "own"
            assert found["m"] == pytest.approx(e / math.hypot(1, found["g"] * x), rel=1e-8)


@pytest.mark.parametrize("effect", [n for n, e in effects().items() if e.of_derivative])
@pytest.mark.parametrize("state", ["g", "m"])
def test_a_limit_on_a_state_s_equation_that_its_rest_does_not_reach_keeps_the_branch(effect, state):
    values = {"state-rate-limit": {"up": 0.4, "down": 0.2}, "non-windup-limit": {"low": 0.01, "high": 20.0}}[effect]
    model, random = apply_effects(LOAD, [EffectUse(effect, (state,), values)]), np.random.default_rng(1)
    for _ in range(5):
        e, x = random.uniform(0.7, 1.3), random.uniform(0.2, 0.9)
        power = random.uniform(0.1, 0.98) * e**2 / (2 * x)
        found, branch = start(model, E=e, X=x, P0=power)
        assert found["g"] == pytest.approx(conductance(power, e, x), rel=1e-8) and branch == "own"


def test_a_limited_state_rests_at_its_limit_even_where_it_has_no_rest_without():
    """The load that may not raise its conductance beyond 0.5 draws less than it is ordered to, and cannot collapse."""
    model = apply_effects(LOAD, [EffectUse("non-windup-limit", ("g",), {"high": 0.5})])
    for order, expected in ((0.3, conductance(0.3)), (0.6, 0.5), (1.5, 0.5)):
        found, branch = start(model, P0=order)
        assert found["g"] == pytest.approx(expected, rel=1e-9) and branch == "own"


SHIFTING = {
    "gain": lambda u, p: p["k"] * u,
    "offset": lambda u, p: u + p["c"],
    "limit": lambda u, p: max(-p["level"], min(u, p["level"])),
    "saturation": lambda u, p: p["level"] * math.tanh(u / p["level"]),
    "deadband": lambda u, p: u - max(-p["width"], min(u, p["width"])),
}


@pytest.mark.parametrize("effect", SHIFTING)
def test_an_effect_that_shifts_the_rest_stays_on_the_branch_or_says_where_that_ends(effect):
    """At the order: the load gets what the effect makes of it, up to the collapse, and has no rest above."""
    random = np.random.default_rng(2)
    ends = 0
    for _ in range(12):
        size = {n: v * random.uniform(0.6, 1.6) for n, v in effects()[effect].example.items()}
        model = apply_effects(LOAD, [EffectUse(effect, ("order",), size)])
        power = random.uniform(0.5, 1.2)
        effective = SHIFTING[effect](power, size)
        if effective < 1.0:
            assert start(model, P0=power)[0]["g"] == pytest.approx(conductance(effective), rel=1e-7)
        else:
            ends += 1
            with pytest.raises(SteadyStateError, match=r"turns back at|no steady state"):
                start(model, P0=power)
    assert effect != "gain" or ends


def test_a_sensitivity_at_the_start_is_that_of_the_branch():
    """dg/dX of the smaller root through a lag, against the closed form."""
    lagged = apply_effects(LOAD, [EffectUse("lag", ("V",), {"T": 0.02})])
    run = simulate(lagged, experiment("rest", np.array([0.0, 0.1])), {"X": 0.7}, sensitivities=("X",))
    h = 1e-6
    slope = (conductance(0.6, x=0.7 + h) - conductance(0.6, x=0.7 - h)) / (2 * h)
    assert run["g"].tolist() == pytest.approx([conductance(0.6, x=0.7)] * 2, rel=1e-9)
    assert run.gradient("g")[0, 0] == pytest.approx(slope, rel=1e-7)


def swing_rest(pm, vref, k):
    """(delta, E) on the branch below the largest power, by bracketed roots; None above that power."""

    def field(delta):
        def left(e):
            vm = math.hypot(0.3 * math.sin(delta), 0.3 * math.cos(delta) + 0.3 * e) / 0.6
            return max(-5, min(k * (vref + 0.1 - vm), 5)) - e - 0.7 * (e - math.cos(delta)) / 0.6

        return brentq(left, -3, 5, xtol=1e-14)

    grid = np.linspace(0.0, 2.0, 400)
    power = np.array([field(d) * math.sin(d) / 0.6 for d in grid])
    top = int(np.argmax(power))
    if pm >= power[top]:
        return None
    delta = brentq(lambda d: field(d) * math.sin(d) / 0.6 - pm, 0.0, grid[top], xtol=1e-13)
    return delta, field(delta)


@pytest.mark.parametrize("effect", ["lag", "second-order", "lead-lag", "window-mean", "rate-limit", "delay"])
@pytest.mark.parametrize("place", ["Vm", "Pe", "err", "delta", "E"])
def test_a_machine_starts_below_its_largest_power(effect, place):
    random = np.random.default_rng(3)
    model = apply_effects(SWING, [EffectUse(effect, (place,), effects()[effect].example)])
    for _ in range(4):
        pm, vref, k = random.uniform(0.3, 1.1), random.uniform(0.9, 1.1), math.exp(random.uniform(2, 5))
        expected = swing_rest(pm, vref, k)
        assert expected is not None
        found, _ = start(model, Pm=pm, Vref=vref, K=k, H=random.uniform(1, 9))
        assert (found["delta"], found["E"]) == pytest.approx(expected, abs=1e-8)


def test_linearisation_stands_where_a_simulation_starts():
    """With a lag, at other values, and the run stays there; the slope against scipy's own run of the load."""
    lagged = apply_effects(LOAD, [EffectUse("lag", ("P",), {"T": 0.02})])
    point = find_operating_point(lagged, {"P0": 0.9, "E": 1.1})
    run = simulate(lagged, experiment("rest", np.array([0.0, 2.0]), {}, values={"P0": 0.9}), {"E": 1.1})
    assert run["g"].tolist() == pytest.approx([point.states["g"]] * 2, rel=1e-8)
    assert point.branch == "own" and point.stable and point.notes == ()
    model = linearize(LOAD, find_operating_point(LOAD), inputs="P0", outputs="g")
    slope = solve_ivp(
        lambda t, g: [(0.6 + 1e-6 - g[0] / (1 + (0.5 * g[0]) ** 2)) / 0.1],
        (0, 5),
        [conductance(0.6)],
        rtol=1e-12,
        atol=1e-14,
    ).y[0, -1]
    gain = model.D - model.C @ np.linalg.solve(model.A, model.B)
    assert gain[0, 0] == pytest.approx((slope - conductance(0.6)) / 1e-6, rel=1e-3)


def test_another_rest_is_told_and_the_own_one_offered():
    """The larger root: unstable, and not the load's own, though a guess leads there."""
    high = 1 / (0.5**2 * conductance(0.6))
    point = find_operating_point(LOAD, guess={"g": high, "m": 0.3})
    assert point.states["g"] == pytest.approx(high) and point.branch == "other" and point.stable is False
    text = " ".join(point.notes)
    assert f"g = {conductance(0.6):.4g}" in text and "Unstable" in text and "grows" in text
    assert point.to_dict()["stable"] is False and point.to_dict()["branch"] == "other"


def test_a_card_of_a_model_with_effects_stays_on_its_branch():
    """A card says nothing of its origin: its guesses do, for every state."""
    model = apply_effects(SWING, [EffectUse("lag", ("Vm",), {"T": 0.08})]).with_values({"K": 120.0, "Pm": 1.0})
    card = parse_card(write_card(with_guesses(model)))
    assert all(s.guess is not None for s in card.states.values())
    assert start(card)[0] == pytest.approx(start(model)[0], rel=1e-9, abs=1e-9)
    assert start(card)[0]["delta"] == pytest.approx(swing_rest(1.0, 1.0, 120.0)[0], abs=1e-8)


def test_no_point_far_outside_a_state_s_own_range_passes():
    """Where no power balance is left the link rests at an infinite dc voltage only: found as 8e4 or 1e9 pu before."""
    link = load_model("vsc-hvdc-link")
    cases = [
        {"E1": 0.1, "Qref2": 5.0},
        {"Vdcref1": 0.5, "Iload1": 0.0},
        {"E1": 2.0, "Iload1": -3.0},
        {"Pref2": 2.0, "Qref2": 10.0},
    ]
    found = 0
    for case in cases:
        try:
            point = find_operating_point(link, case)
        except SteadyStateError:
            continue
        found += 1
        assert abs(point.states["Vdc1"]) < 10
    assert found


# A stirred tank with an exothermic reaction: cold, at the middle (unstable), or ignited; Arrhenius' rate bends so sharply
# that Newton's method leaps from one to another with corrections that halve.
TANK = """
schema = 1
name = "tank"
[parameters]
k0 = {value = 7.2e10}
E = {value = 8750.0}
heat = {value = 209.2}
UA = {value = 2.09}
[inputs]
cf = {value = 1.0}
Tc = {value = 300.0}
[states]
c = {derivative = "cf - c - rate", guess = START_C}
T = {derivative = "350 - T + heat*rate + UA*(Tc - T)", guess = START_T}
[signals]
rate = "k0*exp(-E/T)*c"
[outputs]
T = "T"
"""


def tank_balance(temperature, p):
    """The heat balance with the concentration's own balance put in."""
    k = p["k0"] * math.exp(-p["E"] / temperature)
    return 350 - temperature + p["heat"] * p["cf"] * k / (1 + k) + p["UA"] * (p["Tc"] - temperature)


@pytest.mark.parametrize(("c", "temperature"), [(0.9, 325.0), (0.2, 370.0)])
def test_a_tank_stays_cold_or_ignited_or_says_where_that_ends(c, temperature):
    model = parse_card(TANK.replace("START_C", str(c)).replace("START_T", str(temperature)))
    own = {n: q.value for n, q in model.parameters.items()} | {n: i.value for n, i in model.inputs.items()}
    random = np.random.default_rng(3)
    arrived = 0
    for _ in range(60):
        spread = {"E": 0.1, "Tc": 0.05}
        values = {n: v * math.exp(spread.get(n, 0.7) * random.uniform(-1, 1)) for n, v in own.items()}
        at: float | None = brentq(tank_balance, temperature - 5, temperature + 5, args=(own,))
        for share in np.linspace(0, 1, 801)[1:]:
            p = {n: v + share * (values[n] - v) for n, v in own.items()}
            ends = [tank_balance(at + d, p) for d in (-1.5, 1.5)]
            if ends[0] * ends[1] > 0:  # a fold: the straight way ends here
                at = None
                break
            at = brentq(tank_balance, at - 1.5, at + 1.5, args=(p,))
        if at is not None:
            arrived += 1
            found, branch = start(model, **values)
            assert found["T"] == pytest.approx(at, rel=1e-6) and branch == "own"
    assert arrived > 5


def test_of_several_stable_rests_the_nearest_is_offered():
    """Pushed off its upper rest a weakly damped machine slips many turns one way; the other way it swings back at once."""
    machine = parse_card("""
schema = 1
name = "machine"
[parameters]
H = {value = 4.0}
[inputs]
Pm = {value = 0.8}
[states]
delta = {derivative = "314.16*w", guess = 3.0}
w = {derivative = "(Pm - 2.2*sin(delta) - 4*w)/(2*H)"}
[outputs]
P = "2.2*sin(delta)"
""")
    point = find_operating_point(machine)
    low = math.asin(0.8 / 2.2)
    assert point.states["delta"] == pytest.approx(math.pi - low) and not point.stable
    assert any(f"A stable one stands at delta = {low:.4g}, w = 0;" in note for note in point.notes), point.notes
