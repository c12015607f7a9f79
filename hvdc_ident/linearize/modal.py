"""Modes, zeros and transfer functions of a linear model.

Eigenvalues with damping and frequency, participation, shapes and derivatives by parameters; zeros from the system matrix,
never from polynomials; transfer functions as zeros, poles and gain.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg

from hvdc_ident.errors import LinearizationError, unknown_name
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize.matrices import Array

if TYPE_CHECKING:
    from hvdc_ident.linearize.linear_model import Gradient, LinearModel
    from hvdc_ident.model import Model

ZERO = 1e-8
"""An eigenvalue below this share of the fastest one (or of 1 rad/s) counts as zero."""


@dataclass(frozen=True, eq=False)
class Mode:
    """One eigenvalue in rad/s with what it means.

    frequency_hz: of the oscillation, 0 for a real one. damping: -Re/|lambda|, 0 for a zero eigenvalue.
    participation: share of each state, they sum to 1. shape: the right eigenvector, its largest entry 1.
    sensitivity: d(lambda)/dp by parameter. kind: "oscillation", "decay", "growth", "growing oscillation",
    or what a zero eigenvalue is: "free integrator", "hidden integrator" (nothing reaches it), "saturated state", "angle
    reference or unobserved integrator", "undriven integrator", "sliding mean (cancelled by its delay)".
    """

    eigenvalue: complex
    frequency_hz: float
    damping: float
    participation: FrozenMap[float]
    shape: FrozenMap[complex]
    sensitivity: FrozenMap[complex]
    kind: str

    @property
    def time_constant(self) -> float:
        """1/|Re lambda| in s, infinite on the imaginary axis."""
        return 1.0 / abs(self.eigenvalue.real) if self.eigenvalue.real else float("inf")

    @property
    def dominant(self) -> str:
        """The state that takes part most."""
        return max(self.participation, key=lambda n: self.participation[n])

    def to_dict(self) -> dict[str, Any]:
        """The mode as plain numbers."""
        pair = {n: [v.real, v.imag] for n, v in self.sensitivity.items()}
        return {
            "eigenvalue": [self.eigenvalue.real, self.eigenvalue.imag],
            "frequency_hz": self.frequency_hz,
            "damping": self.damping,
            "participation": dict(self.participation),
            "kind": self.kind,
            **({"sensitivity": pair} if pair else {}),
        }


def poles(model: LinearModel) -> Array:
    """(n,) complex eigenvalues, rad/s; for a descriptor those of the pencil without the infinite ones."""
    if model.A.shape[0] == 0:
        return np.zeros(0, dtype=complex)
    if not model.is_descriptor:
        return np.asarray(np.linalg.eigvals(model.A), dtype=complex)
    alpha, beta = scipy.linalg.eigvals(model.A, model.E, homogeneous_eigvals=True)
    return np.asarray(alpha[finite(alpha, beta)] / beta[finite(alpha, beta)], dtype=complex)


def finite(alpha: Array, beta: Array) -> Array:
    """Which of the generalised eigenvalues alpha/beta are finite."""
    return np.asarray(np.abs(beta) > 1e-10 * np.maximum(np.abs(alpha), np.abs(beta)).clip(1e-300) * 1e-2)


def eigen(a: Array) -> tuple[Array, Array, Array]:
    """(eigenvalues, right vectors in columns, left vectors in rows) with left @ right = 1.

    The left ones are the inverse of the right ones where that is well conditioned, else LAPACK's own.
    """
    values, right = np.linalg.eig(a)
    with np.errstate(all="ignore"):
        try:
            left = np.linalg.inv(right)
        except np.linalg.LinAlgError:
            left = np.full(right.shape, np.inf, dtype=complex)
    if not np.isfinite(left).all() or np.abs(left).max(initial=0.0) > 1e12:
        left = np.linalg.pinv(right, rcond=1e-12)
    return values.astype(complex), right.astype(complex), left.astype(complex)


def modes(model: LinearModel) -> tuple[Mode, ...]:
    """Every mode of a model, by falling real part; conjugates follow each other, the upper one first."""
    from dataclasses import replace

    names = model.state_names
    if model.is_descriptor:
        a, b, c, d = model.standard()
        names = names[: a.shape[0]]
        model = replace(
            model,
            A=a,
            B=b,
            C=c,
            D=d,
            E=np.eye(a.shape[0]),
            state_names=names,
            state_units=(),
            x0=model.x0[: len(names)],
        )
    if model.A.shape[0] == 0:
        return ()
    values, right, left = eigen(model.A)
    slopes = {n: sensitivities(values, right, left, g.A) for n, g in model.gradients.items()}
    share = np.abs(left.T * right)
    share = share / np.maximum(share.sum(axis=0), 1e-300)
    zero = ZERO * max(1.0, float(np.abs(values).max()))
    order = sorted(
        range(values.size), key=lambda k: (-round(float(values[k].real), 9), abs(values[k].imag), -values[k].imag)
    )
    found = []
    for k in order:
        v = right[:, k] / right[np.argmax(np.abs(right[:, k])), k]
        found.append(
            Mode(
                complex(values[k]),
                abs(float(values[k].imag)) / (2 * np.pi),
                0.0 if abs(values[k]) <= zero else float(-values[k].real / abs(values[k])),
                FrozenMap(zip(names, (float(x) for x in share[:, k]), strict=True)),
                FrozenMap(zip(names, (complex(x) for x in v), strict=True)),
                FrozenMap({n: complex(s[k]) for n, s in slopes.items()}),
                _kind(model, complex(values[k]), right[:, k], left[k], zero),
            )
        )
    return tuple(found)


def _kind(model: LinearModel, value: complex, right: Array, left: Array, zero: float) -> str:
    if abs(value) <= zero:
        driven = np.abs(left @ model.B).max(initial=0.0) > 1e-9 * np.abs(left).max() * np.abs(model.B).max(
            initial=1e-300
        )
        seen = np.abs(model.C @ right).max(initial=0.0) > 1e-9 * np.abs(right).max() * np.abs(model.C).max(
            initial=1e-300
        )
        if driven and seen:
            return "free integrator"
        if model.delay_free is not None:
            return "sliding mean (cancelled by its delay)"
        return _hidden(model, right, bool(driven), bool(seen))
    if value.imag:
        return "oscillation" if value.real <= 0 else "growing oscillation"
    return "decay" if value.real < 0 else "growth"


def _hidden(model: LinearModel, right: Array, driven: bool, seen: bool) -> str:
    """A zero eigenvalue that the chosen inputs and outputs do not both reach."""
    if model.point is not None and model.point.active_limits:
        state = model.state_names[int(np.argmax(np.abs(right)))]
        row = model.A[model.state_names.index(state)]
        if not row.any():
            return "saturated state"
    if not driven and not seen:
        return "hidden integrator"
    return "angle reference or unobserved integrator" if driven else "undriven integrator"


def sensitivities(values: Array, right: Array, left: Array, da: Array) -> Array:
    """(n,) d(lambda)/dp for a derivative of A: w' dA v, and in a cluster of equal eigenvalues those of the block.

    A defective cluster has no derivative (it moves like a root): each of its members gets the mean of the cluster.
    """
    slope = np.einsum("ki,ij,jk->k", left, da, right)
    scale = 1e-7 * max(1.0, float(np.abs(values).max(initial=0.0)))
    done = np.zeros(values.size, dtype=bool)
    for k in range(values.size):
        cluster = np.flatnonzero((np.abs(values - values[k]) < min(scale, 1e-6 * max(1.0, abs(values[k])))) & ~done)
        if cluster.size < 2:
            continue
        done[cluster] = True
        block = left[cluster] @ da @ right[:, cluster]
        sound = np.linalg.norm(left[cluster], axis=1).max() * np.linalg.norm(right[:, cluster], axis=0).max() < 1e6
        slope[cluster] = np.linalg.eigvals(block) if sound else np.trace(block) / cluster.size
    return np.asarray(slope)


def gradient_of(model: LinearModel, parameter: str) -> Gradient:
    """The derivatives of A, B, C, D by a parameter; raises where the model was linearised without it."""
    if parameter not in model.gradients:
        if model.point is not None and parameter in model.point.parameters:
            raise LinearizationError(
                f"the derivatives by '{parameter}' were not asked for",
                where=f"linear model '{model.name}'",
                hint=f"linearize(..., sensitivities=['{parameter}'])",
            )
        raise unknown_name("parameter", parameter, model.gradients, where=f"linear model '{model.name}'")
    return model.gradients[parameter]


# --- names ---

SHARE = 0.5
"""A part names a mode where it takes part at least so much as the part that takes part most."""


@dataclass(frozen=True, eq=False)
class NamedMode:
    """A mode, the parts that name it joined by " + ", and the participation of each part (they sum to 1)."""

    mode: Mode
    name: str
    parts: FrozenMap[float]


def parts_of(model: Model) -> FrozenMap[str]:
    """Return the part of each state: its description, or its name where it has none; a delay belongs to the state it feeds."""
    parts = {name: s.description or name for name, s in model.states.items()}
    for delay in (*model.delays, *model.sampled):
        fed = [n for n, s in model.states.items() if any(v.name == delay for v in s.derivative.free_symbols)]
        parts[delay] = parts[fed[0]] if fed else delay
    return FrozenMap(parts)


def named_modes(linear: LinearModel, parts: Mapping[str, str]) -> tuple[NamedMode, ...]:
    """Return the modes of a linear model with their names; of a conjugate pair the upper one.

    parts: the part of each state, as `parts_of` gives it. States of a delay's approximant go with the delay.
    """
    return tuple(named(mode, parts) for mode in linear.modes() if mode.eigenvalue.imag >= 0)


def named(mode: Mode, parts: Mapping[str, str]) -> NamedMode:
    """Return a mode with the name that the parts which take part in it most give it."""
    shares: dict[str, float] = {}
    for state, share in mode.participation.items():
        part = parts.get(state) or parts.get(state.split(".")[0], state)
        shares[part] = shares.get(part, 0.0) + share
    ranked = sorted(shares.items(), key=lambda item: -item[1])
    name = " + ".join(part for part, share in ranked if share >= SHARE * ranked[0][1])
    return NamedMode(mode, name, FrozenMap(ranked))


RANK = 1e-11
"""Singular values below this share of the largest count as 0 when ranks are decided."""


def zeros(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Return the finite invariant zeros, complex, rad/s: infinite ones are deflated by orthogonal steps beforehand.

    Emami-Naeini and Van Dooren 1982 (doi 10.1016/0005-1098(82)90070-X): rank decisions on a balanced system, then a
    generalised eigenproblem. A system without any path from input to output has none by this definition.
    """
    if a.shape[0] == 0 or b.shape[1] == 0 or c.shape[0] == 0:
        return np.zeros(0, dtype=complex)
    a, b, c, d = _balanced(a, b, c, d)
    a, b, c, d = _deflate(a, b, c, d)
    a, b, c, d = _deflate(a.T, c.T, b.T, d.T)
    n, m = a.shape[0], d.shape[1]
    if n == 0 or m == 0 or d.shape[0] != m:
        return np.zeros(0, dtype=complex)
    # Compress the columns of [C D]: what remains is a square pencil of the zeros alone.
    q = scipy.linalg.qr(np.concatenate([d, c], axis=1).T[::-1], mode="full")[0]
    stacked = np.concatenate([b, a], axis=1)
    basis = q[::-1][:, m:]
    left = stacked @ basis
    right = np.concatenate([np.zeros((n, m)), np.eye(n)], axis=1) @ basis
    alpha, beta = scipy.linalg.eig(left, right, right=False, homogeneous_eigvals=True)
    keep = np.abs(beta) > 1e-13 * np.maximum(np.abs(alpha), 1.0)
    return np.asarray(alpha[keep] / beta[keep], dtype=complex)


