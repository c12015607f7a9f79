"""Residuals of many runs, treated together, are those of the blocks of each."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hvdc_ident.data import InputSignal, Trajectory, experiment
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.fit.likelihood import QuantisedNoise
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model
from hvdc_ident.simulate import ModelSimulator, simulate

TIME = np.linspace(0.0, 2.0, 161)
PLANT = Model(
    "plant",
    parameters={"a": 3.0, "k": 2.0, "more": 0.0},
    inputs={"u": 0.0},
    states={"x": "a*(k*u - x) + more*sin(x)", "z": "x - z"},
    outputs={"x": "x", "z": "z"},
)
CASES: dict[str, dict[str, Any]] = {
    "white": {},
    "coloured": {"rho": {"x": 0.6, "z": (0.5, 0.2)}},
    "guarded": {"guard": 0.03},
    "spectrum": {"band": (0.5, 8.0)},
    "rounded": {"quantised_noise": {"x": QuantisedNoise(0.02, 0.005)}},
    "rows of their own noise": {"profile": True},
    "gaps": {"gaps": True, "rho": {"x": 0.6}},
    "nuisances": {"nuisance": ("time-shift", "u")},
    "unknown starts": {"free_initial_states": True},
}


def problem(profile: bool = False, gaps: bool = False, nuisance: tuple[str, ...] = (), **how: Any) -> Problem:
    random = np.random.default_rng(0)
    records = []
    for k, signal in enumerate((InputSignal.step(0.3, 0.0, 1.0), InputSignal.ramp(0.4, 0.0, 1.0, 0.5))):
        e = experiment(f"e{k}", TIME, {"u": signal}, event=0.3)
        run = simulate(PLANT, e, {"a": 3.3, "more": 0.5}).trajectory.values
        y = run + 0.01 * random.standard_normal(run.shape)
        if gaps:
            y[40:60, 0] = np.nan
        e = e.with_(measured=Trajectory(TIME, y, ("x", "z")), noise={"x": 0.01, "z": 0.01}, nuisance=nuisance)
        rows = {"x": np.linspace(0.5, 2.0, TIME.size)} if profile else {}
        records.append(e.with_(noise_profile=FrozenMap(rows)))
    return Problem(ModelSimulator(PLANT), tuple(records), (FitParameter("a", 3.0, 1.0, 9.0),), **how)


@pytest.mark.parametrize("case", CASES)
def test_residuals_of_many_runs_are_those_of_each(case: str) -> None:
    asked = problem(**CASES[case])
    theta = asked.start + 0.01
    runs = [{}, {"more": 0.3}, {"more": -0.2, "k": 1.9}]
    together = asked.residuals(np.column_stack([asked.misfits(theta, also) for also in runs]))
    for column, also in zip(together.T, runs, strict=True):
        alone = replace(asked, simulator=ModelSimulator(PLANT.with_values(also)))
        blocks = alone.blocks(theta, derivatives=False)
        assert column == pytest.approx(np.concatenate([b.residual for b in blocks]), rel=1e-7, abs=1e-9)


def test_a_run_that_grows_beyond_all_bounds_is_none() -> None:
    asked = problem()
    with pytest.raises(SimulationError, match="beyond all bounds"):
        asked.misfits(asked.start, {"k": 1e110})
