"""Sweeps: a model run at many points of its parameters, compared with data, another model or itself; and the result.

Points run in an executor, which may keep what is finished, or in this process.
"""

from __future__ import annotations

import csv
import io
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.codec import Coded, plain, read_fields
from hvdc_ident.data import Array, Experiment
from hvdc_ident.display import Shown, Table, axes_of, data_frame
from hvdc_ident.errors import ComputationError, require_known, unknown_name
from hvdc_ident.executor import Executor, Made, Outcome, Progress, outcomes
from hvdc_ident.files import csv_cell
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel
from hvdc_ident.sensitivity.sweep_points import (
    Against,
    AxesLike,
    Points,
    Quantities,
    Samples,
    Want,
    check,
    points_of,
    task_of,
)
from hvdc_ident.text import with_unit

if TYPE_CHECKING:
    import xarray


# --- result ---


@dataclass(frozen=True)
class _Swept:
    """A parameter in sweep.json."""

    unit: str
    base: float
    kind: Literal["grid", "log", "list", "latin-hypercube"]
    points: int


@dataclass(frozen=True, eq=False)
class _Point:
    """A point in sweep.json."""

    values: Mapping[str, float]
    rmse: Mapping[str, Mapping[str, float | None]]
    status: str
    reason: str = ""
    poles: NDArray[np.complex128] | None = None
    bode: Mapping[str, Mapping[str, NDArray[np.complex128]]] | None = None
    phase_deg: Mapping[str, Mapping[str, Array]] | None = None


@dataclass(frozen=True)
class SeriesBest:
    """The smallest and the largest RMSE of an output in an experiment, in its unit; at: the parameters' values at the smallest."""

    output: str
    experiment: str
    unit: str
    smallest: float
    largest: float
    at: Mapping[str, float]

    @property
    def text(self) -> str:
        """The smallest RMSE and where it is, in words; of a flat line none is the best."""
        size = f"{self.smallest:.4g} {self.unit}".rstrip()
        at = ", ".join(f"{n} = {v:.6g}" for n, v in self.at.items())
        flat = f"{self.smallest:.3g}" == f"{self.largest:.3g}"
        return f"{self.output} in {self.experiment}: " + (
            f"RMSE {size} at every point" if flat else f"smallest RMSE {size}, at {at}"
        )


@dataclass(frozen=True)
class SweepSummary(Coded):
    """A sweep without its points. count, failed: points; failure: the reason of the first that failed. best: by series."""

    parameters: Mapping[str, _Swept]
    count: int
    failed: int
    failure: str = ""
    best: tuple[SeriesBest, ...] = ()

    @property
    def text(self) -> str:
        """How many points of which parameters."""
        return f"{self.count} points of {', '.join(self.parameters)}"


@dataclass(frozen=True, eq=False)
class _Told:
    """The sweep.json that a sweep writes."""

    parameters: Mapping[str, _Swept]
    against: str
    units: Mapping[str, str]
    wanted: tuple[str, ...]
    points: tuple[_Point, ...]
    omega: Array = field(default_factory=lambda: np.zeros(0))


def _axes_of(parameters: Mapping[str, _Swept], values: Array) -> tuple[Samples, ...]:
    """Return the axes whose product the rows of values are; the parameters of a Latin hypercube move together."""
    groups: list[tuple[str, ...]] = []
    for name, p in parameters.items():
        if groups and p.kind == parameters[groups[-1][-1]].kind == "latin-hypercube":
            groups[-1] = (*groups[-1], name)
        else:
            groups.append((name,))
    axes, repeat, names = [], len(values), list(parameters)
    for group in groups:
        length = parameters[group[0]].points
        repeat //= max(length, 1)
        columns = [names.index(n) for n in group]
        axes.append(Samples(group, values[: length * repeat : max(repeat, 1), columns], parameters[group[0]].kind))
    return tuple(axes)


