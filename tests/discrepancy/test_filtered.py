"""Filters found from records: of a meter with a notch or a resonance, by scipy, and none where an effect has a name."""

from __future__ import annotations

import numpy as np
import pytest
from cases import FREE, TIME, TRUE, experiments, model
from meters import filtered

from hvdc_ident.discrepancy import DiagnosisOptions, diagnose
from hvdc_ident.model import Model, parse_card, write_card


def polynomials(told: str) -> list[list[float]]:
    """The coefficients of a fraction of polynomials of second order as it is told."""
    signed = told.replace(" - ", " + -").replace("(s^2", "(1 s^2").replace("(", "").replace(")", "")
    return [[float(term.split()[0]) for term in part.split(" + ")] for part in signed.split("/")]


@pytest.mark.parametrize(
    ("numerator", "denominator", "name"),
    [
        ([1.0, 4.0, 900.0], [1.0, 30.0, 900.0], "notch around 30"),
        ([1.0, 40.0, 1600.0], [1.0, 16.0, 1600.0], "resonance around 40"),
    ],
)
def test_what_passes_a_band_differently_is_told_as_a_filter(
    numerator: list[float], denominator: list[float], name: str
) -> None:
    looks: list[str] = []
    found = diagnose(
        model(), filtered(numerator, denominator), FREE, progress=lambda _done, _total, text: looks.append(text)
    )
    assert found.verdict == "unnameable" and not found.effects and found.fallback is not None
    told = found.fallback
    assert (told["kind"], told["at"]) == ("filter", "outputs.torque") and name in told["text"]
    above, below = polynomials(told["expression"])
    assert above == pytest.approx(numerator, rel=0.1, abs=1.0) and below == pytest.approx(denominator, rel=0.1)
    low, high = told["coefficients"]["wn"]["ci95"]
    assert low < np.sqrt(denominator[2]) < high
    assert found.remaining["adequate"] and (found.gap.shrink_holdout or 0.0) > 0.5
    assert found.parameters_after["Ki"] == pytest.approx(TRUE["Ki"], rel=0.05)
    assert not [text for text in looks if text.startswith("round 2")]
    assert isinstance(found.augmented, Model)
    assert parse_card(write_card(found.augmented)).insertion_points == found.augmented.insertion_points


def test_a_lag_is_named_though_a_wide_filter_comes_near_it() -> None:
    found = diagnose(model(), experiments(lag=0.03), FREE, effects=["lag", "gain"], places=["wm"])
    assert found.verdict == "named" and [e.effect for e in found.effects] == ["lag"]


@pytest.mark.parametrize("late", [0.02, 0.04])
def test_what_only_delays_is_no_filter(late: float) -> None:
    """The delay itself is not among those tried: what a filter makes of it has the zeros of a delay."""
    records = experiments(meter=lambda torque: np.interp(TIME - late, TIME, torque))
    found = diagnose(model(), records, FREE, effects=["gain", "offset"], options=DiagnosisOptions(bootstraps=100))
    assert (found.fallback or {}).get("kind") != "filter"
