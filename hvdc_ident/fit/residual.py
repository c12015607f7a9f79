"""The residuals of one experiment, weighted and if asked whitened, with their derivatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.errors import StudyError
from hvdc_ident.experiment import Experiment
from hvdc_ident.fit.nuisance import observe
from hvdc_ident.fit.simulator import Simulator
from hvdc_ident.trajectory import Array


@dataclass(frozen=True, eq=False)
class Block:
    """The residuals of one output in one experiment, over its m compared rows.

    misfit: (m,) measured - simulated, in the output's unit. sigma: standard deviation, in the same unit.
    residual: (m,) misfit/sigma, whitened; positive where the measurement lies above the model. No unit.
    jacobian: (m, p) d residual/d unknown, so minus the whitened sensitivity over sigma.
    rows: (m,) the experiment's rows that are compared.
    """

    experiment: str
    output: str
    rows: NDArray[np.intp]
    misfit: Array
    sigma: float
    residual: Array
    jacobian: Array

    @property
    def rmse(self) -> float:
        """Root mean square of the misfit, in the output's unit."""
        return float(np.sqrt(np.mean(self.misfit**2)))


def compared_rows(experiment: Experiment, output: str) -> NDArray[np.intp]:
    """The rows of an output that are compared: inside the window, with a finite measurement.

    Raises StudyError where there are none.
    """
    if experiment.measured is None:
        raise StudyError("nothing was measured", where=f"experiment '{experiment.name}'", expected="measured outputs")
    rows = np.flatnonzero(experiment.compared & np.isfinite(experiment.measured[output]))
    if not rows.size:
        raise StudyError(
            f"no row of '{output}' can be compared",
            where=f"experiment '{experiment.name}'",
            expected="finite measurements inside the window",
            got=f"window {experiment.window}",
        )
    return rows


def whitened(signal: Array, rho: float) -> Array:
    """The signal, (m,) or (m, p), as white noise of the same size if it was AR(1) with coefficient rho from row to row.

    First row unchanged, then (s_k - rho s_{k-1})/sqrt(1 - rho^2): the exact likelihood of a stationary AR(1) noise.
    """
    if rho == 0.0:
        return signal
    if not -1.0 < rho < 1.0:
        raise StudyError("an AR(1) coefficient is out of range", expected="-1 < rho < 1", got=f"{rho:g}")
    white = signal.copy()
    white[1:] = (signal[1:] - rho * signal[:-1]) / np.sqrt(1.0 - rho**2)
    return white


def residual_blocks(
    simulator: Simulator,
    experiment: Experiment,
    values: Mapping[str, float],
    sensitivities: Sequence[str],
    sigma: Mapping[str, float],
    *,
    nuisance: Mapping[str, float] | None = None,
    rho: Mapping[str, float] | None = None,
) -> tuple[Block, ...]:
    """One block for each measured output; unknowns are `sensitivities`, then the nuisances in their order.

    sigma: standard deviation by output, in its unit. rho: AR(1) coefficient by output; none means no whitening.
    Raises SimulationError where the run fails, StudyError where nothing can be compared.
    """
    seen = observe(simulator, experiment, values, sensitivities, nuisance)
    blocks = []
    for output in experiment.outputs:
        rows = compared_rows(experiment, output)
        assert experiment.measured is not None
        misfit = experiment.measured[output][rows] - seen.values[output][rows]
        coefficient = (rho or {}).get(output, 0.0)
        weight = sigma[output]
        residual = whitened(misfit / weight, coefficient)
        jacobian = whitened(-seen.gradient[output][rows] / weight, coefficient)
        blocks.append(Block(experiment.name, output, rows, misfit, weight, residual, jacobian))
    return tuple(blocks)
