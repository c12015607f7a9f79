"""Plants 5 and 6 of the study of hidden effects, and the second simulator, which hides effects in how their states move."""

from __future__ import annotations

import ast
import json
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hvdc_ident import linearize
from hvdc_ident import simulate as package
from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.effects import EffectUse, apply_effects
from hvdc_ident.immutable import FrozenMap
from tests.studies.study_module import STUDIES, load

sys.path.insert(0, str(STUDIES / "hidden_effects"))

from hidden import blocks, cases, kinds, mess, outcomes, sizes
from hidden.diagnosing import CARDS, model_of
from hidden.operators import CATALOGUE, OUTSIDE, WITH_SOURCE
from hidden.plant import Plant
from hidden.plants import PLANTS
from hidden.simulator import Hidden, Run, Signal, simulate

from hvdc_ident.model import read_card

pytestmark = pytest.mark.nightly

STUDY = load("hidden_effects")
HYDRO, PARK = PLANTS["hydro"], PLANTS["park"]
NEW = [HYDRO, PARK]
ROWS = 125


def moved(plant, times=1.0):
    """Return inputs that all step away at a tenth of the record and go back as ramps. times: so many kicks."""
    at = [plant.pace * t for t in (0.0402, 0.0402, 0.3, 0.4)]
    return {n: tuple(zip(at, (v, v + times * plant.kicks[n], v, v), strict=True)) for n, v in plant.inputs.items()}


def packages(plant, model, values=None, rows=ROWS, times=1.0):
    """Return (rows, outputs) of the package's engine for the inputs of `moved`."""
    inputs = {n: InputSignal.corners(p) for n, p in moved(plant, times).items()}
    case = experiment("e", np.arange(rows) * plant.interval, inputs)
    return package(model, case, values or {}, outputs=plant.outputs).trajectory.values


def own(plant, values=None, hidden=(), rows=ROWS, times=1.0, **more):
    """Return (rows, outputs) of the second simulator for the inputs of `moved`."""
    run = Run({n: Signal(p) for n, p in moved(plant, times).items()}, values or {})
    return simulate(plant, [run], hidden, rows=rows, **more)[:, 0]


def test_the_second_simulator_knows_neither_the_package_nor_the_first_one():
    for name in ("kutta", "blocks", "kinds", "hydro", "park"):
        tree = ast.parse((STUDIES / "hidden_effects" / "hidden" / f"{name}.py").read_text(encoding="utf-8"))
        only_for_types = {id(n) for branch in tree.body if isinstance(branch, ast.If) for n in ast.walk(branch)}
        imported = {
            n.module
            for n in ast.walk(tree)
            if isinstance(n, ast.ImportFrom) and n.module is not None and id(n) not in only_for_types
        }
        allowed = {"hidden.kinds", "hidden.blocks", "hidden.plant"}
        assert {m for m in imported if m.split(".")[0] == "hidden"} <= allowed, name
        assert not any(m.startswith("hvdc_ident") for m in imported), name


def test_the_second_simulator_hides_all_that_the_first_one_hides_and_effects_on_states():
    assert set(blocks.BLOCKS) == set(CATALOGUE | OUTSIDE) - {"inductance"}
    assert set(blocks.MOTIONS) == set(kinds.OF_STATES)


@pytest.mark.parametrize("plant", NEW, ids=lambda p: p.name)
def test_both_simulators_agree_on_the_plants(plant):
    model = model_of(plant.name)
    values = {n: 1.1 * plant.parameters[n] for n in plant.fitted}
    theirs = packages(plant, model, values)
    extent = np.ptp(theirs, axis=0)
    off = np.abs(own(plant, values) - theirs).max(axis=0)
    assert (off < 2e-4 * extent).all()
    assert (off < 2e-5 * extent).all(), "it was 5e-6"
    assert {n: p.value for n, p in model.parameters.items()} == plant.parameters
    assert {n: s.value for n, s in model.inputs.items()} == plant.inputs
    signals = {s for s in model.insertion_points if not s.startswith("outputs.")}
    assert signals - set(plant.slots) <= {"across", "Vre", "Vim"}, "the park's phasors are in another frame"
    assert set(plant.slots) <= signals
    assert own(plant, values, coarse=True) == pytest.approx(theirs, abs=0.05 * np.ptp(theirs))


