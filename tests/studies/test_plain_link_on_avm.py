"""Both links at once: the phasor link fitted to the average-value one gives independently computed gains."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident.models import load_model
from hvdc_ident.simulate import simulate
from tests.studies.study_module import expected, load

pytestmark = pytest.mark.nightly

STUDY, KNOWN = load("plain_link_on_avm"), expected("plain_link_on_avm")


@pytest.mark.parametrize("case", KNOWN["gains"])
def test_the_fitted_gains(case):
    found = STUDY.fitted(STUDY.CASES[case])
    for gain, value in KNOWN["gains"][case].items():
        assert found[gain] == pytest.approx(value, rel=KNOWN["tolerance"]), gain


def test_the_misfit_over_the_integral_gain():
    recorded, link = STUDY.recording("vsc-hvdc-avm", "vdc-step"), load_model("vsc-hvdc-link")

    def rmse(**gains):
        run = simulate(link, recorded.with_(measured=None), gains, outputs=["Irorder1"])
        return float(np.sqrt(np.mean((run["Irorder1"] - recorded.measured["Irorder1"]) ** 2)))

    for integral, known in KNOWN["rmse of Irorder1 with KPVDC 26.77 by KIVDC"].items():
        assert rmse(KPVDC=26.77, KIVDC=float(integral)) == pytest.approx(known, abs=1e-4), integral
    assert rmse() == pytest.approx(KNOWN["rmse of Irorder1 with the true gains"], abs=1e-4)
