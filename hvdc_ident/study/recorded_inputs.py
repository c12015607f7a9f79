"""The records as a fit takes them: what the noise of recorded inputs does to the outputs is noise of the outputs."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from hvdc_ident.data import Array, Experiment, before_event
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit.frequency_data import with_responses
from hvdc_ident.fit.noise import OutputNoise, noise_of
from hvdc_ident.fit.simulator import Simulator, observe

if TYPE_CHECKING:
    from hvdc_ident.study.study import Study


def fitted_records(study: Study) -> tuple[Simulator, tuple[Experiment, ...]]:
    """Return the simulator and the experiments of a study's fit, measured frequency responses among them.

    A recorded input has noise, which the model follows before the event while the plant rests: what the model leaves of an output there is
    the noise of a fit, where the study does not state one. Where the noise of the inputs is known, that of outputs is their own
    (`PassedNoise`). Raises StudyError as `with_responses`.
    """
    simulator, experiments = with_responses(study.model, study.experiments, study.responses)
    noisy = [e for e in experiments if e.domain == "time" and e.outputs and not e.input_noise and _is_moved(e)]
    runs: dict[str, Mapping[str, Array]] = {}
    for e in noisy:
        with suppress(SimulationError):  # the fit says so where it is run
            runs[e.name] = observe(simulator, e, {n: c.given for n, c in study.candidates.items()}).values
    if not runs:
        return simulator, experiments
    noise = noise_of([e for e in noisy if e.name in runs], runs)
    return simulator, tuple(_with_noise(e, noise) if e.name in runs else e for e in experiments)


def _is_moved(experiment: Experiment) -> bool:
    """Return True where an input is not constant before the event."""
    rows = before_event(experiment.time, np.zeros(experiment.time.size), experiment.event)
    return any(np.ptp(s(experiment.time[rows])) > 0.0 for s in experiment.inputs.values()) if rows.any() else False


def _with_noise(experiment: Experiment, estimated: Mapping[str, OutputNoise]) -> Experiment:
    """Return the experiment with the noise that was found, where it was estimated and is louder than the record alone says."""
    noise, dof, told_by = dict(experiment.noise), dict(experiment.noise_dof), dict(experiment.noise_from)
    for o, n in estimated.items():
        if o in dof and n.std is not None and n.freedom and n.std > noise.get(o, 0.0):
            noise[o], dof[o], told_by[o] = n.std, float(n.freedom), n.source
    return experiment.with_(noise=noise, noise_dof=dof, noise_from=told_by)