@pytest.mark.parametrize("plant", NEW, ids=lambda p: p.name)
def test_kuttas_method_is_of_third_order(plant):
    """Where nothing is limited, with steps that end at the jumps of the inputs."""
    found = [own(plant, rows=20, step=plant.step / k) for k in (1, 2, 4)]
    apart = [np.abs(a - b).max(axis=0) for a, b in pairwise(found)]
    np.testing.assert_allclose(apart[0] / apart[1], 8.0, rtol=0.25)


def test_the_water_column_has_the_zero_and_the_pole_of_the_textbook():
    """Kundur, Power System Stability and Control (1994), equation 9.13: (1 - Tw s)/(1 + Tw s/2), Tw of the flow at rest."""
    gate, time = 0.7, HYDRO.parameters["Tw"] * 0.7
    given = {"Dt": 0.0, "qn": 0.0}
    p = {n: np.array([v]) for n, v in (HYDRO.parameters | given).items()}
    u = {n: np.array([v]) for n, v in HYDRO.inputs.items()}

    def column(opening, flow):
        """Return the power and the derivative of the flow, by the second simulator's equations."""
        seen = {}
        state = [np.array([v]) for v in (0.4, 1.0, 0.0, opening, 0.7, flow)]
        rates = HYDRO.flow(state, u, p, lambda name, value: seen.setdefault(name, value))
        return np.array([seen["Pm"][0], rates[5][0]])

    d = 1e-6
    by_gate = (column(gate + d, gate) - column(gate - d, gate)) / (2 * d)
    by_flow = (column(gate, gate + d) - column(gate, gate - d)) / (2 * d)
    for s in (0.3j, 1.0j, 4.0j):
        answer = by_gate[0] + by_flow[0] * by_gate[1] / (s - by_flow[1])
        published = HYDRO.parameters["At"] * (1 - time * s) / (1 + time * s / 2)
        assert answer == pytest.approx(published, rel=1e-6)


def test_the_governor_follows_the_published_rule_and_is_damped_alone():
    """Kundur (1994), section 9.1.3: RT = (2.3 - 0.15 (Tw - 1)) Tw/TM, TR = (5 - 0.5 (Tw - 1)) Tw, for stable isolated operation."""
    p = HYDRO.parameters
    assert p["RT"] == pytest.approx((2.3 - 0.15 * (p["Tw"] - 1)) * p["Tw"] / (2 * p["H"]), abs=0.005)
    assert p["TR"] == pytest.approx((5 - 0.5 * (p["Tw"] - 1)) * p["Tw"], abs=0.01)
    poles = np.linalg.eigvals(np.asarray(linearize(model_of("hydro"), inputs="Pref", outputs="Pe").A))
    assert (poles.real < 0).all()
    swing = poles[np.argmax(poles.imag)]
    synchronising = np.sqrt((p["E"] / p["X"]) ** 2 - 0.744**2)
    assert abs(swing) == pytest.approx(np.sqrt(100 * np.pi * synchronising / (2 * p["H"])), rel=0.02)


def test_the_park_rests_where_the_load_flow_says():
    p = PARK.parameters
    active, reactive, volts, terminals = own(PARK, rows=2)[0]
    assert active == pytest.approx(0.7, abs=1e-9)
    assert volts + p["Kc"] * reactive == pytest.approx(1.0, abs=1e-9), "the droop of the plant controller"
    current = (active - 1j * reactive) / volts
    assert abs(volts - (p["Rg"] + 1j * p["Xg"]) * current) == pytest.approx(1.0, abs=1e-9)
    assert abs(volts + (p["Rc"] + 1j * p["Xc"]) * current) == pytest.approx(terminals, abs=1e-9)


def test_the_parks_frequency_droop_has_its_dead_band():
    for off, beyond in ((5e-4, 0.0), (3e-3, 3e-3 - 6e-4)):
        run = Run({"fbus": Signal(((0.1, 1.0), (0.1, 1.0 + off)))})
        end = simulate(PARK, [run], rows=400, step=4 * PARK.step)[-1, 0, 0]
        assert end == pytest.approx(0.7 - 20.0 * beyond, abs=1e-5)


