"""The multi-terminal grid against the two-terminal link, and against the physics of its dc lines."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident import find_operating_point, linearize, load_model, simulate
from hvdc_ident.data import Experiment, InputSignal
from hvdc_ident.errors import ModelError
from hvdc_ident.models.vsc_mtdc import vsc_mtdc

TIME = np.linspace(0.0, 0.5, 251)


def step(name: str, before: float, after: float) -> Experiment:
    signal = InputSignal(np.array([0.0, 0.1, 0.1]), np.array([before, before, after]), np.array([0.1]))
    return Experiment(name="step", time=TIME, inputs={name: signal})


def test_two_terminals_are_the_link() -> None:
    names = {"Irorder1": "Irorder1", "Vdc2": "Vdc2", "P2": "P2", "Q1": "Q1", "Idc": "Idc1_2"}
    experiment = step("Vdcref1", 1.0, 1.019)
    link = simulate(load_model("vsc-hvdc-link"), experiment, {}).trajectory
    grid = simulate(vsc_mtdc(2), experiment, {}).trajectory
    for ours, theirs in names.items():
        np.testing.assert_allclose(grid[theirs], link[ours], rtol=0, atol=1e-7)


def test_two_terminals_have_the_links_poles() -> None:
    poles = [np.sort_complex(linearize(m, find_operating_point(m)).poles()) for m in _pair()]
    np.testing.assert_allclose(poles[0], poles[1], rtol=1e-9)


def _pair():
    return load_model("vsc-hvdc-link"), vsc_mtdc(2)


@pytest.mark.parametrize("terminals", [3, 7])
def test_at_rest_every_node_is_balanced(terminals: int) -> None:
    model = load_model(f"vsc-mtdc-{terminals}")
    assert len(model.states) == 3 * terminals
    rest = find_operating_point(model)
    out = rest.outputs
    for i in range(1, terminals + 1):
        flows = sum(
            out[n] * (1 if n.startswith(f"Idc{i}_") else -1)
            for n in out
            if n.startswith("Idc") and str(i) in n[3:].split("_")
        )
        assert out[f"P{i}"] / out[f"Vdc{i}"] + flows == pytest.approx(0.0, abs=1e-9)
    losses = sum((out[n] ** 2) / 4096 for n in out if n.startswith("Idc"))
    assert sum(out[f"P{i}"] for i in range(1, terminals + 1)) == pytest.approx(losses, abs=1e-9)


def test_only_sizes_that_make_sense() -> None:
    with pytest.raises(ModelError, match="2 to 400"):
        load_model("vsc-mtdc-1")
