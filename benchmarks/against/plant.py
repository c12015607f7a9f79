"""What all comparisons share: the smooth link and its step, as ours and as others are given it, and a line of the table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import engine as link_bench  # of the folder above
import numpy as np

from hvdc_ident.data import InputSignal, Trajectory, experiment
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.models import load_model
from hvdc_ident.simulate import NAMES, ModelSimulator, engine_of, simulate
from hvdc_ident.simulate.core import repeat

RTOL = 1e-6
STEP = (0.1, 1.0, 1.019)
TIME = np.linspace(0.0, 1.0, 501)
FREE = (FitParameter("KPVDC", 20.0, 10.0, 40.0), FitParameter("KIVDC", 600.0, 300.0, 1200.0))
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


class Plant:
    """The smooth link for others: its right-hand side, compiled, and its steady start at given gains."""

    def __init__(self) -> None:
        self.model = link_bench.smooth(load_model("vsc-hvdc-link"))
        self.code = engine_of(self.model, ())
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
            x = np.array(y)
            repeat(self._at[0], x, w, p, self._m, self._m, 1)
            repeat(self._at[1], x, w, p, self._m, self._out, 1)
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


def recorded(plant: Plant) -> tuple[Problem, np.ndarray]:
    """A fit of two gains to Vdc1 after a step, with noise, and what was recorded."""
    case = experiment("step", TIME, {"Vdcref1": InputSignal.step(*STEP)})
    clean = simulate(plant.model, case, TRUE, outputs=("Vdc1",)).trajectory
    seen = clean.values + NOISE * np.random.default_rng(1).standard_normal(clean.values.shape)
    case = case.with_(measured=Trajectory(TIME, seen, ("Vdc1",), ("pu",)), noise={"Vdc1": NOISE}, event=STEP[0])
    return Problem(ModelSimulator(plant.model), (case,), FREE), seen[:, 0]
