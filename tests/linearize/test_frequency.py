"""Frequency responses, zeros, loops and margins, against python-control and closed forms."""

import control
import matplotlib.pyplot as plt
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvdc_ident.effects import apply_effects
from hvdc_ident.errors import LinearizationError, UnknownNameError, WaveformError
from hvdc_ident.linearize import (
    FrequencyResponse,
    Port,
    find_operating_point,
    frequency_response,
    linearize,
    loop,
    margins,
    port_admittance,
    port_impedance,
    response_from_record,
    simulated_response,
    symbolic_transfer,
)
from hvdc_ident.linearize.delays import pade, response
from hvdc_ident.linearize.frequency import sensitivity, sigma
from hvdc_ident.linearize.zeros import zeros
from hvdc_ident.model import Model
from hvdc_ident.models import load_model
from tests.linearize.helpers import linear, stable

DELAY = [{"effect": "delay", "at": "Ir1", "parameters": {"T": 0.002}}]
W = np.logspace(-1, 3, 15)
LAG = Model(name="lag", inputs={"u": 0.0}, states={"x": "u - x"}, outputs={"y": "x"})


@pytest.fixture(scope="module")
def link():
    return load_model("vsc-hvdc-link")


@pytest.fixture(scope="module")
def model(link):
    return linearize(link)


def test_response_equals_python_control(model):
    want = model.to_control()(1j * W)
    np.testing.assert_allclose(np.moveaxis(model.bode(W).values, 0, -1), want, rtol=1e-9, atol=1e-12)
    assert model.to_control().state_labels == list(model.state_names)
    assert model.to_control().input_labels == list(model.input_names)


def test_singular_values(model):
    w, s = sigma(model, W)
    np.testing.assert_allclose(s[3], np.linalg.svd(model.response([w[3]])[0], compute_uv=False))


def test_bad_frequencies_are_refused(model):
    for bad in ([-1.0], [np.nan], []):
        with pytest.raises(LinearizationError):
            model.bode(bad)
    with pytest.raises(LinearizationError, match="on a pole"):
        linear([[0.0]], [[1.0]], [[1.0]]).bode([0.0])


# --- transfer functions and zeros ---


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("through", [False, True])
def test_zeros_make_the_system_matrix_singular(seed, through):
    m = stable(seed, n=6, m=2, o=2, through=through)
    found = zeros(*m.standard())
    assert found.size == (6 if through else 4)
    for z in found:
        pencil = np.block([[m.A - z * np.eye(6), m.B], [m.C, m.D]])
        values = np.linalg.svd(pencil, compute_uv=False)
        assert values[-1] < 1e-12 * values[0]


def test_every_transfer_function_of_the_link_is_its_response(model):
    s = 1j * np.array([0.3, 7.0, 150.0])
    for i in model.input_names:
        for o in model.output_names:
            f = model.transfer_function(i, o)
            want = model.channel(i, o).response(s.imag)[:, 0, 0]
            np.testing.assert_allclose(f(s), want, rtol=1e-6, atol=1e-9 * max(1.0, np.abs(want).max()))
            assert np.isfinite([f.gain]).all()


def test_a_channel_without_a_path_is_zero():
    f = linear([[-1.0]], [[1.0]], [[0.0]]).transfer_function()
    assert (f.gain, f.zeros.size, f.poles.size) == (0.0, 0, 0)


def test_stable_pairs_cancel_and_unstable_ones_stay():
    stable_pair = linear([[-1, 0], [0, -2]], [[1], [0]], [[1, 1]]).transfer_function()
    assert stable_pair.poles == pytest.approx([-1.0]) and len(stable_pair.cancelled) == 1
    unstable = linear([[-1, 0], [0, 2]], [[1], [0]], [[1, 1]]).transfer_function()
    assert sorted(unstable.poles.real) == pytest.approx([-1.0, 2.0])
    assert unstable.zeros == pytest.approx([2.0])


# --- delays ---