TOGETHER = [  # plant, effect, slot, from, parameters
    ("hydro", "lag", "dw", "", {"T": 0.3}),
    ("hydro", "gain", "h", "", {"k": 1.05}),
    ("hydro", "offset", "temp", "", {"c": 0.001}),
    ("hydro", "delay", "err", "", {"T": 0.212}),
    ("hydro", "limit", "vel", "", {"level": 0.008}),
    ("hydro", "droop", "err", "Pe", {"k": 0.02}),
    ("hydro", "coupling", "Pref", "h", {"k": 0.5}),
    ("hydro", "lead-lag", "gate", "", {"T1": 0.5, "T2": 0.3}),
    ("hydro", "second-order", "pilot", "", {"wn": 6.0, "zeta": 0.5}),
    ("hydro", "saturation", "err", "", {"level": 0.005}),
    ("hydro", "backlash", "gate", "", {"width": 0.001}),
    ("hydro", "loss", "Pm", "q", {"a": 0.01, "b": 0.02, "c": 0.03}),
    ("park", "droop", "verr", "Q", {"k": 0.1}),
    ("park", "coupling", "perr", "V", {"k": -1.0}),
    ("park", "conductance", "Vcmd", "Q", {"g": 0.1}),
    ("park", "lag", "P", "", {"T": 0.05}),
    ("park", "window-mean", "Qt", "", {"T": 0.083}),
    ("park", "inner-loop", "Ipcmd", "", {"wn": 30.0, "zeta": 0.6}),
    ("park", "deadband", "ferr", "", {"width": 0.001}),
    ("park", "limit", "Vcmd", "", {"level": 1.02}),
    ("park", "delay", "Qcmd", "", {"T": 0.103}),
    ("park", "sample-hold", "Pcmd", "", {"Ts": (1 + sizes.LATE) * 0.051, "compute": 0.0}),
]


@pytest.mark.parametrize(("name", "effect", "at", "source", "values"), TOGETHER)
def test_both_simulators_agree_on_effects(name, effect, at, source, values):
    plant = PLANTS[name]
    plain, mine = (own(plant, hidden=h, rows=60) for h in ((), [Hidden(effect, at, values, source)]))
    use = EffectUse(effect, (at,), FrozenMap(values), source=source)
    theirs = packages(plant, apply_effects(model_of(name), [use]), rows=60)
    extent = np.ptp(plain, axis=0)
    size = np.abs((mine - plain) / extent).max()
    assert size > 0.01
    assert np.abs((mine - theirs) / extent).max() < 0.01 * size + 2e-4


BOTH = {  # slot of the drive, from, parameters
    "backlash": ("wm", "", {"width": 0.05}),
    "conductance": ("v", "w", {"g": 0.1}),
    "coupling": ("load", "w", {"k": 0.1}),
    "cubic": ("vo", "", {"k": 0.05}),
    "deadband": ("load", "", {"width": 0.15}),
    "delay": ("wm", "", {"T": 0.0102}),
    "disturbance": ("wref", "", {"amplitude": 0.1, "frequency": 7.0, "phase": 1.0}),
    "drift": ("wm", "", {"k": 0.3}),
    "droop": ("wref", "i", {"k": 0.3}),
    "gain": ("emf", "", {"k": 1.2}),
    "inner-loop": ("v", "", {"wn": 120.0, "zeta": 0.5}),
    "lag": ("wm", "", {"T": 0.01}),
    "lead-lag": ("vo", "", {"T1": 0.03, "T2": 0.01}),
    "limit": ("v", "", {"level": 0.8}),
    "loss": ("torque", "w", {"a": 0.01, "b": 0.02, "c": 0.03}),
    "notch": ("vo", "", {"wn": 40.0, "k": 0.8}),
    "offset": ("wm", "", {"c": 0.1}),
    "product": ("torque", "w", {"k": 0.3}),
    "quantisation": ("wref", "", {"step": 0.07}),
    "rate-limit": ("wref", "", {"rate": 3.0}),
    "relay": ("torque", "w", {"k": 0.02, "centre": 1.0, "width": 0.05}),
    "sample-hold": ("wm", "", {"Ts": (1 + sizes.LATE) * 0.011, "compute": 0.004}),
    "saturation": ("v", "", {"level": 2.0}),
    "second-order": ("wm", "", {"wn": 120.0, "zeta": 0.4}),
    "window-mean": ("wm", "", {"T": 0.0213}),
}


@pytest.mark.parametrize("effect", sorted(blocks.BLOCKS))
def test_both_programs_of_the_study_hide_the_same(effect):
    """The drive in the first program and in the second, with the same effect."""
    drive = PLANTS["drive"]
    at, source, values = BOTH[effect]
    hidden = [Hidden(effect, at, values, source)]
    plain = own(drive, rows=100)
    first, second = own(drive, hidden=hidden, rows=100), own(replace(drive, scheme="kutta"), hidden=hidden, rows=100)
    size = np.abs(first - plain).max(axis=0)
    assert (size > 1e-3).all()
    assert (np.abs(first - second) < 0.01 * size).all()


