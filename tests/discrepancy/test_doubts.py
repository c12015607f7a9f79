"""What tells against a name: experiments that ask for different sizes of it, and what it leaves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest

from hvdc_ident import InputSignal
from hvdc_ident.discrepancy import diagnose
from hvdc_ident.discrepancy.conclusion import Doubt, _turned, doubt_of_direction, doubt_of_size
from hvdc_ident.discrepancy.hypothesis import Refit, refitted
from hvdc_ident.discrepancy.residual_checks import constancy
from hvdc_ident.effects import apply_effects
from hvdc_ident.immutable import FrozenMap
from tests.discrepancy.cases import FREE, TRUE, corners, experiments, model
from tests.discrepancy.refits import answered, beside, plain


def chance(refit: Refit) -> float:
    """The chance that experiments of one size differ as these do."""
    return constancy(refit, refit.nominal(), refit.placed[-1])[1]


def lagged(before: Refit) -> Refit:
    return refitted(beside(before, "lag", "wm", {"T": 0.02}, {"T": (1e-3, 0.3)}))


def lossy() -> Refit:
    """A drag of third order, told as a loss by the speed."""
    before = plain(experiments(drag=lambda w: TRUE["b"] * w + 0.1 * (w - 1.0) ** 3))
    sizes = dict.fromkeys("abc", 0.01)
    return refitted(beside(before, "loss", "drag", sizes, dict.fromkeys("abc", (-3.0, 3.0)), source="w"))


def test_of_what_is_there_every_chance_is_as_likely() -> None:
    there = apply_effects(model(), [{"effect": "lag", "at": ["wm"], "parameters": {"T": 0.03}}])
    records = experiments()
    found = [chance(lagged(plain(answered(there, records, seed)))) for seed in range(25)]
    assert kstest(found, "uniform").pvalue > 1e-3, np.sort(found)


def test_a_form_in_anothers_stead_has_a_size_in_each_experiment() -> None:
    assert chance(lossy()) < 1e-9


def test_what_is_told_by_one_experiment_alone_or_jumps_with_its_size_is_not_asked() -> None:
    before = plain(experiments())
    stepped = refitted(beside(before, "quantisation", "wm", {"step": 0.01}, {"step": (1e-3, 0.1)}))
    assert chance(stepped) == 1.0
    alone = plain([e for e in experiments(lag=0.03) if e.name != "fit-2"])
    assert chance(lagged(alone)) == 1.0


def doubted(refit: Refit, explained: float = 1.0) -> Doubt | None:
    """Return the doubt about the refit's effect, or None."""
    return doubt_of_size(refit, refit.nominal(), explained)


def test_a_name_is_in_doubt_where_experiments_ask_for_different_sizes() -> None:
    assert doubted(lagged(plain(experiments(lag=0.03)))) is None
    against = doubted(lossy())
    assert against is not None and "different sizes of loss at drag" in against.why and "loss" in against.advice
    assert doubted(lossy(), explained=1e9) is None, "of so little of what it explains nothing is made"


@pytest.mark.parametrize(
    ("course", "turned"),
    [([0, 1, 2, 3], False), ([0, 1, 0.6], False), ([0, 1, 0.4], True), ([1, 0, 0.6], True), ([0, 0.4, 0, 0.4], False)],
)
def test_a_signal_has_turned_where_it_goes_back_by_more_than_a_width(course: list[float], turned: bool) -> None:
    assert _turned(np.array(course, dtype=float), 0.5) == turned
    assert _turned(-np.array(course, dtype=float), 0.5) == turned


def test_of_a_play_that_is_passed_in_one_direction_it_is_said() -> None:
    """In a record that rises only, whatever shifts a signal once it has moved looks like a play."""
    refits = {}
    for name, moves in {"up": [0.6], "both": [0.6, -0.9]}.items():
        held = []
        for e in experiments():
            steps = [(0.2 + 0.5 * k, move) for k, move in enumerate(moves)]
            held.append(replace(e, inputs=FrozenMap({"ref": InputSignal.corners(corners(1.0, steps))})))
        there = apply_effects(model(), [{"effect": "backlash", "at": ["ref"], "parameters": {"width": 0.2}}])
        first = plain(answered(there, held, seed=0))
        refits[name] = refitted(beside(first, "backlash", "ref", {"width": 0.18}, {"width": (1e-3, 1.0)}))
    against = doubt_of_direction(refits["up"])
    assert against is not None and "turn by more than 0.2" in against.why and "ramps both ways" in against.advice
    assert doubt_of_direction(refits["both"]) is None


def test_a_play_that_each_record_passes_one_way_may_be_a_dead_band_and_the_record_that_would_tell_is_named() -> None:
    """A load that begins at 0 and only rises: behind both it is smaller by their width."""
    played = apply_effects(model(), [{"effect": "backlash", "at": ["load"], "parameters": {"width": 0.08}}])
    rises = ([(0.2, 0.5)], [(0.2, 0.2), (0.7, 0.2)], [(0.3, 0.35)])
    moved = [
        replace(e, inputs=FrozenMap({"load": InputSignal.corners(corners(0.0, rise))}))
        for e, rise in zip(experiments(), rises, strict=True)
    ]
    names = ("backlash", "deadband", "deadband-step", "offset")
    found = diagnose(model(), answered(played, moved, seed=3), FREE, effects=names, places=["load"])
    assert found.verdict == "named" and {"backlash", "deadband"} <= set(found.findings[0].same_as)
    assert "does the same in these records" in found.findings[0].text
    assert "ramps both ways" in found.separating_experiment["text"]
    width = {"backlash": 0.08, "deadband": 0.04}[found.findings[0].effect]
    assert found.findings[0].parameters["width"].value == pytest.approx(width, rel=0.02)
