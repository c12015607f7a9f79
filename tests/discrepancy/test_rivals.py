"""What is refitted beside what, what may be told from what, and when what is left is noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from cases import FREE, SIGMA, TRUE, experiments, model
from refits import answered, beside, plain

from hvdc_ident import Experiment, simulate
from hvdc_ident.discrepancy import DiagnosisOptions, diagnose
from hvdc_ident.discrepancy.findings.ambiguity import _as_loss
from hvdc_ident.discrepancy.findings.conclusion import Rival
from hvdc_ident.discrepancy.refits.refit import Refit, run
from hvdc_ident.discrepancy.refits.residual_tests import Binned
from hvdc_ident.discrepancy.search.rounds import against, one_round
from hvdc_ident.discrepancy.signatures.candidates import CandidateEffect
from hvdc_ident.discrepancy.trials.context import SearchContext
from hvdc_ident.discrepancy.trials.objections import as_recorded, objections
from hvdc_ident.discrepancy.trials.refitted import excess, like_noise, misses
from hvdc_ident.discrepancy.trials.select import CandidateFit, Pick, behinds, shortlist
from hvdc_ident.discrepancy.verdict.judge import _half_told, _named
from hvdc_ident.effects import Probe, apply_effects
from hvdc_ident.immutable import FrozenMap


@pytest.fixture(scope="module")
def before() -> Refit:
    return plain(experiments())


def of_size(effect: str, at: str, **values: float) -> CandidateEffect:
    """A candidate with one probe, all of whose values are free."""
    bounds = FrozenMap({n: (0.1 * v, 10.0 * v) for n, v in values.items()})
    return CandidateEffect(effect, (at,), (Probe(effect, FrozenMap(values), bounds),))


@pytest.mark.parametrize(
    ("one", "other", "refitted"),
    [
        (of_size("deadband", "load", width=0.1), of_size("deadband", "torque", width=0.1), 1),
        (of_size("deadband", "load", width=0.1), of_size("deadband", "torque", width=0.4), 2),
        (of_size("offset", "load", c=0.1), of_size("offset", "torque", c=0.4), 1),
        (of_size("lead-lag", "wm", T1=0.02, T2=0.01), of_size("lead-lag", "err", T1=0.005, T2=0.01), 2),
        (of_size("lag", "wm", T=0.02), of_size("delay", "wm", T=0.02), 2),
    ],
)
def test_one_trace_is_one_effect_where_it_is_one_at_every_size(
    one: CandidateEffect, other: CandidateEffect, refitted: int
) -> None:
    trace = np.random.default_rng(0).standard_normal(50)
    picks = [Pick(0, 0, 1.0, 400.0), Pick(1, 0, 1.0, 399.0)]
    chosen, same = shortlist(picks, [one, other], np.vstack([trace, -trace]), DiagnosisOptions())
    assert len(chosen) == refitted
    assert {k: [p.candidate for p in twins] for k, twins in same.items()} == ({} if refitted == 2 else {0: [1]})


def test_what_held_out_data_refute_sets_no_mark_for_the_others(before: Refit) -> None:
    def trial(gain: float, told: float) -> CandidateFit:
        return CandidateFit(Pick(0, 0, 1.0, 1.0), before, gain, told)

    # Best on all data; a little ahead on the fitted ones; far ahead there and refuted by the others.
    assert behinds([trial(100.0, 200.0), trial(104.0, 190.0), trial(150.0, 20.0)]) == [0.0, 0.0, 180.0]
    assert behinds([trial(100.0, 200.0), trial(92.0, 195.0)]) == [0.0, 5.0]


@pytest.mark.parametrize(("lag", "loud", "expected"), [(0.0, 1.0, True), (0.0, 1.12, True), (0.03, 1.0, False)])
def test_somewhat_louder_noise_is_noise_and_a_shape_is_not(lag: float, loud: float, expected: bool) -> None:
    told = FrozenMap({n: s / loud for n, s in SIGMA.items()})
    refit = plain([replace(e, noise=told) for e in experiments(lag=lag)])
    assert excess(refit) == (lag > 0.0 or loud > 1.0), "by its size alone it would not be"
    assert like_noise(refit) == expected


@pytest.mark.parametrize(("lag", "loud", "expected"), [(0.0, 1.12, True), (0.001, 1.0, False)])
def test_held_out_records_may_be_somewhat_louder_and_may_have_no_shape(lag: float, loud: float, expected: bool) -> None:
    own, other = experiments(), experiments(lag=lag)
    told = FrozenMap({n: s / loud for n, s in SIGMA.items()})
    held = [replace(o, noise=told) for o in other if o.role == "holdout"]
    refit = plain([*(e for e in own if e.role == "fit"), *held])
    assert misses(refit), "by its size alone it would not be noise"
    assert like_noise(refit) == expected


def clipped(level: float) -> tuple[Experiment, ...]:
    """Records of the drive whose torque is shown no larger than a level, with the noise behind it."""
    random = np.random.default_rng(0)
    found = []
    for e in plainly(experiments()):
        assert e.measured is not None
        y = e.measured.values.copy()
        y[:, 1] = np.clip(y[:, 1], -level, level)
        y += random.standard_normal(y.shape) * list(SIGMA.values())
        found.append(replace(e, measured=replace(e.measured, values=y)))
    return tuple(found)


def plainly(records: Sequence[Experiment]) -> list[Experiment]:
    """The drive's own answers in place of what was recorded."""
    return [replace(e, measured=simulate(model(), e, TRUE, outputs=tuple(SIGMA)).trajectory) for e in records]


