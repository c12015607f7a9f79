"""Modes of a linear model, and root loci.

Eigenvalues with damping and frequency, participation, shapes, names and derivatives by parameters; eigenvalues along a
parameter, followed by their eigenvectors, and the values at which stability changes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from hvdc_ident.codec import INLINE, Coded, stored_as
from hvdc_ident.errors import LinearizationError, SteadyStateError, unknown_name
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize import delayed_modes
from hvdc_ident.linearize.delayed_locus import crossings, followed
from hvdc_ident.linearize.derivatives import characteristic, state_matrix
from hvdc_ident.linearize.equilibrium import EquilibriumSearch
from hvdc_ident.linearize.jacobian import steady
from hvdc_ident.linearize.linear_model import LinearModel, approximate_poles
from hvdc_ident.linearize.mode import Mode
from hvdc_ident.linearize.plot import locus
from hvdc_ident.linearize.stability import ZERO, Characteristic, Stability, stability
from hvdc_ident.linearize.system import Array, CompiledSystem
from hvdc_ident.model import Model

ON_AXIS = (1e-9, 1e-6)
"""1/s left and right of the imaginary axis within which an eigenvalue of A counts as on it."""


def poles(model: LinearModel) -> Array:
    """Return (n,) complex eigenvalues, rad/s; for a descriptor those of the pencil without the infinite ones.

    Of a model with delays the rightmost roots of its exact characteristic equation, by falling real part.
    """
    if model.exact is not None:
        return model.characteristic.roots.values
    return approximate_poles(model)


def stability_of(model: LinearModel) -> Stability:
    """Return whether a model is stable: with delays by its characteristic equation, else by its eigenvalues."""
    if model.exact is not None:
        return stability(model.characteristic)
    values = approximate_poles(model)
    if not values.size:
        return Stability("stable", 0, None)
    first = complex(values[np.argmax(values.real + 1e-300 * values.imag)])
    verdict = (
        "stable" if first.real < -ON_AXIS[0] else "on the limit of stability" if first.real < ON_AXIS[1] else "unstable"
    )
    return Stability(verdict, int((values.real >= ON_AXIS[1]).sum()), first)


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
        return _hidden(model, right, bool(driven), bool(seen))
    if value.imag:
        return "oscillation" if value.real <= 0 else "growing oscillation"
    return "decay" if value.real < 0 else "growth"


def _hidden(model: LinearModel, right: Array, driven: bool, seen: bool) -> str:
    """Return the kind of a zero eigenvalue that the chosen inputs and outputs do not both reach."""
    if model.point is not None and model.point.active_limits:
        state = model.state_names[int(np.argmax(np.abs(right)))]
        row = model.A[model.state_names.index(state)]
        if not row.any():
            return "saturated state"
    if not driven and not seen:
        return "hidden integrator"
    return "angle reference or unobserved integrator" if driven else "undriven integrator"


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


# --- root loci ---


@dataclass(frozen=True)
class StabilityLimit:
    """A parameter value at which an eigenvalue crosses the imaginary axis, and that eigenvalue, rad/s."""

    value: float
    eigenvalue: complex
    direction: str


@dataclass(frozen=True, eq=False)
class RootLocus(Coded):
    """Eigenvalues (points, modes) in rad/s along values of a parameter; column k is one mode throughout.

    limits: where stability is lost or won between the values. With delays, the columns are the rightmost roots of the exact
    characteristic equation, and unstable is the number of all roots right of the imaginary axis, None where it is unknown.
    """

    parameter: str
    unit: str
    values: Array
    eigenvalues: NDArray[np.complex128]
    limits: tuple[StabilityLimit, ...]
    unstable: tuple[float | None, ...] | None = field(default=None, metadata=stored_as("unstable_roots", optional=True))

    @property
    def stable(self) -> Array:
        """(points,) True where every eigenvalue lies left of the imaginary axis, those that stay at 0 apart."""
        if self.unstable is not None:
            return np.array([n == 0 for n in self.unstable])
        return np.asarray(((self.eigenvalues.real < 0) | at_zero(self.eigenvalues)).all(axis=1))

    def plot(self, ax: Any = None) -> Any:
        """Return the axes with the locus."""
        return locus(self, ax=ax)


def root_locus(
    model: Model, parameter: str, values: Sequence[float] | Array, fixed: dict[str, float] | None = None
) -> RootLocus:
    """Return the eigenvalues of the model along values of a parameter (or input), each at its own operating point.

    Raises UnknownNameError, SteadyStateError with the value at which there is no operating point, and
    LinearizationError on a kink.
    """
    if parameter not in model.parameters and parameter not in model.inputs:
        raise unknown_name(
            "parameter or input", parameter, [*model.parameters, *model.inputs], where=f"model '{model.name}'"
        )
    along = np.asarray(values, dtype=float)
    if along.ndim != 1 or along.size == 0 or not np.isfinite(along).all():
        raise LinearizationError(
            "a locus needs finite values", where=f"locus of '{parameter}'", expected="at least one"
        )
    at = _Along(model, parameter, fixed or {})
    unit = (model.parameters[parameter] if parameter in model.parameters else model.inputs[parameter]).unit
    if model.delays or model.sampled:
        table, unstable = followed(at.equation, along)
        ends = tuple(
            StabilityLimit(v, root, "lost" if lost else "won")
            for v, root, lost in crossings(at.equation, along, unstable)
        )
        return RootLocus(parameter, unit, along, table, ends, unstable)
    found: list[Array] = []
    left: Array | None = None
    for value in along:
        eigenvalues, right, left_new = eigen(at.matrix(float(value)))
        if left is not None:
            order = match(found[-1], left, eigenvalues, right)
            eigenvalues, left_new = eigenvalues[order], left_new[order]
        found.append(eigenvalues)
        left = left_new
    table = np.array(found)
    return RootLocus(parameter, unit, along, table, _limits(at, along, table))


class _Along:
    """The state matrix at a value of the parameter."""

    def __init__(self, model: Model, parameter: str, fixed: dict[str, float]) -> None:
        self.model, self.parameter = model, parameter
        own = model.parameters[parameter] if parameter in model.parameters else model.inputs[parameter]
        start = {parameter: own.value}
        self._search = EquilibriumSearch.of_model(model, {**start, **fixed}, (), {}, at="steady", moving=(), time=0.0)
        names = self._search.system.parameters if parameter in model.parameters else self._search.system.inputs
        self._place = names.index(parameter)

    def _at(self, value: float) -> EquilibriumSearch:
        """Return the search at a value: nothing else in it changes but the guesses that stand on parameters."""
        key = "p" if self.parameter in self.model.parameters else "u"
        values = getattr(self._search, key).copy()
        values[self._place] = value
        return replace(self._search, **{key: values})

    def _rest(self, value: float) -> tuple[CompiledSystem, tuple[Array, Array, Array]]:
        """Return the system and its vectors at the value's own operating point: where a simulation starts from there."""
        search = self._at(value)
        try:
            root, _ = steady(self.model, search)
        except SteadyStateError as e:
            raise e.at(f"{self.parameter} = {value:g}") from None
        assert isinstance(search.system, CompiledSystem)
        return search.system, search.vectors(root.v)

    def matrix(self, value: float) -> Array:
        """Return A, (states, states), at the value's own operating point."""
        system, vectors = self._rest(value)
        return state_matrix(self.model, system, *vectors)

    def equation(self, value: float) -> Characteristic:
        """Return the characteristic equation at the value's own operating point, delays exact."""
        system, vectors = self._rest(value)
        return characteristic(self.model, system, *vectors)


