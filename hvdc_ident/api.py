"""The verbs of the package: five lines for each job, with a model, a study or plain arrays.

Each puts together what is meant (`study.assemble`) and calls the room that does the work. Nothing heavy is imported before
a verb is called.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import wraps
from typing import TYPE_CHECKING, Any, Literal, ParamSpec, TypeAlias, TypeVar

# The rooms are there before the package binds the verbs of the same names: an import of a room would replace them later.
import hvdc_ident.fit
import hvdc_ident.linearize
import hvdc_ident.simulate  # noqa: F401

if TYPE_CHECKING:
    from pathlib import Path

    from hvdc_ident.data import Array, Experiment, SignalLike
    from hvdc_ident.discrepancy import Diagnosis
    from hvdc_ident.executor import Executor, Progress
    from hvdc_ident.fit import FitResult, Problem
    from hvdc_ident.identifiability import IdentifiabilityReport
    from hvdc_ident.linearize import FrequencyResponse, LinearModel, OperatingPoint, Side
    from hvdc_ident.sensitivity import LocalSensitivities, Ranges, SweepResult
    from hvdc_ident.simulate import Simulation, Tolerance
    from hvdc_ident.study.assemble import DataLike, ModelLike, ParametersLike
    from hvdc_ident.study.export import FmuOptions
    from hvdc_ident.study.study import Study
    from hvdc_ident.study.summary import Summary

Values: TypeAlias = "Mapping[str, float] | FitResult | None"
Names: TypeAlias = "str | Iterable[str] | None"
Workers: TypeAlias = "Executor | int | None"
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def _verb(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return the function as a caller in Python meets it: its errors say what to do in Python, and names of 0.2 still work."""
    from hvdc_ident.errors import in_python

    told = in_python(function)

    @wraps(function)
    def verb(*arguments: Arguments.args, **settings: Arguments.kwargs) -> Result:
        from hvdc_ident.aliases import current

        given, named = current(function.__name__, arguments, settings)
        return told(*given, **named)

    return verb


@_verb
def simulate(
    model: ModelLike,
    data: Any = None,
    values: Values = None,
    sensitivities: Names = (),
    *,
    inputs: Mapping[str, SignalLike] | None = None,
    outputs: Names = None,
    tolerance: Tolerance | None = None,
    rtol: float | None = None,
    method: Literal["auto", "explicit", "rosenbrock"] = "auto",
    partial: bool = False,
) -> Simulation:
    """Return the model's outputs over time and, exactly, their derivatives by the named parameters.

    The start is the steady state of the inputs' first values unless a state says otherwise; an FMU begins at its own start.

    Parameters
    ----------
    model : Model, Study, str or Path
        A Model, a shipped name, the path of a card, an FMU or a study, or a Study.
    data : array of float (n,), Experiment or str, default None
        Times in s, an Experiment, or the name of an experiment of the study. None: the study's only one.
    values : dict of float or FitResult, default None
        Values of parameters by name, in the model's units, where they differ from the model's; or a FitResult: its estimates.
    sensitivities : str or list of str, default ()
        Names of parameters by which the derivatives are wanted. The name of an input asks for the derivative by a constant added to it,
        that of a state for the derivative by its start.
    inputs : dict, default None
        By name a number, a signal (`step`, `ramp`, `multisine`) or samples (n,) at the times, in the input's unit. Other inputs keep
        the experiment's signal, or else the model's value.
    outputs : str or list of str, default None
        Names of outputs or signals. None: all outputs.
    tolerance : Tolerance, default None
        Error control of the integration. None: a relative error of 1e-8 and an absolute one of 1e-10, in the states' units.
    rtol : float, default None
        Shorthand for a tolerance with this relative error and atol = rtol / 100.
    method : "auto", "explicit" or "rosenbrock", default "auto"
        The integrator. "auto" takes the explicit one where no eigenvalue is so fast that it would rule the step. An FMU has its own.
    partial : bool, default False
        True gives, of a run that an FMU ends, the rows up to there, with status "ended"; else such a run has failed.

    Returns
    -------
    Simulation
        The outputs at the n times, in their units: `run["NAME"]` is (n,). `run.gradient("NAME")` is (n, parameters), in output unit
        per parameter unit.

    Raises
    ------
    InputError
        No times, or several experiments and none chosen; a value that is no number.
    UnknownNameError
        A name of a parameter, input, output or experiment that is not there.
    SteadyStateError
        There is no steady start.
    SimulationError
        The run stops early.

    Examples
    --------
    >>> import numpy as np, hvdc_ident as hi
    >>> t = np.linspace(0.0, 0.5, 6)
    >>> run = hi.simulate("vsc-hvdc-link", t, inputs={"Pref2": hi.step(0.4, 0.5, at=0.1)}, outputs="Irorder2")
    >>> run["Irorder2"].round(3).tolist()
    [0.4, 0.4, 0.495, 0.5, 0.5, 0.5]
    """
    from hvdc_ident.simulate import simulate as run
    from hvdc_ident.study.assemble import model_of, names_of, subject_of, values_of

    subject = subject_of(model)
    plant = model_of(subject)
    return run(
        plant,
        _experiment(subject, data, inputs),
        values_of(values, plant),
        names_of(sensitivities, "parameter") or (),
        outputs=names_of(outputs, "output"),
        tolerance=tolerance,
        rtol=rtol,
        method=method,
        partial=partial,
    )


