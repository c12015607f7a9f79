"""Standard deviations of measured outputs: given, or to be taken from the misfit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hvdc_ident.errors import StudyError
from hvdc_ident.experiment import Experiment

FLOOR = 1e-6
"""No standard deviation is below this share of an output's range."""

GIVEN = "given"
MISFIT = "misfit"


def range_of(experiments: Sequence[Experiment], output: str) -> float:
    """The largest range of an output within one record, in its unit; its size, or 1, where it stands still."""
    records = [e.measured[output] for e in experiments if e.measured is not None and output in e.measured]
    records = [r[np.isfinite(r)] for r in records]
    records = [r for r in records if r.size]
    width = max((float(np.ptp(r)) for r in records), default=0.0)
    size = max((float(np.abs(r).max()) for r in records), default=0.0)
    return width or size or 1.0


def floor_of(experiments: Sequence[Experiment], output: str) -> float:
    """The smallest standard deviation an output may have, in its unit."""
    return FLOOR * range_of(experiments, output)


def source_of(experiments: Sequence[Experiment], output: str) -> str:
    """Where an output's standard deviation comes from: "given", or "misfit".

    It is the misfit where a record has no noise, or where all noise given is the floor: such data are deterministic.
    """
    noises = [e.noise.get(output) for e in experiments if output in e.outputs]
    limit = floor_of(experiments, output) * (1.0 + 1e-6)
    return GIVEN if noises and all(n is not None for n in noises) and any(n > limit for n in noises if n) else MISFIT


def sigmas(experiment: Experiment, experiments: Sequence[Experiment], weights: Mapping[str, float]) -> dict[str, float]:
    """The standard deviation of each output of an experiment, in the output's unit, never below the floor.

    The first that is there: `weights`, the experiment's own noise where `source_of` says "given", a tenth of the range
    (a first weight, to be replaced by the misfit). Raises StudyError for a noise that is not positive.
    """
    found: dict[str, float] = {}
    for output in experiment.outputs:
        given = experiment.noise.get(output)
        if given is not None and not (np.isfinite(given) and given >= 0):
            raise StudyError(
                f"the noise of '{output}' is wrong",
                where=f"experiment '{experiment.name}'",
                expected="a finite standard deviation, not negative",
                got=f"{given:g}",
            )
        known = weights.get(output)
        if known is None and given is not None and source_of(experiments, output) == GIVEN:
            known = given
        if known is None:
            known = 0.1 * range_of([*experiments, experiment], output)
        found[output] = max(known, floor_of([*experiments, experiment], output))
    return found
