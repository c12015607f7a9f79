"""Answers of a model to pushes at its slots: against runs of a card with the push written in, and a linear simulation by scipy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.signal import StateSpace, lsim
from scipy.stats import norm

from hvdc_ident import Experiment, InputSignal, simulate
from hvdc_ident.data import Array
from hvdc_ident.discrepancy.hypothesis import Refit, slot_signals
from hvdc_ident.discrepancy.pushes import INPUT_SIZES, Inversion, Pushed, Whitening, _hats, pushed
from hvdc_ident.effects import apply_effects
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import parse_card
from hvdc_ident.simulate import Tolerance
from tests.discrepancy.cases import CARD, TIME, TRUE, experiments, model
from tests.discrepancy.refits import plain

EXACT = Tolerance(rtol=1e-11, atol=1e-13)
READERS = {
    "wm": {'err = "ref - wm"': 'err = "ref - (wm + push)"', 'drag = "b*w"': 'drag = "b*w"'},
    "torque": {'"(torque - drag - load) / J"': '"(torque + push - drag - load) / J"', 'torque = "torque"': 'torque = "torque + push"'},
    "w": {'wm = "w"\n': 'wm = "w + push"\n', '"b*w"': '"b*(w + push)"', '[outputs]\nw = "w"': '[outputs]\nw = "w + push"'},
    "outputs.w": {'[outputs]\nw = "w"': '[outputs]\nw = "w + push"'},
}  # fmt: skip
"""By slot what its readers become where a push is added to it by hand."""


@pytest.fixture(scope="module")
def lagged() -> Refit:
    """The drive without the lag that its records have."""
    return plain(experiments(lag=0.03))


@pytest.fixture(scope="module")
def runs(lagged: Refit) -> dict[str, Pushed]:
    return pushed(lagged, slot_signals(lagged))


def by_hand(place: str, experiment: Experiment, values: FrozenMap[float], push: Array) -> Array:
    """Return (2, n), what the drive does more where its card has the push of a slot as an input: between 1e-4 of it either way."""
    card = CARD.replace("[inputs]\n", "[inputs]\npush = {value = 0.0}\n")
    for old, new in READERS[place].items():
        assert card.count(old) == 1, old
        card = card.replace(old, new)
    changed, answers = parse_card(card), []
    for sign in (1.0, -1.0):
        signal = InputSignal(experiment.time, sign * 1e-4 * push, experiment.time[:0])
        asked = experiment.with_(inputs=experiment.inputs | {"push": signal})
        run = simulate(changed, asked, values, outputs=("w", "torque"), tolerance=EXACT)
        answers.append(np.array([run["w"], run["torque"]]))
    return (answers[0] - answers[1]) / 2e-4


@pytest.mark.parametrize("place", READERS)
def test_an_answer_is_that_of_a_card_with_the_push_written_in(
    lagged: Refit, runs: dict[str, Pushed], place: str
) -> None:
    random = np.random.default_rng(3)
    for path in runs.values():
        smooth = np.convolve(random.standard_normal(TIME.size), np.hanning(41), "same")
        bump = np.exp(-(((TIME - 0.45) / 0.05) ** 2))
        pushes = np.column_stack([smooth, bump])
        found = path.answer(place, pushes)
        assert found.shape == (2, TIME.size, 2)
        for k in range(2):
            true = by_hand(place, path.experiment, FrozenMap(lagged.values), pushes[:, k])
            assert found[:, :, k] == pytest.approx(true, abs=1e-3 * np.abs(true).max())


def test_twice_the_push_is_twice_the_answer_and_no_push_is_none(runs: dict[str, Pushed]) -> None:
    path = runs["fit-1"]
    push = np.sin(15.0 * path.time) * (path.time > 0.3)
    other = np.interp(path.time, [0.0, 0.5, 1.2], [0.0, 1.0, 0.0])
    found = path.answer("torque", np.column_stack([push, 2.0 * push, 1e-6 * push, other, push + other, 0.0 * push]))
    most = np.abs(found).max()
    assert found[:, :, 1] == pytest.approx(2.0 * found[:, :, 0], abs=1e-9 * most)
    assert found[:, :, 2] == pytest.approx(1e-6 * found[:, :, 0], abs=1e-12 * most)
    assert found[:, :, 4] == pytest.approx(found[:, :, 0] + found[:, :, 3], abs=1e-3 * most)
    assert not found[:, :, 5].any()


def _closed_loop() -> StateSpace:
    """From a disturbance added to the torque's readers to speed and torque: states w, x."""
    j, b, kp, ki = TRUE["J"], TRUE["b"], TRUE["Kp"], TRUE["Ki"]
    a = np.array([[-(b + kp) / j, 1.0 / j], [-ki, 0.0]])
    return StateSpace(a, [[1.0 / j], [0.0]], [[1.0, 0.0], [-kp, 1.0]], [[0.0], [1.0]])


