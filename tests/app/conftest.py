"""The small study, and its results."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.app.runs import Runs, StudyRun
from tests.app.small_study import SECONDS, write_small_study


@pytest.fixture(scope="session", autouse=True)
def compiled() -> None:
    """The integrators, compiled before a server of a test is waited for: of a fresh installation that takes half a minute."""
    model = hi.load_model("vsc-hvdc-link")
    hi.simulate(model, np.linspace(0.0, 0.1, 3))
    hi.find_operating_point(model)


@pytest.fixture
def small_study(tmp_path: Path) -> hi.Study:
    return hi.load_study(write_small_study(tmp_path))


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[hi.Study, StudyRun]:
    """The small study with its results, written by a run of the workbench."""
    study = hi.load_study(write_small_study(tmp_path_factory.mktemp("finished")))
    run = Runs().start(study, study.folder)
    assert run.wait(SECONDS) == "done", run.message
    return study, run
