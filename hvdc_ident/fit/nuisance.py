"""What is unknown about one experiment alone and is estimated with it: for now the offset of its clock.

A nuisance has a name in `Experiment.nuisance`, an unknown per experiment (`unknowns`) and a way to act on the run
(`observe`). An input's offset, named by the input, has its place in the same two functions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.errors import SimulationError, SteadyStateError, StudyError
from hvdc_ident.experiment import Experiment
from hvdc_ident.fit.simulator import Simulator
from hvdc_ident.fit.unknown import Free
from hvdc_ident.trajectory import Array

TIME_SHIFT = "time-shift"


@dataclass(frozen=True, eq=False)
class Observation:
    """Simulated outputs at an experiment's rows. values: (n,) by output; gradient: (n, unknowns) by output."""

    values: Mapping[str, Array]
    gradient: Mapping[str, Array]


def unknown_of(experiment: str, nuisance: str) -> str:
    """The name of an experiment's nuisance among the unknowns of a fit."""
    return f"{experiment}:{nuisance}"


def unknowns(experiment: Experiment) -> tuple[Free, ...]:
    """The unknowns of the experiment alone. A time shift starts at 0 s and may reach 2 % of the record, or two rows.

    Raises StudyError for a nuisance that is not known here.
    """
    return tuple(_free(experiment, name) for name in experiment.nuisance)


def _free(experiment: Experiment, nuisance: str) -> Free:
    if nuisance != TIME_SHIFT:
        raise StudyError(
            f"nuisance '{nuisance}' cannot be estimated",
            where=f"experiment '{experiment.name}'",
            expected=f"'{TIME_SHIFT}'",
            hint="hold the input's offset with `values`, or leave the nuisance out",
        )
    steps = np.diff(np.unique(experiment.time))
    if not steps.size:
        raise StudyError(
            "a time shift needs more than one instant", where=f"experiment '{experiment.name}'", got="one row"
        )
    reach = max(0.02 * float(np.ptp(experiment.time)), 2.0 * float(np.median(steps)))
    return Free(unknown_of(experiment.name, nuisance), 0.0, -reach, reach, scale=reach)


def observe(
    simulator: Simulator,
    experiment: Experiment,
    values: Mapping[str, float],
    sensitivities: Sequence[str] = (),
    nuisance: Mapping[str, float] | None = None,
) -> Observation:
    """The measured outputs as the model gives them, with derivatives by `sensitivities` and then by each nuisance.

    nuisance: value of each nuisance by its name in the experiment; "time-shift" tau in s: the recorder's clock is late
    by tau, so a row at t shows y(t - tau); before the first row the outputs stand still.
    Raises SimulationError where the run fails, has no steady start or returns a value that is not finite.
    """
    given = dict(nuisance or {})
    tau = given.get(TIME_SHIFT, 0.0)
    grid, rows = _shifted(experiment.time, tau)
    asked = experiment if tau == 0.0 else experiment.with_(time=grid, measured=None)
    try:
        run = simulator.simulate(asked, values, tuple(sensitivities))
    except SteadyStateError as error:
        raise SimulationError(f"no steady start: {error}") from error
    outputs: dict[str, Array] = {}
    gradients: dict[str, Array] = {}
    for output in experiment.outputs:
        y = np.asarray(run.trajectory[output], dtype=float)
        dy = np.asarray(run.gradient(output), dtype=float) if sensitivities else np.empty((y.size, 0))
        if TIME_SHIFT in given:
            dy = np.column_stack([dy, -_slope(grid, y, experiment)])
        outputs[output], gradients[output] = y[rows], dy[rows]
        if TIME_SHIFT in given:
            gradients[output][experiment.time - tau < experiment.time[0], -1] = 0.0
        if not (np.isfinite(outputs[output]).all() and np.isfinite(gradients[output]).all()):
            raise SimulationError(
                f"output '{output}' or its sensitivity is not finite", where=f"experiment '{experiment.name}'"
            )
    return Observation(outputs, gradients)


def _shifted(time: Array, tau: float) -> tuple[Array, NDArray[np.intp]]:
    """The instants to simulate, beginning where the record begins, and for each row the place of its instant."""
    if tau == 0.0:
        return time, np.arange(time.size)
    moved = time - tau
    later = moved > time[0]
    rows = np.zeros(time.size, dtype=np.intp)
    rows[later] = 1 + np.arange(int(later.sum()))
    return np.concatenate([time[:1], moved[later]]), rows


def _slope(time: Array, y: Array, experiment: Experiment) -> Array:
    """dy/dt at every instant from its neighbours, never across a jump or a corner of an input."""
    breaks = np.concatenate([np.empty(0), *(signal.breaks for signal in experiment.inputs.values())])
    piece = np.searchsorted(np.unique(breaks), time, side="right")
    cut = (np.diff(piece) != 0) | (np.diff(time) == 0)
    slope = np.zeros_like(y)
    for part in np.split(np.arange(time.size), np.flatnonzero(cut) + 1):
        if part.size > 1:
            slope[part] = np.gradient(y[part], time[part], edge_order=2 if part.size > 2 else 1)
    return slope
