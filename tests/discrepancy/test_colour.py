"""The colour of noise: the likelihood against dense matrices, and known processes come back from few rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.signal import lfilter
from scipy.stats import multivariate_normal

from hvdc_ident import Experiment, InputSignal, Trajectory
from hvdc_ident.data import Array
from hvdc_ident.data.noise import RHO, TANH, FirstOrder, common_colours
from hvdc_ident.discrepancy.nominal import draws
from hvdc_ident.fit import Problem
from hvdc_ident.fit.noise import ESTIMATED, OutputNoise, noise_of, without_common
from hvdc_ident.immutable import FrozenMap

BEFORE = 50
SIGMA = {"a": 1.0, "b": 0.3, "c": 5.0}


def process(rho: float, shape: tuple[int, ...], seed: int) -> Array:
    """Stationary AR(1) noise of variance 1 along the first axis."""
    e = np.random.default_rng(seed).standard_normal((shape[0] + 400, *shape[1:]))
    return np.asarray(lfilter([np.sqrt(1.0 - rho**2)], [1.0, -rho], e, axis=0)[400:])


def records(rho: float, seed: int, told: float | None) -> list[Experiment]:
    """Three records of nothing but noise, 50 rows of them before the event. told: the true deviations, times this."""
    y = process(rho, (300, 3, 3), seed)
    times = np.arange(300) * 4e-3
    step = {"u": InputSignal.corners([(0.0, 0.0), (0.2, 0.0), (0.2, 1.0)])}
    noise = FrozenMap({} if told is None else {n: told * s for n, s in SIGMA.items()})
    return [
        Experiment(
            times, f"e{k}", inputs=FrozenMap(step), event=0.2, noise=noise,
            measured=Trajectory(times, y[:, k] * list(SIGMA.values()), tuple(SIGMA), ("", "", "")),
        )
        for k in range(3)
    ]  # fmt: skip


def test_the_likelihood_is_that_of_the_rows_without_their_line() -> None:
    parts = [process(0.7, (40,), 1), process(0.7, (30,), 2)]
    found = FirstOrder.of(parts)

    def dense(k: int, std: float) -> float:
        total = 0.0
        for r in parts:
            n = r.size
            free = null_space(np.vander(np.arange(n), 2).T)
            cover = std**2 * RHO[k] ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
            total += float(multivariate_normal.logpdf(free.T @ r, cov=free.T @ cover @ free))
        return total

    spots = [(20, 0.5), (50, 1.0), (65, 2.5)]
    own = np.array([found.at(std)[k] for k, std in spots])
    assert own - own[0] == pytest.approx(np.array([dense(*s) for s in spots]) - dense(*spots[0]), abs=1e-6)


def test_a_line_in_a_record_tells_nothing() -> None:
    r = process(0.9, (50,), 3)
    plain, sloped = FirstOrder.of([r]), FirstOrder.of([r + 0.2 * np.arange(50) - 3.0])
    assert sloped.level == pytest.approx(plain.level, rel=1e-9)


def test_a_given_deviation_sharpens_the_coefficient() -> None:
    alone, told = (
        np.array([n.model[0] for s in range(8) for n in noise_of(records(0.9, s, k)).values()]) for k in (None, 1.0)
    )
    assert np.abs(told - 0.9).max() < 0.06
    assert np.sqrt(np.mean((told - 0.9) ** 2)) < 0.5 * np.sqrt(np.mean((alone - 0.9) ** 2))


def test_steps_from_row_to_row_are_told_whatever_is_given() -> None:
    for told in (None, 0.3):
        for seed in range(4):
            for o, n in noise_of(records(0.9, seed, told)).items():
                assert n.std is not None
                steps = (n.std / SIGMA[o]) ** 2 * (1.0 - sum(n.model) ** 2)
                assert steps == pytest.approx(1.0 - 0.81, rel=0.7)


def test_white_noise_stays_white_beside_a_deviation_that_is_far_too_large() -> None:
    found = [n for s in range(8) for n in noise_of(records(0.0, s, 3.0)).values()]
    assert all(n.source == "given" for n in found)
    assert sum(not n.model for n in found) >= 18  # of 24, of which one in ten may look coloured
    assert max(abs(sum(n.model)) for n in found) < 0.5


def test_outputs_that_agree_are_told_together_and_others_apart() -> None:
    def profiles(*rhos: float) -> list[FirstOrder]:
        return [FirstOrder.of(list(process(r, (50, 3), k).T)) for k, r in enumerate(rhos)]

    alike = profiles(0.9, 0.9, 0.9)
    apart = [common_colours([own])[0].tanh for own in alike]
    shared = [c.tanh for c in common_colours(alike)]
    assert np.ptp(shared) < 0.7 * np.ptp(apart)
    mixed = common_colours(profiles(0.0, 0.95, 0.0))
    assert mixed[1].rho == pytest.approx(0.95, abs=0.06)
    assert abs(mixed[0].rho) < 0.3
    assert abs(mixed[2].rho) < 0.3
    assert TANH[0] < min(shared)


def test_drawn_noise_keeps_its_steps_where_no_deviation_is_given() -> None:
    from hvdc_ident.simulate import ModelSimulator
    from tests.discrepancy.cases import FREE, experiments, model

    problem = Problem(ModelSimulator(model()), experiments(), FREE, rho=FrozenMap({"w": 0.9, "torque": 0.9}))
    blocks = problem.blocks(problem.start, derivatives=False)
    level = [b.misfit for b in blocks]
    own = OutputNoise(1.0, (0.9,), 0.4, 0.0, ESTIMATED, 150)
    steps = []
    for n in (own, replace(own, source="given")):
        drawn = draws(problem, blocks, FrozenMap({"w": n, "torque": n}), level, 100, 0)
        # At the highest frequencies whitened noise is what the steps are.
        power = np.mean(np.diff(drawn[0], 2, axis=0) ** 2, axis=0) / 6.0
        steps.append(float(np.std(np.log(power))))
    assert steps[0] < 0.3
    assert steps[1] > 1.5 * steps[0]


def test_drawn_noise_is_as_uncertain_as_the_rows_that_tell_of_it() -> None:
    """A standard deviation from 46 degrees of freedom is known to 1/sqrt(2 x 46), in every record of its output alike."""
    from hvdc_ident.simulate import ModelSimulator
    from tests.discrepancy.cases import FREE, experiments, model

    problem = Problem(ModelSimulator(model()), experiments(), FREE)
    blocks = problem.blocks(problem.start, derivatives=False)
    spread = {}
    for freedom in (46, 0):
        told = OutputNoise(1.0, (), 0.0, 0.0, ESTIMATED, 50, freedom)
        drawn = draws(problem, blocks, FrozenMap({"w": told, "torque": told}), [b.misfit for b in blocks], 400, 0)
        loud = {
            b.output: np.concatenate([d for d, own in zip(drawn, blocks, strict=True) if own.output == b.output])
            for b in blocks
        }
        spread[freedom] = float(np.std(np.log(np.sqrt(np.mean(loud["w"] ** 2, axis=0)))))
    assert spread[46] == pytest.approx(1.0 / np.sqrt(92.0), rel=0.15)
    assert spread[0] < 0.3 * spread[46]


def test_a_ripple_that_all_records_share_is_no_noise() -> None:
    noise = list(process(0.9, (50, 3), 11).T)
    ripple = 0.8 * np.where(np.arange(50) % 3 == 0, 1.0, -0.5)
    rippling = [r + ripple for r in noise]
    assert common_colours([FirstOrder.of(rippling)])[0].rho < 0.75
    times = [np.arange(50.0)] * 3
    left = without_common(times, rippling)
    assert len(left) == 2
    assert common_colours([FirstOrder.of(left)])[0].rho == pytest.approx(0.9, abs=0.08)
    alike = sum(len(without_common(times, list(process(0.9, (50, 3), seed).T))) == 3 for seed in range(20))
    assert alike >= 18
