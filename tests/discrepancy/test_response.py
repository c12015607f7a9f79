"""Answers of a model to disturbances at its slots, against a linear simulation of the closed loop by hand and the exact runs."""

from __future__ import annotations

import numpy as np
import pytest
from cases import TIME, TRUE, experiments, model
from scipy.signal import StateSpace, lsim

from hvdc_ident import Experiment, InputSignal, simulate
from hvdc_ident.discrepancy.signatures.block import block
from hvdc_ident.discrepancy.signatures.response import along, instants
from hvdc_ident.effects import apply_effects
from hvdc_ident.immutable import FrozenMap


def _closed_loop() -> StateSpace:
    """From a disturbance added to the torque's readers to speed and torque: states w, x."""
    j, b, kp, ki = TRUE["J"], TRUE["b"], TRUE["Kp"], TRUE["Ki"]
    a = np.array([[-(b + kp) / j, 1.0 / j], [-ki, 0.0]])
    return StateSpace(a, [[1.0 / j], [0.0]], [[1.0, 0.0], [-kp, 1.0]], [[0.0], [1.0]])


def test_a_disturbance_of_the_torque_answers_as_the_linear_loop() -> None:
    path = along(model(), experiments()[0], {})
    d = 0.1 * np.sin(15.0 * path.time) * (path.time > 0.3)
    expected = lsim(
        _closed_loop(),
        np.interp(np.linspace(0, path.time[-1], 20001), path.time, d),
        np.linspace(0, path.time[-1], 20001),
    )
    _, y = path.answer(["torque"], d[None, :, None])
    at = np.interp(experiments()[0].time, expected[0], expected[1][:, 0])
    assert y[0, :, 0] == pytest.approx(at, abs=2e-4 * np.abs(at).max())


def test_a_constant_disturbance_begins_at_its_own_rest() -> None:
    path = along(model(), experiments()[0], {})
    u, y = path.answer(["torque"], np.full((1, path.time.size, 1), 0.05))
    # The integrator makes good a constant torque: the speed is unmoved, the slot's own signal falls by it.
    assert np.abs(y[0]).max() < 1e-12
    assert u[0, :, 0] == pytest.approx(-0.05, abs=1e-12)


@pytest.mark.parametrize("place", ["torque", "wm", "drag", "ref", "w", "outputs.w"])
def test_a_small_gain_error_answers_as_the_model_with_it(place: str) -> None:
    e = experiments()[0]
    path = along(model(), e, {})
    u = path.signal(place)
    _, y = path.answer([place], (1e-4 * u)[None, :, None])
    with_it = apply_effects(model(), [{"effect": "gain", "at": place, "parameters": {"k": 1.0001}}])
    exact = simulate(with_it, e).trajectory.values - simulate(model(), e).trajectory.values
    assert np.abs(y[:, :, 0].T - exact).max() < 0.01 * np.abs(exact).max()


def test_the_grid_has_every_row_and_both_sides_of_a_jump() -> None:
    e = experiments()[0]
    time, rows = instants(e)
    assert (np.diff(time) >= 0).all()
    assert np.array_equal(time[rows >= 0], e.time)
    assert np.count_nonzero(np.isclose(time, 0.2, atol=1e-12)) == 2


def recorded() -> Experiment:
    """Fifteen sines in the reference, known at the record's rows."""
    values = 1.0 + 0.05 * sum(np.sin(f * TIME) for f in np.geomspace(4.0, 120.0, 15))
    return Experiment(
        TIME,
        "recorded",
        inputs=FrozenMap({"ref": InputSignal.corners(list(zip(TIME, values, strict=True)))}),
        measured=experiments()[0].measured,
    )


@pytest.mark.parametrize("place", ["wm", "torque", "err"])
def test_an_input_known_at_every_row_needs_few_instants_more(place: str) -> None:
    """After a corner less happens at once than after a jump: a short lag is met all the same."""
    e, short = recorded(), 1.6e-3
    path = along(model(), e, {})
    assert path.time.size < 5.5 * TIME.size
    u = path.signal(place)[:, None]
    d = block("lag", ("T",), False).run({"own_T": np.array([short])}, path.time, u, None) - u
    _, y = path.answer([place], d[None])
    with_it = apply_effects(model(), [{"effect": "lag", "at": place, "parameters": {"T": short}}])
    exact = simulate(with_it, e).trajectory.values - simulate(model(), e).trajectory.values
    assert np.abs(y[:, :, 0].T - exact).max() < 0.05 * np.abs(exact).max()


def test_a_card_with_other_values_runs_with_its_own() -> None:
    """One structure is compiled once: of the values that it was compiled with nothing may stay."""
    e = experiments()[0]
    for m in (model(), model().with_values({"b": 0.9})):
        path = along(m, e, {})
        run = simulate(m, e.with_(time=instants(e)[0], measured=None), outputs=["w", "drag"])
        assert path.signal("w") == pytest.approx(run["w"], abs=1e-9)
        assert path.signal("drag") == pytest.approx(run["drag"], abs=1e-9)