@pytest.mark.parametrize("order", range(1, 9))
def test_pade_is_all_pass_and_right_at_low_frequency(order):
    a, b, c, d = pade(order)
    w = np.array([0.01, 0.2, 1.0])
    got = np.array([c @ np.linalg.solve(1j * x * np.eye(order) - a, b) + d for x in w])
    np.testing.assert_allclose(np.abs(got), 1.0, rtol=1e-9)
    top, bottom = control.pade(1.0, order)
    want = np.polyval(top, 1j * w) / np.polyval(bottom, 1j * w)
    np.testing.assert_allclose(got, want, rtol=1e-8)


def test_pade_order_is_checked():
    with pytest.raises(LinearizationError):
        pade(0)


def test_delays_are_exact_in_frequency_and_pade_in_the_state_space(link):
    found = linearize(apply_effects(link, DELAY), inputs=["Vdcref1"], outputs=["Vdc1"])
    plain = linearize(link, inputs=["Vdcref1"], outputs=["Vdc1"])
    assert len(found.state_names) == 6 + 5
    # Close the loop around the delay by hand: open the plain link at Ir1 and put exp(-sT) in.
    opened = loop(link, "Ir1").open
    s = 1j * W
    e = np.exp(-0.002 * s)
    l0 = opened.response(W)[:, 0, 0]
    direct = plain.response(W)[:, 0, 0]
    # Vdc1 follows the delayed order: G = e (1 + L) / (1 + e L) times the plain closed loop.
    np.testing.assert_allclose(found.response(W)[:, 0, 0], direct * e * (1 + l0) / (1 + e * l0), rtol=1e-8)
    rational = found.to_control()(1j * W[:8])
    np.testing.assert_allclose(found.response(W[:8])[:, 0, 0], np.ravel(rational), rtol=1e-6)


def test_a_sampled_block_is_a_hold_and_its_compute_time():
    s = 1j * np.array([1e-9, 1.0, 100.0])
    want = (1 - np.exp(-0.01 * s[1:])) / (0.01 * s[1:]) * np.exp(-0.004 * s[1:])
    got = response("sampled", 0.01, 0.004, s)
    np.testing.assert_allclose(got[1:], want, rtol=1e-12)
    assert got[0] == pytest.approx(1.0)


# --- sensitivity and bands ---


@pytest.mark.parametrize("effects", [[], DELAY], ids=["plain", "delayed"])
def test_sensitivity_of_the_response_against_differences(link, effects):
    plant = apply_effects(link, effects)
    names = ["KPVDC", "KIVDC", "C1", *([n for n in plant.parameters if n.endswith("_T")])]
    found = linearize(plant, inputs=["Vdcref1"], outputs=["Irorder1"], sensitivities=names)
    slopes = sensitivity(found, W)
    for name in names:
        value = plant.parameters[name].value
        up, down = (
            linearize(plant.with_values({name: value * (1 + s)}), inputs=["Vdcref1"], outputs=["Irorder1"]).response(W)
            for s in (1e-5, -1e-5)
        )
        want = (up - down) / (2e-5 * value)
        assert np.abs(slopes[name] - want).max() < 1e-6 * np.abs(want).max()


def test_bands_against_monte_carlo(link):
    names = ["KPVDC", "KIVDC"]
    found = linearize(link, inputs=["Vdcref1"], outputs=["Vdc1"], sensitivities=names)
    covariance = np.array([[0.04, 0.3], [0.3, 9.0]])
    w = np.array([5.0, 30.0, 80.0])
    band = found.bode(w, covariance=covariance, parameters=names)
    rng = np.random.default_rng(5)
    draws = rng.multivariate_normal([0, 0], covariance, size=4000)
    slopes = sensitivity(found, w, names)
    errors = np.array([sum(slopes[n] * v for n, v in zip(names, d, strict=True)) for d in draws])
    np.testing.assert_allclose(band.std, np.sqrt((np.abs(errors) ** 2).mean(axis=0)), rtol=0.05)
    with pytest.raises(LinearizationError, match="covariance"):
        found.bode(w, covariance=np.eye(3), parameters=names)


