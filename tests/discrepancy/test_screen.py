"""The screen of candidates: its step against scipy's, its scores against a direct computation, and what it says of a hidden lag."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear
from scipy.stats import chi2, kstest

from hvdc_ident import InputSignal, simulate
from hvdc_ident.data import Array, Experiment
from hvdc_ident.discrepancy import DiagnosisOptions
from hvdc_ident.discrepancy.candidates import CandidateEffect, candidates
from hvdc_ident.discrepancy.expansion import ExpansionModel, _few
from hvdc_ident.discrepancy.hypothesis import Refit, slot_signals, with_given_gains
from hvdc_ident.discrepancy.movable import Form, equations, is_proportional
from hvdc_ident.discrepancy.options import SearchContext
from hvdc_ident.discrepancy.screen import ANY_FACTOR, SKETCHED, UP_TO_ONE, Linearised, Sketch, _Batch, screened
from hvdc_ident.effects import Probe, apply_effects, effects
from hvdc_ident.fit import Problem
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.simulate import ModelSimulator, Tolerance
from tests.discrepancy.cases import experiments, model
from tests.discrepancy.refits import plain


def stepped(
    at: Linearised, added: Array, reach: tuple[float, float], *, held: bool = False
) -> tuple[Array, float, float]:
    """Return the step with one effect (`Linearised.stepped`), beside another one that is none of it."""
    steps, left, factors = at.stepped(np.column_stack([added, at.residual]), [reach, UP_TO_ONE], held=held)
    return steps[0], float(left[0]), float(factors[0])


def test_what_runs_away_is_none_of_it() -> None:
    """An unstable candidate's answer is 1e30 times the residual: none of it explains anything."""
    residual, jacobian, low, high = problems(3)
    away = 1e30 * np.exp(np.linspace(0.0, 5.0, 40))
    step, left, factor = stepped(Linearised(residual, jacobian, low, high), away, UP_TO_ONE)
    without = lsq_linear(jacobian, -residual, (low, high), tol=1e-14)
    assert left <= 2.0 * without.cost * (1.0 + 1e-9) and abs(factor) * 1e30 < 10.0 * np.abs(residual).max()
    assert left > 0.5 * without.cost and np.all(step >= low) and np.all(step <= high)


def expansion_model(before: Refit, found: tuple[CandidateEffect, ...], bootstraps: int = 200) -> ExpansionModel:
    """Return what the candidates of a first round are compared on."""
    search = SearchContext("all", None, FrozenMap(), DiagnosisOptions(bootstraps=bootstraps), seed=0)
    return ExpansionModel.of(search, before, found, 1)


def listed(before: Refit, names: tuple[str, ...], places: tuple[str, ...] | None = None) -> tuple[CandidateEffect, ...]:
    """Return the candidates of some effects."""
    times = [e.time for e in before.problem.fitted_experiments]
    return candidates(before.model, slot_signals(before), times, names, places)


def problems(seed: int) -> tuple[Array, Array, Array, Array]:
    """Return a residual, its derivatives of very different sizes, and bounds on a step about as long as the best without any."""
    random = np.random.default_rng(seed)
    count = int(random.integers(1, 7))
    jacobian = random.standard_normal((40, count)) * np.geomspace(1.0, 1e4, count)
    residual = 3.0 * random.standard_normal(40)
    length = np.abs(np.linalg.lstsq(jacobian, residual)[0])
    return residual, jacobian, -length * random.uniform(0.0, 2.0, count), length * random.uniform(0.0, 2.0, count)


@pytest.mark.parametrize("seed", range(8))
def test_a_step_without_bounds_is_that_of_least_squares(seed: int) -> None:
    residual, jacobian, low, high = problems(seed)
    slope = np.random.default_rng(1000 + seed).standard_normal(40)
    step, left, factor = stepped(Linearised(residual, jacobian, 1e9 * low - 1e9, 1e9 * high + 1e9), slope, ANY_FACTOR)
    columns = np.column_stack([jacobian, slope])
    best = np.linalg.lstsq(columns, -residual)[0]
    assert np.append(step, factor) == pytest.approx(best, rel=1e-6)
    assert left == pytest.approx(float(np.sum((residual + columns @ best) ** 2)), rel=1e-9)


@pytest.mark.parametrize("reach", [ANY_FACTOR, UP_TO_ONE, (1.0, 1.0 + 1e-9)])
def test_a_step_within_bounds_is_the_best_there_is(reach: tuple[float, float]) -> None:
    """The bounds of most of these problems are reached. An effect that is held is one whose factor hardly may differ from 1."""
    reached = 0
    for seed in range(60):
        residual, jacobian, low, high = problems(seed)
        slope = np.random.default_rng(1000 + seed).standard_normal(40)
        step, left, factor = stepped(Linearised(residual, jacobian, low, high), slope, reach, held=reach[0] == 1.0)
        columns = np.column_stack([jacobian, slope])
        best = lsq_linear(columns, -residual, (np.append(low, reach[0]), np.append(high, reach[1])), tol=1e-14)
        assert np.all(step >= low * (1.0 + 1e-12)) and np.all(step <= high * (1.0 + 1e-12))
        assert reach[0] <= factor <= reach[1]
        told = np.append(step, factor)
        assert left == pytest.approx(float(np.sum((residual + columns @ told) ** 2)), rel=1e-8)
        reached += bool(np.any(best.active_mask))
        assert left == pytest.approx(2.0 * best.cost, rel=1e-6), f"problem {seed}"
    assert reached > 30


