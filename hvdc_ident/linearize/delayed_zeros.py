"""Invariant zeros of a linear model; those of one with delays are roots of the determinant of its exact system matrix.

With the pencil P(s) of states and delays and what the inputs add to it, B(s), the system matrix is [P, -B; C, D]. An input that is chosen
so that an output stays 0 is a delay of 0 s in a loop of gain 1, v = v + y: with it the determinant is that of a `Part`.
"""

from __future__ import annotations

import numpy as np

from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize.characteristic import Part
from hvdc_ident.linearize.delays import Approximants, Channel
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.stability import ALIKE, Characteristic, quartered
from hvdc_ident.linearize.system import Array
from hvdc_ident.linearize.zeros import zeros

ORDERS = (3, 5, 8, 12)
"""Orders of the Pade approximants whose zeros the search begins from; each finds those as far as its phase holds."""
REACH = 8.0
"""Largest |s| times the longest delay within which none is missing: well inside what the highest order's phase holds for."""
TURN = 0.5
"""Largest turn, rad, of the determinant's phase from one point of the circle to the next: a sixth of half a turn, which has no sign."""
CIRCLE_POINTS = 200_000
"""Points of the circle at most."""


def zeros_of(model: LinearModel) -> Array:
    """Return the complex invariant zeros of a whole model, rad/s; delays are exact, see `exact_zeros`.

    A model read from a file has its delays in their Pade form, and the zeros of that.
    """
    if model.exact is None:
        return zeros(*model.standard())
    equation = model.exact.without_zero_delays()
    return exact_zeros(equation) if equation.channels else zeros(*equation.matrices)


def exact_zeros(equation: Characteristic) -> Array:
    """Return the complex invariant zeros of an equation with delays, rad/s, hidden modes among them.

    None is missing with |s| T up to `REACH`, T the longest delay; their number there is counted by the argument principle. Beyond,
    where there may be infinitely many, some are listed. Raises LinearizationError where the count is not reached.
    """
    squares = [_square(equation, seed) for seed in (1, 2)]
    if any(s is None for s in squares):
        return np.zeros(0, dtype=complex)
    part, other = (_part(s) for s in squares if s is not None)
    starts = np.concatenate([zeros(*_approximate(equation, order)) for order in ORDERS])
    longest = float(equation.whole.lengths.max())
    spread = REACH / longest * np.array([0.1, 0.4, 0.9])[:, None] * np.exp(1j * np.pi * (np.arange(12) + 0.5) / 12)
    roots = part.refined(np.concatenate([starts, spread.ravel()]))
    times = [part.multiplicity(v, roots) for v in roots]
    roots = np.repeat(roots, times)
    radius = _clear(roots, REACH / longest)
    inside, counted = int((np.abs(roots) < radius).sum()), _counted(part, radius)
    if inside != counted:
        raise LinearizationError(
            "not every zero is found: with delays they are roots of a transcendental equation",
            expected=f"{counted} with |s| < {radius:.4g} rad/s, by the argument principle", got=f"{inside}",
            hint="the zeros of the Pade approximant: LinearModel.from_dict(model.to_dict()).zeros()",
        )  # fmt: skip
    if other is part:
        return roots
    again = other.refined(roots)
    return np.array(
        [v for v in roots if again.size and np.abs(again - v).min() <= ALIKE * max(abs(v), part.unit)], dtype=complex
    )


def _square(equation: Characteristic, seed: int) -> Characteristic | None:
    """Return the equation with as many inputs as outputs, as its rank has; None where no input reaches an output.

    Of more it has combinations by chance: zeros of all are zeros of the whole, others are of these combinations.
    """
    outputs, inputs = equation.through.shape
    if not outputs or not inputs:
        return None
    rng = np.random.default_rng(7)
    rate = 1.0 / float(equation.whole.lengths.max())
    values = equation.response(rate * (rng.uniform(0.5, 2.0, 3) + 1j * rng.uniform(0.5, 2.0, 3)))
    scaled = values / np.maximum(np.abs(values).max(axis=(0, 2)), 1e-300)[:, None]
    scaled = scaled / np.maximum(np.abs(scaled).max(axis=(0, 1)), 1e-300)
    rank = int(np.max(np.linalg.matrix_rank(scaled, tol=1e-9)))
    if rank == 0:
        return None
    if rank == inputs == outputs:
        return equation
    rng = np.random.default_rng(seed)
    by = 1.0 / np.maximum(np.abs(values).max(axis=(0, 2)), 1e-300)
    left = rng.normal(size=(rank, outputs)) * by if rank < outputs else np.eye(outputs)
    right = rng.normal(size=(inputs, rank)) if rank < inputs else np.eye(inputs)
    return equation.between(right, left)


def _part(equation: Characteristic) -> Part:
    """Return the part whose roots are the zeros of a square equation."""
    k = equation.through.shape[0]
    scale = 1.0 / np.maximum(np.abs(np.concatenate([equation.read, equation.through], axis=1)).max(axis=1), 1e-300)
    rows = scale[:, None] * np.concatenate([equation.read, equation.through], axis=1)
    rows[:, -k:] += np.eye(k)
    matrix = np.concatenate([np.concatenate([equation.matrix, equation.given], axis=1), rows])
    held = tuple(Channel(f"input {i + 1}", "delay", 0.0, 0.0, (), np.zeros(0)) for i in range(k))
    return Part(matrix, equation.nx, (*equation.channels, *held))


def _approximate(equation: Characteristic, order: int) -> tuple[Array, Array, Array, Array]:
    """Return A, B, C, D with Pade approximants of an order in the place of the delays."""
    whole = np.block([[equation.matrix, equation.given], [equation.read, equation.through]])
    approximants = Approximants.of(equation.channels, order)
    return quartered(approximants.closed(whole, equation.nx).result, equation.nx + len(approximants.a))


def _clear(roots: Array, radius: float) -> float:
    """Return a radius near one, in the widest gap between the zeros about it."""
    sizes = np.sort(np.abs(roots))
    sizes = np.unique(np.concatenate([[0.7 * radius], sizes[(sizes > 0.7 * radius) & (sizes < radius)], [radius]]))
    k = int(np.argmax(np.diff(sizes)))
    return float(0.5 * (sizes[k] + sizes[k + 1]))


def _counted(part: Part, radius: float) -> int:
    """Return how many roots lie in a circle around 0: the turns of the determinant, which has no poles, along it."""
    angle = np.linspace(0.0, np.pi, 64 * (1 + len(part.channels)) + 8 * part.nx)
    phase = _phases(part, radius, angle)
    while True:
        turned = np.angle(np.exp(1j * np.diff(phase)))
        wide = np.abs(turned) > TURN
        if not wide.any():
            return round(2.0 * float(turned.sum()) / (2.0 * np.pi))
        if angle.size > CIRCLE_POINTS:
            raise LinearizationError(
                "the zeros cannot be counted", got=f"one on the circle |s| = {radius:.4g}, or too near it"
            )
        middle = 0.5 * (angle[:-1] + angle[1:])[wide]
        order = np.argsort(np.concatenate([angle, middle]), kind="stable")
        phase = np.concatenate([phase, _phases(part, radius, middle)])[order]
        angle = np.concatenate([angle, middle])[order]


def _phases(part: Part, radius: float, angle: Array) -> Array:
    """Return the determinant's phase at angles of the circle."""
    return np.asarray(np.angle(np.linalg.slogdet(part.pencil(radius * np.exp(1j * angle)))[0]))