def test_dc_impedance_and_admittance(link):
    """At 0 rad/s the voltage control holds Vdc1; far above, the capacitors alone: 1/(s C)."""
    port = Port(("Iload1",), ("Vdc1",), ("-Iload1",))
    assert Port("Iload1", "Vdc1", "-Iload1") == port
    z = port_impedance(link, port, [1e-4, 3e6])
    assert abs(z.values[0, 0, 0]) < 1e-5
    assert z.values[1, 0, 0] == pytest.approx(1 / (3e6j * 0.2), rel=0.02)
    y = port_admittance(link, port, [3e6])
    assert y.values[0, 0, 0] == pytest.approx(1 / z.values[1, 0, 0])
    with pytest.raises(LinearizationError, match="do not fit together"):
        Port(("Iload1",), ("Vdc1", "Vdc2"), ("Iload1",))


# --- loops and margins ---


@pytest.mark.parametrize("signal", ["Irorder1", "Ir1", "P2_m", "ev", "Vdc1", "xp"])
def test_closing_an_opened_loop_gives_the_closed_model_s_poles(link, model, signal):
    opened = loop(link, signal)
    np.testing.assert_allclose(
        np.sort_complex(opened.closed_poles()), np.sort_complex(model.poles()), rtol=1e-6, atol=1e-4
    )
    s, t = opened.sensitivity(W), opened.complementary(W)
    np.testing.assert_allclose(s.values + t.values, 1.0)


def test_no_loop_through_an_input(link):
    with pytest.raises(LinearizationError, match="no loop"):
        loop(link, "Pref2")
    with pytest.raises(UnknownNameError):
        loop(link, "nothing")


@settings(max_examples=25)
@given(st.integers(0, 10_000), st.floats(0.05, 5.0))
def test_margins_equal_python_control(seed, gain):
    rng = np.random.default_rng(seed)
    poles = -(10 ** rng.uniform(-1, 1, 4))
    top = gain * np.prod(-poles)
    a = np.diag(poles[:1])
    g = control.zpk([], poles, top)
    ss = control.ss(control.tf(g))
    found = margins(linear(ss.A, ss.B, ss.C, ss.D))
    gm, pm, sm, wpc, wgc, wms = control.stability_margins(g)
    if np.isfinite(gm) and gm > 1:
        assert found.gain_margin.value == pytest.approx(gm, rel=1e-6)
        assert found.gain_margin.omega == pytest.approx(wpc, rel=1e-6)
    if np.isfinite(pm) and gain > 1.01:
        nearest = min(found.phase, key=lambda c: abs(c.value))
        assert nearest.value == pytest.approx((pm + 180) % 360 - 180, rel=1e-5, abs=1e-5)
        assert nearest.omega == pytest.approx(wgc, rel=1e-6)
        assert found.phase_margin == nearest if found.stable else np.isnan(found.phase_margin.value)
    assert found.stable == bool(np.isfinite(gm) and gm > 1)
    if found.stable:
        assert found.modulus.value == pytest.approx(sm, rel=1e-5)
        assert found.modulus.omega == pytest.approx(wms, rel=1e-2)
    else:
        assert np.isnan(found.modulus.value)
    assert a.shape == (1, 1)


def test_disk_margin_equals_python_control():
    g = control.tf([1], [1, 2, 3, 4])
    alpha, gain_db, phase = control.disk_margins(g, np.logspace(0, 0.5, 200_001))
    ss = control.ss(g)
    found = margins(linear(ss.A, ss.B, ss.C, ss.D))
    assert found.disk.value == pytest.approx(float(alpha), rel=1e-6)
    assert 20 * np.log10(found.disk_gain) == pytest.approx(float(gain_db), rel=1e-5)
    assert found.disk_phase == pytest.approx(float(phase), rel=1e-5)


def test_delay_margin_of_an_integrator_with_a_delay():
    """L = 1/s: phase margin 90 degrees at 1 rad/s, so a delay of pi/2 s."""
    found = margins(linear([[-1e-9]], [[1.0]], [[1.0]]), np.logspace(-3, 3, 2001))
    assert found.phase_margin.value == pytest.approx(90.0, abs=1e-6)
    assert found.delay.value == pytest.approx(np.pi / 2, rel=1e-6)
    with pytest.raises(LinearizationError, match="one loop"):
        margins(stable(0))


