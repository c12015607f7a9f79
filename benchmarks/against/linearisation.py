"""Linearisation, against python-control."""

from __future__ import annotations

from collections.abc import Iterator

import control
import engine as link_bench  # of the folder above
import linearize as linear_bench  # of the folder above
import numpy as np

from hvdc_ident.linearize import find_operating_point, linearize
from hvdc_ident.linearize.system import system
from hvdc_ident.models import load_model

from .plant import Line


def linearisation() -> Iterator[Line]:
    """The linear model of the stiff link: python-control by differences of our right-hand side (linearize.py)."""
    model = load_model("vsc-hvdc-link")
    point = find_operating_point(model)
    s = system(model)
    peer = linear_bench.as_control(s, point)
    x, u = np.array([*point.states.values()]), np.array([*point.inputs.values()])
    own, other = linearize(model, point), control.linearize(peer, x, u)
    assert np.abs(own.A - other.A).max() / np.abs(own.A).max() < 1e-4, "python-control found another A"
    mine = link_bench.best(lambda: linearize(model, point), 100)
    y, w, p = point.y, point.w, point.p
    m = s.modes(y, w, p)
    yield Line(
        "linear model", "python-control", mine, theirs := link_bench.best(lambda: control.linearize(peer, x, u), 10)
    )
    yield Line("its Jacobian", "python-control", link_bench.best(lambda: s.jacobian(y, w, p, m), 1000), theirs)
