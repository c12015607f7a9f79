"""Published answers on linear models, to the digits in which they are printed; sources in each test's docstring."""

from __future__ import annotations

import math

import numpy as np
import pytest
import sympy as sp

from hvdc_ident.expression import parse
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize import (
    LinearModel,
    find_operating_point,
    h2_norm,
    hinf_norm,
    linearize,
    margins,
    nu_gap,
    point_at,
)
from hvdc_ident.model import Model, Output, Signal, State
from hvdc_ident.parameters import Input, Parameter


def linear(a, b, c, d):
    a, b, c, d = (np.atleast_2d(np.asarray(m, dtype=float)) for m in (a, b, c, d))
    n, m, o = a.shape[0], b.shape[1], c.shape[0]
    names = (tuple(f"x{k}" for k in range(n)), tuple(f"u{k}" for k in range(m)), tuple(f"y{k}" for k in range(o)))
    return LinearModel(a, b, c, d, np.eye(n), *names)


def companion(numerator, denominator):
    """The transfer function of one channel, its denominator's first coefficient 1, as a linear model."""
    n = len(denominator) - 1
    a = np.zeros((n, n))
    a[:-1, 1:] = np.eye(n - 1)
    a[-1] = -np.array(denominator[:0:-1])
    top = np.zeros(n)
    top[: len(numerator)] = numerator[::-1]
    return linear(a, np.eye(n)[:, -1:], top[None, :], [[0.0]])


VSC_STATES = {
    "v_q": "wlp*(vpll_q - v_q)",
    "e_pll": "v_q",
    "theta": "wb*dw",
    "s_p": "pref - p",
    "p": "wz*(pe - p)",
    "s_q": "qref - q",
    "q": "wz*(qe - q)",
    "g_d": "id_ref - ic_d",
    "g_q": "iq_ref - ic_q",
    "icr": "wb/lf*(vcr - vr - rf*icr + lf*ici)",
    "ici": "wb/lf*(vci - vi - rf*ici - lf*icr)",
    "vr": "wb/cf*(icr - igr + cf*vi)",
    "vi": "wb/cf*(ici - igi - cf*vr)",
    "igr": "wb/lg*(vr - vtr - rg*igr + lg*igi)",
    "igi": "wb/lg*(vi - vti - rg*igi - lg*igr)",
}
VSC_SIGNALS = {
    "alpha": "theta + pi/2",
    "vpll_d": "sin(alpha)*vr - cos(alpha)*vi",
    "vpll_q": "cos(alpha)*vr + sin(alpha)*vi",
    "ic_d": "sin(alpha)*icr - cos(alpha)*ici",
    "ic_q": "cos(alpha)*icr + sin(alpha)*ici",
    "dw": "2*v_q + 20*e_pll",
    "w": "1 + dw",
    "pe": "igr*vr + igi*vi",
    "qe": "igr*vi - igi*vr",
    "iq_ref": "2*(pref - p) + 30*s_p",
    "id_ref": "2*(qref - q) + 30*s_q",
    "vc_d": "0.37*(id_ref - ic_d) + 0.7*g_d - w*lf*ic_q + vpll_d",
    "vc_q": "0.37*(iq_ref - ic_q) + 0.7*g_q + w*lf*ic_d + vpll_q",
    "vcr": "sin(alpha)*vc_d + cos(alpha)*vc_q",
    "vci": "-cos(alpha)*vc_d + sin(alpha)*vc_q",
    "vtr": "1.00001 - xg*igi",
    "vti": "xg*igr",
}
VSC_START = {"vr": 1.0, "igr": 0.5, "icr": 0.5, "p": 0.5, "s_p": 0.5 / 30, "g_d": 0.0, "g_q": 0.01}


