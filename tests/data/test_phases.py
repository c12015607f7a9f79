"""Quantities from phases against phasor arithmetic."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident.data import Trajectory
from hvdc_ident.data.three_phase import PhaseFilter, phase_quantities
from hvdc_ident.errors import InputError

F = 50.0
V, I, PHI, START = 325.0, 10.0, 0.6, 0.4
MEAN = PhaseFilter("mean", 1 / F)


def record(f: float = F, negative: float = 0.0, rate: float = 10_000.0) -> Trajectory:
    t = np.arange(0.0, 0.2, 1 / rate)
    columns = []
    for amplitude, lag in ((V, 0.0), (I, PHI)):
        for k in range(3):
            angle = 2 * np.pi * f * t + START - lag
            positive = np.cos(angle - 2 * np.pi * k / 3)
            columns.append(amplitude * (positive + negative * np.cos(angle + 2 * np.pi * k / 3)))
    names = ("va", "vb", "vc", "ia", "ib", "ic")
    return Trajectory(t, np.column_stack(columns), names, ("kV",) * 3 + ("kA",) * 3)


def ask(rec: Trajectory, *names: str, smoothing: PhaseFilter = MEAN, f: float = F) -> Trajectory:
    return phase_quantities(rec, ["va", "vb", "vc"], ["ia", "ib", "ic"], names, frequency=f, smoothing=smoothing)


def test_a_balanced_set_gives_its_phasors() -> None:
    phasor_v, phasor_i = V / np.sqrt(2), I / np.sqrt(2) * np.exp(-1j * PHI)
    power = 3 * phasor_v * np.conj(phasor_i)
    found = ask(record(), "p", "q", "v", "v-rms", "i-rms", "id", "iq", "vd", "vq", "f", "v2", "i2")
    expected = [power.real, power.imag, V, V * np.sqrt(3) / np.sqrt(2), I / np.sqrt(2)]
    expected += [I * np.cos(PHI), -I * np.sin(PHI), V, 0.0, F, 0.0, 0.0]
    settled = found.values[found.time > 1.01 / F]
    np.testing.assert_allclose(settled, np.tile(expected, (len(settled), 1)), rtol=2e-4, atol=2e-4 * V)
    assert found.units[:4] == ("MW", "Mvar", "kV", "kV")
    assert found.unit("f") == "Hz"


def test_another_frequency_is_seen() -> None:
    found = ask(record(f=50.5), "f", "v", smoothing=PhaseFilter("none", 0.0))
    np.testing.assert_allclose(found["f"][10:-10], 50.5, atol=1e-3)
    np.testing.assert_allclose(found["v"], V, rtol=1e-12)


def test_unbalance_is_told_from_the_positive_sequence() -> None:
    found = ask(record(negative=0.1), "v", "v2", "i2")
    settled = found.values[found.time > 1.01 / F]
    np.testing.assert_allclose(settled, np.tile([V, 0.1 * V, 0.1 * I], (len(settled), 1)), rtol=5e-4)


def test_a_mean_answers_a_step_with_a_ramp_of_its_length() -> None:
    t = np.array([0.0, 0.1, 0.1, 0.11, 0.12, 0.2])
    step = np.array([0, 0, 1, 1, 1, 1], dtype=complex)
    np.testing.assert_allclose(PhaseFilter("mean", 0.02)(t, step).real, [0, 0, 0, 0.5, 1, 1], atol=1e-12)


def test_a_low_pass_answers_a_step_and_a_ramp_as_the_solution_says() -> None:
    t = np.array([0.0, 0.1, 0.1, 0.13, 0.2])
    step = np.array([0, 0, 1, 1, 1], dtype=complex)
    expected = np.where(t <= 0.1, 0, 1 - np.exp(-(t - 0.1) / 0.02))
    np.testing.assert_allclose(PhaseFilter("lowpass", 0.02)(t, step).real, expected, atol=1e-12)
    ramp = PhaseFilter("lowpass", 0.02)(t, t.astype(complex)).real
    np.testing.assert_allclose(ramp, t - 0.02 + 0.02 * np.exp(-t / 0.02), atol=1e-12)


@pytest.mark.parametrize(
    ("rec", "names", "says"),
    [
        (record(rate=400.0), ("p",), "too coarse"),
        (record(), ("power",), "did you mean|one of"),
    ],
)
def test_what_cannot_be_had_is_refused(rec: Trajectory, names: tuple[str, ...], says: str) -> None:
    with pytest.raises(InputError, match=says):
        ask(rec, *names)


def test_currents_are_asked_for_where_they_are_needed() -> None:
    with pytest.raises(InputError, match="needs the currents"):
        phase_quantities(record(), ["va", "vb", "vc"], None, ["p"], frequency=F, smoothing=MEAN)
