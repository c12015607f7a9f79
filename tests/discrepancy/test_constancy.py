"""An effect has one size: where each experiment asks for another, what is named stands for something else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from cases import TRUE, experiments, model
from refits import answered, beside, plain
from scipy.stats import kstest

from hvdc_ident.discrepancy import Options
from hvdc_ident.discrepancy.constancy import constancy
from hvdc_ident.discrepancy.refit import Refit, run
from hvdc_ident.discrepancy.result import Rival
from hvdc_ident.discrepancy.rounds import one_round
from hvdc_ident.discrepancy.search import Outcome
from hvdc_ident.discrepancy.select import Pick, Trial
from hvdc_ident.discrepancy.state import Search
from hvdc_ident.discrepancy.verdict import Judgement, _doubted
from hvdc_ident.frozen import FrozenMap


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
    there = model().with_effects([{"effect": "lag", "at": ["wm"], "parameters": {"T": 0.03}}])
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


def judged(refit: Refit, trifle: float = 0.0, beside: Sequence[Trial] = ()) -> Judgement:
    """The refit's effect as it would be named. beside: refits of another effect with it, too small to matter."""
    label = refit.placed[-1].candidate.label
    named = Judgement("named", f"Missing: {label}.", (), ((Rival("lag", ("wm",), 0.0),),))
    last = one_round(Search(("gain",), ("wm",), FrozenMap(), Options(), seed=0), refit, 2)
    assert last.winner is None
    last = replace(last, trials=tuple(beside))
    return _doubted(named, Outcome(refit, (last,), (last,)), refit.nominal(), trifle, Options())


def test_a_name_is_in_doubt_where_experiments_ask_for_different_sizes() -> None:
    right = judged(lagged(plain(experiments(lag=0.03))))
    assert right.verdict == "named" and not right.doubt
    wrong = judged(lossy())
    assert wrong.verdict == "ambiguous" and wrong.experiment and "different sizes of loss at drag" in wrong.text
    assert wrong.doubt in wrong.text
    assert judged(lossy(), trifle=1e6).verdict == "named", "of so little of what it explains nothing is made"


def test_a_name_is_in_doubt_where_something_quicker_shows_after_breaks() -> None:
    there = model().with_effects([{"effect": "lag", "at": ["ref"], "parameters": {"T": 0.004}}])
    quick = plain(answered(there, experiments(), seed=0))
    found = judged(run(beside(quick, "gain", "wm", {"k": 1.01}, {"k": (0.5, 2.0)})))
    assert found.verdict == "ambiguous" and "first rows after" in found.doubt
    assert "as densely" in found.experiment["text"]


@pytest.mark.parametrize(
    ("gain", "score", "verdict"), [(40.0, 1e4, "ambiguous"), (5.0, 1e4, "named"), (40.0, 0.0, "named")]
)
def test_a_name_is_in_doubt_where_something_beside_it_is_no_noise(gain: float, score: float, verdict: str) -> None:
    refit = lagged(plain(experiments(lag=0.03)))
    more = replace(run(beside(refit, "gain", "torque", {"k": 1.01}, {"k": (0.5, 2.0)})), chi2=refit.chi2 - 50.0)
    found = judged(refit, beside=[Trial(Pick(0, 0, 1.0, score), more, gain, evidence=gain)])
    assert found.verdict == verdict
    assert ("gain at torque beside it" in found.doubt) == (verdict == "ambiguous")
