"""An effect has one size: where each experiment asks for another, what is named stands for something else."""

from __future__ import annotations

import numpy as np
from cases import TRUE, experiments, model
from refits import answered, beside, plain
from scipy.stats import kstest

from hvdc_ident.discrepancy.constancy import constancy
from hvdc_ident.discrepancy.refit import Refit, run
from hvdc_ident.discrepancy.result import Rival
from hvdc_ident.discrepancy.verdict import Judgement, _doubted


def chance(refit: Refit) -> float:
    """The chance that experiments of one size differ as these do."""
    return constancy(refit, refit.nominal(), refit.placed[-1])


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


def test_a_name_is_in_doubt_where_experiments_ask_for_different_sizes() -> None:
    def told(refit: Refit, name: str) -> Judgement:
        named = Judgement("named", f"Missing: {name}.", (), ((Rival(name, ("drag",), 0.0),),))
        return _doubted(named, refit, refit.nominal(), name)

    right = lagged(plain(experiments(lag=0.03)))
    assert told(right, "lag").verdict == "named" and not told(right, "lag").doubt
    wrong = told(lossy(), "loss")
    assert wrong.verdict == "ambiguous" and wrong.experiment and "different sizes of loss at drag" in wrong.text
    assert wrong.doubt in wrong.text
