"""Sweeps: a model run at many points of its parameters, compared with data, another model or itself."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Experiment
from hvdc_ident.executor import Executor, Progress, ends
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel
from hvdc_ident.sensitivity.sampling import AxesLike, Points, points_of
from hvdc_ident.sensitivity.sweep_point import PointTask, Want, check, task_of
from hvdc_ident.sensitivity.sweep_result import SweepResult

CHUNK = 2048  # points looked up, queued or written at a time
PROBE, WORTH = 0.3, 2.0  # s: points run here first; work left that is worth starting other processes for
TOLD = 0.1  # s between two reports of progress


class Kept(Protocol):
    """Store of finished points: bytes by key."""

    def get(self, keys: Sequence[bytes], /) -> Mapping[bytes, bytes]: ...
    def put(self, key: bytes, value: bytes, /) -> None: ...


@dataclass
class _Table:
    """The numbers as they come in; rows stand where their points stand."""

    task: PointTask
    points: Points
    failed: dict[int, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n, t = len(self.points), self.task
        self.rmse = np.full((n, len(t.references)), np.nan)
        self.poles = np.full((n, t.poles), np.nan, dtype=complex)
        size = (t.omega.size, len(t.outputs), len(t.inputs)) if t.omega.size else (0, 0, 0)
        self.response = np.full((n, *size), np.nan, dtype=complex)

    def fill(self, index: int, packed: bytes) -> None:
        found = self.task.unpacked(packed)
        if isinstance(found, str):
            self.failed[index] = found
            return
        self.rmse[index], self.poles[index] = found[0], found[1]
        if self.task.omega.size:
            self.response[index] = found[2]


def sweep(
    model: AnyModel,
    experiments: Sequence[Experiment],
    axes: AxesLike,
    *,
    against: Literal["data", "base"] | AnyModel = "data",
    outputs: Sequence[str] | None = None,
    values: Mapping[str, float] | None = None,
    want: Sequence[Want] = ("rmse",),
    linear: tuple[Sequence[str], Sequence[str]] | None = None,
    omega: Array | None = None,
    executor: Executor | None = None,
    kept: Callable[[str], Kept] | None = None,
    progress: Progress | None = None,
) -> SweepResult:
    """Return a row for each point: the RMSE of each output in each experiment, and poles or frequency response if wanted.

    axes: `grid`, `log_grid`, `listed`, `latin_hypercube`, several of them (their product, the last moves fastest), or
    {name: values}; parameters, or inputs that no experiment moves, in their units. against: the recordings, the run at
    the base values, or another model's run. outputs: default, the recorded ones (against data), else all the model's.
    values: what the base is where it is not the model's. linear: (inputs, outputs) of the frequency response.
    omega: its frequencies, rad/s (default: 200 around the base's poles). executor: where points run if there is work
    for more than a few seconds; rows and digits do not depend on it. kept: given the task's fingerprint, where points
    are looked up and kept. A point that fails is a row with a reason and no number.

    Raises InputError for names, values, bounds or data that do not fit, ComputationError where the reference fails.

    >>> from hvdc_ident import load_model
    >>> from hvdc_ident.sensitivity import sweep
    >>> found = sweep(load_model("vsc-hvdc-link"), [], {"KIVDC": [250.0, 750.0, 1500.0]}, want=["poles"])
    >>> len(found), found.poles.shape
    (3, (3, 6))
    """
    points = points_of(axes)
    base = FrozenMap(values or {})
    check(model, experiments, points, base, want)
    task = task_of(model, tuple(experiments), points.names, base, against, outputs, want, linear, omega)
    shelf = kept(task.fingerprint) if kept else None
    table = _Table(task, points)
    told = _Told(progress, len(points))
    missing = _known(table, shelf, told)
    _run(table, missing, shelf, executor, told)
    told.close()
    return SweepResult(
        model=model.name,
        axes=points.axes,
        units=FrozenMap({n: _unit(model, n) for n in points.names}),
        series=tuple((r.output, r.experiment) for r in task.references),
        series_units=tuple(model.outputs[r.output].unit if r.output in model.outputs else "" for r in task.references),
        against=against if isinstance(against, str) else against.name,
        base=FrozenMap({n: _base_value(model, base, n) for n in points.names}),
        rmse=table.rmse,
        poles=table.poles,
        omega=task.omega,
        response=table.response,
        channels=(task.inputs, task.outputs) if task.omega.size else ((), ()),
        failed=dict(sorted(table.failed.items())),
        wanted=tuple(want),
    )


def _known(table: _Table, shelf: Kept | None, told: _Told) -> NDArray[np.intp]:
    """The places of points that are not kept yet; those that are, are filled in."""
    n = len(table.points)
    if shelf is None:
        return np.arange(n)
    open_ = []
    for start in range(0, n, CHUNK):
        keys = [row.tobytes() for row in table.points.rows(start, start + CHUNK)]
        found = shelf.get(keys)
        for offset, key in enumerate(keys):
            packed = found.get(key)
            if packed is None:
                open_.append(start + offset)
            else:
                table.fill(start + offset, packed)
    told.done = n - len(open_)
    return np.array(open_, dtype=np.intp)


def _run(table: _Table, missing: NDArray[np.intp], shelf: Kept | None, executor: Executor | None, told: _Told) -> None:
    """Every missing point run: here while that is quick, in the executor where there is much left."""
    begin, count = time.perf_counter(), 0
    for count, (index, row) in enumerate(_rows(table.points, missing), start=1):
        _finish(table, index, row, table.task(row), shelf, told)
        spent = time.perf_counter() - begin
        if executor is not None and spent > PROBE and spent / count * (missing.size - count) > WORTH:
            break
    left = missing[count:]
    if not left.size or executor is None:
        return
    for place, packed, failure in ends(executor, table.task, (row for _, row in _rows(table.points, left))):
        index = int(left[place])
        row = table.points.rows(index, index + 1)[0]
        if failure:
            table.failed[index] = failure
            told.step()
        else:
            _finish(table, index, row, packed, shelf, told)


def _finish(table: _Table, index: int, row: Array, packed: bytes, shelf: Kept | None, told: _Told) -> None:
    table.fill(index, packed)
    if shelf is not None:
        shelf.put(row.tobytes(), packed)
    told.step()


def _rows(points: Points, indices: NDArray[np.intp]) -> Iterator[tuple[int, Array]]:
    """(place, values) of each point, made a chunk at a time."""
    for start in range(0, indices.size, CHUNK):
        chosen = indices[start : start + CHUNK]
        first = int(chosen[0])
        block = points.rows(first, int(chosen[-1]) + 1) if chosen[-1] - first < 4 * CHUNK else None
        for index in map(int, chosen):
            yield index, block[index - first] if block is not None else points.rows(index, index + 1)[0]


class _Told:
    """Progress, told now and then."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self.progress, self.total, self.done, self.last = progress, total, 0, 0.0

    def step(self) -> None:
        self.done += 1
        now = time.perf_counter()
        if self.progress and now - self.last > TOLD:
            self.last = now
            self.progress(self.done, self.total, "points")

    def close(self) -> None:
        if self.progress:
            self.progress(self.total, self.total, "points")


def _unit(model: AnyModel, name: str) -> str:
    return model.parameters[name].unit if name in model.parameters else model.inputs[name].unit


def _base_value(model: AnyModel, base: Mapping[str, float], name: str) -> float:
    own = model.parameters[name].value if name in model.parameters else model.inputs[name].value
    return float(base.get(name, own))
