"""Records rounded to steps that their noise does not hide: levels that are off by a share of a step are no evidence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hvdc_ident import Experiment, Trajectory
from hvdc_ident.discrepancy.hypothesis import OPTIMISER
from hvdc_ident.discrepancy.nominal import Nominal, nominal
from hvdc_ident.effects import EffectUse, apply_effects
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.simulate import ModelSimulator
from tests.discrepancy.cases import FREE, SIGMA, experiments, model

LAG = 0.03
STEP = {n: 8.0 * s for n, s in SIGMA.items()}


def _start(seed: int) -> Nominal:
    """The drive without its lag, fitted to rounded records of the drive with it."""
    given = [_rounded(e) for e in experiments(lag=LAG, noise="white", seed=seed)]
    return nominal(ModelSimulator(model()), given, FREE, {}, None, starts=1, seed=0, executor=None)[0]


def _rounded(e: Experiment) -> Experiment:
    assert e.measured is not None
    rows = [np.round(e.measured[o] / s) * s for o, s in STEP.items()]
    return e.with_(measured=Trajectory(e.time, np.column_stack(rows), tuple(STEP), ("", "")), noise=FrozenMap())


def _chi2(problem: Problem, uses: dict[str, tuple[EffectUse, str, tuple[float, float, float]]]) -> float:
    """The least chi2 with these effects; of each one parameter is free: its name, start and bounds."""
    subject, free, theta = model(), [*problem.free], [f.start for f in problem.free]
    for use, name, (start, low, high) in uses.values():
        before = set(subject.parameters)
        subject = apply_effects(subject, [use])
        own = next(n for n in subject.parameters if n not in before and n.endswith(name))
        free.append(FitParameter(own, start, low, high))
        theta.append(start)
    whole = replace(problem, simulator=ModelSimulator(subject), free=tuple(free))
    end = OPTIMISER.run(whole, np.array(theta))
    assert end.status == "converged", end.message
    return sum(b.chi2 for b in whole.blocks(end.theta))


def _both(problem: Problem) -> tuple[float, float]:
    """chi2 with the lag that is there, and by how much offsets of both outputs, which are not there, lower it."""
    lag = {"lag": (EffectUse("lag", ("wm",), FrozenMap({"T": LAG})), "T", (LAG, 0.001, 0.2))}
    offsets = {
        o: (EffectUse("offset", (f"outputs.{o}",), FrozenMap({"c": 0.01 * s})), "c", (0.01 * s, -s, s))
        for o, s in STEP.items()
    }
    truth = _chi2(problem, lag)
    return truth, truth - _chi2(problem, lag | offsets)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_rounding_alone_rewards_no_offset(seed: int) -> None:
    found = _start(seed)
    assert set(found.problem.quantised_noise) == set(SIGMA)
    chi2, gain = _both(found.problem)
    rows = sum(b.residual.size for b in found.blocks)
    assert gain < 10.0  # two parameters of chi2: the chance of more is 0.7 %
    assert chi2 == pytest.approx(rows, rel=0.2)  # the noise below the quantiser is a guess


def test_taken_for_white_noise_it_rewards_them_more() -> None:
    problems = [_start(seed).problem for seed in (0, 1, 2)]
    plain = sum(_both(replace(p, quantised_noise=FrozenMap()))[1] for p in problems)
    assert plain > 2.0 * sum(_both(p)[1] for p in problems)
