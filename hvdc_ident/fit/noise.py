"""Standard deviations of measured outputs: given, or to be taken from the misfit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hvdc_ident.data import Experiment, noise_estimate, noise_floor, row_scatter
from hvdc_ident.errors import StudyError

FLOOR = 1e-6
"""No standard deviation is below this share of an output's range."""

GIVEN = "given"
ESTIMATED = "estimated before the event"
MISFIT = "misfit"
FEWEST_QUIET = 8
"""Rows before an event from which the noise of a record is told."""


def from_misfit(source: str) -> bool:
    """Return whether a `noise_source` says that the standard deviation is that of the fit's own residual."""
    return source.startswith(MISFIT)


def quiet(experiments: Sequence[Experiment], output: str) -> bool:
    """Return whether every record of an output has rows enough before its event to tell its noise by."""
    measured = [e for e in experiments if output in e.outputs and e.measured is not None]
    counts = [
        0 if e.event is None else int(np.isfinite(e.measured[output][e.time < e.event]).sum())
        for e in measured
        if e.measured is not None
    ]
    return min(counts, default=0) >= FEWEST_QUIET


def unknown_noise(experiments: Sequence[Experiment], sources: Mapping[str, str]) -> dict[str, str]:
    """Why an output's standard deviation is that of the misfit, by output, as a clause. sources: `noise_source`.

    Data have no noise only where the model itself meets them to the last digits; a record that was measured has some, if not
    in the rows before the event.
    """
    found = {}
    for output, source in sources.items():
        if not from_misfit(source):
            continue
        if source != MISFIT:
            found[output] = "the record has no noise (the model meets it to 1e-6 of its range)"
        elif quiet(experiments, output) and not _moves_before(experiments, output):
            found[output] = "the record shows no noise before the event"
        else:
            found[output] = "its noise is not given, and no quiet rows before an event tell it"
    return found


def _moves_before(experiments: Sequence[Experiment], output: str) -> bool:
    """Return whether a record shows noise above its floor before its event."""
    for e in experiments:
        if output in e.outputs and e.measured is not None and e.event is not None:
            keep = (e.time < e.event) & np.isfinite(e.measured[output])
            v = e.measured[output]
            if noise_estimate(e.time[keep], v[keep], e.event) > noise_floor(v[np.isfinite(v)]):
                return True
    return False


def scatter_of(experiments: Sequence[Experiment], output: str) -> tuple[float, int] | None:
    """Return the white noise that an output's compared rows show from one to the next, and the number of rows behind it.

    In the output's unit, over all its records, each by its rows; None where one of them does not show it (`row_scatter`), or
    is a frequency response, which is as rough as the plant makes it.
    """
    found = []
    for e in experiments:
        if output in e.outputs and e.measured is not None:
            if e.domain != "time":
                return None
            keep = e.compared & np.isfinite(e.measured[output])
            one = row_scatter(e.time[keep], e.measured[output][keep])
            if one is None:
                return None
            found.append((one, int(keep.sum())))
    rows = sum(n for _, n in found)
    return (float(np.sqrt(sum(s * s * n for s, n in found) / rows)), rows) if rows else None


def source_text(experiments: Sequence[Experiment], output: str, floor: bool) -> str:
    """Where an output's standard deviation comes from, in words. floor: whether the misfit is no larger than `floor_of`."""
    if source_of(experiments, output) == MISFIT:
        return f"{MISFIT}, at the floor of 1e-6 of the range" if floor else MISFIT
    told = [e for e in experiments if output in e.outputs]
    estimated = [e.name for e in told if output in e.noise_dof]
    if not estimated:
        return GIVEN
    return ESTIMATED if len(estimated) == len(told) else f"{ESTIMATED} in {', '.join(estimated)}, given for the others"


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
