"""The error of Irorder1 over KIVDC agrees with what an independent computation found."""

from __future__ import annotations

import pytest

from hvdc_ident.sensitivity import sweep
from hvdc_ident.study.study import load_study
from tests.studies.study_module import STUDIES, expected


@pytest.mark.parametrize("name", ["figure_8", "figure_9"])
def test_the_error_over_the_integral_gain(name):
    study, known = load_study(STUDIES / name / "study.toml"), expected(name)
    for experiment, line in known["rmse"].items():
        found = sweep(study.model, study.experiments, {"KIVDC": [float(v) for v in line]}).error("Irorder1", experiment)
        assert found.tolist() == pytest.approx(list(line.values()), abs=known["tolerance"]), experiment
    if "rmse with the true gains" in known:
        found = sweep(study.model, study.experiments, {"KPVDC": [24.0], "KIVDC": [734.7]}).error("Irorder1", "vdc-step")
        assert found[0] == pytest.approx(known["rmse with the true gains"], abs=known["tolerance"])