def _balanced(a: Array, b: Array, c: Array, d: Array) -> tuple[Array, Array, Array, Array]:
    """Return the system with states, inputs and outputs scaled so that rows and columns are alike in size."""
    n, m, o = a.shape[0], b.shape[1], c.shape[0]
    whole = np.block([[a, b], [c, d]])
    t, rows, columns = np.ones(n), np.ones(o), np.ones(m)
    for _ in range(8):
        for k in range(n):
            row = np.abs(np.delete(whole[k], k)).sum()
            column = np.abs(np.delete(whole[:, k], k)).sum()
            if row > 0 and column > 0:
                factor = 2.0 ** round(np.log2(np.sqrt(column / row)))
                whole[k] *= factor
                whole[:, k] /= factor
                t[k] /= factor
        for k in range(m):
            size = np.abs(whole[:, n + k]).max()
            if size > 0:
                factor = 2.0 ** round(np.log2(size))
                whole[:, n + k] /= factor
                columns[k] *= factor
        for k in range(o):
            size = np.abs(whole[n + k]).max()
            if size > 0:
                factor = 2.0 ** round(np.log2(size))
                whole[n + k] /= factor
                rows[k] *= factor
    return whole[:n, :n], whole[:n, n:], whole[n:, :n], whole[n:, n:]


