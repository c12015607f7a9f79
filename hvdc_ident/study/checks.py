"""Checks of what a study holds before a stage runs: names that its questions use, the preconditions of each stage, and remarks on
the steady states its runs begin at."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING

from hvdc_ident.errors import (
    ComputationError,
    HvdcIdentError,
    InputError,
    SimulationError,
    SteadyStateError,
    StudyError,
    TimingError,
    located,
    require_known,
)
from hvdc_ident.model import AnyModel, Model, is_white_box
from hvdc_ident.study import schema
from hvdc_ident.toml_tables import check_names

if TYPE_CHECKING:
    from hvdc_ident.data import Experiment
    from hvdc_ident.study.study import Study


def check_questions(study: Study, where: str) -> None:
    """Raise UnknownNameError or StudyError where a stage's table names what is not there."""
    s = study.settings
    if s.linearize:
        _check_kind_of_model(s.linearize, study.model, f"{where}, linearize")
    for line in s.sweep:
        _free_line(line.parameter, s.parameters, f"{where}, sweep", local=True)
    groups = enumerate(s.fit.groups if s.fit else (), start=1)
    asked = {f"fit.groups number {k}.parameters": g.parameters for k, g in groups}
    asked["screening.parameters"] = (s.screening.parameters or []) if s.screening else []
    asked["identifiability.pair"] = (s.identifiability.pair or []) if s.identifiability else []
    for place, names in asked.items():
        for name in names:
            _free_line(name, s.parameters, f"{where}, {place}")
    check_names(s.model_copy(update={"experiment": [], "response": []}), _known_names(study), f"{where}, ")
    for line in s.sweep:
        _check_sweep(line, study.model, where)
    if s.sweep:
        from hvdc_ident.study.stages.sweep import sweep_axes

        sweep_axes(s.sweep, 0, f"{where}, sweep")
    if s.linearize:
        _check_linear(s.linearize, study, f"{where}, linearize")
    if s.fit:
        from hvdc_ident.fit.tolerance_profile import tolerance

        with located(f"{where}, fit.tolerance"):
            tolerance(s.fit.tolerance, study.path.parent)


def _known_names(study: Study) -> dict[str, Collection[str]]:
    """Return by kind of names those that a stage's table may hold."""
    s, model = study.settings, study.model
    asked = s.linearize or schema.LinearizeTable()
    known: dict[str, Collection[str]] = {
        **names_of_model(model),
        "insertion point": model.insertion_points,
        "input or output of [linearize]": [*(asked.inputs or model.inputs), *(asked.outputs or model.outputs)],
        "candidate": study.candidates,
        "measured output": list(dict.fromkeys(o for e in study.experiments for o in e.outputs)),
        "experiment": [*(e.name for e in study.experiments), *(r.name for r in study.responses)],
    }
    if s.fit:
        from hvdc_ident.fit.likelihood import LOSSES
        from hvdc_ident.fit.optimisers import catalogue

        known |= {"optimiser": catalogue(), "loss": LOSSES}
    if s.diagnose:
        from hvdc_ident.effects import effects

        known["effect"] = ["all", *effects()]
    return known


def names_of_model(model: AnyModel) -> dict[str, Collection[str]]:
    """Return the names of a model by kind, as the keys of a study say which they hold."""
    signals = [*model.states, *model.signals, *model.algebraic]
    return {
        "input": model.inputs,
        "output": model.outputs,
        "parameter": model.parameters,
        "input or parameter": [*model.inputs, *model.parameters],
        "signal": signals,
        "output or signal": [*model.outputs, *(signals if is_white_box(model) else ())],
    }


def _check_sweep(line: schema.SweepTable, model: AnyModel, where: str) -> None:
    """Raise StudyError where a swept value leaves the model's own bounds."""
    parameter = model.parameters[line.parameter]
    ends = line.values or [v for v in (line.min, line.max) if v is not None]
    for value in (min(ends), max(ends)):
        if not parameter.min <= value <= parameter.max:
            raise StudyError(
                f"a value of '{line.parameter}' lies outside the model's own bounds",
                where=f"{where}, sweep of {line.parameter}",
                expected=f"values in [{parameter.min:g}, {parameter.max:g}]",
                got=f"{value:g}",
            )


