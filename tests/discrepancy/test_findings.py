"""Findings of a diagnosis: parameters among them, places apart from effects, and the remainder."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hvdc_ident.discrepancy import Diagnosis, DiagnosisOptions, description, diagnose
from hvdc_ident.discrepancy.conclusion import Conclusion, headline, leaves_more_than_noise
from hvdc_ident.discrepancy.hypothesis import refitted
from hvdc_ident.discrepancy.misfit import misfit_of
from hvdc_ident.discrepancy.options import SearchContext
from hvdc_ident.discrepancy.remainder import Remainder, remainder_of
from hvdc_ident.discrepancy.result import EffectSize, FoundEffect, Place, Rival
from hvdc_ident.discrepancy.rivals import classes
from hvdc_ident.discrepancy.sentences import at_given, base_factor, elsewhere, off_given, sentence, separating
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.parameters import Parameter
from tests.discrepancy.cases import FREE, SIGMA, TRUE, experiments, model
from tests.discrepancy.refits import beside, plain

GIVEN = {"Kp": 2.6, "Ki": 9.0}
SEARCH = SearchContext("all", None, FrozenMap(), DiagnosisOptions(bootstraps=100), seed=0)


@pytest.fixture(scope="module")
def lagged() -> Diagnosis:
    return diagnose(model(), experiments(lag=0.03), FREE, effects=["lag", "gain", "offset"], seed=1)


def test_a_parameter_that_explains_the_gap_is_the_finding() -> None:
    free = [replace(f, given=GIVEN[f.name]) for f in FREE]
    found = diagnose(model(), experiments(), free, effects=["lag", "gain"], seed=1)
    assert found.verdict == "no-evidence" and not found.effects
    (told,) = found.findings
    assert told.effect == "parameter" and set(told.parameters) == {"Kp", "Ki"}
    for name, size in told.parameters.items():
        assert size.ci95 is not None and size.ci95[0] is not None and size.ci95[1] is not None
        assert size.ci95[0] < TRUE[name] < size.ci95[1]
    assert found.text.startswith("No effect is missing: Kp is 2") and "not 2.6" in found.text


def test_where_no_value_is_off_there_is_no_finding() -> None:
    free = [replace(f, given=TRUE[f.name]) for f in FREE]
    found = diagnose(model(), experiments(), free, effects=["lag", "gain"], seed=1)
    assert found.verdict == "no-evidence" and not found.findings


def test_a_finding_has_its_probability_and_places(lagged: Diagnosis) -> None:
    assert lagged.verdict == "named"
    (told,) = lagged.findings
    assert told.effect == "lag" and told.probability > 0.95
    assert sum(p.probability for p in told.places) == pytest.approx(1.0, abs=0.06)
    assert told.equivalent_delay is not None and told.equivalent_delay.value == pytest.approx(0.03, rel=0.05)
    assert told.share is not None and told.share > 0.95
    assert "It explains" in lagged.text and "times the noise" in lagged.text


def test_what_leaves_more_than_noise_tells_no_interval(lagged: Diagnosis) -> None:
    """With the lag alone the drive is right; with a brake as well, which is not looked for, its values are off by more than they say."""
    assert not lagged.beyond_noise and "(95 %: " in lagged.text and "within" not in lagged.text
    records = experiments(lag=0.03, drag=lambda w: TRUE["b"] * w * (1.0 + 0.03 * w**2))
    braked = diagnose(model(), records, FREE, effects=["lag"], options=DiagnosisOptions(most=1, fallback=False), seed=1)
    assert [e.effect for e in braked.effects] == ["lag"]
    assert braked.beyond_noise and "95 %" not in braked.text and all("95 %" not in f.text for f in braked.findings)
    assert "interval if nothing else is missing" in str(braked) and "95 % interval" in str(lagged)


@pytest.mark.parametrize(
    ("adequate", "loud", "doubt", "remainder", "more"),
    [
        (True, 2.0, "", None, False),  # louder than was supposed, and noise
        (False, 1.3, "", None, False),  # of another colour, and hardly louder
        (False, 2.0, "", None, True),
        (True, 1.0, "the experiments ask for different sizes", None, True),
        (True, 1.0, "", Remainder(0.05, None, 1.0, p=0.005), True),
        (True, 1.0, "", Remainder(0.05, None, 1.0, p=0.5), False),
        (True, 1.0, "", Remainder(0.0, 0.05, 1.0, held_out_p=0.005), True),
    ],
)
def test_more_than_noise_is_left_where_a_test_a_doubt_or_the_remainder_says_so(
    adequate: bool, loud: float, doubt: str, remainder: Remainder | None, more: bool
) -> None:
    """loud: the residual of one of two outputs over its noise; that of the other is as loud as noise."""
    signs = np.tile([1.0, -1.0], 50)
    blocks = [SimpleNamespace(output=o, residual=k * signs) for o, k in (("w", 1.0), ("torque", loud))]
    last: Any = type("Left", (), {"nominal": lambda self: SimpleNamespace(blocks=blocks)})()
    judgement = Conclusion("named", "", (), doubt=doubt, remainder=remainder)
    assert leaves_more_than_noise(judgement, last, adequate=adequate, significance=0.01) is more


def test_the_headline_speaks_of_a_tolerance_only_where_one_is_stated_and_kept(lagged: Diagnosis) -> None:
    told = Conclusion("named", "", (), remainder=Remainder(0.0, None, 4.0))
    assert "what remains is 4 times the noise." in headline(told, lagged.findings)
    assert "4 times the noise, within the stated tolerance." in headline(told, lagged.findings, tolerated=True)
    first = plain(experiments(lag=0.03))
    largest = max(v for v in first.problem.rmse(first.theta)["w"].values() if v is not None)
    for band, kept in ((1.01 * largest, True), (0.99 * largest, False)):
        assert misfit_of(first).keeps({"w": band}) is kept
    assert misfit_of(first).keeps({}) is False


def test_the_json_of_findings(lagged: Diagnosis) -> None:
    told = json.loads(json.dumps(lagged.to_dict(), allow_nan=False))
    (found,) = told["findings"]
    assert {"effect", "same_as", "probability", "parameters", "equivalent_delay", "places", "text"} <= set(found)
    assert {"at", "probability"} <= set(found["places"][0])
    assert {"share", "held_out", "noise_units", "p", "below_tolerance"} <= set(told["remainder"])
    best = told["hypotheses"][0]
    assert best["effects"] and best["log_evidence"] > 100.0 and 0.0 <= best["probability"] <= 1.0


def test_what_is_left_of_the_right_effect_is_noise_and_of_a_wrong_one_is_not() -> None:
    first = plain(experiments(lag=0.03))
    right = remainder_of(SEARCH, first, refitted(beside(first, "lag", "wm", {"T": 0.02}, {"T": (1e-3, 0.3)})), 1.0)
    wrong = remainder_of(SEARCH, first, refitted(beside(first, "gain", "wm", {"k": 1.01}, {"k": (0.5, 2.0)})), 1.0)
    assert right.p > 0.01 and right.share < 0.02
    assert wrong.p <= 0.01 and wrong.share > 0.1 and wrong.log_evidence > 20.0


def test_of_noise_alone_a_latent_input_is_as_likely_as_chance_has_it() -> None:
    chances = []
    for seed in range(4):
        records = plain(experiments(seed=seed))
        loud = replace(records, chi2=records.chi2 + 100.0)
        chances.append(remainder_of(SEARCH, loud, records, 1.0).p)
    assert min(chances) > 0.01 and max(chances) > 0.2
    assert set(SIGMA) == set(model().outputs)


def test_held_out_noise_may_be_as_loud_as_the_rows_before_the_event_let_it() -> None:
    """7 % more than the noise is much for 600 rows of known noise, and nothing where few rows have told of it."""
    right = plain(experiments())
    assert right.holdout is not None
    louder = replace(right, holdout=1.07)
    sure, unsure = (
        replace(louder, noise=FrozenMap({o: replace(n, freedom=freedom) for o, n in louder.noise.items()}))
        for freedom in (0, 40)
    )
    first = replace(right, holdout=3.0)
    assert remainder_of(SEARCH, first, sure, 1.0).held_out_p < 0.02
    assert remainder_of(SEARCH, first, unsure, 1.0).held_out_p > 0.05


def test_the_interval_of_a_finding_leaves_out_places_where_the_size_is_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """A coupling on the other side of a difference has the other sign: no interval from one to the other."""
    spans = {"wm": (-0.035, -0.025), "err": (0.025, 0.035), "torque": (-0.036, -0.026)}
    sizes = {"wm": -0.030, "err": 0.030, "torque": -0.031}
    members = [Rival("coupling", (at,), 0.1 * k, FrozenMap({"k": v})) for k, (at, v) in enumerate(sizes.items())]
    monkeypatch.setattr(description, "_span", lambda rival, _name: spans[rival.at[0]])
    (one,) = classes(members)
    assert description.finding(one).parameters["k"].ci95 == (-0.036, -0.025)


def test_what_was_put_in_is_told_where_it_is_as_likely(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sentence, sizes and the model that is written name the same place; one that is unlikely does not stand for its class."""
    members = [
        Rival("lag", (at,), behind, FrozenMap({"T": 0.03})) for at, behind in (("wm", 0.0), ("err", 0.5), ("w", 9.0))
    ]
    monkeypatch.setattr(description, "_span", lambda _rival, _name: (0.029, 0.031))
    (one,) = classes(members)
    size = FrozenMap({"T": EffectSize(0.04, (0.039, 0.041), "s")})
    told = description.finding(one, FoundEffect("lag", ("err",), size, "err is late", 3))
    assert told.text.startswith("err is late (95 %: 39 ms to 41 ms)") and told.parameters["T"].value == 0.04
    told = description.finding(one, FoundEffect("lag", ("w",), size, "w is late", 3))
    assert told.parameters["T"].value == 0.03 and "w is late" not in told.text


