"""What is refitted beside what, what may be told from what, and when what is left is noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from hvdc_ident import Experiment, InputSignal, simulate
from hvdc_ident.discrepancy import DiagnosisOptions, diagnose
from hvdc_ident.discrepancy.conclusion import Conclusion, _weighed
from hvdc_ident.discrepancy.hypothesis import Refit, refitted
from hvdc_ident.discrepancy.misfit import misfit_of
from hvdc_ident.discrepancy.moves import MOVES
from hvdc_ident.discrepancy.moves.effects import opened
from hvdc_ident.discrepancy.options import SearchContext
from hvdc_ident.discrepancy.remainder import Remainder
from hvdc_ident.discrepancy.result import Rival
from hvdc_ident.discrepancy.rivals import _equal, akin_of, classes
from hvdc_ident.discrepancy.score import Ruler, objections
from hvdc_ident.discrepancy.search import Hypothesis, Search, SearchOutcome
from hvdc_ident.discrepancy.stated import Errors
from hvdc_ident.effects import apply_effects
from hvdc_ident.immutable import FrozenMap
from tests.discrepancy.cases import FREE, SIGMA, TRUE, experiments, model
from tests.discrepancy.refits import answered, beside, expanded, plain, search_from


@pytest.fixture(scope="module")
def before() -> Refit:
    return plain(experiments())


@pytest.mark.parametrize(("lag", "loud", "expected"), [(0.0, 1.0, True), (0.0, 1.12, True), (0.03, 1.0, False)])
def test_somewhat_louder_noise_is_noise_and_a_shape_is_not(lag: float, loud: float, expected: bool) -> None:
    told = FrozenMap({n: s / loud for n, s in SIGMA.items()})
    refit = plain([replace(e, noise=told) for e in experiments(lag=lag)])
    assert misfit_of(refit).is_loud == (lag > 0.0 or loud > 1.0), "by its size alone it would not be"
    assert misfit_of(refit).is_noise == expected


@pytest.mark.parametrize(("lag", "loud", "expected"), [(0.0, 1.12, True), (0.001, 1.0, False)])
def test_held_out_records_may_be_somewhat_louder_and_may_have_no_shape(lag: float, loud: float, expected: bool) -> None:
    own, other = experiments(), experiments(lag=lag)
    told = FrozenMap({n: s / loud for n, s in SIGMA.items()})
    held = [replace(o, noise=told) for o in other if o.role == "holdout"]
    refit = plain([*(e for e in own if e.role == "fit"), *held])
    assert misfit_of(refit).is_louder_unseen, "by its size alone it would not be noise"
    assert misfit_of(refit).is_noise == expected


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
    refit = refitted(beside(before, "limit", "outputs.torque", {"level": 1.45}, {"level": (0.5, 3.0)}))
    assert before.predicted is not None
    worse = {by: replace(refit, predicted=before.predicted + by) for by in (0.002, 0.05)}
    told = {by: objections(before, r, 500.0, 0.005, DiagnosisOptions(), {}, first=True) for by, r in worse.items()}
    assert told[0.002] == ""
    assert "speak" in told[0.05] and "against it" in told[0.05]


def test_somewhat_louder_noise_is_not_looked_at_more_closely() -> None:
    told = FrozenMap({n: s / 1.1 for n, s in SIGMA.items()})
    records = [replace(e, noise=told) for e in experiments(seed=2)]
    assert misfit_of(plain(records)).is_loud, "by its size alone it would be"
    looks: list[str] = []
    found = diagnose(model(), records, FREE, progress=lambda _done, _total, text: looks.append(text))
    assert found.verdict == "no-evidence"
    assert any("candidates" in look for look in looks) and not any("to be met" in look for look in looks)


def test_a_slow_gap_in_slow_noise_matters_as_it_is_recorded() -> None:
    before = plain(experiments(offset=0.008, noise="ar"))
    refit = refitted(beside(before, "offset", "drag", {"c": -0.008}, {"c": (-0.1, 0.1)}))
    assert before.holdout is not None and refit.holdout is not None
    assert 0.0 < before.holdout - refit.holdout < DiagnosisOptions().holdout_share, (
        "whitened there is hardly anything to see"
    )
    recorded = [misfit_of(r).as_recorded[role] for role in ("fit", "holdout") for r in (before, refit)]
    assert recorded[0] > 1.5 * recorded[1] and recorded[2] > 1.5 * recorded[3]
    gain = before.chi2 - refit.chi2
    assert objections(before, refit, gain, 0.005, DiagnosisOptions(), {}, first=True) == ""


def test_where_the_model_does_not_run_at_a_size_it_begins_at_another_and_at_the_best(before: Refit) -> None:
    job = beside(before, "limit", "torque", {"level": 1e-4}, {"level": (1e-5, 10.0)})  # cannot carry the drag
    assert refitted(job).failure
    others = tuple(np.concatenate([before.theta, [level]]) for level in (2e-4, 1.0, 2.0))
    found = refitted(replace(job, begins=(*job.begins, *others)))
    assert not found.failure
    assert found.chi2 <= 1.001 * before.chi2
    best = min((refitted(replace(job, begins=(b,))) for b in others[1:]), key=lambda r: r.chi2)
    assert found.chi2 <= 1.001 * best.chi2


def test_a_parameter_more_is_no_refutation_where_several_explain_the_data() -> None:
    looked_for = ("lag", "delay", "second-order", "gain")
    found = diagnose(model(), experiments(lag=0.0015), FREE, effects=looked_for, places=["wm"])
    (group,) = found.ambiguity
    behind = {r.effect: r.delta_bic for r in group}
    assert {"lag", "delay", "second-order"} == set(behind)
    assert DiagnosisOptions().set_bic < behind["second-order"] < DiagnosisOptions().set_bic + np.log(1800)
    alone = diagnose(model(), experiments(lag=0.03), FREE, effects=looked_for, places=["wm"])
    assert alone.verdict == "named" and [e.effect for e in alone.effects] == ["lag"]
    assert all(r.akin == "lag" for g in alone.ambiguity for r in g[1:]), "what does the same within the tolerance"


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


def rated(groups: Sequence[Sequence[Rival]], **remainder: float) -> Conclusion:
    """The verdict on some sets, with what they leave."""
    refit = plain(experiments())
    left = Remainder(**({"share": 0.0, "held_out": 0.0, "noise_units": 1.0} | remainder), at="wm")  # type: ignore[arg-type]
    found = Conclusion("named", "", (), tuple(tuple(g) for g in groups), remainder=left)
    outcome = SearchOutcome(Hypothesis(refit, refit), (), {}, Ruler.of(refit), Errors({}, {}, 0.0, 0.0))
    return _weighed(outcome, refit.nominal(), 1000.0, found, "lag at wm", 0.01)


def rival(effect: str, at: str, behind: float = 0.0, **values: float) -> Rival:
    return Rival(effect, (at,), behind, FrozenMap(values))


def test_what_is_told_apart_from_where() -> None:
    """One effect at places that cannot be told apart is named; two effects are not."""
    places = [rival("lag", p, T=0.01) for p in ("wm", "err", "torque")]
    assert rated([places]).verdict == "named"
    assert rated([[*places, rival("saturation", "wm", level=1.0)]]).verdict == "ambiguous"
    assert rated([[*places, rival("saturation", "wm", 8.0, level=1.0)]]).verdict == "named"
    (one,) = classes(places)
    assert one.probability == pytest.approx(1.0) and [p for _, p in one.members] == pytest.approx([1 / 3] * 3)


def test_effects_that_are_one_equation_are_one_class() -> None:
    both = [rival("coupling", "wm", k=-0.1), replace(rival("droop", "wm", k=0.1), same_as="coupling", refitted=False)]
    (one,) = classes(both)
    assert one.names == ("coupling", "droop") and one.probability == pytest.approx(1.0)
    (one,) = classes([rival("inductance", "torque"), replace(rival("lag", "torque"), same_as="inductance")])
    assert set(one.names) == {"lag", "inductance"}


def test_kinds_of_delay_that_are_as_long_are_one_class() -> None:
    """A mean over T is late by T/2. Of delays that differ by a tenth a hundredth of the squared answer is left."""
    (one,) = classes([rival("delay", "wm", T=0.02), rival("window-mean", "wm", 3.0, T=0.0404)])
    assert one.kinds == ("delay", "window-mean") and one.probability == pytest.approx(1.0)
    apart = classes([rival("delay", "wm", T=0.02), rival("window-mean", "wm", 3.0, T=0.06)])
    assert [c.kinds for c in apart] == [("delay",), ("window-mean",)]
    assert rated([[rival("delay", "wm", T=0.02), rival("lag", "wm", 1.0, T=0.02)]]).verdict == "named"


@pytest.mark.parametrize(
    ("share", "p", "held_out", "held_out_p", "verdict"),
    [
        (0.5, 0.5, 0.0, 1.0, "named"),  # as loud as noise may be
        (0.005, 0.001, 0.0, 1.0, "named"),  # of so little nothing is made
        (0.05, 0.001, 0.0, 1.0, "ambiguous"),
        (0.2, 0.001, 0.0, 1.0, "ambiguous"),
        (0.0, 0.5, 0.05, 1e-4, "ambiguous"),
        (0.0, 0.5, 0.4, 0.5, "named"),
    ],
)
def test_a_remainder_that_is_no_noise_and_no_trifle_is_told(
    share: float, p: float, held_out: float, held_out_p: float, verdict: str
) -> None:
    found = rated([[rival("lag", "wm", T=0.01)]], share=share, p=p, held_out=held_out, held_out_p=held_out_p)
    assert found.verdict == verdict
    assert bool(found.doubt) == bool(found.experiment) == (verdict == "ambiguous")


def test_unlike_forms_that_leave_much_are_not_named() -> None:
    group = [rival("lag", "wm", T=0.01), rival("saturation", "wm", level=1.0)]
    assert rated([group], share=0.2, p=0.001).verdict == "unnameable"
    assert (
        rated([[rival("lag", "wm", T=0.01), rival("delay", "wm", T=0.01)]], share=0.2, p=0.001).verdict == "ambiguous"
    )


def test_a_conductance_is_a_loss_too_while_its_source_keeps_its_sign() -> None:
    """b |w| is b w as long as the drive does not turn; the load's sign changes."""
    search = SearchContext(("conductance", "loss"), ("torque",), FrozenMap(), DiagnosisOptions(bootstraps=100), seed=0)
    _, found = opened(search, plain(experiments()), 1)
    leaks = [Rival("conductance", ("torque",), 0.5, FrozenMap({"g": 0.1}), source=s) for s in ("w", "load")]
    assert [(r.effect, r.at, r.source, r.delta_bic, r.refitted) for r in _equal(found, leaks, lambda _: True)] == [
        ("loss", ("torque",), "w", 0.5, False)
    ]


