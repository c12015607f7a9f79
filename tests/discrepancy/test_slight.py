"""Slight errors of stated values and of recorded levels are no missing effect. Records: scipy, in `cases`."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident import Experiment
from hvdc_ident.discrepancy import DiagnosisOptions, diagnose
from hvdc_ident.discrepancy.hypothesis import Refit, judged
from hvdc_ident.discrepancy.nominal import nominal
from hvdc_ident.discrepancy.stated import COVERED, LEVEL_ERROR, STATED_ERROR, SlightErrors, _weight, stated
from hvdc_ident.fit.noise import SURE
from hvdc_ident.model import Model
from hvdc_ident.simulate import ModelSimulator
from tests.discrepancy.cases import FREE, TRUE, experiments, model

QUIETER = 20.0
"""Times that the noise is smaller than in the other tests: half a per cent of a range is seen in it."""
RANGE = 3.2
"""Of the torque in the fitted records, about."""
SMALL, LARGE = 0.002 * RANGE, 0.02 * RANGE
"""Levels that a recorder of class 0.5 may add to the torque, and may not."""
OPTIONS = DiagnosisOptions(fallback=False)


def of_a_card(card: Model, data: tuple[Experiment, ...]) -> Refit:
    """A drive by its card, refitted."""
    start, _ = nominal(ModelSimulator(card), data, FREE, {}, None, starts=1, seed=0, executor=None)
    return judged(Refit(card, (), start.problem, start.noise, start.theta))


def test_the_likeliest_errors_are_those_that_the_card_has() -> None:
    wrong = {"J": 0.99 * TRUE["J"], "b": 1.015 * TRUE["b"]}
    card = model().with_values(wrong)
    first = of_a_card(card, experiments(quieter=QUIETER, meter=lambda torque: torque + SMALL))
    found = SlightErrors.of(first, stated(card, FREE)).under(first)
    assert found.relative["J"] == pytest.approx(1 / 0.99 - 1, abs=2e-3)
    assert found.relative["b"] == pytest.approx(1 / 1.015 - 1, abs=3e-3)
    assert found.relative["torque"] == pytest.approx(SMALL, rel=0.3)
    rows = sum(e.time.size for e in experiments()[:2]) * 2
    assert first.chi2 > 2.0 * rows and first.chi2 - found.fall_fitted < 1.1 * rows
    assert str(found).startswith(("J by 1", "b by -1", "the level of torque by 0.0"))


def test_what_is_larger_than_such_errors_stays() -> None:
    """Together they are no larger than chance makes as many: an inertia that is a fifth off is none of them."""
    card = model().with_values({"J": 0.8 * TRUE["J"]})
    first = of_a_card(card, experiments(quieter=QUIETER))
    slight = SlightErrors.of(first, stated(card, FREE))
    found = slight.under(first)
    size = dict(zip(slight.names, slight.sizes, strict=True))
    deviations = np.array([e / size[n] for n, e in found.relative.items()])
    assert len(deviations) == 4 and np.sum(deviations**2) <= (4.0 + SURE * np.sqrt(8.0)) * (1.0 + 1e-6)
    assert first.chi2 - found.fall_fitted > 10.0 * first.rows


def test_errors_are_as_large_as_their_class_allows() -> None:
    first = of_a_card(model(), experiments())
    slight = SlightErrors.of(first, stated(model(), FREE))
    ranges = [np.ptp(np.concatenate([e.measured[o] for e in experiments()[:2] if e.measured])) for o in ("w", "torque")]
    assert slight.names == ("J", "b", "w", "torque")
    expected = (*(2 * [STATED_ERROR / COVERED]), *(LEVEL_ERROR / COVERED * r for r in ranges))
    assert slight.sizes == pytest.approx(expected, rel=0.02), "rows at jumps are left out of a fit"


def test_what_the_records_show_of_no_error_is_none() -> None:
    first = of_a_card(model(), experiments())
    found = SlightErrors.of(first, stated(model(), FREE)).under(first)
    assert all(abs(found.relative[n]) < 0.02 for n in ("J", "b"))
    assert found.fall_fitted < 15.0, "what noise gives four errors"


@pytest.mark.parametrize("most", [100.0, 1.0])
def test_the_weight_of_the_errors_is_one_or_leads_to_the_edge_of_their_ball(most: float) -> None:
    strength, asked = np.array([0.0, 3.0, 40.0]), np.array([2.0, 9.0, 200.0])

    def squares(weight: float) -> float:
        return float(np.sum((asked / (weight + strength)) ** 2))

    assert squares(1.0) == pytest.approx(4.0 + 81.0 / 16.0 + (200.0 / 41.0) ** 2)
    weight = _weight(strength, asked, most)
    assert weight == 1.0 if most > squares(1.0) else squares(weight) == pytest.approx(most, rel=1e-4)


@pytest.mark.parametrize(("level", "told"), [(SMALL, False), (LARGE, True)])
def test_an_offset_is_named_where_it_is_more_than_a_recorder_may_have(level: float, told: bool) -> None:
    data = experiments(quieter=QUIETER, meter=lambda torque: torque + level)
    found = diagnose(model(), data, FREE, effects=["offset", "lag", "gain"], options=OPTIONS)
    alone = found.verdict == "named" and [e.effect for e in found.effects] == ["offset"]
    assert alone == told
    assert ("the level of torque by" in found.text) != told


def test_an_effect_that_no_such_error_explains_is_named() -> None:
    found = diagnose(model(), experiments(quieter=QUIETER, lag=0.01), FREE, effects=["offset", "lag", "gain"])
    assert found.verdict == "named" and [e.effect for e in found.effects] == ["lag"]


def test_several_values_that_are_a_per_cent_off_are_no_effect() -> None:
    """Together they look like a gain; each by itself is what a data sheet may be off. A value that is told is the true one."""
    card = model().with_values({"J": 0.99 * TRUE["J"], "b": 1.01 * TRUE["b"]})
    found = diagnose(card, experiments(quieter=QUIETER), FREE, effects=["offset", "lag", "gain"])
    assert not found.effects
    told = {n: s.value for f in found.findings if f.effect == "parameter" for n, s in f.parameters.items()}
    assert told == pytest.approx({n: TRUE[n] for n in told}, rel=0.01)


def test_the_range_of_the_torque_is_about_what_is_taken_for_it() -> None:
    torque = np.concatenate([e.measured["torque"] for e in experiments()[:2] if e.measured])
    assert np.ptp(torque) == pytest.approx(RANGE, rel=0.3)