def _rank(values: Array, scale: float) -> int:
    return int((values > RANK * scale).sum())


def _deflate(a: Array, b: Array, c: Array, d: Array) -> tuple[Array, Array, Array, Array]:
    """The system with D of full row rank and the same zeros."""
    while True:
        n, o = a.shape[0], c.shape[0]
        scale = max(float(np.abs(np.block([[b], [d]])).max(initial=0.0)), 1e-300) if d.size else 1.0
        if o == 0 or n == 0:
            return a, b, c, d
        u, values, _ = np.linalg.svd(d) if d.shape[1] else (np.eye(o), np.zeros(0), None)
        r = _rank(values, scale)
        if r == o:
            return a, b, c, d
        c, d = u.T @ c, u.T @ d
        c_low = c[r:]
        v = np.linalg.svd(c_low)
        k = _rank(v[1], max(float(np.abs(c).max(initial=0.0)), float(np.abs(a).max(initial=0.0)) * 1e-3, 1e-300))
        if k == 0:
            return a, b, c[:r], d[:r]
        # The first n - k columns span the null space of the low part of C.
        basis = np.concatenate([v[2].T[:, k:], v[2].T[:, :k]], axis=1)
        at, bt, ct = basis.T @ a @ basis, basis.T @ b, c @ basis
        keep = n - k
        a = at[:keep, :keep]
        c = np.concatenate([ct[:r, :keep], at[keep:, :keep]])
        b, d = bt[:keep], np.concatenate([d[:r], bt[keep:]])


