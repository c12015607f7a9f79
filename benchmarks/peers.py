"""Side by side with other people's packages: the same model, data and machine, in one run; the figures are ratios.

    python benchmarks/peers.py [--only simulation sensitivities linearisation fit profile]    (needs the extra `bench`)

The smooth link (lags on currents, measurements and the dc line: 15 states, no fast mode), for every peer here can
integrate it; the stiff link as it is, against CasADi, stands in engine.py. The peers get our compiled right-hand side and
our start, so what is compared is the method and its way to work, not an interpreter; where a peer is handed something
better than its users would write, the ratio is to its favour. A peer whose answer is not ours stops the run; one that is
not installed is named and left out. Times are the least wall time of several runs.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import engine as link_bench  # of this folder
import numpy as np
from numba import njit
from scipy.integrate import solve_ivp
from scipy.optimize import differential_evolution, least_squares

from hvdc_ident.experiment import InputSignal, experiment
from hvdc_ident.fit import Free, Problem, fit
from hvdc_ident.fit.objective import LeastSquares
from hvdc_ident.fit.profile import TWO_SIDED, profiles
from hvdc_ident.models import load_model
from hvdc_ident.simulate import Tolerance, engine, simulate
from hvdc_ident.simulate.call import call
from hvdc_ident.simulate.model_simulator import ModelSimulator
from hvdc_ident.simulate.structure import NAMES
from hvdc_ident.trajectory import Trajectory

RTOL = 1e-6
STEP = (0.1, 1.0, 1.019)
TIME = np.linspace(0.0, 1.0, 501)
FREE = (Free("KPVDC", 20.0, 10.0, 40.0), Free("KIVDC", 600.0, 300.0, 1200.0))
TRUE = {"KPVDC": 24.0, "KIVDC": 734.7}
NOISE = 1e-4


@dataclass(frozen=True)
class Line:
    """One comparison. own, theirs: s. more: what else is worth saying."""

    what: str
    peer: str
    own: float
    theirs: float
    more: str = ""

    def __str__(self) -> str:
        times = f"{self.own * 1e3:.3g} | {self.theirs * 1e3:.4g} | {self.theirs / self.own:.3g}"
        return f"| {self.what} | {self.peer} | {times} | {self.more} |"


@njit(error_model="numpy")
def _rhs(modes, f, y, w, p, m, out):
    call(modes, y, y, w, w, p, m, m)
    call(f, y, y, w, w, p, m, out)


class Plant:
    """The smooth link for others: its right-hand side, compiled, and its steady start at given gains."""

    def __init__(self) -> None:
        self.model = link_bench.smooth(load_model("vsc-hvdc-link"))
        self.code = engine(self.model, ())
        s = self.code.structure.sizes
        assert s.nz == 0, "a peer could not integrate it"
        self.names = list(self.code.structure.states)
        self.p = np.array(list(self.model.values.values()))
        self.u = np.array([i.value for i in self.model.inputs.values()])
        self.place = list(self.model.inputs).index("Vdcref1")
        self._at = [int(self.code._address[NAMES.index(n)]) for n in ("modes", "f")]
        self._m, self._out = np.zeros(max(s.ns, 1)), np.zeros(s.nx)

    def values(self, gains: dict[str, float]) -> np.ndarray:
        """All parameters, with these gains."""
        p = self.p.copy()
        for n, v in gains.items():
            p[list(self.model.parameters).index(n)] = v
        return p

    def rhs(self, p: np.ndarray, level: float) -> Callable[[float, np.ndarray], np.ndarray]:
        """f(t, y) with the set-point of the dc voltage at a level."""
        w = np.concatenate([[0.0], self.u])
        w[1 + self.place] = level

        def f(t: float, y: np.ndarray) -> np.ndarray:
            _rhs(self._at[0], self._at[1], np.ascontiguousarray(y), w, p, self._m, self._out)
            return self._out.copy()

        return f

    def run(self, gains: dict[str, float], solve: Callable[..., np.ndarray]) -> np.ndarray:
        """The states at TIME, (n, 15): solve(f, start, times) for the part before the step and the part after it."""
        p = self.values(gains)
        y = self.code.start(p, self.u)[0][: len(self.names)]
        at = int(np.searchsorted(TIME, STEP[0]))
        rows = [np.tile(y, (at, 1))]
        x = solve(self.rhs(p, STEP[1]), y, np.array([0.0, STEP[0]]))[-1]
        rows.append(solve(self.rhs(p, STEP[2]), x, TIME[at:]))
        return np.vstack(rows)


def scipy_way(method: str, rtol: float = RTOL) -> Callable[..., np.ndarray]:
    """Scipy's integrator of that name."""

    def solve(f: Any, y: np.ndarray, times: np.ndarray) -> np.ndarray:
        done = solve_ivp(f, (times[0], times[-1]), y, method=method, t_eval=times, rtol=rtol, atol=rtol / 100)
        assert done.success, done.message
        return done.y.T

    return solve


