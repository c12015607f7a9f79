"""Algebraic loops at jumps across limits, and steady starts that are hard to find, against what follows from the equations."""

import itertools

import numpy as np
import pytest
import sympy as sp

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.effects import EffectUse, apply_effects
from hvdc_ident.errors import SimulationError, SteadyStateError
from hvdc_ident.model import Algebraic, Model, State
from hvdc_ident.models import load_model
from hvdc_ident.simulate import simulate

LINK = load_model("vsc-hvdc-link")
TIME = np.array([0.0, 0.1, 0.1, 0.11])
TABLE_2 = {"KIP": (5, 50), "KPP": (0, 10), "KIQ": (10, 50), "KPQ": (0, 10), "KPVDC": (10, 40), "KIVDC": (550, 950)}


@pytest.mark.parametrize("gain", [2.0, 8.0, 10.0, 40.0])
def test_a_step_into_a_fast_loop_with_a_limit_finds_its_end(gain):
    """Q1 = KPQ (0.1 - Q1) at once, inside the limits, though the first Newton step lands on one."""
    run = experiment("step", TIME, {"Qref1": InputSignal.step(0.1, 0.0, 0.1)})
    q = simulate(LINK, run, {"KPQ": gain}, sensitivities=("KPQ",))
    assert q["Q1"][2] == pytest.approx(0.1 * gain / (1 + gain), rel=1e-9)
    assert q.gradient("Q1")[2, 0] == pytest.approx(0.1 / (1 + gain) ** 2, rel=1e-7)


def loop(a):
    """z = clip(u b - A z, -1, 1) for three unknowns."""
    z = sp.symbols("z1:4")
    right = [
        sp.Symbol("u") * b - sum(x * v for x, v in zip(row, z, strict=True)) for b, row in zip(a[3], a[:3], strict=True)
    ]
    return Model(
        "loop",
        inputs={"u": 0.0},
        states={"x": State("-x", start=0)},
        algebraic={str(v): Algebraic(f"clip({e}, -1, 1)") for v, e in zip(z, right, strict=True)},
        outputs={str(v): str(v) for v in z},
    )


@pytest.mark.parametrize("seed", range(6))
def test_coupled_loops_find_the_one_solution_that_trying_all_sides_finds(seed):
    """A + A' is positive definite, so that I + D A is regular for every D in 0..1 and the solution is one."""
    random = np.random.default_rng(seed)
    m, skew = random.normal(size=(2, 3, 3))
    a = 10 * (m @ m.T) + 5 * np.eye(3) + 20 * (skew - skew.T)
    b = random.normal(size=3) * 40
    run = experiment("step", TIME, {"u": InputSignal.step(0.1, 0.0, 1.0)})
    found = simulate(loop([*a.tolist(), b.tolist()]), run)
    z = np.array([found[f"z{k}"][2] for k in (1, 2, 3)])
    solutions = []
    for sides in itertools.product((-1, 0, 1), repeat=3):
        free, at = np.array(sides) == 0, np.array(sides, dtype=float)
        trial = at.copy()
        trial[free] = np.linalg.solve(np.eye(free.sum()) + a[np.ix_(free, free)], (b - a @ at)[free])
        if np.allclose(np.clip(b - a @ trial, -1, 1), trial, atol=1e-9):
            solutions.append(trial)
    assert solutions and np.ptp(solutions, axis=0).max() < 1e-9
    np.testing.assert_allclose(z, solutions[0], atol=1e-10)


def test_a_loop_without_a_solution_is_refused():
    """z = z^2 + 1 + |z| once u is 1."""
    model = Model(
        "none",
        inputs={"u": 0.0},
        states={"x": State("-x", start=0)},
        algebraic={"z": Algebraic("u*(z**2 + 1 + abs(z))")},
        outputs={"z": "z"},
    )
    with pytest.raises(SimulationError, match="inconsistent"):
        simulate(model, experiment("step", TIME, {"u": InputSignal.step(0.1, 0.0, 1.0)}))


@pytest.mark.parametrize("gains", list(itertools.product(*TABLE_2.values())), ids=str)
def test_the_gains_do_not_move_the_rest(gains):
    """Every control integrates, so that the rest is that of Table I, whatever the gains."""
    start = experiment("start", np.array([0.0, 1e-6]))
    names = ("Vdc1", "Vdc2", "Irorder1", "Iiorder1", "Irorder2", "Iiorder2")
    here = simulate(LINK, start, dict(zip(TABLE_2, map(float, gains), strict=True)))
    there = simulate(LINK, start)
    for name in names:
        assert here[name][0] == pytest.approx(there[name][0], abs=1e-9)
    assert there["Vdc1"][0] == pytest.approx(1.0, abs=1e-12)


def test_a_loop_that_a_recording_opens_starts_next_to_its_guess():
    """An integrator that sees no error rests anywhere: the link rests where its powers balance, at Vdc = 1."""
    run = experiment("open", np.array([0.0, 1e-6]), {"Vdc1_m": InputSignal.constant(1.0)}, drive=("Vdc1_m",))
    start = simulate(LINK, run)
    assert start["Vdc1"][0] == pytest.approx(1.0, abs=1e-3) and start["P2"][0] == pytest.approx(0.4, abs=1e-9)
    assert start["P1"][0] / start["Vdc1"][0] + start["Idc"][0] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("measured", [0.99, 1.01])
def test_a_start_that_runs_away_is_refused_by_name(measured):
    """An integrator that sees a constant error ends at its limit, where only an infinite dc voltage balances the powers."""
    run = experiment("open", np.array([0.0, 1e-6]), {"Vdc1_m": InputSignal.constant(measured)}, drive=("Vdc1_m",))
    with pytest.raises(SteadyStateError, match=r"'Vdc[12]' runs away to"):
        simulate(LINK, run)


@pytest.mark.parametrize("size", [1e3, 1e6])
def test_a_rest_far_from_a_guess_of_zero_is_found_where_a_state_does_not_matter(size):
    """The units of a state may be small ones: x rests at u, and y, which nothing moves, where it was guessed."""
    model = Model(
        "idle",
        inputs={"u": size},
        states={"x": State("3*(u - x)", guess=0.0), "y": State("0*y", guess=2.0)},
        outputs={"x": "x", "y": "y"},
    )
    start = simulate(model, experiment("start", np.array([0.0, 1.0])))
    np.testing.assert_allclose(start["x"], size, rtol=1e-12)
    np.testing.assert_allclose(start["y"], 2.0)


@pytest.mark.parametrize("slot", ["Vdc1", "Vac1", "Vac2", "Vdc1_m"])
@pytest.mark.parametrize("effect", ["delay", "sample-hold"])
def test_what_is_delayed_is_at_rest_where_the_signal_is(slot, effect):
    """A delayed voltage that is taken for 0 at first is divided by: the search begins where its source stands."""
    late = apply_effects(LINK, [EffectUse(effect, (slot,), {"T" if effect == "delay" else "Ts": 1e-3})])
    still = experiment("rest", np.array([0.0, 1e-4]), {"Pref2": InputSignal.constant(0.3)})
    expected = simulate(LINK, still, sensitivities=("Rdc",))
    found = simulate(late, still, sensitivities=("Rdc",))
    for output in LINK.outputs:
        assert found[output][0] == pytest.approx(expected[output][0], abs=1e-9)
        assert found.gradient(output)[0] == pytest.approx(expected.gradient(output)[0], abs=1e-9)
