"""Minimal and balanced realisations, and the norms of linear models: L-infinity, H-infinity and H2.

python-control 0.10.2 with Slycot 0.7.1 was measured (`benchmarks/linear_library.py`): on models whose states differ in their units
by 1e8, as companion forms do, two thirds of its reductions and H2 norms are off by more than 1e-6, and it calls stable models
unstable. Own code scales the states first, and takes delays and sliding means.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import scipy.linalg
from scipy.optimize import minimize_scalar

from hvdc_ident.codec import INLINE, Coded, stored_as
from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize.frequency import transfer, wide_omega
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.realisation import TOLERANCE, kalman, on_axis, scaled_states, visible, without_sliding_means
from hvdc_ident.linearize.stability import sliding_means, stability
from hvdc_ident.linearize.system import Array


@dataclass(frozen=True, eq=False)
class Reduction(Coded):
    """A smaller model. removed: eigenvalues that went; hankel: singular values of the whole; bound: on max |G - Gr|.

    kept: how many states carry modes that are not stable; these are never reduced. match_dc: whether the dc gain is the
    whole's. stable: the stable part before and after.
    """

    model: LinearModel = field(metadata=INLINE)
    removed: tuple[complex, ...]
    hankel: tuple[float, ...]
    bound: float
    kept: int = field(default=0, metadata=stored_as("not_stable_states_kept"))
    match_dc: bool = False
    stable: tuple[LinearModel, LinearModel] | None = field(
        default=None, repr=False, metadata=stored_as("stable_parts", optional=True)
    )
    stored_properties: ClassVar[tuple[str, ...]] = ("order",)

    @property
    def order(self) -> int:
        """The number of states that stay."""
        return len(self.model.state_names)

    @property
    def error(self) -> Peak:
        """The L-infinity norm of whole - reduced, and where it is: between the stable parts, for the rest is kept."""
        return Peak(0.0, 0.0) if self.stable is None else linf_norm(difference(*self.stable))

    def __str__(self) -> str:
        dc = ", with the dc gain kept" if self.match_dc else ""
        listed = ", ".join(f"{v:.3g}" for v in self.hankel[: self.order + 3])
        return f"{self.order} states{dc}; the gain is off by {self.bound:.4g} at most\nHankel singular values {listed}"


def minimal(model: LinearModel, tolerance: float = TOLERANCE) -> Reduction:
    """Return the controllable and observable part, and the eigenvalues that were removed.

    Raises LinearizationError where an unstable or undamped mode would be cancelled: it is hidden, not gone.
    """
    a, b, c, d = model.standard()
    part, hidden = kalman(*scaled_states(a, b, c), tolerance)
    for eigenvalues, verb in zip(hidden, ("control", "observe"), strict=True):
        bad = eigenvalues[eigenvalues.real > -1e-9 * np.maximum(1.0, np.abs(eigenvalues))]
        if bad.size:
            raise LinearizationError(
                f"a mode that the {'outputs' if verb == 'observe' else 'inputs'} do not {verb} is not stable",
                where=f"linear model '{model.name}'",
                expected="only stable modes to cancel",
                got=f"eigenvalue {bad[0]:.6g}",
                hint="choose inputs and outputs that reach it, or keep the model whole",
            )
    removed = tuple(complex(v) for v in np.concatenate(hidden))
    return Reduction(_renamed(model, *part, d, "minimal"), removed, (), 0.0)


def _renamed(model: LinearModel, a: Array, b: Array, c: Array, d: Array, how: str) -> LinearModel:
    return model.with_matrices(a, b, c, d, prefix=how, provenance=model.provenance | {"reduction": how})


def hankel(a: Array, b: Array, c: Array) -> tuple[Array, Array, Array]:
    """Return (singular values, left and right square-root balancing matrices) of a stable system."""
    p = scipy.linalg.solve_continuous_lyapunov(a, -b @ b.T)
    q = scipy.linalg.solve_continuous_lyapunov(a.T, -c.T @ c)
    root_p, root_q = _root(p), _root(q)
    u, values, v = np.linalg.svd(root_q.T @ root_p)
    return values, root_q @ u, root_p @ v.T


def _root(p: Array) -> Array:
    """Return R with R R' = P, of a Gramian whose states are first counted in units in which each has 1: small ones keep their digits."""
    unit = np.sqrt(np.maximum(np.diag(p), 1e-300))
    values, vectors = np.linalg.eigh(0.5 * (p + p.T) / np.outer(unit, unit))
    return np.asarray(unit[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def balanced(
    model: LinearModel, order: int | None = None, bound: float | None = None, *, match_dc: bool = False
) -> Reduction:
    """Return the model of fewer states by balanced truncation, with the bound 2 sum(removed Hankel values) on its error.

    order: states that stay, or bound: the largest L-infinity error allowed (in output per input units). match_dc: the
    removed states are put at rest instead of left out (singular perturbation, Liu and Anderson 1989): the dc gain stays
    what it is, the bound is the same and the error lies at high frequencies. Modes that are not stable are split off and
    kept whole. Raises LinearizationError for an order out of range or where a hidden mode is not stable.
    """
    source = minimal(model)
    a, b, c, d = source.model.standard()
    a, b, c, kept = _stable_last(a, b, c)
    stable = a[kept:, kept:]
    values, left, right = hankel(stable, b[kept:], c[:, kept:])
    tails = 2.0 * np.concatenate([np.cumsum(values[::-1])[::-1], [0.0]])
    if order is None:
        if bound is None:
            raise LinearizationError(
                "neither an order nor a bound", where="balanced reduction", hint="give one of them"
            )
        order = kept + int(np.argmax(tails <= bound))
    if not kept <= order <= kept + values.size:
        unstable = f" ({kept} of them are not stable and stay)" if kept else ""
        raise LinearizationError(
            "the order is out of range", where=f"balanced reduction of linear model '{model.name}'",
            expected=f"{kept} to {kept + values.size}{unstable}", got=f"{order}",
        )  # fmt: skip
    usable = int((values > 1e-14 * values[0]).sum()) if values.size else 0
    count = min(order - kept, usable)
    size = usable if match_dc else count
    scale = 1.0 / np.sqrt(values[:size])
    w, t = left[:, :size] * scale, right[:, :size] * scale
    inner = w.T @ stable @ t, w.T @ b[kept:], c[:, kept:] @ t, d
    a_, b_, c_, d_ = _residualised(*inner, count) if match_dc else inner
    reduced = _renamed(
        source.model,
        scipy.linalg.block_diag(a[:kept, :kept], a_),
        np.concatenate([b[:kept], b_]),
        np.concatenate([c[:, :kept], c_], axis=1),
        d_,
        "balanced",
    )
    all_poles = np.concatenate([np.linalg.eigvals(a[:kept, :kept]), np.linalg.eigvals(stable)])
    left_over = np.linalg.eigvals(reduced.A) if reduced.A.size else np.zeros(0)
    gone = [
        complex(v) for v in all_poles if not left_over.size or np.abs(left_over - v).min() > 1e-9 * max(1.0, abs(v))
    ]
    parts = (
        _renamed(source.model, stable, b[kept:], c[:, kept:], d, "stable part"),
        _renamed(source.model, a_, b_, c_, d_, "balanced"),
    )
    hankel_values = tuple(float(v) for v in values)
    return Reduction(reduced, (*source.removed, *gone), hankel_values, float(tails[count]), kept, match_dc, parts)


def reduced(
    model: LinearModel, order: int | None = None, tolerance: float | None = None, *, match_dc: bool = False
) -> Reduction:
    """Return a balanced model of fewer states: so many, or as few as keep the error within the tolerance. See `balanced`."""
    return balanced(model, order, tolerance, match_dc=match_dc)


def _stable_last(a: Array, b: Array, c: Array) -> tuple[Array, Array, Array, int]:
    """Return a block diagonal with the modes that are not stable first, B and C to match, and the number of their states."""
    if a.shape[0] == 0:
        return a, b, c, 0
    poles = np.linalg.eigvals(a)
    stable = (poles.real < 0) & ~on_axis(poles, a)
    if stable.all():
        return a, b, c, 0
    # The Schur form is ordered by a real part between the two groups, and the coupling removed by a Sylvester equation.
    edge = 0.5 * (poles[~stable].real.min() + poles[stable].real.max(initial=poles[~stable].real.min() - 1.0))
    t, basis, kept = scipy.linalg.schur(a, output="real", sort=lambda re, im=0.0: re > edge)
    if kept == a.shape[0]:
        return t, basis.T @ b, c @ basis, kept
    x = scipy.linalg.solve_sylvester(t[:kept, :kept], -t[kept:, kept:], -t[:kept, kept:])
    right = basis.copy()
    right[:, kept:] += basis[:, :kept] @ x
    left = basis.T.copy()
    left[:kept] -= x @ basis.T[kept:]
    return scipy.linalg.block_diag(t[:kept, :kept], t[kept:, kept:]), left @ b, c @ right, kept


def _residualised(a: Array, b: Array, c: Array, d: Array, count: int) -> tuple[Array, Array, Array, Array]:
    """Return the first states of a balanced model, the others at rest."""
    if count == a.shape[0]:
        return a, b, c, d
    fast = a[count:, count:]
    slow, drive = np.linalg.solve(fast, a[count:, :count]), np.linalg.solve(fast, b[count:])
    first = a[:count, count:]
    return (
        a[:count, :count] - first @ slow,
        b[:count] - first @ drive,
        c[:, :count] - c[:, count:] @ slow,
        d - c[:, count:] @ drive,
    )


def same_channels(first: LinearModel, second: LinearModel) -> None:
    """Raise LinearizationError where two models differ in their number of inputs or outputs."""
    shapes = [(len(m.output_names), len(m.input_names)) for m in (first, second)]
    if shapes[0] != shapes[1]:
        raise LinearizationError(
            "the models have other inputs or outputs",
            where=f"'{first.name}' against '{second.name}'",
            expected=f"{shapes[0][0]} outputs and {shapes[0][1]} inputs",
            got=f"{shapes[1][0]} and {shapes[1][1]}",
        )


def difference(first: LinearModel, second: LinearModel) -> LinearModel:
    """Return the model first - second, delays in their Pade form. Raises LinearizationError where the sizes differ."""
    same_channels(first, second)
    a1, b1, c1, d1 = without_sliding_means(first)
    a2, b2, c2, d2 = without_sliding_means(second)
    return first.with_matrices(
        scipy.linalg.block_diag(a1, a2) if a1.size or a2.size else np.zeros((0, 0)),
        np.concatenate([b1, b2]),
        np.concatenate([c1, -c2], axis=1),
        d1 - d2,
        point=None,
        name=f"{first.name} - {second.name}",
    )


# --- norms ---


AXIS = 1e-2
"""Share of its size by which an imaginary eigenvalue of a Hamiltonian matrix may be off the axis in floating point."""


@dataclass(frozen=True)
class Peak(Coded):
    """The largest singular value over all frequencies and where it is, rad/s (0 and infinity are places)."""

    value: float
    omega: float = float("inf")


def linf_norm(model: LinearModel, tolerance: float = 1e-13) -> Peak:
    """Return the L-infinity norm, max over w of the largest singular value of G(jw), stable or not.

    From the largest value on a grid, two-step bisection on the imaginary eigenvalues of the Hamiltonian matrix (Bruinsma and
    Steinbuch 1990), which needs no stability; a model with delays is searched on its exact response instead. Raises
    LinearizationError where a pole that the inputs reach and the outputs see lies on the imaginary axis: the norm is infinite.
    """
    if model.exact is not None:
        return _linf_of_delays(model)
    a, b, c, d = _clear_of_axis(model)

    def gains(w: Array) -> Array:
        """The largest singular value at each frequency."""
        if not a.shape[0] or not d.size:
            return np.full(w.size, float(np.linalg.norm(d, 2)) if d.size else 0.0)
        inner = 1j * w[:, None, None] * np.eye(a.shape[0]) - a
        values = c @ np.linalg.solve(inner, np.broadcast_to(b.astype(complex), (w.size, *b.shape))) + d
        return np.asarray(np.linalg.svd(values, compute_uv=False)[:, 0])

    def peak(w: Array) -> tuple[float, float]:
        found = gains(w)
        k = int(np.argmax(found))
        return float(found[k]), float(w[k])

    poles = np.linalg.eigvals(a) if a.shape[0] else np.zeros(0)
    top = float(np.linalg.norm(d, 2)) if d.size else 0.0
    first = np.concatenate([[0.0], np.abs(poles), np.abs(poles.imag), wide_omega(model)])
    best, where = max((top, float("inf")), peak(first))
    if best == 0.0:
        return Peak(0.0, 0.0)
    for _ in range(60):
        crossings = _axis_crossings(a, b, c, d, best * (1.0 + 2.0 * max(tolerance, 1e-12)))
        if crossings.size < 2:
            break
        value, w = peak(np.concatenate([crossings, 0.5 * (crossings[:-1] + crossings[1:])]))
        if value <= best * (1.0 + tolerance):
            break
        best, where = value, w
    return refined(lambda w: float(gains(np.array([w]))[0]), best, where)


def _clear_of_axis(model: LinearModel) -> tuple[Array, Array, Array, Array]:
    """Return A, B, C, D without poles on the imaginary axis: the model scaled, or where it has such hidden ones the visible part.

    The bases that show what is hidden are orthogonal, and mix states of very different sizes: the model's own keep the
    digits. Raises LinearizationError for a pole on the axis that the inputs reach and the outputs see.
    """
    a, b, c, d = without_sliding_means(model)
    a, b, c = scaled_states(a, b, c)
    if on_axis(np.linalg.eigvals(a), a).any():
        a, b, c, d = visible(model)
    poles = np.linalg.eigvals(a) if a.shape[0] else np.zeros(0)
    axis = poles[on_axis(poles, a)]
    if axis.size:
        raise LinearizationError(
            "the L-infinity norm is infinite: a pole lies on the imaginary axis",
            where=f"linear model '{model.name}'",
            got=f"eigenvalue {axis[0]:.6g}",
            hint="compare with nu_gap, which takes integrators",
        )
    return a, b, c, d


def hinf_norm(model: LinearModel, tolerance: float = 1e-13) -> Peak:
    """Return the H-infinity norm: the L-infinity norm of a stable model.

    Raises LinearizationError where a pole that inputs reach and outputs see is not stable.
    """
    if model.exact is not None:
        _refuse_unstable(model, "an unstable model has no H-infinity norm")
        return linf_norm(model, tolerance)
    a = visible(model)[0]
    poles = np.linalg.eigvals(a) if a.shape[0] else np.zeros(0)
    if ((poles.real >= 0) | on_axis(poles, a)).any():
        raise LinearizationError(
            "an unstable model has no H-infinity norm",
            where=f"linear model '{model.name}'",
            got=f"eigenvalue {poles[np.argmax(poles.real)]:.6g}",
            hint="linf_norm takes unstable models without poles on the imaginary axis, nu_gap any",
        )
    return linf_norm(model, tolerance)


def _refuse_unstable(model: LinearModel, what: str) -> None:
    """Raise LinearizationError where a model with delays is not stable, or cannot be told to be, between inputs and outputs."""
    assert model.exact is not None
    found = stability(model.characteristic.visible())
    if found.verdict != "stable":
        raise LinearizationError(
            what, where=f"linear model '{model.name}'", got=f"{found.verdict}: {found.reason or found.count_text}"
        )


def _linf_of_delays(model: LinearModel) -> Peak:
    """Return the L-infinity norm of a model with delays, on a grid of its exact response and beside the largest value."""
    assert model.exact is not None
    equation = model.characteristic.visible()
    if equation.roots.axis > sliding_means(equation):
        raise LinearizationError(
            "the L-infinity norm is infinite: a pole lies on the imaginary axis", where=f"linear model '{model.name}'"
        )
    grid = np.concatenate([[0.0], wide_omega(model, 4000)])
    return peak_over(lambda w: np.linalg.svd(transfer(model, 1j * w), compute_uv=False)[:, 0], grid)


def h2_norm(model: LinearModel) -> float:
    """Return the H2 norm, by a Gramian. Raises LinearizationError where it is infinite: unstable, or D not 0.

    Delays stand as their Pade approximants in the value, not in the verdict on stability.
    """
    if model.exact is not None:
        _refuse_unstable(model, "the H2 norm is infinite: the model is not stable")
    a, b, c, d = visible(model)
    if np.any(d):
        raise LinearizationError("the H2 norm is infinite: D is not 0", where=f"linear model '{model.name}'")
    if a.shape[0] == 0:
        return 0.0
    poles = np.linalg.eigvals(a)
    if ((poles.real >= 0) | on_axis(poles, a)).any():
        raise LinearizationError(
            "the H2 norm is infinite: the model is not stable"
            if model.exact is None
            else "the H2 norm is not known: the model is stable, and its delays' Pade approximants are not",
            where=f"linear model '{model.name}'",
        )
    gramian = scipy.linalg.solve_continuous_lyapunov(a, -b @ b.T)
    return float(np.sqrt(max(np.trace(c @ gramian @ c.T), 0.0)))


def norms(model: LinearModel) -> dict[str, Any]:
    """Return H2, H-infinity and L-infinity norms as plain numbers; of one that does not exist, None and the reason."""
    found: dict[str, Any] = {}
    for name, norm in (("h2", h2_norm), ("hinf", hinf_norm), ("linf", linf_norm)):
        try:
            value = norm(model)
        except LinearizationError as e:
            found[name] = None
            found[f"{name}_reason"] = e.what
        else:
            found[name] = value.to_dict() if isinstance(value, Peak) else value
    return found


def _axis_crossings(a: Array, b: Array, c: Array, d: Array, level: float) -> Array:
    """Return frequencies among which are all at which a singular value equals the level.

    They are imaginary parts of imaginary eigenvalues of the Hamiltonian matrix, here of those within `AXIS` of the axis: more
    than rounding moves them. One that is none does no harm, for the gain is computed there.
    """
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


def refined(gain: Callable[[float], float], best: float, where: float) -> Peak:
    """Return the peak near a frequency at which the gain is already known to be `best`."""
    if not 0.0 < where < np.inf:
        return Peak(best, where)
    found = minimize_scalar(
        lambda x: -gain(float(np.exp(x))), bounds=(np.log(where) - NEAR, np.log(where) + NEAR), method="bounded",
        options={"xatol": 1e-12},
    )  # fmt: skip
    return Peak(-float(found.fun), float(np.exp(found.x))) if -found.fun > best else Peak(best, where)


def peak_over(values: Callable[[Array], Array], grid: Array) -> Peak:
    """Return the largest of some positive values over the frequencies of a grid, refined beside the largest."""
    found = values(grid)
    k = int(np.argmax(found))
    return refined(lambda w: float(values(np.array([w]))[0]), float(found[k]), float(grid[k]))
