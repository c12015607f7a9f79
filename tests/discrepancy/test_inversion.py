"""What the records tell of a slot's signal, and the closer look that goes by it, against records computed by scipy."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from cases import EVENT, FREE, RUNS, SIGMA, TIME, TRUE, corners, experiments, model
from refits import plain
from scipy.integrate import solve_ivp
from scipy.stats import norm

from hvdc_ident import Experiment, InputSignal, Trajectory
from hvdc_ident.data import Array
from hvdc_ident.discrepancy import DiagnosisOptions, diagnose, proposals, rounds
from hvdc_ident.discrepancy.context import Round, SearchContext
from hvdc_ident.discrepancy.latent import TRIED, Inversion
from hvdc_ident.discrepancy.nominal import Nominal
from hvdc_ident.discrepancy.proposals import by_latent, by_score, by_score_elsewhere, views_of
from hvdc_ident.discrepancy.rounds import one_round
from hvdc_ident.discrepancy.scores import Whitening, runs
from hvdc_ident.discrepancy.signatures.response import Along
from hvdc_ident.effects import SignalScales, effects
from hvdc_ident.immutable import FrozenMap

STEP = 0.11


@pytest.fixture(scope="module")
def levels() -> tuple[tuple[Experiment, ...], dict[str, Array]]:
    """Records of the drive whose torque acts in levels of STEP, and by experiment the torque before it is rounded.

    A loop between two levels turns about their edge: the edges have a width here, as they have in the package.
    """
    random = np.random.default_rng(0)
    found, asked = [], {}
    for name, (role, moves) in RUNS.items():
        inputs = {n: InputSignal.corners(corners({"ref": 1.0, "load": 0.0}[n], m)) for n, m in moves.items()}
        y = _rounded(inputs)
        asked[name] = y[:, 1].copy()
        y[:, 1] = [_level(u) for u in y[:, 1]]
        seen = y + random.standard_normal(y.shape) * list(SIGMA.values())
        measured = Trajectory(TIME, seen, tuple(SIGMA), ("", ""))
        found.append(
            Experiment(
                TIME, name, inputs=FrozenMap(inputs), measured=measured, noise=FrozenMap(SIGMA), event=EVENT, role=role
            )
        )
    return tuple(found), asked


def _level(u: float) -> float:
    whole = np.floor(u / STEP)
    return float(STEP * (whole + np.clip((u / STEP - whole - 0.5) / 2e-3 + 0.5, 0.0, 1.0)))


def _rounded(inputs: dict[str, InputSignal]) -> Array:
    """(n, 2) speed and torque, from a start that was waited for."""

    def given(name: str, t: float) -> float:
        return float(inputs[name](t)) if name in inputs else {"ref": 1.0, "load": 0.0}[name]

    def slopes(t: float, s: Array, at: float | None = None) -> list[float]:
        err = given("ref", t if at is None else at) - s[0]
        torque = _level(TRUE["Kp"] * err + s[1])
        return [
            (torque - TRUE["b"] * s[0] - given("load", t if at is None else at)) / TRUE["J"],
            TRUE["Ki"] * err,
        ]

    settings = {"method": "LSODA", "rtol": 1e-7, "atol": 1e-9, "max_step": 2e-3}
    state = solve_ivp(lambda t, s: slopes(t, s, 0.0), (0.0, 20.0), [1.0, TRUE["b"]], method="Radau", rtol=1e-8).y[:, -1]
    jumps = sorted({float(b) for i in inputs.values() for b in i.breaks if 0 < b < TIME[-1]})
    rows = np.zeros((TIME.size, 2))
    for a, b in pairwise([0.0, *jumps, float(TIME[-1]) + 1e-6]):
        inner = (a <= TIME) & (b > TIME)
        done = solve_ivp(slopes, (a, b - 1e-9), state, t_eval=[*TIME[inner], b - 1e-9], **settings)
        err = np.array([given("ref", t) for t in TIME[inner]]) - done.y[0, :-1]
        rows[inner] = np.column_stack([done.y[0, :-1], TRUE["Kp"] * err + done.y[1, :-1]])
        state = done.y[:, -1]
    return rows


def test_falls_are_those_of_the_whole_linear_problem() -> None:
    """By the whitened answers themselves and a regression on everything, without the directions."""
    first = plain(experiments(lag=0.03))
    nominal = first.nominal()
    paths = {n: p for n, p in runs(model(), nominal).items() if isinstance(p, Along)}
    inverse = Inversion.of(nominal, paths, "wm")
    knots = inverse.directions.shape[0]
    random = np.random.default_rng(3)
    put = np.cumsum(random.standard_normal((knots, 5)), axis=0) * 1e-3
    halves = np.split(put, 2)
    answers = []
    for (name, path), part in zip(paths.items(), halves, strict=True):
        e = next(e for e in nominal.problem.fitted_experiments if e.name == name)
        at = np.linspace(path.time[0], path.time[-1], part.shape[0])
        d = np.array([np.interp(path.time, at, c) for c in part.T]).T
        whitening = Whitening.of([b for b in nominal.blocks if b.experiment == name], e, nominal)
        answers.append(whitening(path.answer(["wm"], d[None])[1]))
    rows = np.vstack(answers)
    was = float(np.sum(nominal.projected(nominal.residual[:, None]) ** 2))
    left = [float(np.sum(nominal.projected((nominal.residual - r)[:, None]) ** 2)) for r in rows.T]
    falls, scores, _ = inverse.falls(put, np.zeros((inverse.strength.size, 1)))
    assert falls == pytest.approx(was - np.array(left), rel=1e-6, abs=1e-6 * was)
    freed = nominal.projected(rows)
    best = (freed.T @ nominal.residual) ** 2 / np.sum(freed**2, axis=0)
    assert scores == pytest.approx(np.where(freed.T @ nominal.residual > 0, best, 0.0), rel=1e-4, abs=1e-4)


def test_nothing_is_added_where_the_records_ask_for_nothing() -> None:
    first = plain(experiments())
    paths = {n: p for n, p in runs(model(), first.nominal()).items() if isinstance(p, Along)}
    inverse = Inversion.of(first.nominal(), paths, "torque")
    # What noise asks for is smaller than a hundredth of what moves.
    for own, told in zip(inverse.own, inverse.told, strict=True):
        assert np.abs(own - told).max() < 0.01 * np.ptp(own)


def test_the_records_know_a_slot_better_than_gains_that_are_biased(
    levels: tuple[tuple[Experiment, ...], dict[str, Array]],
) -> None:
    records, asked = levels
    first = plain(records)
    paths = {n: p for n, p in runs(model(), first.nominal()).items() if isinstance(p, Along)}
    inverse = Inversion.of(first.nominal(), paths, "torque")
    for k, (name, path) in enumerate(paths.items()):
        at = np.flatnonzero(path.rows >= 0)
        truth = asked[name][path.rows[at]]
        own, told = (np.sqrt(np.mean((s[k][at] - truth) ** 2)) for s in (inverse.own, inverse.told))
        assert told < 0.6 * own


def test_a_step_is_met_among_hundreds(levels: tuple[tuple[Experiment, ...], dict[str, Array]]) -> None:
    found = diagnose(
        model(), levels[0], FREE, effects=["quantisation", "deadband", "backlash", "lag", "gain"], seed=0,
        options=DiagnosisOptions(fallback=False),
    )  # fmt: skip
    assert found.verdict == "named", found.text
    assert (found.effects[0].effect, found.effects[0].at) == ("quantisation", ("torque",))
    assert found.effects[0].parameters["step"].value == pytest.approx(STEP, rel=2e-3)


@pytest.mark.parametrize("middle", [0.0, 1.0, 10.0])
def test_of_the_levels_of_a_closer_look_one_puts_its_marks_where_any_step_does(middle: float) -> None:
    time = np.linspace(0.0, 1.0, 101)
    signal = SignalScales.of([time], [middle + 0.5 * np.sin(7 * time)])
    scan = effects()["quantisation"].parameters["step"].grid
    assert scan is not None
    steps = signal.peak / np.array(scan(signal))
    assert 0.5 * signal.range < steps.max() < 2.0 * signal.range and steps.min() < signal.range / 35
    assert steps.size < 5000
    u = np.linspace(signal.low, signal.high, 50)[:, None]
    for step in signal.range / np.random.default_rng(0).uniform(2.0, 35.0, 40):
        apart = u / step - u / steps
        # Levels may be counted otherwise: what shows is where the marks lie.
        apart -= np.round(apart[-1:])
        assert np.abs(apart).max(axis=0).min() < 0.13


def test_one_slot_of_a_run_answers_as_among_all() -> None:
    nominal = plain(experiments(lag=0.03)).nominal()
    path = runs(model(), nominal)["fit-1"]
    assert isinstance(path, Along)
    d = np.random.default_rng(0).standard_normal((1, path.time.size, 3))
    alone = path.only("err")
    assert alone.slots == ("err",) and set(alone.values) == {"err"}
    for all_of_it, one in zip(path.answer(["err"], d), alone.answer(["err"], d), strict=True):
        assert np.array_equal(all_of_it, one)


def test_noise_is_scored_without_what_the_parameters_of_each_view_make_good(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else it would score what the parameters do at the gains as given, and every effect would look like chance."""
    seen, scored = [], proposals._at_place
    monkeypatch.setattr(proposals, "_at_place", lambda job: (seen.append(job), scored(job))[1])
    first = plain(experiments(lag=0.1))
    search = SearchContext(("deadband",), ("wm", "err"), FrozenMap(), DiagnosisOptions(bootstraps=100), seed=0)
    found = one_round(search, first, 1)
    assert {tuple(job.view.nominal.theta) for job in seen} == {
        tuple(v.nominal.theta) for v in views_of(found, first.nominal())()
    }
    assert len({tuple(job.view.nominal.theta) for job in seen}) == 2
    for job in seen:
        assert np.abs(job.view.nominal.basis.T @ job.noise).max() < 1e-9 * np.linalg.norm(job.noise)