@_verb
def find_operating_point(
    model: ModelLike,
    inputs: Mapping[str, float] | None = None,
    outputs: Mapping[str, float] | None = None,
    values: Values = None,
    *,
    free: Names = None,
    at: Literal["steady", "start"] = "steady",
    **search: Any,
) -> OperatingPoint:
    """Return the operating point at which every derivative is 0.

    Parameters
    ----------
    model : Model, Study, str or Path
        A Model, a shipped name, the path of a card, an FMU or a study, or a Study.
    inputs : dict of float, default None
        Values of inputs by name (or of parameters, states and signals that are to hold), in the model's units. An input that is not
        named keeps the model's value.
    outputs : dict of float, default None
        Values that outputs are to have (a trimmed point), in their units. The inputs that move them at rest are then found, or the
        inputs and parameters in `free`.
    values : dict of float or FitResult, default None
        Values of parameters by name, in the model's units, where they differ from the model's; or a FitResult: its estimates.
    free : str or list of str, default None
        Names of inputs and parameters to be found. None: where `outputs` are given, the inputs that move these outputs at rest, if they
        are as many.
    at : "steady" or "start", default "steady"
        "start": states with a given start stand there and only the rest is solved.
    **search
        Arguments of the search: `bounds`, {name: (low, high)} of anything but a fixed name; `guess`, {name: value} where it begins;
        `moving`, names of states whose derivative need not be 0; `time`, the instant in s (default 0).

    Returns
    -------
    OperatingPoint
        The values of states, unknowns, inputs, outputs and parameters by name, in the model's units.

    Raises
    ------
    UnknownNameError
        A name that the model lacks.
    SteadyStateError
        There is no such point; the error names the worst equation.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> point = hi.find_operating_point("vsc-hvdc-link", {"Pref2": 0.5})
    >>> round(point.outputs["P2"], 9)
    0.5
    >>> trimmed = hi.find_operating_point("vsc-hvdc-link", outputs={"P2": 0.6})
    >>> round(trimmed.inputs["Pref2"], 9)
    0.6
    """
    from hvdc_ident.linearize import find_operating_point as find
    from hvdc_ident.study.assemble import model_of, names_of, values_of

    plant = model_of(model)
    fixed = {**values_of(values, plant), **(inputs or {})}
    return find(plant, fixed, names_of(free, "parameter or input") or (), outputs=outputs, at=at, **search)


@_verb
def linearize(
    model: ModelLike,
    point: OperatingPoint | None = None,
    *,
    inputs: Names = None,
    outputs: Names = None,
    values: Values = None,
    sensitivities: Names = (),
    pade_order: int | None = None,
    side: Side = "refuse",
    descriptor: bool = False,
) -> LinearModel:
    """Return the linear model between inputs and outputs at an operating point.

    Of a study, what is not named here is as its [linearize] states it: inputs, outputs, side and the operating point.

    Parameters
    ----------
    model : Model, Study, str or Path
        A Model, a shipped name, the path of a card, an FMU or a study, or a Study.
    point : OperatingPoint, default None
        Where. None: the steady state at the model's values and `values`, or the point of a study's [linearize].
    inputs : str or list of str, default None
        Names of inputs. None: all, or those of a study's [linearize].
    outputs : str or list of str, default None
        Names of outputs or signals. None: all outputs, or those of a study's [linearize].
    values : dict of float or FitResult, default None
        Values of parameters by name, in the model's units, where they differ from the model's; or a FitResult: its estimates. They count
        where no point is given.
    sensitivities : str or list of str, default ()
        Parameters whose exact derivatives of A, B, C, D come along, the shift of the operating point included.
    pade_order : int, default None
        Order of the Pade approximant of every delay in the state space. None: 5. Frequency responses take delays exactly.
    side : "refuse", "below" or "above", default "refuse"
        Of a limit on which the point lies: the derivative below or above it, or an error.
    descriptor : bool, default False
        True keeps the algebraic unknowns as states, with E.

    Returns
    -------
    LinearModel
        E dx/dt = A x + B u, y = C x + D u for the deviations from the point, in the model's units, time in s: A (n, n), B (n, inputs),
        C (outputs, n), D (outputs, inputs).

    Raises
    ------
    UnknownNameError
        An input, output, signal or parameter that the model lacks.
    SteadyStateError
        There is no steady state, where no point is given.
    LinearizationError
        The point lies on a kink, an algebraic loop is ill-posed, an entry is not finite, or an FMU cannot answer what is asked.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> linear = hi.linearize("vsc-hvdc-link", inputs="Vdcref1", outputs="Irorder1")
    >>> linear.A.shape, linear.D.shape
    ((6, 6), (1, 1))
    """
    from hvdc_ident.linearize import find_operating_point as find
    from hvdc_ident.linearize import linearize as linear_model
    from hvdc_ident.study.assemble import is_study, model_of, names_of, subject_of, values_of
    from hvdc_ident.study.linear_analysis import operating_point

    subject = subject_of(model)
    plant = model_of(subject)
    asked = subject.settings.linearize if is_study(subject) else None
    known = values_of(values, plant)
    if point is None and is_study(subject):
        point = operating_point(subject, {**subject.given, **known})
    elif point is None:
        point = find(plant, known)
    return linear_model(
        plant,
        point,
        inputs=names_of(inputs, "input") or (asked.inputs if asked else None),
        outputs=names_of(outputs, "output") or (asked.outputs if asked else None),
        pade_order=pade_order,
        sensitivities=names_of(sensitivities, "parameter") or (),
        side=asked.side if asked and side == "refuse" else side,
        descriptor=descriptor,
    )


