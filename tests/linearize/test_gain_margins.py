"""Upper and lower gain margins, phase and delay margins: against eigenvalues of closed loops, published values and closed forms."""

import control
import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.linearize import loop_margins, margins
from tests.linearize.helpers import linear


def rational(top, bottom):
    system = control.ss(control.tf(top, bottom))
    return linear(system.A, system.B, system.C, system.D)


def stable_at(model, factor):
    """Whether the closed loop is stable, by its eigenvalues."""
    a, b, c, d = model.A, model.B, model.C, model.D
    return bool((np.linalg.eigvals(a - factor * b @ c / (1 + factor * d[0, 0])).real < 0).all())


def check_by_eigenvalues(model, found):
    """Stable from one limit to the other, and not stable beyond."""
    low, high = found.lower_gain_margin.value, found.gain_margin.value
    inside = np.geomspace(max(low, 1e-4) * (1 + 1e-6), min(high, 1e4) * (1 - 1e-6), 400)
    assert all(stable_at(model, k) for k in inside)
    if np.isfinite(high):
        assert not stable_at(model, high * (1 + 1e-6))
    if low > 0:
        assert not stable_at(model, low * (1 - 1e-6))


def test_a_loop_that_must_not_be_weakened():
    """(s^2 + 0.5 s + 0.05)/s^3, python-control issue 947."""
    found = margins(rational([1, 0.5, 0.05], [1, 0, 0, 0]))
    assert found.lower_gain_margin.value == pytest.approx(0.1, rel=1e-9)
    assert found.lower_gain_margin.omega == pytest.approx(np.sqrt(0.05), rel=1e-9)
    assert found.gain_margin.value == np.inf and found.stable
    assert "not below 0.1 at 0.03559 Hz" in str(found)
    data = found.to_dict()
    assert data["lower_gain_margin"]["value"] == pytest.approx(0.1) and data["gain_margin"]["value"] is None


@pytest.mark.parametrize(
    ("top", "bottom", "lower", "upper"),
    [
        ([3], [1, -1.5], (0.5, 0.0), (np.inf, np.inf)),  # -1 crossed at 0 rad/s
        ([-0.5, 1], [1, 2], (0.0, np.inf), (2.0, np.inf)),  # and at infinity: (1 - 0.5 k) s + 2 + k
        ([0.2, 4], [-1, 1], (0.25, 0.0), (5.0, np.inf)),  # (0.2 k - 1) s + 1 + 4 k, of which both change sign
        ([25], [1, 10, 10, 10], (0.0, np.inf), (3.6, np.sqrt(10))),  # Routh
        ([20, 40, 20], [1, 0.4, 0.04, 0], None, None),  # conditionally stable
    ],
)
def test_limits_at_zero_and_at_infinity(top, bottom, lower, upper):
    model = rational(top, bottom)
    found = margins(model)
    if not found.stable:  # (0.2 k - 1) s is unstable at k = 1
        assert not stable_at(model, 1.0) and np.isnan(found.gain_margin.value)
        return
    if lower is not None:
        assert (found.lower_gain_margin.value, found.lower_gain_margin.omega) == pytest.approx(lower, rel=1e-9)
        assert (found.gain_margin.value, found.gain_margin.omega) == pytest.approx(upper, rel=1e-9)
    check_by_eigenvalues(model, found)


@pytest.mark.parametrize("seed", range(40))
def test_random_loops_against_eigenvalues(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 5))
    for _ in range(200):
        a, b, c = rng.normal(size=(n, n)), rng.normal(size=(n, 1)), rng.normal(size=(1, n)) * 10 ** rng.uniform(-1, 1)
        model = linear(a, b, c, rng.normal(size=(1, 1)) if seed % 2 else None)
        if stable_at(model, 1.0):
            break
    found = margins(model)
    assert found.stable
    check_by_eigenvalues(model, found)


def test_a_crossover_far_above_the_poles_is_found():
    """1000/(s + 1): |L| = 1 at sqrt(10^6 - 1) rad/s."""
    found = margins(rational([1000], [1, 1]))
    w = np.sqrt(1e6 - 1)
    assert found.phase_margin.omega == pytest.approx(w, rel=1e-9)
    assert found.phase_margin.value == pytest.approx(180 - np.degrees(np.arctan(w)), rel=1e-9)
    assert found.delay.value == pytest.approx((np.pi - np.arctan(w)) / w, rel=1e-9)


def test_a_gain_of_1_at_high_frequency_stands_no_delay():
    """(2 s^2 + s + 0.3)/(s^2 + 0.1 s - 0.2) is closed stable, and |L| tends to 2: any delay makes infinitely many roots grow."""
    assert margins(rational([2, 1, 0.3], [1, 0.1, -0.2])).delay.value == 0.0


def test_an_unstable_loop_has_no_margins():
    found = margins(rational([20], [1, 2, 3, 4]))  # Routh: 2 x 3 < 4 + 20
    assert found.stable is False and found.stability.unstable == 2
    assert str(found) == "the closed loop is not stable (2 roots right of the imaginary axis): there are no margins"
    data = found.to_dict()
    numbers = [v for name, m in data.items() if "margin" in name for v in m.values()]
    assert len(numbers) == 14 and set(numbers) == {None} and data["stable"] is False


# --- delays ---