def sundae_way(rtol: float = RTOL) -> Callable[..., np.ndarray]:
    """CVODE by scikit-sundae."""
    from sksundae.cvode import CVODE

    def solve(f: Any, y: np.ndarray, times: np.ndarray) -> np.ndarray:
        def rhs(t: float, x: np.ndarray, out: np.ndarray) -> None:
            out[:] = f(t, x)

        done = CVODE(rhs, rtol=rtol, atol=rtol / 100, max_num_steps=100_000).solve(times, y)
        assert done.success, done.message
        return done.y

    return solve


def ways(rtol: float = RTOL) -> Iterator[tuple[str, Callable[..., np.ndarray]]]:
    """The integrators that are installed, by name."""
    for method in ("LSODA", "BDF", "Radau", "DOP853"):
        yield f"scipy {method}", scipy_way(method, rtol)
    try:
        yield "scikit-sundae CVODE", sundae_way(rtol)
    except ImportError:
        print("scikit-sundae is not installed")


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
    yield from casadi_lines()


def casadi_lines() -> Iterator[Line]:
    """CasADi's CVODES on the same equations as engine.py has them: three steps, 3001 points."""
    try:
        import casadi  # noqa: F401
    except ImportError:
        print("casadi is not installed")
        return
    model = link_bench.smooth(load_model("vsc-hvdc-link"))
    for names in ((), link_bench.GAINS):

        def own(names: tuple[str, ...] = names) -> Any:
            return simulate(model, link_bench.CASE, sensitivities=names, tolerance=Tolerance(RTOL, RTOL / 100))

        theirs = link_bench.best(link_bench.casadi_run(model, names, RTOL), 2, 1)
        yield Line(f"3 steps, {len(names)} sensitivities", "CasADi CVODES", link_bench.best(own, 15), theirs)


def linearisation() -> Iterator[Line]:
    """The linear model of the stiff link: python-control by differences of our right-hand side (linearize.py)."""
    import control
    import linearize as linear_bench

    from hvdc_ident.linearize import find_operating_point, linearize
    from hvdc_ident.linearize.system import system

    model = load_model("vsc-hvdc-link")
    point = find_operating_point(model)
    s = system(model)
    peer = linear_bench.as_control(s, point)
    x, u = np.array([*point.states.values()]), np.array([*point.inputs.values()])
    own, other = linearize(model, point), control.linearize(peer, x, u)
    assert np.abs(own.A - other.A).max() / np.abs(own.A).max() < 1e-4, "python-control found another A"
    mine = link_bench.best(lambda: linearize(model, point), 100)
    y, w, p = point.y, point.w, point.p
    m = s.modes(y, w, p)
    yield Line(
        "linear model", "python-control", mine, theirs := link_bench.best(lambda: control.linearize(peer, x, u), 10)
    )
    yield Line("its Jacobian", "python-control", link_bench.best(lambda: s.jacobian(y, w, p, m), 1000), theirs)