@_verb
def bode(
    model: ModelLike | LinearModel,
    omega: Sequence[float] | Array | None = None,
    *,
    inputs: Names = None,
    outputs: Names = None,
    values: Values = None,
    point: OperatingPoint | None = None,
) -> FrequencyResponse:
    """Return the frequency response between inputs and outputs, delays exact; it draws itself with `plot()`.

    Parameters
    ----------
    model : Model, Study, LinearModel, str or Path
        A Model, a shipped name, the path of a card, an FMU or a study, a Study, or a LinearModel.
    omega : array of float (n,), default None
        Frequencies in rad/s. None: from a decade below the slowest to a decade above the fastest pole that the response shows.
    inputs : str or list of str, default None
        Names of inputs. None: all, or those of a study's [linearize].
    outputs : str or list of str, default None
        Names of outputs or signals. None: all outputs, or those of a study's [linearize].
    values : dict of float or FitResult, default None
        Values of parameters by name, in the model's units, where they differ from the model's; or a FitResult: its estimates. They count
        where no point is given; a LinearModel has its own.
    point : OperatingPoint, default None
        Where the model is linearised. None: its steady state, or the point of a study's [linearize]; a LinearModel has its own.

    Returns
    -------
    FrequencyResponse
        omega (n,) in rad/s and values (n, outputs, inputs), complex, in output unit per input unit.

    Raises
    ------
    UnknownNameError
        An input, output or signal that the model lacks.
    SteadyStateError
        There is no steady state, where no point is given.
    LinearizationError
        The point lies on a kink, or an algebraic loop is ill-posed.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> response = hi.bode("vsc-hvdc-link", [0.1, 30.0], inputs="Vdcref1", outputs="Irorder1")
    >>> response.magnitude.shape
    (2, 1, 1)
    """
    import numpy as np

    from hvdc_ident.linearize import LinearModel

    if isinstance(model, LinearModel):
        from hvdc_ident.study.assemble import names_of

        chosen = names_of(inputs, "input") or model.input_names, names_of(outputs, "output") or model.output_names
        linear = model.channel(*chosen)
    else:
        linear = linearize(model, point, inputs=inputs, outputs=outputs, values=values)
    return linear.bode(None if omega is None else np.atleast_1d(np.asarray(omega, dtype=float)))