def late(signals, states, time, parameters=None):
    return hi.Model(
        name="late",
        parameters={"T": {"value": time, "unit": "s"}, **(parameters or {})},
        inputs={"r": 0.0},
        states=states,
        signals={"e": "r - back", **signals},
        delays={"back": {"of": "y", "time": "T"}},
        outputs={"y": "y"},
    )


@pytest.mark.parametrize(("k", "time"), [(1.0, 1.0), (0.2, 3.0), (40.0, 0.01)])
def test_a_late_integrator(k, time):
    """k exp(-s T)/s: gain up to pi/2/(k T), phase 90 degrees less k T, delay pi/2/k less T."""
    found = margins(hi.linear.loop(late({"y": "x"}, {"x": f"{k}*e"}, time), "e"))
    assert found.gain_margin.value == pytest.approx(np.pi / 2 / (k * time), rel=1e-9)
    assert found.gain_margin.omega == pytest.approx(np.pi / 2 / time, rel=1e-9)
    assert found.lower_gain_margin.value == 0.0
    assert found.phase_margin.value == pytest.approx(90 - np.degrees(k * time), rel=1e-9)
    assert found.delay.value == pytest.approx(np.pi / 2 / k - time, rel=1e-9)


def test_a_late_unstable_plant():
    """1.5 exp(-0.3 s)/(s - 1): closed for k between 1 (at 0 rad/s) and w sin(0.3 w) + cos(0.3 w) with w = tan(0.3 w)."""
    found = margins(hi.linear.loop(late({"y": "x"}, {"x": "x + 1.5*e"}, 0.3), "e"))
    assert found.lower_gain_margin.value == pytest.approx(1 / 1.5, rel=1e-9) and found.lower_gain_margin.omega == 0.0
    w = 4.0
    for _ in range(50):
        w = w - (w - np.tan(0.3 * w)) / (1 - 0.3 / np.cos(0.3 * w) ** 2)
    assert found.gain_margin.omega == pytest.approx(w, rel=1e-9)
    assert found.gain_margin.value == pytest.approx((w * np.sin(0.3 * w) + np.cos(0.3 * w)) / 1.5, rel=1e-9)


def test_a_late_gain():
    """0.4 exp(-s T): the ring has a gain below 1 up to a factor of 2.5, at frequencies without end."""
    found = margins(hi.linear.loop(late({"y": "0.4*e + 0*x"}, {"x": "r - x"}, 0.2), "e"))
    assert found.stable and found.gain_margin.value == pytest.approx(2.5, rel=1e-9)
    assert found.lower_gain_margin.value == 0.0


def test_a_late_gain_of_1_is_not_judged():
    found = margins(hi.linear.loop(late({"y": "1.0*e + 0*x"}, {"x": "r - x"}, 0.2), "e"))
    assert found.stable is None and np.isnan(found.gain_margin.value)
    assert "cannot be told" in str(found)


def test_loops_of_one_plant_have_their_lower_limits():
    """Two integrators with unstable plants side by side: each loop is stable from a half and from a third of its gain on."""
    a = np.diag([1.0, 1.0])
    found = loop_margins(linear(a, np.diag([2.0, 3.0]), np.eye(2)))
    lower = [m.lower_gain_margin.value for m in found.each.values()]
    assert lower == pytest.approx([1 / 2, 1 / 3], rel=1e-9) and found.stable


@pytest.mark.parametrize(("time", "stable"), [(1.8, True), (2.2, False)])
def test_margins_stand_on_the_exact_stability(time, stable):
    """A Pade approximant of order 5 says the opposite in both cases: see `test_delay_stability`."""
    model = late({"y": "0.02*v"}, {"x": "v", "v": "49*(e - x) - 0.14*v"}, time)
    found = margins(hi.linear.loop(model, "e"))
    assert found.stable == stable == hi.find_operating_point(model).stable
    assert np.isfinite(found.gain_margin.value) == np.isfinite(found.phase_margin.value) == stable
    if stable:
        assert found.gain_margin.value > 1.0
        for factor, inside in ((1 - 1e-6, True), (1 + 1e-6, False)):
            gain = 0.02 * found.gain_margin.value * factor
            other = late({"y": f"{gain!r}*v"}, {"x": "v", "v": "49*(e - x) - 0.14*v"}, time)
            assert (hi.linearize(other).stability().verdict == "stable") == inside


@pytest.mark.parametrize("compute", [0.0, 0.4, 1.0, 1.3])
def test_a_sampled_integrator(compute):
    """With a period of 1 s and a compute time q + r: z^(q + 1) (z - 1) + k ((1 - r) z + r) = 0."""
    model = hi.Model(
        name="sampled",
        inputs={"r": 0.0},
        states={"x": "0.3*e"},
        signals={"e": "r - h"},
        sampled={"h": {"value": "x", "period": "1.0", "compute": str(compute)}},
        outputs={"x": "x"},
    )
    found = margins(hi.linear.loop(model, "e"))
    k, q, r = 0.3 * found.gain_margin.value, int(compute), compute - int(compute)

    def largest(k):
        return np.abs(np.roots(np.polyadd([1.0, -1.0] + [0.0] * (q + 1), [k * (1 - r), k * r]))).max()

    assert largest(k * (1 - 1e-6)) < 1 < largest(k * (1 + 1e-6))
