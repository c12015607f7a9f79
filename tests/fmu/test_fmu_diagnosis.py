"""Diagnosis at the ends of FMUs: of co-simulation, of those that do not start at rest, of those without inputs."""

from __future__ import annotations

import os
import time
from itertools import pairwise

import numpy as np
import pytest

from hvdc_ident import simulate
from hvdc_ident.data import InputSignal, Trajectory, experiment
from hvdc_ident.discrepancy import diagnose
from hvdc_ident.effects import apply_effects
from hvdc_ident.fit import FitParameter
from hvdc_ident.fmu import Limits
from tests.fmu.c_fmu import CModel, Var, needs_compiler
from tests.fmu.c_models import DECAY, PLAIN, RELEASED, spring

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


# The armature of a small machine at a given speed: L I' = U - R I - k w.
ARMATURE = CModel(
    "armature",
    PLAIN
    + """
#define NR 5
static void start(double *r) { r[2] = 1; }
static void equations(double *r, double t) { r[1] = (r[3] - r[2] * r[0] - 0.01 * r[4]) / 1e-3; }
""",
    (
        Var("i", 0),
        Var("der(i)", 1, more=(("derivative", "i"),)),
        Var("R", 2, "parameter", "tunable", (("start", "1"), ("min", "0"))),
        Var("U", 3, "input", "continuous", (("start", "0"),)),
        Var("w", 4, "input", "continuous", (("start", "0"),)),
        Var("I", 0, "output"),
    ),
    1,
)


def staircase(*values):
    """A signal that has the values one after the other, with jumps at 0.125, 0.33, 0.5 and 0.75 s."""
    at = (0.0, 0.125, 0.33, 0.5, 0.75, 1.0)
    return InputSignal.corners([(t, v) for v, ends in zip(values, pairwise(at), strict=True) for t in ends])


def test_a_gain_that_a_free_parameter_nearly_absorbs_is_among_what_is_told(fmu):
    """The voltage is 0.8 of what the record says and R is right: R = 1.25 and 1.25 times k w explain all but a thousandth."""
    model, instants = fmu(ARMATURE, 2, "co-simulation", ONE), np.linspace(0.0, 1.0, 201)
    drive = {"U": staircase(0.0, 0.1, 0.03, -0.04, 0.06), "w": staircase(0.0, 0.06, 0.1, 0.03, -0.04)}
    hidden = apply_effects(model, [{"effect": "gain", "at": "U", "parameters": {"k": 0.8}}])
    current = simulate(hidden, experiment("e", instants, drive))["I"]
    noise = 1e-3 * float(np.ptp(current))
    rows = (current + noise * np.random.default_rng(7).standard_normal(instants.size))[:, None]
    record = experiment("e", instants, drive, measured=Trajectory(instants, rows, ("I",), ("",)), noise={"I": noise})
    found = diagnose(model, [record], [FitParameter("R", 1.0, 0.6, 1.6)], effects=["gain", "lag", "delay", "offset"])
    told = {(e.effect, e.at) for e in (*found.effects, *(rival for group in found.ambiguity for rival in group))}
    assert found.verdict in ("named", "ambiguous") and ("gain", ("U",)) in told