@_verb
def sensitivities(
    model: ModelLike,
    data: Any = None,
    parameters: Names = None,
    *,
    inputs: Mapping[str, SignalLike] | Names = None,
    outputs: Names = None,
    values: Values = None,
    omega: Sequence[float] | Array | None = None,
    ranges: Ranges | None = None,
) -> LocalSensitivities:
    """Return the exact derivatives of trajectories, steady state, eigenvalues and frequency responses by parameters.

    Parameters
    ----------
    model : Model, Study, str or Path
        A Model, a shipped name, the path of a card or a study, or a Study; a model with equations.
    data : array of float (n,), Experiment or list of Experiment, default None
        Times in s, an Experiment, several, or left out: then a study's own, if a study is given.
    parameters : str or list of str, default None
        Names of parameters. None: all.
    inputs : dict, str or list of str, default None
        Where `data` are times, the input signals by name, as in `simulate`; else names of the inputs of the frequency response. None: all.
    outputs : str or list of str, default None
        Names of outputs or signals. None: of trajectories the recorded ones, else all outputs.
    values : dict of float or FitResult, default None
        Values of parameters by name, in the model's units, at which the derivatives are taken, where they differ from the model's;
        or a FitResult: its estimates.
    omega : array of float (m,), default None
        Frequencies of the responses in rad/s. None: around the poles.
    ranges : dict of (float, float), default None
        (min, max) by parameter, in its unit: their distance is the factor that normalises. None: the size of its value, or its range
        where that is 0.

    Returns
    -------
    LocalSensitivities
        `trajectories` by experiment and output (None without data), `steady` of the steady state, `linear` of eigenvalues and frequency
        responses (None where there is no linear model; `why` says it): in units per parameter unit, and normalised.

    Raises
    ------
    InputError
        A model without equations (an FMU).
    UnknownNameError
        A name of a parameter, input or output that is not there.
    SteadyStateError
        There is no steady state.
    SimulationError
        A run stops early.

    Examples
    --------
    >>> import numpy as np, hvdc_ident as hi
    >>> t = np.linspace(0.0, 0.5, 51)
    >>> result = hi.sensitivities("vsc-hvdc-link", t, "KIVDC", inputs={"Vdcref1": hi.step(1.0, 1.019, at=0.1)}, outputs="Irorder1")
    >>> result.trajectories is not None
    True
    """
    import numpy as np

    from hvdc_ident.errors import InputError
    from hvdc_ident.model import is_white_box
    from hvdc_ident.sensitivity import sensitivities as derivatives
    from hvdc_ident.study.assemble import experiments_of, is_study, model_of, names_of, subject_of, values_of

    subject = subject_of(model)
    plant = model_of(subject)
    if not is_white_box(plant):
        hint = "simulate(..., sensitivities=[...]) gives an FMU's derivatives"
        raise InputError(
            "exact sensitivities need the model's equations", where=f"model '{plant.name}'", got="an FMU", hint=hint
        )
    moved = inputs if isinstance(inputs, Mapping) else None
    seen = None if isinstance(inputs, Mapping) else names_of(inputs, "input")
    experiments: Sequence[Experiment] = ()
    if data is None:
        experiments = subject.experiments if is_study(subject) else ()
    elif moved is not None or _are_times(data):
        experiments = (_experiment(plant, data, moved),)
    else:
        experiments = experiments_of(data, plant)
    return derivatives(
        plant,
        experiments,
        names_of(parameters, "parameter"),
        values=values_of(values, plant),
        inputs=seen or (tuple(moved) if moved else None),
        outputs=names_of(outputs, "output"),
        omega=None if omega is None else np.atleast_1d(np.asarray(omega, dtype=float)),
        ranges=ranges,
    )


@_verb
def sweep(
    model: ModelLike,
    data: DataLike | None = None,
    parameters: Any = None,
    *,
    outputs: Names = None,
    against: Any = None,
    want: Names = None,
    values: Values = None,
    executor: Workers = None,
    progress: Progress | bool | None = None,
) -> SweepResult:
    """Return the RMSE of each output in each experiment, and poles where wanted, at many values of some parameters.

    Parameters
    ----------
    model : Model, Study, str or Path
        A Model, a shipped name, the path of a card, an FMU or a study, or a Study.
    data : Experiment, list of Experiment, Trajectory, Study, str or Path, default None
        A study, experiments, or a table whose columns are named like the model's inputs and outputs; or the path of one. None: those of a
        study, else none.
    parameters : dict of list of float, Samples or list of Samples, default None
        {name: values} in the parameter's unit, of which several make their product; or `grid`, `log_grid`, `latin_hypercube` of
        `hvdc_ident.sensitivity.sweep_points`. None: those of a study's [[sweep]].
    outputs : str or list of str, default None
        Names of the outputs that are compared. None: the recorded ones against data, else all outputs.
    against : "data", "base" or Model, default None
        What the outputs are compared with: the recordings, the run at the model's own values, or another model's run. None: what a study's
        [[sweep]] says, else "data" where outputs were recorded and "base" where none were.
    want : str or list of str, default None
        "rmse", "poles" or "bode", or several of them. None: what a study's [[sweep]] asks for where it gives the points, else "rmse",
        without data "poles".
    values : dict of float or FitResult, default None
        Values of the parameters that are not swept, by name, in the model's units, where they differ from the given ones; or a FitResult.
    executor : int or executor, default None
        A number of processes on this machine, or anything with the `map` of concurrent.futures. None: this process.
    progress : bool or function, default None
        True for a bar on stderr, or a function called with runs done, runs in all and a line of text.

    Returns
    -------
    SweepResult
        A row for each of the n points: rmse (n, series) in the output's unit, poles (n, modes) in rad/s. A point that fails is a row
        with a reason and no number.

    Raises
    ------
    InputError
        Names, values, data or an executor that do not fit.
    StudyError
        There is no parameter to sweep.
    ComputationError
        The run that the others are compared with stops early; one without a steady start is a SteadyStateError.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> table = hi.sweep("vsc-hvdc-link", parameters={"KIVDC": [250.0, 750.0, 1500.0]})
    >>> table.poles.shape
    (3, 6)
    """
    from hvdc_ident.errors import StudyError
    from hvdc_ident.sensitivity import sweep as swept
    from hvdc_ident.study.assemble import model_of, names_of, study_of, values_of
    from hvdc_ident.study.stages.sweep import sweep_axes, sweep_quantities, sweep_reference, swept_names

    study = study_of(model, data)
    tables = study.settings.sweep
    if parameters is None and not tables:
        raise StudyError(
            "no parameter to sweep", where=study.path.name, hint='sweep(model, data, {"NAME": np.linspace(1, 2, 11)})'
        )
    recorded = any(e.outputs for e in study.experiments)
    if against is None:
        said = sweep_reference(tables) if tables else "data"
        against = study.against or ("base" if said == "base" or not recorded else "data")
    elif against not in ("data", "base"):
        against = model_of(against)
    chosen: Any = names_of(want, "quantity") or (swept_names(tables) if tables and parameters is None else None)
    with _open(executor) as pool, _told(progress, "sweep") as told:
        return swept(
            study.model,
            study.experiments,
            sweep_axes(tables, 0) if parameters is None else parameters,
            against=against,
            outputs=names_of(outputs, "output"),
            values={**study.given, **values_of(values, study.model)},
            want=sweep_quantities(study, chosen or (("rmse",) if study.experiments else ("poles",))),
            executor=pool,
            progress=told,
        )


