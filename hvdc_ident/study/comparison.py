"""Two results side by side: values and how far apart they are, gaps, verdicts, findings, and what went into each."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hvdc_ident.codec import plain
from hvdc_ident.display import Shown, Table
from hvdc_ident.errors import InputError
from hvdc_ident.report.comparison import comparison_page
from hvdc_ident.study.stages import Stage, stages
from hvdc_ident.summary import Results, RunSummary
from hvdc_ident.summary.phrases import by_place, note_text, verdict_sentence
from hvdc_ident.summary.run_summary import ParameterSummary
from hvdc_ident.text import change_text, estimate_texts, figures, interval_text, listed, percentage

SIDES = ("first", "second")
APART = (
    "apart: the difference over the half-widths of both 95 % intervals together (root of the sum of their squares); "
    "above 1, chance alone does not explain it."
)
"""The unit of a distance, in words."""


GAPS = {"given": "at the given values", "fitted": "fitted without an effect", "effect": "with the effects found"}
"""The sets of values at which gaps are compared, and their names in text."""


@dataclass(frozen=True, eq=False, repr=False)
class RunComparison(Shown):
    """Two results in numbers and lines. data: as `compare --json` prints it."""

    data: Mapping[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as JSON has it."""
        return dict(self.data)

    def _screen(self) -> Iterator[str | Table]:
        values, gaps = self.values_table(), self.gaps_table()
        heads = (
            "study {study} in {folder}, model {model}, {software}, seed {seed}".format(**r) for r in self.data["runs"]
        )
        yield "\n".join(f"{side}: {head}" for side, head in zip(SIDES, heads, strict=True))
        yield "\n".join(self.input_lines)
        yield values if values.rows else ""
        yield APART if any(v["apart"] is not None for v in self.data["values"]) else ""
        yield "RMSE over the recordings that both have:" if gaps.rows else ""
        yield gaps if gaps.rows else ""
        yield "\n".join(self.verdict_lines)
        yield self.conclusion

    @property
    def conclusion(self) -> str:
        """The values that differ beyond their intervals."""
        judged = [v for v in self.data["values"] if v["apart"] is not None]
        beyond = [v["parameter"] for v in judged if v["apart"] > 1.0]
        if not beyond:
            if judged:
                return "No value differs beyond both intervals."
            if placed := [v["parameter"] for v in self.data["values"] if v["depends"]]:
                plural = "s" if len(placed) == 1 else ""
                return (
                    f"{listed(placed)} depend{plural} on where the effect is, so that there is no one value to compare."
                )
            fitted = any(None not in v["values"] for v in self.data["values"])
            return (
                "No value has an interval in both, by which to judge it." if fitted else "No value was fitted in both."
            )
        mixed = len({s["name"] for s in self.data["sets"]}) > 1
        why = " One run is fitted with an effect and the other without one, which moves values too." if mixed else ""
        return f"Apart beyond both intervals: {listed(beyond)}.{why}"

    def values_table(self, names: Sequence[str] = SIDES) -> Table:
        """Return every candidate with both values that count, their intervals, and how far apart they are."""
        rows = []
        for v in self.data["values"]:
            change = "" if v["change_percent"] is None else change_text(v["values"][1], v["values"][0])
            apart = "" if v["apart"] is None else figures(v["apart"], 3)
            given, without, with_it = (_both(v[k]) for k in ("given", "without_effect", "with_effect"))
            rows.append((v["parameter"], v["unit"], given, *value_texts(v), change, apart, without, with_it))
        header = ("parameter", "unit", "given", *names, "change", "apart", "without the effect", "with the effect")
        return Table(header, tuple(rows)).without_empty() if rows else Table(header, ())

    def gaps_table(self, names: Sequence[str] = SIDES) -> Table:
        """Return the RMSE of each output at each set of values, over the recordings that both have."""
        rows = []
        for g in self.data["gaps"]:
            ratio = "" if g["ratio"] is None else figures(g["ratio"], 3)
            rows.append((GAPS[g["at"]], g["output"], g["unit"], *map(figures, g["rmse"]), ratio, str(g["recordings"])))
        header = ("at", "output", "unit", *names, "ratio", "recordings")
        return Table(header, tuple(rows)).without_empty() if rows else Table(header, ())

    @property
    def page(self) -> str:
        """The comparison as an HTML page in one file."""
        runs, keys = self.data["runs"], ("study", "folder", "model", "software", "seed")
        heads = tuple((side, *(str(r[k]) for k in keys)) for side, r in zip(SIDES, runs, strict=True))
        verdicts = tuple((n, *(v or "has not run" for v in both)) for n, both in self.data["verdicts"].items())
        parts = {
            "What is compared": (self.input_lines, Table(("", "study", "results", *keys[2:]), heads)),
            "Values": ([self.conclusion, APART], self.values_table()),
            "Gaps": ([], self.gaps_table()),
            "Verdicts": ([], Table(("", *SIDES), verdicts)),
            "What the model lacks": (finding_lines(self.data["findings"]), None),
        }
        names = [str(r["study"]) for r in runs]
        title = f"{names[0]} and {names[1]}" if names[0] != names[1] else f"{names[0]}, twice"
        return comparison_page(title, parts)

    @property
    def input_lines(self) -> list[str]:
        """The differences in software, model, files and given values, in lines; and which fitted values are compared."""
        data = self.data
        lines = [f"{kind}: {a} and {b}" for kind, (a, b) in data["differing"].items()]
        files = data["sources"]
        lines += [f"inputs that differ: {', '.join(files['differ'])}"] if files["differ"] else []
        lines += [f"inputs of the {s} alone: {', '.join(files[s])}" for s in SIDES if files[s]]
        for name, (a, b) in data["given_values"].items():
            lines.append(f"given value of {name}: {a:.6g} and {b:.6g}")
        lines = lines or ["inputs, software, model and given values: the same"]
        return [*lines, *(f"values of the {side}: {v['text']}" for side, v in zip(SIDES, data["sets"], strict=True))]

    @property
    def verdict_lines(self) -> list[str]:
        """The verdict on the model and of each stage, in one line where both are the same, and what each diagnosis found."""
        lines = []
        for name, both in self.data["verdicts"].items():
            if both[0] == both[1]:
                lines.append(f"{name}: the same: {both[0]}")
            else:
                lines += [f"{name}, {side}: {v or 'has not run'}" for side, v in zip(SIDES, both, strict=True)]
        return lines + finding_lines(self.data["findings"])