@dataclass(frozen=True, eq=False, repr=False)
class SweepResult(Coded, Shown):
    """A sweep's n points.

    axes: of the product. units: by parameter. series: (output, experiment) of the columns of rmse, with series_units.
    against: "data", "base" or the name of the other model. base: where the axes' parameters stand without a sweep.
    rmse: (n, series) in the outputs' units; poles: (n, modes) 1/s; response: (n, frequencies, outputs, inputs) at
    omega rad/s, with its phase in degrees; rows of failed points are not numbers. failed: reason by row.
    """

    model: str
    axes: tuple[Samples, ...]
    units: FrozenMap[str]
    series: tuple[tuple[str, str], ...]
    series_units: tuple[str, ...]
    against: str
    base: FrozenMap[float]
    rmse: Array
    poles: np.ndarray[Any, np.dtype[np.complex128]]
    omega: Array
    response: np.ndarray[Any, np.dtype[np.complex128]]
    phase_deg: Array
    channels: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())
    failed: Mapping[int, str] = field(default_factory=dict)
    wanted: tuple[str, ...] = ("rmse",)

    def __post_init__(self) -> None:
        for name in ("rmse", "poles", "omega", "response", "phase_deg"):
            getattr(self, name).setflags(write=False)

    @cached_property
    def points(self) -> Points:
        """The points, in the order of the rows."""
        return Points(self.axes)

    @property
    def parameters(self) -> tuple[str, ...]:
        """The swept parameters."""
        return self.points.names

    def __len__(self) -> int:
        return len(self.points)

    def values(self, name: str) -> Array:
        """(n,): one parameter's value in each row, in its unit."""
        require_known("swept parameter", [name], self.parameters, "")
        return self.points.rows(0, len(self))[:, self.parameters.index(name)]

    def error(self, output: str, experiment: str) -> Array:
        """(n,): RMSE of one output in one experiment, in its unit; nan where the point failed."""
        if (output, experiment) not in self.series:
            raise unknown_name("series", f"{output} in {experiment}", [f"{o} in {e}" for o, e in self.series])
        return self.rmse[:, self.series.index((output, experiment))]

    def best(self, output: str, experiment: str) -> dict[str, float]:
        """The values at the row of the smallest RMSE. Raises ComputationError where every point failed."""
        errors = self.error(output, experiment)
        if not np.isfinite(errors).any():
            raise ComputationError("every point of the sweep failed", got=next(iter(self.failed.values()), ""))
        row = int(np.nanargmin(errors))
        return dict(zip(self.parameters, self.points.rows(row, row + 1)[0].tolist(), strict=True))

    @property
    def bests(self) -> tuple[SeriesBest, ...]:
        """The smallest and the largest error of each series; none of one without an error."""
        bests = []
        for (output, experiment), unit in zip(self.series, self.series_units, strict=True):
            errors = self.error(output, experiment)
            if np.isfinite(errors).any():
                low, high = float(np.nanmin(errors)), float(np.nanmax(errors))
                bests.append(SeriesBest(output, experiment, unit, low, high, self.best(output, experiment)))
        return tuple(bests)

    def row(self, index: int) -> dict[str, Any]:
        """One point as sweep.json has it: values, rmse, status, reason, poles, bode and its phase where wanted."""
        return self._row(index, self.points.rows(index, index + 1)[0].tolist())

    def rows(self) -> Iterator[dict[str, Any]]:
        """Every point as sweep.json has it, made one at a time."""
        for start in range(0, len(self), 1024):
            for offset, values in enumerate(self.points.rows(start, start + 1024).tolist()):
                yield self._row(start + offset, values)

    def _row(self, index: int, values: list[float]) -> dict[str, Any]:
        bad = self.failed.get(index)
        rmse: dict[str, dict[str, float | None]] = {}
        for (output, experiment), error in zip(self.series, self.rmse[index].tolist(), strict=True):
            rmse.setdefault(output, {})[experiment] = None if bad is not None else error
        row: dict[str, Any] = {
            "values": dict(zip(self.parameters, values, strict=True)),
            "rmse": rmse,
            "status": "done" if bad is None else "failed",
            "reason": bad or "",
        }
        if "poles" in self.wanted:
            row["poles"] = None if bad is not None else [[p.real, p.imag] for p in self.poles[index].tolist()]
        if "bode" in self.wanted:
            pairs = np.stack([self.response[index].real, self.response[index].imag], axis=-1)
            row["bode"] = None if bad is not None else self._by_channel(pairs)
            row["phase_deg"] = None if bad is not None else self._by_channel(self.phase_deg[index])
        return row

    def _by_channel(self, numbers: Array) -> dict[str, dict[str, list[Any]]]:
        """Return lists over the frequencies by output and input of (frequencies, outputs, inputs, ...)."""
        inputs, outputs = self.channels
        return {o: {i: numbers[:, b, a].tolist() for a, i in enumerate(inputs)} for b, o in enumerate(outputs)}

    @property
    def heading(self) -> dict[str, Any]:
        """Return the part of sweep.json beside the points: parameters with axis and base, units, what was compared, failures."""
        kinds = {n: a for a in self.axes for n in a.names}
        return {
            "parameters": {
                n: {"unit": self.units[n], "base": self.base[n], "kind": kinds[n].kind, "points": len(kinds[n])}
                for n in self.parameters
            },
            "against": self.against,
            "units": {o: u for (o, _), u in zip(self.series, self.series_units, strict=True)},
            "wanted": list(self.wanted),
            **({"omega": self.omega.tolist()} if "bode" in self.wanted else {}),
            "count": len(self),
            "failed": len(self.failed),
            "failure": self.failed[min(self.failed)] if self.failed else "",
            "best": plain(self.bests),
        }

    def to_dict(self) -> dict[str, Any]:
        """The sweep as sweep.json has it, without its heading."""
        return {**self.heading, "points": list(self.rows())}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> SweepResult:
        """Return the sweep that `to_dict` wrote, or that a sweep.json holds. Raises InputError for anything else."""
        told = read_fields(_Told, data)
        rows, names = told.points, list(told.parameters)
        values = np.array([[p.values[n] for n in names] for p in rows], dtype=float).reshape(len(rows), len(names))
        first = rows[0] if rows else _Point({}, {}, "done")
        series = tuple((o, e) for o, line in first.rmse.items() for e in line)
        whole = next((p for p in rows if p.bode is not None), first)
        channels = (tuple(next(iter((whole.bode or {}).values()), {})), tuple(whole.bode or {}))
        modes = max((p.poles.size for p in rows if p.poles is not None), default=0)
        shape = (told.omega.size, len(channels[1]), len(channels[0]))
        poles = [p.poles if p.poles is not None else np.full(modes, np.nan) for p in rows]

        def table(channel_values: Mapping[str, Mapping[str, Any]] | None) -> Array:
            if channel_values is None:
                return np.full(shape, np.nan)
            return np.array([[channel_values[o][i] for i in channels[0]] for o in channels[1]]).transpose(2, 0, 1)

        rmse = [[np.nan if (v := p.rmse[o][e]) is None else v for o, e in series] for p in rows]
        return cls(
            str(data.get("model", "")),
            _axes_of(told.parameters, values),
            FrozenMap({n: p.unit for n, p in told.parameters.items()}),
            series,
            tuple(told.units.get(o, "") for o, _ in series),
            told.against,
            FrozenMap({n: p.base for n, p in told.parameters.items()}),
            np.array(rmse, dtype=float).reshape(len(rows), len(series)),
            np.array(poles, dtype=complex).reshape(len(rows), modes),
            told.omega,
            np.array([table(p.bode) for p in rows], dtype=complex).reshape(len(rows), *shape),
            np.array([table(p.phase_deg) for p in rows], dtype=float).reshape(len(rows), *shape),
            channels,
            {k: p.reason for k, p in enumerate(rows) if p.status == "failed"},
            told.wanted,
        )

    def to_csv(self) -> str:
        """CSV text, one row a point: parameters, rmse.OUTPUT.EXPERIMENT, status, reason; every digit of every number.

        Text that a spreadsheet would take for a formula begins with an apostrophe.
        """
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        header = [*self.parameters, *(f"rmse.{o}.{e}" for o, e in self.series), "status", "reason"]
        writer.writerow([csv_cell(h) for h in header])
        for start in range(0, len(self), 1024):
            block = self.points.rows(start, start + 1024).tolist()
            errors = self.rmse[start : start + 1024].tolist()
            for offset, (values, line) in enumerate(zip(block, errors, strict=True)):
                bad = self.failed.get(start + offset)
                numbers = ["" if bad is not None or not math.isfinite(v) else repr(v) for v in line]
                writer.writerow(
                    [*map(repr, values), *numbers, "done" if bad is None else "failed", csv_cell(bad or "")]
                )
        return stream.getvalue()

    def to_xarray(self) -> xarray.Dataset:
        """A dataset over the axes (a hypercube's rows are one axis): rmse, status, reason, poles, response and phase."""
        import xarray

        dims = [a.names[0] if len(a.names) == 1 else f"point{k or ''}" for k, a in enumerate(self.axes)]
        shape = self.points.shape
        coords: dict[str, Any] = {}
        for dim, axis in zip(dims, self.axes, strict=True):
            for column, name in enumerate(axis.names):
                coords[name] = (dim, axis.values[:, column], {"units": self.units[name]})
        outputs, experiments = (list(dict.fromkeys(s[k] for s in self.series)) for k in (0, 1))
        errors = np.full((len(self), len(outputs), len(experiments)), np.nan)
        for k, (o, e) in enumerate(self.series):
            errors[:, outputs.index(o), experiments.index(e)] = self.rmse[:, k]
        reasons = np.array([self.failed.get(i, "") for i in range(len(self))], dtype=object)
        data: dict[str, Any] = {
            "rmse": ((*dims, "output", "experiment"), errors.reshape(*shape, len(outputs), len(experiments))),
            "status": (dims, np.where(reasons == "", "done", "failed").reshape(shape)),
            "reason": (dims, reasons.reshape(shape)),
        }
        coords |= {"output": outputs, "experiment": experiments}
        if "poles" in self.wanted:
            data["poles"] = ((*dims, "mode"), self.poles.reshape(*shape, -1), {"units": "1/s"})
        if "bode" in self.wanted:
            coords |= {"omega": self.omega, "response_input": list(self.channels[0])}
            coords["response_output"] = list(self.channels[1])
            axes = (*dims, "omega", "response_output", "response_input")
            data["response"] = (axes, self.response.reshape(*shape, *self.response.shape[1:]))
            data["phase"] = (axes, self.phase_deg.reshape(*shape, *self.response.shape[1:]), {"units": "degrees"})
        return xarray.Dataset(data, coords=coords, attrs={"model": self.model, "against": self.against})

    def plot(self, ax: Any = None) -> Any:
        """Axes with the RMSE over the first parameter: a curve a series, points where several parameters move."""
        axes = axes_of(ax)
        name = self.parameters[0]
        x = self.values(name)
        for k, (output, experiment) in enumerate(self.series):
            style = "-" if len(self.parameters) == 1 else "."
            axes.plot(x, self.rmse[:, k], style, label=f"{output}, {experiment}")
        axes.axvline(self.base[name], color="0.6", linestyle=":")
        unit = self.units[name]
        axes.set_xlabel(with_unit(name, unit))
        axes.set_ylabel(
            "RMSE" + (f", {self.series_units[0]}" if len(set(self.series_units)) == 1 and self.series_units[0] else "")
        )
        if self.series:
            axes.legend()
        return axes

    def to_dataframe(self) -> Any:
        """Return a pandas DataFrame, a row a point: parameters, RMSE by output and experiment, status and reason.

        Raises InputError where pandas is missing.
        """
        points = self.points.rows(0, len(self))
        columns: dict[str, Any] = {n: points[:, k] for k, n in enumerate(self.parameters)}
        columns |= {f"rmse.{o}.{e}": self.rmse[:, k] for k, (o, e) in enumerate(self.series)}
        reasons = [self.failed.get(i, "") for i in range(len(self))]
        return data_frame({**columns, "status": ["failed" if r else "done" for r in reasons], "reason": reasons})

    def _screen(self) -> Iterator[str | Table]:
        yield f"Sweep of {', '.join(self.parameters)}: {len(self)} points, {len(self.failed)} failed"
        rows = []
        for line in self.bests:
            at = ", ".join(f"{n} = {v:.6g} {self.units[n]}".rstrip() for n, v in line.at.items())
            rows.append((line.output, line.experiment, line.unit, line.smallest, at, line.largest))
        yield Table(("output", "experiment", "unit", "smallest RMSE", "at", "largest"), tuple(rows)) if rows else ""
        if "poles" in self.wanted and np.isfinite(self.poles).any():
            right = self.poles.real[np.isfinite(self.poles).all(axis=1)].max(axis=1)
            yield f"Rightmost pole: {np.min(right):.4g} to {np.max(right):.4g} 1/s; {int((right > 0).sum())} points are unstable"
        yield f"The first that failed: {next(iter(self.failed.values()))}" if self.failed else ""