@_verb
def identify(
    model: ModelLike,
    data: DataLike | None = None,
    parameters: ParametersLike | None = None,
    *,
    pair: Names = None,
    seed: int = 0,
    executor: Workers = None,
    progress: Progress | bool | None = None,
) -> IdentifiabilityReport:
    """Return what the data tell about each parameter: a verdict with its evidence, the set to fit, what to measure next.

    Parameters
    ----------
    model : Model, Study, str or Path
        A Study, or a Model, a shipped name or the path of a card, an FMU or a study.
    data : Experiment, list of Experiment, Trajectory, Study, str or Path, default None
        Experiments, a study, or a table whose columns are named like the model's inputs and outputs; or the path of one. None: a study's
        own.
    parameters : str, list or dict, default None
        Names; or by name bounds (min, max), a start value, or a line as in a study's [parameters], in the parameter's unit: {"k": (0, 10)}
        or [("k", 0, 10)]. None: a study's own.
    pair : list of str, default None
        Two of the parameters whose common profile is wanted too.
    seed : int, default 0
        Of the starts of the search; same seed, same result.
    executor : int or executor, default None
        A number of processes on this machine, or anything with the `map` of concurrent.futures. None: this process.
    progress : bool or function, default None
        True for a bar on stderr, or a function called with runs done, runs in all and a line of text.

    Returns
    -------
    IdentifiabilityReport
        `parameters`, the verdict on each; `identifiable`, the names that a fit may estimate; `held`, the value and the reason of each
        other one; `recommended`, what to measure next.

    Raises
    ------
    StudyError
        There is nothing to judge: data or parameters are missing.
    UnknownNameError
        A name of a parameter, input or output that the model lacks.
    SimulationError
        An experiment cannot be simulated.

    Examples
    --------
    >>> import numpy as np, hvdc_ident as hi
    >>> lag = hi.Model("lag", parameters={"T": 1.0, "k": 2.0}, inputs={"u": 0.0}, states={"x": "(k*u - x)/T"}, outputs={"y": "x"})
    >>> t = np.linspace(0.0, 5.0, 101)
    >>> y = 3.0 * np.where(t > 1.0, 1.0 - np.exp(-(t - 1.0) / 0.5), 0.0) + 0.01 * np.random.default_rng(1).standard_normal(t.size)
    >>> record = hi.Experiment(t, inputs={"u": hi.step(0.0, 1.0, at=1.0)}, outputs={"y": y})
    >>> hi.identify(lag, record, {"T": (0.1, 10.0), "k": (0.0, 10.0)}).identifiable
    ('T', 'k')
    """
    from hvdc_ident.study.assemble import names_of, study_of
    from hvdc_ident.study.fitting import need
    from hvdc_ident.study.stages.identify import judged

    both = {"pair": list(names_of(pair, "parameter") or ())} if pair else {}
    study = _asked(study_of(model, data, parameters, identifiability=both), "identify")
    need(study, "identify")
    with _open(executor) as pool, _told(progress, "identify") as told:
        return judged(study, seed=seed, executor=pool, progress=told)