def fitted(first: Refit, effect: str, at: str, sizes: dict[str, float], source: str = "") -> Rival:
    """The rival that the refit of an effect beside a model is, begun at these sizes."""
    refit = refitted(beside(first, effect, at, sizes, dict.fromkeys(sizes, (-2.0, 2.0)), source))
    assert not refit.failure
    return replace(rival(effect, at, **sizes), source=source, refit=refit)


def test_effects_that_add_the_same_to_a_signal_in_these_records_are_one_class() -> None:
    """Beyond its edge a dead band takes off its width, as an offset does; the speed moves too much for a gain to do the same."""
    width = 0.05
    there = apply_effects(model(), [{"effect": "deadband", "at": ["w"], "parameters": {"width": width}}])
    records = answered(there, experiments(), seed=0)
    assert min(float(np.min(e.measured["w"])) for e in records if e.measured is not None) > 2.0 * width
    first, sizes = plain(records), {"offset": {"c": -width}, "deadband": {"width": width}, "gain": {"k": 1.0 - width}}
    group = [replace(fitted(first, n, "w", own), delta_bic=float(k)) for k, (n, own) in enumerate(sizes.items())]
    assert akin_of(first, group) == ["", "offset", ""]
    assert akin_of(first, [group[0], replace(group[1], at=("err",))]) == ["", ""]
    named = [replace(r, akin=akin) for r, akin in zip(group, akin_of(first, group), strict=True)]
    assert [set(c.names) for c in classes(named)] == [{"offset", "deadband"}, {"gain"}]