def test_no_proposal_promises_more_than_the_model_leaves() -> None:
    """At the gains as given more is left, so a fall from there is no fall from what the refitted model leaves."""
    first = plain(experiments(lag=0.03))
    search = SearchContext(("lag", "delay"), ("wm", "err"), FrozenMap(), DiagnosisOptions(bootstraps=100), seed=0)
    found, nominal = one_round(search, first, 1), first.nominal()
    views = views_of(found, nominal)
    left = [float(np.sum(v.nominal.projected(v.nominal.residual[:, None]) ** 2)) for v in views()]
    assert left[1] > 1.2 * left[0]
    _, picks = by_latent(search, found, views, 1, lambda _: True)
    assert 0.5 * left[0] < max(p.fall for p in picks) <= left[0]


def test_gains_that_hide_an_effect_are_left_for_those_given(monkeypatch: pytest.MonkeyPatch) -> None:
    """A lag of half the loop's period: the gains fall to a fifth, and with them others answer more like the records."""
    ranks = {}

    def looked_at(search: SearchContext, opened: Round, nominal: Nominal, number: int) -> None:
        views = views_of(opened, nominal)
        own, given = by_score(opened), by_score_elsewhere(search, opened, views)
        labels = {n: [opened.candidates[p.candidate].label for p in v] for n, v in (("own", own), ("given", given))}
        ranks.update({n: v.index("lag at wm") for n, v in labels.items()})
        assert {p.gains for p in given} == {tuple(views()[1].nominal.theta)} and {p.gains for p in own} == {()}
        # What noise is judged by stays what it was.
        assert max(p.score for p in given) <= max(p.score for p in own)
        raise StopIteration

    monkeypatch.setattr(rounds, "explored", looked_at)
    first = plain(experiments(lag=0.1))
    with pytest.raises(StopIteration):
        one_round(SearchContext("all", None, FrozenMap(), DiagnosisOptions(bootstraps=100), seed=0), first, 1)
    assert ranks["given"] < 5 < ranks["own"]


def test_the_evidence_of_a_latent_input_is_that_of_a_gaussian_with_its_prior() -> None:
    """Against the marginal likelihood computed from the covariance of the residual itself, by scipy."""
    nominal = plain(experiments(lag=0.03)).nominal()
    paths = {n: p for n, p in runs(model(), nominal).items() if isinstance(p, Along)}
    latent = Inversion.of(nominal, paths, "wm")
    told = float(latent.log_evidence(latent.wanted[:, None])[0])
    likely = []
    for size in TRIED / latent.strength[0]:
        spread = np.sqrt(1.0 + (size * latent.strength) ** 2)
        likely.append(norm.logpdf(latent.wanted, scale=spread).sum() - norm.logpdf(latent.wanted).sum())
    assert told == pytest.approx(max(likely), rel=1e-9) and told > 100.0
    assert latent.log_evidence(np.zeros((latent.strength.size, 1)))[0] == pytest.approx(0.0, abs=1e-6)