@dataclass(frozen=True, eq=False)
class TransferFunction:
    """gain * prod(s - zeros) / prod(s - poles), s in rad/s; cancelled: (pole, zero) pairs that were left out."""

    input: str
    output: str
    zeros: Array
    poles: Array
    gain: float
    cancelled: tuple[tuple[complex, complex], ...] = ()

    def __call__(self, s: complex | Array) -> Array:
        """The value at complex frequencies s."""
        s = np.asarray(s, dtype=complex)
        top = np.prod(s[..., None] - self.zeros, axis=-1)
        return np.asarray(self.gain * top / np.prod(s[..., None] - self.poles, axis=-1))

    @property
    def dc_gain(self) -> float:
        """The value at s = 0; infinite with a pole there."""
        if (self.poles == 0).any():
            return float("inf")
        return float(self(0.0).real)

    def to_dict(self) -> dict[str, Any]:
        """The transfer function as plain numbers, complex ones as [re, im]."""

        def pairs(values: Array) -> list[list[float]]:
            return [[float(v.real), float(v.imag)] for v in values]

        return {
            "input": self.input,
            "output": self.output,
            "zeros": pairs(self.zeros),
            "poles": pairs(self.poles),
            "gain": self.gain,
            "cancelled": [[[p.real, p.imag], [z.real, z.imag]] for p, z in self.cancelled],
        }


