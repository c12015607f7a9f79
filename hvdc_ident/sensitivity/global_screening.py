"""Global screening of parameters over their ranges: Morris' elementary effects and Sobol's indices, through SALib.

SALib is an extra: pip install 'hvdc_ident[screening]'. Morris 1991, doi 10.1080/00401706.1991.10484804; Saltelli et al.
2010, doi 10.1016/j.cpc.2009.09.018.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from hvdc_ident.codec import Coded
from hvdc_ident.data import Array, Experiment
from hvdc_ident.display import Shown, Table, axes_of, library
from hvdc_ident.errors import ComputationError, StudyError
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel
from hvdc_ident.sensitivity.local_sensitivities import bars
from hvdc_ident.sensitivity.sweep_points import Samples
from hvdc_ident.sensitivity.sweep_run import SweepResult, sweep

if TYPE_CHECKING:
    import xarray


Measures = FrozenMap[FrozenMap[FrozenMap[FrozenMap[float]]]]


@dataclass(frozen=True, eq=False, repr=False)
class ScreeningResult(Coded, Shown):
    """Measures of a screening for the RMSE of each output in each experiment.

    measures: by output, experiment, parameter and name. Morris: mu_star, mu, sigma, mu_star_conf, in the output's unit over the
    whole range. Sobol: S1, ST, S1_conf, ST_conf: shares of the variance. failed: points that failed; dropped: Morris
    trajectories left out because of them.
    """

    method: Literal["morris", "sobol"]
    evaluations: int
    failed: int
    dropped: int
    measures: Measures

    @property
    def measure(self) -> str:
        """The name of the measure of a parameter's whole effect."""
        return "mu_star" if self.method == "morris" else "ST"

    @property
    def series(self) -> tuple[tuple[str, str], ...]:
        """Every output with every experiment."""
        return tuple((o, e) for o, line in self.measures.items() for e in line)

    @property
    def parameters(self) -> tuple[str, ...]:
        """The parameters that were screened."""
        return tuple(next((p for line in self.measures.values() for p in line.values()), ()))

    def of(self, output: str, experiment: str) -> FrozenMap[FrozenMap[float]]:
        """Return the measures of one output in one experiment by parameter, the one that matters most first."""
        measures = self.measures[output][experiment]
        return FrozenMap(sorted(measures.items(), key=lambda line: -line[1][self.measure]))

    def array(self, name: str) -> Array:
        """Return one measure, (series, parameters)."""
        return np.array([[line[name] for line in self.measures[o][e].values()] for o, e in self.series])

    @property
    def _names(self) -> tuple[str, ...]:
        return MORRIS if self.method == "morris" else SOBOL

    def to_xarray(self) -> xarray.Dataset:
        """The measures over series ("OUTPUT.EXPERIMENT") and parameter."""
        import xarray

        axes = {"series": [f"{o}.{e}" for o, e in self.series], "parameter": list(self.parameters)}
        data = {n: (tuple(axes), self.array(n)) for n in self._names}
        return xarray.Dataset(data, coords=axes, attrs={"method": self.method})

    def plot(self, ax: Any = None) -> Any:
        """Axes with a bar for every parameter and series: mu_star, or the total share of the variance."""
        axes = axes_of(ax)
        labels = [f"{o} in {e}" for o, e in self.series]
        heights, errors = (
            dict(zip(labels, self.array(n), strict=True)) for n in (self.measure, f"{self.measure}_conf")
        )
        bars(axes, self.parameters, heights, errors)
        axes.set_ylabel(f"{self.measure} of the RMSE")
        return axes

    def _screen(self) -> Iterator[str | Table]:
        yield f"Screening by the method of {self.method.capitalize()}: {self.evaluations} runs, {self.failed} failed"
        lines = (
            (o, e, p, *(f"{m[n]:.4g}" for n in self._names))
            for o, e in self.series
            for p, m in self.measures[o][e].items()
        )
        yield Table(("output", "experiment", "parameter", *self._names), tuple(lines))


MORRIS = ("mu_star", "mu", "sigma", "mu_star_conf")
SOBOL = ("S1", "ST", "S1_conf", "ST_conf")
LEVELS = 4
"""Levels of Morris' grid."""


