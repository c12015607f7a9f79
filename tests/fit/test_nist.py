"""NIST StRD nonlinear regression (https://www.itl.nist.gov/div898/strd/nls/nls_main.shtml), certified values."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident.fit import FitParameter, FitResult, Problem, fit
from tests.fit.simulators import Closed, parameters, recorded

MISRA_X = [77.6, 114.9, 141.1, 190.8, 239.9, 289.0, 332.8, 378.4, 434.8, 477.3, 536.8, 593.1, 689.1, 760.0]
MISRA_Y = [10.07, 14.73, 17.94, 23.93, 29.61, 35.18, 40.02, 44.82, 50.76, 55.05, 61.01, 66.40, 75.47, 81.78]

MGH_X = [0.0625, 0.0714, 0.0833, 0.1, 0.125, 0.167, 0.25, 0.5, 1.0, 2.0, 4.0]
MGH_Y = [0.0246, 0.0235, 0.0323, 0.0342, 0.0456, 0.0627, 0.0844, 0.16, 0.1735, 0.1947, 0.1957]


def misra1a(x, p):
    e = np.exp(-p["b2"] * x)
    return p["b1"] * (1 - e), {"b1": 1 - e, "b2": p["b1"] * x * e}


def mgh09(x, p):
    top, bottom = x**2 + p["b2"] * x, x**2 + p["b3"] * x + p["b4"]
    y = p["b1"] * top / bottom
    return y, {"b1": top / bottom, "b2": p["b1"] * x / bottom, "b3": -y * x / bottom, "b4": -y / bottom}


def check(result: FitResult, certified: dict[str, tuple[float, float]], squares: float, n: int) -> None:
    assert result.status == "converged", result.message
    for name, (value, std) in certified.items():
        assert result.estimates[name].value == pytest.approx(value, rel=1e-6)
        assert result.estimates[name].std_raw == pytest.approx(std, rel=1e-6)
    assert result.rmse["y"]["nist"] ** 2 * n == pytest.approx(squares, rel=1e-9)
    assert result.noise_source == {"y": "misfit"}


@pytest.mark.parametrize("start", [(500.0, 1e-4), (250.0, 5e-4)])
@pytest.mark.parametrize("starts", [1, 8])
def test_misra1a(start, starts):
    simulator = Closed(parameters(b1=start[0], b2=start[1]), {"y": misra1a})
    free = (FitParameter("b1", start[0], 50, 1000), FitParameter("b2", start[1], 1e-5, 1e-2))
    result = fit(Problem(simulator, (recorded("nist", np.array(MISRA_X), y=np.array(MISRA_Y)),), free), starts=starts)
    certified = {"b1": (2.3894212918e2, 2.7070075241), "b2": (5.5015643181e-4, 7.2668688436e-6)}
    check(result, certified, 1.2455138894e-1, 14)


CERTIFIED_MGH09 = {
    "b1": (1.9280693458e-1, 1.1435312227e-2),
    "b2": (1.9128232873e-1, 1.9633220911e-1),
    "b3": (1.2305650693e-1, 8.0842031232e-2),
    "b4": (1.3606233068e-1, 9.0025542308e-2),
}


@pytest.mark.parametrize("start", [(25.0, 39.0, 41.5, 39.0), (0.25, 0.39, 0.415, 0.39)])
def test_mgh09(start):
    free = tuple(FitParameter(f"b{i + 1}", s, 0, 100) for i, s in enumerate(start))
    simulator = Closed(parameters(**{f.name: f.start for f in free}), {"y": mgh09})
    result = fit(Problem(simulator, (recorded("nist", np.array(MGH_X), y=np.array(MGH_Y)),), free))
    check(result, CERTIFIED_MGH09, 3.0750560385e-4, 11)


def test_mgh09_has_an_interval_of_students_t():
    free = tuple(FitParameter(n, v, 0, 1) for n, (v, _) in CERTIFIED_MGH09.items())
    simulator = Closed(parameters(**{f.name: f.start for f in free}), {"y": mgh09})
    result = fit(Problem(simulator, (recorded("nist", np.array(MGH_X), y=np.array(MGH_Y)),), free), starts=1)
    estimate = result.estimates["b1"]
    assert result.rho == {"y": 0.0}
    assert estimate.std == pytest.approx(estimate.std_raw, rel=1e-12)
    half = 2.364624251592785 * CERTIFIED_MGH09["b1"][1]  # t of 0.975 with 7 degrees of freedom
    assert estimate.ci95 == pytest.approx((estimate.value - half, estimate.value + half), rel=1e-5)


@pytest.mark.parametrize("start", [(500.0, 1e-4), (250.0, 5e-4), (1.0, 0.01)])
def test_misra1a_without_bounds_does_not_depend_on_the_start(start):
    simulator = Closed(parameters(b1=start[0], b2=start[1]), {"y": misra1a}, lambda p: p["b2"] < -0.5)
    free = (FitParameter("b1", start[0]), FitParameter("b2", start[1]))
    result = fit(Problem(simulator, (recorded("nist", np.array(MISRA_X), y=np.array(MISRA_Y)),), free))
    certified = {"b1": (2.3894212918e2, 2.7070075241), "b2": (5.5015643181e-4, 7.2668688436e-6)}
    check(result, certified, 1.2455138894e-1, 14)
    assert result.adequacy.verdict == "not-judged"


MODELS = {
    "misra1a": (MISRA_X, MISRA_Y, "b1*(1 - exp(-b2*{x}))", ((500.0, 1e-4), (250.0, 5e-4))),
    "mgh09": (
        MGH_X,
        MGH_Y,
        "b1*({x}**2 + {x}*b2)/({x}**2 + {x}*b3 + b4)",
        ((25.0, 39.0, 41.5, 39.0), (0.25, 0.39, 0.415, 0.39)),
    ),
}
CERTIFIED = {
    "misra1a": {"b1": (2.3894212918e2, 2.7070075241), "b2": (5.5015643181e-4, 7.2668688436e-6)},
    "mgh09": CERTIFIED_MGH09,
}


@pytest.mark.parametrize("x", ["time", "x"])
@pytest.mark.parametrize("start", [0, 1])
@pytest.mark.parametrize("name", MODELS)
def test_as_a_study_without_noise_or_bounds(name, start, x, tmp_path):
    """The predictor is the time, or an input recorded by rows; the model has no states."""
    from hvdc_ident.simulate import ModelSimulator
    from hvdc_ident.study.study import load_study

    xs, ys, formula, starts = MODELS[name]
    names = [f"b{i + 1}" for i in range(len(starts[start]))]
    values = "".join(f"{n} = {{value = {v!r}}}\n" for n, v in zip(names, starts[start], strict=True))
    inputs = "" if x == "time" else f"[inputs]\nx = {{value = {xs[0]!r}}}\n"
    (tmp_path / "m.toml").write_text(
        f'schema = 1\nname = "{name}"\n[parameters]\n{values}{inputs}[outputs]\ny = "{formula.format(x=x)}"\n'
    )
    rows = zip(*([xs, ys] if x == "time" else [range(len(xs)), xs, ys]), strict=True)
    head = "time,y" if x == "time" else "time,x,y"
    (tmp_path / "d.csv").write_text(head + "\n" + "\n".join(",".join(map(repr, r)) for r in rows) + "\n")
    read = "" if x == "time" else 'inputs = ["x"]\n'
    (tmp_path / "s.toml").write_text(
        'schema = 1\n[model]\nsource = "m.toml"\n[parameters]\n'
        + "".join(f"{n} = {{}}\n" for n in names)
        + f'[[experiment]]\nname = "nist"\ndata = "d.csv"\n{read}outputs = ["y"]\n'
    )
    study = load_study(tmp_path / "s.toml")
    result = fit(Problem(ModelSimulator(study.model), study.experiments, tuple(study.candidates.values())))
    assert result.status in ("converged", "two-optima"), result.message  # eleven rows of MGH09 allow a pole between two
    for n, (value, std) in CERTIFIED[name].items():
        assert result.estimates[n].value == pytest.approx(value, rel=1e-6)
        assert result.estimates[n].std_raw == pytest.approx(std, rel=1e-5)
    assert result.noise_source == {"y": "misfit"}
    assert {n.source for notes in study.noise.values() for n in notes.values()} == {"residual"}
