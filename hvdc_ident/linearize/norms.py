"""The norms of linear models: L-infinity, H-infinity and H2; delays exact but for H2.

python-control 0.10.2 with Slycot 0.7.1 was measured (`benchmarks/linear_library.py`): on models whose states differ in their units
by 1e8, as companion forms do, two thirds of its H2 norms are off by more than 1e-6, and it calls stable models unstable.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from hvdc_ident.codec import Coded
from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize.frequency import wide_omega
from hvdc_ident.linearize.gramians import reached_gramian, seen_gramian
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.realisation import approximate_visible, scaled_states, visible, whole, without_sliding_means
from hvdc_ident.linearize.stability import Characteristic, poles_of_transfer
from hvdc_ident.linearize.system import Array

AXIS = 1e-2
"""Share of its size by which an imaginary eigenvalue of a Hamiltonian matrix may be off the axis in floating point."""


@dataclass(frozen=True)
class Peak(Coded):
    """The largest singular value over all frequencies and where it is, rad/s (0 and infinity are places)."""

    value: float
    omega: float = float("inf")


def linf_norm(model: LinearModel, tolerance: float = 1e-13) -> Peak:
    """Return the L-infinity norm, max over w of the largest singular value of G(jw), stable or not.

    Parameters
    ----------
    model : LinearModel
        G, its inputs and outputs in the units in which the norm is wanted (`LinearModel.scaled`).
    tolerance : float, default 1e-13
        The relative error at which the search ends.

    Returns
    -------
    Peak
        `value`, the norm, in output per input units, and `omega` in rad/s, where it is (0 and infinity are places).

    Raises
    ------
    LinearizationError
        A pole that the inputs reach and the outputs see lies on the imaginary axis: the norm is infinite.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> unstable = hi.Model("unstable", inputs={"u": 0.0}, states={"x": "3*u + x"}, outputs={"y": "x"})
    >>> round(hi.linear.linf_norm(hi.linearize(unstable)).value, 9)
    3.0
    """
    equation = _clear_of_axis(model)
    return largest_gain(equation, wide_omega(model, 4000 if equation.channels else 400), tolerance)


def _clear_of_axis(model: LinearModel) -> Characteristic:
    """Return the equation of a model without poles on the imaginary axis: the visible part where it has such hidden ones.

    The bases that show what is hidden are orthogonal, and mix states of very different sizes: the model's own keep the
    digits. Raises LinearizationError for a pole on the axis that the inputs reach and the outputs see.
    """
    equation = whole(model)
    if not equation.channels:
        equation = Characteristic.rational(
            *scaled_states(equation.matrix, equation.given, equation.read), equation.through, equation.error
        )
    if equation.channels or equation.roots.axis:
        equation = visible(model)
        axis = poles_of_transfer(equation, f"linear model '{model.name}'")[1]
        if axis.size:
            raise LinearizationError(
                "the L-infinity norm is infinite: a pole lies on the imaginary axis",
                where=f"linear model '{model.name}'",
                got=f"eigenvalue {axis[0]:.6g}",
                hint="compare with nu_gap, which takes integrators",
            )
    return equation


def largest_gain(equation: Characteristic, omega: Array, tolerance: float = 1e-13) -> Peak:
    """Return the largest singular value of a response without poles on the imaginary axis, and where it is.

    omega: frequencies, rad/s, among which the search begins. Without delays, two-step bisection on the imaginary eigenvalues
    of the Hamiltonian matrix from there (Bruinsma and Steinbuch 1990), which needs no stability; with delays the peak is
    refined beside the largest value.
    """

    def gains(w: Array) -> Array:
        return np.linalg.svd(equation.response(1j * w), compute_uv=False)[:, 0]

    d = equation.through
    if equation.channels:
        return peak_over(gains, np.concatenate([[0.0], omega]))
    top = float(np.linalg.norm(d, 2)) if d.size else 0.0
    if not equation.nx or not d.size:
        return Peak(top, float("inf") if top else 0.0)
    poles = equation.roots.values
    best = Peak(top, float("inf"))
    at = np.concatenate([[0.0], np.abs(poles), np.abs(poles.imag), omega])
    for _ in range(60):
        values = gains(at)
        k = int(np.argmax(values))
        if values[k] <= best.value * (1.0 + tolerance):
            break
        best = Peak(float(values[k]), float(at[k]))
        crossings = _axis_crossings(equation, best.value * (1.0 + 2.0 * max(tolerance, 1e-12)))
        if crossings.size < 2:
            break
        at = np.concatenate([crossings, 0.5 * (crossings[:-1] + crossings[1:])])
    return Peak(0.0, 0.0) if best.value == 0.0 else refined(lambda w: float(gains(np.array([w]))[0]), best)


def hinf_norm(model: LinearModel, tolerance: float = 1e-13) -> Peak:
    """Return the H-infinity norm: the L-infinity norm of a stable model.

    Parameters
    ----------
    model : LinearModel
        G, its inputs and outputs in the units in which the norm is wanted (`LinearModel.scaled`).
    tolerance : float, default 1e-13
        The relative error at which the search ends.

    Returns
    -------
    Peak
        `value`, the largest singular value of G(jw), in output per input units, and `omega` in rad/s, where it is.

    Raises
    ------
    LinearizationError
        A pole that inputs reach and outputs see is not stable.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> lag = hi.Model("lag", parameters={"T": 0.5, "k": 2.0}, inputs={"u": 0.0}, states={"x": "(k*u - x)/T"}, outputs={"y": "x"})
    >>> peak = hi.linear.hinf_norm(hi.linearize(lag))
    >>> round(peak.value, 9), peak.omega  # the gain at rest
    (2.0, 0.0)
    """
    _refuse_unstable(model, "an unstable model has no H-infinity norm")
    return linf_norm(model, tolerance)


def _refuse_unstable(model: LinearModel, what: str) -> None:
    """Raise LinearizationError where a model is not stable between inputs and outputs, or cannot be told to be.

    A model that is stable as a whole is so between them: what they reach and see is asked only where it is not.
    """
    all_ = whole(model)
    if all_.roots.unstable == 0 and not all_.roots.axis:
        return
    right, axis = poles_of_transfer(visible(model), f"linear model '{model.name}'")
    if right or axis.size:
        raise LinearizationError(
            what,
            where=f"linear model '{model.name}'",
            got=f"{right} poles right of the imaginary axis and {axis.size} on it",
            hint="linf_norm takes unstable models without poles on the imaginary axis, nu_gap any",
        )


AGREE = 1e-4
"""Share by which the two Gramians' H2 norms may differ: of well scaled models they do by 1e-12; no digit is right where it is 1."""