def compare_runs(first: str | Path, second: str | Path) -> RunComparison:
    """Return two results side by side. first, second: folders of results, or studies whose results stand beside them.

    Raises InputError where one of them holds no results.

    >>> import tempfile, hvdc_ident as hi
    >>> from pathlib import Path
    >>> from hvdc_ident.study import load_study, run_all, StageOptions, write_starter
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     study = load_study(write_starter(Path(folder) / "a"))
    ...     ran = run_all(study, study.folder, StageOptions())
    ...     found = hi.compare_runs(study.path, study.folder)
    >>> [v["apart"] for v in found.to_dict()["values"]]
    [0.0, 0.0]
    """
    folders = [folder_of(Path(p)) for p in (first, second)]
    results = [Results(f) for f in folders]
    both = [r.summary for r in results]
    headings = [r.heading for r in results]
    runs = [
        {"folder": f.as_posix(), **{k: h.get(k) for k in ("study", "model", "software", "seed")}}
        for f, h in zip(folders, headings, strict=True)
    ]
    given = [dict(r.get("simulation").get("values") or {}) for r in results]
    return RunComparison(
        {
            "schema": 1,
            "runs": runs,
            "differing": {
                k: [h.get(k) for h in headings]
                for k in ("study", "model", "software", "seed")
                if headings[0].get(k) != headings[1].get(k)
            },
            "sources": _sources(*(dict(h.get("sources") or {}) for h in headings)),
            "given_values": {
                n: [given[0][n], given[1][n]] for n in given[0] if given[0][n] != given[1].get(n, given[0][n])
            },
            "sets": [_set_of(s) for s in both],
            "values": _values(both),
            "gaps": _gaps(both),
            "verdicts": _verdicts(results),
            "findings": [plain(s.findings) if s.diagnosis else None for s in both],
        }
    )


