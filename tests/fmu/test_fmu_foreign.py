"""FMUs of other makers, where a folder of them is given in HVDC_IDENT_FMUS: each runs, or says why not."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from hvdc_ident.data import experiment
from hvdc_ident.errors import InputError, SimulationError
from hvdc_ident.fmu import INTERFACES, Limits, read_fmu
from hvdc_ident.linearize import find_operating_point, linearize

FOLDER = os.environ.get("HVDC_IDENT_FMUS", "")
FILES = sorted(Path(FOLDER).rglob("*.fmu")) if FOLDER else []


@pytest.mark.skipif(not FILES, reason="no FMUs of other makers: HVDC_IDENT_FMUS names no folder that has any")
@pytest.mark.parametrize("path", FILES, ids=lambda p: p.name)
def test_a_foreign_fmu_runs_or_says_why_not(path):
    ran = 0
    for interface in INTERFACES:
        try:
            model = read_fmu(path, interface=interface, limits=Limits(deadline=20.0, load=20.0))
        except InputError as e:
            assert str(path) in str(e)
            continue
        run = experiment("own", np.linspace(0.0, 1.0, 101))
        try:
            found = model.simulate(run)
        except SimulationError as e:
            assert path.name in str(e)
            continue
        finally:
            model.pool.close()
        assert np.isfinite(found.trajectory.values).all() and found.trajectory.names == tuple(model.outputs)
        ran += 1
        if interface == "model-exchange" and model.states:
            linear = linearize(model, find_operating_point(model, at="start"))
            assert np.isfinite(linear.A).all() and linear.A.shape == (len(model.states),) * 2
        model.pool.close()
    if not ran:
        pytest.skip(f"{path.name} has no interface that runs here, and says so")
