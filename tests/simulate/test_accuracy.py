"""States and sensitivities of the link against sympy's derivatives integrated by scipy at tight tolerance."""

import numpy as np
import pytest

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.effects import apply_effects
from hvdc_ident.model import Delay, Model, Sampled
from hvdc_ident.models import load_model
from hvdc_ident.simulate import simulate
from tests.simulate.reference import Reference, sided

pytestmark = pytest.mark.nightly

RTOL = 1e-8
LINK = load_model("vsc-hvdc-link")
LAGGED = apply_effects(
    LINK,
    [
        {"effect": "lag", "at": ["Ir1", "Ii1", "Ir2", "Ii2"], "parameters": {"T": 0.0016}},
        {"effect": "limit", "at": ["Ir2"], "parameters": {"level": 0.45}},
    ],
)
VDC_P_Q = {
    "Vdcref1": InputSignal.step(0.02, 1.0, 1.019),
    "Pref2": InputSignal.step(0.06, 0.4, 0.5),
    "Qref1": InputSignal.ramp(0.08, 0.0, 0.12, 0.1),
}
SATURATING = {
    "Pref2": InputSignal.corners([(0.02, 0.4), (0.02, 0.9), (0.1, 0.9), (0.1, 0.4)]),
    "Qref1": InputSignal.corners([(0.04, 0.0), (0.04, 0.7), (0.12, 0.7), (0.12, 0.0)]),
}
CASES = {
    "index-1 DAE": (LINK, VDC_P_Q, {"KPP": 0.2, "KPQ": 0.3}, ("KPVDC", "KPP", "KPQ"), 0),
    "limits reached and released": (LINK, SATURATING, {"KPQ": 0.3}, ("KIQ", "KPQ"), 2),
    "very stiff": (
        LINK,
        {"Vdcref1": InputSignal.step(0.02, 1.0, 1.019)},
        {"C1": 1e-6, "C2": 0.4},
        ("KPVDC", "KIVDC"),
        0,
    ),
    "lag and limit": (LAGGED, {"Pref2": SATURATING["Pref2"]}, {}, ("KIP", "lag_Ir1_T", "limit_Ir2_level"), 2),
}


@pytest.mark.parametrize("case", CASES)
def test_against_reference(case):
    model, inputs, values, names, switches = CASES[case]
    run = experiment(case, np.linspace(0.0, 0.16, 33), inputs)
    mine = simulate(model, run, values, names, rtol=RTOL)
    breaks = sorted({b for s in inputs.values() for b in s.breaks})
    with np.errstate(all="ignore"):
        theirs, gradients = Reference(model, names).run(
            {n: sided(s) for n, s in inputs.items()}, run.time, breaks, values, rtol=1e-10
        )
    assert mine.statistics.events >= switches
    for k, output in enumerate(model.outputs):
        # The dc current is the difference of two voltages times 4096: so is its error.
        gain = 4096.0 if output == "Idc" else 1.0
        scale = max(np.abs(theirs[:, k]).max(), 0.1)
        assert np.abs(mine[output] - theirs[:, k]).max() < 100 * RTOL * scale * gain, output
        for j, name in enumerate(names):
            size = max(np.abs(gradients[:, k, j]).max(), 0.1 / model.parameters[name].size)
            assert np.abs(mine.gradient(output)[:, j] - gradients[:, k, j]).max() < 100 * RTOL * size * gain, (
                output,
                name,
            )


def test_the_published_start_and_peak_of_the_link():
    run = experiment("step", np.linspace(0.0, 0.9, 1801), {"Vdcref1": InputSignal.step(0.1, 1.0, 1.019)})
    result = simulate(LINK, run)
    assert result["Irorder1"][0] == pytest.approx(-0.39981, abs=5e-6)
    assert result["Irorder2"][0] == pytest.approx(0.40016, abs=5e-6)
    assert result["Vdc2"][0] == pytest.approx(1.00010, abs=5e-6)
    assert result["Irorder1"].max() == pytest.approx(0.056, abs=5e-4)
    assert result["Vdc1"].max() == pytest.approx(1.0230, abs=5e-5)


