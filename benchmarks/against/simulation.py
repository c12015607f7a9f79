"""Simulation and sensitivities, against scipy, SUNDIALS by scikit-sundae, libroadrunner, AMICI and CasADi."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import engine as link_bench  # of the folder above
import numpy as np

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.models import load_model
from hvdc_ident.simulate import Tolerance, simulate

from .integrators import installed, ways
from .plant import RTOL, STEP, TIME, Line, Plant
from .sbml import amici_here, amici_model, amici_run, sbml_runs


def simulation() -> Iterator[Line]:
    """One run of 1 s, 501 points, all states."""
    plant, case = Plant(), experiment("step", TIME, {"Vdcref1": InputSignal.step(*STEP)})
    states = tuple(plant.names)

    def own() -> np.ndarray:
        return simulate(plant.model, case, outputs=states, tolerance=Tolerance(RTOL, RTOL / 100)).trajectory.values

    exact = simulate(plant.model, case, outputs=states, rtol=1e-11).trajectory.values
    size = np.maximum(np.abs(exact).max(axis=0), 1e-3)
    mine, off = link_bench.best(own, 15), (np.abs(own() - exact) / size).max()
    for name, way in ways():
        error = (np.abs(plant.run({}, way) - exact) / size).max()
        assert error < 1e-2, f"{name} ended elsewhere: {error}"
        theirs = link_bench.best(lambda way=way: plant.run({}, way), 3, 1)
        yield Line("simulation", name, mine, theirs, f"error {off:.0e} here, {error:.0e} there")
    for name, run in sbml_runs(plant):
        error = (np.abs(run() - exact) / size).max()
        assert error < 1e-2, f"{name} ended elsewhere: {error}"
        yield Line("simulation", name, mine, link_bench.best(run, 3, 1), f"error {off:.0e} here, {error:.0e} there")


def derivatives() -> Iterator[Line]:
    """The same run with its derivatives by 8 gains: exact here, differences of 9 tighter runs there."""
    plant, case = Plant(), experiment("step", TIME, {"Vdcref1": InputSignal.step(*STEP)})
    states, base = tuple(plant.names), plant.model.values

    def own(rtol: float = RTOL) -> np.ndarray:
        tolerance = Tolerance(rtol, rtol / 100)
        return simulate(
            plant.model, case, outputs=states, sensitivities=link_bench.GAINS, tolerance=tolerance
        ).gradients

    exact = own(1e-11)
    scale = np.abs(exact).max(axis=(0, 1))
    seen = scale > 1e-9  # the gains of a power control that this step does not reach change nothing

    def worst(found: np.ndarray) -> float:
        """The largest error, relative to the largest derivative by that gain."""
        return float((np.abs(found - exact).max(axis=(0, 1))[seen] / scale[seen]).max())

    mine, off = link_bench.best(own, 15), worst(own())
    for name, way in ways(RTOL / 100):  # coarser runs have no differences worth the name
        if name in ("scipy BDF", "scipy DOP853"):  # ten seconds, or too coarse to take differences of
            continue

        def differences(way: Callable[..., np.ndarray] = way) -> np.ndarray:
            middle, columns = plant.run({}, way), []
            for g in link_bench.GAINS:
                h = 1e-3 * max(abs(base[g]), 1e-2)
                columns.append((plant.run({g: base[g] + h}, way) - middle) / h)
            return np.stack(columns, axis=-1)

        error = worst(differences())
        assert error < 0.5, f"{name} found other derivatives: {error}"
        theirs = link_bench.best(differences, 2, 0)
        yield Line("8 sensitivities", f"{name}, differences", mine, theirs, f"error {off:.0e} here, {error:.0e} there")
    if amici_here():
        with amici_model(plant) as model:
            run = amici_run(model, plant.names, link_bench.GAINS)
            error = worst(run())
            assert error < 1e-2, f"AMICI found other derivatives: {error}"
            more = f"error {off:.0e} here, {error:.0e} there"
            yield Line("8 sensitivities", "AMICI CVODES", mine, link_bench.best(run, 3, 1), more)
    yield from casadi_lines()


def casadi_lines() -> Iterator[Line]:
    """CasADi's CVODES on the same equations as engine.py has them: three steps, 3001 points."""
    if not installed("casadi"):
        return
    model = link_bench.smooth(load_model("vsc-hvdc-link"))
    for names in ((), link_bench.GAINS):

        def own(names: tuple[str, ...] = names) -> Any:
            return simulate(model, link_bench.CASE, sensitivities=names, tolerance=Tolerance(RTOL, RTOL / 100))

        theirs = link_bench.best(link_bench.casadi_run(model, names, RTOL), 2, 1)
        yield Line(f"3 steps, {len(names)} sensitivities", "CasADi CVODES", link_bench.best(own, 15), theirs)
