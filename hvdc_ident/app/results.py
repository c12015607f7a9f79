"""The results of a study in a folder as the page uses them: the JSON of its stages, their summary, and the models behind them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import hvdc_ident as hi
from hvdc_ident.app.supposed import Supposition, suppositions
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.study.stages import stage
from hvdc_ident.summary import Results, RunSummary, summarise
from hvdc_ident.summary.phrases import WORDS
from hvdc_ident.summary.stage_results import StageResults


@dataclass(frozen=True)
class FoundResults:
    """The results of a study in a folder: the JSON by stage of those that ran to their end, and how each stage stands."""

    study: hi.Study
    folder: Path
    data: Mapping[str, Mapping[str, Any]]

    def of(self, stage: str) -> Mapping[str, Any]:
        """Return the JSON of a stage; empty where it has not run."""
        return self.data.get(stage, {})

    def is_of_the_study(self, stage: str) -> bool:
        """Return whether a stage has run since the study and its files were changed last."""
        return self.of(stage).get("sources") == dict(self.study.sources)

    @cached_property
    def _by_file(self) -> dict[str, Mapping[str, Any]]:
        return {Path(stage(n).file).stem: data for n, data in self.data.items()}

    @cached_property
    def objects(self) -> StageResults:
        """The results as objects; those of stages that have not run are empty."""
        return StageResults.read(self._by_file)

    @cached_property
    def summary(self) -> RunSummary:
        """Summary of the results."""
        return summarise(self._by_file, Results(self.folder).swing)

    @cached_property
    def fitted(self) -> Supposition | None:
        """The model with the values of the fit; None where there are none."""
        fit = self.objects.fit
        own = {} if fit is None else {n: v for n, v in fit.values.items() if n in self.study.model.parameters}
        return Supposition(WORDS["fitted"], self.study.model.with_values(own)) if own else None

    @cached_property
    def supposed(self) -> tuple[tuple[Supposition, ...], str]:
        """The models with what a diagnosis found, the best first; and why they cannot be had."""
        try:
            return suppositions(self.study, self.objects.diagnosis, self.folder), ""
        except HvdcIdentError as error:
            return (), str(error)

    @property
    def models(self) -> tuple[Supposition, ...]:
        """The models that the results come to: the fitted one, then those with what a diagnosis found."""
        return (*([self.fitted] if self.fitted else []), *self.supposed[0])
