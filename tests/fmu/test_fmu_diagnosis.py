"""Diagnosis at the ends of FMUs: of co-simulation, of those that do not start at rest, of those without inputs."""

from __future__ import annotations

import os
import time

import numpy as np
import pytest
from c_fmu import needs_compiler
from c_models import DECAY, RELEASED, spring

from hvdc_ident import simulate
from hvdc_ident.data import InputSignal, Trajectory, experiment
from hvdc_ident.discrepancy import diagnose
from hvdc_ident.effects import apply_effects
from hvdc_ident.fit import FitParameter
from hvdc_ident.fmu import Limits

pytestmark = needs_compiler

TIME = np.linspace(0.0, 5.0, 151)
DRIVE = {"u": InputSignal.corners([(0, 0.0), (1, 0.0), (1, 1.0), (3, 1.0), (3, -0.5)])}
SPRING = [FitParameter("k", 8.0, 2.0, 30.0), FitParameter("d", 0.5, 0.1, 3.0)]
FREE = [FitParameter("a", 1.0, 0.1, 5.0)]
AT_REST = spring("at_rest", own=False)
ONE = Limits(runs=100_000, workers=1)  # one process throughout, whose time can be read at the end
MOST = 60.0  # s of processor time of a diagnosis, its FMU's process included


def processor_time(pid):
    """The processor time of a process, s."""
    with open(f"/proc/{pid}/stat") as text:
        fields = text.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@pytest.mark.parametrize(
    ("subject", "drive", "free", "effect", "at", "size"),
    [
        (AT_REST, DRIVE, SPRING, "gain", "u", {"k": 0.8}),
        (AT_REST, DRIVE, SPRING, "lag", "y", {"T": 0.15}),
        (RELEASED, DRIVE, SPRING, "gain", "u", {"k": 0.8}),
        (RELEASED, DRIVE, SPRING, "lag", "y", {"T": 0.15}),
        (DECAY, {}, FREE, "gain", "y", {"k": 1.3}),
        (DECAY, {}, FREE, "lag", "y", {"T": 0.15}),
    ],
    ids=["rest-gain", "rest-lag", "released-gain", "released-lag", "no-inputs-gain", "no-inputs-lag"],
)
def test_a_hidden_effect_at_an_end_of_a_co_simulation_is_named(fmu, subject, drive, free, effect, at, size):
    """The record is the FMU's own run with the effect, with a thousandth of its range as noise."""
    model, random = fmu(subject, 2, "co-simulation", ONE), np.random.default_rng(4)
    hidden = apply_effects(model, [{"effect": effect, "at": at, "parameters": size}])
    run = simulate(hidden, experiment("e", TIME, drive))
    names = tuple(model.outputs)
    noise = {n: 1e-3 * float(np.ptp(run[n])) for n in names}
    rows = np.column_stack([run[n] + noise[n] * random.standard_normal(TIME.size) for n in names])
    measured = Trajectory(TIME, rows, names, ("",) * len(names))
    record = experiment("e", TIME, drive, measured=measured, noise=noise, event=1.0 if drive else 0.0)

    worker = model.pool._processes.workers[0].pid
    begun = time.process_time() + processor_time(worker)
    found = diagnose(model, [record], free, effects=["gain", "lag", "delay", "offset"])
    taken = time.process_time() + processor_time(worker) - begun

    assert found.verdict == "named"
    (named,) = found.effects
    assert named.effect == effect and named.at == (at,)
    for name, value in size.items():
        assert named.parameters[name].value == pytest.approx(value, rel=0.05)
    assert taken < MOST
