"""Measured frequency responses as files write them, and from records at the perturbation's frequencies."""

import numpy as np
import pytest
import scipy.signal

from hvdc_ident.errors import WaveformError
from hvdc_ident.linearize import read_response, response_at_tones

W = np.array([1.0, 2.0, 5.0]) * 2 * np.pi
Z = np.array([1.2 - 0.3j, 0.5 + 2.0j, -1.0 + 0.1j])


def rows(*columns):
    return "\n".join(",".join(str(c) for c in row) for row in zip(*columns, strict=True)) + "\n"


F = (1.0, 2.0, 5.0)
RE, IM = Z.real.tolist(), Z.imag.tolist()
DB, DEG, RAD = (20 * np.log10(abs(Z))).tolist(), np.degrees(np.angle(Z)).tolist(), np.angle(Z).tolist()
TEXTS = {
    "complex": "frequency,Z\n" + rows(F, ["1.2-0.3j", "0.5 + 2.0i", "(-1+0.1j)"]),
    "j in front": "f,Z\n" + rows(F, ["1.2-j0.3", "0.5+j2.0", "-1+j0.1"]),
    "parts": "f_Hz,Z_re,Z_im\n" + rows(F, RE, IM),
    "parts in brackets": "Frequency [Hz],re(Z),im(Z)\n" + rows(F, RE, IM),
    "decibels": "f,Z [dB],Z [deg]\n" + rows(F, DB, DEG),
    "modulus": "f,|Z|,phase Z (rad)\n" + rows(F, abs(Z).tolist(), RAD),
    "kilohertz": "f [kHz],Z real,Z imag\n" + rows([v / 1000 for v in F], RE, IM),
    "rad/s": "omega,re Z,im Z\n" + rows(W.tolist(), RE, IM),
    "comments, order": "# swept\n% by hand\nf,ReZ,ImZ\n" + rows(F[::-1], RE[::-1], IM[::-1]),
}


@pytest.mark.parametrize("name", TEXTS)
def test_columns_of_text(tmp_path, name):
    path = tmp_path / "z.csv"
    path.write_text(TEXTS[name], encoding="utf-8")
    found = read_response(path)
    np.testing.assert_allclose(found.omega, W, rtol=1e-12)
    assert list(found.channels) == ["Z"]
    np.testing.assert_allclose(found.channels["Z"], Z, rtol=1e-12, atol=1e-12)


def test_german_columns(tmp_path):
    path = tmp_path / "z.csv"
    path.write_text("f [Hz];Zdd_re;Zdd_im\n1,0;1,25;-0,5\n2,0;1e-3;2,5\n")
    np.testing.assert_allclose(read_response(path).channels["Zdd"], [1.25 - 0.5j, 1e-3 + 2.5j])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("f,Z\n1,2.0\n2,3.0\n", "complex numbers"),
        ("f,Z_re\n1,2.0\n", "complex numbers"),
        ("f,Z\n1,abc\n", "no number"),
        ("f,Z\n1,nan+1j\n", "no number"),
        ("t,Z_re,Z_im\n1,2,3\n", "no column of frequencies"),
        ("1,2,3\n2,3,4\n", "no titles"),
        ("f,Z\n", "no rows"),
        ("f,Z\n1,1+1j\n2\n", "another length"),
        ("f,Z,Z\n1,1+1j,1+1j\n", "one meaning"),
        ("f,Z\n-1,1+1j\n2,1+1j\n", "at least 0"),
    ],
)
def test_what_is_no_response_is_said(tmp_path, text, words):
    path = tmp_path / "z.csv"
    path.write_text(text)
    with pytest.raises(WaveformError, match=words):
        read_response(path)


def test_repeated_sweeps_tell_the_noise(tmp_path):
    rng = np.random.default_rng(1)
    f = np.geomspace(1, 100, 30)
    z = 1 / (1 + 0.05j * f)
    sweeps = [z * (1 + 0.02 * (rng.normal(size=30) + 1j * rng.normal(size=30)) / np.sqrt(2)) for _ in range(3)]
    text = "f,Z_re,Z_im\n" + "".join(rows(f.tolist(), s.real.tolist(), s.imag.tolist()) for s in sweeps)
    path = tmp_path / "z.csv"
    path.write_text(text)
    found = read_response(path)
    assert found.repeats == 3 and found.dof["Z"] == 2 * 2 * 30
    np.testing.assert_allclose(found.channels["Z"], np.mean(sweeps, axis=0), rtol=1e-12)
    np.testing.assert_allclose(found.std["Z"] / np.abs(z) * np.sqrt(3), 0.02, rtol=0.25)


