"""A named form against formulas outside the catalogue: told apart where the data do, a set where they do not."""

from __future__ import annotations

import math

import pytest
from cases import FREE, TRUE, experiments, model

from hvdc_ident.discrepancy import Diagnosis, Options, diagnose


def bent(third: float, level: float, options: Options | None = None) -> Diagnosis:
    """The drive whose drag bends: by a third order, or towards a level; looked for are the bends of the catalogue."""

    def drag(w: float) -> float:
        u = TRUE["b"] * w
        return level * math.tanh(u / level) if math.isfinite(level) else u + third * u**3

    effects = ("saturation", "limit", "deadband", "loss")
    return diagnose(model(), experiments(drag=drag), FREE, effects=effects, places=["drag"], options=options)


def test_a_bend_of_third_order_is_not_called_a_saturation_alone() -> None:
    found = bent(-0.25, math.inf)
    assert found.verdict == "ambiguous"
    (group,) = found.ambiguity
    formulas = {r.expression: r.parameters for r in group if r.effect == "term"}
    assert "k1*drag**3" in formulas
    assert formulas["k1*drag**3"]["k1"] == pytest.approx(-0.25, rel=0.1)
    assert "term" in found.separating_experiment["text"]
    (told,) = found.to_dict()["ambiguity"]
    assert all(("expression" in r) == (r["effect"] == "term") for r in told)


def test_a_saturation_that_bends_far_is_told_from_every_formula() -> None:
    found = bent(0.0, 0.2)
    assert found.verdict == "named"
    assert found.effects[0].effect == "saturation"
    assert found.effects[0].parameters["level"].value == pytest.approx(0.2, rel=0.02)


def test_a_formula_that_explains_more_is_told_instead() -> None:
    found = bent(2.0, math.inf)  # the other way than anything in the catalogue bends at one slot
    assert found.verdict == "unnameable"
    assert found.fallback is not None
    assert found.fallback["kind"] == "term"
    assert "drag" in found.fallback["expression"]


def test_no_formula_is_tried_where_none_is_asked_for() -> None:
    found = bent(-0.25, math.inf, Options(fallback=False))
    assert found.verdict == "named"
    assert found.effects[0].effect == "saturation"
