"""A fit of two gains, against lmfit, a loop over an FMU as ModestPy has it, and differential evolution."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import engine as link_bench  # of the folder above
import numpy as np
from scipy.optimize import differential_evolution, least_squares

from hvdc_ident.fit import fit

from .integrators import installed, scipy_way
from .plant import FREE, NOISE, STEP, TIME, Line, Plant, recorded


def fits() -> Iterator[Line]:
    """The same fit by others: their optimiser and their simulations; each has to find our optimum."""
    plant = Plant()
    problem, seen = recorded(plant)
    own = fit(problem, starts=1)
    best = np.array([own.values[f.name] for f in FREE])
    mine = link_bench.best(lambda: fit(problem, starts=1, assess=False), 5, 1)
    begin = np.array([f.start for f in FREE])
    low, high = np.array([f.min for f in FREE]), np.array([f.max for f in FREE])
    at, count = plant.names.index("Vdc1"), [0]

    def residual(theta: np.ndarray, way: Callable[..., np.ndarray]) -> np.ndarray:
        count[0] += 1
        gains = {f.name: float(v) for f, v in zip(FREE, theta, strict=True)}
        return (plant.run(gains, way)[:, at] - seen) / NOISE

    def line(name: str, found: np.ndarray, seconds: float, runs: int) -> Line:
        off = np.abs(np.asarray(found) / best - 1.0).max()
        assert off < 2e-2, f"{name} found {found}, not {best}"
        return Line("fit of 2 gains", name, mine, seconds, f"{runs} runs, {off:.0e} from our optimum")

    lsoda = scipy_way("LSODA", 1e-8)
    if installed("lmfit"):
        import lmfit

        def by_lmfit() -> Any:
            count[0] = 0
            start = lmfit.Parameters()
            for f in FREE:
                start.add(f.name, value=f.start, min=f.min, max=f.max)
            return lmfit.minimize(lambda q: residual(np.array([q[f.name].value for f in FREE]), lsoda), start)

        found = by_lmfit()
        seconds = link_bench.best(by_lmfit, 2, 0)
        yield line("lmfit + solve_ivp LSODA", np.array([found.params[f.name].value for f in FREE]), seconds, count[0])
    yield from (line(*found) for found in by_fmpy(plant, seen, begin, low, high))

    def evolve() -> Any:
        count[0] = 0
        cost = lambda theta: float(np.sum(residual(theta, lsoda) ** 2))  # noqa: E731
        bounds = list(zip(low, high, strict=True))
        return differential_evolution(cost, bounds, seed=1, popsize=8, maxiter=30, tol=1e-6, polish=False)

    answers: list[Any] = []
    seconds = link_bench.best(lambda: answers.append(evolve()), 1, 0)
    yield line("scipy differential evolution + LSODA", answers[-1].x, seconds, count[0])


def by_fmpy(
    plant: Plant, seen: np.ndarray, begin: np.ndarray, low: np.ndarray, high: np.ndarray
) -> Iterator[tuple[str, np.ndarray, float, int]]:
    """A loop over fmpy.simulate_fmu within scipy's least squares, as ModestPy and its like work; the FMU is our own."""
    import fmpy

    from hvdc_ident.fmu.export import export_fmu

    folder = Path(tempfile.mkdtemp())
    try:
        path = export_fmu(plant.model, folder / "link.fmu", version="2.0", kinds=("co-simulation",)).path
        unpacked, description = fmpy.extract(str(path)), fmpy.read_model_description(str(path))
        signal = np.zeros(4, dtype=[("time", float), *((n, float) for n in plant.model.inputs)])
        for n, i in plant.model.inputs.items():
            signal[n] = i.value
        signal["time"] = (0.0, STEP[0], STEP[0], TIME[-1])
        signal["Vdcref1"] = (STEP[1], STEP[1], STEP[2], STEP[2])
        count = [0]

        def residual(theta: np.ndarray) -> np.ndarray:
            count[0] += 1
            start = {f.name: float(v) for f, v in zip(FREE, theta, strict=True)}
            done = fmpy.simulate_fmu(
                unpacked, stop_time=TIME[-1], output_interval=TIME[1], start_values=start, input=signal,
                output=["Vdc1"], model_description=description, fmi_type="CoSimulation",
            )  # fmt: skip
            return (np.interp(TIME, done["time"], done["Vdc1"]) - seen) / NOISE

        def work() -> Any:
            count[0] = 0
            return least_squares(residual, begin, bounds=(low, high), x_scale=begin, diff_step=1e-4)

        found = work()
        yield "FMPy loop + scipy least_squares", found.x, link_bench.best(work, 1, 0), count[0]
        shutil.rmtree(unpacked)
    finally:
        shutil.rmtree(folder)