def at_zero(table: Array) -> Array:
    """Return a mask (points, modes) of the eigenvalues that are 0 but for rounding."""
    return np.asarray(np.abs(table) <= ZERO * np.maximum(1.0, np.abs(table).max(axis=1, keepdims=True)))


def match(before: Array, left: Array, after: Array, right: Array) -> Array:
    """Return the order that puts the new modes in the old ones' columns: by eigenvectors, distances deciding between alike."""
    likeness = np.abs(left @ right)
    likeness = likeness / np.maximum(likeness.max(axis=1, keepdims=True), 1e-300)
    distance = np.abs(before[:, None] - after[None, :])
    scale = np.maximum(np.abs(before)[:, None], 1e-6 * np.abs(before).max(initial=1.0))
    cost = (1.0 - likeness) + np.minimum(distance / np.maximum(scale, 1e-300), 10.0)
    order = np.argmax(-cost, axis=1)
    return order if np.unique(order).size == order.size else np.asarray(linear_sum_assignment(cost)[1])


def _limits(at: _Along, values: Array, table: Array) -> tuple[StabilityLimit, ...]:
    """Return the values at which a mode's real part changes sign, to the last digits, by bisection."""
    found = []
    resting = at_zero(table)
    for k in range(values.size - 1):
        a, b = table[k].real, table[k + 1].real
        for j in np.flatnonzero(((a < 0) != (b < 0)) & ~(resting[k] & resting[k + 1])):
            if table[k, j].imag < 0:
                continue
            value, eigenvalue = _crossing(
                at, float(values[k]), float(values[k + 1]), complex(table[k, j]), bool(a[j] < 0)
            )
            found.append(StabilityLimit(value, eigenvalue, "lost" if a[j] < 0 else "won"))
    return tuple(found)


def _crossing(at: _Along, low: float, high: float, start: complex, stable_below: bool) -> tuple[float, complex]:
    current = start
    for _ in range(80):
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        eigenvalues = np.linalg.eigvals(at.matrix(middle))
        current = complex(eigenvalues[np.argmin(np.abs(eigenvalues - current))])
        if (current.real < 0) == stable_below:
            low = middle
        else:
            high = middle
        if abs(high - low) <= 1e-13 * max(abs(high), abs(low)):
            break
    return 0.5 * (low + high), current
