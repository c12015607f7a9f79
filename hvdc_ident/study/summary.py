"""The summary of a study that `check` prints: what it holds, whether recordings and model begin at the same levels, and what
hinders a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from typing import Any

from hvdc_ident.data import Experiment, recording_lines
from hvdc_ident.study.checks import steady_notes
from hvdc_ident.study.hindrances import hindrances
from hvdc_ident.study.initial_values import initial_values
from hvdc_ident.study.measured_responses import described
from hvdc_ident.study.pipeline import heading_of
from hvdc_ident.study.stages import stages
from hvdc_ident.study.study import Study, candidate_lines
from hvdc_ident.text import one_of, quantity


@dataclass(frozen=True, eq=False)
class Summary:
    """A study in numbers and lines. data: as `check --json` prints it. in_python: whether the next step is a call or a command."""

    data: Mapping[str, Any]
    in_python: bool = False

    @classmethod
    def of(cls, study: Study, seed: int = 0, *, in_python: bool = False) -> Summary:
        """Return the summary of a study. The model is run once an experiment, and once more where the start values differ."""
        model, initial = study.model, initial_values(study)
        sizes = {n: len(getattr(model, n)) for n in ("states", "parameters", "inputs", "outputs")}
        return cls(
            {
                **heading_of(study, seed),
                "sizes": sizes,
                "candidates": {n: {**c, "given_by": _given_by(study, n)} for n, c in candidate_lines(study).items()},
                "experiments": {e.name: _experiment(e, study) for e in study.experiments},
                "steady_state": steady_notes(study, searches=any(s.searches and s.wanted(study) for s in stages())),
                "responses": {r.name: described(r) for r in study.responses},
                "stages": [s.name for s in stages() if s.wanted(study)],
                "rest_levels": initial.to_list(),
                "rest_lines": [*initial.lines, *initial.remarks],
                "hindrances": hindrances(study, initial),
            },
            in_python,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the summary as JSON has it."""
        return dict(self.data)

    def __str__(self) -> str:
        found = self.data
        sizes = ", ".join(f"{n} {k}" for k, n in found["sizes"].items())
        wrong = found["hindrances"]
        good = "good" if not wrong else "to be mended before a run: see the end"
        lines = [f"study {found['study']}: {good}", f"model {found['model']}: {sizes}"]
        for name, c in found["candidates"].items():
            unit = f" {c['unit']}" if c["unit"] else ""
            given = f"given {c['given']:g}{unit} ({c['given_by']})"
            lines.append(f"candidate {name}: from {c['start']:g} within [{c['min']:g}, {c['max']:g}]{unit}; {given}")
        for name, e in found["experiments"].items():
            event = f"event at {e['event']:g} s" if e["event"] is not None else "no event"
            noise = ", ".join(_noise(o, n, e["units"][o]) for o, n in e["noise"].items())
            start, end = e["time"]
            lines.append(
                f"experiment {name} ({e['role']}): {e['rows']} rows, {start:g} to {end:g} s, {event}; noise {noise}"
            )
        lines += _recording_lines({name: recording_lines(e["recording"]) for name, e in found["experiments"].items()})
        lines += [line for line in found["rest_lines"] if line not in wrong]
        lines += [f"steady state, {line}" for line in found["steady_state"]]
        for name, r in found["responses"].items():
            low, high = r["band_hz"]
            share, source = r["relative_noise"], r["noise_source"]
            noise = "not given" if share is None else f"{100 * share:.3g} % ({source})"
            unit = f" in {r['unit']}" if r["unit"] else ""
            lines.append(
                f"response {name} ({r['role']}): {r['kind']}{unit}, {', '.join(r['channels'])}; {r['points']} "
                f"frequencies, {low:.4g} to {high:.4g} Hz; noise {noise}"
            )
        lines.append(f"a run does: {', '.join(found['stages']) or 'nothing but the report'}")
        if wrong:
            lines += ["before a run:", *wrong]
            again = "`hi.check(...)`" if self.in_python else "`hvdc-ident check STUDY`"
            lines.append(f"Next: answer or mend what stands above, then {again}")
        elif self.in_python:
            verbs = [f"`hi.{s}(...)`" for s in found["stages"] if s != "screen"]
            lines += [f"Next: {one_of(verbs, len(verbs))}"] if verbs else []
        elif found["stages"]:
            lines.append("Next: `hvdc-ident run STUDY`")
        return "\n".join(lines)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"


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


def _noise(output: str, note: dict[str, Any], unit: str) -> str:
    """The noise of one output, or what stands in for it."""
    if note["source"] == "residual":
        return f"{output} from the residual of the fit (not given, and no quiet rows before an event)"
    if note["source"] == "floor":
        return f"{output} none above {quantity(note['std'], unit, 3)} (before the event; the residual of the fit stands in)"
    how = f"{note['source']}, row by row" if note["by_row"] else note["source"]
    return f"{output} {quantity(note['std'], unit, 3)} ({how})"


def _given_by(study: Study, name: str) -> str:
    """Return the source of a candidate's given value; a value of [model.values] that does not count is named too."""
    line, stated = study.settings.parameters[name], study.settings.model.values
    if line.given is not None:
        unused = f", not {stated[name]:g} of [model.values]" if stated.get(name, line.given) != line.given else ""
        return f"[parameters]{unused}"
    return "[model.values]" if name in stated else "the model"


def _experiment(e: Experiment, study: Study) -> dict[str, Any]:
    notes = study.noise[e.name]
    return {
        "role": e.role,
        "rows": int(e.time.size),
        "time": [float(e.time[0]), float(e.time[-1])],
        "event": e.event,
        "window": e.window,
        "inputs": [n for n in e.inputs if n not in e.drive],
        "outputs": list(e.outputs),
        "units": {o: study.model.outputs[o].unit for o in e.outputs},
        "recording": e.recording,
        "noise": {o: asdict(n) for o, n in notes.items()},
    }
