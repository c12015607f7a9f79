"""Root loci: eigenvalues along a parameter, each at its own operating point, and the values at which stability changes.

Eigenvalues are followed by their eigenvectors, roots of models with delays by their distance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from hvdc_ident.codec import Coded, stored_as
from hvdc_ident.errors import LinearizationError, SteadyStateError, unknown_name
from hvdc_ident.linearize.derivatives import characteristic, constants
from hvdc_ident.linearize.equilibrium import EquilibriumSearch, PointOptions
from hvdc_ident.linearize.jacobian import steady
from hvdc_ident.linearize.modal import at_rest, eigen
from hvdc_ident.linearize.plot import locus
from hvdc_ident.linearize.stability import Characteristic
from hvdc_ident.linearize.system import Array, CompiledSystem
from hvdc_ident.model import Model


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
        return np.asarray(((self.eigenvalues.real < 0) | (self.eigenvalues == 0)).all(axis=1))

    def plot(self, ax: Any = None) -> Any:
        """Return the axes with the locus."""
        return locus(self, ax=ax)


def root_locus(
    model: Model, parameter: str, values: Sequence[float] | Array, fixed: dict[str, float] | None = None
) -> RootLocus:
    """Return the eigenvalues of the model along values of a parameter (or input), each at its own operating point.

    Parameters
    ----------
    model : Model
        A model with equations.
    parameter : str
        The parameter or input that moves.
    values : array of float (n,)
        Its values, in its unit.
    fixed : dict of float, default None
        Values of other parameters and inputs (or of states and signals that are to hold), in the model's units.

    Returns
    -------
    RootLocus
        eigenvalues (n, modes) in rad/s, column k one mode throughout, `stable` (n,), and `limits`, the values at which stability is lost or
        won. With delays the columns are the rightmost roots of the exact characteristic equation.

    Raises
    ------
    UnknownNameError
        The parameter, or another name, is not in the model.
    SteadyStateError
        There is no operating point at a value, which the error names.
    LinearizationError
        There are no finite values, or a point lies on a kink.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> locus = hi.linear.root_locus(hi.load_model("vsc-hvdc-link"), "KPVDC", [1.0, 24.0, 100.0])
    >>> locus.eigenvalues.shape, locus.stable.tolist()
    ((3, 6), [True, True, True])
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
    equations = [at.equation(float(value)) for value in along]
    if any(e.channels for e in equations):
        table, unstable = _delayed_columns(equations)
        return RootLocus(parameter, unit, along, table, tuple(_count_limits(at, along, unstable)), unstable)
    table = _columns(equations)
    return RootLocus(parameter, unit, along, table, tuple(_column_limits(at, along, table)))


class _Along:
    """The characteristic equation at a value of the parameter."""

    def __init__(self, model: Model, parameter: str, fixed: dict[str, float]) -> None:
        self.model, self.parameter = model, parameter
        own = model.parameters[parameter] if parameter in model.parameters else model.inputs[parameter]
        start = {parameter: own.value}
        self._search = EquilibriumSearch.of_model(model, PointOptions({**start, **fixed}))
        names = self._search.system.parameters if parameter in model.parameters else self._search.system.inputs
        self._place = names.index(parameter)

    def _at(self, value: float) -> EquilibriumSearch:
        """Return the search at a value: nothing else in it changes but the guesses that stand on parameters."""
        key = "p" if self.parameter in self.model.parameters else "u"
        values = getattr(self._search, key).copy()
        values[self._place] = value
        return replace(self._search, **{key: values})

    def equation(self, value: float) -> Characteristic:
        """Return the characteristic equation at the value's own operating point, without states that never move."""
        search = self._at(value)
        try:
            root, _ = steady(self.model, search)
        except SteadyStateError as e:
            raise e.at(f"{self.parameter} = {value:g}") from None
        s = search.system
        assert isinstance(s, CompiledSystem)
        whole = characteristic(self.model, s, *search.vectors(root.v))
        return whole.without_states([s.states.index(n) for n in constants(self.model)])


