"""Once several effects are in: each can be taken out or exchanged, also one that another sits behind, and is told as itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hvdc_ident.discrepancy.diagnosis import lines
from hvdc_ident.discrepancy.expansion import Expansion, ExpansionModel
from hvdc_ident.discrepancy.hypothesis import Refit, joint_refit_job, last_placed, refitted, slot_signals
from hvdc_ident.discrepancy.moves import MOVES
from hvdc_ident.discrepancy.moves import effects as moves_of_effects
from hvdc_ident.discrepancy.moves.effects import opened
from hvdc_ident.discrepancy.options import DiagnosisOptions, SearchContext
from hvdc_ident.discrepancy.pushes import pushed
from hvdc_ident.discrepancy.score import P_EFFECT, is_clear
from hvdc_ident.discrepancy.search import Hypothesis, Search, Term
from hvdc_ident.errors import SimulationError
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import insertion_point_of
from tests.discrepancy.cases import experiments
from tests.discrepancy.refits import beside, plain, search_from


def looking_for(effects: tuple[str, ...], places: tuple[str, ...]) -> SearchContext:
    """A search for some effects at some places."""
    return SearchContext(effects, places, FrozenMap(), DiagnosisOptions(bootstraps=100, fallback=False), seed=0)


def hypothesis(first: Refit, refit: Refit) -> Hypothesis:
    """A refit with effects as a hypothesis beside the model `first`."""
    placed = [p.candidate for p in refit.placed]
    return Hypothesis(refit, first, tuple(Term(c.effect, c.at, c.source, P_EFFECT / 2.0) for c in placed))


@pytest.fixture(scope="module")
def first() -> Refit:
    """The drive, refitted to records of a drive whose controller sees a lagged speed."""
    return plain(experiments(lag=0.03))


@pytest.fixture(scope="module")
def both(first: Refit) -> Refit:
    """A gain of the set-point, which is not there, and behind it a lag."""
    one = refitted(beside(first, "gain", "ref", {"k": 1.001}, {"k": (0.9, 1.1)}))
    two = refitted(beside(one, "lag", "ref_after_gain", {"T": 0.02}, {"T": (1e-4, 0.3)}))
    assert not two.failure
    return two


def test_an_effect_that_sits_behind_another_stays_where_that_was_when_it_goes(first: Refit, both: Refit) -> None:
    alone = refitted(joint_refit_job(first, both, both.placed[1:], {}))
    assert not alone.failure
    assert alone.placed[0].candidate.at == ("ref",)
    direct = refitted(beside(first, "lag", "ref", {"T": 0.02}, {"T": (1e-4, 0.3)}))
    assert alone.chi2 == pytest.approx(direct.chi2, rel=1e-6)


def test_what_is_not_there_is_not_clear_and_what_is_told_last_takes_its_evidence_along(first: Refit) -> None:
    one = refitted(beside(first, "gain", "ref", {"k": 1.001}, {"k": (0.9, 1.1)}))
    both = refitted(beside(one, "lag", "wm", {"T": 0.02}, {"T": (1e-4, 0.3)}))
    assert [is_clear(both, k) for k in range(2)] == [False, True]
    turned = last_placed(both, 0)
    assert [p.candidate.effect for p in turned.placed] == ["lag", "gain"]
    assert [is_clear(turned, k) for k in range(2)] == [True, False]


def test_a_search_does_without_what_is_nothing_beside_the_others(first: Refit) -> None:
    one = refitted(beside(first, "gain", "ref", {"k": 1.001}, {"k": (0.9, 1.1)}))
    both = refitted(beside(one, "lag", "wm", {"T": 0.02}, {"T": (1e-4, 0.3)}))
    search = Search(looking_for(("gain", "lag"), ("ref", "wm")), first, MOVES)
    pair = hypothesis(first, both)
    search.add([pair])
    outcome = search.run()
    assert pair.key in {h.key for h, _ in outcome.pool}
    assert [t.label for t in outcome.best.terms] == ["lag at wm"]
    assert [p.candidate.label for p in outcome.refit.placed] == ["lag at wm"]
    assert [t.label for t in outcome.named] == ["lag at wm"]


def test_an_effect_that_another_explains_better_is_exchanged_for_it() -> None:
    """Beside the offset a delay is nearly the lag that it stands for; what is beside it stays."""
    first = plain(experiments(lag=0.03, offset=0.3))
    late = refitted(beside(first, "delay", "wm", {"T": 0.02}, {"T": (1e-4, 0.3)}))
    both = refitted(beside(late, "offset", "drag", {"c": -0.3}, {"c": (-1.0, 1.0)}))
    search = Search(looking_for(("lag", "delay", "offset"), ("wm", "drag")), first, MOVES)
    (looked,) = [m for m in MOVES if m.name == "effects"]
    search.add([*looked.make(search, search.root), hypothesis(first, both)])
    assert {t.label for t in search.answer()[0].terms} == {"delay at wm", "offset at drag"}
    search._exchanged()
    best, _ = search.answer()
    assert {t.label for t in best.terms} == {"lag at wm", "offset at drag"}
    sizes = {p.candidate.effect: best.refit.sizes(p) for p in best.refit.placed}
    assert sizes["lag"]["T"] == pytest.approx(0.03, rel=0.02) and sizes["offset"]["c"] == pytest.approx(-0.3, rel=0.02)


def test_a_card_is_exchanged_in_the_model_without_terms_alone() -> None:
    """Of a model with effects the one with another card would lose them."""
    asked: list[str] = []

    def cards(_: Search, h: Hypothesis) -> list[Hypothesis]:
        asked.append(" and ".join(t.label for t in h.terms))
        return []

    moves = tuple(replace(m, make=cards) if m.name == "cards" else m for m in MOVES)
    first = plain(experiments(lag=0.03, offset=0.3))
    outcome = Search(looking_for(("lag", "offset"), ("wm", "drag")), first, moves).run()
    assert len(outcome.best.terms) == 2
    assert asked == [""]


def test_what_could_not_be_refitted_stays_told(first: Refit) -> None:
    search = Search(looking_for(("gain", "lag"), ("ref", "wm")), first, MOVES)
    search.run()
    key = search.root.key
    *others, last = search.expansions[key].trials
    lost = replace(last, refit=replace(last.refit, failure="it does not run"))
    search.expansions[key] = replace(search.expansions[key], trials=(*others, lost))
    outcome = search.outcome(exhausted=True)
    assert [t.label for t in outcome.named] == ["lag at wm"]
    assert [line.status for line in lines(outcome) if line.status.startswith("failed")] == ["failed: it does not run"]


def test_what_could_not_be_looked_for_beside_an_effect_is_told_and_the_effect_stays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def stopped(
        context: SearchContext, here: Refit, number: int, known: Expansion | None = None
    ) -> tuple[ExpansionModel, Expansion]:
        if here.placed:
            raise SimulationError("the simulation stopped", got="step-limit")
        return opened(context, here, number, known)

    monkeypatch.setattr(moves_of_effects, "opened", stopped)
    outcome = search_from(looking_for(("lag", "offset"), ("wm", "drag")), plain(experiments(lag=0.03, offset=0.3)))
    (term,) = outcome.best.terms
    assert term.label in ("lag at wm", "offset at drag")
    told = [n for n in outcome.notes if f"beside {term.label}" in n]
    assert told and all("step-limit" in n for n in told)


def test_a_model_beside_which_nothing_can_be_looked_for_ends_the_search(
    first: Refit, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object) -> tuple[ExpansionModel, Expansion]:
        raise SimulationError("the simulation stopped", got="step-limit")

    monkeypatch.setattr(moves_of_effects, "opened", stopped)
    with pytest.raises(SimulationError, match="stopped"):
        search_from(looking_for(("lag",), ("wm",)), first)


@pytest.mark.parametrize(
    ("slots", "name", "found"),
    [
        ("ref wm", "ref", "ref"),
        ("ref wm", "ref_after_gain", "ref"),
        ("ref wm", "ref_after_gain_2", "ref"),
        ("ref wm", "wm_before_lag_before_gain", "wm"),
        ("day day_before", "day_before_lag", "day"),
        ("ref wm", "lag_wm_x", "lag_wm_x"),
        ("ref wm", "outputs.w", "outputs.w"),
    ],
)
def test_the_slot_that_a_name_was_made_at(slots: str, name: str, found: str) -> None:
    assert insertion_point_of(slots.split(), name) == found


def test_nothing_is_looked_for_inside_an_effect_that_is_there_already(first: Refit) -> None:
    """The velocity of a second-order lag, or a bit of a quantiser, is no place of the plant."""
    one = refitted(
        beside(first, "second-order", "wm", {"wn": 60.0, "zeta": 1.0}, {"wn": (5.0, 500.0), "zeta": (0.1, 2.0)})
    )
    two = refitted(beside(one, "quantisation", "outputs.w", {"step": 0.05}, {"step": (0.02, 0.1)}))
    inner = [s for s in two.model.insertion_points if any(p.use.made(s) for p in two.placed)]
    assert {"second_order_wm_y", "second_order_wm_v"} <= set(inner) and len(inner) > 40
    assert "wm" not in inner and "wm_before_second_order" not in inner
    _, found = opened(
        SearchContext(("gain", "coupling"), None, FrozenMap(), DiagnosisOptions(bootstraps=100), 0), two, 2
    )
    assert {c.at[0] for c in found.candidates} >= {"wm", "wm_before_second_order", "torque"}
    assert not {*inner} & {p for c in found.candidates for p in (*c.at, c.source)}


def test_expansions_that_are_over_have_the_answers_of_their_model() -> None:
    first = plain(experiments(lag=0.03, offset=0.3))
    outcome = search_from(looking_for(("lag", "offset"), ("wm", "drag")), first)
    assert len(outcome.named) == 2
    again, anew = outcome.opened.answers(), pushed(first, slot_signals(first))
    assert again.keys() == anew.keys() == {"fit-1", "fit-2"}
    for name, path in anew.items():
        np.testing.assert_array_equal(again[name].values["wm"], path.values["wm"])
