"""Directional derivatives: against the symbolic linear model, against differences, and through the steady start."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident.linearize import linearize
from hvdc_ident.simulate import engine_of
from tests.fmu_export.driver import rate_names, state_names


def at_start(run, values=None):
    """The run, in event mode at its start."""
    run.set(values or {})
    run.enter()
    run.raw.exitInitializationMode()
    run.settle()
    return run


@pytest.mark.parametrize(("name", "version"), [("link", "2.0"), ("augmented", "2.0"), ("augmented", "3.0")])
def test_a_b_c_d_are_the_symbolic_ones(fmu, name, version):
    f = fmu(name, version)
    reference = linearize(f.model)
    with f.instance(False) as run:
        at_start(run)
        rows = [*rate_names(f), *reference.output_names]
        found = run.jacobian(rows, [*state_names(f), *reference.input_names])
    expected = np.block([[reference.A, reference.B], [reference.C, reference.D]])
    assert np.abs(found - expected).max() <= 1e-9 * np.abs(expected).max()
    assert np.abs(found - expected)[np.abs(expected) < 10].max() <= 1e-9


@pytest.mark.parametrize("name", ["link", "augmented", "zoo", "remembering"])
def test_every_derivative_is_the_limit_of_differences(fmu, name):
    """At a point off the start: states moved, so that products of states do not vanish."""
    f = fmu(name)
    outputs = [v.name for v in f.description.modelVariables if v.causality == "output"]
    rows = [*rate_names(f), *outputs]
    tunable = [v.name for v in f.description.modelVariables if v.variability == "tunable"]
    knowns = [*state_names(f), *f.model.inputs, *tunable]
    with f.instance(False) as run:
        at_start(run)
        x = run.states() * (1 + 1e-3 * np.cos(np.arange(len(f.model.states))))
        run.states(x)
        run.settle()
        exact = run.jacobian(rows, knowns)

        def value(name, shift):
            if name in state_names(f):
                y = x.copy()
                y[state_names(f).index(name)] += shift
                run.states(y)
                result = run.get(rows)
                run.states(x)
                return result
            before = run.get([name])[0]
            run.set({name: before + shift})
            result = run.get(rows)
            run.set({name: before})
            return result

        for k, known in enumerate(knowns):
            h = 1e-5 * (abs(run.get([known])[0]) or 0.1)
            numeric = (value(known, h) - value(known, -h)) / (2 * h)
            size = 1e-6 * (np.abs(exact[:, k]).max() + 1e-3 * np.abs(exact).max())
            assert np.abs(numeric - exact[:, k]).max() <= size, known


@pytest.mark.parametrize(("name", "version"), [("link", "2.0"), ("zoo", "2.0"), ("zoo", "3.0"), ("remembering", "3.0")])
def test_the_start_has_exact_derivatives_too(fmu, name, version):
    """During initialisation states and outputs follow inputs and parameters through the steady start."""
    f = fmu(name, version)
    parameters = list(f.model.parameters)
    code = engine_of(f.model, parameters)
    s = code.structure.sizes
    p = np.array([q.value for q in f.model.parameters.values()])
    u = np.array([i.value for i in f.model.inputs.values()])
    y, _ = code.start(p, u)
    n = s.nx + s.nz
    expected = y[n:].reshape(n, s.width)[: s.nx, : s.np]
    with f.instance(False) as run:
        run.enter()
        assert np.allclose(run.get(state_names(f)), y[: s.nx], rtol=1e-12, atol=1e-13)
        found = run.jacobian(state_names(f), parameters)
        assert np.allclose(found, expected, rtol=1e-9, atol=1e-10 * np.abs(expected).max())
        outputs = [v.name for v in f.description.modelVariables if v.causality == "output"]
        for known in f.model.inputs:
            exact = run.derivative(outputs, known)
            at = run.get([known])[0]
            ends = []
            for shift in (1e-5, -1e-5):
                run.set({known: at + shift})
                ends.append(run.get(outputs))
            run.set({known: at})
            assert np.allclose((ends[0] - ends[1]) / 2e-5, exact, rtol=1e-6, atol=1e-7), known


def test_an_output_that_is_a_state_is_that_variable(fmu):
    f = fmu("link")
    with f.instance(False) as run:
        at_start(run)
        assert "Vdc1" in state_names(f)
        assert (run.derivative(["Vdc1"], "Vdc1") == 1.0).all()
        assert (run.derivative(["Vdc1"], "KPVDC") == 0.0).all()