@pytest.fixture(scope="module")
def lagged() -> Refit:
    """The drive without the lag of 30 ms at the speed's meter that its records have."""
    return plain(experiments(lag=0.03))


def test_a_hidden_lag_is_best_at_its_place(lagged: Refit) -> None:
    found = listed(lagged, ("lag", "gain", "limit", "offset"), ("wm", "err", "torque", "drag"))
    told = expansion_model(lagged, found).screen(found, "screen")
    best = told.scores[0]
    assert found[best.candidate].label == "lag at wm"
    assert found[best.candidate].probes[best.probe].values["T"] == pytest.approx(0.03, rel=0.7)
    falls = {found[k].label: s.fall for k, s in told.best().items()}
    # The refit leaves noise alone: no fall is larger than what is left before.
    most = lagged.chi2 - 0.8 * lagged.rows
    assert 0.5 * most < falls["lag at wm"] < lagged.chi2
    assert falls["lag at wm"] > 1.2 * max(v for n, v in falls.items() if n != "lag at wm")
    assert told.p(best.fall) == pytest.approx(1.0 / 201.0) and np.quantile(told.largest, 0.99) < best.fall


def test_gains_that_hide_an_effect_are_left_for_those_given() -> None:
    """A lag of half the loop's period: the gains fall to a fifth, and with them others answer more like the records."""
    first = plain(experiments(lag=0.1))
    found = listed(first, ("lag", "gain", "limit", "offset", "delay", "second-order", "deadband"))
    given = with_given_gains(first)
    assert given is not None
    ranks = [found[k].label for k in expansion_model(first, found).screen(found, "given", point=given).best()]
    assert ranks.index("lag at wm") < 5
    # The answers from beside the fitted gains tell it, too: those at other unknowns need a run for the best of them only.
    stand = expansion_model(first, found)
    known = stand.screen(found, "fitted")
    promising = [found[k].label for k in stand.promising(known, found, given)]
    assert promising.index("lag at wm") < 5 and len(promising) < len(known.best())


def test_a_sine_that_begins_at_its_peak_is_no_state_to_begin_from(lagged: Refit) -> None:
    """The integrator behind `err` rests at no sine: beside one that begins at its peak it would start far off. Its answer is that of one
    a quarter of a period earlier, but for the transient at the start."""
    (sine,) = listed(lagged, ("disturbance",), ("err",))
    wave = {"amplitude": 0.05, "frequency": 5.0}
    sine = replace(sine, probes=()).with_sizes([wave | {"phase": p} for p in (0.0, np.pi / 2)], like=sine.probes)
    screen = expansion_model(lagged, (sine,)).screen((sine,), "both phases")
    assert screen.size[0, 1] == pytest.approx(screen.size[0, 0], rel=0.05)


