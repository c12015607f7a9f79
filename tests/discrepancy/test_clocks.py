"""Clocks that are off by less than half a row are found as such and are no effect. Records: scipy, in `cases`."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from hvdc_ident.discrepancy import DiagnosisOptions, diagnose, hypothesis
from hvdc_ident.discrepancy.hypothesis import Refit
from hvdc_ident.discrepancy.moves import MOVES
from hvdc_ident.discrepancy.moves.clocks import clocks, on_their_clocks
from hvdc_ident.discrepancy.options import SearchContext
from hvdc_ident.discrepancy.search import CLOCKS, Search
from hvdc_ident.errors import SimulationError
from hvdc_ident.immutable import FrozenMap
from tests.discrepancy.cases import FREE, TRUE, experiments, model
from tests.discrepancy.refits import plain, search_from

LATE = {"fit-1": 1.5e-3, "fit-2": -1.2e-3, "held": 1e-3}
"""Of rows every 4 ms."""
SCATTER = {"fit-1": 4e-5, "fit-2": 2.2e-4, "held": 8e-5}
"""Standard deviations of the estimates over eight records of noise, s; their means are off by less than a third of that."""


def search_of(first: Refit) -> SearchContext:
    return SearchContext("all", None, FrozenMap(), DiagnosisOptions(), seed=0, records=first.problem.experiments)


def test_clocks_that_are_off_are_found_and_no_effect_is_named() -> None:
    found = diagnose(model(), experiments(late=LATE), FREE, seed=0)
    assert found.verdict == "no-evidence" and not found.effects
    assert re.search(
        "that of fit-1 is 1.[45].* ms late, that of fit-2 is .* ms early and that of held is .* ms late", found.text
    )
    assert found.parameters_after == pytest.approx({n: TRUE[n] for n in ("Kp", "Ki")}, rel=0.01)


def test_beside_clocks_that_are_off_an_effect_is_named_with_its_size() -> None:
    found = diagnose(
        model(), experiments(lag=0.03, late=LATE), FREE, effects=["lag", "delay", "gain", "sample-hold"], seed=0
    )
    assert [(e.effect, e.at) for e in found.effects] == [("lag", ("wm",))]
    assert found.effects[0].parameters["T"].value == pytest.approx(0.03, rel=0.01)
    assert "The clocks of the records are off" in found.text


def test_by_how_much_a_clock_is_late() -> None:
    first = plain(experiments(late=LATE))
    base, here = on_their_clocks(search_of(first), first, first)
    off = clocks(search_of(first), here)
    assert off.keys() == LATE.keys() and all(abs(off[n] - LATE[n]) < 4.0 * SCATTER[n] for n in LATE)
    assert base.problem.experiments is here.problem.experiments
    assert here.rows == first.rows - 2 and here.chi2 / here.rows == pytest.approx(1.0, abs=0.1)


def test_records_with_a_right_clock_stay_as_they_are() -> None:
    first = plain(experiments())
    assert on_their_clocks(search_of(first), first, first) == (first, first)
    assert clocks(search_of(first), first) == {}


def test_a_clock_that_would_be_off_by_more_than_half_a_row_is_none() -> None:
    first = plain(experiments(late={"fit-1": 3e-3}))
    assert on_their_clocks(search_of(first), first, first)[1] is first


def test_records_whose_misfit_an_effect_explains_are_on_their_clocks() -> None:
    """A lag of less than half a row looks like late clocks by itself; what a clock has to explain stays moved."""
    first = plain(experiments(lag=0.0015))
    moved = on_their_clocks(search_of(first), first, first)[1]
    assert clocks(search_of(first), moved), "without the lag they seem to be off"
    outcome = search_from(replace(search_of(first), effects=("lag", "gain"), places=("wm",)), first)
    assert [t.label for t in outcome.best.terms] == ["lag at wm"] and clocks(search_of(first), outcome.refit) == {}
    late = plain(experiments(lag=0.03, late=LATE))
    outcome = search_from(replace(search_of(late), effects=("lag", "gain"), places=("wm",)), late)
    assert {t.kind for t in outcome.best.terms} == {CLOCKS, "lag"}
    off = clocks(search_of(late), outcome.refit)
    assert off.keys() == LATE.keys() and all(abs(off[n] - LATE[n]) < 4.0 * SCATTER[n] for n in LATE)


def test_each_clock_that_is_off_has_its_price() -> None:
    first = plain(experiments(late=LATE))
    search = Search(search_of(first), first, MOVES)
    (timed,) = [h for m in MOVES if m.name == CLOCKS for h in m.make(search, search.root)]
    ruler, fewer = search.ruler, replace(timed, terms=(replace(timed.terms[0], at=("fit-1",)),))
    assert timed.terms[0].at == tuple(LATE)
    assert search.cost(timed, ruler) - search.cost(fewer, ruler) == pytest.approx(2.0 * ruler.price)


def test_records_stay_where_the_hypothesis_does_not_run_on_moved_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    first = plain(experiments(late=LATE))
    monkeypatch.setattr(hypothesis, "joint_refit_job", raising)
    assert on_their_clocks(search_of(first), first, first) == (first, first)


def raising(*_: object) -> None:
    raise SimulationError("it does not run")
