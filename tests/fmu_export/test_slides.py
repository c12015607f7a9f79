"""Exported FMUs of models that slide along a limit: as the engine, whose runs are compared with Filippov's solution elsewhere."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException

from hvdc_ident.data import Experiment, InputSignal, experiment
from hvdc_ident.fmu.compile import compiler
from hvdc_ident.model import Model
from hvdc_ident.simulate import simulate
from tests.fmu_export.driver import cosimulate, exported

pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler: nothing to run")

# A PI controller whose integrator stops at its limit, on a lag; the second in an algebraic loop.
CONTROLLERS = {
    "plain": Model(
        "pi",
        parameters={"Kp": 2.0, "Ki": 8.0, "T": 0.5, "top": 1.2},
        inputs={"r": 0.0},
        states={"p": "(c - p)/T", "z": "where(sum > top, 0, where(sum < -top, 0, Ki*e))"},
        signals={"e": "r - p", "sum": "Kp*e + z", "c": "clip(sum, -top, top)"},
        outputs={"y": "p", "z": "z"},
    ),
    "loop": Model(
        "pi-loop",
        parameters={"Kp": 2.0, "Ki": 8.0, "T": 0.5, "top": 1.2, "D": 0.3},
        inputs={"r": 0.0},
        states={"p": "(c - p)/T", "z": "where(sum > top, min(Ki*e, 0), where(sum < -top, max(Ki*e, 0), Ki*e))"},
        signals={"y": "p + D*c", "e": "r - y", "sum": "Kp*e + z"},
        algebraic={"c": "clip(sum, -top, top)"},
        outputs={"y": "y", "z": "z"},
    ),
}
OUTPUTS = ["y", "z"]
TIME = np.linspace(0.0, 2.0, 83)
INPUTS = {"r": InputSignal.corners([(0.101, 0.0), (0.101, 1.0), (0.9, 1.0), (0.9, -1.0)])}
CASE: Experiment = experiment("step", TIME, INPUTS)


@pytest.mark.parametrize("name", sorted(CONTROLLERS))
@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_the_co_simulation_slides_as_the_engine_does(tmp_path: Path, name: str, version: str) -> None:
    model = CONTROLLERS[name]
    fmu = exported(model, tmp_path / "pi.fmu", version, experiments=[CASE])
    run = simulate(model, CASE, rtol=1e-11)
    expected = np.column_stack([run[o] for o in model.outputs])
    found = cosimulate(fmu, TIME, INPUTS, OUTPUTS, tolerance=1e-10)
    assert np.abs(found - expected).max() < 1e-7


def test_a_copy_taken_on_a_slide_goes_on_from_there(tmp_path: Path) -> None:
    fmu = exported(CONTROLLERS["loop"], tmp_path / "pi.fmu", experiments=[CASE])
    with fmu.instance(True) as run:
        run.enter(0.0, 2.0, 1e-9)
        run.raw.exitInitializationMode()
        run.set({"r": 1.0})
        times = np.linspace(0.0, 0.6, 61)
        values, copies = [], []
        for a, b in pairwise(times.tolist()):
            copies.append(run.copy())
            run.step(a, b - a)
            values.append(run.get(OUTPUTS))
        for k in (40, 7, 23):
            run.restore(copies[k])
            again = []
            for a, b in pairwise(times[k:].tolist()):
                run.step(a, b - a)
                again.append(run.get(OUTPUTS))
            assert np.array_equal(again, values[k:])
        refused = 0
        for copy in copies:
            run.restore(copy)
            try:
                run.derivative(["y"], "r")
            except FMICallException:  # on the slide the model has no single linearisation
                refused += 1
        assert 0 < refused < len(copies)


def test_without_the_slide_the_co_simulation_stops_with_an_error(tmp_path: Path) -> None:
    fmu = exported(CONTROLLERS["plain"], tmp_path / "pi.fmu")
    with pytest.raises(FMICallException):
        cosimulate(fmu, TIME, INPUTS, ["y"])