def grid_following_vsc() -> Model:
    plant = {"lf": 0.009, "rf": 0.016, "cf": 2.5, "lg": 0.002, "rg": 0.003, "xg": (0.075 + 5e-6) * 2.75 / 100}
    rates = {"wb": 2 * math.pi * 60, "wlp": 1.32 * 2 * math.pi * 50, "wz": 0.132 * 2 * math.pi * 50}
    return Model(
        name="grid-following-vsc",
        parameters=FrozenMap({n: Parameter(v) for n, v in (plant | rates).items()}),
        inputs=FrozenMap({"pref": Input(0.500750063), "qref": Input(-0.004089049)}),
        states=FrozenMap({n: State(parse(e), guess=VSC_START.get(n, 0.0)) for n, e in VSC_STATES.items()}),
        signals=FrozenMap({n: Signal(parse(e)) for n, e in VSC_SIGNALS.items()}),
        outputs=FrozenMap({"p": Output(parse("pe")), "v": Output(parse("sqrt(vr**2 + vi**2)"))}),
    )


def test_grid_following_converter():
    """PowerSimulationsDynamics.jl, test/test_case_gridfollowing.jl with test24: 15 eigenvalues to eight decimals."""
    model = grid_following_vsc()
    point = find_operating_point(model)
    assert point.states["theta"] == pytest.approx(0.00204, abs=2e-5)
    assert point.outputs["v"] == pytest.approx(1.00149, abs=1e-5)
    pairs = [
        (-16167.45215897, 8.04341623),
        (-306.82201246, 5867.88729338),
        (-258.57819320, 4795.26435760),
        (-202.17657189, 520.53223265),
        (-26.89823743, 74.82611316),
        (-14.14657141, 5.18585144),
        (-1.89149338, 0.00554748),
    ]
    want = np.array([complex(r, s * i) for r, i in pairs for s in (1, -1)] + [-10.13153509])
    found = linearize(model, point).poles()
    assert len(found) == 15
    for value in want:
        gap = np.abs(found - value).min()
        # The set-points have nine digits; a pair 0.0055 rad/s apart, or one at 16000 rad/s, shows it most.
        assert gap < (2e-4 if abs(value) > 1e4 else 2e-6), value


def test_limited_pid():
    """ModelingToolkit.jl, test/downstream/linearize.jl: a PID controller, k 400, Ti 0.5, Td 1, Nd 10."""
    model = _pid()
    found = linearize(model, point_at(model, {"integral": 0.0, "filter": 0.0}))
    np.testing.assert_allclose(found.A, [[0, 0], [0, -10]], atol=1e-12)
    np.testing.assert_allclose(found.B, [[2, -2], [10, -10]], atol=1e-12)
    np.testing.assert_allclose(found.C, [[400, -4000]], atol=1e-9)
    np.testing.assert_allclose(found.D, [[4400, -4400]], atol=1e-9)


def _pid() -> Model:
    return Model(
        name="limited-pid",
        parameters=FrozenMap(
            {"k": Parameter(400.0), "Ti": Parameter(0.5), "Td": Parameter(1.0), "Nd": Parameter(10.0)}
        ),
        inputs=FrozenMap({"reference": Input(0.0), "measurement": Input(0.0)}),
        states=FrozenMap(
            {"integral": State(parse("error / Ti")), "filter": State(parse("Nd / Td * (error - filter)"))}
        ),
        signals=FrozenMap(
            {
                "error": Signal(parse("reference - measurement")),
                "derivative": Signal(parse("Nd * (error - filter)")),
                "control": Signal(parse("k * (error + integral + Td * derivative)")),
            }
        ),
        outputs=FrozenMap({"u": Output(parse("clip(control, -1000, 1000)"))}),
    )


def test_lotka_volterra():
    """OpenModelica, testsuite/openmodelica/linearization/test_04.mo and .mos: A, B, C, D at (1, 2)."""
    model = Model(
        name="simple_test",
        parameters=FrozenMap({n: Parameter(v) for n, v in {"a": 6.0, "b": 2.0, "c": 4.0}.items()}),
        inputs=FrozenMap({"u": Input(0.0)}),
        states=FrozenMap({"x1": State(parse("x1*(a - b*x1 - x2)")), "x2": State(parse("x2*(c - x1 - x2)"))}),
        outputs=FrozenMap({"y": Output(parse("x1*u + x2*u"))}),
    )
    found = linearize(model, point_at(model, {"x1": 1.0, "x2": 2.0}))
    np.testing.assert_array_equal(found.A, [[0, -1], [-2, -1]])
    np.testing.assert_array_equal(found.B, [[0], [0]])
    np.testing.assert_array_equal(found.C, [[0, 0]])
    np.testing.assert_array_equal(found.D, [[3]])


