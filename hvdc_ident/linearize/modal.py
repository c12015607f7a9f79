"""Modes of a linear model: eigenvalues with damping and frequency, participation, shapes, names and derivatives by parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from hvdc_ident.codec import INLINE
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize import delayed_modes
from hvdc_ident.linearize.characteristic import reaches
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.mode import Mode, damping_of, kind_of_mode
from hvdc_ident.linearize.stability import Stability, stability
from hvdc_ident.linearize.system import Array
from hvdc_ident.model import Model


def poles(model: LinearModel) -> Array:
    """Return (n,) complex poles by falling real part, rad/s, hidden ones among them; for a descriptor the finite eigenvalues.

    Of a model with delays the rightmost roots of its exact characteristic equation.
    """
    return model.characteristic.roots.values


def stability_of(model: LinearModel) -> Stability:
    """Return whether a model is stable: with delays by its characteristic equation, else by its eigenvalues."""
    return stability(model.characteristic)


def eigen(a: Array) -> tuple[Array, Array, Array]:
    """Return (eigenvalues, right vectors in columns, left vectors in rows) with left @ right = 1.

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
    """Every mode of a model, by falling real part; conjugates follow each other, the upper one first.

    A model with delays has infinitely many; these are the rightmost ones, at least as many as it has states.
    """
    if model.exact is not None:
        return delayed_modes.modes(model)
    names = model.state_names
    if model.is_descriptor:
        a, b, c, d = model.standard()
        names = names[: a.shape[0]]
        model = replace(model.with_matrices(a, b, c, d), state_names=names)
    if model.A.shape[0] == 0:
        return ()
    values, right, left = eigen(model.A)
    slopes = {n: sensitivities(values, right, left, g.A) for n, g in model.gradients.items()}
    share = np.abs(left.T * right)
    share = share / np.maximum(share.sum(axis=0), 1e-300)
    values = at_rest(values, model.characteristic.roots.values)
    order = sorted(
        range(values.size), key=lambda k: (-round(float(values[k].real), 9), abs(values[k].imag), -values[k].imag)
    )
    every = []
    for k in order:
        v = right[:, k] / right[np.argmax(np.abs(right[:, k])), k]
        every.append(
            Mode(
                complex(values[k]),
                abs(float(values[k].imag)) / (2 * np.pi),
                damping_of(complex(values[k])),
                FrozenMap(zip(names, (float(x) for x in share[:, k]), strict=True)),
                FrozenMap(zip(names, (complex(x) for x in v), strict=True)),
                FrozenMap({n: complex(s[k]) for n, s in slopes.items()}),
                _kind(model, complex(values[k]), right[:, k], left[k]),
            )
        )
    return tuple(every)


def at_rest(values: Array, roots: Array) -> Array:
    """Return eigenvalues of a whole matrix, those nearest to 0 made 0: as many as roots of its parts are."""
    values = values.copy()
    values[np.argsort(np.abs(values), kind="stable")[: np.count_nonzero(roots == 0)]] = 0.0
    return values


def _kind(model: LinearModel, value: complex, right: Array, left: Array) -> str:
    """Return the kind of a mode; a zero eigenvalue whose state is held by a limit is a saturated state."""
    right, left = right / np.linalg.norm(right), left / np.linalg.norm(left)
    driven, seen = reaches(left @ model.B, model.B), reaches(model.C @ right, model.C)
    hidden = value == 0 and not (driven and seen)
    held = hidden and model.point is not None and model.point.active_limits
    if held and not model.A[int(np.argmax(np.abs(right)))].any():
        return "saturated state"
    return kind_of_mode(value, driven, seen)


def sensitivities(values: Array, right: Array, left: Array, da: Array) -> Array:
    """Return (n,) d(lambda)/dp for a derivative of A: w' dA v, and in a cluster of equal eigenvalues those of the block.

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


# --- names ---

SHARE = 0.5
"""A part names a mode where it takes part at least so much as the part that takes part most."""


@dataclass(frozen=True, eq=False)
class NamedMode:
    """A mode, the parts that name it joined by " + ", and the participation of each part (they sum to 1)."""

    mode: Mode = field(metadata=INLINE)
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
