"""The first main job on waveforms nobody here wrote: gains and misfits as the study's README says."""

import importlib.util
import json
from pathlib import Path

import pytest

pytestmark = pytest.mark.nightly

STUDY = Path(__file__).resolve().parents[2] / "studies" / "dymola_waveform"


@pytest.fixture(scope="module")
def study():
    spec = importlib.util.spec_from_file_location("dymola_waveform_run", STUDY / "run.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if not module.DATA.exists():
        pytest.skip("the reference data beside the project are not there")
    return module


def test_the_gains_and_misfits_of_the_readme(study):
    expected = json.loads((STUDY / "expected.json").read_text())
    found = study.main()
    for name, value in expected["gains fitted"].items():
        assert found["gains"]["fitted"][name] == pytest.approx(value, rel=expected["tolerance"])
    for output, value in expected["rmse fitted"].items():
        assert found["rmse"]["fitted"][output] == pytest.approx(value, rel=0.05)
    # Near the model's own gains, as near as the missing effects let it.
    assert found["gains"]["fitted"]["KIP"] == pytest.approx(30.0, rel=0.03)
    assert found["gains"]["fitted"]["KPVDC"] == pytest.approx(9.6, rel=0.02)
    assert found["gains"]["fitted"]["KIVDC"] == pytest.approx(293.88, rel=0.06)
