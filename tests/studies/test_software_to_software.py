"""The average-value link follows Dymola, and the phasor link follows the average-value link, as the study says."""

from __future__ import annotations

import pytest

from tests.studies.study_module import expected, load

pytestmark = pytest.mark.nightly

STUDY, KNOWN = load("software_to_software"), expected("software_to_software")


@pytest.fixture(scope="module")
def against_dymola():
    if not STUDY.DATA.exists():
        pytest.skip(f"reference data not found beside the project: {STUDY.DATA.name}")
    return STUDY.against_dymola()


@pytest.mark.parametrize("signal", KNOWN["rmse_%"])
def test_every_signal_follows_dymola(against_dymola, signal):
    error = STUDY.errors(*against_dymola)[signal]["rmse_%"]
    assert error <= KNOWN["allowed"] * KNOWN["rmse_%"][signal]


def test_no_signal_is_off_by_more_than_the_reference_ripples(against_dymola):
    ripple, errors = STUDY.ripple(against_dymola[0]), STUDY.errors(*against_dymola)
    assert {n: round(e["rmse_%"], 3) for n, e in errors.items() if e["rmse_%"] > 1.3 * ripple[n]} == {}


def test_the_steady_start_is_that_of_dymola(against_dymola):
    theirs, ours = against_dymola
    for name in theirs.names:
        quiet = (theirs.time >= 0.7) & (theirs.time < STUDY.STEP)
        assert ours[name][quiet].mean() == pytest.approx(theirs[name][quiet].mean(), abs=1e-3), name


def test_the_phasor_link_follows_the_average_value_link():
    for step, pair in STUDY.phasor_against_avm().items():
        errors = STUDY.errors(*pair)
        for signal, known in KNOWN["phasor"][step].items():
            assert errors[signal]["rmse_%"] == pytest.approx(known, rel=0.02), (step, signal)