@_verb
def fit(
    model: ModelLike | Problem,
    data: DataLike | None = None,
    parameters: ParametersLike | None = None,
    *,
    report: IdentifiabilityReport | None = None,
    force: Names = None,
    seed: int = 0,
    executor: Workers = None,
    progress: Progress | bool | None = None,
    **settings: Any,
) -> FitResult:
    """Return the estimates of the parameters that the data identify; the others are held, each with its reason.

    Parameters
    ----------
    model : Model, Study, Problem, str or Path
        A Study, or a Model, a shipped name or the path of a card, an FMU or a study. A `hvdc_ident.fit.Problem` is fitted as it stands,
        all that is free in it.
    data : Experiment, list of Experiment, Trajectory, Study, str or Path, default None
        Experiments, a study, or a table whose columns are named like the model's inputs and outputs; or the path of one. None: a study's
        own.
    parameters : str, list or dict, default None
        Names; or by name bounds (min, max), a start value, or a line as in a study's [parameters], in the parameter's unit: {"k": (0, 10)}
        or [("k", 0, 10)]. None: a study's own.
    report : IdentifiabilityReport, default None
        The report of `identify`, which decides what is fitted. None: it is made first.
    force : str or list of str, default None
        Names to fit whatever the verdict on them.
    seed : int, default 0
        Of the starts of the search; same seed, same result.
    executor : int or executor, default None
        A number of processes on this machine, or anything with the `map` of concurrent.futures. None: this process.
    progress : bool or function, default None
        True for a bar on stderr, or a function called with runs done, runs in all and a line of text.
    **settings
        Keys of a study's [fit]: starts, optimiser, loss, whiten, mode, groups, guard, residual, band. Of a Problem: arguments of
        `hvdc_ident.fit.fit`.

    Returns
    -------
    FitResult
        `estimates` by parameter, each with its value, standard deviation and 95 % interval in the parameter's unit; `held`, the reason of
        each other one; `status`. A fit that fails says so in `status` and raises nothing.

    Raises
    ------
    StudyError
        Data or parameters are missing, or do not fit together.
    UnknownNameError
        A name of a parameter, input or output that the model lacks.
    SimulationError
        An experiment cannot be simulated when the report is made.

    Examples
    --------
    >>> import numpy as np, hvdc_ident as hi
    >>> lag = hi.Model("lag", parameters={"T": 1.0, "k": 2.0}, inputs={"u": 0.0}, states={"x": "(k*u - x)/T"}, outputs={"y": "x"})
    >>> t = np.linspace(0.0, 5.0, 101)
    >>> y = 3.0 * np.where(t > 1.0, 1.0 - np.exp(-(t - 1.0) / 0.5), 0.0) + 0.01 * np.random.default_rng(1).standard_normal(t.size)
    >>> record = hi.Experiment(t, inputs={"u": hi.step(0.0, 1.0, at=1.0)}, outputs={"y": y})
    >>> result = hi.fit(lag, record, {"T": (0.1, 10.0), "k": (0.0, 10.0)})
    >>> result.status, {n: round(e.value, 1) for n, e in result.estimates.items()}
    ('converged', {'T': 0.5, 'k': 3.0})
    """
    from hvdc_ident.fit import Problem
    from hvdc_ident.fit.estimate import fit as fit_of
    from hvdc_ident.study import fitting
    from hvdc_ident.study.assemble import names_of, study_of
    from hvdc_ident.study.stages.identify import judged

    with _open(executor) as pool, _told(progress, "fit") as told:
        if isinstance(model, Problem):
            return fit_of(model, seed=seed, executor=pool, progress=told, **settings)
        study = _asked(study_of(model, data, parameters, fit=settings), "fit")
        fitting.need(study, "fit")
        identified = report or judged(study, seed=seed, executor=pool, progress=told)
        forced = names_of(force, "parameter") or ()
        return fitting.estimated(study, identified, force=forced, seed=seed, executor=pool, progress=told)


