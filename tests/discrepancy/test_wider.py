"""Where the first refits miss: periods that have to be met, gains that took an effect's place, ties the held-out data break."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hvdc_ident import InputSignal, simulate
from hvdc_ident.data import Array
from hvdc_ident.discrepancy import DiagnosisOptions, diagnose
from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.hypothesis import Refit, RefitJob, refit_job, refitted, with_given_gains
from hvdc_ident.discrepancy.movable import Form, movable
from hvdc_ident.discrepancy.options import SearchContext
from hvdc_ident.discrepancy.residual_checks import is_louder_after_breaks
from hvdc_ident.discrepancy.score import is_clear
from hvdc_ident.effects import Probe, apply_effects
from hvdc_ident.immutable import FrozenMap
from tests.discrepancy.cases import EVENT, FREE, SIGMA, TIME, TRUE, experiments, model
from tests.discrepancy.meters import noisy, records
from tests.discrepancy.refits import answered, beside, expanded, plain

pytestmark = pytest.mark.nightly

PERIOD = 0.033
WINDOW = 0.05


def beginning(before: Refit, effect: str, at: str, values: dict[str, float]) -> RefitJob:
    """The refit of the drive with one effect, from a size."""
    return beside(before, effect, at, values, dict.fromkeys((n for n in values if n != "compute"), (1e-3, 0.3)))


def sampled(inputs: dict[str, InputSignal]) -> Array:
    """Speed and torque where the controller sees the speed every PERIOD, computed from one instant to the next by scipy."""
    ref = inputs.get("ref") or (lambda t: np.full_like(np.asarray(t, float), 1.0))
    load = inputs.get("load") or (lambda t: np.zeros_like(np.asarray(t, float)))
    jumps = [float(b) for i in inputs.values() for b in i.breaks]
    instants = np.unique(np.round([*np.arange(0.0, 1.3, PERIOD), *jumps, TIME[-1] + 1e-3], 12))
    state, held = np.array([1.0, TRUE["b"]]), 1.0
    rows = np.zeros((TIME.size, 2))
    for a, b in pairwise(instants):
        if abs(a / PERIOD - round(a / PERIOD)) < 1e-9:
            held = state[0]

        def slopes(t: float, s: Array, seen: float = held) -> list[float]:
            err = float(ref(t)) - seen
            torque = TRUE["Kp"] * err + s[1]
            return [(torque - TRUE["b"] * s[0] - float(load(t))) / TRUE["J"], TRUE["Ki"] * err]

        inner = (a <= TIME) & (b > TIME)
        done = solve_ivp(slopes, (a, b - 1e-12), state, t_eval=[*TIME[inner], b - 1e-12], rtol=1e-9, atol=1e-11)
        rows[inner, 0] = done.y[0, :-1]
        rows[inner, 1] = TRUE["Kp"] * (np.asarray(ref(TIME[inner]), float) - held) + done.y[1, :-1]
        state = done.y[:, -1]
    return rows


def searched(before: Refit, effects: tuple[str, ...], places: tuple[str, ...]) -> list[Refit]:
    """The refits of some effects at some places beside a model, the best first."""
    search = SearchContext(effects, places, FrozenMap(), DiagnosisOptions(bootstraps=100), seed=0)
    found = expanded(search, before)
    assert found.trials, found.why
    return sorted((t.refit for t in found.trials), key=lambda r: r.chi2)


def test_a_period_is_met_that_no_slope_leads_to() -> None:
    first = plain(records(sampled))
    job = beginning(first, "sample-hold", "wm", {"Ts": 0.039, "compute": 0.0})
    stuck, refit = refitted(job), searched(first, ("sample-hold",), ("wm",))[0]
    assert abs(stuck.values[job.placed[0].names["Ts"]] / PERIOD - 1.0) > 0.1
    assert refit.sizes(refit.placed[-1])["Ts"] == pytest.approx(PERIOD, rel=2e-3)
    assert refit.chi2 == pytest.approx(refit.rows, rel=0.1)


def test_a_level_that_stands_right_may_be_another_number_of_steps_from_nothing() -> None:
    """The speed in steps of 0.01, resting at the hundredth: with steps of 1/99 its level stands there too, the others do not."""
    rounded = []
    for e in answered(model(), experiments(), seed=0):
        assert e.measured is not None
        clean = simulate(model(), e, TRUE, outputs=tuple(SIGMA)).trajectory
        noise = e.measured.values - clean.values
        stepped = np.column_stack([0.01 * np.round(clean["w"] / 0.01), clean["torque"]])
        rounded.append(replace(e, measured=replace(e.measured, values=stepped + 0.3 * noise), noise=FrozenMap()))
    first = plain(rounded)
    job = beside(first, "quantisation", "outputs.w", {"step": 1.0 / 99.0}, {"step": (1e-3, 0.1)})
    refit = searched(first, ("quantisation",), ("outputs.w",))[0]
    assert refit.sizes(refit.placed[-1])["step"] == pytest.approx(0.01, rel=1e-4)
    assert refit.chi2 < 0.2 * refitted(job).chi2


def test_places_and_sizes_of_one_form_share_a_model() -> None:
    """And where the effect is moved there, or put in, a refit comes to the same end."""
    before = plain(experiments(lag=0.03))
    sizes = [Probe("lag", FrozenMap({"T": t}), FrozenMap({"T": (1e-3, 0.3)})) for t in (0.01, 0.05)]
    lags = {p: CandidateEffect("lag", (p,), tuple(sizes)) for p in ("wm", "drag")}
    moving = movable(model(), Form("lag", ("T",)), tuple(lags), ())
    jobs = {(p, k): refit_job(before, c, k, 1.0, before.theta, moving) for p, c in lags.items() for k in (0, 1)}
    assert {id(j.model) for j in jobs.values()} == {id(moving.model)}
    for (place, size), moved in jobs.items():
        end, put_in = refitted(moved), refitted(refit_job(before, lags[place], size, 1.0, before.theta))
        assert end.chi2 == pytest.approx(put_in.chi2, rel=1e-6)
    assert refitted(jobs["wm", 0]).chi2 == pytest.approx(refitted(jobs["wm", 1]).chi2, rel=1e-6)


def test_what_answers_within_a_few_rows_is_louder_after_breaks() -> None:
    still = [plain(experiments(seed=seed)).nominal() for seed in range(5)]
    assert not any(is_louder_after_breaks(n) for n in still)
    there = apply_effects(model(), [{"effect": "lag", "at": ["ref"], "parameters": {"T": 0.004}}])
    quick = plain(answered(there, experiments(), seed=0)).nominal()
    assert is_louder_after_breaks(quick)
    # However loud everything is: only where it is loud counts.
    louder = [
        replace(n, noise=FrozenMap({o: replace(s, std=0.3 * (s.std or 0.0)) for o, s in n.noise.items()}))
        for n in still
    ]
    assert not any(is_louder_after_breaks(n) for n in louder)


def test_gains_that_moved_are_given_back_as_another_start() -> None:
    before = plain(experiments(lag=0.03))
    moved = replace(before, theta=np.array([0.7, 11.0]))
    given = with_given_gains(moved)
    assert given is not None and given.tolist() == [f.start for f in FREE]
    there = replace(before, theta=np.array([f.start for f in FREE]))
    assert with_given_gains(there) is None


def test_parameters_that_are_vague_one_by_one_are_clear_together() -> None:
    before = plain(experiments(lag=0.03))
    refit = refitted(beginning(before, "lead-lag", "wm", {"T1": 0.02, "T2": 0.05}))
    names = [refit.placed[0].names[n] for n in ("T1", "T2")]
    at = [refit.problem.names.index(n) for n in names]
    jacobian = np.vstack([b.jacobian for b in refit.problem.blocks(refit.theta)])
    covariance = np.linalg.inv(jacobian.T @ jacobian)[np.ix_(at, at)]
    way = np.array([1.0, -1.0])
    expected = abs(float(way @ refit.theta[at])) / float(np.sqrt(way @ covariance @ way))
    assert refit.apart[0] == pytest.approx(expected, rel=0.2)  # autocorrelation, where there is some, widens it
    assert is_clear(refit, 0)


def ramped(inputs: dict[str, InputSignal]) -> Array:
    """Speed and torque where a moving mean stands behind the set-point: a step of it becomes a ramp of WINDOW."""
    load = inputs.get("load") or (lambda t: 0.0)
    steps = []
    if "ref" in inputs:
        points = inputs["ref"]
        jumps = sorted({float(b) for b in points.breaks if 0 < b < TIME[-1]})
        steps = [(b, float(points(b + 1e-9)) - float(points(b - 1e-9))) for b in jumps]

    def ref(t: float) -> float:
        return 1.0 + sum(size * float(np.clip((t - at) / WINDOW, 0.0, 1.0)) for at, size in steps)

    def slopes(t: float, s: Array) -> list[float]:
        err = ref(t) - s[0]
        torque = TRUE["Kp"] * err + s[1]
        return [(torque - TRUE["b"] * s[0] - float(load(t))) / TRUE["J"], TRUE["Ki"] * err]

    done = solve_ivp(slopes, (0.0, TIME[-1]), [1.0, TRUE["b"]], t_eval=TIME, rtol=1e-9, atol=1e-11, max_step=2e-3)
    err = np.array([ref(t) for t in TIME]) - done.y[0]
    return np.column_stack([done.y[0], TRUE["Kp"] * err + done.y[1]])


def test_of_two_that_explain_the_fitted_steps_alike_the_held_out_one_decides() -> None:
    """Behind one step a moving mean and a rate limit are the same ramp; behind a step of another size they are not."""
    few = tuple(e for e in records(ramped) if e.name != "fit-2")
    short = few[0].with_(inputs=FrozenMap({"ref": InputSignal.step(EVENT, 1.0, 1.6)}))
    few = (short.with_(measured=noisy(ramped(dict(short.inputs)), np.random.default_rng(1))), few[1])
    found = diagnose(model(), few, FREE, effects=["rate-limit", "window-mean"], places=["ref"], seed=0,
                     options=DiagnosisOptions(fallback=False))  # fmt: skip
    assert found.verdict in ("named", "ambiguous")
    best = found.effects[0]
    assert best.effect == "window-mean"
    assert best.parameters["T"].value == pytest.approx(WINDOW, rel=0.03)


def test_a_kind_of_delay_is_refitted_beside_one_that_is_right_to_first_order() -> None:
    """A window, of which a delay, or a lag, explains most; the one that explains less is left on its way."""
    first = plain(records(ramped))
    ends = searched(first, ("delay", "window-mean", "lag"), ("ref",))
    assert ends[0].placed[-1].candidate.effect == "window-mean" and len(ends) == 2
    assert ends[0].sizes(ends[0].placed[-1])["T"] == pytest.approx(WINDOW, rel=0.02)
    late = refitted(beside(first, "delay", "ref", {"T": WINDOW / 2}, {"T": (1e-3, 0.3)}))
    assert ends[0].chi2 < late.chi2


def test_the_same_effect_elsewhere_is_refitted_where_the_best_is_on_a_bound() -> None:
    """A controller that hardly sees its set-point: small, it leaves the trace of feedback times k; large, gains would be off bounds."""
    deaf = apply_effects(
        model(),
        [{"effect": "coupling", "at": ["err"], "parameters": {"k": -0.9}, "from": "ref"}],
    )
    ends = searched(plain(answered(deaf, experiments(), seed=0)), ("coupling",), ("wm", "err"))
    there = {(r.placed[-1].candidate.at, r.placed[-1].candidate.source): r for r in ends}
    told, seen = there[("err",), "ref"], there[("wm",), "w"]
    assert told.chi2 < 1.2 * told.rows < seen.chi2


def test_of_parameters_that_only_a_combination_is_told_of_that_is_judged() -> None:
    """Where what a loss is of has one level, its three parts are one offset: as clear as an offset is, and no less."""
    loaded = experiments()[1]
    assert loaded.measured is not None
    shifted = replace(loaded.measured, values=np.add(loaded.measured.values, [0.02, 0.0]))
    first = plain([loaded.with_(measured=shifted)])
    one = refitted(beside(first, "offset", "outputs.w", {"c": 0.01}, {"c": (-0.1, 0.1)}))
    parts = dict.fromkeys("abc", 0.005)
    three = refitted(beside(first, "loss", "outputs.w", parts, dict.fromkeys("abc", (-0.1, 0.1)), source="ref"))
    assert sum(three.sizes(three.placed[0]).values()) == pytest.approx(-one.sizes(one.placed[0])["c"], rel=1e-3)
    assert is_clear(one, 0) and one.apart[0] > 20
    assert three.apart[0] == pytest.approx(one.apart[0], rel=0.05)


def test_a_size_that_has_to_be_met_is_met_at_its_place_among_several() -> None:
    """A sampler of the speed; at the error it samples the set-point too, and explains less."""
    period = PERIOD * 1.0001  # no sample falls on a break of the inputs
    there = apply_effects(model(), [{"effect": "sample-hold", "at": ["wm"], "parameters": {"Ts": period}}])
    first = plain(answered(there, experiments(), seed=0))
    near = refitted(beginning(first, "sample-hold", "err", {"Ts": period, "compute": 0.0}))
    best = searched(first, ("sample-hold",), ("wm", "err", "ref"))[0]
    assert best.placed[-1].candidate.at == ("wm",)
    assert best.chi2 < 1.2 * best.rows < near.chi2
    assert best.sizes(best.placed[-1])["Ts"] == pytest.approx(period, rel=1e-4)


def test_a_size_of_levels_is_met_that_no_slope_leads_to() -> None:
    """Where a gain moves rows go over an edge, and no slope tells of it: begun a little off, a refit is stuck at once."""
    there = apply_effects(model(), [{"effect": "quantisation", "at": ["wm"], "parameters": {"step": 0.03}}])
    first = plain(answered(there, experiments(), seed=0))
    stuck = refitted(beside(first, "quantisation", "wm", {"step": 0.0302}, {"step": (1e-3, 0.3)}))
    assert stuck.chi2 > 5.0 * stuck.rows
    free = searched(first, ("quantisation",), ("wm",))[0]
    assert free.chi2 < 1.2 * free.rows
    assert free.sizes(free.placed[-1])["step"] == pytest.approx(0.03, rel=1e-4)
    assert free.values["Ki"] == pytest.approx(TRUE["Ki"], rel=0.005)


def test_a_level_that_a_signal_never_reaches_is_left_for_one_that_it_does() -> None:
    """Above what the torque comes to, no slope leads to the level of its meter."""
    level, bounds = 0.9, (0.1, 6.0)
    first = plain(experiments(meter=lambda torque: np.clip(torque, -level, level)))
    job = beside(first, "limit", "outputs.torque", {"level": 3.0}, {"level": bounds})
    stuck, found = refitted(job), searched(first, ("limit",), ("outputs.torque",))[0]
    assert stuck.values[job.placed[-1].names["level"]] == pytest.approx(3.0)
    assert stuck.chi2 == pytest.approx(first.chi2, rel=1e-6)
    assert found.sizes(found.placed[-1])["level"] == pytest.approx(level, rel=2e-3)
    assert found.values["Kp"] == pytest.approx(TRUE["Kp"], rel=2e-3)
    assert found.chi2 / found.rows == pytest.approx(1.0, abs=0.1)
