"""Points of a sweep (grids, lists, Latin hypercubes and their products), and the work of one of them.

The work is a value that any process can be given: from the parameters' values to RMSE, poles and frequency response.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Experiment
from hvdc_ident.errors import (
    ComputationError,
    HvdcIdentError,
    InputError,
    SimulationError,
    SteadyStateError,
    StudyError,
    require_known,
)
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel
from hvdc_ident.simulate import Method, simulate

Complex = NDArray[np.complex128]
MOST_POINTS = 10_000_000


@dataclass(frozen=True, eq=False)
class Samples:
    """Points of one or several parameters that move together: values (n, k), one column a parameter, in its unit."""

    names: tuple[str, ...]
    values: Array
    kind: Literal["grid", "log", "list", "latin-hypercube"] = "list"

    def __post_init__(self) -> None:
        values = np.array(self.values, dtype=float, ndmin=2)
        values.setflags(write=False)
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "names", tuple(self.names))
        where = f"sweep of {', '.join(self.names)}"
        if values.ndim != 2 or values.shape[1] != len(self.names) or not values.size:
            expected = f"a table of {len(self.names)} columns and at least one row"
            raise StudyError("a sweep's values do not fit", where=where, expected=expected, got=f"{values.shape}")
        if not np.isfinite(values).all():
            raise StudyError("a swept value is not finite", where=where, expected="finite numbers")

    def __len__(self) -> int:
        return int(self.values.shape[0])


def grid(name: str, low: float, high: float, points: int) -> Samples:
    """Evenly spread values from low to high, both included."""
    _range(name, low, high, points)
    return Samples((name,), np.linspace(low, high, points)[:, None], "grid")


def log_grid(name: str, low: float, high: float, points: int) -> Samples:
    """Values from low to high, both included, each the same factor above the last; low is above 0."""
    _range(name, low, high, points, log=True)
    values = np.geomspace(low, high, points)
    values[[0, -1]] = low, high
    return Samples((name,), values[:, None], "log")


def listed(name: str, values: Iterable[float]) -> Samples:
    """The values as they are listed."""
    return Samples((name,), np.array([float(v) for v in values])[:, None], "list")


def latin_hypercube(
    bounds: Mapping[str, tuple[float, float]], points: int, *, seed: int = 0, log: Sequence[str] = ()
) -> Samples:
    """Random points of which each parameter has exactly one in each of as many equal slices of its range.

    log: parameters whose slices are equal in their logarithm. The same seed gives the same points.
    """
    from scipy.stats import qmc

    for name, (low, high) in bounds.items():
        _range(name, low, high, points, log=name in log)
    shares = qmc.LatinHypercube(d=len(bounds), seed=np.random.default_rng(seed)).random(points).T if bounds else ()
    columns = []
    for (name, (low, high)), share in zip(bounds.items(), shares, strict=True):
        column = low * (high / low) ** share if name in log else low + share * (high - low)
        columns.append(np.clip(column, low, high))
    table = np.column_stack(columns) if columns else np.empty((0, 0))
    return Samples(tuple(bounds), table, "latin-hypercube")


def _range(name: str, low: float, high: float, points: int, *, log: bool = False) -> None:
    if log and not low > 0:
        raise StudyError("a log scale needs a range above 0", where=f"sweep of {name}", got=f"{low:g}")
    if not (np.isfinite([low, high]).all() and low < high and points >= 2):
        raise StudyError(
            "a sweep's range is wrong",
            where=f"sweep of {name}",
            expected="finite min < max and at least 2 points",
            got=f"min {low:g}, max {high:g}, {points} points",
        )


@dataclass(frozen=True, eq=False)
class Points:
    """The product of axes: the last one moves fastest. Rows are made when they are asked for."""

    axes: tuple[Samples, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "axes", tuple(self.axes))
        names = self.names
        if not names:
            raise StudyError("nothing to sweep", expected="at least one axis", hint='grid("NAME", min, max, points)')
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise StudyError(f"'{twice[0]}' is swept twice", where="sweep", expected="each parameter in one axis")
        if len(self) > MOST_POINTS:
            raise StudyError(
                "the product of the sweep's axes is too large",
                where="sweep",
                expected=f"at most {MOST_POINTS} points",
                got=" x ".join(str(len(a)) for a in self.axes),
                hint="fewer points an axis, or a Latin hypercube",
            )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The parameters, in the order of the columns."""
        return tuple(n for a in self.axes for n in a.names)

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of values on each axis."""
        return tuple(len(a) for a in self.axes)

    def __len__(self) -> int:
        count = 1
        for axis in self.axes:
            count *= len(axis)
        return count

    def rows(self, start: int, stop: int) -> Array:
        """(stop - start, parameters): the points from start up to stop."""
        places = np.unravel_index(np.arange(start, min(stop, len(self))), self.shape)
        return np.column_stack([a.values[i] for a, i in zip(self.axes, places, strict=True)])


AxesLike = Samples | Sequence[Samples] | Mapping[str, Iterable[float]]


def points_of(axes: AxesLike) -> Points:
    """The points of one axis, of several, or of a mapping from names to lists of values."""
    if isinstance(axes, Samples):
        return Points((axes,))
    if isinstance(axes, Mapping):
        return Points(tuple(listed(name, values) for name, values in axes.items()))
    several = tuple(axes)
    if not all(isinstance(a, Samples) for a in several):
        raise InputError(
            "an axis of a sweep is none", expected="grid, log_grid, listed or latin_hypercube", got=str(several)[:80]
        )
    return Points(several)


# --- one point: parameter values in; RMSE, poles and frequency response out ---


@dataclass(frozen=True, eq=False)
class Reference:
    """Reference of an output of an experiment: values at the experiment's rows, (m,), in the output's unit."""

    experiment: str
    output: str
    rows: NDArray[np.intp]
    values: Array


@dataclass(frozen=True, eq=False)
class PointTask:
    """The work of a point, the same in every process.

    values: parameters and inputs held at other than the model's values. references: what is compared, in order.
    poles: how many poles are wanted (0: none). omega, inputs, outputs: of the frequency response (empty: none).
    method: the integrator of every run, fixed beforehand so that no point depends on those before it.
    """

    model: AnyModel
    experiments: tuple[Experiment, ...]
    names: tuple[str, ...]
    values: FrozenMap[float]
    references: tuple[Reference, ...]
    poles: int = 0
    omega: Array = field(default_factory=lambda: np.empty(0))
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    method: Method = "rosenbrock"

    @property
    def identity(self) -> tuple[Any, ...]:
        """What decides a point's result beside the point itself and the code."""
        runs = tuple(e.with_(measured=None, noise={}) for e in self.experiments)
        return (
            self.model.text,
            *(getattr(self, f.name) for f in fields(self) if f.name not in ("model", "experiments")),
            runs,
        )

    def __call__(self, point: Array) -> tuple[Array, Complex, Complex, Array] | str:
        """Return RMSE (references,), poles (modes,) in 1/s, response and phase in degrees (frequencies, outputs, inputs).

        point: (k,). The reason where a run fails.
        """
        given = FrozenMap({**self.values, **dict(zip(self.names, map(float, point), strict=True))})
        try:
            results = (self._errors(given), *self._linear(given))
        except HvdcIdentError as e:
            return str(e)
        return results if all(np.isfinite(numbers).all() for numbers in results) else "a result is not finite"

    def _errors(self, given: FrozenMap[float]) -> Array:
        """Return the RMSE of each reference, (references,), in the outputs' units."""
        errors = np.empty(len(self.references))
        for experiment in self.experiments:
            columns = [(i, r) for i, r in enumerate(self.references) if r.experiment == experiment.name]
            if not columns:
                continue
            run = simulated(self.model, experiment, given, tuple(r.output for _, r in columns), self.method)
            for column, (i, r) in enumerate(columns):
                difference = run[r.rows, column] - r.values
                errors[i] = np.sqrt(np.mean(difference * difference))
        return errors

    def _linear(self, given: FrozenMap[float]) -> tuple[Complex, Complex, Array]:
        """Return the poles, sorted, the response and its phase; each empty where it is not wanted."""
        poles, response = (np.empty(shape, dtype=complex) for shape in (0, (0, len(self.outputs), len(self.inputs))))
        phase = np.empty(response.shape)
        if not self.poles and not self.omega.size:
            return poles, response, phase
        from hvdc_ident.linearize import find_operating_point, linearize

        at = find_operating_point(self.model, given)
        linear = linearize(self.model, at, inputs=self.inputs or None, outputs=self.outputs or None)
        if self.poles:
            poles = np.asarray(linear.poles(), dtype=complex)
            if linear.exact is not None:  # infinitely many: the rightmost ones
                poles = poles[: self.poles]
            if poles.size != self.poles:
                raise SimulationError(
                    "the number of poles changed", expected=str(self.poles), got=str(poles.size)
                )  # e.g. a loop that becomes ill-posed
            poles = poles[np.lexsort((poles.imag, poles.real))]
        if self.omega.size:
            bode = linear.bode(self.omega)
            response, phase = bode.values, bode.phase_deg
        return poles, response, phase