def test_held_out_records_that_an_effect_does_not_move_do_not_speak_against_it() -> None:
    records = clipped(1.4)
    held = next(e for e in records if e.role == "holdout")
    assert held.measured is not None and np.abs(held.measured.values[:, 1]).max() < 0.9
    before = plain(records)
    refit = run(beside(before, "limit", "outputs.torque", {"level": 1.45}, {"level": (0.5, 3.0)}))
    assert before.holdout is not None
    worse = {by: replace(refit, holdout=before.holdout + by) for by in (0.002, 0.05)}
    told = {
        by: objections(
            before, CandidateFit(Pick(0, 0, 1.0, 500.0), r, 500.0), 0.005, DiagnosisOptions(), {}, first=True
        )
        for by, r in worse.items()
    }
    assert told[0.002] == ""
    assert "held-out data speak against it" in told[0.05]


def test_somewhat_louder_noise_is_not_looked_at_more_closely() -> None:
    told = FrozenMap({n: s / 1.1 for n, s in SIGMA.items()})
    records = [replace(e, noise=told) for e in experiments(seed=2)]
    assert excess(plain(records)), "by its size alone it would be"
    looks: list[str] = []
    found = diagnose(model(), records, FREE, progress=lambda _done, _total, text: looks.append(text))
    assert found.verdict == "no-evidence"
    assert any("scores of" in look for look in looks) and not any("closer look" in look for look in looks)


def test_a_slow_gap_in_slow_noise_matters_as_it_is_recorded() -> None:
    before = plain(experiments(offset=0.008, noise="ar"))
    refit = run(beside(before, "offset", "drag", {"c": -0.008}, {"c": (-0.1, 0.1)}))
    assert before.holdout is not None and refit.holdout is not None
    assert 0.0 < before.holdout - refit.holdout < DiagnosisOptions().holdout_share, (
        "whitened there is hardly anything to see"
    )
    recorded = [as_recorded(r)[role] for role in ("fit", "holdout") for r in (before, refit)]
    assert recorded[0] > 1.5 * recorded[1] and recorded[2] > 1.5 * recorded[3]
    trial = CandidateFit(Pick(0, 0, 1.0, 500.0), refit, before.chi2 - refit.chi2)
    assert objections(before, trial, 0.005, DiagnosisOptions(), {}, first=True) == ""


def test_where_the_model_does_not_run_at_a_size_it_begins_at_a_spare_one(before: Refit) -> None:
    job = beside(before, "limit", "torque", {"level": 1e-4}, {"level": (1e-5, 10.0)})  # cannot carry the drag
    assert run(job).failure
    spare = tuple(np.concatenate([before.theta, [level]]) for level in (2e-4, 1.0, 2.0))
    found = run(replace(job, spare=spare))
    assert not found.failure
    assert found.chi2 <= 1.001 * before.chi2
    runs = run(replace(job, begins=(spare[1],), spare=(spare[0],)))
    assert runs.chi2 == found.chi2


def test_a_parameter_more_is_no_refutation_where_several_explain_the_data() -> None:
    looked_for = ("lag", "delay", "second-order", "gain")
    found = diagnose(model(), experiments(lag=0.0015), FREE, effects=looked_for, places=["wm"])
    (group,) = found.ambiguity
    behind = {r.effect: r.delta_bic for r in group}
    assert {"lag", "delay", "second-order"} == set(behind)
    assert DiagnosisOptions().set_bic < behind["second-order"] < DiagnosisOptions().set_bic + np.log(1800)
    alone = diagnose(model(), experiments(lag=0.03), FREE, effects=looked_for, places=["wm"])
    assert alone.verdict == "named" and not alone.ambiguity


def test_a_form_with_a_parameter_more_is_no_less_likely_where_the_evidence_is_weak() -> None:
    looked_for, clear = ("lag", "lead-lag"), experiments(lag=0.012)
    assert diagnose(model(), clear, FREE, effects=looked_for, places=["wm"]).verdict == "named"
    random, loud = np.random.default_rng(1), FrozenMap({n: 10.0 * s for n, s in SIGMA.items()})
    weak = []
    for e in clear:
        assert e.measured is not None
        y = e.measured.values + 10.0 * random.standard_normal(e.measured.values.shape) * list(SIGMA.values())
        weak.append(replace(e, measured=replace(e.measured, values=y), noise=loud))
    found = diagnose(model(), weak, FREE, effects=looked_for, places=["wm"])
    assert [{r.effect for r in group} for group in found.ambiguity] == [{"lag", "lead-lag"}]


