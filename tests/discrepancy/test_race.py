"""Refits in a race: what leads comes to the end it would have come to alone, what cannot catch up is left where it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cases import experiments
from refits import beside, plain

from hvdc_ident.discrepancy.options import DiagnosisOptions
from hvdc_ident.discrepancy.refits.refit import Refit, RefitJob, run
from hvdc_ident.discrepancy.trials.context import SearchContext
from hvdc_ident.discrepancy.trials.race import Race
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.simulate import ModelSimulator

SEARCH = SearchContext("all", None, FrozenMap(), DiagnosisOptions(), 0)


@pytest.fixture(scope="module")
def before() -> Refit:
    """The drive without the lag of 30 ms that its records have."""
    return plain(experiments(lag=0.03))


def job(before: Refit, effect: str, at: str, size: float, begins: int = 1) -> RefitJob:
    one = beside(before, effect, at, {"T": size}, {"T": (1e-4, 1.0)})
    return replace(one, begins=one.begins * begins)


def test_where_none_is_better_than_nothing_yet_all_come_to_their_ends(
    before: Refit,
) -> None:
    jobs = [job(before, "lag", "wm", 0.2), job(before, "lag", "drag", 0.2)]
    alone = [run(j) for j in jobs]
    for found, expected in zip(Race(sprint=4).run(SEARCH, before.chi2, jobs, ["a", "b"]), alone, strict=True):
        assert found.ended
        assert found.chi2 == pytest.approx(expected.chi2, rel=1e-5)
        assert found.theta == pytest.approx(expected.theta, rel=1e-2)


def test_nothing_goes_on_that_is_out_of_reach_of_what_is_known(before: Refit) -> None:
    (left,) = Race(sprint=2).run(SEARCH, before.chi2, [job(before, "lag", "wm", 0.2)], ["a"], best=-1e9)
    assert not left.ended
    assert left.chi2 > run(job(before, "lag", "wm", 0.2)).chi2


def test_a_start_given_twice_is_run_once(before: Refit, monkeypatch: pytest.MonkeyPatch) -> None:
    count = []
    plain = ModelSimulator.simulate

    def counted(self, *given, **named):  # type: ignore[no-untyped-def]
        count.append(1)
        return plain(self, *given, **named)

    monkeypatch.setattr(ModelSimulator, "simulate", counted)
    one = run(job(before, "lag", "wm", 0.05))
    runs = len(count)
    two = run(job(before, "lag", "wm", 0.05, begins=2))
    assert len(count) == 2 * runs
    assert np.array_equal(one.theta, two.theta)


def test_those_that_promise_most_are_admitted_whoever_shares_their_model(before: Refit) -> None:
    """The promise is where one Gauss-Newton step of all unknowns, without bounds, would come to if the model were linear."""
    one, other = job(before, "lag", "wm", 0.2), job(before, "lag", "drag", 0.2)
    at = len(before.theta)

    def sized(j: RefitJob, size: float) -> RefitJob:
        begin = j.begins[0].copy()
        begin[at] = size
        return replace(j, begins=(begin,))

    jobs = [*(sized(one, s) for s in (0.2, 0.02, 0.05)), *(sized(other, s) for s in (0.3, 0.05)), sized(one, 0.04)]
    expected = []
    for j in jobs:
        blocks = j.problem.blocks(j.begins[0])
        r, slopes = np.concatenate([b.residual for b in blocks]), np.vstack([b.jacobian for b in blocks])
        step = np.linalg.lstsq(slopes / np.linalg.norm(slopes, axis=0), r, rcond=None)[0]
        expected.append(float(np.sum((r - slopes / np.linalg.norm(slopes, axis=0) @ step) ** 2)))
    admitted = Race(entrants=2).admitted(SEARCH, jobs, "race")
    assert admitted == sorted(np.argsort(expected)[:2].tolist())
    assert {jobs[k].placed[-1].candidate.at for k in admitted} == {("wm",)}
    assert Race(entrants=6).admitted(SEARCH, jobs, "race") == list(range(6)) == Race().admitted(SEARCH, jobs, "race")
