"""No effect is named by a misfit that is taken for noise, and what would settle it is said."""

from __future__ import annotations

import pytest

from hvdc_ident import Experiment, Trajectory
from hvdc_ident.discrepancy import Diagnosis, diagnose
from hvdc_ident.fit.noise import AT_FLOOR, MISFIT, misfit_sentence
from tests.discrepancy.cases import FREE, SIGMA, TIME, experiments, model

LAG = 0.03
SPARSE = slice(None, None, 8)
"""Rows 32 ms apart: seven before the event, too few to tell of noise, and the motion between two hides it."""


def records(rows: slice = SPARSE, *, quieter: float = 1.0) -> tuple[Experiment, ...]:
    """Records of the drive with a lag, without a word on their noise."""
    found = []
    for e in experiments(lag=LAG, quieter=quieter):
        assert e.measured is not None
        measured = Trajectory(TIME[rows], e.measured.values[rows], e.measured.names, e.measured.units)
        found.append(e.with_(time=TIME[rows], measured=measured, noise={}))
    return tuple(found)


def diagnosed(noise: dict[str, float], **of: float) -> Diagnosis:
    """The diagnosis of the sparse records with this noise stated."""
    return diagnose(model(), [e.with_(noise=noise) for e in records(**of)], FREE, effects=["lag"])


def test_no_effect_is_named_where_the_misfit_is_the_noise() -> None:
    found = diagnosed({})
    assert {o: n["source"] for o, n in found.noise.items()} == dict.fromkeys(SIGMA, MISFIT)
    assert found.verdict == "no-evidence"
    assert not found.effects and not found.ambiguity and not found.hypotheses and not found.stand_ins
    assert found.augmented is None and found.fallback is None
    assert all(f.effect == "parameter" and f.share is None for f in found.findings)
    assert "lag" not in found.text and "No effect is missing" not in found.text
    assert found.text.endswith(misfit_sentence(tuple(SIGMA)))
    assert "state the noise" in found.separating_experiment["text"].lower()


def test_the_same_records_name_it_once_their_noise_is_stated() -> None:
    found = diagnosed(SIGMA)
    assert found.verdict == "named"
    assert found.effects[0].parameters["T"].value == pytest.approx(LAG, rel=0.1)
    assert "misfit" not in found.text


def test_an_output_whose_noise_is_stated_names_it_alone() -> None:
    found = diagnosed({"w": SIGMA["w"] / 20.0}, quieter=20.0)
    assert found.noise["torque"]["source"] == MISFIT
    assert found.verdict == "named"
    assert found.text.endswith(misfit_sentence(["torque"]))


def test_a_record_that_the_model_with_the_effect_meets_to_its_last_digits_has_no_noise() -> None:
    found = diagnose(model(), records(slice(None), quieter=1e9), FREE, effects=["lag"])
    assert found.verdict == "named"
    assert {o: n["source"] for o, n in found.noise.items()} == dict.fromkeys(SIGMA, AT_FLOOR)
    assert found.effects[0].parameters["T"].value == pytest.approx(LAG, rel=1e-5)
    assert "misfit" not in found.text