def h2_norm(model: LinearModel) -> float:
    """Return the H2 norm, by a Gramian.

    It is the square root of the integral of trace(G(jw)* G(jw)) dw / (2 pi). Delays stand as their Pade approximants in the value, not in
    the verdict on stability.

    Parameters
    ----------
    model : LinearModel
        G, its inputs and outputs in the units in which the norm is wanted (`LinearModel.scaled`).

    Returns
    -------
    float
        The norm, in output unit per input unit and square root of s.

    Raises
    ------
    LinearizationError
        The norm is infinite (the model is unstable, or D is not 0), or both Gramians, which give it, do not agree: rounding has taken its
        digits.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> lag = hi.Model("lag", parameters={"T": 0.5, "k": 2.0}, inputs={"u": 0.0}, states={"x": "(k*u - x)/T"}, outputs={"y": "x"})
    >>> round(hi.linear.h2_norm(hi.linearize(lag)), 9)  # k / sqrt(2 T)
    2.0
    """
    _refuse_unstable(model, "the H2 norm is infinite: the model is not stable")
    a, b, c, d = without_sliding_means(model)
    equation = Characteristic.rational(*scaled_states(a, b, c), d, model.error)
    if equation.roots.unstable or equation.roots.axis:
        equation = approximate_visible(model)
    if np.any(equation.through):
        raise LinearizationError("the H2 norm is infinite: D is not 0", where=f"linear model '{model.name}'")
    if equation.nx == 0:
        return 0.0
    if equation.roots.unstable or equation.roots.axis:
        raise LinearizationError(
            "the H2 norm is not known: the model is stable, and its delays' Pade approximants are not",
            where=f"linear model '{model.name}'",
        )
    a, b, c, _ = equation.matrices
    squares = [float(np.trace(c @ reached_gramian(a, b) @ c.T)), float(np.trace(b.T @ seen_gramian(a, c) @ b))]
    if not abs(squares[0] - squares[1]) <= 2.0 * AGREE * max(squares):
        raise LinearizationError(
            "the H2 norm is not known: rounding has taken its digits",
            where=f"linear model '{model.name}'",
            expected="one square by both Gramians",
            got=f"{squares[0]:.6g} and {squares[1]:.6g}",
            hint="reduce the model first (`reduce`)",
        )
    return float(np.sqrt(squares[0]))


