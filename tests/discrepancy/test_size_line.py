"""Many sizes of one effect looked at before a refit begins. Records: scipy, in `cases`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cases import TRUE, experiments
from refits import beside, plain
from scipy.optimize import least_squares

from hvdc_ident.discrepancy.refit import run
from hvdc_ident.discrepancy.size_line import SizeLine

LEVEL, BOUNDS = 0.9, (0.1, 6.0)


def test_a_level_that_the_signal_never_reaches_is_left_only_by_a_look_at_many() -> None:
    first = plain(experiments(meter=lambda torque: np.clip(torque, -LEVEL, LEVEL)))
    job = beside(first, "limit", "outputs.torque", {"level": 3.0}, {"level": BOUNDS})
    name = job.placed[-1].names["level"]
    stuck, found = run(job), run(replace(job, swept=name))
    assert stuck.values[name] == pytest.approx(3.0) and stuck.chi2 == pytest.approx(first.chi2, rel=1e-6)
    assert found.values[name] == pytest.approx(LEVEL, rel=2e-3)
    assert found.values["Kp"] == pytest.approx(TRUE["Kp"], rel=2e-3)
    assert found.chi2 / found.rows == pytest.approx(1.0, abs=0.1)


def test_what_a_size_leaves_is_what_a_linear_fit_of_the_others_leaves() -> None:
    first = plain(experiments(meter=lambda torque: np.clip(torque, -LEVEL, LEVEL)))
    job = beside(first, "limit", "outputs.torque", {"level": 1.2}, {"level": BOUNDS})
    theta, at = job.begins[0], job.problem.names.index(job.placed[-1].names["level"])
    line = SizeLine.of(job.model, job.problem, theta, at)
    others = np.delete(np.vstack([b.jacobian for b in job.problem.blocks(theta)]), at, axis=1)
    there = theta.copy()
    there[at] = 1.0
    residual = np.concatenate([b.residual for b in line.problem.blocks(there, derivatives=False)])
    left = 2.0 * least_squares(lambda step: residual + others @ step, np.zeros(others.shape[1]), x_scale="jac").cost
    assert line.fitted(1.0) == pytest.approx(left, rel=1e-6)
    assert line.left(1.0) > line.fitted(1.0)