def test_an_ill_posed_loop_is_refused():
    with pytest.raises(LinearizationError, match="ill-posed"):
        margins(linear([[-1.0]], [[0.0]], [[1.0]], [[-1.0]]))


# --- measured ---


def test_multisine_through_the_nonlinear_model(link):
    found = simulated_response(link, "Vdcref1", ["Vdc1", "Irorder1"], [5.0, 20.0, 60.0], 1e-5, rtol=1e-10)
    want = linearize(link, find_operating_point(link), inputs=["Vdcref1"], outputs=["Vdc1", "Irorder1"]).response(
        found.omega
    )
    np.testing.assert_allclose(found.values, want, rtol=2e-4)


def test_multisine_through_a_delay(link):
    plant = apply_effects(link, DELAY)
    found = simulated_response(plant, "Vdcref1", ["Vdc1"], [20.0, 60.0], 1e-5, rtol=1e-9)
    want = linearize(plant, inputs=["Vdcref1"], outputs=["Vdc1"]).response(found.omega)
    np.testing.assert_allclose(found.values, want, rtol=2e-3)


def test_response_from_a_recording_with_its_band():
    import scipy.signal

    rng = np.random.default_rng(0)
    t = np.arange(20000) * 1e-3
    u = rng.normal(size=t.size)
    y = scipy.signal.lfilter([0.1], [1, -0.9], u) + 0.02 * rng.normal(size=t.size)
    found = response_from_record(t, u, y, segments=20)
    want = 0.1 / (1 - 0.9 * np.exp(-1j * found.omega * 1e-3))
    z = np.abs(found.values[:, 0, 0] - want) / found.std[:, 0, 0]
    assert 0.5 < np.mean(z**2) / 2 < 2.0
    assert 0 <= found.coherence.min() <= found.coherence.max() <= 1
    with pytest.raises(WaveformError, match="never changes"):
        response_from_record(t, np.ones_like(t), y)
    with pytest.raises(WaveformError, match="too few"):
        response_from_record(t[:20], u[:20], y[:20])


# --- formulas ---


def test_the_voltage_loop_as_a_formula(link):
    found = symbolic_transfer(link, "Vdcref1", "Vdc1", ["KPVDC", "KIVDC"], together={"C1": "C", "C2": "C"})
    assert {s.name for s in found.expression.free_symbols} == {"s", "KPVDC", "KIVDC", "C"}
    for values in ({"KPVDC": 24.0, "KIVDC": 734.7, "C": 0.2}, {"KPVDC": 10.0, "KIVDC": 300.0, "C": 0.3}):
        other = link.with_values(
            {"KPVDC": values["KPVDC"], "KIVDC": values["KIVDC"], "C1": values["C"], "C2": values["C"]}
        )
        want = linearize(other, inputs=["Vdcref1"], outputs=["Vdc1"]).response([3.0])[0, 0, 0]
        assert found(3j, values) == pytest.approx(want, rel=1e-9)
    latex = found.latex()
    assert "s^{3}" in latex and "KIVDC" in latex and latex.startswith(r"\frac")
    with pytest.raises(LinearizationError, match="delays"):
        symbolic_transfer(apply_effects(link, DELAY), "Vdcref1", "Vdc1", ["KPVDC"])


# --- phases and frequencies to show ---


def test_default_frequencies_cover_the_poles(model):
    found = frequency_response(model)
    assert found.omega[0] == pytest.approx(3.0) and found.omega[-1] > 4.1e5
    assert found.to_xarray().dims == ("omega", "output", "input")


def test_default_frequencies_end_where_a_channel_shows_nothing_more(model):
    """The dc line's mode at 6.5 kHz is a thousandth of what the voltage control shows, and most of the line's current."""
    voltage = model.channel("Vdcref1", "Vdc1").bode().frequency_hz
    assert 0.4 < voltage[0] < 1.0 and 60.0 < voltage[-1] < 100.0
    assert model.channel("Vdcref1", "Idc").bode().frequency_hz[-1] > 6e4