def changed(plant, state, derivative):
    """Return the package's model of a plant with another derivative of one state, read from its changed card."""
    text = (CARDS / f"{plant.name}.toml").read_text(encoding="utf-8")
    lines = text.splitlines()
    (k,) = (k for k, line in enumerate(lines) if line.startswith(f"{state} = {{derivative"))
    before = lines[k].split('"')[1]
    lines[k] = lines[k].replace(f'"{before}"', f'"{derivative.format(f"({before})")}"')
    return "\n".join(lines)


SLOW = [("hydro", "gate", 0.004), ("hydro", "pilot", 0.01), ("park", "Ip", 0.1), ("park", "Qext", 0.02)]


@pytest.mark.parametrize(("name", "state", "rate"), SLOW)
def test_a_rate_limited_state_is_that_of_a_card_with_a_clipped_derivative(tmp_path, name, state, rate):
    plant = PLANTS[name]
    card = tmp_path / "slow.toml"
    card.write_text(changed(plant, state, f"clip({{}}, -{rate}, {rate})"), encoding="utf-8")
    theirs = packages(plant, read_card(card), rows=60)
    plain, mine = (
        own(plant, hidden=h, rows=60) for h in ((), [Hidden(kinds.SLOW_STATE, state, {"up": rate, "down": rate})])
    )
    extent = np.ptp(plain, axis=0)
    size = np.abs((mine - plain) / extent).max()
    assert size > 0.01
    assert np.abs((mine - theirs) / extent).max() < 0.01 * size + 2e-4


HELD = [("hydro", "gate", {"high": 0.7015}), ("hydro", "pilot", {"low": -3e-4}), ("hydro", "slow", {"high": 0.7004})]
HELD += [
    ("park", "xi", {"low": 0.05}),
    ("park", "xi", {"high": 0.077}),
    ("park", "xp", {"high": 0.715}),
    ("park", "Pord", {"high": 0.71}),
]


@pytest.mark.parametrize(("name", "state", "limit"), HELD)
def test_a_held_state_is_that_of_an_integration_with_events(name, state, limit):
    """scipy's own integrator on the plant's equations, from one arrival at the limit to the next departure."""
    plant = PLANTS[name]
    hidden = [Hidden(kinds.HELD_STATE, state, limit)]
    plain, mine = (own(plant, hidden=h, rows=60) for h in ((), hidden))
    extent = np.ptp(plain, axis=0)
    size = np.abs((mine - plain) / extent).max()
    assert size > 0.01
    theirs = by_events(plant, state, limit, 60)
    assert np.abs((mine - theirs) / extent).max() < 0.01 * size + 2e-4


def by_events(plant, state, limit, rows):
    """Return (rows, outputs) of a plant with one limited state, integrated by scipy between events."""
    place, p = list(plant.states).index(state), {n: np.array([v]) for n, v in plant.parameters.items()}
    corners, level = moved(plant), next(iter(limit.values()))
    outward = 1.0 if "high" in limit else -1.0
    seen = {}

    def at(t, before=False):
        times = {n: np.array([q[0] for q in c]) for n, c in corners.items()}
        nudge = -1e-9 if before else 1e-9
        return {n: np.array([np.interp(t + nudge, times[n], [q[1] for q in c])]) for n, c in corners.items()}

    def free(t, x, late=False):
        rates = plant.flow([np.array([v]) for v in x], at(t, late), p, lambda n, v: seen.update({n: v}) or v)
        return np.array([float(r[0]) for r in rates])

    def held(t, x, late=False):
        rates = free(t, x, late)
        rates[place] = 0.0
        return rates

    x = simulate(plant, [Run()], rows=1, watch=tuple(plant.states))[0, 0]
    grid = np.arange(rows) * plant.interval
    edges = sorted({0.0, *(q[0] for q in next(iter(corners.values()))), grid[-1]})
    found = np.zeros((rows, len(plant.outputs)))
    is_held = outward * (x[place] - level) >= 0
    for begin, end in pairwise(edges):
        t = begin
        while t < end - 1e-12:
            if is_held and outward * free(t, x)[place] < 0:
                is_held = False

            def arrives(s, y):
                return outward * (y[place] - level)

            def leaves(s, y, end=end):
                return outward * free(s, y, s > end - 1e-8)[place]

            event, equations = (leaves, held) if is_held else (arrives, free)
            event.terminal, event.direction = True, -1.0 if is_held else 1.0
            part = solve_ivp(
                lambda s, y, f=equations, end=end: f(s, y, s > end - 1e-8),
                (t, end), x, events=event, rtol=1e-9, atol=1e-11, dense_output=True, max_step=plant.interval,
            )  # fmt: skip
            for row in np.flatnonzero((grid >= t - 1e-12) & (grid <= part.t[-1])):
                free(grid[row], part.sol(max(grid[row], t)))
                found[row] = [seen[f"outputs.{o}"][0] for o in plant.outputs]
            x, t = part.y[:, -1], float(part.t[-1])
            if part.status == 1:
                is_held = not is_held
    return found


