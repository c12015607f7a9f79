"""Minimal and balanced realisations of linear models.

python-control 0.10.2 with Slycot 0.7.1 was measured (`benchmarks/linear_library.py`): on models whose states differ in their units
by 1e8, as companion forms do, two thirds of its reductions are off by more than 1e-6. Own code scales the states first.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import scipy.linalg

from hvdc_ident.codec import INLINE, Coded, stored_as
from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize.gramians import reached_gramian, seen_gramian
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.norms import Peak, linf_norm
from hvdc_ident.linearize.realisation import TOLERANCE, difference, kalman, scaled_states
from hvdc_ident.linearize.stability import on_axis, with_errors
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
    root_p, root_q = _root(reached_gramian(a, b)), _root(seen_gramian(a, c))
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
    """Return the model of fewer states by balanced truncation, with a bound on its error.

    The bound is 2 sum(removed Hankel values). Modes that are not stable are split off and kept whole.

    Parameters
    ----------
    model : LinearModel
        The whole model, its inputs and outputs in the units in which the error counts (`LinearModel.scaled`).
    order : int, default None
        How many states stay. None: as few as `bound` allows.
    bound : float, default None
        The largest L-infinity error allowed, in output per input units; it counts where no order is given.
    match_dc : bool, default False
        True puts the removed states at rest instead of leaving them out (singular perturbation, Liu and Anderson 1989): the dc gain stays
        what it is, the bound is the same and the error lies at high frequencies.

    Returns
    -------
    Reduction
        `model`, the smaller one; `bound` on its error; `hankel`, the singular values; `removed`, the eigenvalues that went, rad/s.

    Raises
    ------
    LinearizationError
        An order out of range, neither an order nor a bound, or a hidden mode that is not stable.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> whole = hi.linearize("vsc-hvdc-link", inputs="Vdcref1", outputs="Vdc1")
    >>> small = hi.linear.balanced(whole, order=2)
    >>> len(small.model.state_names), small.error.value <= small.bound * (1 + 1e-9)
    (2, True)
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
    poles, off = with_errors(a)
    stable = (poles.real < 0) & ~on_axis(poles, off)
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