def test_another_kind_of_delay_is_not_refuted_by_the_price_of_a_parameter() -> None:
    """A window is no special case of two lags: where both explain as much, fewer parameters are no evidence."""
    there = apply_effects(
        model(), [{"effect": "second-order", "at": ["wm"], "parameters": {"wn": 700.0, "zeta": 0.82}}]
    )
    recorded = answered(there, experiments(), seed=0)
    found = diagnose(model(), recorded, FREE, effects=["window-mean", "second-order"], places=["wm"])
    (group,) = found.ambiguity
    assert [r.effect for r in group] == ["window-mean", "second-order"]
    assert DiagnosisOptions().set_bic < group[1].delta_bic < np.log(1800) + 1.0


def test_delays_that_explain_most_of_a_held_out_gap_are_told_as_something_like_them() -> None:
    """What the catalogue lacks may still be of one kind: by how long it delays is known, and that it is not all."""
    lag, delay = (Rival(e, ("wm",), 0.0, FrozenMap({"T": 0.01})) for e in ("lag", "delay"))
    bend = Rival("saturation", ("wm",), 0.0, FrozenMap({"level": 1.0}))
    told = {
        (told, group): _half_told("lag at wm", (group,), (), told)
        for told in (0.4, 0.7)
        for group in ((lag, delay), (lag, bend), (lag,))
    }
    assert {k for k, v in told.items() if v.verdict == "ambiguous"} == {(0.7, (lag, delay))}
    assert told[0.7, (lag, delay)].sets == ((lag, delay),)
    assert "only 70% of the held-out gap" in told[0.7, (lag, delay)].text
    assert {v.verdict for v in told.values()} == {"ambiguous", "unnameable"}


@pytest.mark.parametrize(
    ("effects", "p", "statistic", "verdict"),
    [
        (("coupling", "backlash"), 0.5, 40.0, "named"),
        (("coupling", "backlash"), 0.005, 90.0, "ambiguous"),
        (("coupling",), 0.5, 40.0, "named"),
        (("coupling",), 0.005, 90.0, "ambiguous"),
        (("coupling",), 0.005, 44.0, "named"),
        (("coupling", "backlash"), 0.005, 190.0, "unnameable"),
    ],
)
def test_effects_that_leave_structure_are_not_named(
    effects: tuple[str, ...], p: float, statistic: float, verdict: str
) -> None:
    """What is in no catalogue is told as what looks like it: a relay as a quantiser, or as a coupling with a backlash."""
    sets = tuple((Rival(e, ("wm",), 0.0, FrozenMap({"k": 0.01})),) for e in effects)
    told = _named(" and ".join(effects), sets, (Binned("time", statistic, 40.0, p),), 1000.0, DiagnosisOptions())
    assert told.verdict == verdict
    assert bool(told.experiment) == bool(told.doubt) == (verdict == "ambiguous")


def test_a_conductance_is_a_loss_too_while_its_source_keeps_its_sign() -> None:
    """b |w| is b w as long as the drive does not turn; the load's sign changes."""
    found = one_round(
        SearchContext(("conductance", "loss"), ("torque",), FrozenMap(), DiagnosisOptions(bootstraps=100), seed=0),
        plain(experiments()),
        1,
    )
    leaks = [Rival("conductance", ("torque",), 0.5, source=s) for s in ("w", "load")]
    assert [(r.effect, r.at, r.source, r.delta_bic, r.refitted) for r in _as_loss(found, leaks)] == [
        ("loss", ("torque",), "w", 0.5, False)
    ]


def test_a_refit_that_began_at_a_poor_size_is_judged_by_its_candidates_best_score() -> None:
    search = SearchContext(("lag",), ("wm",), FrozenMap(), DiagnosisOptions(bootstraps=100), seed=0)
    found = one_round(search, plain(experiments(lag=0.03)), 1)
    assert found.winner is not None
    poor = replace(found.winner, pick=replace(found.winner.pick, score=1e-3))
    assert found.scores.p(poor.pick.score) > 0.5
    assert against(search, found.before, poor, found, first=True) == ""


def test_a_refit_that_brings_many_times_what_scores_do_is_judged_by_that() -> None:
    """The sizes tried of a moving mean may all lie near zeros that the records know nothing of."""
    search = SearchContext(("lag",), ("wm",), FrozenMap(), DiagnosisOptions(bootstraps=100), seed=0)
    found = one_round(search, plain(experiments(lag=0.03)), 1)
    assert found.winner is not None
    deaf = replace(found, scores=replace(found.scores, raw=1e-3 * found.scores.raw))
    poor = replace(found.winner, pick=replace(found.winner.pick, score=1e-3))
    assert deaf.score_p(poor.pick.candidate)[1] > 0.5
    assert against(search, found.before, poor, deaf, first=True) == ""
    little = replace(poor, refit=replace(poor.refit, chi2=found.before.chi2 - 20.0))
    assert "its score is what noise gives" in against(search, found.before, little, deaf, first=True)
