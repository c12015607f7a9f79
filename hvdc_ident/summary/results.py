"""A folder of results as it stands on the disk."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from hvdc_ident.data import Trajectory
from hvdc_ident.errors import InputError
from hvdc_ident.files import csv_name
from hvdc_ident.next_step import NextStep
from hvdc_ident.summary.run_summary import RunSummary
from hvdc_ident.summary.stage_results import StageResults
from hvdc_ident.summary.summarise import STAGES, judgements_of, lines_of, summarise


@dataclass(frozen=True)
class Results:
    """The JSON of every stage in a folder, by file name without its ending, and the tables beside them."""

    folder: Path

    @cached_property
    def stages(self) -> dict[str, dict[str, Any]]:
        """The JSON files that have the heading of a result. Raises InputError for a broken one, or none at all."""
        if not self.folder.is_dir():
            raise InputError(
                "no folder of results", where=str(self.folder), next=(NextStep("run"),)
            )
        found = {}
        for path in sorted(self.folder.glob("*.json")):
            try:
                data = json.loads(path.read_text(encoding="utf-8"))
            except (OSError, ValueError, RecursionError) as e:
                hint = "run the study again"
                raise InputError("a result that cannot be read", where=str(path), got=str(e)[:100], hint=hint) from None
            if isinstance(data, dict) and {"schema", "study", "model", "software"} <= set(data):
                found[path.stem] = data
        if not found:
            raise InputError(
                "no results in the folder", where=str(self.folder), next=(NextStep("run"),)
            )
        return found

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

    @property
    def experiments(self) -> dict[str, Mapping[str, Any]]:
        """Role, event, window, recording and status of every experiment, by its name."""
        return {**self.objects.simulated.experiments, **self.objects.of_fit.experiments}

    def noise(self, experiment: str, output: str) -> float | None:
        """The standard deviation of a recorded output's noise, in its unit, given or from the rows before the event; else None."""
        for stage in ("fit", "simulation"):
            note = ((self.get(stage).get("noise") or {}).get(experiment) or {}).get(output) or {}
            if note.get("source") in ("given", "estimated") and note.get("std"):
                return float(note["std"])
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

    def windows(self, name: str | None) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
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