def _columns(equations: Sequence[Characteristic]) -> Array:
    """Return (points, modes) the eigenvalues of models without delays, each column one mode throughout."""
    rows: list[Array] = []
    left: Array | None = None
    for equation in equations:
        eigenvalues, right, left_new = eigen(equation.matrix)
        eigenvalues = at_rest(eigenvalues, equation.roots.values)
        if left is not None:
            order = match(rows[-1], left, eigenvalues, right)
            eigenvalues, left_new = eigenvalues[order], left_new[order]
        rows.append(eigenvalues)
        left = left_new
    return np.array(rows)


def _delayed_columns(equations: Sequence[Characteristic]) -> tuple[Array, tuple[float | None, ...]]:
    """Return (points, modes) roots of models with delays, each column one root throughout, and how many of all are unstable.

    There are as many columns as the fewest rightmost roots found at one of the points, at least one for each state.
    """
    by_point = [equation.roots for equation in equations]
    count = min(r.values.size for r in by_point)
    rows: list[Array] = []
    for r in by_point:
        roots = r.values
        if rows:
            before = rows[-1]
            size = np.maximum(np.maximum(np.abs(before)[:, None], np.abs(roots)[None, :]), 1e-300)
            roots = roots[linear_sum_assignment(np.abs(before[:, None] - roots[None, :]) / size)[1]]
        rows.append(roots[:count])
    return np.array(rows).reshape(len(by_point), count), tuple(r.unstable for r in by_point)


def match(before: Array, left: Array, after: Array, right: Array) -> Array:
    """Return the order that puts the new modes in the old ones' columns: by eigenvectors, distances deciding between alike."""
    likeness = np.abs(left @ right)
    likeness = likeness / np.maximum(likeness.max(axis=1, keepdims=True), 1e-300)
    distance = np.abs(before[:, None] - after[None, :])
    scale = np.maximum(np.abs(before)[:, None], 1e-6 * np.abs(before).max(initial=1.0))
    cost = (1.0 - likeness) + np.minimum(distance / np.maximum(scale, 1e-300), 10.0)
    order = np.argmax(-cost, axis=1)
    return order if np.unique(order).size == order.size else np.asarray(linear_sum_assignment(cost)[1])


def _column_limits(at: _Along, values: Array, table: Array) -> Iterator[StabilityLimit]:
    """Return the values at which a mode's real part changes sign, to the last digits, by bisection."""
    resting = table == 0
    for k in range(values.size - 1):
        a, b = table[k].real, table[k + 1].real
        for j in np.flatnonzero(((a < 0) != (b < 0)) & ~(resting[k] & resting[k + 1])):
            if table[k, j].imag < 0:
                continue
            value, eigenvalue = _crossing(
                at, float(values[k]), float(values[k + 1]), complex(table[k, j]), bool(a[j] < 0)
            )
            yield StabilityLimit(value, eigenvalue, "lost" if a[j] < 0 else "won")


def _crossing(at: _Along, low: float, high: float, start: complex, stable_below: bool) -> tuple[float, complex]:
    current = start
    for _ in range(80):
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        eigenvalues = np.linalg.eigvals(at.equation(middle).matrix)
        current = complex(eigenvalues[np.argmin(np.abs(eigenvalues - current))])
        if (current.real < 0) == stable_below:
            low = middle
        else:
            high = middle
        if abs(high - low) <= 1e-13 * max(abs(high), abs(low)):
            break
    return 0.5 * (low + high), current


def _count_limits(at: _Along, values: Array, unstable: Sequence[float | None]) -> Iterator[StabilityLimit]:
    """Return the values at which the number of unstable roots changes, by bisection on that number.

    Between values where it is unknown or infinite nothing is looked for.
    """
    for low, high, first, last in zip(values[:-1], values[1:], unstable[:-1], unstable[1:], strict=True):
        if first is None or last is None or np.isinf(first) or np.isinf(last):
            continue
        a, own = float(low), first
        while own != last:
            b, other = float(high), last
            while abs(b - a) > 1e-12 * max(abs(a), abs(b)):
                middle = 0.5 * (a + b)
                if middle in (a, b):
                    break
                count = at.equation(middle).counts()[0]
                if count == own:
                    a = middle
                else:
                    b, other = middle, last if count is None else count
            roots = at.equation(b).roots.values
            upper = roots[roots.imag >= 0]
            nearest = complex(upper[np.argmin(np.abs(upper.real))])
            yield StabilityLimit(0.5 * (a + b), nearest, "lost" if other > own else "won")
            a, own = b, other
