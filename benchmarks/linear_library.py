"""Python-control with Slycot against the package, on 100 badly scaled systems: why `linearize` keeps code of its own.

    pip install slycot && python benchmarks/linear_library.py

Each system has up to 30 states with poles over four decades, and its states are counted in units of 1e-4 to 1e4. The answers are
those of the same system in units that suit it. Printed: how many are off by more than 1e-6 (relative), and the worst; of
the package, of the library as it is, and of the library after the package's own scaling of the states.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import control
import numpy as np
import slycot

sys.path.insert(0, str(Path(__file__).parents[1]))
from scipy.optimize import linear_sum_assignment

from hvdc_ident.linearize import LinearModel, balanced, h2_norm, linf_norm
from hvdc_ident.linearize.loops import structured_singular_value
from hvdc_ident.linearize.realisation import scaled_states
from hvdc_ident.linearize.reduction import hankel
from hvdc_ident.linearize.zeros import zeros
from tests.linearize.helpers import linear
from tests.linearize.test_badly_scaled import random_system

Array = Any
W = np.logspace(-3, 5, 200)


def apart(found: Array, want: Array) -> float:
    """The largest relative difference of two sets of numbers, each with its nearest; infinite where their counts differ."""
    found, want = np.atleast_1d(found), np.atleast_1d(want)
    if found.size != want.size or not np.isfinite(found).all():
        return float("inf")
    distance = (
        np.abs(want[:, None] - found) / np.maximum(np.abs(want), 1e-3 * np.abs(want).max(initial=1e-300))[:, None]
    )
    return float(distance[linear_sum_assignment(distance)].max(initial=0.0))


def reduced(model: LinearModel) -> Array:
    """The response of the model reduced to half its states."""
    return balanced(model, max(1, model.A.shape[0] // 2)).model.response(W)


def reduced_by_library(system: control.StateSpace) -> Array:
    """The same by python-control."""
    small = control.balanced_reduction(system, max(1, system.nstates // 2))
    return np.moveaxis(small(1j * W, squeeze=False), -1, 0)


def questions(
    seed: int,
) -> list[tuple[str, Array, Callable[[LinearModel], Array], Callable[[control.StateSpace], Array]]]:
    """Name, answer, and what computes it in the package and in the library."""
    good = random_system(seed)[0]
    values = hankel(*good[:3])[0]
    large = values > 1e-8 * values[0]
    gain, whole = linf_norm(linear(*good)).value, reduced(linear(*good))
    found: list[tuple[str, Array, Any, Any]] = [
        ("zeros", zeros(*good), lambda m: zeros(*m.standard()), lambda s: s.zeros()),
        ("L-infinity norm", gain, lambda m: linf_norm(m).value, lambda s: control.linfnorm(s)[0]),
        ("Hankel singular values", values[large], lambda m: hankel(*scaled_states(m.A, m.B, m.C))[0][large],
         lambda s: np.asarray(control.hankel_singular_values(s))[large]),
        ("reduction, in largest gains", np.zeros(1), lambda m: abs(reduced(m) - whole).max() / gain,
         lambda s: abs(reduced_by_library(s) - whole).max() / gain),
    ]  # fmt: skip
    if not good[3].any():
        found.append(("H2 norm", h2_norm(linear(*good)), h2_norm, lambda s: control.norm(s, 2)))
    return found


def error(compute: Callable[[Any], Array], of: Any, want: Array) -> float:
    """Return how far an answer is off; infinite where the library raises an error, which counts as a wrong one."""
    try:
        found = compute(of)
    except (ArithmeticError, ValueError, control.exception.ControlArgument) as refused:
        print(f"  {type(refused).__name__}: {str(refused).strip()[:80]}")
        return float("inf")
    if np.size(want) == 1 and np.all(np.equal(want, 0.0)):
        return float(np.max(found))
    return apart(found, want)


def main() -> None:
    """Print the comparison."""
    warnings.simplefilter("ignore")
    table: dict[str, list[tuple[float, float, float]]] = {}
    for seed in range(100):
        a, b, c, d = random_system(seed)[1]
        raw, scaled = control.ss(a, b, c, d), control.ss(*scaled_states(a, b, c), d)
        for name, want, own, library in questions(seed):
            errors = (error(own, linear(a, b, c, d), want), error(library, raw, want), error(library, scaled, want))
            table.setdefault(name, []).append(errors)
    rng = np.random.default_rng(0)
    for k in range(60):
        n = 2 + k % 5
        m = (rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n))) * 10 ** rng.uniform(-3, 3, (n, n))
        bound = slycot.ab13md(m, np.ones(n, dtype=int), 2 * np.ones(n, dtype=int))[0]
        own = structured_singular_value(m)
        table.setdefault("structured singular value", []).append(
            (max(own / bound - 1, 0.0), max(bound / own - 1, 0.0), np.nan)
        )
    print("off by more than 1e-6 (worst): package | python-control with Slycot | the same, scaled first")
    for name, rows in table.items():
        parts = [
            f"{(column > 1e-6).sum():3d} ({np.nanmax(column):.1g})"
            for column in np.array(rows).T
            if not np.isnan(column).all()
        ]
        print(f"{name:28s} of {len(rows):3d}: {' | '.join(parts)}")


if __name__ == "__main__":
    main()