@pytest.mark.parametrize(("place", "akin"), [("wm", ""), ("torque", "coupling")])
def test_what_differs_by_an_offset_that_no_record_shows_is_one_class(place: str, akin: str) -> None:
    """A coupling acts by the change of a signal since the start, a conductance by all of it. Before the torque the integrator
    makes good for any offset; one of the measured speed is seen in the speed."""
    there = apply_effects(model(), [{"effect": "coupling", "at": [place], "parameters": {"k": 0.1}, "from": "load"}])
    loaded = {"ref": InputSignal.step(0.3, 1.0, 1.2), "load": InputSignal.step(0.6, 0.5, 1.0)}
    first = plain(answered(there, [replace(e, inputs=FrozenMap(loaded)) for e in experiments()], seed=0))
    leaks = [
        fitted(first, "coupling", place, {"k": 0.1}, "load"),
        fitted(first, "conductance", place, {"g": -0.1}, "load"),
    ]
    assert akin_of(first, leaks) == ["", akin]


def test_a_refit_that_takes_away_what_noise_gives_is_no_evidence() -> None:
    """Whatever its pick promised: it is what the refit came to that is judged."""
    search = SearchContext(("lag",), ("wm",), FrozenMap(), DiagnosisOptions(bootstraps=100), seed=0)
    at_work = Search(search, plain(experiments(lag=0.03)), MOVES)
    at_work.run()
    (found,) = [h for h in at_work.pool.values() if [t.label for t in h.terms] == ["lag at wm"]]
    assert at_work._objection(found) == ""
    little = replace(found, refit=replace(found.refit, chi2=at_work.root.refit.chi2 - 2.0))
    assert "its score is what noise gives" in at_work._objection(little)


def test_of_effects_that_explain_as_much_the_one_with_the_fewest_places_wins() -> None:
    """Before any data an effect shares its probability with all its places and sources: with those of a conductance at the load."""
    search = SearchContext(("offset", "conductance"), ("load",), FrozenMap(), DiagnosisOptions(bootstraps=100), seed=0)
    first = plain(experiments(offset=0.05))
    kinds = [c.effect for c in expanded(search, first).candidates]
    assert kinds.count("offset") == 1 < kinds.count("conductance")
    outcome = search_from(search, first)
    scores = {h.terms[0]: (score, h) for h, score in outcome.pool if len(h.terms) == 1}
    (offset,) = [t for t in scores if t.kind == "offset"]
    others = [t for t in scores if t.kind == "conductance"]
    assert others and offset.prior == pytest.approx(others[0].prior * kinds.count("conductance"))
    at_work = Search(search, first, MOVES)
    as_good = [replace(scores[t][1], refit=scores[offset][1].refit) for t in (*others, offset)]
    for hypotheses in (as_good, as_good[::-1]):
        at_work.pool = {at_work.root.key: at_work.root} | {h.key: h for h in hypotheses}
        assert at_work.ranked()[0].kind == "offset"