def test_van_der_pol():
    """Modelica Reference-FMUs, VanDerPol at (2, 0), mu = 1."""
    mu, x0, x1 = sp.symbols("mu x0 x1", real=True)
    model = Model(
        name="van-der-pol",
        parameters=FrozenMap({"mu": Parameter(1.0)}),
        states=FrozenMap({"x0": State(x1), "x1": State(mu * (1 - x0**2) * x1 - x0)}),
        outputs=FrozenMap({"x0": Output(x0)}),
    )
    found = linearize(model, point_at(model, {"x0": 2.0, "x1": 0.0}))
    np.testing.assert_array_equal(found.A, [[0, 1], [-1, -3]])
    np.testing.assert_allclose(np.sort(found.poles().real), [-2.618034, -0.381966], atol=5e-7)


def test_margins():
    """python-control, margin_test.py: 1/(s^3 + 2 s^2 + 3 s + 4)."""
    found = margins(companion([1.0], [1.0, 2.0, 3.0, 4.0]))
    assert found.gain_margin.value == pytest.approx(2.0, abs=1e-12)
    assert found.gain_margin.omega == pytest.approx(1.7321, abs=5e-5)
    assert found.modulus.value == pytest.approx(0.4170, abs=5e-5)
    assert found.modulus.omega == pytest.approx(1.6620, abs=5e-5)
    assert found.stable


def test_no_invented_zeros():
    """python-control issue 1068: a motor with a tiny inertia has three poles and no finite zeros."""
    inertia, k, resistance, inductance = 1e-7, 1e-3, 1.0, 1e-3
    a = [[0, 1, 0], [0, 0, k / inertia], [0, -k / inductance, -resistance / inductance]]
    model = linear(a, [[0], [0], [1 / inductance]], [[1, 0, 0]], [[0]])
    np.testing.assert_allclose(np.sort(model.poles().real), [-989.89794856, -10.10205144, 0], atol=5e-9)
    assert model.zeros().size == 0
    assert model.transfer_function().zeros.size == 0


def test_nu_gap():
    """MathWorks, gapmetric: 1/(s - 0.001) against 1/(s + 0.001), nu-gap 0.0020."""
    found = nu_gap(companion([1.0], [1.0, -0.001]), companion([1.0], [1.0, 0.001]))
    assert found.winding == 0
    assert found.value == pytest.approx(0.0020, abs=5e-5)
    assert found.value == pytest.approx(2000 / (1 + 1e6), rel=1e-9)


def test_norms():
    """python-control, sysnorm_test.py, G4: H-infinity 4.276759162964244 and H2 2.237461821810309."""
    a = [[-1.017041847539126, -0.224182952826418, 0.042538079149249],
         [-0.310374015319095, -0.516461581407780, -0.119195790221750],
         [-1.452723568727942, 1.7995860837102088, -1.491935830615152]]  # fmt: skip
    b = [[0.312858596637428, -0.164879019209038], [-0.864879917324456, 0.627707287528727],
         [-0.030051296196269, 1.093265669039484]]  # fmt: skip
    c = [[1.109273297614398, 0.077359091130425, -1.113500741486764],
         [-0.863652821988714, -1.214117043615409, -0.006849328103348]]  # fmt: skip
    model = linear(a, b, c, np.zeros((2, 2)))
    assert hinf_norm(model).value == pytest.approx(4.276759162964244, rel=1e-12)
    assert h2_norm(model) == pytest.approx(2.237461821810309, rel=1e-13)
