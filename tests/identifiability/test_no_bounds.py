"""Without bounds a verdict is the data's: it does not hang on where the search began, and it says of which range it speaks."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.identifiability import identifiability
from hvdc_ident.parameters import Parameter
from tests.fit.simulators import recorded
from tests.identifiability.cases import T, closed, line_and_nothing

NOISE = 0.01
Y = 1.0 + 2.0 * T + NOISE * np.random.default_rng(4).normal(size=T.size)
DATA = recorded("e", T, {"y": NOISE}, y=Y)
COLUMNS = np.column_stack([np.ones_like(T), T, 1e-6 * T**2])


@pytest.mark.parametrize("start", [0.01, 1.0, 300.0])
def test_the_start_does_not_decide(start) -> None:
    """Intervals of a linear model are those of the normal equations, however far off the search began."""
    plant = closed(line_and_nothing, a=1.0, b=1.0, c=0.0)
    report = identifiability(plant, [DATA], [FitParameter(n, start) for n in "abc"], starts=3)
    covariance = NOISE**2 * np.linalg.inv(COLUMNS.T @ COLUMNS)
    best = np.linalg.lstsq(COLUMNS, Y)[0]
    for i, (n, verdict) in enumerate(zip("abc", ["identifiable", "identifiable", "weak"], strict=True)):
        judged, half = report.parameters[n], math.sqrt(3.84 * covariance[i, i])
        assert judged.verdict == verdict
        assert judged.ci95 == pytest.approx((best[i] - half, best[i] + half), abs=5e-3 * half)
    assert abs(best[2]) < math.sqrt(3.84 * covariance[2, 2]), "so that c is not known to differ from 0"
    assert "no bounds" in report.parameters["c"].reason or "of its value" in report.parameters["c"].reason


def silent(t, p):
    """y = a + 0 c."""
    return p["a"] + 0.0 * t, {"a": np.ones_like(t), "c": np.zeros_like(t)}


@pytest.mark.parametrize(("low", "said"), [(0.0, "Anywhere between 0 and"), (-math.inf, "Anywhere between -")])
def test_one_without_effect_is_said_to_have_none_over_a_range_that_is_told(low, said) -> None:
    plant = closed(silent, a=1.0, c=Parameter(1.0, min=low))
    report = identifiability(plant, [DATA], [FitParameter("a", 1.0), FitParameter("c", 1.0, low)], starts=1)
    reason = report.parameters["c"].reason
    assert report.parameters["c"].verdict == "insensitive"
    assert reason.startswith(said) and "the outputs do not change at all" in reason


def decades(t, p):
    """y = a (1 - exp(-k t))."""
    e = np.exp(-p["k"] * t)
    return p["a"] * (1 - e), {"a": 1 - e, "k": p["a"] * t * e}


def test_a_positive_rate_without_upper_bound_is_walked_in_its_logarithm() -> None:
    """Seen only as quicker than the first sample: open above, and nothing overflows on the way."""
    t = np.linspace(0.2, 1.0, 41)
    y = 2.0 + 0.02 * np.random.default_rng(0).normal(size=t.size)
    plant = closed(decades, a=1.0, k=Parameter(10.0, min=1e-3))
    free = [FitParameter("a", 1, 0.1, 10), FitParameter("k", 30.0, 1e-3)]
    report = identifiability(plant, [recorded("e", t, {"y": 0.02}, y=y)], free, starts=1)
    k = report.parameters["k"]
    assert k.verdict == "practically-unidentifiable" and k.ci95[1] is None
    assert "from above (no crossing found up to" in k.reason


def test_an_interval_stays_within_the_bounds() -> None:
    plant = closed(line_and_nothing, a=1.0, b=Parameter(1.0, min=0.0), c=0.0)
    y = 1.0 + 0.005 * T + NOISE * np.random.default_rng(4).normal(size=T.size)
    free = (FitParameter("a", 1.0), FitParameter("b", 1.0, 0.0))
    result = fit(Problem(plant, (recorded("e", T, {"y": NOISE}, y=y),), free), starts=1)
    b = result.estimates["b"]
    assert b.value > 0 and b.value - 1.96 * b.std < 0
    assert b.ci95[0] == 0.0 and b.ci95[1] == pytest.approx(b.value + 1.96 * b.std, rel=1e-2)
