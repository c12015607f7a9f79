"""A study put together in Python: from a model, data and parameters in any of the forms in which a user has them.

Nothing that reads, fits or linearises is imported before a function needs it: `hi.simulate` of a model is to begin at once.
"""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeGuard, cast

import numpy as np

from hvdc_ident.data import Experiment, Trajectory
from hvdc_ident.data.signal_table import SignalTable
from hvdc_ident.errors import InputError, StudyError, require_known, unknown_name
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel, is_white_box
from hvdc_ident.models import is_shipped, load_model
from hvdc_ident.parameters import Parameter
from hvdc_ident.toml_tables import validated

if TYPE_CHECKING:
    from hvdc_ident.fit import FitResult
    from hvdc_ident.study.schema import ParameterTable
    from hvdc_ident.study.study import Study

ModelLike: TypeAlias = "AnyModel | Study | str | Path"
"""A model, a study's model, a shipped name, or the path of a model card, an FMU or a study."""
DataLike: TypeAlias = "Experiment | Trajectory | Study | str | Path | Iterable[Any] | Any"
"""Experiments, a study's, a table whose columns are named like the model's inputs and outputs, or the path of one."""
ParametersLike: TypeAlias = str | Iterable[Any] | Mapping[str, Any]
"""Parameter names; or by name, in a mapping or as tuples, bounds (min, max), a start value, or a line as in a study's [parameters]."""


def is_study(subject: object) -> TypeGuard[Study]:
    """Return whether an object is a Study; without the module of studies nothing is one."""
    module = sys.modules.get("hvdc_ident.study.study")
    return module is not None and isinstance(subject, module.Study)


def subject_of(source: ModelLike) -> AnyModel | Study:
    """Return the study or the model that is meant; a .toml file with a table [model] is a study.

    Raises InputError for what is neither.
    """
    if isinstance(source, str | Path):
        path = Path(source)
        if not is_shipped(str(source)) and path.suffix.lower() == ".toml":
            from hvdc_ident.study.parse import is_study_file
            from hvdc_ident.study.study import load_study

            if is_study_file(path):
                return load_study(path)
        return load_model(source)
    if is_study(source):
        return source
    for subject in (source, getattr(source, "model", None)):
        if is_white_box(subject) or (hasattr(subject, "with_effects") and hasattr(subject, "simulate")):
            return cast("AnyModel", subject)
    raise InputError(
        "no model",
        expected="a Model, a Study, the name of a shipped model, or the path of a model card, an FMU or a study",
        got=f"an object of type {type(source).__name__}",
    )


def model_of(source: ModelLike) -> AnyModel:
    """Return the model that is meant, of a study its own. Raises InputError for what is no model."""
    subject = subject_of(source)
    return subject.model if is_study(subject) else cast("AnyModel", subject)


def names_of(names: str | Iterable[str] | None, kind: str) -> tuple[str, ...] | None:
    """Return the names as a tuple; one alone may be a text. None stays None. Raises InputError for what is no name."""
    if names is None:
        return None
    wanted = (names,) if isinstance(names, str) else tuple(names)
    for name in wanted:
        if not isinstance(name, str):
            article = "an" if kind[0] in "aeiou" else "a"
            raise InputError(f"no name of {article} {kind}", expected="a text, or a list of texts", got=repr(name))
    return wanted


def values_of(
    values: Mapping[str, float] | FitResult | None, model: AnyModel, kind: str = "parameter"
) -> dict[str, float]:
    """Return values by name, of a fit its estimates. Raises InputError where one is no number or no such name is there."""
    table = values or {} if isinstance(values, Mapping | None) else getattr(values, "values", values)
    if not isinstance(table, Mapping):
        raise InputError(f"{kind} values are given by name", expected="{name: number}", got=repr(values)[:60])
    known: Collection[str] = model.inputs if kind == "input" else model.parameters
    others: Collection[str] = () if kind == "input" else model.inputs
    by_name = {}
    for name, value in table.items():
        if name not in known and name not in others:
            both = kind if kind == "input" else "parameter or input"
            raise unknown_name(both, name, [*known, *others], where=f"model '{model.name}'")
        if not isinstance(value, int | float | np.number):
            raise InputError(f"the value of '{name}' is no number", where=f"model '{model.name}'", got=repr(value)[:60])
        by_name[name] = float(value)
    return by_name


