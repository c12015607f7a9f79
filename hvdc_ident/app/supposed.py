"""Models that may lie behind the recordings, and the experiments that would tell, as the results of a study name them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

import hvdc_ident as hi
from hvdc_ident.app.setting import size_titles
from hvdc_ident.data import Experiment
from hvdc_ident.discrepancy import Diagnosis
from hvdc_ident.discrepancy.result import FoundEffect, Rival
from hvdc_ident.errors import ComputationError, HvdcIdentError
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.identifiability import IdentifiabilityReport
from hvdc_ident.identifiability.experiment_design import ExperimentDesign, single_input_designs
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel
from hvdc_ident.simulate import ModelSimulator
from hvdc_ident.study.augmented import use_of
from hvdc_ident.text import listed


@dataclass(frozen=True)
class Supposition:
    """A model that may lie behind the recordings.

    sizes: names of its parameters that say how large what is missing is, titles: what a reader calls those that the study's model lacks.
    fitted: its values are those of its own best fit.
    """

    name: str
    model: AnyModel
    sizes: tuple[str, ...] = ()
    fitted: bool = True
    titles: FrozenMap[str] = field(default_factory=FrozenMap)


def suppositions(study: hi.Study, diagnosis: Diagnosis | None, folder: Path) -> tuple[Supposition, ...]:
    """Return the models with what a diagnosis found missing: the best one, then those that explain the records as well.

    The rivals have the parameters that their refits came to, and those of the best one where the results keep no others:
    `refitted` gives them all. None where nothing was put in; a rival that cannot be built here is left out.
    """
    card = folder / Path((diagnosis and diagnosis.augmented_model) or "").name
    if diagnosis is None or not diagnosis.augmented_model or not card.is_file():
        return ()
    best = hi.load_model(card)
    likeliest: Sequence[FoundEffect | Rival] = diagnosis.effects
    gains = {n: v for n, v in diagnosis.parameters_after.items() if n in study.model.parameters}
    plant = study.model.with_values(gains)
    rivals = [Supposition(_named(likeliest), best, _sizes(study, best), titles=_titles(plant, likeliest))]
    for k, group in enumerate(diagnosis.ambiguity):
        for other in (r for r in group if k >= len(likeliest) or _place_of(r) != _place_of(likeliest[k])):
            effects = [*likeliest[:k], other, *likeliest[k + 1 :]]
            own = {n: v.value for n, v in other.values.items() if n in gains}
            try:
                model = hi.apply_effects(plant.with_values(own), [use_of(e) for e in effects])
            except HvdcIdentError:  # a formula, or an unknown input: no effect that can be put in by its name
                continue
            titles = _titles(plant, effects)
            rivals.append(Supposition(_named(effects), model, _sizes(study, model), fitted=False, titles=titles))
    return tuple(rivals)


def _place_of(effect: FoundEffect | Rival) -> tuple[str, tuple[str, ...], str]:
    return effect.effect, effect.at, effect.source


def refitted(study: hi.Study, rival: Supposition) -> Supposition:
    """Return a model with the values that fit the recordings best, by one run from those it has; itself where it has them.

    Without that it would seem to differ from the best one where only its parameters are another's. Raises ComputationError
    where the fit fails.
    """
    if rival.fitted:
        return rival
    unknowns = [
        replace(FitParameter.of(n, rival.model.parameters[n]), min=c.min, max=c.max)
        for n, c in study.candidates.items()
        if c.min <= rival.model.parameters[n].value <= c.max
    ]
    unknowns += [FitParameter.of(n, rival.model.parameters[n]) for n in rival.sizes]
    problem = Problem(ModelSimulator(rival.model), study.experiments, tuple(unknowns))
    fit = hi.fit(problem, starts=1, assess=False)
    if fit.status == "failed":
        raise ComputationError(f"the model with {rival.name} could not be fitted", got=fit.message)
    return replace(rival, model=rival.model.with_values({u.name: fit.values[u.name] for u in unknowns}), fitted=True)


def _named(effects: Sequence[FoundEffect | Rival]) -> str:
    """Return the effects with their places in words."""
    parts = []
    for e in effects:
        source = f" from {e.source}" if e.source else ""
        parts.append(f"{e.name} at {listed(e.at)}{source}")
    return "; ".join(parts) or "as found"


def _titles(plant: AnyModel, effects: Sequence[FoundEffect | Rival]) -> FrozenMap[str]:
    """Return what a reader calls the parameters that effects add; none where they cannot be put in by their names."""
    try:
        return size_titles(plant, [use_of(e) for e in effects])
    except HvdcIdentError:
        return FrozenMap()


def _sizes(study: hi.Study, model: AnyModel) -> tuple[str, ...]:
    """Return the parameters that the study's model lacks, and those it holds at another value."""
    own, candidates = study.model.parameters, study.candidates
    added = [n for n in model.parameters if n not in own]
    moved = [n for n, q in model.parameters.items() if n in own and n not in candidates and own[n].value != q.value]
    return (*added, *moved)


@dataclass(frozen=True)
class PlannedExperiment:
    """An experiment that could be made. words: what to do. record: signals to record; new: not recorded so far."""

    words: str
    design: ExperimentDesign
    record: tuple[str, ...]
    new: tuple[str, ...]

    def experiment(self, study: hi.Study) -> Experiment:
        """Return it over the instants of the study's longest record, as the results have it."""
        return self.design.experiment(max(study.experiments, key=lambda e: float(np.ptp(e.time))))


def planned_experiments(study: hi.Study, report: IdentifiabilityReport) -> tuple[PlannedExperiment, ...]:
    """Return the experiments that an identifiability analysis recommends, the best first; where it has none, those that could be made:
    the moves of each input that a person can set."""
    inputs = study.model.inputs
    units = {n: i.unit for n, i in inputs.items()}
    advice = report.recommended
    ranked = () if advice is None else (advice.best, *advice.others)
    told = tuple(dict.fromkeys(PlannedExperiment(r.design.text(units), r.design, r.record, r.new) for r in ranked))
    if told or not study.experiments:
        return told
    record = tuple(dict.fromkeys(o for e in study.experiments for o in e.outputs))
    values = {n: i.value for n, i in inputs.items() if i.settable}
    longest = max(study.experiments, key=lambda e: float(np.ptp(e.time)))
    designs = single_input_designs(study.experiments, values, units, longest)
    return tuple(PlannedExperiment(d.text(units), d, record, ()) for d in designs)