def servo(u, slots=("u", "x")):
    """Return a plant of one servo, x' = (u - x)/T, and an integrator behind it."""

    def flow(x, inputs, p, tap):
        order, place, total = tap("u", inputs["u"]), tap("x", x[0]), tap("s", x[1])
        tap("outputs.x", place)
        tap("outputs.s", total)
        return [(order - place) / p["T"], place - total]

    return Plant(
        name="servo", parameters={"T": 0.1}, inputs={"u": u}, states={"x": 0.0, "s": 0.0}, outputs=("x", "s"),
        fitted=("T",), kicks={"u": 1.0}, slots=slots, resistance=("", ""), flow=flow, scheme="kutta",
    )  # fmt: skip


def test_a_rate_limited_servo_has_its_closed_form():
    """A step of 1 with the time constant T and the rate r: a ramp until r T is left, then an exponential."""
    run = Run({"u": Signal(((0.1, 0.0), (0.1, 1.0)))})
    found = simulate(servo(0.0), [run], [Hidden(kinds.SLOW_STATE, "x", {"up": 2.0, "down": 1.0})], rows=200)[:, 0, 0]
    t = np.arange(200) * 4e-3 - 0.1
    end = (1.0 - 2.0 * 0.1) / 2.0
    exact = np.where(t < end, 2.0 * np.maximum(t, 0.0), 1.0 - 0.2 * np.exp(-(np.maximum(t, end) - end) / 0.1))
    assert np.abs(found - exact).max() < 1e-6


def test_a_held_servo_stops_at_its_limit_and_leaves_it_at_once():
    """A step up that would end at 1, held at 0.6, and a step down: no part of the push is remembered."""
    run = Run({"u": Signal(((0.1, 0.0), (0.1, 1.0), (0.4, 1.0), (0.4, 0.2)))})
    found = simulate(servo(0.0), [run], [Hidden(kinds.HELD_STATE, "x", {"high": 0.6})], rows=200)[:, 0, 0]
    t = np.arange(200) * 4e-3
    up = np.minimum(1.0 - np.exp(-np.maximum(t - 0.1, 0.0) / 0.1), 0.6)
    exact = np.where(t < 0.4, up, 0.2 + 0.4 * np.exp(-np.maximum(t - 0.4, 0.0) / 0.1))
    assert np.abs(found - exact).max() < 1e-6


def test_a_plant_that_rests_at_a_limit_is_held_there_from_the_start():
    found = simulate(servo(1.0), [Run()], [Hidden(kinds.HELD_STATE, "x", {"high": 0.6})], rows=50)[:, 0]
    assert found == pytest.approx(np.full((50, 2), 0.6), abs=1e-9)


@pytest.mark.parametrize(("plant", "at"), [(HYDRO, "Pref"), (PARK, "Vref")], ids=lambda p: getattr(p, "name", p))
def test_a_disturbance_has_acted_until_the_plant_repeats_itself(plant, at):
    values = {"amplitude": 0.02, "frequency": 4.0 / plant.pace, "phase": 1.0}
    hidden = [Hidden("disturbance", at, values)]
    one, two = (
        simulate(plant, [Run()], hidden, rows=60, step=10 * plant.step, lead=k * plant.lead)[:, 0] for k in (1, 2)
    )
    assert (np.abs(one - two).max(axis=0) < 0.01 * np.ptp(one, axis=0)).all()