def recorded(plant: Plant) -> tuple[Problem, np.ndarray]:
    """A fit of two gains to Vdc1 after a step, with noise, and what was recorded."""
    case = experiment("step", TIME, {"Vdcref1": InputSignal.step(*STEP)})
    clean = simulate(plant.model, case, TRUE, outputs=("Vdc1",)).trajectory
    seen = clean.values + NOISE * np.random.default_rng(1).standard_normal(clean.values.shape)
    case = case.with_(measured=Trajectory(TIME, seen, ("Vdc1",), ("pu",)), noise={"Vdc1": NOISE}, event=STEP[0])
    return Problem(ModelSimulator(plant.model), (case,), FREE), seen[:, 0]


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
    try:
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
    except ImportError:
        print("lmfit is not installed")
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

    from hvdc_ident.fmu.export.fmu import export_fmu

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


def profiling() -> Iterator[Line]:
    """Both gains' profiles from the optimum; pyPESTO is given our cost with its exact gradient."""
    try:
        import logging

        import pypesto
        import pypesto.optimize
        import pypesto.profile
    except ImportError:
        print("pypesto is not installed")
        return
    logging.disable(logging.WARNING)
    problem, _ = recorded(Plant())
    objective, count = LeastSquares.of(problem), [0]
    best = np.array([fit(problem, starts=1).values[f.name] for f in FREE])
    mine = link_bench.best(lambda: profiles(objective, best), 5, 1)
    own = profiles(objective, best)

    def cost(theta: np.ndarray) -> float:
        count[0] += 1
        return float(objective.evaluate(theta).cost)

    low, high = [f.min for f in FREE], [f.max for f in FREE]
    theirs = pypesto.Problem(
        pypesto.Objective(fun=cost, grad=lambda theta: objective.evaluate(theta).gradient), low, high,
        x_names=[f.name for f in FREE],
    )  # fmt: skip
    optimizer = pypesto.optimize.ScipyOptimizer(method="L-BFGS-B")
    begun = _begun(pypesto, theirs, optimizer, best)
    options = pypesto.profile.ProfileOptions(ratio_min=float(np.exp(-1.1 * TWO_SIDED)))

    def work() -> Any:
        count[0] = 0
        return pypesto.profile.parameter_profile(
            theirs, begun(), optimizer, profile_options=options, progress_bar=False
        )

    result = work()
    seconds = link_bench.best(work, 1, 0)
    apart = []
    for k, f in enumerate(FREE):
        found = result.profile_result.list[0][k]
        x, rise = found["x_path"][k], found["fval_path"] - found["fval_path"].min()
        middle = int(np.argmin(rise))
        for side, limit in (
            (slice(None, middle + 1), own.by_name[f.name].lower),
            (slice(middle, None), own.by_name[f.name].upper),
        ):
            order = np.argsort(rise[side])
            end = np.interp(np.sqrt(TWO_SIDED), np.sqrt(rise[side][order]), x[side][order])
            apart.append(abs(end - limit.limit) / abs(best[k] - limit.limit))
    assert max(apart) < 0.1, f"pyPESTO's intervals are others: {apart}"
    evaluations = sum(p.evaluations for p in own.by_name.values())
    yield Line(
        "2 profiles", "pyPESTO", mine, seconds,
        f"{evaluations} evaluations here, {count[0]} there; ends within {max(apart):.1%} of half an interval",
    )  # fmt: skip


def _begun(pypesto: Any, problem: Any, optimizer: Any, best: np.ndarray) -> Callable[[], Any]:
    """A new result that holds the optimum and no profile yet."""

    def make() -> Any:
        given = pypesto.Problem(problem.objective, problem.lb, problem.ub, x_names=problem.x_names, x_guesses=[best])
        return pypesto.optimize.minimize(given, optimizer, n_starts=1, progress_bar=False)

    return make


GROUPS = {
    "simulation": simulation,
    "sensitivities": derivatives,
    "linearisation": linearisation,
    "fit": fits,
    "profile": profiling,
}


def main() -> None:
    """Prints a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=tuple(GROUPS), default=tuple(GROUPS))
    print("| what | peer | here, ms | there, ms | there / here | |\n|---|---|---|---|---|---|", flush=True)
    for name in parser.parse_args().only:
        for line in GROUPS[name]():
            print(line, flush=True)


if __name__ == "__main__":
    main()
