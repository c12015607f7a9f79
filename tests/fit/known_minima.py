"""Problems whose least cost is known: from a formula or a certificate, never from a run of the methods under test."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hvdc_ident.fit import FitParameter, Problem
from tests.fit.simulators import Closed, decay, parameters, recorded
from tests.fit.test_nist import MISRA_X, MISRA_Y, misra1a

T = np.linspace(0.0, 3.0, 31)


@dataclass(frozen=True)
class Known:
    """A problem, where its least cost lies and how large it is. rough: whether it has other minima."""

    name: str
    make: Callable[[], Problem]
    theta: tuple[float, ...]
    cost: float
    rough: bool = False


def _exact() -> Problem:
    simulator = Closed(parameters(a=1.0, k=1.0), {"y": decay})
    free = (FitParameter("a", 1.0, 0.1, 10.0), FitParameter("k", 4.0, 0.0, 20.0))
    return Problem(simulator, (recorded("e", T, {"y": 0.1}, y=2 * np.exp(-1.5 * T)),), free)


BOUND = 1.2


def _bounded() -> Problem:
    simulator = Closed(parameters(a=1.0, k=1.0), {"y": decay})
    free = (FitParameter("a", 1.0, 0.1, 10.0), FitParameter("k", 0.5, 0.0, BOUND))
    return Problem(simulator, (recorded("e", T, {"y": 0.1}, y=2 * np.exp(-1.5 * T)),), free)


def _bounded_answer() -> tuple[tuple[float, float], float]:
    e, y = np.exp(-BOUND * T), 2.0 * np.exp(-1.5 * T)
    a = float(y @ e / (e @ e))
    return (a, BOUND), 0.5 * float(np.sum(((y - a * e) / 0.1) ** 2))


def _rosenbrock(t, p):
    """Residuals 10 (x2 - x1^2) and 1 - x1 as two rows."""
    a, b = p["x1"], p["x2"]
    y = np.array([10 * (b - a * a), 1 - a])
    return y, {"x1": np.array([-20 * a, -1.0]), "x2": np.array([10.0, 0.0])}


def _valley() -> Problem:
    simulator = Closed(parameters(x1=-1.2, x2=1.0), {"y": _rosenbrock})
    free = (FitParameter("x1", -1.2, -3, 3), FitParameter("x2", 1.0, -3, 3))
    return Problem(simulator, (recorded("e", np.arange(2.0), {"y": 1.0}, y=np.zeros(2)),), free)


def _misra() -> Problem:
    """NIST StRD Misra1a from its first start, weighted by the certified residual standard deviation."""
    simulator = Closed(parameters(b1=500.0, b2=1e-4), {"y": misra1a})
    free = (FitParameter("b1", 500.0, 50, 1000), FitParameter("b2", 1e-4, 1e-5, 1e-2))
    noise = {"y": 1.0187876330e-1}
    return Problem(simulator, (recorded("nist", np.array(MISRA_X), noise, y=np.array(MISRA_Y)),), free)


def _line_only(t, p):
    """y = a t: one unknown."""
    return p["a"] * t, {"a": t}


def _single() -> Problem:
    simulator = Closed(parameters(a=1.0), {"y": _line_only})
    return Problem(simulator, (recorded("e", T, {"y": 1.0}, y=0.5 * T + 1.0),), (FitParameter("a", 4.0, -5, 5),))


def _single_answer() -> tuple[tuple[float], float]:
    y = 0.5 * T + 1.0
    a = float(y @ T / (T @ T))
    return (a,), 0.5 * float(np.sum((y - a * T) ** 2))


def _waves(t, p):
    """y_i = sin(3 x_i) + x_i/2: for each row its own unknown, several places where it comes near 0."""
    x = np.array([p["x1"], p["x2"]])
    d = 3 * np.cos(3 * x) + 0.5
    return np.sin(3 * x) + 0.5 * x, {"x1": np.array([d[0], 0.0]), "x2": np.array([0.0, d[1]])}


def _rough() -> Problem:
    simulator = Closed(parameters(x1=0.0, x2=0.0), {"y": _waves})
    free = (FitParameter("x1", -1.9, -2.0, 3.0), FitParameter("x2", -1.9, -2.0, 3.0))
    data = recorded("e", np.arange(2.0), {"y": 0.1}, y=np.array([2.4, 2.4]))
    return Problem(simulator, (data,), free)


def _rough_answer() -> tuple[tuple[float, float], float]:
    """sin(3x) + x/2 stays below 2.4 up to 3; its largest value is at cos(3x) = -1/6, x = (2 pi + acos(-1/6))/3."""
    x = (2 * np.pi + np.arccos(-1.0 / 6.0)) / 3.0
    gap = (2.4 - (np.sin(3 * x) + 0.5 * x)) / 0.1
    return (x, x), float(gap**2)


TABLE = (
    Known("exact decay", _exact, (2.0, 1.5), 0.0),
    Known("optimum on a bound", _bounded, *_bounded_answer()),
    Known("Rosenbrock's valley", _valley, (1.0, 1.0), 0.0),
    Known("NIST Misra1a", _misra, (2.3894212918e2, 5.5015643181e-4), 6.0),  # SSR/(2 s^2) = (14 - 2)/2
    Known("one unknown", _single, *_single_answer()),
    Known("several minima", _rough, *_rough_answer(), rough=True),
)
