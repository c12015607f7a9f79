"""Zeros, poles and gain of a channel of a linear model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.codec import Coded
from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize.delays import eliminate
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.realisation import approximate_visible, kalman, scaled_states, without_sliding_means
from hvdc_ident.linearize.system import Array
from hvdc_ident.linearize.zeros import zeros


@dataclass(frozen=True, eq=False)
class TransferFunction(Coded):
    """gain * prod(s - zeros) / prod(s - poles), s in rad/s; cancelled: (pole, zero) pairs that were left out.

    dc_gain: the value at s = 0, infinite with a pole there; modes that the input does not reach or the output does not
    see are no poles of it, though an integrator among them stays in `poles` and `zeros`. approximated: the delays that stand in it as
    Pade approximants, whose zeros and poles are none of the model's; `LinearModel.zeros` and `poles` have those.
    """

    input: str
    output: str
    zeros: NDArray[np.complex128]
    poles: NDArray[np.complex128]
    gain: float
    dc_gain: float
    cancelled: tuple[tuple[complex, complex], ...] = ()
    approximated: tuple[str, ...] = ()

    def __call__(self, s: complex | Array) -> Array:
        """Return the value at complex frequencies s."""
        s = np.asarray(s, dtype=complex)
        top = np.prod(s[..., None] - self.zeros, axis=-1)
        return np.asarray(self.gain * top / np.prod(s[..., None] - self.poles, axis=-1))


def transfer_function(model: LinearModel, input: str | None = None, output: str | None = None) -> TransferFunction:
    """Return zeros, poles and gain from an input to an output; stable pole-zero pairs that cancel are left out and listed.

    The names may be left out where there is only one. An unstable pair is never cancelled. A channel without a path is 0: no
    zeros, no poles, gain 0.
    """
    input, output = (
        input or _only(model, "input", model.input_names),
        output or _only(model, "output", model.output_names),
    )
    part = model.channel(input, output)
    a, b, c, d = part.standard()
    if not _connected(a, b, c, d):
        none = np.zeros(0, dtype=complex)
        return TransferFunction(input, output, none, none, 0.0, 0.0)
    all_poles, all_zeros = np.linalg.eigvals(a).astype(complex), zeros(a, b, c, d)
    hidden = np.concatenate(kalman(*scaled_states(a, b, c))[1])
    kept_poles, kept_zeros, cancelled = _cancel(all_poles, all_zeros, hidden)
    gain = _gain(a, b, c, d, kept_zeros, kept_poles)
    late = () if part.exact is None else tuple(c.name for c in part.exact.channels if c.total > 0.0)
    return TransferFunction(
        input, output, _paired(kept_zeros), _paired(kept_poles), gain, _dc_gain(part), tuple(cancelled), late
    )


def _only(model: LinearModel, kind: str, names: tuple[str, ...]) -> str:
    if len(names) != 1:
        raise LinearizationError(
            f"which {kind}?", where=f"linear model '{model.name}'", expected=f"one of {', '.join(names)}"
        )
    return names[0]


def _dc_gain(channel: LinearModel) -> float:
    """Return D - C A^-1 B; where A is singular that of what the input reaches and the output sees, infinite where it is too."""
    for a, b, c, d in (without_sliding_means(channel), approximate_visible(channel).matrices):
        at_rest = eliminate(np.block([[d, c], [b, a]]), 1, 1)
        if np.isfinite(at_rest.condition):
            return float(at_rest.result[0, 0])
    return float("inf")


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
    """Return the values sorted by size, imaginary parts due to rounding removed."""
    values = np.where(np.abs(values.imag) < 1e-13 * np.abs(values), values.real, values)
    return np.asarray(values[np.lexsort((-values.imag, values.real, np.abs(values).round(12)))], dtype=complex)


def _gain(a: Array, b: Array, c: Array, d: Array, zeros_: Array, poles: Array) -> float:
    """Return the leading coefficient, from values of the transfer function at points away from every pole and zero."""
    sizes = np.abs(np.concatenate([poles, zeros_, [1.0 + 0j]]))
    typical = float(np.exp(np.log(np.maximum(sizes, 1e-3)).mean()))
    gains, eye = [], np.eye(a.shape[0])
    for angle in (0.31, 0.77, 1.23):
        s = 1.7 * typical * np.exp(1j * angle)
        value = (c @ np.linalg.solve(s * eye - a, b) + d)[0, 0]
        log = np.log(value) + np.log(s - poles).sum() - np.log(s - zeros_).sum() if value != 0 else -np.inf
        gains.append(float(np.exp(log).real))
    return float(np.median(gains))
