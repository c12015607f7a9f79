"""The link as SBML, for simulators that make machine code of it themselves: libroadrunner and AMICI."""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from .antimony_text import antimony_text
from .integrators import installed
from .plant import RTOL, STEP, TIME, Plant

Run = Callable[[], np.ndarray]


def sbml_text(plant: Plant) -> str:
    """The link and its step from its steady start."""
    import antimony

    start = plant.code.start(plant.p, plant.u)[0][: len(plant.names)]
    text = antimony_text(plant.model, dict(zip(plant.names, map(float, start), strict=True)), {"Vdcref1": STEP})
    assert antimony.loadAntimonyString(text) >= 0, antimony.getLastError()
    return antimony.getSBMLString("link")


def sbml_runs(plant: Plant) -> Iterator[tuple[str, Run]]:
    """Name and run of each such simulator that is there: the states at TIME, (n, states)."""
    if not installed("antimony"):
        return
    if installed("roadrunner", "libroadrunner"):
        yield "libroadrunner CVODE", roadrunner_run(plant)
    if amici_here():
        with amici_model(plant) as model:
            yield "AMICI CVODES", amici_run(model, plant.names, ())


def roadrunner_run(plant: Plant) -> Run:
    """A run in libroadrunner."""
    import roadrunner

    runner = roadrunner.RoadRunner(sbml_text(plant))
    runner.integrator.relative_tolerance, runner.integrator.absolute_tolerance = RTOL, RTOL / 100

    def run() -> np.ndarray:
        runner.reset()
        return np.array(runner.simulate(TIME[0], TIME[-1], TIME.size, ["time", *plant.names]))[:, 1:]

    return run


def amici_here() -> bool:
    """Whether AMICI can be used; it needs a C++ compiler and swig to install, and the compiler for each model."""
    return installed("amici") and installed("antimony")


@contextmanager
def amici_model(plant: Plant) -> Iterator[Any]:
    """The link compiled by AMICI, in a folder that is removed again."""
    import amici

    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        importer = amici.SbmlImporter(sbml_text(plant), from_file=False)
        yield importer.sbml2amici("link", Path(folder), simplify=None, compute_conservation_laws=False, verbose=False)
        print(f"AMICI compiled and ran the link in {time.perf_counter() - begin:.0f} s", file=sys.stderr)


def amici_run(model: Any, states: Sequence[str], gains: Sequence[str]) -> Run:
    """A run in AMICI: the states at TIME, (n, states), or their derivatives by the gains, (n, states, gains)."""
    import amici.sim.sundials as amici_sim

    model.set_timepoints(TIME)
    solver = model.create_solver()
    solver.set_relative_tolerance(RTOL)
    solver.set_absolute_tolerance(RTOL / 100)
    solver.set_max_steps(100_000)
    columns = [model.get_state_ids().index(n) for n in states]
    if gains:
        known = list(model.get_free_parameter_ids())
        model.set_parameter_list([known.index(g) for g in gains])
        solver.set_sensitivity_order(amici_sim.SensitivityOrder.first)
        solver.set_sensitivity_method(amici_sim.SensitivityMethod.forward)

    def run() -> np.ndarray:
        done = amici_sim.run_simulation(model, solver)
        assert done.status == 0, f"AMICI ended with status {done.status}"
        return np.array(done.sx)[:, :, columns].transpose(0, 2, 1) if gains else np.array(done.x)[:, columns]

    return run