def test_default_frequencies_of_models_without_poles_or_damping():
    static = linear(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[2.0]]).bode()
    np.testing.assert_array_equal(static.magnitude, 2.0)
    undamped = linear([[0, 1], [-4, 0]], [[0], [1]], [[1, 0]]).bode()
    assert undamped.omega[0] == pytest.approx(0.2) and np.isfinite(undamped.values).all()


@pytest.mark.parametrize("time", [1e-4, 2e-3, 0.5])
@pytest.mark.parametrize("points", [2, 7, 300])
def test_the_phase_of_a_lag_and_a_delay_on_coarse_grids(time, points):
    """-atan(w) - w T: up to 100 000 turns, of which a step passes hundreds."""
    late = linearize(
        apply_effects(LAG, [{"effect": "delay", "at": ["y"], "parameters": {"T": time}}]), inputs="u", outputs="y"
    )
    w = 2 * np.pi * np.geomspace(0.1, 2e5, points)
    found = late.bode(w)
    want = -np.degrees(np.arctan(w) + w * time)
    np.testing.assert_allclose(found.phase_deg[:, 0, 0], want, rtol=1e-9, atol=1e-6)
    again = FrequencyResponse.from_dict(found.to_dict())
    np.testing.assert_array_equal(again.phase_deg, found.phase_deg)
    shuffled = late.bode(w[::-1])
    np.testing.assert_allclose(shuffled.phase_deg[::-1, 0, 0], want, rtol=1e-9, atol=1e-6)
    drawn = found.plot()[1].lines[0].get_ydata()
    np.testing.assert_allclose(drawn, want, rtol=1e-9, atol=1e-6)
    plt.close("all")


def sections(zeros, poles):
    """Return the series of (s^2 - 2 Re z s + |z|^2)/(s^2 - 2 Re p s + |p|^2), one section after the other: a companion form would
    lose the digits of a response that is small beside its terms."""
    parts = [
        control.tf([1.0, -2.0 * z.real, abs(z) ** 2], [1.0, -2.0 * p.real, abs(p) ** 2])
        for z, p in zip(zeros, poles, strict=True)
    ]
    a, b, c, d = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.ones((1, 1))
    for g in map(control.ss, parts):
        a, b = np.block([[a, np.zeros((a.shape[0], 2))], [g.B @ c, g.A]]), np.concatenate([b, g.B @ d])
        c, d = np.concatenate([g.D @ c, g.C], axis=1), g.D @ d
    return linear(a, b, c, d)


def turned(roots, w):
    """Return (n,) degrees by which the factor (s - r)(s - r*) of each root turns from 0 to w, as arctangents and not from angles."""
    near, far = (w[:, None] - roots.imag) / -roots.real, (w[:, None] + roots.imag) / -roots.real
    return np.degrees((np.arctan(near) + np.arctan(far)).sum(axis=1))


def upper_roots(rng, sizes, sides):
    """Return roots above the real axis damped by 0.1 to 30 %. sides: 1 left of the imaginary axis, -1 right of it."""
    damping = 10 ** rng.uniform(-3, -0.5, sizes.size)
    return sizes * (-damping * sides + 1j * np.sqrt(1 - damping**2))


@settings(max_examples=30, derandomize=True)
@given(st.integers(0, 1_000_000))
def test_phases_on_coarse_grids_are_those_of_poles_and_zeros(seed):
    """Three pairs of zeros, on either side of the axis, and as many of poles, at 6 frequencies over six decades.

    Each pair of zeros has a pair of poles within half a decade: between zeros far below all poles a response is lost in the
    rounding errors of its terms, and no phase is known.
    """
    rng = np.random.default_rng(seed)
    sizes = 10 ** rng.uniform(-1, 3, 3)
    zeros_ = upper_roots(rng, sizes, rng.choice([-1.0, 1.0], 3))
    poles = upper_roots(rng, sizes * 10 ** rng.uniform(-0.5, 0.5, 3), np.ones(3))
    w = np.geomspace(1e-2, 1e4, 6)
    found = sections(zeros_, poles).bode(w).phase_deg[:, 0, 0]
    want = turned(zeros_, w) - turned(poles, w)
    np.testing.assert_allclose(found - found[0], want - want[0], atol=1e-3)


