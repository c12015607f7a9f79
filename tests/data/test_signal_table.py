"""Results with named signals are asked alike, as a pandas DataFrame is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.errors import InputError, UnknownNameError

TIME = np.linspace(0.0, 1.0, 11)


def results() -> dict[str, Any]:
    lag = hi.Model("lag", inputs={"u": 0.0}, states={"x": "u - x"}, outputs={"y": "x"})
    run = hi.simulate(lag, TIME, inputs={"u": hi.step(0.0, 1.0, at=0.1)})
    record = hi.Experiment(TIME, inputs={"u": hi.step(0.0, 1.0, at=0.1)}, outputs={"y": run["y"]})
    return {"simulation": run, "trajectory": run.trajectory, "experiment": record}


@pytest.mark.parametrize("kind", ["simulation", "trajectory", "experiment"])
def test_signals_are_asked_by_name(kind: str) -> None:
    found = results()[kind]
    names = ["u", "y"] if kind == "experiment" else ["y"]
    assert list(found) == list(found.keys()) == names and len(found) == TIME.size
    assert "y" in found and "z" not in found
    assert [n for n, _ in found.items()] == names
    for name, values in found.items():
        np.testing.assert_array_equal(values, found[name])
    frame = found.to_frame()
    assert list(frame.columns) == names and len(frame) == TIME.size
    np.testing.assert_array_equal(frame["y"], found["y"])
    with pytest.raises(UnknownNameError, match=r"'z'.*y"):
        found["z"]


def test_a_run_is_no_data_to_fit_for_it_has_no_inputs() -> None:
    lag = hi.Model("lag", parameters={"T": 1.0}, inputs={"u": 0.0}, states={"x": "(u - x)/T"}, outputs={"y": "x"})
    with pytest.raises(InputError):
        hi.identify(lag, results()["simulation"], {"T": (0.1, 10.0)})
