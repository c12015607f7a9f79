"""Refits in a race: what leads comes to the end it would have come to alone, what cannot catch up is left where it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from hvdc_ident.discrepancy import diagnose, hypothesis
from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.expansion import Race
from hvdc_ident.discrepancy.hypothesis import Refit, RefitJob, refitted
from hvdc_ident.discrepancy.options import Course, DiagnosisOptions, SearchContext
from hvdc_ident.discrepancy.screen import _Batch
from hvdc_ident.errors import ComputationError, InputError
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.simulate import ModelSimulator
from tests.discrepancy.cases import FREE, experiments, model
from tests.discrepancy.refits import beside, plain

SEARCH = SearchContext("all", None, FrozenMap(), DiagnosisOptions(), 0)


@pytest.fixture(scope="module")
def before() -> Refit:
    """The drive without the lag of 30 ms that its records have."""
    return plain(experiments(lag=0.03))


def job(before: Refit, effect: str, at: str, size: float, begins: int = 1) -> RefitJob:
    one = beside(before, effect, at, {"T": size}, {"T": (1e-4, 1.0)})
    return replace(one, begins=one.begins * begins)


def test_where_none_is_better_than_nothing_yet_all_come_to_the_ends_that_they_would_have_come_to_alone(
    before: Refit,
) -> None:
    jobs = [job(before, "lag", "wm", 0.2), job(before, "lag", "drag", 0.2)]
    alone = [refitted(j) for j in jobs]
    for found, expected in zip(Race(laps=(4,)).run(SEARCH, before, jobs, ["a", "b"]), alone, strict=True):
        # One creeps along a valley until its evaluations are spent, or nearly so: that is for the last digits to say.
        assert found.chi2 == pytest.approx(expected.chi2, rel=1e-3)
        if expected.ended and found.ended:
            assert found.chi2 == pytest.approx(expected.chi2, rel=1e-4), "a walk ends where a step gains a millionth"
            assert found.theta == pytest.approx(expected.theta, rel=1e-2)
    assert alone[0].ended


def test_nothing_goes_on_that_is_out_of_reach_of_what_is_known(before: Refit) -> None:
    (left,) = Race(laps=(2,), least=0).run(SEARCH, before, [job(before, "lag", "wm", 0.2)], ["a"], best=-1e9)
    assert not left.ended
    assert left.chi2 > refitted(job(before, "lag", "wm", 0.2)).chi2


def test_a_start_given_twice_is_run_once(before: Refit, monkeypatch: pytest.MonkeyPatch) -> None:
    count = []
    plain = ModelSimulator.simulate

    def counted(self, *given, **named):  # type: ignore[no-untyped-def]
        count.append(1)
        return plain(self, *given, **named)

    monkeypatch.setattr(ModelSimulator, "simulate", counted)
    one = refitted(job(before, "lag", "wm", 0.05))
    runs = len(count)
    two = refitted(job(before, "lag", "wm", 0.05, begins=2))
    assert len(count) == 2 * runs
    assert np.array_equal(one.theta, two.theta)


def test_progress_counts_the_batch_at_work_and_tells_the_best_so_far() -> None:
    """How many batches there will be depends on what they find: none of all is told."""
    seen: list[tuple[int, int, str]] = []
    course = Course(lambda done, total, text: seen.append((done, total, text)))
    for total in (1, 40, 7):
        for done in range(total + 1):
            course.step(done, total, "refits")
        course.lead(f"after {total}", 1.0 / total)
    assert seen[0] == (0, 1, "refits") and seen[5][:2] == (3, 40)
    assert seen[-1] == (7, 7, "refits, 7 of 7; best so far: after 40, 0.025 times the noise is left")


FAILS = (
    InputError("a value lies outside its bounds"),
    ComputationError("it does not converge"),
    np.linalg.LinAlgError("SVD did not converge"),
    ValueError("operands could not be broadcast"),
    ZeroDivisionError("division by zero"),
)


@pytest.mark.parametrize("error", FAILS, ids=lambda e: type(e).__name__)
def test_a_candidate_that_raises_has_failed_with_the_reason_and_the_others_go_on(
    before: Refit, error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wherever it raises: where its refit is made, at its first run, or where its result is judged."""
    sound, broken = job(before, "lag", "wm", 0.05), job(before, "lag", "drag", 0.05)
    alone = refitted(sound)
    for place in ("_best_walk", "judged", "_walk"):
        plain = getattr(hypothesis, place)

        def fails(of: object, *given: object, plain: Callable[..., object] = plain) -> object:
            placed = getattr(of, "placed", None)
            if (placed or (None,))[0] is broken.placed[0] or of is broken.problem:
                raise error
            return plain(of, *given)

        with monkeypatch.context() as patched:
            patched.setattr(hypothesis, place, fails)
            told, lost = Race(reach=-1e6, near=-1e6).run(SEARCH, before, [sound, broken], ["a", "b"])
        assert str(error) in lost.failure
        assert not told.failure and told.chi2 == pytest.approx(alone.chi2, rel=1e-5)


def test_a_diagnosis_outlives_a_candidate_that_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    """The delay raises where its refit is made; the lag that is missing is named all the same."""
    plain = hypothesis.refit_job

    def fails(before: Refit, candidate: CandidateEffect, *given: object) -> object:
        if candidate.effect == "delay":
            raise ValueError("no such delay")
        return plain(before, candidate, *given)  # type: ignore[arg-type]

    monkeypatch.setattr("hvdc_ident.discrepancy.expansion.refit_job", fails)
    found = diagnose(model(), experiments(lag=0.03), FREE, effects=["lag", "delay"], places=["wm"])
    assert [(e.effect, e.at) for e in found.effects] == [("lag", ("wm",))], found.text
    statuses = {c.effect: c.status for c in found.candidates if c.round == 1}
    assert statuses == {"lag": "refitted", "delay": "failed: no such delay"}


def test_a_candidate_that_cannot_be_screened_is_told_and_the_others_are_looked_at(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plain = _Batch.__call__

    def fails(of: _Batch, column: tuple[int, int]) -> object:
        candidate = of.candidates[column[0]]
        if (candidate.effect, candidate.at) == ("quantisation", ("err",)):
            raise np.linalg.LinAlgError("SVD did not converge")
        return plain(of, column)

    monkeypatch.setattr(_Batch, "__call__", fails)
    quick, looked_for = DiagnosisOptions(fallback=False), ["lag", "quantisation"]
    found = diagnose(model(), experiments(lag=0.03), FREE, effects=looked_for, places=["wm", "err"], options=quick)
    assert [(e.effect, e.at) for e in found.effects] == [("lag", ("wm",))], found.text
    lines = {(c.effect, c.at): c.status for c in found.candidates if c.round == 1}
    assert lines["quantisation", ("err",)] == "failed: SVD did not converge", lines
    assert "failed" not in lines["lag", ("wm",)]