@pytest.mark.parametrize("apart", [3.2, 9.42, 15.7])
def test_two_roots_whose_slopes_explain_one_another_are_not_taken_for_turns(apart):
    """Halfway between, the slope of each pair at the other one's frequency would give the phase a turn more or less."""
    poles = np.array([-1.0 + 1000.0j, -1.0 + (1000.0 + apart) * 1j])
    zeros_ = np.array([-3e4 + 1j, -3e4 + 1j])
    w = np.array([1.0, 1e4])
    found = sections(zeros_, poles).bode(w).phase_deg[:, 0, 0]
    assert np.diff(found) == pytest.approx(np.diff(turned(zeros_, w) - turned(poles, w)), abs=1e-6)
    flipped = sections(poles, zeros_).bode(w).phase_deg[:, 0, 0]
    np.testing.assert_allclose(np.diff(flipped), -np.diff(found), atol=1e-6)


@pytest.mark.parametrize("gain", [0.3, 0.9, -0.95, 1.7])
def test_the_phase_of_a_loop_around_a_delay_on_coarse_grids(gain):
    """1/(1 + k e^(-s)) turns beside each of the 64 roots that lie in the band; in far finer steps by less than 0.5 rad."""
    plant = Model(
        name="ring", parameters={"T": {"value": 1.0, "unit": "s"}, "k": gain}, inputs={"u": 0.0}, states={"x": "u - k*v - x"},
        delays={"v": {"of": "u - k*v", "time": "T"}}, outputs={"e": "u - k*v"},
    )  # fmt: skip
    ring = linearize(plant, find_operating_point(plant), inputs="u", outputs="e")
    fine = np.linspace(0.05, 400.0, 400_001)
    angle = np.angle(1.0 / (1.0 + gain * np.exp(-1j * fine)))
    assert np.abs((np.diff(angle) + np.pi) % (2 * np.pi) - np.pi).max() < 0.5
    coarse = [0, 1_000, 33_333, 200_000, 400_000]
    np.testing.assert_allclose(
        ring.bode(fine[coarse]).phase_deg[:, 0, 0], np.degrees(np.unwrap(angle))[coarse], atol=1e-6
    )


def test_a_phase_below_rounding_errors_is_not_searched_for():
    """Channels of 49 states and a delay that are 1e-16 of others: five frequencies over ten decades ask for some hundred points."""
    plant = load_model("vsc-hvdc-avm")
    found = linearize(plant, inputs=["Qref2", "E2"], outputs=["Ii1", "Ii2"]).bode(np.geomspace(1e-3, 1e7, 5))
    assert np.isfinite(found.phase_deg).all() and found.magnitude.min() < 1e-15 < 1e-3 < found.magnitude.max()
    told = found.magnitude > 1e-6
    turned = found.values[told] * np.exp(-1j * np.radians(found.phase_deg[told]))
    np.testing.assert_allclose(turned, found.magnitude[told], rtol=1e-6)


def test_dc_gains_beside_integrators():
    """1/(s + 1) beside an integrator of another input, and an integrator that is washed out; 1/s and 2/(s + 1)."""
    beside = linear([[-1, 0], [0, 0]], np.eye(2), np.eye(2))
    assert beside.transfer_function("u0", "y0").dc_gain == pytest.approx(1.0)
    assert beside.transfer_function("u1", "y1").dc_gain == np.inf
    assert beside.transfer_function("u0", "y1").dc_gain == 0.0
    washed = linear([[0, 0], [1, -1]], [[1], [0]], [[1, -1]]).transfer_function()
    assert washed.dc_gain == pytest.approx(1.0)
    assert linear([[-1]], [[2]], [[1]]).transfer_function().dc_gain == pytest.approx(2.0)
    late = linearize(apply_effects(LAG, [{"effect": "delay", "at": ["y"], "parameters": {"T": 0.2}}]))
    assert late.transfer_function().dc_gain == pytest.approx(1.0)