def at_truth(lagged: Refit) -> Refit:
    """The drive with its true gains."""
    return replace(lagged, theta=np.array([TRUE["Kp"], TRUE["Ki"]]))


def test_a_disturbance_of_the_torque_answers_as_the_linear_loop(lagged: Refit) -> None:
    first = at_truth(lagged)
    path = pushed(first, slot_signals(first))["fit-1"]
    d = 0.1 * np.sin(15.0 * (path.time - 0.3)) * (path.time > 0.3)
    fine = np.linspace(0.0, path.time[-1], 20001)
    _, expected, _ = lsim(_closed_loop(), np.interp(fine, path.time, d), fine)
    found = path.answer("torque", d[:, None])
    for k in range(2):
        at = np.interp(path.time, fine, expected[:, k])
        assert found[k, :, 0] == pytest.approx(at, abs=2e-4 * np.abs(at).max())


def test_a_constant_disturbance_begins_at_its_own_rest(runs: dict[str, Pushed]) -> None:
    """The integrator makes good a constant torque: speed and torque are unmoved."""
    found = runs["fit-1"].answer("torque", np.full((TIME.size, 1), 0.05))
    assert np.abs(found).max() < 1e-6


@pytest.mark.parametrize("place", ["wm", "drag", "w", "outputs.w"])
def test_a_small_gain_error_answers_as_the_model_with_it(lagged: Refit, place: str) -> None:
    """At signals without a jump: between two rows of a push a jump is a ramp."""
    first = at_truth(lagged)
    path = pushed(first, slot_signals(first))["fit-1"]
    found = path.answer(place, 1e-4 * path.values[place][:, None])[:, :, 0].T
    with_it = apply_effects(model(), [{"effect": "gain", "at": place, "parameters": {"k": 1.0001}}])
    e = path.experiment
    exact = (
        simulate(with_it, e, tolerance=EXACT).trajectory.values
        - simulate(model(), e, tolerance=EXACT).trajectory.values
    )
    assert np.abs(found - exact).max() < 0.01 * np.abs(exact).max()


def test_the_run_of_a_card_with_other_values_is_its_own(lagged: Refit) -> None:
    """One structure is compiled once: of the values that it was compiled with nothing may stay."""
    braked = replace(lagged, problem=replace(lagged.problem, held=lagged.problem.held | {"b": 0.9}))
    for first in (lagged, braked):
        path = pushed(first, slot_signals(first))["fit-1"]
        run = simulate(model(), path.experiment, first.values, outputs=["w", "drag"], tolerance=EXACT)
        assert path.values["w"] == pytest.approx(run["w"], abs=1e-6)
        assert path.values["drag"] == pytest.approx(run["drag"], abs=1e-6)


def test_the_directions_are_those_of_all_hats_beside_the_parameters(lagged: Refit, runs: dict[str, Pushed]) -> None:
    """How strongly each shows, and what the residual has of it: by a singular value decomposition of everything."""
    nominal, shown = lagged.nominal(), []
    for e in nominal.problem.fitted_experiments:
        whitening = Whitening.of([b for b in nominal.blocks if b.experiment == e.name], e, nominal)
        shown.append(whitening(runs[e.name].answer("torque", _hats(e, 200))))
    left, strength, _ = np.linalg.svd(nominal.projected(block_diag(*shown)), full_matrices=False)
    found = Inversion.of(nominal, runs, "torque")
    strong = strength > 1e-2 * strength[0]
    count = int(strong.sum())
    assert found.strength[:count] == pytest.approx(strength[strong], rel=1e-4)
    free = nominal.projected(nominal.residual[:, None])[:, 0]
    assert np.abs(found.wanted[:count]) == pytest.approx(np.abs(left[:, strong].T @ free), rel=1e-2, abs=0.05)
    assert np.abs(found.against(free[:, None])[:, 0]) == pytest.approx(np.abs(found.wanted), rel=1e-6, abs=1e-6)


def test_the_evidence_of_a_latent_input_is_that_of_a_gaussian_with_its_prior(
    lagged: Refit, runs: dict[str, Pushed]
) -> None:
    """Against the marginal likelihood computed from the covariance of the residual itself, by scipy."""
    latent = Inversion.of(lagged.nominal(), runs, "wm")
    told = float(latent.log_evidence(latent.wanted[:, None])[0])
    likely = []
    for size in INPUT_SIZES / latent.strength[0]:
        spread = np.sqrt(1.0 + (size * latent.strength) ** 2)
        likely.append(norm.logpdf(latent.wanted, scale=spread).sum() - norm.logpdf(latent.wanted).sum())
    assert told == pytest.approx(max(likely), rel=1e-9) and told > 100.0
    assert latent.log_evidence(np.zeros((latent.strength.size, 1)))[0] == pytest.approx(0.0, abs=1e-6)
