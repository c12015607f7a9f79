"""A named form against formulas outside the catalogue: told apart where the data do, a set where they do not."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from cases import FREE, TRUE, corners, experiments, model
from refits import answered, beside, plain

from hvdc_ident import Experiment, InputSignal, Model
from hvdc_ident.discrepancy import Diagnosis, DiagnosisOptions, diagnose
from hvdc_ident.discrepancy.alternatives import beyond
from hvdc_ident.discrepancy.classes import formula_rivals
from hvdc_ident.discrepancy.context import Round, SearchContext
from hvdc_ident.discrepancy.evidence import CandidateFit, Pick, Ruler, alike
from hvdc_ident.discrepancy.formula import Term, formula_job
from hvdc_ident.discrepancy.refit import run
from hvdc_ident.discrepancy.rounds import one_round
from hvdc_ident.effects import apply_effects
from hvdc_ident.immutable import FrozenMap


def bent(third: float, level: float, options: DiagnosisOptions | None = None) -> Diagnosis:
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
    found = bent(-0.25, math.inf, DiagnosisOptions(fallback=False))
    assert found.verdict == "named"
    assert found.effects[0].effect == "saturation"


def shown(changed: Model, still: str) -> tuple[Experiment, ...]:
    """Records of a changed drive, with noise, in which one input stands still and the other moves."""
    rest, moved = {"ref": 1.0, "load": 0.3}, []
    for e, change in zip(experiments(), (0.3, -0.25, 0.2), strict=True):
        moves = {n: InputSignal.step(0.3, v, v + change * (n != still)) for n, v in rest.items()}
        moved.append(replace(e, inputs=FrozenMap(moves)))
    return answered(changed, moved, seed=3)


def test_formulas_near_the_winner_are_rivals_with_their_priors() -> None:
    before = plain(shown(model(), still="ref"))
    refit = run(formula_job(before, "outputs.w", [Term("load*w", ("load", "w"), "xy")], np.array([0.01])))
    coupling = beside(before, "coupling", "outputs.w", {"k": 0.01}, {"k": (-1.0, 1.0)}, source="load")
    winner = CandidateFit(Pick(0, 0, 1.0, 1.0), run(coupling), 100.0)
    found = cast(Round, SimpleNamespace(winner=winner, ruler=Ruler(1800, 1800.0, 1.0)))
    near, far, ahead = (CandidateFit(winner.pick, refit, gain) for gain in (97.0, 92.0, 107.0))
    behind, rivals = formula_rivals(found, [(far, 0.5), (near, 0.25)], DiagnosisOptions())
    assert behind == 0.0 and [(r.effect, r.delta_bic, r.prior) for r in rivals] == [("term", 3.0, 0.25)]
    behind, rivals = formula_rivals(found, [(ahead, 0.5)], DiagnosisOptions())
    assert np.isinf(behind) and not rivals


def test_a_form_outside_the_catalogue_is_as_likely_as_an_effect() -> None:
    """A cube at one of two places has half of what a saturation has at both."""
    there = apply_effects(model(), [{"effect": "saturation", "at": ["drag"], "parameters": {"level": 0.25}}])
    search = SearchContext(("saturation",), ("drag", "torque"), FrozenMap(), DiagnosisOptions(bootstraps=100), seed=0)
    found = one_round(search, plain(answered(there, experiments(), seed=0)), 1)
    tried = {t.refit.placed[-1].use.expression: prior for t, prior in beyond(search, found)}
    assert tried["k1*drag**3"] == 0.5 and tried["k1*drag**2"] == 0.5
    assert "k1*drag*abs(drag)" not in tried, "of a drag above 0 it is the square"
    assert all(prior <= 0.5 for prior in tried.values())


def test_what_bends_a_signal_that_never_moves_is_told_with_the_gain_there() -> None:
    clipped = {"effect": "limit", "at": "load", "parameters": {"level": 0.25}}
    bends = ("gain", "limit", "saturation", "deadband")
    found = diagnose(
        model(), shown(apply_effects(model(), [clipped]), still="load"), FREE, effects=bends, places=["load"]
    )
    assert found.verdict == "named"
    assert {r.effect for r in found.ambiguity[0]} == set(bends)
    more = {"effect": "gain", "at": "load", "parameters": {"k": 1.2}}
    found = diagnose(model(), shown(apply_effects(model(), [more]), still="load"), FREE, effects=bends, places=["load"])
    assert found.verdict == "named" and not found.ambiguity, "none of them adds"


def test_a_formula_that_is_an_effect_of_the_catalogue_is_no_rival_of_it() -> None:
    """The magnitude of a speed above 0 is the speed, and its square is a loss: neither is outside the catalogue."""
    leak = {"effect": "conductance", "at": "load", "from": "w", "parameters": {"g": 0.05}}
    records = answered(apply_effects(model(), [leak]), experiments(), seed=5)
    found = diagnose(model(), records, FREE, effects=("conductance", "loss"), places=["load"])
    formulas = {r.expression for group in found.ambiguity for r in group if r.effect == "term"}
    assert not formulas & {"k1*w", "k1*abs(w)", "k1*w**2", "k1*w*abs(w)"}
    assert found.findings[0].same_as[0] in ("conductance", "loss")
    assert found.findings[0].parameters["g"].value == pytest.approx(0.05, rel=0.1)


@pytest.mark.parametrize(("change", "same"), [(0.02, True), (0.6, False)])
def test_a_formula_of_a_signal_that_hardly_moves_is_its_own_tangent(change: float, same: bool) -> None:
    """The cube of a set-point of 1 moves three times as much as that, and bends only where it moves far."""
    levels = corners(1.0, [(0.3, change), (0.7, -1.5 * change)])
    moved = FrozenMap({"ref": InputSignal.corners(levels), "load": InputSignal.constant(0.3)})
    cubed = apply_effects(
        model(), [{"effect": "term", "at": ["torque"], "expression": "k1*ref**3", "parameters": {"k1": 0.3}}]
    )
    before = plain(answered(cubed, [replace(e, inputs=moved) for e in experiments()], seed=5))
    cube = run(formula_job(before, "torque", [Term("ref**3", ("ref",), "x3")], np.array([0.3])))
    linear = run(beside(before, "conductance", "torque", {"g": -0.9}, {"g": (-3.0, 3.0)}, source="ref"))
    assert cube.sizes(cube.placed[-1])["k1"] == pytest.approx(0.3, rel=0.5 if same else 0.1)
    assert alike(linear, cube, before) == same
