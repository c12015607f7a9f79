"""A folder of results as it stands on the disk."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from hvdc_ident.codec import read_fields
from hvdc_ident.data import Trajectory
from hvdc_ident.errors import InputError, located
from hvdc_ident.files import csv_name
from hvdc_ident.fit.judgement import WindowErrors
from hvdc_ident.next_step import NextStep
from hvdc_ident.summary.compared_responses import ComparedResponse
from hvdc_ident.summary.decisions import STAGES, judgements_of, lines_of, summarise
from hvdc_ident.summary.levels import InitialValue
from hvdc_ident.summary.linear import Linearisation
from hvdc_ident.summary.run_summary import RunSummary
from hvdc_ident.summary.stage_results import ExperimentContext, StageResults


@dataclass(frozen=True)
class _Levels:
    rest_levels: tuple[InitialValue, ...] = ()


@dataclass(frozen=True)
class Results:
    """The JSON of every stage in a folder, by file name without its ending, and the tables beside them."""

    folder: Path

    @cached_property
    def stages(self) -> dict[str, dict[str, Any]]:
        """The JSON files that have the heading of a result. Raises InputError for a broken one, or none at all."""
        if not self.folder.is_dir():
            raise InputError("no folder of results", where=str(self.folder), next=(NextStep("run"),))
        by_name = {}
        for path in sorted(self.folder.glob("*.json")):
            try:
                data = json.loads(path.read_text(encoding="utf-8"))
            except (OSError, ValueError, RecursionError) as e:
                hint = "run the study again"
                raise InputError("a result that cannot be read", where=str(path), got=str(e)[:100], hint=hint) from None
            if isinstance(data, dict) and {"schema", "study", "model", "software"} <= set(data):
                by_name[path.stem] = data
        if not by_name:
            raise InputError("no results in the folder", where=str(self.folder), next=(NextStep("run"),))
        return by_name

    def get(self, stage: str) -> dict[str, Any]:
        """The JSON of a stage, empty where it has not run."""
        return self.stages.get(stage, {})

    @cached_property
    def objects(self) -> StageResults:
        """The results as objects. Raises InputError for what is no result of this version."""
        return StageResults.read(self.stages)

    @cached_property
    def summary(self) -> RunSummary:
        """Summary of the results."""
        return summarise(self.stages, self.swing, self.heading)

    @property
    def units(self) -> dict[str, str]:
        """Unit of every recorded output, by its name."""
        return {**self.objects.simulated.units, **self.objects.of_fit.units}

    @cached_property
    def linear(self) -> Linearisation | None:
        """The linear models; None where the stage has not run, or failed. Raises InputError for what is no result of this version."""
        data = self.get("linearization")
        with located("linearization.json"):
            return Linearisation.from_dict(data) if "modes" in data else None

    @property
    def responses(self) -> tuple[ComparedResponse, ...]:
        """The measured frequency responses beside the model's: of the fit, else of the linear model at the given values."""
        of_fit = self.objects.of_fit.responses
        return of_fit or (() if self.linear is None else self.linear.given.responses)

    @property
    def rest_levels(self) -> tuple[InitialValue, ...]:
        """The levels before the events, from a stage of the present state of the study where there is one."""
        with_levels = [s for s in self.stages.values() if s.get("rest_levels")]
        present = [s for s in with_levels if s.get("sources") == self.heading.get("sources")]
        return read_fields(_Levels, next(iter([*present, *with_levels]), {})).rest_levels

    def fingerprint(self, stage: str) -> str:
        """Return the fingerprint of a result; "" where the stage has not come to its end."""
        return str(self.get(stage).get("fingerprint") or "")

    @property
    def experiments(self) -> dict[str, ExperimentContext]:
        """Every experiment by its name, as the fit has it where there is one, with the outcome of its run at the given values."""
        return {**self.objects.simulated.experiments, **self.objects.of_fit.experiments}

    def noise(self, experiment: str, output: str) -> float | None:
        """The standard deviation of a recorded output's noise, in its unit, given or from the rows before the event; else None."""
        for about in (self.objects.of_fit, self.objects.simulated):
            note = about.noise.get(experiment, {}).get(output)
            if note is not None and note.source in ("given", "estimated") and note.std:
                return note.std
        return None

    def outputs_of(self, experiment: str) -> list[str]:
        """The recorded outputs of an experiment of which a run of the model is at hand."""
        names: list[str] = []
        for stage in ("fit", "simulation"):
            table = self.table(f"{stage}.{experiment}.csv")
            columns = table.names if table is not None else ()
            names += [n for n in columns if f"{n}.measured" in columns]
        return list(dict.fromkeys(names))

    @property
    def heading(self) -> dict[str, Any]:
        """Schema, study, model, software, seed and sources of the last run."""
        return self.get("summary") or self.get("run") or self.get("fit") or next(iter(self.stages.values()))

    def windows(self, name: str | None) -> Iterator[tuple[str, str, WindowErrors]]:
        """Yield output, experiment and the errors within the windows of the profile, of every signal with a set of values."""
        judgement = judgements_of(self.objects).get(name or "")
        for output, experiment, about in lines_of(judgement) if judgement is not None else ():
            yield output, experiment, about.windows

    def swing(self, output: str, experiment: str) -> float | None:
        """The peak-to-peak value of a recorded signal, in its unit; None where its recording is not at hand."""
        for stage in STAGES.values():
            table, column = self.table(f"{stage}.{experiment}.csv"), f"{output}.measured"
            if table is not None and column in table.names and np.isfinite(table[column]).any():
                return float(np.nanmax(table[column]) - np.nanmin(table[column]))
        return None

    @cached_property
    def _tables(self) -> dict[str, Trajectory | None]:
        return {}

    def table(self, name: str) -> Trajectory | None:
        """A table of numbers whose first column is the time; None where the file is not there or no such table."""
        if name not in self._tables:
            self._tables[name] = self._read(name)
        return self._tables[name]

    def _read(self, name: str) -> Trajectory | None:
        path = self.folder / name
        if path.parent.resolve() != self.folder.resolve() or not path.is_file():
            return None
        with path.open(encoding="utf-8", newline="") as file:
            header = [csv_name(name) for name in next(csv.reader(file), [])]
            try:
                rows = np.loadtxt((_filled(line) for line in file), delimiter=",", ndmin=2)
            except ValueError:
                return None
        return (
            Trajectory(rows[:, 0], rows[:, 1:], tuple(header[1:]))
            if rows.shape[1] == len(header) and rows.size
            else None
        )


def _filled(line: str) -> str:
    """A line of a table with NaN in its empty cells: what was not recorded."""
    if ",," not in line and not line.rstrip().endswith(","):
        return line
    return ",".join(cell.strip() or "nan" for cell in line.split(","))