def test_from_many_sweeps_on_each_frequency_has_its_own_standard_deviation(tmp_path):
    rng = np.random.default_rng(2)
    f = np.geomspace(1, 100, 5)
    size = 0.01 * np.arange(1, 6)  # noise that differs from frequency to frequency
    sweeps = np.array([1.0 + size * (rng.normal(size=5) + 1j * rng.normal(size=5)) for _ in range(12)])
    path = tmp_path / "z.csv"
    path.write_text("f,Z_re,Z_im\n" + "".join(rows(f.tolist(), s.real.tolist(), s.imag.tolist()) for s in sweeps))
    found = read_response(path)
    spread = np.sqrt(np.var(sweeps.real, axis=0, ddof=1) + np.var(sweeps.imag, axis=0, ddof=1))
    np.testing.assert_allclose(found.std["Z"], spread / np.sqrt(12), rtol=1e-9)


@pytest.mark.parametrize("form", ["RI", "MA", "DB"])
def test_touchstone_of_one_port_by_the_definition_of_s(tmp_path, form):
    """S = (Z - R)/(Z + R)."""
    s = (Z - 75.0) / (Z + 75.0)
    pair = {
        "RI": (s.real, s.imag),
        "MA": (abs(s), np.degrees(np.angle(s))),
        "DB": (20 * np.log10(abs(s)), np.degrees(np.angle(s))),
    }[form]
    path = tmp_path / "z.s1p"
    path.write_text(f"! a load\n# kHz S {form} R 75\n" + rows((W / 2e3 / np.pi).tolist(), *pair).replace(",", " "))
    found = read_response(path)
    np.testing.assert_allclose(found.omega, W, rtol=1e-12)
    np.testing.assert_allclose(found.channels["Z11"], Z, rtol=1e-9)


def test_touchstone_of_two_ports_and_its_order(tmp_path):
    """Z parameters are normalised, and 21 stands before 12; S of a series coil by its definition."""
    path = tmp_path / "z.s2p"
    path.write_text("# Hz Z RI R 50\n1.0 11 0 21 0 12 0 22 0 ! all of it\n")
    found = read_response(path).channels
    assert [found[n][0] for n in ("Z11", "Z12", "Z21", "Z22")] == [550, 600, 1050, 1100]
    z = np.array([[3.0 + 1j, 0.5], [0.7, 2.0 - 1j]])
    s = (z - np.eye(2)) @ np.linalg.inv(z + np.eye(2))
    cells = " ".join(f"{v.real} {v.imag}" for v in (s[0, 0], s[1, 0], s[0, 1], s[1, 1]))
    path.write_text(f"# Hz S RI R 1\n1.0 {cells}\n")
    found = read_response(path).channels
    np.testing.assert_allclose([[found[f"Z{i}{j}"][0] for j in (1, 2)] for i in (1, 2)], z, rtol=1e-12)
    path.write_text("# Hz S RI R 1\n1.0 2 3\n")
    with pytest.raises(WaveformError, match="9 numbers"):
        read_response(path)


def test_a_record_at_the_frequencies_of_its_perturbation():
    """Three tones through a known filter by scipy, with white noise on the output."""
    rng = np.random.default_rng(0)
    t = np.arange(0, 4, 1e-3)
    w = 2 * np.pi * np.array([1.0, 3.0, 10.5])
    u = 2.0 + sum(np.sin(k * t + k) for k in w)
    plant = scipy.signal.lti([20.0], [1.0, 20.0])
    y = scipy.signal.lsim(plant, u, t, X0=None)[1]
    t, u, y = t[2000:], u[2000:], y[2000:] + 0.01 * rng.normal(size=2000)
    found = response_at_tones(t, u, y, w)
    z = np.abs(found.values[:, 0, 0] - 20 / (20 + 1j * w)) / found.std[:, 0, 0]
    assert (z < 4).all() and (found.std < 2e-3).all()
    with pytest.raises(WaveformError, match="does not move"):
        response_at_tones(t, u, y, 2 * np.pi * np.array([1.0, 5.0]))
    with pytest.raises(WaveformError, match="too short"):
        response_at_tones(t, u, y, 2 * np.pi * np.array([1.0, 1.2]))
