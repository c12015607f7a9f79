"""Modes of a linear model with delays: the roots of its exact characteristic equation, with what takes part in them."""

from __future__ import annotations

import numpy as np

from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize.characteristic import Part
from hvdc_ident.linearize.delays import DelayFree, response, response_slopes
from hvdc_ident.linearize.linear_model import Gradient, LinearModel
from hvdc_ident.linearize.modal import Mode
from hvdc_ident.linearize.operating_point import ZERO
from hvdc_ident.linearize.stability import Characteristic, sliding_means
from hvdc_ident.linearize.system import Array

ALIKE = 1e-7
"""Roots nearer to each other than this share of their size are taken for one of several times."""
CONTOUR = 32
"""Points of the circle around roots that are not apart; the trapezoidal rule converges geometrically on it."""


def modes(model: LinearModel) -> tuple[Mode, ...]:
    """Return the rightmost modes, at least one for each state and five for each delay; conjugates follow each other, the upper one first.

    With u P(s) = 0 and P(s) v = 0 at a root, the share of a state is u v and that of a delay u v times its time (the content
    of the delay); they sum to 1 over both before their moduli are taken. The derivative by a parameter is
    -u dP v / (u P' v).
    """
    core = model.delay_free
    assert core is not None
    equation = model.characteristic
    found_roots = equation.roots
    roots = found_roots.values if found_roots.averaged is None else found_roots.averaged
    whole, means = equation.whole, sliding_means(equation)
    names = (*model.state_names[: core.nx], *(c.name for c in core.channels))
    zero = ZERO * max(1.0, float(np.abs(roots).max(initial=0.0)))
    slowest = np.argsort(np.abs(roots), kind="stable")[:means]
    found = []
    for k, root in enumerate(roots):
        apart = np.abs(roots - root) > ALIKE * max(abs(root), 1e-3 * whole.unit)
        place = int((~apart[:k]).sum())  # among the roots that are alike
        right, left = _vectors(whole, complex(root), int((~apart).sum()))
        share, shape = _participation(whole, complex(root), right, left, place)
        radius = 0.3 * float(np.abs(roots - root)[apart].min(initial=whole.unit))
        slopes = {
            name: _slope(whole, core, complex(root), right, left, place, g, radius)
            for name, g in model.gradients.items()
        }
        mean = k in slowest and abs(root) <= zero
        found.append(
            Mode(
                complex(root),
                abs(float(root.imag)) / (2 * np.pi),
                0.0 if abs(root) <= zero else float(-root.real / abs(root)),
                FrozenMap(zip(names, (float(x) for x in share), strict=True)),
                FrozenMap(zip(names, (complex(x) for x in shape), strict=True)),
                FrozenMap(slopes),
                "sliding mean (cancelled by its delay)" if mean else _kind(equation, complex(root), right, left, zero),
            )
        )
    return tuple(found)


def _vectors(whole: Part, root: complex, count: int) -> tuple[Array, Array]:
    """Return the null vectors of the pencil at a root: the right ones in columns, the left ones in rows."""
    pencil = whole.pencil(np.array([root]))[0]
    size = np.abs(pencil)
    rows = np.where(size.max(axis=1) > 1e-13 * size.max(), size.max(axis=1), 1.0)
    size = size / rows[:, None]
    columns = np.where(size.max(axis=0) > 1e-13 * size.max(), size.max(axis=0), 1.0)
    u, sizes, vh = np.linalg.svd(pencil / rows[:, None] / columns)
    dimension = max(1, min(count, int((sizes <= 1e-8 * sizes[0]).sum())))
    right = vh[-dimension:].conj().T / columns[:, None]
    left = u[:, -dimension:].conj().T / rows
    return right / np.linalg.norm(right, axis=0), left / np.linalg.norm(left, axis=1)[:, None]


def _participation(whole: Part, root: complex, right: Array, left: Array, place: int) -> tuple[Array, Array]:
    """Return the shares of states and delays, and the shape, its largest entry 1."""
    slope = whole.pencil_by_s(np.array([root]))[0]
    with np.errstate(all="ignore"):
        share = np.abs(np.diag(slope @ right @ np.linalg.pinv(left @ slope @ right) @ left))
    if not share.sum() > 0:
        share = np.abs(right[:, 0] * left[0])
    v = right[:, min(place, right.shape[1] - 1)]
    return share / max(float(share.sum()), 1e-300), v / v[np.argmax(np.abs(v))]


def _slope(
    whole: Part,
    core: DelayFree,
    root: complex,
    right: Array,
    left: Array,
    place: int,
    gradient: Gradient,
    radius: float,
) -> complex:
    """Return the derivative of a root by a parameter; of roots that are one and not apart, the mean."""
    s = np.array([root])
    inner = left @ whole.pencil_by_s(s)[0] @ right
    if np.linalg.cond(inner) < 1e6:
        values = np.linalg.eigvals(-np.linalg.solve(inner, left @ _along(whole, core, s, gradient)[0] @ right))
        return complex(np.sort_complex(values)[min(place, values.size - 1)])
    around = root + radius * np.exp(2j * np.pi * np.arange(CONTOUR) / CONTOUR)
    pencil, slope, along = whole.pencil(around), whole.pencil_by_s(around), _along(whole, core, around, gradient)
    count = np.trace(np.linalg.solve(pencil, slope), axis1=1, axis2=2) @ (around - root)
    moved = np.trace(np.linalg.solve(pencil, along), axis1=1, axis2=2) @ (around - root)
    return complex(-moved / count)


def _along(whole: Part, core: DelayFree, s: Array, gradient: Gradient) -> Array:
    """Return the derivative of the pencil by a parameter."""
    n, e = whole.nx, len(whole.channels)
    assert gradient.delay_free is not None
    rows = [*range(n), *range(n + core.no, n + core.no + e)]
    columns = [*range(n), *range(n + core.nu, n + core.nu + e)]
    change = gradient.delay_free[np.ix_(rows, columns)]
    factors = np.ones((s.size, n + e), dtype=complex)
    slopes = np.zeros((s.size, n + e), dtype=complex)
    for i, (c, times) in enumerate(zip(whole.channels, gradient.times, strict=True)):
        factors[:, n + i] = response(c.kind, c.time, c.compute, s)
        by_time, by_compute = response_slopes(c.kind, c.time, c.compute, s)
        slopes[:, n + i] = by_time * times[0] + (by_compute * times[1] if len(times) > 1 else 0.0)
    return np.asarray(-(factors[:, :, None] * change + slopes[:, :, None] * whole.matrix))


def _kind(equation: Characteristic, root: complex, right: Array, left: Array, zero: float) -> str:
    """Return the kind of a mode that is not a sliding mean."""
    if abs(root) > zero:
        if root.imag:
            return "oscillation" if root.real <= 0 else "growing oscillation"
        return "decay" if root.real < 0 else "growth"
    driven = np.abs(left @ equation.given).max(initial=0.0) > 1e-9 * np.abs(equation.given).max(initial=1e-300)
    seen = np.abs(equation.read @ right).max(initial=0.0) > 1e-9 * np.abs(equation.read).max(initial=1e-300)
    if driven and seen:
        return "free integrator"
    if driven:
        return "angle reference or unobserved integrator"
    return "undriven integrator" if seen else "hidden integrator"