def morris(
    model: AnyModel,
    experiments: Sequence[Experiment],
    ranges: Mapping[str, tuple[float, float]],
    *,
    trajectories: int = 20,
    seed: int = 0,
    **options: Any,
) -> ScreeningResult:
    """Return elementary effects of the RMSE over the ranges (Morris 1991, doi 10.1080/00401706.1991.10484804), through SALib.

    It takes trajectories (k + 1) runs for k parameters. A trajectory with a failed run is left out and counted.

    Parameters
    ----------
    model : Model
        The model, or an FMU.
    experiments : list of Experiment
        The recordings with which the runs are compared.
    ranges : dict of (float, float)
        (min, max) by parameter, in its unit.
    trajectories : int, default 20
        How many, at least 2.
    seed : int, default 0
        Of the points; same seed, same result.
    **options
        Arguments of `hvdc_ident.sensitivity.sweep`: against, outputs, values, executor, progress.

    Returns
    -------
    ScreeningResult
        By output, experiment and parameter mu_star, mu, sigma and mu_star_conf, in the output's unit over the whole range; `failed` points
        and `dropped` trajectories.

    Raises
    ------
    InputError
        SALib is not installed.
    StudyError
        Ranges that are not finite with min < max, or too few trajectories.
    ComputationError
        Fewer than two trajectories are whole.

    Examples
    --------
    >>> import numpy as np, hvdc_ident as hi
    >>> lag = hi.Model("lag", parameters={"T": 1.0, "k": 2.0}, inputs={"u": 0.0}, states={"x": "(k*u - x)/T"}, outputs={"y": "x"})
    >>> t, u = np.linspace(0.0, 5.0, 51), {"u": hi.step(0.0, 1.0, at=1.0)}
    >>> record = hi.Experiment(t, "step", inputs=u, outputs={"y": hi.simulate(lag, t, inputs=u)["y"]})
    >>> screening = hi.sensitivity.morris(lag, [record], {"T": (0.9, 1.1), "k": (1.0, 3.0)}, trajectories=4)
    >>> screening.evaluations, list(screening.of("y", "step"))  # k matters most
    (12, ['k', 'T'])
    """
    library("SALib", "global screening", "'hvdc_ident[screening]'")
    from SALib.analyze import morris as analyse
    from SALib.sample import morris as sample

    problem = _problem(ranges, trajectories)
    points = _points(sample.sample, problem, trajectories, num_levels=LEVELS, seed=seed)
    swept = sweep(model, experiments, points, **options)
    good = np.isfinite(swept.rmse).all(axis=1)
    whole = good.reshape(trajectories, -1).all(axis=1)
    if whole.sum() < 2:
        got = f"{whole.sum()} of {trajectories}; {next(iter(swept.failed.values()), '')}"
        raise ComputationError("too few Morris trajectories are whole", got=got)
    rows = np.repeat(whole, len(ranges) + 1)

    def effects(rmse: Array) -> Mapping[str, Any]:
        return analyse.analyze(problem, points.values[rows], rmse[rows], num_levels=LEVELS, seed=seed)

    measures = _measures(MORRIS, effects, swept, tuple(ranges))
    return ScreeningResult("morris", len(points), int((~good).sum()), int((~whole).sum()), measures)