def test_small_steps_follow_the_linear_chain():
    """Irorder1/Vdcref1 = (KPVDC s + KIVDC) C s / (C s^2 + KPVDC s + KIVDC) with Rdc -> 0."""
    from scipy.signal import lti, step

    kp, ki, c, size = 24.0, 734.7, 0.4, 1e-5
    t, y = step(lti([kp * c, ki * c, 0], [c, kp, ki]), T=np.linspace(0, 0.3, 301))
    run = experiment("small", t + 0.1, {"Vdcref1": InputSignal.step(0.1, 1.0, 1.0 + size), "Pref2": 0.0})
    found = simulate(LINK, run, {"Rdc": 1e-7, "Zg": 1e-9, "KIP": 1e-6}, rtol=1e-9)["Irorder1"]
    np.testing.assert_allclose((found - found[0] + kp * size) / size, y, atol=2e-2)


@pytest.mark.parametrize("method", ["explicit", "rosenbrock"])
def test_a_delayed_signal_is_exact_where_it_moves_faster_than_the_states(method):
    """d = 1/(1 + 25 u^2), 0.2 s late, of a ramp u: nothing but d itself tells that it is no quartic over a step."""
    model = Model(
        "peak",
        parameters={"T": 0.2},
        inputs={"u": 0.0},
        states={"x": "0.001*d - x"},
        delays={"d": Delay("1/(1 + 25*u**2)", "T")},
        outputs={"d": "d"},
    )
    time = np.linspace(0.0, 1.4, 1401)
    run = simulate(
        model, experiment("ramp", time, {"u": InputSignal.ramp(0.1, -1.0, 0.9, 1.0)}), {}, ["T"], method=method
    )
    u = np.clip((time - 0.3) / 0.8, 0.0, 1.0) * 2 - 1
    np.testing.assert_allclose(run["d"], 1 / (1 + 25 * u**2), rtol=0, atol=2 * RTOL)
    inside = (time > 0.301) & (time < 1.099)
    slope = 125 * u / (1 + 25 * u**2) ** 2  # the ramp goes 2.5 a second
    np.testing.assert_allclose(run.gradient("d")[inside, 0], slope[inside], rtol=0, atol=100 * RTOL * slope.max())


def test_a_first_step_over_many_time_constants_is_exact_within():
    """x = r - T s on a ramp r = s t: a step that begins at rest has to leave it first, and only its end is sure to be right."""
    T, rtol = 1e-6, 1e-6
    model = Model("lag", parameters={"T": T}, inputs={"u": 0.0}, states={"x": "(u - x)/T"}, outputs={"x": "x"})
    time = np.linspace(0.0, 0.8, 801)
    case = experiment("ramp", time, {"u": InputSignal.ramp(0.1, 0.0, 0.9, 0.8)})
    run = simulate(model, case, {}, rtol=rtol, method="rosenbrock")
    behind = np.clip(time - 0.1, 0.0, None)
    np.testing.assert_allclose(run["x"], behind - T * (1 - np.exp(-behind / T)), rtol=0, atol=rtol * 0.1)


@pytest.mark.parametrize("method", ["explicit", "rosenbrock"])
def test_a_sample_that_a_delay_brings_back_moves_with_the_sampling_period(method):
    """x' = q(t - 0.07), with q a ramp sampled every T: each step of it comes k T + 0.07 after the start."""
    T, lag, slope = 0.13, 0.07, 1.7

    def x(t, T):
        edges = np.arange(20) * T + lag
        return sum(slope * T * np.maximum(t - edge, 0.0) for edge in edges[1:])

    model = Model(
        "computer",
        parameters={"T": T},
        inputs={"u": 0.0},
        states={"x": {"derivative": "late", "start": 0.0}},
        sampled={"q": Sampled("u", "T")},
        delays={"late": Delay("q", lag)},
        outputs={"x": "x"},
    )
    time = np.linspace(0.0, 0.99, 34)
    run = simulate(
        model, experiment("ramp", time, {"u": InputSignal.ramp(0.0, 0.0, 1.0, slope)}), {}, ["T"], method=method
    )
    np.testing.assert_allclose(run["x"], x(time, T), rtol=0, atol=RTOL)
    slopes = (x(time, T + 1e-6) - x(time, T - 1e-6)) / 2e-6
    away = np.abs((time - lag) / T - np.round((time - lag) / T)) > 1e-4
    np.testing.assert_allclose(run.gradient("x")[away, 0], slopes[away], rtol=0, atol=1e-7)