def experiments_of(data: DataLike, model: AnyModel) -> tuple[Experiment, ...]:
    """Return the experiments that are meant, each named differently, the units of its outputs those of the model.

    Raises InputError for what is no data, UnknownNameError for an input or output that the model does not have.
    """
    if isinstance(data, str | Path):
        path = Path(data)
        if path.suffix.lower() == ".toml":
            from hvdc_ident.study.study import load_study

            return load_study(path).experiments
        from hvdc_ident.formats import read_waveforms

        data = [_from_table(read_waveforms(path), model, path.stem)]
    elif is_study(data):
        return data.experiments
    elif isinstance(data, Experiment):
        data = [data]
    elif isinstance(data, Trajectory) or _is_frame(data):
        data = [_from_table(data, model, "experiment")]
    elif not isinstance(data, Iterable) or isinstance(data, np.ndarray | Mapping | SignalTable):
        raise _no_data(data)
    experiments = []
    for item in data:
        if isinstance(item, Experiment):
            experiments.append(item)
        elif isinstance(item, str | Path | Trajectory) or _is_frame(item):
            experiments.extend(experiments_of(item, model))
        else:
            raise _no_data(item)
    return tuple(_fitting(e, model) for e in _numbered(experiments))


def _no_data(data: object) -> InputError:
    return InputError(
        "no data",
        expected="an Experiment or several, a Study, a table (Trajectory, DataFrame), or the path of a study or a recording",
        got=f"an object of type {type(data).__name__}",
        hint='hi.Experiment(t, inputs={"u": u}, outputs={"y": y})',
    )


def _is_frame(data: object) -> bool:
    """Return whether data is a pandas DataFrame, or what looks like one."""
    return all(hasattr(data, n) for n in ("columns", "index", "to_numpy"))


def _from_table(table: Any, model: AnyModel, name: str) -> Experiment:
    """Return an experiment of a table, by the names of its columns. The time is the column `time`, else the index."""
    if isinstance(table, Trajectory):
        time, columns = table.time, {n: table[n] for n in table.names}
    else:
        columns = {str(c): np.asarray(table[c], dtype=float) for c in table.columns}
        time = columns.pop("time") if "time" in columns else np.asarray(table.index, dtype=float)
    for column in columns:
        if column not in model.inputs and column not in model.outputs:
            raise unknown_name("input or output", column, [*model.inputs, *model.outputs], where=f"a column of {name}")
    outputs = {n: v for n, v in columns.items() if n in model.outputs and n not in model.inputs}
    return Experiment(time, name, inputs={n: v for n, v in columns.items() if n in model.inputs}, outputs=outputs)


def _numbered(experiments: Sequence[Experiment]) -> list[Experiment]:
    """Return the experiments, those that share a name with a number behind it."""
    names = [e.name for e in experiments]
    return [
        e.with_(name=f"{e.name}-{names[: k + 1].count(e.name)}") if names.count(e.name) > 1 else e
        for k, e in enumerate(experiments)
    ]


def _fitting(e: Experiment, model: AnyModel) -> Experiment:
    """Return the experiment with the units of the model's outputs. Raises UnknownNameError."""
    where = f"experiment '{e.name}'"
    require_known("input", (n for n in e.inputs if n not in e.drive), model.inputs, where)
    require_known("output", e.outputs, model.outputs, where)
    require_known("recorded output", e.noise, e.outputs, f"{where}, noise")
    if e.measured is None or any(e.measured.units):
        return e
    table = e.measured
    return e.with_(measured=replace(table, units=tuple(model.outputs[o].unit for o in table.names)))


def lines_of(parameters: ParametersLike, model: AnyModel, where: str) -> dict[str, ParameterTable]:
    """Return the lines of a study's [parameters] that are meant.

    A name alone is estimated from the model's value within the model's bounds. (min, max) are bounds; where the model's value
    lies outside them the search begins in their middle. A number is where it begins. In a list, ("k", 0, 10) and
    ("k", (0, 10)) are what {"k": (0, 10)} is. Raises StudyError for what is none of these.
    """
    if isinstance(parameters, str):
        parameters = (parameters,)
    if not isinstance(parameters, Mapping):
        items = parameters if isinstance(parameters, Iterable) else (parameters,)
        listed = [_named(item) for item in items]
        parameters = dict(listed)
        if len(parameters) < len(listed):
            names = [name for name, _ in listed]
            twice = next(name for name in names if names.count(name) > 1)
            raise StudyError(f"parameter '{twice}' stands there twice", where="parameters", expected="each name once")
    for name in parameters:
        if not isinstance(name, str):
            raise _no_parameter(name)
        if name in model.inputs and name not in model.parameters:
            raise StudyError(
                f"'{name}' is an input, not a parameter", where="parameters", hint="an experiment's inputs"
            )
    require_known("parameter", parameters, model.parameters, f"model '{model.name}'")
    return {name: _line(name, given, model.parameters[name].value, where) for name, given in parameters.items()}


def _named(item: Any) -> tuple[str, Any]:
    """Return the name of a parameter and what is said of it. Raises StudyError for what is neither a name, a tuple, nor of a fit."""
    if isinstance(item, str):
        return item, None
    if isinstance(item, Sequence) and item and isinstance(item[0], str):
        name, *said = item
        if len(said) in (1, 2):
            return name, said[0] if len(said) == 1 else tuple(said)
    name = getattr(item, "name", None)
    if not isinstance(name, str):
        raise _no_parameter(item)
    return name, item