def folder_of(path: Path) -> Path:
    """Return the folder of results that a path stands for: itself, that of a study file, or the only one in a study's folder."""
    if path.suffix.lower() == ".toml":
        return path.with_name(f"{path.stem}-results")
    if path.is_dir() and not any(path.glob("*.json")):
        inside = sorted(p for p in path.glob("*-results") if p.is_dir())
        return inside[0] if len(inside) == 1 else path
    if not path.exists():
        raise InputError(
            "no such study, and no such folder",
            where=str(path),
            expected="a study file, or a folder that a run wrote its results into",
            hint="`hvdc-ident run STUDY` writes such a folder, STUDY-results",
        )
    return path


def distance(first: Mapping[str, Any], second: Mapping[str, Any]) -> float | None:
    """Return how far two estimates are apart, in units of both intervals.

    |a - b| / sqrt(ha^2 + hb^2), h being the half of each 95 % interval that faces the other value; of normal estimates that
    are independent the distance is above 1 in 5 % of cases where the true values agree. None where an interval is not
    known or open on that side, but 0 for equal values.
    """
    if first["value"] == second["value"]:
        return 0.0
    low, high = sorted((first, second), key=lambda e: e["value"])
    ends = ((low.get("ci95") or (None, None))[1], (high.get("ci95") or (None, None))[0])
    if ends[0] is None or ends[1] is None:
        return None
    width = math.hypot(ends[0] - low["value"], high["value"] - ends[1])
    between = high["value"] - low["value"]
    return between / width if width > 0.0 else None


def value_texts(line: Mapping[str, Any]) -> tuple[str, str]:
    """Return both values of a parameter with their intervals as text, "31.39 (31.37 to 31.41)"; why there is none where it is held."""
    first, second = (
        _with_interval(v, ci) if v is not None else held
        for v, ci, held in zip(line["values"], line["ci95"], line["held"], strict=True)
    )
    return first, second


def _with_interval(value: float, interval: Sequence[float | None] | None) -> str:
    ends = interval_text(interval)
    return estimate_texts(value, interval)[0] + (f" ({ends})" if ends else "")


def _both(values: Sequence[float | None]) -> str:
    """Return one number where both are the same, else both; empty where there is none."""
    first, second = ("–" if v is None else figures(v) for v in values)
    return "" if first == second == "–" else first if first == second else f"{first} / {second}"


def finding_lines(findings: Sequence[Sequence[Mapping[str, Any]] | None]) -> list[str]:
    """Return what each diagnosis found missing, a line each; none where no diagnosis has run."""
    lines = []
    for side, found in zip(SIDES, findings, strict=True):
        if found is not None:
            said = [f"{f['effect']} ({percentage(f['probability'])}): {f['text']}" for f in found]
            lines.append(f"missing, {side}: {' '.join(said) or 'nothing was found'}")
    kinds = [sorted(f["effect"] for f in found) for found in findings if found is not None]
    if len(kinds) == 2 and any(kinds):
        lines.append(f"missing: {'the same effects' if kinds[0] == kinds[1] else 'different effects'} in both")
    return lines


def _sources(first: dict[str, str], second: dict[str, str]) -> dict[str, list[str]]:
    """The names of files that both read and that differ, and of those that one alone read."""
    return {
        "differ": [n for n in first if n in second and first[n] != second[n]],
        "first": [n for n in first if n not in second],
        "second": [n for n in second if n not in first],
    }


