"""Impedances in the network's frame, against the circuit."""

from dataclasses import replace

import numpy as np
import pytest

from hvdc_ident.errors import LinearizationError, UnknownNameError
from hvdc_ident.expression import parse
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize import Port, find_operating_point, port_admittance, port_impedance
from hvdc_ident.linearize.operating_point import signal_value
from hvdc_ident.model import Delay, Model, Output, Signal, State
from hvdc_ident.models import load_model
from hvdc_ident.parameters import Input, Parameter

W = np.array([1.0, 50.0, 314.0, 2000.0])


def coil():
    """A coil at 100 pi rad/s, 0.1 + j0.5 pu, in a frame turned by 0.3 rad against the network's."""
    return Model(
        name="coil",
        parameters=FrozenMap({"r": Parameter(0.1), "x": Parameter(0.5), "w0": Parameter(100 * np.pi)}),
        inputs=FrozenMap({"E": Input(1.0)}),
        states=FrozenMap(
            {
                "d": State(parse("w0/x*(ed - r*d + x*q)"), guess=0.0),
                "q": State(parse("w0/x*(eq - r*q - x*d)"), guess=0.0),
            }
        ),
        signals=FrozenMap({"ed": Signal(parse("E*cos(0.3)")), "eq": Signal(parse("-E*sin(0.3)"))}),
        outputs=FrozenMap({"d": Output(parse("d"))}),
    )


def by_hand(r, x, w0, w):
    s = 1j * w / w0
    return np.array([[[r + x * k, -x], [x, r + x * k]] for k in s])


def test_a_coil():
    port = Port(("ed", "eq"), ("ed", "eq"), ("d", "q"), "0.3")
    found = port_impedance(coil(), port, W)
    np.testing.assert_allclose(found.values, by_hand(0.1, 0.5, 100 * np.pi, W), rtol=1e-12, atol=1e-13)
    inverse = port_admittance(coil(), port, W)
    np.testing.assert_allclose(found.values @ inverse.values, np.broadcast_to(np.eye(2), (4, 2, 2)), atol=1e-12)


def test_a_station_s_impedance_and_the_grid_s_are_the_whole():
    """Seen from behind the grid and from the terminal of station 1: what lies between is the grid's coil."""
    model = load_model("vsc-hvdc-avm")
    point = find_operating_point(model)
    current = ("Ir1", "-Ii1")
    whole = port_impedance(model, Port(("Ed1", "Eq1"), ("Ed1", "Eq1"), current, "psi1"), W, point)
    station = port_impedance(model, Port(("Ed1", "Eq1"), ("vd1", "vq1"), current, "psi1"), W, point)
    r, x = signal_value(model, point, "R"), signal_value(model, point, "X")
    w0 = signal_value(model, point, "w0")
    np.testing.assert_allclose(whole.values - station.values, by_hand(r, x, w0, W), rtol=1e-6, atol=1e-7)


def test_the_phase_of_an_impedance_counts_its_turns():
    """A coil whose voltage is measured late, z e^(-s T): at four frequencies the phase has gone round some twenty times."""
    late = replace(
        coil(),
        parameters=coil().parameters | {"T": Parameter(0.06, unit="s")},
        delays=FrozenMap({"ed_late": Delay(parse("ed"), parse("T")), "eq_late": Delay(parse("eq"), parse("T"))}),
    )
    found = port_impedance(late, Port(("ed", "eq"), ("ed_late", "eq_late"), ("d", "q"), "0.3"), W)
    want = by_hand(0.1, 0.5, 100 * np.pi, W) * np.exp(-0.06j * W)[:, None, None]
    np.testing.assert_allclose(found.values, want, rtol=1e-9)
    own = np.degrees(np.angle(by_hand(0.1, 0.5, 100 * np.pi, W)))
    turned = found.phase_deg + np.degrees(0.06 * W)[:, None, None] - own
    np.testing.assert_allclose(turned, np.broadcast_to(turned[:1], turned.shape), atol=1e-6)


def test_a_port_that_cannot_be():
    with pytest.raises(UnknownNameError):
        port_impedance(coil(), Port(("ed", "nothing"), ("ed", "eq"), ("d", "q")), W)
    with pytest.raises(LinearizationError, match="both axes"):
        port_impedance(coil(), Port(("ed", "eq"), ("ed", "eq"), ("d", "d")), W)