def _free_line(name: str, lines: Mapping[str, schema.ParameterTable], where: str, *, local: bool = False) -> None:
    """Raise StudyError for a parameter that follows others by its tie or, unless `local`, has a value in each experiment."""
    line = lines.get(name)
    if line is not None and line.tie is not None:
        what, why = "follows other parameters", f"tie = {line.tie!r}"
        hint = "name one that it follows, or leave the tie out"
    elif line is not None and line.per_experiment and not local:
        what, why = "has a value in each experiment", "per-experiment = true"
        hint = "leave that out for one value in all experiments"
    else:
        return
    raise StudyError(
        f"'{name}' {what}", where=where, expected="a parameter with one value of its own", got=why, hint=hint
    )


def _check_kind_of_model(asked: schema.LinearizeTable, model: AnyModel, place: str) -> None:
    """Raise StudyError where [linearize] asks for what only equations tell."""
    of_equations = (asked.break_at, asked.plant, asked.port, asked.formula, asked.locus, asked.side != "refuse")
    if not is_white_box(model) and any(of_equations):
        raise StudyError(
            "loops, ports, loci, formulas and a side of a limit need the model's equations",
            where=place,
            expected="a model card or a shipped model",
            got="an FMU",
            hint="leave break_at, plant, port, locus, formula and side out",
        )


def _check_linear(asked: schema.LinearizeTable, study: Study, place: str) -> None:
    """Raise StudyError or UnknownNameError for ports that do not fit, and where the compared model lacks a name."""
    for port in asked.port:
        _check_port(port, study, f"{place}.port '{port.name}'")
    names = [p.name for p in asked.port]
    doubled = next((n for n in names if names.count(n) > 1), None)
    if doubled is not None:
        raise StudyError(f"two ports are called '{doubled}'", where=place)
    other, model = study.compared, study.model
    if other is not None:
        require_known("input", asked.inputs or model.inputs, other.inputs, f"{place}.compare '{other.name}'")
        require_known("output", asked.outputs or model.outputs, other.outputs, f"{place}.compare '{other.name}'")


def _check_port(port: schema.PortTable, study: Study, where: str) -> None:
    """Raise ExpressionError or UnknownNameError for an expression of a port that the model has no value for."""
    from hvdc_ident.expression import parse

    model = study.model
    known = [*model.inputs, *model.states, *model.signals, *model.algebraic, *model.parameters]
    for key, texts in (("voltage", port.voltage), ("current", port.current), ("angle", [port.angle])):
        for text in texts:
            with located(f"{where}, {key}"):
                names = sorted(s.name for s in parse(text).free_symbols)
            require_known("name", names, known, f"{where}, {key}")


def need_experiments(study: Study, stage: str, role: str | None = None, *, responses: bool = False) -> None:
    """Raise StudyError where the study has no experiment, or none of the role.

    responses: whether a measured frequency response does instead.
    """
    if responses and any(r.role == role for r in study.responses):
        return
    if not study.experiments:
        hint = '[[experiment]] with name, data = "file.csv", inputs and outputs'
        raise StudyError(f"{stage} needs an experiment and the study has none", where=study.path.name, hint=hint)
    if role is not None and not any(e.role == role for e in study.experiments):
        hint = f'role = "{role}" for at least one'
        raise StudyError(
            f"{stage} needs an experiment of role '{role}'", where=study.path.name, got="held-out ones only", hint=hint
        )


def need_candidates(study: Study, stage: str) -> None:
    """Raise StudyError where the study names no parameter to estimate."""
    if not study.candidates:
        known = list(study.model.parameters)
        hint = "[parameters] with lines like NAME = {given = 1, min = 0, max = 10}; the model has "
        hint += ", ".join(known[:8]) + (" ..." if len(known) > 8 else "")
        if not known:
            hint = "a model with parameters: this one has none, so that nothing of it can be estimated"
        raise StudyError(
            f"{stage} needs parameters to estimate and the study names none", where=study.path.name, hint=hint
        )


