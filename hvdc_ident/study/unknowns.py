"""What of [parameters] is no plain candidate: ties, values of their own in every experiment, priors, free starts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from hvdc_ident.data import Experiment
from hvdc_ident.errors import InputError, StudyError, unknown_name
from hvdc_ident.expression import parse
from hvdc_ident.fit import Free
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model
from hvdc_ident.study import schema

if TYPE_CHECKING:
    from hvdc_ident.fit.prior import Prior
    from hvdc_ident.model import AnyModel


def with_unknowns(settings: schema.StudyFile, model: AnyModel, where: str) -> AnyModel:
    """The model with its ties and its given values.

    Raises StudyError or UnknownNameError for a tie, or a parameter of each experiment, that does not fit the model.
    """
    for name, line in settings.parameters.items():
        if line.given is not None and name in model.parameters:
            try:
                model = model.with_values({name: line.given})
            except InputError as e:
                raise e.at(f"{where}, parameters.{name}.given") from None
    ties = {n: line.tie for n, line in settings.parameters.items() if line.tie is not None}
    own = [n for n, line in settings.parameters.items() if line.per_experiment]
    for name in (*ties, *own):
        if name not in model.parameters:
            raise unknown_name("parameter", name, model.parameters, where=f"{where}, parameters")
    if not ties and not own:
        return model
    if not isinstance(model, Model):
        first = next(iter((*ties, *own)))
        raise StudyError(
            f"'{first}' cannot be tied or given to each experiment",
            where=f"{where}, parameters.{first}",
            expected="a model with equations",
            got="an FMU",
        )
    if not ties:
        return model
    expressions = {}
    for name, tie in ties.items():
        try:
            expressions[name] = parse(tie)
        except InputError as e:
            raise e.at(f"{where}, parameters.{name}.tie") from None
    try:
        return model.tied(expressions)
    except InputError as e:
        raise e.at(f"{where}, parameters") from None


def with_nuisances(
    settings: schema.StudyFile,
    model: AnyModel,
    experiments: Sequence[Experiment],
    candidates: Sequence[str],
    where: str,
) -> tuple[Experiment, ...]:
    """The experiments with the parameters each has for itself: those asked for, and the free starts of states.

    A start that is "free" is unknown: it is estimated in every experiment unless it is a candidate, one for all. Raises StudyError
    where the bounds of one do not hold its start.
    """
    own = [n for n, line in settings.parameters.items() if line.per_experiment]
    if isinstance(model, Model):
        free = [f"{n}_start" for n, s in model.states.items() if s.start == "free"]
        own += [n for n in free if n not in candidates and n not in own]
    if not own:
        return tuple(experiments)
    search = {}
    for name in (n for n in own if n in settings.parameters):
        try:
            found = free_of(name, settings.parameters[name], model)
        except InputError as e:
            raise e.at(f"{where}, parameters.{name}") from None
        search[name] = (found.start, found.min, found.max)
    return tuple(e.with_(nuisance=tuple(dict.fromkeys((*e.nuisance, *own))), search=search) for e in experiments)


def free_of(name: str, line: schema.ParameterTable, model: AnyModel) -> Free:
    """The unknown of a fit that a line of [parameters] describes; what it leaves out is the model's, its given value too.

    Raises StudyError where the bounds do not hold the start.
    """
    stated = {k: v for k in ("start", "min", "max") if (v := getattr(line, k)) is not None}
    return Free.of(name, model.parameters[name], **stated)


def priors(settings: schema.StudyFile, experiments: Sequence[Experiment]) -> FrozenMap[Prior]:
    """The priors by unknown of a fit; one of a parameter that each experiment has for itself holds in every experiment."""
    from hvdc_ident.fit.nuisance import unknown_of
    from hvdc_ident.fit.prior import Prior

    found: dict[str, Prior] = {}
    for name, line in settings.parameters.items():
        if line.prior is None:
            continue
        prior = Prior(line.prior.mean, line.prior.std)
        if line.per_experiment:
            found |= {unknown_of(e.name, name): prior for e in experiments if e.role == "fit"}
        else:
            found[name] = prior
    return FrozenMap(found)
