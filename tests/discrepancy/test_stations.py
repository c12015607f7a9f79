"""One effect that both of two stations have, each with a signal of its own; the records are computed by scipy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hvdc_ident import Experiment, InputSignal, Trajectory
from hvdc_ident.discrepancy import DiagnosisOptions, diagnose
from hvdc_ident.discrepancy.candidates import own_sources
from hvdc_ident.fit import FitParameter
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import parse_card

CARD = """
schema = 1
name = "two-stations"
[parameters]
K = {value = 30.0, min = 0.0}
X = {value = 0.2, min = 0.0}
[inputs]
ref1 = {value = 1.0}
ref2 = {value = 1.02}
[states]
x1 = {derivative = "K*err1", guess = 0.0}
x2 = {derivative = "K*err2", guess = 0.1}
q1 = {derivative = "(x1 - q1) / 0.03", guess = 0.0}
q2 = {derivative = "(x2 - q2) / 0.03", guess = 0.1}
[signals]
V1 = "1 + X*q1 + 0.3*X*q2"
V2 = "1 + 1.4*X*q2 + 0.3*X*q1"
err1 = "ref1 - V1"
err2 = "ref2 - V2"
[outputs]
V1 = "V1"
V2 = "V2"
q1 = "q1"
q2 = "q2"
"""
DROOP, K, X = 0.13, 30.0, 0.2
OUTPUTS, SIGMA = ("V1", "V2", "q1", "q2"), (2e-4, 2e-4, 1e-3, 1e-3)
TIME = np.round(np.arange(250) * 8e-3, 9)
MOVES = {
    "one": ("fit", {"ref1": [(0.2, 1.02), (1.1, 0.99)]}),
    "two": ("fit", {"ref2": [(0.2, 1.0), (1.1, 1.03)]}),
    "both": ("holdout", {"ref1": [(0.3, 1.01)], "ref2": [(1.0, 1.04)]}),
}


def _rest() -> np.ndarray:
    """q1, q2 at the set-points: droops count from there."""
    return np.linalg.solve(X * np.array([[1.0, 0.3], [0.3, 1.4]]), [0.0, 0.02])


def _solved(moves: Mapping[str, Sequence[tuple[float, float]]]) -> np.ndarray:
    """V1, V2, q1, q2 at every row: solved from move to move, the set-points constant between them."""
    rest, ref = _rest(), {"ref1": 1.0, "ref2": 1.02}
    changes = sorted((at, name, new) for name, own in moves.items() for at, new in own)
    edges = sorted({0.0, *(at for at, _, _ in changes), float(TIME[-1])})
    states, state = np.zeros((TIME.size, 4)), np.concatenate([rest, rest])
    for begin, end in pairwise(edges):
        ref |= {name: new for at, name, new in changes if at == begin}

        def rates(_: float, s: np.ndarray, ref: tuple[float, ...] = tuple(ref.values())) -> np.ndarray:
            x, q = s[:2], s[2:]
            return np.concatenate([K * (np.array(ref) - _voltages(q) - DROOP * (q - rest)), (x - q) / 0.03])

        here = (begin <= TIME) & (end >= TIME)
        run = solve_ivp(rates, (begin, end), state, dense_output=True, rtol=1e-9, atol=1e-12)
        states[here], state = run.sol(TIME[here]).T, run.y[:, -1]
    return np.column_stack([np.array([_voltages(q) for q in states[:, 2:]]), states[:, 2:]])


def _voltages(q: np.ndarray) -> np.ndarray:
    return 1.0 + X * np.array([q[0] + 0.3 * q[1], 1.4 * q[1] + 0.3 * q[0]])


def records() -> list[Experiment]:
    """The stations' records with a droop of each by its own reactive power."""
    random, found = np.random.default_rng(5), []
    for name, (role, moves) in MOVES.items():
        inputs = {}
        for n, first in (("ref1", 1.0), ("ref2", 1.02)):
            corners, value = [(0.0, first)], first
            for at, new in moves.get(n, []):
                corners += [(at, value), (at, new)]
                value = new
            inputs[n] = InputSignal.corners(tuple(corners))
        values = _solved(moves) + random.normal(size=(TIME.size, 4)) * SIGMA
        measured = Trajectory(TIME, values, OUTPUTS, ("",) * 4)
        noise = FrozenMap(dict(zip(OUTPUTS, SIGMA, strict=True)))
        found.append(
            Experiment(TIME, name, inputs=FrozenMap(inputs), measured=measured, noise=noise, event=0.2, role=role)
        )
    return found


def test_the_same_droop_of_both_stations_is_one_effect_with_one_size() -> None:
    told = diagnose(
        parse_card(CARD),
        records(),
        [FitParameter("K", 20.0, 5.0, 120.0)],
        effects=["coupling", "droop", "gain", "lag"],
        options=DiagnosisOptions(fallback=False),
    )
    (droop,) = told.effects
    assert (droop.effect, droop.source) == ("coupling", "q1, q2")
    assert droop.at in (("ref1", "ref2"), ("err1", "err2"))  # what is added to a set-point is added to its error
    size = droop.parameters["k"]
    assert size.ci95 is not None
    assert size.ci95[0] < -DROOP < size.ci95[1]
    assert size.ci95[1] - size.ci95[0] < 0.1 * DROOP
    assert "of its own of q1 and q2" in droop.text
    assert any((r.effect, r.at, r.source) == ("droop", ("err1", "err2"), "q1, q2") for g in told.ambiguity for r in g)
    assert told.gap.shrink_holdout == pytest.approx(1.0, abs=0.2)


def test_of_stations_each_brings_in_its_own() -> None:
    known = ["q1", "q2", "q3", "x1", "time2", "V1f", "V2f"]
    assert own_sources(["err1"], ["q2", "x1"], known) == [("q2",), ("x1",)]
    assert own_sources(["err1", "err2"], ["q2", "x1", "V1f", "w"], known) == [("q1", "q2"), ("V1f", "V2f")]
    assert own_sources(["err3", "err1"], ["q2", "q3"], known) == [("q3", "q1")]
    # Neither two signals of one station nor signals that are not alike are one thing at several stations.
    assert own_sources(["Ir1", "Ii1"], ["q1"], known) == []
    assert own_sources(["err1", "x2"], ["q1"], known) == []
    assert own_sources(["err", "x"], ["q1"], known) == []
