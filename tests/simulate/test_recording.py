"""Slots driven by recordings and outputs seen through recording chains."""

import numpy as np
import pytest

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.errors import ModelError, UnknownNameError
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.models import load_model
from hvdc_ident.simulate import simulate

LINK = load_model("vsc-hvdc-link")
TIME = np.linspace(0.0, 0.4, 2001)
STEP = {"Pref2": InputSignal.step(0.1, 0.4, 0.5)}


def test_a_slot_driven_by_its_own_recording_changes_nothing():
    free = simulate(LINK, experiment("free", TIME, STEP), outputs=("Irorder2", "Vac2", "P2"))
    recorded = InputSignal(TIME, free["Vac2"], np.array([0.1]))
    driven = simulate(LINK, experiment("driven", TIME, {**STEP, "Vac2": recorded}, drive=("Vac2",)))
    np.testing.assert_allclose(driven["Irorder2"], free["Irorder2"], atol=2e-7)


def test_a_driven_signal_cuts_the_loop_behind_it():
    constant = experiment("cut", TIME, {**STEP, "P2_m": InputSignal.constant(0.4)}, drive=("P2_m",))
    order = simulate(LINK, constant)["Irorder2"]
    # An integrator whose measurement does not move: a ramp of 30 * 0.1 pu/s, up to where the limit holds it.
    ramp = order[(TIME > 0.11) & (TIME < 0.2)]
    assert np.ptp(np.diff(ramp)) < 1e-5 and np.diff(ramp).mean() / (TIME[1] - TIME[0]) == pytest.approx(3.0, rel=2e-3)


def test_a_recording_chain_delays_and_averages_an_output_alone():
    chain = FrozenMap({"P2": FrozenMap({"window-mean": 0.02, "delay": 0.005})})
    seen = simulate(LINK, experiment("seen", TIME, STEP, instrument=chain))
    plain = simulate(LINK, experiment("plain", TIME, STEP))
    np.testing.assert_allclose(seen["Irorder2"], plain["Irorder2"], atol=1e-8)
    fine = np.linspace(0.0, 0.4, 40001)
    p = simulate(LINK, experiment("fine", fine, STEP))["P2"]
    area = np.concatenate([[0.0], np.cumsum((p[1:] + p[:-1]) / 2 * np.diff(fine))])
    mean = (np.interp(TIME - 0.005, fine, area) - np.interp(TIME - 0.025, fine, area)) / 0.02
    late = TIME > 0.03
    np.testing.assert_allclose(seen["P2"][late], mean[late], atol=2e-6)
    assert seen["P2"][0] == pytest.approx(0.4, abs=1e-9)


def test_what_cannot_be_driven_is_said():
    with pytest.raises(UnknownNameError, match="did you mean 'Vac2'"):
        LINK.driven(("Vac3",))
    with pytest.raises(ModelError, match="output cannot be driven"):
        LINK.driven(("outputs.P2",))
