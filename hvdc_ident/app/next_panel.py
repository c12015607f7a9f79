"""The experiment to make next, simulated for every model that may lie behind the recordings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from nicegui import run, ui

import hvdc_ident as hi
from hvdc_ident.app.plot import GIVEN, NOW, Grid, Plot, Trace, thinned
from hvdc_ident.app.supposed import PlannedExperiment, Supposition, planned_experiments, refitted
from hvdc_ident.colours import SERIES
from hvdc_ident.data import Array, Experiment
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.identifiability import IdentifiabilityReport
from hvdc_ident.summary.phrases import WORDS
from hvdc_ident.text import with_unit

COLORS = SERIES[1:6]
"""Colours of the rivals."""
CURVES = len(COLORS)
TALL = 150


@dataclass(frozen=True)
class PlannedRun:
    """An experiment as it would look. models: as they were run. runs: by model and signal, (n,). trouble: by model, why it
    has none."""

    experiment: Experiment
    models: tuple[Supposition, ...]
    runs: Mapping[str, Mapping[str, Array]]
    trouble: Mapping[str, str]


def planned_run(
    study: hi.Study, experiment: Experiment, models: tuple[Supposition, ...], signals: tuple[str, ...]
) -> PlannedRun:
    """Return the signals of an experiment by every model, fitted to the study's records where it is not yet."""
    runs: dict[str, dict[str, Array]] = {}
    trouble: dict[str, str] = {}
    ready: list[Supposition] = []
    for m in models:
        try:
            ready.append(refitted(study, m))
            simulated = hi.simulate(ready[-1].model, experiment, outputs=signals)
        except HvdcIdentError as error:
            trouble[m.name] = str(error)
        else:
            runs[m.name] = {s: simulated[s] for s in signals}
    return PlannedRun(experiment, tuple(ready), runs, trouble)


class NextExperiment:
    """The experiments that the analysis recommends, or that could be made, and a button that simulates the chosen one.

    fitted: the model with its fitted values. rivals: models with what a diagnosis found.
    """

    def __init__(
        self,
        study: hi.Study,
        report: IdentifiabilityReport,
        fitted: Supposition | None,
        rivals: tuple[Supposition, ...],
    ) -> None:
        self._study = study
        self._planned = planned_experiments(study, report)
        self._models = (fitted or Supposition(WORDS["given"], study.model), *rivals[:CURVES])

    def build(self) -> None:
        """Build the choice and the button; nothing where no input can be moved."""
        if not self._planned:
            return
        with ui.element("div").classes("line"):
            words = {k: p.words for k, p in enumerate(self._planned)}
            self._which = ui.select(words, value=0, label="experiment", on_change=self._choose)
            self._which.props("dense options-dense").style("min-width: min(26rem, 80vw); max-width: 40rem")
            signals = self._signals()
            first = [s for s in self._planned[0].record if s in signals]
            self._record = ui.select(signals, value=first or signals[:1], label="signals", multiple=True)
            self._record.props("dense options-dense").style("min-width: 12rem; max-width: 24rem")
            self._button = ui.button("Simulate it", on_click=self._simulate).props("dense no-caps").classes("q-px-md")
        if len(self._models) > 1:
            told = "Drawn for the fitted model and for what may be missing, each at its best fit: where curves part, a record tells."
            ui.label(told).classes("small")
        self._trouble = ui.label("").classes("alert").props('role="alert"')
        self._place = ui.column().classes("w-full gap-0")

    def _signals(self) -> list[str]:
        """Return what every model has and can be recorded."""
        own = self._study.model
        names = dict.fromkeys((*own.outputs, *own.insertion_points))
        inside = [{*m.model.outputs, *m.model.insertion_points} for m in self._models]
        return [n for n in names if n not in own.inputs and all(n in known for known in inside)]

    def _choose(self, event: Any) -> None:
        planned = self._planned[int(event.value)]
        self._record.value = [s for s in planned.record if s in self._record.options]

    async def _simulate(self) -> None:
        planned: PlannedExperiment = self._planned[int(self._which.value)]
        signals = tuple(self._record.value or ())
        if not signals:
            self._trouble.text = "Choose at least one signal."
            return
        self._button.props("loading")
        asked = (self._study, planned.experiment(self._study), self._models, signals)
        simulated = await run.io_bound(planned_run, *asked)
        self._button.props(remove="loading")
        if simulated is not None:  # None: the server is ending
            known = {m.name: m for m in simulated.models}
            self._models = tuple(known.get(m.name, m) for m in self._models)
            self._trouble.text = "; ".join(f"{n}: {why}" for n, why in simulated.trouble.items())
            self._draw(simulated, signals)

    def _draw(self, simulated: PlannedRun, signals: tuple[str, ...]) -> None:
        colors = dict(zip([m.name for m in self._models], (NOW, *COLORS), strict=False))
        curves = tuple(Trace(n, colors[n], dashed=k > 1) for k, n in enumerate(simulated.runs))
        time = simulated.experiment.time
        inputs = simulated.experiment.inputs
        known = self._study.model.inputs
        grids = [Grid(with_unit(n, known[n].unit), (Trace("input", GIVEN),)) for n in inputs]
        units = {n: s.unit for n, s in self._study.model.outputs.items()}
        grids += [Grid(with_unit(s, units.get(s, "")), curves) for s in signals]
        self._place.clear()
        with self._place:
            plot = Plot(grids, "time, s", TALL * len(grids) + 30, "The experiment as it would be").classes("w-full")
        for k, signal in enumerate(inputs.values()):
            plot.whole(k, thinned(time, np.asarray(signal(time))))
        for k, name in enumerate(signals, len(inputs)):
            plot.whole(k, thinned(time, *(line[name] for line in simulated.runs.values())))
