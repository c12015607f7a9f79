"""Global screening: the error without its extra, and known indices with it."""

from __future__ import annotations

import sys

import matplotlib as mpl
import numpy as np
import pytest

from hvdc_ident.data import experiment
from hvdc_ident.errors import InputError, StudyError
from hvdc_ident.model import parse_card
from hvdc_ident.sensitivity import morris, sobol

mpl.use("Agg")
CARD = """
schema = 1
name = "sum"
[parameters]
a = {value = 0.0}
b = {value = 0.0}
c = {value = 0.0}
[states]
x = {derivative = "a + 0.5*b + 0*c - x"}
[outputs]
y = "x"
"""
MODEL = parse_card(CARD)
REST = experiment("rest", np.array([0.0, 1.0]))
RANGES = {"a": (0.0, 1.0), "b": (0.0, 1.0), "c": (0.0, 1.0)}


def test_without_the_extra_the_message_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "SALib", None)
    for method in (morris, sobol):
        with pytest.raises(InputError, match=r"hvdc_ident\[screening\]"):
            method(MODEL, [REST], RANGES, against="base")


def test_a_linear_model_has_known_indices():
    pytest.importorskip("SALib")
    found = morris(MODEL, [REST], RANGES, against="base", trajectories=6)
    assert np.allclose(found.array("mu_star"), [[1, 0.5, 0]], atol=1e-6) and found.evaluations == 24
    shares = sobol(MODEL, [REST], RANGES, against="base", samples=256)
    assert np.allclose(shares.array("ST"), [[0.8, 0.2, 0]], atol=0.05)
    assert shares.to_dict()["measures"]["y"]["rest"]["c"]["ST"] == pytest.approx(0, abs=1e-9)
    assert found.to_xarray()["mu_star"].dims == ("series", "parameter")
    axes = found.plot()
    assert [b.get_height() for b in axes.patches] == pytest.approx([1, 0.5, 0], abs=1e-6)
    assert "mu_star" in str(found) and str(found).splitlines()[0] in found._repr_html_()
    assert "ST of the RMSE" in shares.plot(ax=axes).get_ylabel()
    with pytest.raises(StudyError, match="power of 2"):
        sobol(MODEL, [REST], RANGES, against="base", samples=100)