def test_a_run_that_stops_on_its_way_is_not_begun_elsewhere(lagged: Refit, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside levels of the error the integrator rests nowhere: that run begins where the drive rests without them. One that has taken
    all its steps would take them again."""
    (levels,) = listed(lagged, ("quantisation",), ("err",))
    (fine,) = listed(lagged, ("quantisation",), ("outputs.w",))
    fine = replace(fine, probes=()).with_sizes([{"step": 1e-6}], like=fine.probes)
    begun: list[dict[str, float]] = []
    plain_run = Problem.misfits

    def counted(problem: Problem, theta: Array, also: dict[str, float]) -> Array:
        begun.append(also)
        return plain_run(problem, theta, also)

    monkeypatch.setattr(Problem, "misfits", counted)
    found = (replace(levels, probes=levels.probes[:1]), fine)
    screen = expansion_model(lagged, found).screen(found, "two")
    assert "step-limit" in screen.failures[1] and {s.candidate for s in screen.scores} == {0}
    assert len(begun) == 3


def test_sizes_that_were_run_are_not_run_again(lagged: Refit, monkeypatch: pytest.MonkeyPatch) -> None:
    found = listed(lagged, ("lag", "limit"), ("wm", "err"))
    stand = expansion_model(lagged, found)
    known = stand.screen(found, "once")
    more = tuple(c.with_sizes([{"T": 0.0123}]) if c.effect == "lag" else c for c in found)
    runs: list[tuple[int, int]] = []
    plain_run = _Batch.__call__

    def counted(runner: _Batch, column: tuple[int, int]) -> Array:
        runs.append(column)
        return plain_run(runner, column)

    monkeypatch.setattr(_Batch, "__call__", counted)
    again = stand.screen(more, "again", known=known)
    assert sorted(runs) == sorted((k, len(c.probes)) for k, c in enumerate(found) if c.effect == "lag")
    assert {s.candidate for s in again.scores} == {k for k, _ in runs}


def test_a_sketch_keeps_products() -> None:
    random = np.random.default_rng(5)
    one, other = random.standard_normal((2, 20_000))
    sketch = Sketch(one.size)
    mixed = one + 0.5 * other
    exact = mixed @ one / np.linalg.norm(mixed) / np.linalg.norm(one)
    a, b = sketch(mixed), sketch(one)
    assert a.size == SKETCHED and a @ b / np.linalg.norm(a) / np.linalg.norm(b) == pytest.approx(exact, abs=0.03)
    assert Sketch(100)(one[:100]).tolist() == one[:100].tolist()
    assert np.isfinite(Sketch(3).kept(np.array([1e300, -1e300, 1.0]))).all()


def test_the_largest_score_under_noise_is_that_of_a_direct_computation(lagged: Refit) -> None:
    """Of one size of one effect, whose score under white noise is chi2 with one degree of freedom."""
    (lag,) = listed(lagged, ("lag",), ("wm",))
    only = replace(lag, probes=lag.probes[:1])
    setup = expansion_model(lagged, (lag,), bootstraps=3000).setup
    told = screened(setup, [only])
    nominal = setup.nominal
    placed = apply_effects(model(), [only.use(only.probes[0])])
    exact = ModelSimulator(placed, Tolerance(rtol=1e-9, atol=1e-11))
    there = replace(nominal.problem, simulator=exact).blocks(nominal.theta, derivatives=False)
    answer = nominal.residual - np.concatenate([b.residual for b in there])
    left = nominal.projected(answer[:, None])[:, 0]
    direct = (left @ setup.noise) ** 2 / (left @ left)
    assert told.largest == pytest.approx(direct, rel=0.03, abs=3e-3)  # runs of a first look are exact to 1e-5
    assert told.size[0, 0] == pytest.approx(float(answer @ answer), rel=1e-3)
    assert told.left[0, 0] == pytest.approx(float(left @ left), rel=1e-3)
    assert kstest(told.largest, chi2(1).cdf).pvalue > 0.01
    for chance in (0.1, 0.01):
        assert np.quantile(told.largest, 1.0 - chance) == pytest.approx(chi2(1).ppf(1.0 - chance), rel=0.12)


def test_of_many_candidates_the_largest_score_is_that_of_any(lagged: Refit) -> None:
    found = listed(lagged, ("lag", "gain"), ("wm", "err", "drag"))
    setup = expansion_model(lagged, found).setup
    alone = [screened(setup, [c]).largest for c in found]
    assert screened(setup, found).largest == pytest.approx(np.max(alone, axis=0), rel=0.01)


def course(effect: str, values: dict[str, float]) -> Array:
    """Return what an effect in a model by itself adds to a large signal that turns, beside another."""
    time = np.linspace(0.0, 1.0, 401)
    u, source = 1.3 * np.sin(9.0 * time) + 0.3 + 0.4 * time, 1.0 + 0.8 * np.cos(5.0 * time)
    alone = equations(effect, tuple(values)).with_values(values)
    driven = {
        "u": InputSignal.corners(list(zip(time, u, strict=True))),
        "source": InputSignal.corners(list(zip(time, source, strict=True))),
        "x": InputSignal.corners(list(zip(time, u, strict=True))),
    }
    run = simulate(alone, Experiment(time, "course", inputs=FrozenMap(driven)), outputs=["y"])
    return np.asarray(run["y"]) - u


@pytest.mark.parametrize("effect", [e.name for e in effects().values() if not e.needs_expression])
def test_what_is_said_to_be_in_proportion_to_a_size_is_so(effect: str) -> None:
    """And what is so is said to be: twice the distance of the size from nothing adds twice as much, and none of it nothing."""
    entry = effects()[effect]
    sizes = dict(entry.example)
    once = course(effect, sizes)
    assert np.abs(once).max() > 1e-4

    def is_so(name: str) -> bool:
        neutral = entry.parameters[name].neutral
        if entry.parameters[name].fixed or not isinstance(neutral, float) or not np.isfinite(neutral):
            return False
        twice = course(effect, {**sizes, name: neutral + 2.0 * (sizes[name] - neutral)})
        return bool(np.abs(twice - 2.0 * once).max() < 1e-6 * np.abs(once).max())

    assert is_proportional(Form(effect, tuple(sizes))) == any(is_so(n) for n in sizes)


def test_a_first_look_takes_a_size_in_the_middle_and_the_one_nearest_to_nothing() -> None:
    """A slow filter in a loop bends all of it, and hides how well a quick one does: the demo's is one of 343 rad/s."""
    probes = tuple(
        Probe("second-order", FrozenMap({"wn": wn, "zeta": 0.7}), FrozenMap({"wn": (1.0, 2000.0), "zeta": (0.1, 2.0)}))
        for wn in (616.0, 20.0, 90.0, 300.0)
    )
    assert set(_few(CandidateEffect("second-order", ("wm",), probes))) == {0, 2}
