"""Root loci: eigenvalues along a parameter, followed by their eigenvectors, and the values at which stability changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from hvdc_ident.errors import LinearizationError, SteadyStateError, unknown_name
from hvdc_ident.linearize.equilibrium import EquilibriumSearch
from hvdc_ident.linearize.jacobian import state_matrix
from hvdc_ident.linearize.matrices import Array
from hvdc_ident.linearize.modal import ZERO, eigen
from hvdc_ident.linearize.operating_point import steady
from hvdc_ident.model import Model


@dataclass(frozen=True)
class StabilityLimit:
    """A parameter value at which an eigenvalue crosses the imaginary axis, and that eigenvalue, rad/s."""

    value: float
    eigenvalue: complex
    direction: str


@dataclass(frozen=True, eq=False)
class RootLocus:
    """Eigenvalues (points, modes) in rad/s along values of a parameter; column k is one mode throughout.

    limits: where stability is lost or won between the values.
    """

    parameter: str
    unit: str
    values: Array
    eigenvalues: Array
    limits: tuple[StabilityLimit, ...]

    @property
    def stable(self) -> Array:
        """(points,) True where every eigenvalue lies left of the imaginary axis, those that stay at 0 apart."""
        return np.asarray(((self.eigenvalues.real < 0) | at_zero(self.eigenvalues)).all(axis=1))

    def plot(self, ax: Any = None) -> Any:
        """The axes with the locus."""
        from hvdc_ident.linearize.plot import locus

        return locus(self, ax=ax)

    def to_dict(self) -> dict[str, Any]:
        """The locus as plain lists, complex numbers as [re, im]."""
        pairs = np.stack([self.eigenvalues.real, self.eigenvalues.imag], axis=-1).tolist()
        limits = [
            {"value": x.value, "eigenvalue": [x.eigenvalue.real, x.eigenvalue.imag], "direction": x.direction}
            for x in self.limits
        ]
        return {
            "parameter": self.parameter,
            "unit": self.unit,
            "values": self.values.tolist(),
            "eigenvalues": pairs,
            "limits": limits,
        }


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
    unit = (model.parameters[parameter] if parameter in model.parameters else model.inputs[parameter]).unit
    return RootLocus(parameter, unit, along, table, _limits(at, along, table))


class _Along:
    """The state matrix at a value of the parameter."""

    def __init__(self, model: Model, parameter: str, fixed: dict[str, float]) -> None:
        self.model, self.parameter = model, parameter
        own = model.parameters[parameter] if parameter in model.parameters else model.inputs[parameter]
        start = {parameter: own.value}
        self._search = EquilibriumSearch.of(model, {**start, **fixed}, (), {}, at="steady", moving=(), time=0.0)
        names = self._search.system.parameters if parameter in model.parameters else self._search.system.inputs
        self._place = names.index(parameter)

    def _at(self, value: float) -> EquilibriumSearch:
        """The search at a value: nothing else in it changes but the guesses that stand on parameters."""
        key = "p" if self.parameter in self.model.parameters else "u"
        values = getattr(self._search, key).copy()
        values[self._place] = value
        return replace(self._search, **{key: values})

    def matrix(self, value: float) -> Array:
        """A alone at the value's own operating point: the steady state that a simulation starts from there."""
        search = self._at(value)
        try:
            root, _ = steady(self.model, search)
        except SteadyStateError as e:
            raise e.at(f"{self.parameter} = {value:g}") from None
        return state_matrix(self.model, search.system, *search.vectors(root.v))


def at_zero(table: Array) -> Array:
    """Which eigenvalues (points, modes) are 0 but for rounding."""
    return np.asarray(np.abs(table) <= ZERO * np.maximum(1.0, np.abs(table).max(axis=1, keepdims=True)))


def match(before: Array, left: Array, after: Array, right: Array) -> Array:
    """The order that puts the new modes in the old ones' columns: by eigenvectors, distances deciding between alike."""
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