@_verb
def diagnose(
    model: ModelLike,
    data: DataLike | None = None,
    parameters: ParametersLike | None = None,
    *,
    effects: Names = None,
    report: IdentifiabilityReport | None = None,
    seed: int = 0,
    executor: Workers = None,
    progress: Progress | bool | None = None,
    **settings: Any,
) -> Diagnosis:
    """Return what the model lacks, if the data tell: the verdict, the missing effects, and the gap before and after.

    Parameters
    ----------
    model : Model, Study, str or Path
        A Study, or a Model, a shipped name or the path of a card, an FMU or a study.
    data : Experiment, list of Experiment, Trajectory, Study, str or Path, default None
        Experiments, a study, or a table whose columns are named like the model's inputs and outputs; or the path of one. None: a study's
        own.
    parameters : str, list or dict, default None
        Names; or by name bounds (min, max), a start value, or a line as in a study's [parameters], in the parameter's unit: {"k": (0, 10)}
        or [("k", 0, 10)]. None: a study's own.
    effects : str or list of str, default None
        Names of the catalogue that are tried. None: those of a study's [diagnose], else all.
    report : IdentifiabilityReport, default None
        The report of `identify`, which decides what is refitted. None: it is made first.
    seed : int, default 0
        Of the starts of the searches; same seed, same result.
    executor : int or executor, default None
        A number of processes on this machine, or anything with the `map` of concurrent.futures. None: this process.
    progress : bool or function, default None
        True for a bar on stderr, or a function called with runs done, runs in all and a line of text.
    **settings
        Keys of a study's [diagnose]: places, tolerance (by output, in its unit), most, thorough, budget (s).

    Returns
    -------
    Diagnosis
        `verdict` (named, ambiguous, unnameable, not-excited or no-evidence) and `text`; `findings`, each missing effect with its
        probability and its likely places; `augmented`, the model with the effects and the new values; `gap` before and after.

    Raises
    ------
    StudyError
        Data or parameters are missing, or do not fit together.
    UnknownNameError
        A name of a parameter, input, output or effect that is not there.
    ComputationError
        The data identify no parameter; an experiment that cannot be simulated is a SimulationError.

    Examples
    --------
    >>> import numpy as np, hvdc_ident as hi
    >>> lag = hi.Model("lag", parameters={"T": 1.0, "k": 2.0}, inputs={"u": 0.0}, states={"x": "(k*u - x)/T"}, outputs={"y": "x"})
    >>> plant = hi.apply_effects(lag, [{"effect": "delay", "at": "u", "parameters": {"T": 0.3}}])
    >>> t, noise = np.linspace(0.0, 5.0, 201), np.random.default_rng(1)
    >>> def record(name, after):
    ...     step = {"u": hi.step(0.0, after, at=1.0)}
    ...     y = hi.simulate(plant, t, inputs=step)["y"] + 0.005 * noise.standard_normal(t.size)
    ...     return hi.Experiment(t, name, inputs=step, outputs={"y": y})
    >>> records = [record("up", 1.0), record("down", -0.5)]
    >>> diagnosis = hi.diagnose(lag, records, {"T": (0.1, 10.0), "k": (0.1, 10.0)}, effects=["delay", "gain"])
    >>> diagnosis.verdict, diagnosis.effects[0].effect, len(diagnosis.findings[0].places)  # at u or at y: these records cannot tell
    ('named', 'delay', 2)
    """
    from hvdc_ident.study.assemble import names_of, study_of
    from hvdc_ident.study.fitting import need
    from hvdc_ident.study.stages.diagnose import diagnosed
    from hvdc_ident.study.stages.identify import judged

    chosen = names_of(effects, "effect")
    tried = {} if chosen is None else {"effects": "all" if chosen == ("all",) else list(chosen)}
    study = _asked(study_of(model, data, parameters, diagnose={**settings, **tried}), "diagnose")
    need(study, "diagnose")
    with _open(executor) as pool, _told(progress, "diagnose") as told:
        identified = report or judged(study, seed=seed, executor=pool, progress=told)
        return diagnosed(study, identified, seed=seed, executor=pool, progress=told)


@_verb
def check(model: ModelLike, data: DataLike | None = None, parameters: ParametersLike | None = None) -> Summary:
    """Return what was found in a study, or in a model, data and parameters: rows, event, noise, levels before the event.

    No stage is run; the model is, once an experiment, and what hinders a run or a fit is told.

    Parameters
    ----------
    model : Model, Study, str or Path
        A Study, or a Model, a shipped name or the path of a card, an FMU or a study.
    data : Experiment, list of Experiment, Trajectory, Study, str or Path, default None
        Experiments, a study, or a table whose columns are named like the model's inputs and outputs; or the path of one. None: a study's
        own.
    parameters : str, list or dict, default None
        Names; or by name bounds (min, max), a start value, or a line as in a study's [parameters], in the parameter's unit. None: a study's
        own.

    Returns
    -------
    Summary
        `sizes` of the model, `candidates`, `experiments` with rows, event, levels and noise, and `hindrances`; it prints itself.

    Raises
    ------
    InputError
        Something does not hold together: the error says what, where, expected, got, and what to try.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> hi.check("vsc-hvdc-link").to_dict()["sizes"]["states"]
    6
    """
    from hvdc_ident.study.assemble import study_of
    from hvdc_ident.study.summary import Summary

    return Summary.of(study_of(model, data, parameters), in_python=True)


@_verb
def export(
    source: ModelLike | LinearModel,
    path: str | Path,
    linear: bool = False,
    fmu: FmuOptions | None = None,
    values: str | FitResult | Mapping[str, float] | None = None,
    folder: str | Path | None = None,
) -> Path:
    """Write a model or its linear model in the format of the path's ending, and return the path.

    Parameters
    ----------
    source : Model, Study, LinearModel, str or Path
        A Study, a Model, a shipped name, the path of a card, an FMU or a study, or a LinearModel.
    path : str or Path
        The file to be written. .toml, .fmu and .mo are the model, .ssv its parameters, .mat, .json, .csv and .m its linear model.
    linear : bool, default False
        True writes the linear model even for .mo.
    fmu : FmuOptions, default None
        Version and kinds of an FMU. None: FMI 2.0, model exchange and co-simulation.
    values : str, dict of float or FitResult, default None
        Of a study "given", "start" or "fitted"; or a FitResult, or values by name in the model's units. "fitted" are the values that count:
        with the effect where a diagnosis in the folder named one, which the file then holds too; "effect" and "fit" are either of them.
        None: the fitted ones where a fit stands in `folder`, else the given ones. The file says which it holds.
    folder : str or Path, default None
        The folder of results in which a fit may stand. None: the study's own.

    Returns
    -------
    Path
        The file that was written.

    Raises
    ------
    StudyError
        An ending that is not known or does not suit what is written, or fitted values are asked for and none stand.
    UnknownNameError
        A value of a parameter that the model lacks.

    Examples
    --------
    >>> import tempfile, hvdc_ident as hi
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     hi.export("vsc-hvdc-link", f"{folder}/link.mat").name
    'link.mat'
    """
    from hvdc_ident.linearize import LinearModel
    from hvdc_ident.model import Model
    from hvdc_ident.study.assemble import is_study, model_of, subject_of, values_of
    from hvdc_ident.study.export import write

    subject: Any = source if isinstance(source, LinearModel) else subject_of(source)
    if values is not None and not isinstance(values, str):
        plant = model_of(subject)
        subject, values = plant.with_values(values_of(values, plant)), None
    if not (is_study(subject) or isinstance(subject, Model | LinearModel)):
        from hvdc_ident.linearize import linearize as linear_model

        subject = linear_model(subject)
    return write(subject, path, linear, fmu, values, folder).path