def simulated(model: AnyModel, experiment: Experiment, given: Any, outputs: tuple[str, ...], method: Method) -> Array:
    """Return the outputs, (n, outputs), of one run whose integrator does not depend on the runs before it."""
    return simulate(model, experiment, given, outputs=outputs, method=method).trajectory.values


Want = Literal["rmse", "poles", "bode"]
Against = Literal["data", "base"] | AnyModel


@dataclass(frozen=True, eq=False)
class Quantities:
    """Quantities computed at every point of a sweep: the RMSE, poles, or the frequency response ("bode").

    inputs, outputs: of the linear model; default, all. omega: rad/s; default, 200 around the base's poles.
    """

    names: Sequence[Want]
    inputs: Sequence[str] | None = None
    outputs: Sequence[str] | None = None
    omega: Array | None = None


def check(
    model: AnyModel, experiments: Sequence[Experiment], points: Points, base: Mapping[str, float], want: Sequence[str]
) -> None:
    """Raise InputError for names, values, bounds or experiments that do not fit the sweep."""
    require_known("parameter or input", (*points.names, *base), {**model.parameters, **model.inputs}, "sweep")
    require_known("result of a sweep", want, ("rmse", "poles", "bode"), "")
    names = [e.name for e in experiments]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise StudyError("two experiments of one name", where="sweep", got=twice[0], expected="distinct names")
    if "rmse" in want and not experiments:
        raise StudyError("a sweep has nothing to compare", where="sweep", expected="at least one experiment")
    for axis in points.axes:
        for column, name in enumerate(axis.names):
            _check_values(model, experiments, name, axis.values[:, column])


