"""FMUs whose binary begins with other values of parameters than their description says."""

import numpy as np
import pytest

from hvdc_ident import simulate
from hvdc_ident.data import experiment
from tests.fmu.c_fmu import needs_compiler
from tests.fmu.c_models import OTHERWISE

pytestmark = needs_compiler

TIME = np.linspace(0.0, 4.0, 81)
AT_REST = experiment("let go", TIME, {"u": 0.0})
DESCRIBED, OWN = 0.5, 1.5


def let_go(d):
    """Return x of 2 x'' + d x' + 8 x = 0 from x = 1, x' = 0."""
    decay = d / 4.0
    w = np.sqrt(4.0 - decay**2)
    return np.exp(-decay * TIME) * (np.cos(w * TIME) + decay / w * np.sin(w * TIME))


def by_damping(d):
    """Return dx/dd, from central differences of the closed form."""
    return (let_go(d + 1e-5) - let_go(d - 1e-5)) / 2e-5


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize(("interface", "near"), [("model-exchange", 1e-5), ("co-simulation", 2e-2)])
def test_a_run_has_the_values_it_names_whatever_ran_before(fmu, version, interface, near):
    model = fmu(OTHERWISE, version=version, interface=interface)
    for values in ({}, {"d": DESCRIBED}, {"d": 0.9}, {"d": DESCRIBED}, {}, {"m": 2.0}):
        found = simulate(model, AT_REST, values)
        np.testing.assert_allclose(found["y"], let_go(values.get("d", OWN)), atol=near)
        model.pool.cache.clear()
    assert "'d' = 1.5" in found.notes["own values"] and "'b'" not in found.notes["own values"]


def test_a_derivative_at_the_described_value_is_taken_there(fmu):
    model = fmu(OTHERWISE, interface="model-exchange")
    found = simulate(model, AT_REST, {"d": DESCRIBED}, ["d"])
    np.testing.assert_allclose(found.gradient("y")[:, 0], by_damping(DESCRIBED), atol=2e-4)
    found = simulate(
        model, AT_REST, sensitivities=["d"]
    )  # one that is varied is set: it stands where its derivative is taken
    np.testing.assert_allclose(found["y"], let_go(DESCRIBED), atol=1e-5)
    np.testing.assert_allclose(found.gradient("y")[:, 0], by_damping(DESCRIBED), atol=2e-4)