# --- run ---


def sweep(
    model: AnyModel,
    experiments: Sequence[Experiment],
    axes: AxesLike,
    *,
    against: Against = "data",
    outputs: Sequence[str] | None = None,
    values: Mapping[str, float] | None = None,
    want: Sequence[Want] | Quantities = ("rmse",),
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> SweepResult:
    """Return a row for each point: the RMSE of each output in each experiment, and poles or frequency response if wanted.

    axes: `grid`, `log_grid`, `listed`, `latin_hypercube`, several of them (their product, the last moves fastest), or
    {name: values}; parameters, or inputs that no experiment moves, in their units. against: the recordings, the run at
    the base values, or another model's run. outputs: default, the recorded ones (against data), else all the model's.
    values: of the base where they are not the model's. want: names of quantities; `Quantities` says of which frequency
    response. executor: where points run; rows and digits do not depend on it. A point that fails is a row with a reason and no
    number.

    Raises InputError for names, values, bounds or data that do not fit, ComputationError where the reference fails.

    >>> from hvdc_ident import load_model
    >>> from hvdc_ident.sensitivity import sweep
    >>> result = sweep(load_model("vsc-hvdc-link"), [], {"KIVDC": [250.0, 750.0, 1500.0]}, want=["poles"])
    >>> len(result), result.poles.shape
    (3, (3, 6))
    """
    points = points_of(axes)
    base = FrozenMap(values or {})
    quantities = want if isinstance(want, Quantities) else Quantities(want)
    check(model, experiments, points, base, quantities.names)
    task = task_of(model, tuple(experiments), points.names, base, against, outputs, quantities)
    count = len(points)
    rmse = np.full((count, len(task.references)), np.nan)
    poles = np.full((count, task.poles), np.nan, dtype=complex)
    response = np.full((count, task.omega.size, len(task.outputs), len(task.inputs)), np.nan, dtype=complex)
    phase = np.full(response.shape, np.nan)
    failed: dict[int, str] = {}
    items = Made(partial(_row, points), range(count))
    swept = map(Outcome, itertools.count(), map(task, items)) if executor is None else outcomes(executor, task, items)
    for done, outcome in enumerate(swept, start=1):
        k, value = outcome.index, outcome.value
        if outcome.failure or isinstance(value, str):
            failed[k] = outcome.failure or value
        else:
            rmse[k], poles[k], response[k], phase[k] = value
        if progress:
            progress(done, count, "points")
    known: dict[str, Any] = {**model.inputs, **model.parameters}
    return SweepResult(
        model=model.name,
        axes=points.axes,
        units=FrozenMap({n: known[n].unit for n in points.names}),
        series=tuple((r.output, r.experiment) for r in task.references),
        series_units=tuple(model.outputs[r.output].unit if r.output in model.outputs else "" for r in task.references),
        against=against if isinstance(against, str) else against.name,
        base=FrozenMap({n: float(base.get(n, known[n].value)) for n in points.names}),
        rmse=rmse,
        poles=poles,
        omega=task.omega,
        response=response,
        phase_deg=phase,
        channels=(task.inputs, task.outputs) if task.omega.size else ((), ()),
        failed=dict(sorted(failed.items())),
        wanted=tuple(quantities.names),
    )


def _row(points: Points, index: int) -> Array:
    """Return the values of a point, (k,)."""
    return points.rows(index, index + 1)[0]