def _check_values(model: AnyModel, experiments: Sequence[Experiment], name: str, values: Array) -> None:
    for e in experiments:
        if name in e.inputs:
            raise StudyError(f"'{name}' is moved by experiment '{e.name}' and cannot be swept", where="sweep")
    parameter = model.parameters.get(name)
    if parameter is not None and not (parameter.min <= values.min() and values.max() <= parameter.max):
        raise StudyError(
            f"a value of '{name}' lies outside the model's own bounds",
            where=f"sweep of {name}",
            expected=f"values in [{parameter.min:g}, {parameter.max:g}]",
            got=f"{values.min():g} to {values.max():g}",
        )


def task_of(
    model: AnyModel,
    experiments: tuple[Experiment, ...],
    names: tuple[str, ...],
    base: FrozenMap[float],
    against: Against,
    outputs: Sequence[str] | None,
    quantities: Quantities,
) -> PointTask:
    """Return the work of every point, its references run once here. Raises ComputationError where a reference fails."""
    want, omega = quantities.names, quantities.omega
    references: list[Reference] = []
    method: Method = "rosenbrock"
    if "rmse" in want:
        method = _method(model, experiments, base)
        for e in experiments:
            references += _references(model, e, base, against, outputs, method)
        if not references:
            raise StudyError(
                "no experiment has a recorded output to compare",
                where="sweep",
                hint='against="base", or another model, needs no recording',
            )
    poles = 0
    channels: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())
    frequencies = np.empty(0)
    if "poles" in want or "bode" in want:
        from hvdc_ident.linearize import find_operating_point, linearize

        try:
            point = find_operating_point(model, base)
        except SteadyStateError as e:
            hint = 'want = ["rmse"], which needs no operating point, or base values in [model.values] that have one'
            raise SteadyStateError(
                e.what, where=f"sweep, {e.where}", expected=e.expected, got=e.got, hint=hint
            ) from None
        at = linearize(model, point, inputs=quantities.inputs, outputs=quantities.outputs)
        if "poles" in want:
            poles = int(np.size(at.poles())) if at.exact is None else at.exact.nx
        channels = tuple(at.input_names), tuple(at.output_names)
        if "bode" in want:
            frequencies = np.asarray(omega if omega is not None else at.bode().omega, dtype=float)
    return PointTask(model, experiments, names, base, tuple(references), poles, frequencies, *channels, method=method)


def _method(model: AnyModel, experiments: tuple[Experiment, ...], base: FrozenMap[float]) -> Method:
    """The integrator of every point: the one that serves at the base values."""
    first = experiments[0]
    try:
        method = simulate(model, first, base).statistics.method
    except (ComputationError, SteadyStateError):
        return "rosenbrock"
    return "nonstiff" if method == "explicit" else "rosenbrock"


def _references(
    model: AnyModel,
    e: Experiment,
    base: FrozenMap[float],
    against: Against,
    outputs: Sequence[str] | None,
    method: Method,
) -> list[Reference]:
    """Return the references of one experiment: its recording, the run at the base values, or another model's run."""
    if against == "data":
        recorded = [o for o in (e.outputs if outputs is None else outputs) if o in e.outputs]
        references = []
        for o in recorded:
            assert e.measured is not None
            rows = np.flatnonzero(e.compared & np.isfinite(e.measured[o]))
            if not rows.size:
                hint = "a wider window"
                raise StudyError(f"no row of '{o}' can be compared", where=f"experiment '{e.name}'", hint=hint)
            references.append(Reference(e.name, o, rows, np.array(e.measured[o][rows])))
        return references
    compared = tuple(outputs if outputs is not None else (e.outputs or model.outputs))
    rows = np.flatnonzero(e.compared)
    if not isinstance(against, str) and hasattr(against, "outputs"):
        missing = [o for o in compared if o not in against.outputs and o not in against.names]
        if missing and outputs is None:
            compared = tuple(o for o in compared if o not in missing)
        run = simulate(against, e.with_(measured=None), {}, outputs=compared).trajectory.values
    elif against == "base":
        run = simulated(model, e, base, compared, method)
    else:
        raise StudyError(
            "what a sweep is compared with is unknown", expected='"data", "base" or a Model', got=repr(against)[:60]
        )
    return [Reference(e.name, o, rows, np.array(run[rows, k])) for k, o in enumerate(compared)]
