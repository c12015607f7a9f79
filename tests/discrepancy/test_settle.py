"""Once several effects are in: each can be taken out alone, also one that another sits behind, and is told as itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hvdc_ident.discrepancy import search as searching
from hvdc_ident.discrepancy.evidence import CandidateFit, Pick, Ruler, is_clear
from hvdc_ident.discrepancy.hypothesis import Refit, joint_refit_job, refitted, slot_signals
from hvdc_ident.discrepancy.options import DiagnosisOptions, SearchContext
from hvdc_ident.discrepancy.pushes import pushed
from hvdc_ident.discrepancy.rounds import Round
from hvdc_ident.discrepancy.search import _last, backward_elimination, forward_search, one_round
from hvdc_ident.errors import SimulationError
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import insertion_point_of
from tests.discrepancy.cases import experiments
from tests.discrepancy.refits import beside, plain


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
    turned = _last(both, 0)
    assert [p.candidate.effect for p in turned.placed] == ["lag", "gain"]
    assert [is_clear(turned, k) for k in range(2)] == [True, False]


def test_a_search_takes_out_again_what_is_nothing_beside_the_others(first: Refit) -> None:
    one = refitted(beside(first, "gain", "ref", {"k": 1.001}, {"k": (0.9, 1.1)}))
    both = refitted(beside(one, "lag", "wm", {"T": 0.02}, {"T": (1e-4, 0.3)}))
    search = SearchContext(("gain", "lag"), ("ref", "wm"), FrozenMap(), DiagnosisOptions(bootstraps=100), seed=0)
    begun = one_round(search, first, 1)
    rounds = tuple(replace(begun, winner=CandidateFit(begun.trials[0].pick, r, 100.0), trials=()) for r in (one, both))
    here, kept, notes = backward_elimination(search, first, both, rounds, 2)
    assert notes == ()
    assert [p.candidate.label for p in here.placed] == ["lag at wm"]
    assert [k.winner.refit.placed[-1].candidate.label for k in kept if k.winner] == ["lag at wm"]


def test_what_could_not_be_refitted_stays_told(first: Refit, monkeypatch: pytest.MonkeyPatch) -> None:
    lagged = refitted(beside(first, "lag", "wm", {"T": 0.02}, {"T": (1e-4, 0.3)}))
    search = SearchContext(("gain", "lag"), ("ref", "wm"), FrozenMap(), DiagnosisOptions(bootstraps=100), seed=0)
    begun = one_round(search, first, 1)
    lost = CandidateFit(begun.trials[-1].pick, replace(begun.trials[-1].refit, failure="it does not run"), -np.inf)
    monkeypatch.setattr(searching, "one_round", lambda *_: replace(begun, trials=begun.trials[:-1], failed=(lost,)))
    _, kept, _ = backward_elimination(search, first, lagged, [replace(begun, winner=begun.trials[0], trials=())], 1)
    assert kept[0].failed == (lost,)


def test_what_could_not_be_looked_for_again_stays_and_is_told(first: Refit, monkeypatch: pytest.MonkeyPatch) -> None:
    lagged = refitted(beside(first, "lag", "wm", {"T": 0.02}, {"T": (1e-4, 0.3)}))
    search = SearchContext(("gain", "lag"), ("ref", "wm"), FrozenMap(), DiagnosisOptions(bootstraps=100), seed=0)
    begun = replace(one_round(search, first, 1), trials=())
    begun = replace(begun, winner=CandidateFit(Pick(0, 0, 1.0, 0.0), lagged, 100.0), ruler=Ruler.of(lagged))

    def stopped(*_: object) -> Round:
        raise SimulationError("the simulation stopped", got="step-limit")

    monkeypatch.setattr(searching, "one_round", stopped)
    here, kept, notes = backward_elimination(search, first, lagged, [begun], 1)
    assert [p.candidate.label for p in here.placed] == ["lag at wm"] and kept == [begun]
    assert len(notes) == 1 and "lag at wm" in notes[0] and "step-limit" in notes[0]


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
    search = SearchContext(("gain", "coupling"), None, FrozenMap(), DiagnosisOptions(bootstraps=100), seed=0)
    found = one_round(search, two, 2)
    assert {c.at[0] for c in found.candidates} >= {"wm", "wm_before_second_order", "torque"}
    assert not {*inner} & {p for c in found.candidates for p in (*c.at, c.source)}


def test_rounds_that_are_over_have_the_answers_of_their_model() -> None:
    recorded = experiments(lag=0.03, offset=0.3)
    first = plain(recorded)
    search = SearchContext(("lag", "offset"), ("wm", "drag"), FrozenMap(), DiagnosisOptions(bootstraps=100), seed=0)
    outcome = forward_search(search, first)
    assert len(outcome.kept) == 2
    again, anew = outcome.rounds[0].answers(), pushed(first, slot_signals(first))
    assert again.keys() == anew.keys() == {"fit-1", "fit-2"}
    for name, path in anew.items():
        np.testing.assert_array_equal(again[name].values["wm"], path.values["wm"])
