"""Errors that stated values and recorded levels are known to have are no missing effect. Records: scipy, in `cases`."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident import Experiment
from hvdc_ident.discrepancy import DiagnosisOptions, diagnose
from hvdc_ident.discrepancy.hypothesis import Refit, judged
from hvdc_ident.discrepancy.known_errors import KnownErrors, known_errors
from hvdc_ident.discrepancy.moves import stated
from hvdc_ident.discrepancy.nominal import nominal
from hvdc_ident.discrepancy.options import SearchContext
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model
from hvdc_ident.simulate import ModelSimulator
from tests.discrepancy.cases import FREE, TRUE, experiments, model

QUIETER = 20.0
"""Times that the noise is smaller than in the other tests: half a per cent of a range is seen in it."""
RANGE = 3.2
"""Of the torque in the fitted records, about."""
SMALL, LARGE = 0.002 * RANGE, 0.02 * RANGE
"""Levels that a recorder of class 0.5 may add to the torque, and may not."""


def of_a_card(card: Model, data: tuple[Experiment, ...]) -> KnownErrors:
    """The errors of a drive, refitted."""
    search = SearchContext("all", None, FrozenMap(), DiagnosisOptions(), seed=0, stated=stated(card, FREE))
    start, _ = nominal(ModelSimulator(card), data, FREE, {}, None, starts=1, seed=0, executor=None)
    return known_errors(search, judged(Refit(card, (), start.problem, start.noise, start.theta)))


def test_the_likeliest_errors_are_those_that_the_card_has() -> None:
    wrong = {"J": 0.99 * TRUE["J"], "b": 1.015 * TRUE["b"]}
    found = of_a_card(model().with_values(wrong), experiments(quieter=QUIETER, meter=lambda torque: torque + SMALL))
    assert found.errors["J"] == pytest.approx(1 / 0.99 - 1, abs=2e-3)
    assert found.errors["b"] == pytest.approx(1 / 1.015 - 1, abs=3e-3)
    assert found.errors["torque"] == pytest.approx(SMALL, rel=0.3)
    rows = sum(e.time.size for e in experiments()[:2]) * 2
    assert found.chi2 < 1.1 * rows


@pytest.mark.parametrize("level, verdict", [(SMALL, "ambiguous"), (LARGE, "named")])
def test_an_offset_is_named_where_it_is_more_than_a_recorder_may_have(level: float, verdict: str) -> None:
    data = experiments(quieter=QUIETER, meter=lambda torque: torque + level)
    found = diagnose(model(), data, FREE, effects=["offset", "lag", "gain"])
    assert found.verdict == verdict
    assert "offset" in {r.effect for g in found.ambiguity for r in g} | {e.effect for e in found.effects}
    assert ("the level of torque by" in found.text) == (verdict == "ambiguous")


def test_an_effect_that_no_such_error_explains_is_named() -> None:
    found = diagnose(model(), experiments(quieter=QUIETER, lag=0.01), FREE, effects=["offset", "lag", "gain"])
    assert found.verdict == "named" and [e.effect for e in found.effects] == ["lag"]


def test_the_range_of_the_torque_is_about_what_is_taken_for_it() -> None:
    torque = np.concatenate([e.measured["torque"] for e in experiments()[:2] if e.measured])
    assert np.ptp(torque) == pytest.approx(RANGE, rel=0.3)
