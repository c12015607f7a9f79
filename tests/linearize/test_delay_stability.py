"""Stability of models with delays, against closed forms, the Lambert function and simulations."""

import numpy as np
import pytest
from scipy.special import lambertw

import hvdc_ident as hi
from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize.delays import Channel
from hvdc_ident.linearize.frequency import sensitivity
from hvdc_ident.linearize.stability import Characteristic, stability


def channel(time, kind="delay", compute=0.0):
    return Channel("d", kind, time, compute, (0,), np.ones(1))


def equation(matrix, states, *channels):
    m = np.array(matrix, dtype=float)
    return Characteristic(m, states, channels, np.zeros((len(m), 0)), np.zeros((0, len(m))), np.zeros((0, 0)))


def scalar(a, b, time):
    """x' = a x + b x(t - T)."""
    return equation([[a, b], [1, 0]], 1, channel(time))


def integrator(k, time):
    """x' = k (r - x(t - T)): stable where k T < pi/2."""
    return hi.Model(
        name="late-integrator",
        parameters={"k": {"value": k}, "T": {"value": time, "unit": "s"}},
        inputs={"r": 0.0},
        states={"x": "k*e"},
        signals={"e": "r - late"},
        delays={"late": {"of": "x", "time": "T"}},
        outputs={"x": "x"},
    )


def resonance(gain, time, zeta=0.01):
    """An oscillator of 7 rad/s with little damping, its velocity fed back late."""
    return hi.Model(
        name="late-resonance",
        parameters={"gain": {"value": gain}, "T": {"value": time, "unit": "s"}, "zeta": {"value": zeta}},
        inputs={"r": 0.0},
        states={"x": "v", "v": "49*(e - x) - 14*zeta*v"},
        signals={"e": "r - gain*late"},
        delays={"late": {"of": "v", "time": "T"}},
        outputs={"x": "x"},
    )


def lambert(a, b, time, branches=400):
    k = np.arange(-branches, branches + 1)
    return a + lambertw(b * time * np.exp(-a * time), k) / time