def _are_times(data: Any) -> bool:
    """Return whether data are instants and no experiment or table."""
    import numpy as np

    if isinstance(data, np.ndarray):
        return True
    return isinstance(data, Sequence) and not isinstance(data, str) and all(isinstance(v, int | float) for v in data)


def _experiment(subject: Any, data: Any, inputs: Mapping[str, SignalLike] | None) -> Experiment:
    """Return the experiment that is meant, with these inputs in place of its own. Raises InputError."""
    from hvdc_ident.data import Experiment
    from hvdc_ident.errors import InputError, require_known
    from hvdc_ident.study.assemble import is_study

    if inputs is not None and not isinstance(inputs, Mapping):
        raise InputError(
            "inputs are given by name",
            expected='{"u": 1.0}, {"u": hi.step(...)} or {"u": samples}',
            got=repr(inputs)[:60],
        )
    known = {e.name: e for e in subject.experiments} if is_study(subject) else {}
    if isinstance(data, str) and known:
        require_known("experiment", [data], known, f"study '{subject.name}'")
        data = known[data]
    elif data is None and len(known) == 1:
        data = next(iter(known.values()))
    if data is None:
        listed = f"one of {', '.join(known)}" if known else "times in s, or an Experiment"
        raise InputError(
            "over what time?" if not known else "which experiment?",
            expected=listed,
            hint="simulate(model, t, inputs={...})",
        )
    if isinstance(data, Experiment):
        if not inputs:
            return data
        given = Experiment(data.time, data.name, inputs=inputs)
        return data.with_(inputs=data.inputs | given.inputs, values=data.values.without(*given.inputs))
    if not _are_times(data):
        raise InputError(
            "no times", expected="instants in s, or an Experiment", got=f"an object of type {type(data).__name__}"
        )
    return Experiment(data, inputs=inputs)


def _asked(study: Study, verb: str) -> Study:
    """Return the study. Raises StudyError where data or parameters are missing that Python would state."""
    from hvdc_ident.errors import StudyError

    known = list(study.model.parameters)
    listed = ", ".join(known[:8]) + (f" and {len(known) - 8} more" if len(known) > 8 else "")
    if not study.experiments and not study.responses:
        hint = f'hi.{verb}(model, hi.Experiment(t, inputs={{"u": u}}, outputs={{"y": y}}), {{"{known[0] if known else "k"}": (min, max)}})'
        raise StudyError(
            f"{verb} needs data", where=study.path.name, expected="experiments with recorded outputs", hint=hint
        )
    if not study.candidates:
        hint = f'{{"{known[0]}": (min, max)}}' if known else ""
        raise StudyError(f"{verb} needs parameters", where=study.path.name, expected=f"some of {listed}", hint=hint)
    return study


@contextmanager
def _open(executor: Workers) -> Iterator[Executor | None]:
    """Open so many processes on this machine; an executor is taken as it is."""
    from hvdc_ident.errors import InputError

    if executor is None or hasattr(executor, "map"):
        yield executor
        return
    if isinstance(executor, bool) or not isinstance(executor, int) or executor < 1:
        raise InputError(
            "no executor", expected="a number of processes, or something with `map`", got=repr(executor)[:60]
        )
    from hvdc_ident.study.executors import open_executor

    with open_executor("local", executor) as pool:
        yield pool


@contextmanager
def _told(progress: Progress | bool | None, verb: str) -> Iterator[Progress | None]:
    """Open a bar on stderr for True; a function is taken as it is. verb: the name of its stage."""
    if not isinstance(progress, bool):
        yield progress
        return
    from hvdc_ident.executor import StageProgress, progress_bar
    from hvdc_ident.study.stages import stage

    with progress_bar(quiet=not progress) as shown:
        yield StageProgress(shown, verb, stage(verb).counted)
