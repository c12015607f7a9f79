"""Records of the small drive of `cases` that scipy computes: of a torque shown by a meter, or of another course."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.signal import TransferFunction, lsim

from hvdc_ident import Experiment, InputSignal, Trajectory
from hvdc_ident.data import Array
from hvdc_ident.immutable import FrozenMap
from tests.discrepancy.cases import EVENT, RUNS, SIGMA, TIME, corners, experiments


def filtered(numerator: list[float], denominator: list[float]) -> tuple[Experiment, ...]:
    """Records of the drive whose torque is shown by a meter with this transfer function."""

    def meter(torque: Array) -> Array:
        shown = lsim(TransferFunction(numerator, denominator), torque - torque[0], TIME)[1]
        return np.asarray(torque[0] * numerator[-1] / denominator[-1] + shown)

    return experiments(meter=meter)


def records(course: Callable[[dict[str, InputSignal]], Array]) -> tuple[Experiment, ...]:
    """What `course` (inputs to (n, 2) speed and torque) makes of the three runs, with white noise."""
    random = np.random.default_rng(0)
    found = []
    for name, (role, moves) in RUNS.items():
        inputs = {n: InputSignal.corners(corners({"ref": 1.0, "load": 0.0}[n], m)) for n, m in moves.items()}
        measured = noisy(course(inputs), random)
        found.append(
            Experiment(
                TIME, name, inputs=FrozenMap(inputs), measured=measured, noise=FrozenMap(SIGMA), event=EVENT, role=role
            )
        )
    return tuple(found)


def noisy(y: Array, random: np.random.Generator) -> Trajectory:
    """The course of speed and torque as it is recorded."""
    seen = y + random.standard_normal(y.shape) * list(SIGMA.values())
    return Trajectory(TIME, seen, tuple(SIGMA), ("", ""))