@pytest.mark.parametrize(
    ("a", "b", "time"),
    [(0, -1, 1.5), (0, -1, 1.6), (0, -1, 20.0), (-1, -2, 1.0), (-1, -2, 2.0), (0.5, -1, 0.3), (-3, 2.9, 5), (-3, 3.1, 5),
     (2, -1, 0.1), (-40, 41, 7), (-40, -44, 3), (-0.1, -60, 0.4)],
)  # fmt: skip
def test_roots_and_their_number_are_those_of_the_lambert_function(a, b, time):
    want = lambert(a, b, time)
    found = scalar(a, b, time).roots
    assert found.certain and found.axis == 0
    assert found.unstable == (want.real > 0).sum()
    first = want[np.argmax(want.real)]
    assert found.values[0] == pytest.approx(complex(first.real, abs(first.imag)), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("share", [0.9, 0.999, 0.999999, 1.000001, 1.001, 1.1, 4.999, 5.001])
def test_a_late_integrator_is_stable_up_to_a_quarter_turn(share):
    """Further pairs cross at k T = pi/2 + 2 pi n."""
    found = stability(scalar(0.0, -share * np.pi / 2, 1.0))
    assert found.verdict == ("stable" if share < 1 else "unstable")
    assert found.unstable == (0 if share < 1 else 2 if share < 5 else 4)


def test_roots_on_the_axis_are_told():
    found = stability(scalar(0.0, -np.pi / 2, 1.0))
    assert (found.verdict, found.unstable) == ("on the limit of stability", 0)
    assert found.rightmost == pytest.approx(0.5j * np.pi, abs=1e-12)


def test_a_double_root_is_found():
    """k T = 1/e: -1/T twice."""
    found = stability(scalar(0.0, -np.exp(-1.0), 1.0))
    assert found.verdict == "stable" and found.rightmost == pytest.approx(-1.0, abs=1e-6)


def test_a_slow_delay_on_a_fast_loop_is_counted():
    """s = -a - b exp(-s T) with a = 10^4/s and T = 1 s: stable where |b| < a; beyond, 2 sqrt(b^2 - a^2) T/2 pi roots grow."""
    assert scalar(-1e4, -9.9e3, 1.0).roots.unstable == 0
    grown = scalar(-1e3, -1.1e3, 1.0).roots.unstable
    assert grown == pytest.approx(np.sqrt(1.1e3**2 - 1e3**2) / np.pi, abs=2)


def roots_that_crossed(gain, time, zeta=0.01, w0=7.0):
    """Roots right of the axis of s^2 + 2 zeta w0 s + w0^2 (1 + gain s exp(-s T)), by D-subdivision (Cooke, van den Driessche 1986).

    At T = 0 there are none. With T a pair crosses at each of the two frequencies with |s^2 + 2 zeta w0 s + w0^2| = w0^2 gain w:
    to the right at the upper one, back at the lower one.
    """
    b = (2 * zeta * w0) ** 2 - 2 * w0**2 - (w0**2 * gain) ** 2
    squares = np.roots([1.0, b, w0**4])
    if np.iscomplex(squares).any():
        return 0
    low, high = np.sqrt(np.sort(squares.real))
    count = 0
    for w, side in ((high, 1), (low, -1)):
        s = 1j * w
        turn = -np.angle(-(s * s + 2 * zeta * w0 * s + w0**2) / (w0**2 * gain * s)) % (2 * np.pi)
        count += side * 2 * len(np.arange(turn / w, time, 2 * np.pi / w))
    return count


@pytest.mark.parametrize("gain", [0.002, 0.005, 0.02, 0.05])
def test_a_resonance_with_a_late_feedback_against_d_subdivision(gain):
    seen = set()
    for time in np.arange(0.05, 5.0, 0.45):
        zeta, w = 0.01, 7.0
        matrix = [[0, 1, 0], [-(w**2), -2 * zeta * w, -(w**2) * gain], [0, 1, 0]]
        found = equation(matrix, 2, channel(time)).roots.unstable
        assert found == roots_that_crossed(gain, time), time
        seen.add(found > 0)
    assert seen == ({False} if gain < 0.003 else {False, True})


@pytest.mark.parametrize(
    ("gain", "time", "pade"),
    [(0.02, 2.2, "stable"), (0.05, 3.0, "stable"), (0.02, 1.8, "unstable"), (0.01, 1.6, "unstable")],
)
def test_the_simulation_grows_where_a_root_does_and_a_pade_approximant_errs(gain, time, pade):
    model = resonance(gain, time)
    linear = hi.linearize(model, inputs="r", outputs="x")
    assert (np.linalg.eigvals(linear.A).real.max() < 0) == (pade == "stable")
    found = linear.stability()
    t = np.linspace(0.0, 80.0, 8001)
    x = hi.simulate(model, t, inputs={"r": hi.step(0.0, 1.0, at=0.5)})["x"]
    sizes = [np.ptp(x[(t > a) & (t < a + 10)]) for a in (40.0, 70.0)]
    rate = np.log(sizes[1] / sizes[0]) / 30.0
    assert found.verdict == ("unstable" if rate > 0 else "stable") != pade
    assert found.rightmost.real == pytest.approx(rate, rel=0.2)
    assert hi.find_operating_point(model).stable == (found.verdict == "stable")
    modes = linear.modes()
    assert modes[0].eigenvalue == found.rightmost and (modes[0].kind == "growing oscillation") == (rate > 0)


def test_a_fast_mode_before_a_long_delay_is_its_own_state_s():
    chain = hi.Model(
        name="fast-before-late",
        parameters={
            "T1": {"value": 2e-5, "unit": "s"},
            "T2": {"value": 0.5, "unit": "s"},
            "Td": {"value": 0.05, "unit": "s"},
        },
        inputs={"u": 0.0},
        states={"x": "(u - x)/T1", "y": "(late - y)/T2"},
        delays={"late": {"of": "x", "time": "Td"}},
        outputs={"y": "y"},
    )
    modes = {round(m.eigenvalue.real, 6): m for m in hi.linearize(chain, sensitivities=["T1", "T2", "Td"]).modes()}
    for name, time, own in (("T1", 2e-5, "x"), ("T2", 0.5, "y")):
        mode = modes[round(-1 / time, 6)]
        assert mode.participation[own] == pytest.approx(1.0)
        assert mode.sensitivity[name] == pytest.approx(1 / time**2)
        assert sum(map(abs, mode.sensitivity.values())) == pytest.approx(1 / time**2)


def test_modes_of_a_delay_against_differences():
    names = ["gain", "T", "zeta"]
    model = resonance(0.02, 1.3)
    linear = hi.linearize(model, inputs="r", outputs="x", sensitivities=names)
    for mode in linear.modes():
        assert set(mode.participation) == {"x", "v", "late"}
        assert sum(mode.participation.values()) == pytest.approx(1.0)
        s, shape = mode.eigenvalue, mode.shape
        assert shape["v"] == pytest.approx(s * shape["x"])
        assert shape["late"] == pytest.approx(np.exp(-1.3 * s) * shape["v"])
        for name in names:
            value = model.parameters[name].value
            up, down = (
                hi.linearize(model.with_values({name: value * (1 + h)}), inputs="r", outputs="x").poles()
                for h in (1e-5, -1e-5)
            )
            a, b = (v[np.argmin(abs(v - s))] for v in (up, down))
            assert mode.sensitivity[name] == pytest.approx((a - b) / (2e-5 * value), rel=1e-6)


# --- gains around a delay without a state on the way ---


@pytest.mark.parametrize(
    ("gain", "verdict"),
    [(0.5, "stable"), (-0.99, "stable"), (1.0, "not decided"), (-1.0, "not decided"), (1.2, "unstable")],
)
def test_a_ring_of_a_delay_and_a_gain(gain, verdict):
    """v(t) = g v(t - T): roots ln|g|/T, infinitely many."""
    found = stability(equation([[gain]], 0, channel(0.1)))
    assert found.verdict == verdict
    assert found.unstable == {"stable": 0, "not decided": None, "unstable": np.inf}[verdict]
    assert (found.reason != "") == (verdict != "stable")


@pytest.mark.parametrize(("gain", "k", "time"), [(0.6, 1.0, 0.5), (-0.6, 1.0, 2.0), (-0.9, 3.0, 1.0), (0.3, 4.0, 1.0)])
def test_a_neutral_equation_against_its_crossings(gain, k, time):
    """x' - g x'(t - T) = -k x(t - T): v = x(t - T) + ... with s (1 - g z) + k z = 0, z = exp(-s T), against Newton from a grid."""
    found = equation([[0, -k], [1, gain]], 1, channel(time)).roots
    grid = (np.linspace(-0.5, 3.0, 36)[:, None] + 1j * np.linspace(0.0, 40.0, 401)).ravel()
    with np.errstate(all="ignore"):
        for _ in range(60):
            z = np.exp(-grid * time)
            grid = grid - (grid * (1 - gain * z) + k * z) / (1 - gain * z + grid * gain * time * z - k * time * z)
    grid = grid[np.isfinite(grid) & (grid.real > 1e-6)]
    z = np.exp(-grid * time)
    grid = grid[np.abs(grid * (1 - gain * z) + k * z) < 1e-9]
    distinct = {(round(v.real, 6), round(abs(v.imag), 6)) for v in grid}
    assert found.unstable == sum(1 if im == 0 else 2 for _, im in distinct)


# --- along a parameter ---


def test_the_limits_of_a_late_integrator_along_its_gain():
    found = hi.linear.root_locus(integrator(1.0, 0.5), "k", np.linspace(0.5, 18.0, 8))
    assert [x.value for x in found.limits] == pytest.approx([np.pi, 5 * np.pi], rel=1e-9)
    assert [abs(x.eigenvalue.imag) for x in found.limits] == pytest.approx([np.pi, 5 * np.pi], rel=1e-9)
    assert [x.direction for x in found.limits] == ["lost", "lost"]
    np.testing.assert_array_equal(found.stable, found.values < np.pi)
    assert found.to_dict()["unstable_roots"][-1] == 4


# --- delays of 0 ---


def two_delays(first, length, k=3.0):
    """An integrator with a lag, its error late, and a second delay within the loop."""
    return hi.Model(
        name="two-delays",
        parameters={"T": {"value": first, "unit": "s"}, "length": length, "speed": 2.0, "k": k},
        inputs={"u": 0.0},
        states={"x": "late - x"},
        signals={"e": "u - k*x - 0.3*later"},
        delays={"late": {"of": "e", "time": "T"}, "later": {"of": "late", "time": "length/speed"}},
        outputs={"x": "x"},
    )


OMEGA = np.array([0.5, 3.0, 20.0])


def two_delays_response(first, second, k=3.0):
    """x/u = D/((s + 1)(1 + D (k/(s + 1) + 0.3 E))), D and E the two delays."""
    s = 1j * OMEGA
    d, e = np.exp(-s * first), np.exp(-s * second)
    return d / (1.0 + d * (k / (s + 1.0) + 0.3 * e)) / (s + 1.0)


def test_a_delay_of_0_is_none_beside_one_that_is():
    linear = hi.linearize(two_delays(0.0, 0.2))
    assert linear.state_names == ("x", *(f"later.pade{k}" for k in range(1, 6)))
    np.testing.assert_allclose(linear.response(OMEGA)[:, 0, 0], two_delays_response(0.0, 0.1), rtol=1e-12)
    # Rightmost root of (s + 1)(1 + 0.3 exp(-0.1 s)) + 3 = 0, real.
    pole = linear.poles()[0]
    assert abs((pole + 1.0) * (1.0 + 0.3 * np.exp(-0.1 * pole)) + 3.0) < 1e-9


def test_a_model_all_whose_delays_are_0_has_the_matrices_of_the_loop_without_them():
    """late = (u - 3 x)/1.3, so x' = -x - 3 x/1.3 + u/1.3."""
    linear = hi.linearize(two_delays(0.0, 0.0))
    np.testing.assert_allclose(linear.A, [[-1.0 - 3.0 / 1.3]], rtol=1e-12)
    np.testing.assert_allclose(linear.B, [[1.0 / 1.3]], rtol=1e-12)
    assert linear.exact is None and linear.state_names == ("x",)


def test_the_response_has_its_derivative_by_a_delay_at_0():
    linear = hi.linearize(two_delays(0.0, 0.2), sensitivities=("T", "k"))
    found = sensitivity(linear, OMEGA)
    h = 1e-5
    ahead = [two_delays_response(n * h, 0.1) for n in range(3)]
    by_delay = (-3.0 * ahead[0] + 4.0 * ahead[1] - ahead[2]) / (2.0 * h)
    by_gain = (two_delays_response(0.0, 0.1, 3.0 + h) - two_delays_response(0.0, 0.1, 3.0 - h)) / (2.0 * h)
    np.testing.assert_allclose(found["T"][:, 0, 0], by_delay, rtol=1e-7)
    np.testing.assert_allclose(found["k"][:, 0, 0], by_gain, rtol=1e-7)
    assert np.isnan(linear.gradients["T"].A).all() and np.isfinite(linear.gradients["k"].A).all()
    with pytest.raises(LinearizationError, match="no computed derivative by a delay of 0 s"):
        linear.modes()


def test_roots_that_two_loops_have_alike_are_each_its_own():
    """Two late integrators alike, one after the other: each mode has its own delay, and moves with its own gain alone."""
    both = hi.Model(
        name="two", parameters={"k1": 2.0, "k2": 2.0, "T": {"value": 0.3, "unit": "s"}}, inputs={"r": 0.0},
        states={"x1": "k1*(r - late1)", "x2": "k2*(x1 - late2)"},
        delays={"late1": {"of": "x1", "time": "T"}, "late2": {"of": "x2", "time": "T"}}, outputs={"x2": "x2"},
    )  # fmt: skip
    alone = hi.linearize(integrator(2.0, 0.3), sensitivities=["k"]).modes()
    modes = hi.linearize(both, sensitivities=["k1", "k2"]).modes()
    for one in alone[:4]:
        pair = [m for m in modes if abs(m.eigenvalue - one.eigenvalue) < 1e-6]
        assert {m.dominant.rstrip("12") for m in pair} == {one.dominant} and len({m.dominant for m in pair}) == 2
        for mode in pair:
            own = mode.dominant[-1]
            other = {"1": "2", "2": "1"}[own]
            assert mode.sensitivity[f"k{own}"] == pytest.approx(one.sensitivity["k"], rel=1e-6)
            assert mode.sensitivity[f"k{other}"] == 0.0
            assert mode.participation[f"x{other}"] == 0.0
