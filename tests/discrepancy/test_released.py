"""A parameter that the report held, and whose value is wrong, is a hypothesis beside the effects. Records: scipy, in `cases`."""

from __future__ import annotations

import pytest

from hvdc_ident import Experiment
from hvdc_ident.discrepancy import DiagnosisOptions, diagnose
from hvdc_ident.discrepancy.hypothesis import Refit, RefitJob, judged, refitted
from hvdc_ident.discrepancy.moves import _with_free, held_again, released
from hvdc_ident.discrepancy.nominal import nominal
from hvdc_ident.discrepancy.options import SearchContext
from hvdc_ident.fit import FitParameter
from hvdc_ident.identifiability import IdentifiabilityReport
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.simulate import ModelSimulator
from tests.discrepancy.cases import FREE, experiments, model
from tests.discrepancy.refits import beside

FRICTION = 0.45
CANDIDATES = (*FREE, FitParameter("b", 0.3, 0.01, 2.0))
VERDICTS = {"Kp": "identifiable", "Ki": "identifiable", "b": "weak"}
REPORT = IdentifiabilityReport.from_dict(
    {
        "identifiable": ["Kp", "Ki"],
        "parameters": {n: {"name": n, "verdict": v, "reason": "", "value": 1.0} for n, v in VERDICTS.items()},
        "held": {"b": {"value": 0.3, "reason": "the model does not fit"}},
    }
)
"""A report that a misfit has kept from telling the friction, which is held at a wrong value."""
TRIED = ["lag", "coupling", "gain", "loss", "conductance"]
"""Among them those that put a wrong friction into words as an effect."""


def test_a_wrong_value_of_a_held_parameter_is_the_finding_and_no_effect() -> None:
    found = diagnose(model(), experiments(drag=lambda w: FRICTION * w), CANDIDATES, effects=TRIED, report=REPORT)
    assert found.verdict == "no-evidence" and not found.effects
    assert found.findings[0].effect == "parameter"
    assert "No effect is missing" in found.text and "b is 0.4" in found.text and "not 0.3" in found.text
    assert found.parameters_after["b"] == pytest.approx(FRICTION, rel=0.01)
    assert found.gap.pooled["augmented"]["holdout"] == pytest.approx(1.0, abs=0.1)


def test_beside_a_missing_effect_the_held_parameter_is_set_free_and_told() -> None:
    data = experiments(lag=0.03, drag=lambda w: FRICTION * w)
    found = diagnose(model(), data, CANDIDATES, effects=TRIED, report=REPORT)
    assert [(e.effect, e.at) for e in found.effects] == [("lag", ("wm",))]
    assert found.verdict == "named"
    assert found.effects[0].parameters["T"].value == pytest.approx(0.03, rel=0.02)
    assert found.parameters_after["b"] == pytest.approx(FRICTION, rel=0.01)
    (friction,) = [f for f in found.findings if f.effect == "parameter"]
    low, high = friction.parameters["b"].ci95 or (None, None)
    assert low is not None and high is not None and low < FRICTION < high


def test_a_held_parameter_whose_value_is_right_stays_held() -> None:
    found = diagnose(model(), experiments(lag=0.03), CANDIDATES, effects=TRIED, report=REPORT)
    assert [(e.effect, e.at) for e in found.effects] == [("lag", ("wm",))]
    assert found.parameters_after["b"] == 0.3
    assert not [f for f in found.findings if f.effect == "parameter"]


def test_a_stated_value_that_is_two_per_cent_off_is_told_beside_the_effect() -> None:
    """The inertia is no candidate; scipy has 0.2 and the card 0.197."""
    card = model().with_values({"J": 0.197})
    found = diagnose(card, experiments(lag=0.03), FREE, effects=TRIED)
    assert [(e.effect, e.at) for e in found.effects] == [("lag", ("wm",))]
    assert found.verdict == "named" and found.effects[0].parameters["T"].value == pytest.approx(0.03, rel=0.02)
    (inertia,) = [f for f in found.findings if f.effect == "parameter"]
    assert inertia.parameters["J"].value == pytest.approx(0.2, rel=2e-3)


def held_at(b: float, data: tuple[Experiment, ...]) -> tuple[SearchContext, Refit]:
    """A search that may set the friction free, and the drive with the friction held at a value, refitted to the records."""
    search = SearchContext(
        ("lag", "coupling"),
        None,
        FrozenMap(),
        DiagnosisOptions(),
        seed=0,
        held=(FitParameter("b", b, 0.9 * b, 1.1 * b),),
    )
    start, _ = nominal(ModelSimulator(model()), data, FREE, {"b": b}, None, starts=1, seed=0, executor=None)
    return search, judged(Refit(model(), (), start.problem, start.noise, start.theta))


def test_a_parameter_that_would_have_to_be_further_off_than_it_may_stays_held() -> None:
    """Free and on its bound it would be taken out of every score, though it explains the gap no more than in part."""
    search, first = held_at(0.3, experiments(drag=lambda w: FRICTION * w))
    base, here = released(search, first, first)
    assert base is first and here is first


def test_a_parameter_that_stood_for_an_effect_is_held_again_beside_it() -> None:
    search, first = held_at(0.3, experiments(lag=0.03))
    base, here = _with_free(first, search.held[0]), refitted(lagged(_with_free(first, search.held[0])))
    assert "b" in here.problem.names and here.values["b"] == pytest.approx(0.3, rel=0.05)
    base, here = held_again(search, base, here)
    assert "b" not in base.problem.names and "b" not in here.problem.names
    assert here.problem.held["b"] == 0.3 and [p.candidate.label for p in here.placed] == ["lag at wm"]


def test_a_parameter_that_is_off_beside_an_effect_stays_free() -> None:
    search, first = held_at(0.42, experiments(lag=0.03, drag=lambda w: FRICTION * w))
    wider = _with_free(first, search.held[0])
    base, here = held_again(search, wider, refitted(lagged(wider)))
    assert base is wider and here.values["b"] == pytest.approx(FRICTION, rel=0.01)


def lagged(before: Refit) -> RefitJob:
    return beside(before, "lag", "wm", {"T": 0.02}, {"T": (1e-4, 0.3)})