def _set_of(s: RunSummary) -> dict[str, str]:
    """Return which of the fitted values count: "fit" or "effect", "" where there are none, and the same in words."""
    words = "not fitted"
    if s.counting.name == "effect":
        words = f"fitted with {s.counting.added}, as the diagnosis named it"
    elif s.counting.name == "fit":
        words = f"fitted without an effect{f'; {s.counting.doubt}' if s.counting.doubt else ''}"
    return {"name": s.counting.name, "text": words}


def _values(both: Sequence[RunSummary]) -> list[dict[str, Any]]:
    """Return every candidate of either result with both values that count, their intervals and their distance."""
    tables = [{p.name: p for p in s.parameters} for s in both]
    rows = []
    for name in dict.fromkeys([*tables[0], *tables[1]]):
        pair = [t.get(name) for t in tables]
        known = [p for p in pair if p is not None]
        values = [None if p is None else p.value for p in pair]
        intervals = [None if p is None else p.interval for p in pair]
        apart = None
        if values[0] is not None and values[1] is not None:
            apart = distance(*({"value": v, "ci95": ci} for v, ci in zip(values, intervals, strict=True)))
        rows.append(
            {
                "parameter": name,
                "unit": next((p.unit for p in known if p.unit), ""),
                "given": [None if p is None else p.given for p in pair],
                "values": values,
                "ci95": plain(intervals),
                "depends": any(p.by_place for p in known),
                "held": [_held(s, p) for s, p in zip(both, pair, strict=True)],
                "change_percent": 100.0 * (values[1] / values[0] - 1.0)
                if values[0] and values[1] is not None
                else None,
                "apart": apart,
                "without_effect": [None if p is None or p.effect is None else p.fitted for p in pair],
                "with_effect": [None if p is None else p.effect for p in pair],
            }
        )
    return rows


def _held(s: RunSummary, p: ParameterSummary | None) -> str:
    """Return why a parameter has no value that counts; empty where it has one."""
    if p is None:
        return "no candidate"
    if p.value is not None:
        return ""
    return f"it is {by_place(p)}" if p.by_place else note_text(p) or ("not fitted" if s.fit else "no fit")


def _gaps(both: Sequence[RunSummary]) -> list[dict[str, Any]]:
    """Return by output the RMSE of both, each recording that both have counting alike, at each set of values."""
    rows = []
    units = {x.output: x.unit for s in reversed(both) for x in s.signals}
    for kind in GAPS:
        first, second = (
            {(x.output, x.experiment): x.errors[kind].rmse for x in s.signals if kind in x.errors} for s in both
        )
        for output in dict.fromkeys(o for o, _ in first):
            by = {e: [rmse, second[o, e]] for (o, e), rmse in first.items() if o == output and (o, e) in second}
            if not by:
                continue
            rmse = [math.sqrt(sum(pair[k] ** 2 for pair in by.values()) / len(by)) for k in (0, 1)]
            about = {"at": kind, "output": output, "unit": units.get(output, ""), "rmse": rmse}
            ratio = rmse[1] / rmse[0] if rmse[0] else None
            rows.append({**about, "ratio": ratio, "recordings": len(by), "by_recording": by})
    return rows


def _verdicts(results: Sequence[Results]) -> dict[str, list[str]]:
    """Return the verdict on the model, then of each stage in one phrase; empty where it has not run."""
    found = {"model": [verdict_sentence(r.summary) if r.summary.sets else "" for r in results]}
    found |= {s.name: [_verdict(s, r) for r in results] for s in stages()}
    return {name: both for name, both in found.items() if any(both)}


def _verdict(stage: Stage, results: Results) -> str:
    data = results.get(Path(stage.file).stem)
    if not data:
        return ""
    if not data.get("fingerprint"):
        return f"not finished: {data.get('message') or data.get('status') or 'no reason is kept'}"
    return stage.verdict(data)