def _no_parameter(given: Any) -> StudyError:
    return StudyError(
        "no parameter",
        where="parameters",
        expected='names like "k", bounds by name like {"k": (min, max)} or [("k", min, max)], or parameters of a fit',
        got=repr(given)[:60],
    )


def _line(name: str, given: Any, value: float, where: str) -> ParameterTable:
    """Return one line of [parameters]. Raises StudyError for what is none."""
    from hvdc_ident.study.schema import ParameterTable

    if given is None:
        return ParameterTable()
    if isinstance(given, Parameter):
        given = {"start": given.value, "min": given.min, "max": given.max}
    elif hasattr(given, "start") and hasattr(given, "given"):  # a parameter of a fit
        given = {k: getattr(given, k) for k in ("start", "min", "max", "given")}
    if isinstance(given, Mapping):
        numbers = {k: float(v) for k, v in given.items() if _is_number(v)}
        line = {k: numbers.get(k, v) for k, v in given.items() if np.isfinite(numbers.get(k, 0.0))}
        return validated(ParameterTable, line, f"{where}, parameters.{name}", StudyError)
    if _is_number(given):
        return ParameterTable(start=float(given))
    pair = list(given) if isinstance(given, Sequence | np.ndarray) and not isinstance(given, str) else []
    if len(pair) != 2 or not all(map(_is_number, pair)):
        raise StudyError(
            "no bounds",
            where=f"parameters, '{name}'",
            expected="(min, max), a start value, or {start = ..., min = ..., max = ...} as a dict",
            got=repr(given)[:60],
        )
    low, high = map(float, pair)
    if not low < high:
        raise StudyError(
            "bounds in the wrong order",
            where=f"parameters, '{name}'",
            expected="min < max",
            got=f"({low:g}, {high:g})",
            hint=f"({high:g}, {low:g})" if high < low else "leave it out if it is not to move",
        )
    line = {k: v for k, v in (("min", low), ("max", high)) if np.isfinite(v)}
    line |= {} if low <= value <= high else {"start": float(np.clip(0.5 * (low + high), low, high))}
    return ParameterTable.model_validate(line)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def study_of(
    subject: ModelLike, data: DataLike | None = None, parameters: ParametersLike | None = None, **tables: Any
) -> Study:
    """Return the study that a model, data and parameters make; of a study that is given, with these in place of its own.

    tables: keys of the study's tables by table, {"fit": {"starts": 4}}, added to its own.
    Raises InputError: StudyError, UnknownNameError or WaveformError.
    """
    from hvdc_ident.study.checks import check_questions
    from hvdc_ident.study.recordings import with_noise
    from hvdc_ident.study.schema import TABLES, ModelTable, StudyFile
    from hvdc_ident.study.study import Study, candidates_of, load_study, with_nuisances, with_unknowns

    meant = subject_of(subject)
    source = meant if isinstance(meant, Study) else None
    model = source.model if source else cast("AnyModel", meant)
    if isinstance(data, str | Path) and Path(data).suffix.lower() == ".toml":
        data = load_study(data)
    if source is None and isinstance(data, Study):
        source, data = replace(data, model=model), None
    where = source.path.name if source else model.name
    settings = (
        source.settings if source else StudyFile.model_validate({"schema": 1, "model": ModelTable(source=model.name)})
    )
    changes: dict[str, Any] = {} if parameters is None else {"parameters": lines_of(parameters, model, where)}
    for name, keys in tables.items():
        if keys:
            own = getattr(settings, name)
            whole = {**(own.model_dump(by_alias=True, exclude_unset=True) if own else {}), **keys}
            changes[name] = validated(TABLES[name], whole, f"{where}, {name}", StudyError)
    settings = settings.model_copy(update=changes)
    if parameters is not None or source is None:
        model = with_unknowns(settings, model, where)
        candidates = candidates_of(settings, model, where)
    else:
        candidates = source.candidates
    made: dict[str, Any] = {"model": model, "candidates": candidates, "settings": settings}
    if data is not None or source is None:
        pairs = [with_noise(e) for e in (experiments_of(data, model) if data is not None else ())]
        experiments = with_nuisances(settings, model, [e for e, _ in pairs], tuple(candidates), where)
        noise = FrozenMap({e.name: n for e, n in pairs})
        made |= {"experiments": experiments, "noise": noise, "responses": ()}
    if source is not None:
        study = replace(source, **made)
    else:
        study = Study(name=model.name, path=Path(model.name), sources=FrozenMap(), **made)
    check_questions(study, where)
    return study
