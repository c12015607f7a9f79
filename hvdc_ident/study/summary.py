"""The summary of a study that `check` prints: what it holds, whether recordings and model begin at the same levels, and what
hinders a run."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any

from hvdc_ident.codec import INLINE, NOT_STORED, Coded
from hvdc_ident.data import Experiment, recording_lines
from hvdc_ident.study.checks import steady_notes
from hvdc_ident.study.column_contradictions import column_contradictions
from hvdc_ident.study.heading import heading_of
from hvdc_ident.study.hindrances import hindrances
from hvdc_ident.study.initial_values import initial_values
from hvdc_ident.study.measured_responses import described
from hvdc_ident.study.stages import stages
from hvdc_ident.study.study import Study, candidate_lines
from hvdc_ident.summary.candidate import Candidate
from hvdc_ident.summary.compared_responses import DescribedResponse
from hvdc_ident.summary.levels import InitialValue, NoiseNote
from hvdc_ident.text import one_of, quantity


@dataclass(frozen=True)
class StatedCandidate:
    """A candidate, and where its given value is stated."""

    candidate: Candidate = field(metadata=INLINE)
    given_by: str = ""

    @classmethod
    def of(cls, candidate: Candidate, name: str, study: Study) -> StatedCandidate:
        """Return a candidate of a study; a value of [model.values] that does not count is named too."""
        line, stated = study.settings.parameters[name], study.settings.model.values
        if line.given is not None:
            unused = f", not {stated[name]:g} of [model.values]" if stated.get(name, line.given) != line.given else ""
            return cls(candidate, f"[parameters]{unused}")
        return cls(candidate, "[model.values]" if name in stated else "the model")

    @property
    def text(self) -> str:
        """Start, bounds and given value in words."""
        c = self.candidate
        low, high = (-math.inf if c.min is None else c.min, math.inf if c.max is None else c.max)
        unit = f" {c.unit}" if c.unit else ""
        return f"from {c.start:g} within [{low:g}, {high:g}]{unit}; given {c.given:g}{unit} ({self.given_by})"


@dataclass(frozen=True)
class RecordedExperiment:
    """An experiment of a study as `check` finds it. time, event, window: s. recording: `Experiment.recording`."""

    role: str
    rows: int
    time: tuple[float, float]
    event: float | None
    window: tuple[float, float] | None
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: Mapping[str, str]
    recording: Mapping[str, Any]
    noise: Mapping[str, NoiseNote]

    @classmethod
    def of(cls, e: Experiment, study: Study) -> RecordedExperiment:
        """Return an experiment of a study."""
        return cls(
            e.role,
            int(e.time.size),
            (float(e.time[0]), float(e.time[-1])),
            e.event,
            e.window,
            tuple(n for n in e.inputs if n not in e.drive),
            e.outputs,
            {o: study.model.outputs[o].unit for o in e.outputs},
            e.recording,
            study.noise[e.name],
        )

    @property
    def text(self) -> str:
        """Rows, times, event and noise in words."""
        event = f"event at {self.event:g} s" if self.event is not None else "no event"
        noise = ", ".join(_noise(o, n, self.units[o]) for o, n in self.noise.items())
        return f"{self.rows} rows, {self.time[0]:g} to {self.time[1]:g} s, {event}; noise {noise}"


@dataclass(frozen=True, eq=False)
class Summary(Coded):
    """A study as `check` finds it. sizes: of the model. steady_state: remarks on the points at which runs begin. stages: that a run
    does. rest_lines: on levels that differ. hindrances: what a run would stumble over. in_python: whether the next step is a call or a
    command.
    """

    schema: int
    study: str
    model: str
    software: str
    seed: int
    sources: Mapping[str, str]
    sizes: Mapping[str, int]
    candidates: Mapping[str, StatedCandidate]
    experiments: Mapping[str, RecordedExperiment]
    steady_state: tuple[str, ...]
    responses: Mapping[str, DescribedResponse]
    stages: tuple[str, ...]
    rest_levels: tuple[InitialValue, ...]
    rest_lines: tuple[str, ...]
    hindrances: tuple[str, ...]
    in_python: bool = field(default=False, metadata=NOT_STORED)

    @classmethod
    def of(cls, study: Study, seed: int = 0, *, in_python: bool = False) -> Summary:
        """Return the summary of a study. The model is run once an experiment, and once more where the start values differ."""
        model, initial, of_columns = study.model, initial_values(study), column_contradictions(study)
        wrong = {c.where for c in of_columns if not c.done}
        of_rows = (c for e in study.experiments if e.measured is not None for c in e.measured.origin.contradictions)
        contradictions = (*of_rows, *of_columns)
        others = initial.without(where.removeprefix("experiment ") for where in wrong)
        steady = steady_notes(study, searches=any(s.searches and s.wanted(study) for s in stages()))
        return cls(
            **heading_of(study, seed),
            sizes={n: len(getattr(model, n)) for n in ("states", "parameters", "inputs", "outputs")},
            candidates={n: StatedCandidate.of(c, n, study) for n, c in candidate_lines(study).items()},
            experiments={e.name: RecordedExperiment.of(e, study) for e in study.experiments},
            steady_state=tuple(n for n in steady if n.replace(",", ":").split(":")[0] not in wrong),
            responses={r.name: described(r) for r in study.responses},
            stages=tuple(s.name for s in stages() if s.wanted(study)),
            rest_levels=initial.all,
            rest_lines=(*others.lines, *others.remarks, *(c.text for c in contradictions if c.done)),
            hindrances=tuple(hindrances(study, others, contradictions)),
            in_python=in_python,
        )

    def __str__(self) -> str:
        sizes = ", ".join(f"{n} {k}" for k, n in self.sizes.items())
        good = "good" if not self.hindrances else "to be mended before a run: see the end"
        lines = [f"study {self.study}: {good}", f"model {self.model}: {sizes}"]
        lines += [f"candidate {name}: {c.text}" for name, c in self.candidates.items()]
        lines += [f"experiment {name} ({e.role}): {e.text}" for name, e in self.experiments.items()]
        lines += _recording_lines({name: recording_lines(e.recording) for name, e in self.experiments.items()})
        lines += [line for line in self.rest_lines if line not in self.hindrances]
        lines += [f"steady state, {line}" for line in self.steady_state]
        lines += [f"response {name} ({r.role}): {r.text}" for name, r in self.responses.items()]
        lines.append(f"a run does: {', '.join(self.stages) or 'nothing but the report'}")
        return "\n".join([*lines, *self._next()])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"

    def _next(self) -> Iterator[str]:
        """Yield what is to be mended, and what to do next."""
        if self.hindrances:
            again = "`hi.check(...)`" if self.in_python else "`hvdc-ident check STUDY`"
            yield from ("before a run:", *self.hindrances, f"Next: answer or mend what stands above, then {again}")
        elif self.in_python:
            verbs = [f"`hi.{s}(...)`" for s in self.stages if s != "screen"]
            yield from [f"Next: {one_of(verbs, len(verbs))}"] if verbs else []
        elif self.stages:
            yield "Next: `hvdc-ident run STUDY`"


def _recording_lines(notes: Mapping[str, Sequence[str]]) -> list[str]:
    """The remarks on the recordings; one that several share is told once, with its number."""
    by_line: dict[str, list[str]] = {}
    for name, lines in notes.items():
        for line in lines:
            by_line.setdefault(line, []).append(name)
    return [
        f"experiment {names[0]}: {line}" + (f" (and so in {len(names) - 1} more)" if len(names) > 1 else "")
        for line, names in by_line.items()
    ]


def _noise(output: str, note: NoiseNote, unit: str) -> str:
    """The noise of one output, or what stands in for it."""
    if note.source == "residual":
        return f"{output} from the residual of the fit (not given, and no quiet rows before an event)"
    if note.source == "floor":
        return (
            f"{output} none above {quantity(note.std, unit, 3)} (before the event; the residual of the fit stands in)"
        )
    how = f"{note.source}, row by row" if note.by_row else note.source
    return f"{output} {quantity(note.std, unit, 3)} ({how})"
