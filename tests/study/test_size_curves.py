"""The runs behind the report's slider: the model with the effect at several sizes, beside the recording it matters most for."""

from __future__ import annotations

import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.discrepancy.result import Diagnosis, EffectSize, FoundEffect, Gap
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.study.size_curves import SHARES, size_curves

TIME = np.linspace(0.0, 2.0, 201)
STEP = hi.step(0.0, 1.0, at=0.5)
PLANT = hi.Model("plant", inputs={"u": 0.0}, states={"x": "4*(u - x)"}, outputs={"y": "x"})


def experiment(name: str, role: str = "fit") -> hi.Experiment:
    return hi.Experiment(
        TIME, name, inputs={"u": STEP}, outputs={"y": np.zeros(TIME.size)}, noise={"y": 0.01}, role=role
    )


def diagnosis(effect: str, size: dict[str, float], gap: Gap, at: str = "u") -> Diagnosis:
    found = FoundEffect(
        effect, (at,), FrozenMap({n: EffectSize(v, unit="s" if n == "T" else "") for n, v in size.items()})
    )
    return Diagnosis("named", effects=(found,), gap=gap, augmented=PLANT)


HERE = Gap(refitted={"fit": {"y": {"e": 0.3}}}, augmented={"fit": {"y": {"e": 0.1}}})


def first_order(rate: float, lag: float) -> np.ndarray:
    """The step response of a first-order plant behind a lag, in closed form."""
    t = np.clip(TIME - 0.5, 0.0, None)
    if lag == 0.0:
        return 1.0 - np.exp(-rate * t)
    a, b = 1.0 / lag, rate
    return 1.0 - (b * np.exp(-a * t) - a * np.exp(-b * t)) / (b - a)


def test_the_curves_of_a_lag_are_those_of_its_time_constants() -> None:
    found = size_curves(PLANT, [experiment("e")], diagnosis("lag", {"T": 0.1}, HERE))
    assert found is not None and [*found.sizes] == [None, *(pytest.approx(0.1 * s) for s in SHARES[1:])]
    assert found.labels[0] == "without it" and found.labels[found.chosen] == "T = 0.1 s"
    for size, curve in zip(found.sizes, found.curves, strict=True):
        np.testing.assert_allclose(curve, first_order(4.0, size or 0.0), atol=2e-5)


def test_the_sizes_of_a_gain_lie_about_1_where_it_is_none() -> None:
    found = size_curves(PLANT, [experiment("e")], diagnosis("gain", {"k": 1.4}, HERE))
    assert found is not None and [*found.sizes] == [None, *(pytest.approx(1.0 + 0.4 * s) for s in SHARES[1:])]
    half = found.curves[found.shares.index(0.5)]
    np.testing.assert_allclose(half, 1.2 * first_order(4.0, 0.0), atol=2e-5)


def test_a_limit_is_none_at_infinity() -> None:
    found = size_curves(PLANT, [experiment("e")], diagnosis("saturation", {"level": 0.8}, HERE))
    assert found is not None and [*found.sizes] == [None, *(pytest.approx(0.8 / s) for s in SHARES[1:])]
    np.testing.assert_allclose(found.curves[0], first_order(4.0, 0.0), atol=2e-5)
    ends = [curve[-1] for curve in found.curves]
    assert ends == sorted(ends, reverse=True) and ends[-1] < 0.5  # the lower the limit, the less comes through


def test_the_held_out_signal_whose_error_falls_most_in_noise_units_is_shown() -> None:
    gap = Gap(
        refitted={"fit": {"y": {"a": 9.0}}, "holdout": {"y": {"b": 0.5, "c": 0.6, "d": 0.9}}},
        augmented={"fit": {"y": {"a": 0.0}}, "holdout": {"y": {"b": 0.1, "c": 0.3, "d": None}}},
        noise_floor=FrozenMap({"y": 0.01}),
    )
    records = [experiment("a"), *(experiment(n, "holdout") for n in "bcd")]
    found = size_curves(PLANT, records, diagnosis("lag", {"T": 0.1}, gap))
    assert found is not None and (found.experiment, found.output) == ("b", "y")


def test_without_an_effect_or_a_recording_there_are_no_curves() -> None:
    assert size_curves(PLANT, [experiment("e")], Diagnosis("no-evidence")) is None
    assert size_curves(PLANT, [experiment("other")], diagnosis("lag", {"T": 0.1}, HERE)) is None