def test_an_effect_that_may_be_anywhere_is_told_with_its_places(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 40 places that are as likely none is likely, and 38 hold 95 %."""
    members = [Rival("delay", (f"s{k}",), 0.0, FrozenMap({"T": 0.02})) for k in range(40)]
    monkeypatch.setattr(description, "_span", lambda _rival, _name: (0.019, 0.021))
    (one,) = classes(members)
    told = description.finding(one)
    assert len(told.places) == 38 and told.equivalent_delay is not None
    assert told.equivalent_delay.ci95 == pytest.approx((0.019, 0.021))
    assert "or one of 33 more" in told.text


def test_the_names_of_a_finding_are_those_of_its_likely_effects_its_own_first() -> None:
    gain = replace(Rival("gain", ("wm",), 1.0, FrozenMap({"k": 0.9})), akin="offset")
    deadband = replace(Rival("deadband", ("wm",), 9.0, FrozenMap({"width": 0.1})), akin="gain")
    limit = Rival("limit", ("wm",), 1.0, FrozenMap(), refitted=False, same_as="gain")
    (one,) = classes([Rival("offset", ("wm",), 0.0, FrozenMap({"c": 0.1})), gain, limit, deadband])
    assert description._names(one, "gain") == ("gain", "offset", "limit")
    assert (
        description._others(one, one.members[0][0]) == ", or another effect that does the same in these records (gain)"
    )


def test_many_that_do_the_same_do_not_crowd_out_another() -> None:
    """Looked for at few places or at many, an effect as likely by the data is among the names; one the data refute is not."""
    lags = [Rival("lag", (f"s{k}",), 0.0, FrozenMap({"T": 0.02}), prior=0.1) for k in range(8)]
    mean = Rival("window-mean", ("s0",), 1.0, FrozenMap({"T": 0.04}), prior=0.01)
    delay = Rival("delay", ("s0",), 9.0, FrozenMap({"T": 0.02}), prior=0.1)
    (one,) = classes([*lags, mean, delay])
    assert description._names(one, "lag") == ("lag", "window-mean")


@pytest.mark.parametrize(
    ("adequate", "matters", "told", "share"),
    [
        (True, False, "No effect is missing: Kp is ", 1.0),
        (True, True, "looks like noise, 1.5 times as loud as supposed.", 1.0),
        (False, True, "what remains is 1.5 times the noise and does not look like noise", None),
    ],
)
def test_no_effect_is_missing_only_where_nothing_else_is_left(
    adequate: bool, matters: bool, told: str, share: float | None
) -> None:
    right = plain(experiments())
    last = replace(right, chi2=(1.5**2 if matters else 0.9) * right.rows)
    found = off_given(last, at_given(last, GIVEN), adequate, matters)
    assert (
        found is not None and told in found.text and ("No effect is missing" in found.text) == (adequate or not matters)
    )
    before = sum(b.chi2 for b in right.problem.blocks(last.theta_at_given, derivatives=False))
    expected = 1.0 - (last.chi2 - last.rows) / (before - last.rows) if share is None else share
    assert found.share == pytest.approx(expected)


def test_a_size_that_later_effects_moved_is_told_with_its_interval_there() -> None:
    """The interval of the last model, wider by as much as the places make that of the effect's own round."""
    last, own = EffectSize(0.018, (0.017, 0.019), "s"), EffectSize(0.020, (0.0195, 0.0205), "s")
    over = description._over_places(last, own, [(0.0195, 0.0205), (0.0190, 0.0210), (0.030, 0.031)])
    assert over.value == 0.018 and over.ci95 == pytest.approx((0.0165, 0.0195))
    assert description._over_places(last, own, []) is last


def test_the_interval_of_a_delay_is_that_of_the_one_size_that_makes_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mean over T is T/2 late. Of two sizes that go together, as in a lead-lag, the intervals tell nothing of the difference."""
    monkeypatch.setattr(description, "_span", lambda _rival, _name: (0.018, 0.022))
    mean = Rival("window-mean", ("wm",), 0.0, FrozenMap({"T": 0.02}))
    assert description._delay_span(mean) == pytest.approx((0.009, 0.011))
    lead = Rival("lead-lag", ("wm",), 0.0, FrozenMap({"T1": 0.010, "T2": 0.013}))
    assert description._delay_span(lead) is None
    assert description._delay_span(Rival("gain", ("wm",), 0.0, FrozenMap({"k": 1.1}))) is None


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"a": 0.0, "b": 0.01, "c": 0.0}, "drag loses 0.01 |w|"),
        ({"a": 0.2, "b": 0.0, "c": -0.5}, "drag loses 0.2 + -0.5 w^2"),
    ],
)
def test_a_sentence_leaves_out_the_parts_that_are_not_there(values: dict[str, float], told: str) -> None:
    placed = beside(plain(experiments()), "loss", "drag", values, {"b": (-3.0, 3.0)}, source="w").placed[-1]
    assert sentence(placed.candidate, values) == told


@pytest.mark.parametrize(
    ("compute", "told"),
    [(0.0, "drag is sampled every 20 ms"), (0.003, "drag is sampled every 20 ms and published 3 ms later")],
)
def test_a_sampler_that_publishes_at_once_is_told_without_a_delay(compute: float, told: str) -> None:
    sampled = Rival("sample-hold", ("drag",), 0.0, FrozenMap({"Ts": 0.02, "compute": compute}))
    assert sentence(sampled, sampled.parameters) == told


def test_a_finding_tells_places_and_sources_apart() -> None:
    best = Rival("coupling", ("eq1", "eq2"), 0.0, FrozenMap({"k": 0.1}), source="Q1f, Q2f")
    places = [
        Place(("eq1", "eq2"), 0.4, "Q1f, Q2f"),
        Place(("Uref1", "Uref2"), 0.3, "Q1f, Q2f"),
        Place(("Uref1", "Uref2"), 0.3, "iq1, iq2"),
    ]
    assert sentence(best, best.parameters) == "Each of eq1 and eq2 takes 0.1 of the change of its own of Q1f and Q2f"
    assert elsewhere(best, places[:1]) == ""
    apart = "; the records do not distinguish this place from Uref1 and Uref2, nor Q1f and Q2f from iq1 and iq2"
    assert elsewhere(best, places) == apart


def test_what_to_record_next_asks_for_signals_that_are_not_there_and_not_for_other_names_of_one_equation() -> None:
    lag = [Rival("lag", (at,), 0.0, FrozenMap({"T": 0.03})) for at in ("wm", "w")]
    told = separating([lag], {"wm"})["text"]
    assert told.startswith("Record w as well") and "wm" not in told
    assert separating([lag], {"wm", "w"})["text"].startswith("Step an input that acts on some of wm and w")
    alike = [Rival("coupling", ("e",), 0.0, FrozenMap({"k": 1.0}), source="w")]
    alike.append(Rival("droop", ("e",), 0.0, FrozenMap({"k": -1.0}), source="w", refitted=False, same_as="coupling"))
    assert separating([alike], set()) == {}


def test_an_effect_with_many_places_is_no_likelier_for_that() -> None:
    """Where nothing tells them apart, an effect holds what its places hold of all those it was looked for at."""
    leaks = [Rival("coupling", ("e",), 0.0, FrozenMap({"k": 0.1}), source=f"s{k}", prior=1 / 60) for k in range(12)]
    gains = [Rival("gain", (at,), 0.0, FrozenMap({"k": 0.9}), prior=1 / 10) for at in ("e", "u")]
    found = {c.names[0]: c.probability for c in classes([*leaks, *gains])}
    assert found == {"coupling": pytest.approx(0.5), "gain": pytest.approx(0.5)}


def test_one_equation_under_two_names_counts_once() -> None:
    leak = Rival("conductance", ("e",), 0.0, FrozenMap({"g": 0.1}), source="s", prior=0.1)
    loss = Rival("loss", ("e",), 0.0, FrozenMap({"b": 0.1}), source="s", same_as="conductance", prior=0.1)
    gain = Rival("gain", ("e",), 0.0, FrozenMap({"k": 0.9}), prior=0.1)
    one, other = classes([leak, loss, gain])
    assert one.probability == other.probability == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("unit", "ratio", "error", "said"),
    [
        ("rad/s", 6.283, 1e-3, "2 pi"),
        ("Hz", 1.0 / 6.2832, 1e-3, "2 pi"),
        ("kV", 1.732, 1e-3, "sqrt 3"),
        ("pu", 2.5, 1e-3, "the bases Sn and Sb"),
        ("", 0.4, 1e-3, "the bases Sn and Sb"),
        ("s", 1.732, 1e-3, ""),  # no time is off by a base
        ("kV", 1.732, 0.05, ""),  # it may be any of several
        ("pu", 2.0, 1e-3, ""),
    ],
)
def test_a_ratio_that_is_of_a_unit_or_base_is_told_where_the_unit_lets_it(
    unit: str, ratio: float, error: float, said: str
) -> None:
    bases = {"Sn": Parameter(250.0, unit="MVA"), "Sb": Parameter(100.0, unit="MVA")}
    plant = replace(model(), parameters=model().parameters | bases)
    text = base_factor(plant, unit, ratio, error)
    assert text == (f" (the ratio is that of {said})" if said else "")