def sobol(
    model: AnyModel,
    experiments: Sequence[Experiment],
    ranges: Mapping[str, tuple[float, float]],
    *,
    samples: int = 256,
    seed: int = 0,
    **options: Any,
) -> ScreeningResult:
    """Return first-order and total shares of the RMSE's variance over the ranges (Saltelli et al. 2010, doi 10.1016/j.cpc.2009.09.018).

    It takes samples (k + 2) runs for k parameters, through SALib.

    Parameters
    ----------
    model : Model
        The model, or an FMU.
    experiments : list of Experiment
        The recordings with which the runs are compared.
    ranges : dict of (float, float)
        (min, max) by parameter, in its unit.
    samples : int, default 256
        How many; a power of 2.
    seed : int, default 0
        Of the points; same seed, same result.
    **options
        Arguments of `hvdc_ident.sensitivity.sweep`: against, outputs, values, executor, progress.

    Returns
    -------
    ScreeningResult
        By output, experiment and parameter S1 and ST, shares of the variance, with S1_conf and ST_conf.

    Raises
    ------
    InputError
        SALib is not installed.
    StudyError
        Ranges that are not finite with min < max, or a number of samples that is no power of 2.
    ComputationError
        A run fails: the indices need every one.

    Examples
    --------
    >>> import numpy as np, hvdc_ident as hi
    >>> lag = hi.Model("lag", parameters={"T": 1.0, "k": 2.0}, inputs={"u": 0.0}, states={"x": "(k*u - x)/T"}, outputs={"y": "x"})
    >>> t, u = np.linspace(0.0, 5.0, 51), {"u": hi.step(0.0, 1.0, at=1.0)}
    >>> record = hi.Experiment(t, "step", inputs=u, outputs={"y": hi.simulate(lag, t, inputs=u)["y"]})
    >>> screening = hi.sensitivity.sobol(lag, [record], {"T": (0.9, 1.1), "k": (1.0, 3.0)}, samples=16)
    >>> screening.evaluations, list(screening.of("y", "step"))  # k matters most
    (64, ['k', 'T'])
    """
    library("SALib", "global screening", "'hvdc_ident[screening]'")
    from SALib.analyze import sobol as analyse
    from SALib.sample import sobol as sample

    if samples < 2 or samples & (samples - 1):
        raise StudyError("the number of samples is wrong", where="sobol", expected="a power of 2", got=str(samples))
    problem = _problem(ranges, samples)
    points = _points(sample.sample, problem, samples, calc_second_order=False, seed=seed)
    swept = sweep(model, experiments, points, **options)
    failed = int((~np.isfinite(swept.rmse).all(axis=1)).sum())
    if failed:
        raise ComputationError(
            "Sobol's indices need every run",
            got=f"{failed} of {len(points)} failed; {next(iter(swept.failed.values()), '')}",
            hint="narrower ranges, or morris",
        )

    def indices(rmse: Array) -> Mapping[str, Any]:
        return analyse.analyze(problem, rmse, calc_second_order=False, seed=seed)

    return ScreeningResult("sobol", len(points), 0, 0, _measures(SOBOL, indices, swept, tuple(ranges)))


def _problem(ranges: Mapping[str, tuple[float, float]], count: int) -> dict[str, Any]:
    """Return the ranges as SALib takes them. Raises StudyError for wrong ones, or too few samples."""
    wrong = [n for n, (low, high) in ranges.items() if not (np.isfinite([low, high]).all() and low < high)]
    if not ranges or wrong or count < 2:
        raise StudyError(
            "a screening's ranges or its size are wrong",
            expected="finite min < max for at least one parameter, and at least 2 samples",
            got=f"{', '.join(wrong) or len(ranges)}; {count} samples",
        )
    return {"num_vars": len(ranges), "names": list(ranges), "bounds": [list(map(float, r)) for r in ranges.values()]}


def _points(sample: Callable[..., Any], problem: Mapping[str, Any], count: int, **options: Any) -> Samples:
    """Return the points that SALib draws in the ranges, its warnings silenced."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Samples(tuple(problem["names"]), sample(problem, count, **options))


def _measures(
    names: Sequence[str], analyse: Callable[[Array], Mapping[str, Any]], swept: SweepResult, parameters: tuple[str, ...]
) -> Measures:
    """Return the measures of every series of a sweep, by output, experiment, parameter and name."""
    measures: dict[str, dict[str, FrozenMap[FrozenMap[float]]]] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for (output, experiment), column in zip(swept.series, swept.rmse.T, strict=True):
            line = analyse(column)
            rows = zip(*(np.asarray(line[n], dtype=float).tolist() for n in names), strict=True)
            each = {p: FrozenMap(zip(names, row, strict=True)) for p, row in zip(parameters, rows, strict=True)}
            measures.setdefault(output, {})[experiment] = FrozenMap(each)
    return FrozenMap({o: FrozenMap(line) for o, line in measures.items()})
