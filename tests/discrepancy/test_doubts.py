"""What tells against a name: experiments that ask for different sizes of it, and what it leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from cases import TRUE, corners, experiments, model
from refits import answered, beside, plain
from scipy.stats import kstest

from hvdc_ident import InputSignal
from hvdc_ident.discrepancy import DiagnosisOptions
from hvdc_ident.discrepancy.refits.constancy import constancy
from hvdc_ident.discrepancy.refits.refit import Refit, run
from hvdc_ident.discrepancy.search.forward import SearchOutcome
from hvdc_ident.discrepancy.search.rounds import one_round
from hvdc_ident.discrepancy.trials.context import SearchContext
from hvdc_ident.discrepancy.trials.select import CandidateFit, Pick
from hvdc_ident.discrepancy.verdict.doubts import Doubt, _turned, doubt
from hvdc_ident.effects import apply_effects
from hvdc_ident.immutable import FrozenMap


def chance(refit: Refit) -> float:
    """The chance that experiments of one size differ as these do."""
    return constancy(refit, refit.nominal(), refit.placed[-1]).p


def lagged(before: Refit) -> Refit:
    return run(beside(before, "lag", "wm", {"T": 0.02}, {"T": (1e-3, 0.3)}))


def lossy() -> Refit:
    """A drag of third order, told as a loss by the speed."""
    before = plain(experiments(drag=lambda w: TRUE["b"] * w + 0.1 * (w - 1.0) ** 3))
    sizes = dict.fromkeys("abc", 0.01)
    return run(beside(before, "loss", "drag", sizes, dict.fromkeys("abc", (-3.0, 3.0)), source="w"))


def test_of_what_is_there_every_chance_is_as_likely() -> None:
    there = apply_effects(model(), [{"effect": "lag", "at": ["wm"], "parameters": {"T": 0.03}}])
    records = experiments()
    found = [chance(lagged(plain(answered(there, records, seed)))) for seed in range(25)]
    assert kstest(found, "uniform").pvalue > 1e-3, np.sort(found)


def test_a_form_in_anothers_stead_has_a_size_in_each_experiment() -> None:
    assert chance(lossy()) < 1e-9


def test_what_is_told_by_one_experiment_alone_or_jumps_with_its_size_is_not_asked() -> None:
    before = plain(experiments())
    stepped = run(beside(before, "quantisation", "wm", {"step": 0.01}, {"step": (1e-3, 0.1)}))
    assert chance(stepped) == 1.0
    alone = plain([e for e in experiments(lag=0.03) if e.name != "fit-2"])
    assert chance(lagged(alone)) == 1.0


def doubted(
    refit: Refit, explained: float = 1.0, told: float = 1.0, beside: Sequence[CandidateFit] = ()
) -> Doubt | None:
    """What tells against the refit's effect. beside: refits of another effect with it, too small to matter."""
    last = one_round(SearchContext(("gain",), ("wm",), FrozenMap(), DiagnosisOptions(), seed=0), refit, 2)
    assert last.winner is None
    last = replace(last, trials=tuple(beside))
    return doubt(SearchOutcome(refit, (last,), (last,)), refit.nominal(), explained, told, 1.0, DiagnosisOptions())


def test_a_name_is_in_doubt_where_experiments_ask_for_different_sizes() -> None:
    assert doubted(lagged(plain(experiments(lag=0.03)))) is None
    against = doubted(lossy())
    assert against is not None and "different sizes of loss at drag" in against.why and "loss" in against.advice
    assert doubted(lossy(), explained=1e9) is None, "of so little of what it explains nothing is made"


def test_a_name_is_in_doubt_where_something_quicker_shows_after_breaks() -> None:
    there = apply_effects(model(), [{"effect": "lag", "at": ["ref"], "parameters": {"T": 0.004}}])
    quick = plain(answered(there, experiments(), seed=0))
    against = doubted(run(beside(quick, "gain", "wm", {"k": 1.01}, {"k": (0.5, 2.0)})))
    assert against is not None and "first rows after" in against.why and "as densely" in against.advice


@pytest.mark.parametrize(("told", "held_out", "doubtful"), [(0.9, 2.4, True), (0.97, 2.4, False), (0.9, 1.1, False)])
def test_a_name_is_in_doubt_where_held_out_records_are_explained_in_part(
    told: float, held_out: float, doubtful: bool
) -> None:
    refit = replace(lagged(plain(experiments(lag=0.03))), holdout=held_out)
    against = doubted(refit, told=told)
    assert (against is not None and "90% of the held-out gap" in against.why) == doubtful


@pytest.mark.parametrize(("gain", "score", "doubtful"), [(40.0, 1e4, True), (5.0, 1e4, False), (40.0, 0.0, False)])
def test_a_name_is_in_doubt_where_something_beside_it_is_no_noise(gain: float, score: float, doubtful: bool) -> None:
    refit = lagged(plain(experiments(lag=0.03)))
    more = replace(run(beside(refit, "gain", "torque", {"k": 1.01}, {"k": (0.5, 2.0)})), chi2=refit.chi2 - 50.0)
    against = doubted(refit, beside=[CandidateFit(Pick(0, 0, 1.0, score), more, gain, evidence=gain)])
    assert (against is not None and "gain at torque beside it" in against.why) == doubtful


@pytest.mark.parametrize(
    ("course", "turned"),
    [([0, 1, 2, 3], False), ([0, 1, 0.6], False), ([0, 1, 0.4], True), ([1, 0, 0.6], True), ([0, 0.4, 0, 0.4], False)],
)
def test_a_signal_has_turned_where_it_goes_back_by_more_than_a_width(course: list[float], turned: bool) -> None:
    assert _turned(np.array(course, dtype=float), 0.5) == turned
    assert _turned(-np.array(course, dtype=float), 0.5) == turned


def test_a_play_that_is_passed_in_one_direction_is_doubted() -> None:
    """In a record that rises only, whatever shifts a signal once it has moved looks like a play."""
    refits = {}
    for name, moves in {"up": [0.6], "both": [0.6, -0.9]}.items():
        held = []
        for e in experiments():
            steps = [(0.2 + 0.5 * k, move) for k, move in enumerate(moves)]
            held.append(replace(e, inputs=FrozenMap({"ref": InputSignal.corners(corners(1.0, steps))})))
        there = apply_effects(model(), [{"effect": "backlash", "at": ["ref"], "parameters": {"width": 0.2}}])
        first = plain(answered(there, held, seed=0))
        refits[name] = run(beside(first, "backlash", "ref", {"width": 0.18}, {"width": (1e-3, 1.0)}))
    against = doubted(refits["up"])
    assert against is not None and "turn by more than 0.2" in against.why and "ramps both ways" in against.advice
    assert doubted(refits["both"]) is None