def need_start(study: Study) -> None:
    """Raise SteadyStateError where some experiment has no steady state, or TimingError, wherever a search may begin.

    A start without one is a start that fails, among others that do not; where all are like that the study is wrong.
    LinearizationError where a measured response has no counterpart at the start values.
    """
    for experiment in study.experiments:
        error = _no_start(study, experiment, study.start)
        if error is not None and not _starts_elsewhere(study, experiment):
            raise error
    for response in study.responses:
        with located(f"response '{response.name}'"):
            response.of_model(study.model, study.start)


def _no_start(study: Study, experiment: Experiment, values: Mapping[str, float]) -> InputError | None:
    """Return why an experiment cannot begin at these values; None where it can, or fails later."""
    from hvdc_ident.simulate import simulate

    try:
        simulate(study.model, experiment.with_(time=experiment.time[:1], measured=None), values)
    except (SteadyStateError, TimingError) as error:
        return error
    except SimulationError:
        return None
    return None


def _starts_elsewhere(study: Study, experiment: Experiment) -> bool:
    """Return whether an experiment can begin at one of the points from which a multistart searches the candidates' ranges."""
    from hvdc_ident.fit.fit_parameter import starting_points
    from hvdc_ident.fit.search import STARTS

    candidates = tuple(study.candidates.values())
    points = starting_points(candidates, (), STARTS - 1, seed=0)
    trials = [study.start | {f.name: float(v) for f, v in zip(candidates, p, strict=True)} for p in points]
    return bool(candidates) and any(_no_start(study, experiment, values) is None for values in trials)


@contextmanager
def at_given(study: Study) -> Iterator[None]:
    """Run what is inside at the given values.

    A model that has no steady state there is wrong input (SteadyStateError). Where the study's search begins, or may go,
    elsewhere it is a finding about the vendor's values, a ComputationError, which ends this stage and not those that fit.
    """
    try:
        yield
    except SteadyStateError as e:
        stuck = [x for x in study.experiments if _no_start(study, x, study.given) is not None]
        elsewhere = bool(stuck) and all(_starts_elsewhere(study, x) for x in stuck)
        if study.start == study.given and not elsewhere:
            raise
        raise ComputationError(
            f"at the given values {e.what}",
            where=e.where,
            expected=e.expected,
            got=e.got,
            hint="given = ... in [parameters] states the vendor's value; a fit begins at `start` and is not touched",
        ) from None


def steady_notes(study: Study, *, searches: bool = False) -> list[str]:
    """Return a sentence for each start, of the model and of each experiment, that is unstable, off its branch or far out.

    The model stands at its own inputs, an experiment at the first values of its; parameters at the given values, which
    every stage runs at. searches: also at the start values, where they differ, for a search begins there.
    Empty where every start is the model's own stable steady state, and for an FMU, which begins where it says.
    """
    model = study.model
    if not is_white_box(model) or any(s.start is not None for s in model.states.values()):
        return []
    begins: dict[str, Mapping[str, float]] = {"model": {}}
    for e in (e for e in study.experiments if not e.drive):
        begins[f"experiment {e.name}"] = e.values | {n: float(signal.values[0]) for n, signal in e.inputs.items()}
    at_given = {where: _notes(model, study.given, inputs) for where, inputs in begins.items()}
    sentences = [f"{where}: {note}" for where, notes in at_given.items() for note in notes]
    if searches and study.start != study.given:
        for where, inputs in begins.items():
            notes = _notes(model, study.start, inputs)
            sentences += [f"{where}, at the start values: {note}" for note in notes if note not in at_given[where]]
    return sentences


def _notes(model: Model, values: Mapping[str, float], inputs: Mapping[str, float]) -> tuple[str, ...]:
    from hvdc_ident.linearize import find_operating_point

    fixed = {**values, **inputs}
    known = {n: v for n, v in fixed.items() if n in model.parameters or n in model.inputs}
    try:
        return find_operating_point(model, known).notes
    except HvdcIdentError as error:  # the stage that needs a steady state ends with it
        return (str(error),)
