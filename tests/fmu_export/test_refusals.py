"""What an exported FMU refuses, and the reason it logs."""

from __future__ import annotations

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException


def refused(capfd, call, *arguments):
    """The logged reason of a call that has to fail."""
    capfd.readouterr()
    with pytest.raises(FMICallException, match="failed"):
        call(*arguments)
    return "".join(capfd.readouterr())


def test_the_wrong_token_gives_no_instance(fmu, capfd):
    f = fmu("link")
    description = f.description
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(description, "guid", "{wrong}")
        with pytest.raises(Exception, match="instantiate"), f.instance(True):
            pass
    assert "GUID" in "".join(capfd.readouterr())


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_calls_out_of_order_are_refused(fmu, capfd, version):
    f = fmu("link", version)
    with f.instance(True) as run:
        assert "not allowed" in refused(capfd, run.step, 0.0, 0.1)
        run.enter()
        assert "not allowed" in refused(capfd, run.step, 0.0, 0.1)
        run.raw.exitInitializationMode()
        run.step(0.0, 0.1)
        assert "the last one ended at 0.1 s" in refused(capfd, run.step, 0.5, 0.1)
        assert "cannot be done" in refused(capfd, run.step, 0.1, -0.1)


def test_an_input_level_without_a_steady_state_names_an_equation(fmu, capfd):
    f = fmu("link")
    with f.instance(True) as run:
        run.set({"Pref2": 5.0, "E2": 0.0})
        run.enter()
        said = refused(capfd, run.raw.exitInitializationMode)
        assert "no steady state" in said
        # The instance is not lost: a reset brings it back.
        run.raw.reset()
        run.enter()
        run.raw.exitInitializationMode()
        run.step(0.0, 0.1)


def test_values_that_cannot_be_set_are_refused(fmu, capfd):
    f = fmu("zoo")
    with f.instance(False) as run:
        assert "not finite" in refused(capfd, run.set, {"a": float("nan")})
        run.set({"T": -1.0})
        run.enter()
        assert "the delay 'late' is -1 s" in refused(capfd, run.raw.exitInitializationMode)
        run.set({"T": 0.02})
        assert "cannot be set" in refused(capfd, run.set, {"f": 1.0})  # its start follows from a parameter
        run.raw.exitInitializationMode()
        run.settle()
        assert "fixed after initialisation" in refused(capfd, run.set, {"T": 0.03})
        assert "cannot be set" in refused(capfd, run.set, {"x": 1.0})
        run.set({"a": 25.0})
        run.raw.enterContinuousTimeMode()
        assert "event mode first" in refused(capfd, run.set, {"a": 30.0})
        assert "not finite" in refused(capfd, run.states, [np.nan, 0.0, 0.0, 0.0])


def test_a_start_far_off_is_found_from_the_known_one(fmu):
    """The guess for a state may be set; a useless one does not keep the steady state from being found."""
    f = fmu("link")
    with f.instance(False) as run:
        run.enter()
        expected = run.states()
        run.set({"Vdc1": -30.0, "xv": 1e3})
        found = run.states()
    assert np.allclose(found, expected, rtol=1e-10, atol=1e-10)
