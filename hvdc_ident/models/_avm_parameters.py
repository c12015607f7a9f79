"""The average-value link's inputs and parameters, in either rating."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hvdc_ident.parameters import Input, Parameter

X_TRANSFORMER, R_TRANSFORMER, X_ARM = 0.18, 0.001, 0.075


@dataclass(frozen=True)
class Rating:
    """Parameters that differ between two ratings: MVA, power at the start in pu, gains in pu and pu/s, C in s, Zg, Rdc in pu."""

    base: float
    power: float
    KPVDC: float
    KIVDC: float
    C: float
    Zg: float
    Rdc: float


RATINGS = {
    "paper": Rating(100.0, 0.4, 24.0, 734.7, 0.2, 0.01, 1.0 / 4096),
    "authors": Rating(1000.0, 1.0, 9.6, 293.87755, 195.3e-6 * 409.6, 0.1, 1.022 / 409.6),
}


def inputs(rated: Rating) -> dict[str, Input]:
    """The inputs with their start values in pu."""
    return {
        "Vdcref1": Input(1.0, "pu", "dc voltage set-point of station 1"),
        "Qref1": Input(0.0, "pu", "reactive power set-point of station 1"),
        "Pref2": Input(rated.power, "pu", "active power set-point of station 2"),
        "Qref2": Input(0.0, "pu", "reactive power set-point of station 2"),
        "E1": Input(1.0, "pu", "grid voltage of station 1"),
        "E2": Input(1.0, "pu", "grid voltage of station 2"),
        "Iload1": Input(0.0, "pu", "dc current drawn from the capacitor of station 1"),
    }


def _parameter(value: float, unit: str, text: str) -> Parameter:
    return Parameter(value, unit, min=0.0, description=text)


def gains(rated: Rating) -> dict[str, Parameter]:
    """The outer controls' gains, named as in the phasor link."""
    return {
        "KPVDC": _parameter(rated.KPVDC, "pu", "proportional gain of the dc voltage control"),
        "KIVDC": _parameter(rated.KIVDC, "pu/s", "integral gain of the dc voltage control"),
        "KPQ": _parameter(0.0, "pu", "proportional gain of the reactive power control, station 1"),
        "KIQ": _parameter(30.0, "pu/s", "integral gain of the reactive power control, station 1"),
        "KPP": _parameter(0.0, "pu", "proportional gain of the active power control, station 2"),
        "KIP": _parameter(30.0, "pu/s", "integral gain of the active power control, station 2"),
        "KPQ2": _parameter(0.0, "pu", "proportional gain of the reactive power control, station 2"),
        "KIQ2": _parameter(30.0, "pu/s", "integral gain of the reactive power control, station 2"),
    }


def plant(rated: Rating) -> dict[str, Parameter]:
    """Grids, transformers, arms and dc side."""
    return {
        "C1": _parameter(rated.C, "s", "dc capacitance of station 1"),
        "C2": _parameter(rated.C, "s", "dc capacitance of station 2"),
        "Rdc": _parameter(rated.Rdc, "pu", "dc line resistance"),
        "Zg": _parameter(rated.Zg, "pu", "grid impedance of either station, 10 GVA"),
        "XR": _parameter(10.0, "", "X/R of the grids"),
        "XT": _parameter(X_TRANSFORMER, "pu", "transformer reactance"),
        "RT": _parameter(R_TRANSFORMER, "pu", "transformer resistance"),
        "XA": _parameter(X_ARM, "pu", "arm reactance as the ac side sees it: half of 0.15"),
        "Rs": _parameter(2 / 3 * 0.4 / 409.6, "pu", "dc-side resistance of a station: 2/3 of 400 modules of 1 mohm"),
        "Ls": _parameter(2 / 3 * 0.15 / 4 / (100 * math.pi), "s", "dc-side inductance of a station: 2/3 of an arm's"),
        "F0": _parameter(50.0, "Hz", "grid frequency"),
    }


def inside(filtered: bool) -> dict[str, Parameter]:
    """Parameters that the phasor link lacks: current control, PLL, feed-forward and filters."""
    filter_ = {"FM": _parameter(140.0, "Hz", "-3 dB frequency of the measurement filters")} if filtered else {}
    return {
        "KPI": _parameter(0.4870141, "pu", "proportional gain of the current control"),
        "KII": _parameter(149.085957, "pu/s", "integral gain of the current control"),
        "KX": _parameter(X_TRANSFORMER + X_ARM, "pu", "reactance that the current control decouples"),
        "FF": _parameter(11.0, "Hz", "-3 dB frequency of the voltage feed-forward"),
        "FV": _parameter(16.0, "Hz", "-3 dB frequency of the Bessel filter on the ac voltage"),
        "KPPLL": _parameter(80.0, "rad/s", "proportional gain of the PLL"),
        "KIPLL": _parameter(1600.0, "rad/s^2", "integral gain of the PLL"),
        "Tpll": _parameter(0.02, "s", "window of the PLL's mean, one cycle"),
    } | filter_