def test_only_the_new_plants_have_effects_on_states_and_feedbacks_of_outputs():
    for plant in PLANTS.values():
        hidden = {e for d in cases.designs("single", 3, (plant.name,)) for e in d.effects}
        assert set(kinds.OF_STATES) <= hidden if plant in NEW else not set(kinds.OF_STATES) & hidden
        assert bool(plant.servos) == bool(plant.bounded) == bool(plant.feedbacks) == (plant in NEW)
        assert {*plant.servos, *plant.bounded} <= set(plant.states)
        for at, source in plant.feedbacks:
            order = plant.slots
            assert source in plant.outputs and order.index(source) < order.index(at)
    base = sizes.nominal("hydro", "small", 0)
    drawn = [cases._place(np.random.default_rng(k), base, "droop", []) for k in range(40)]
    assert 10 < sum(pair in HYDRO.feedbacks for pair in drawn) < 35
    assert set(cases.FED_BACK) <= set(WITH_SOURCE)


def test_sizes_of_effects_on_states_count_from_what_the_state_does():
    about = sizes.About(0.1, 0.9, 0.3, start=0.3, steepest=4.0)
    x = np.array([0.1, 0.5])
    slow = sizes.parameters(kinds.SLOW_STATE, x, about, np.random.default_rng(0), 1.0)
    np.testing.assert_allclose(slow["up"], [3.6, 2.0])
    sides = [sizes.parameters(kinds.HELD_STATE, x, about, np.random.default_rng(k), 1.0) for k in range(40)]
    ups = [s["high"] for s in sides if "high" in s]
    downs = [s["low"] for s in sides if "low" in s]
    np.testing.assert_allclose(ups[0], [0.84, 0.6])
    np.testing.assert_allclose(downs[0], [0.12, 0.2])
    assert len(ups) + len(downs) == 40 and 20 < len(ups) < 38, "three quarters of the movement are upwards"
    assert sizes.paced(kinds.SLOW_STATE, {"down": np.array(3.0)}, 20.0)["down"] == pytest.approx(0.15)


def test_a_case_with_an_effect_on_a_state_is_made_at_its_size():
    design = cases.Design("single", 5, "hydro", (kinds.HELD_STATE,), 10.0, "white", "small", False, True, 0.005, 0)
    case = cases.made(design, 3)
    assert case is not None and case.units == pytest.approx(10.0, rel=0.2)
    (truth,) = case.truth
    assert truth["effect"] == kinds.HELD_STATE and truth["at"] in HYDRO.bounded
    assert json.loads(json.dumps(case.truth)) == case.truth
    line = {"verdict": "named", "plant": "hydro", "truth": case.truth, "ambiguity": []}
    right = line | {"found": [{"effect": kinds.HELD_STATE, "at": [truth["at"]], "from": ""}]}
    assert outcomes.outcome(right) == "right" and outcomes.named(right)
    assert outcomes.outcome(line | {"found": [{"effect": "limit", "at": [truth["at"]], "from": ""}]}) == "wrong"


@pytest.mark.parametrize("plant", NEW, ids=lambda p: p.name)
def test_sums_of_the_plants_are_sums(plant):
    """An addition at one slot of a sum is, times a number, one at each of the others."""
    p = {n: np.array([v]) for n, v in plant.parameters.items()}
    u = {n: np.array([v]) for n, v in plant.inputs.items()}
    x = [np.array([v * 1.01 + 1e-4]) for v in plant.states.values()]

    def rates(slot="", added=0.0):
        return np.array(plant.flow(list(x), u, p, lambda n, v: v + added * (n == slot)))[:, 0]

    plain = rates()
    for group in outcomes.SUMS[plant.name]:
        answers = [rates(slot, 1e-4) - plain for slot in sorted(group)]
        norms = [np.linalg.norm(a) for a in answers]
        assert min(norms) > 0
        for a, n in zip(answers, norms, strict=True):
            assert abs(a @ answers[0]) == pytest.approx(n * norms[0], rel=1e-6), group


def test_a_messy_record_of_the_second_simulator_is_near_a_tidy_one():
    base = sizes.nominal("park", "small", 0)
    extent = np.ptp(base.outputs[:, :2], axis=(0, 1))
    found = mess.recorded(PARK, base.runs, [], extent, [1, 2, 3])
    off = np.abs(found - base.outputs).max(axis=(0, 1)) / extent
    assert ((off > 1e-3) & (off < 0.3)).all(), (
        "parameters 1 % off, half a cycle as the step, and late time stamps at jumps"
    )