def transfer_function(model: LinearModel, input: str, output: str) -> TransferFunction:
    """Return zeros, poles and gain of one channel; stable pole-zero pairs that cancel are left out and listed.

    An unstable pair is never cancelled. A channel without a path is 0: no zeros, no poles, gain 0.
    """
    from hvdc_ident.linearize.reduce import uncontrollable_unobservable

    part = model.channel(input, output)
    a, b, c, d = part.standard()
    if not _connected(a, b, c, d):
        none = np.zeros(0, dtype=complex)
        return TransferFunction(input, output, none, none, 0.0)
    all_poles, all_zeros = np.linalg.eigvals(a).astype(complex), zeros(a, b, c, d)
    hidden = uncontrollable_unobservable(a, b, c)
    kept_poles, kept_zeros, cancelled = _cancel(all_poles, all_zeros, hidden)
    gain = _gain(a, b, c, d, kept_zeros, kept_poles)
    return TransferFunction(input, output, _paired(kept_zeros), _paired(kept_poles), gain, tuple(cancelled))


def _connected(a: Array, b: Array, c: Array, d: Array) -> bool:
    if np.any(d):
        return True
    reached = np.any(b != 0, axis=1)
    for _ in range(a.shape[0]):
        reached = reached | (np.abs(a) @ reached > 0)
    return bool((np.abs(c) @ reached > 0).any())


def _cancel(poles: Array, zeros_: Array, hidden: Array) -> tuple[Array, Array, list[tuple[complex, complex]]]:
    """Poles and zeros without the pairs that stand for a hidden, stable mode."""
    left, pairs = list(zeros_), []
    kept = []
    candidates = list(hidden)
    for p in poles:
        match = min(candidates, key=lambda h: abs(h - p), default=None)
        near = min(range(len(left)), key=lambda k: abs(left[k] - p), default=None)
        close = 1e-6 * max(1.0, abs(p))
        if (
            match is not None
            and abs(match - p) < close
            and near is not None
            and abs(left[near] - p) < close
            and p.real < 0
        ):
            candidates.remove(match)
            pairs.append((complex(p), complex(left.pop(near))))
        else:
            kept.append(p)
    return np.array(kept, dtype=complex), np.array(left, dtype=complex), pairs


def _paired(values: Array) -> Array:
    """Sorted by size; rounding's imaginary parts removed."""
    values = np.where(np.abs(values.imag) < 1e-13 * np.abs(values), values.real, values)
    return np.asarray(values[np.lexsort((-values.imag, values.real, np.abs(values).round(12)))], dtype=complex)


def _gain(a: Array, b: Array, c: Array, d: Array, zeros_: Array, poles: Array) -> float:
    """The leading coefficient, from values of the transfer function at points away from every pole and zero."""
    sizes = np.abs(np.concatenate([poles, zeros_, [1.0 + 0j]]))
    typical = float(np.exp(np.log(np.maximum(sizes, 1e-3)).mean()))
    found, eye = [], np.eye(a.shape[0])
    for angle in (0.31, 0.77, 1.23):
        s = 1.7 * typical * np.exp(1j * angle)
        value = (c @ np.linalg.solve(s * eye - a, b) + d)[0, 0]
        log = np.log(value) + np.log(s - poles).sum() - np.log(s - zeros_).sum() if value != 0 else -np.inf
        found.append(float(np.exp(log).real))
    return float(np.median(found))