def norms(model: LinearModel) -> dict[str, Any]:
    """Return H2, H-infinity and L-infinity norms as plain numbers; of one that does not exist, None and the reason."""
    by_name: dict[str, Any] = {}
    for name, norm in (("h2", h2_norm), ("hinf", hinf_norm), ("linf", linf_norm)):
        try:
            value = norm(model)
        except LinearizationError as e:
            by_name[name] = None
            by_name[f"{name}_reason"] = e.what
        else:
            by_name[name] = value.to_dict() if isinstance(value, Peak) else value
    return by_name


def _axis_crossings(equation: Characteristic, level: float) -> Array:
    """Return frequencies among which are all at which a singular value equals the level.

    They are imaginary parts of imaginary eigenvalues of the Hamiltonian matrix, here of those within `AXIS` of the axis: more
    than rounding moves them. One that is none does no harm, for the gain is computed there.
    """
    a, b, c, d = equation.matrices
    r = level**2 * np.eye(d.shape[1]) - d.T @ d
    inner = np.linalg.solve(r, d.T @ c)
    f = a + b @ inner
    top = b @ np.linalg.solve(r, b.T)
    bottom = -(c.T @ c + c.T @ d @ inner)
    # Both sides counted in units in which the two blocks off the diagonal are alike.
    unit = np.sqrt(
        max(float(np.abs(bottom).max(initial=0.0)), 1e-300) / max(float(np.abs(top).max(initial=0.0)), 1e-300)
    )
    values = np.linalg.eigvals(np.block([[f, top * unit], [bottom / unit, -f.T]]))
    return np.unique(np.abs(values[np.abs(values.real) < AXIS * np.abs(values)].imag))


NEAR = 0.05
"""Logarithm of frequency either side of a peak within which it is refined: the distance of two frequencies of a grid."""


def refined(gain: Callable[[float], float], best: Peak) -> Peak:
    """Return the peak near a frequency at which the gain is known."""
    if not 0.0 < best.omega < np.inf:
        return best
    solution = minimize_scalar(
        lambda x: -gain(float(np.exp(x))),
        bounds=(np.log(best.omega) - NEAR, np.log(best.omega) + NEAR), method="bounded", options={"xatol": 1e-12},
    )  # fmt: skip
    return Peak(-float(solution.fun), float(np.exp(solution.x))) if -solution.fun > best.value else best


def peak_over(values: Callable[[Array], Array], grid: Array) -> Peak:
    """Return the largest of some positive values over the frequencies of a grid, refined beside the largest."""
    sizes = values(grid)
    k = int(np.argmax(sizes))
    return refined(lambda w: float(values(np.array([w]))[0]), Peak(float(sizes[k]), float(grid[k])))
