"""Both links at once: the phasor link fitted to the average-value one gives independently computed gains."""

from __future__ import annotations

import pytest

from tests.studies.study_module import expected, load

STUDY, KNOWN = load("plain_link_on_avm"), expected("plain_link_on_avm")


@pytest.mark.parametrize("case", KNOWN["gains"])
def test_the_fitted_gains(case):
    found = STUDY.fitted(STUDY.CASES[case])
    for gain, value in KNOWN["gains"][case].items():
        assert found[gain] == pytest.approx(value, rel=KNOWN["tolerance"]), gain
