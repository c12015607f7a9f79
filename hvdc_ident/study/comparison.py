"""Two results side by side: values and how far apart they are, gaps, verdicts, findings, and what went into each."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hvdc_ident.display import Shown, Table, rounded
from hvdc_ident.errors import InputError
from hvdc_ident.report.answers import Answers
from hvdc_ident.report.comparison import comparison_page
from hvdc_ident.report.results import Results
from hvdc_ident.report.values_that_count import estimates_that_count, values_that_count
from hvdc_ident.study.stages import Stage, stages
from hvdc_ident.text import figures, figures_of, listed, percentage

SIDES = ("first", "second")
APART = (
    "apart: the difference over the half-widths of both 95 % intervals together (root of the sum of their squares); "
    "above 1, chance alone does not explain it."
)
"""The unit of a distance, in words."""
FIXED = (1e-3, 1e7)
"""Sizes from and up to which a value and its interval are written without an exponent."""


@dataclass(frozen=True, eq=False, repr=False)
class RunComparison(Shown):
    """Two results in numbers and lines. data: as `compare --json` prints it."""

    data: Mapping[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as JSON has it."""
        return dict(self.data)

    def _screen(self) -> Iterator[str | Table]:
        data = self.data
        yield "\n".join(f"{side}: {_heading(run)}" for side, run in zip(SIDES, data["runs"], strict=True))
        yield "\n".join(self.input_lines)
        yield from self._tables()
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
            fitted = any(None not in v["values"] for v in self.data["values"])
            return (
                "No value has an interval in both, by which to judge it." if fitted else "No value was fitted in both."
            )
        mixed = len({s["name"] for s in self.data["sets"]}) > 1
        why = " One run is fitted with an effect and the other without one, which moves values too." if mixed else ""
        return f"Apart beyond both intervals: {listed(beyond)}.{why}"

    def _tables(self) -> Iterator[str | Table]:
        if self.data["values"]:
            header = ("parameter", "unit", *SIDES, "change, %", "apart")
            rows = tuple(
                (v["parameter"], v["unit"], *value_texts(v), rounded(v["change_percent"], 3), rounded(v["apart"], 3))
                for v in self.data["values"]
            )
            yield Table(header, rows).without_empty()
            yield APART if any(v["apart"] is not None for v in self.data["values"]) else ""
        for kind, title in GAPS.items():
            rows = tuple(
                (g["output"], g["unit"], *map(rounded, g["rmse"]), rounded(g["ratio"], 3), g["recordings"])
                for g in self.data["gaps"]
                if g["at"] == kind
            )
            if rows:
                yield f"RMSE {title}, over the recordings that both have:"
                yield Table(("output", "unit", *SIDES, "ratio", "recordings"), rows).without_empty()

    @property
    def page(self) -> str:
        """The comparison as an HTML page in one file."""
        texts = [value_texts(v) for v in self.data["values"]]
        return comparison_page(self.data, texts, self.input_lines, self.conclusion, APART)

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
        """The verdict of each stage, in one line where both are the same, and what each diagnosis found."""
        lines = []
        for name, both in self.data["verdicts"].items():
            if both[0] == both[1]:
                lines.append(f"{name}: the same: {both[0]}")
            else:
                lines += [f"{name}, {side}: {v or 'has not run'}" for side, v in zip(SIDES, both, strict=True)]
        return lines + finding_lines(self.data["findings"])


GAPS = {"given": "at the given values", "fitted": "fitted without an effect", "augmented": "with the effects found"}
"""The sets of values at which gaps are compared, and their names in text."""


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
            "sets": [_set_of(r) for r in results],
            "values": _values(*results),
            "gaps": _gaps(*results),
            "verdicts": {s.name: v for s in stages() if any(v := [_verdict(s, r) for r in results])},
            "findings": [_findings(r) for r in results],
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
    """Return both values of a parameter with their intervals as text, "31.39 ± 0.02"; why there is none where it is held."""
    first, second = (
        _with_interval(v, ci) if v is not None else held
        for v, ci, held in zip(line["values"], line["ci95"], line["held"], strict=True)
    )
    return first, second


def _with_interval(value: float, ci95: Sequence[float | None] | None) -> str:
    """Return a value with the halves of its interval, all with as many decimals: two figures of the smaller half."""
    low, high = ci95 or (None, None)
    halves = [abs(end - value) for end in (low, high) if end is not None]
    if len(halves) < 2 or min(halves) == 0.0 or not FIXED[0] <= max(abs(value), *halves) < FIXED[1]:
        shown = figures(value, figures_of(ci95, 5))
        down, up = (figures(half, 2) for half in halves) if len(halves) == 2 else ("", "")
    else:
        places = max(0, 1 - int(f"{min(halves):.1e}".split("e")[1]))  # of the half as rounded
        shown, down, up = (f"{v:.{places}f}" for v in (value, *halves))
    if not up:
        return shown
    return f"{shown} ± {up}" if down == up else f"{shown} +{up} -{down}"


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


def _heading(run: Mapping[str, Any]) -> str:
    return f"study {run['study']} in {run['folder']}, model {run['model']}, {run['software']}, seed {run['seed']}"


def _sources(first: dict[str, str], second: dict[str, str]) -> dict[str, list[str]]:
    """The names of files that both read and that differ, and of those that one alone read."""
    return {
        "differ": [n for n in first if n in second and first[n] != second[n]],
        "first": [n for n in first if n not in second],
        "second": [n for n in second if n not in first],
    }


def _set_of(results: Results) -> dict[str, str]:
    """Return which of the fitted values count: "fit" or "effect", "" where there are none, and the same in words."""
    counts = values_that_count(results.get("fit"), results.get("discrepancy"))
    if counts.name == "effect":
        words = f"fitted with {counts.added}, as the diagnosis named it"
    elif counts.name == "fit":
        words = f"fitted without an effect{f'; {counts.doubt}' if counts.doubt else ''}"
    else:
        words = "not fitted"
    return {"name": counts.name, "text": words}


def _values(first: Results, second: Results) -> list[dict[str, Any]]:
    """Return every candidate of either fit with both values that count, their intervals and their distance."""
    fits = [first.get("fit"), second.get("fit")]
    counted = [estimates_that_count(r.get("fit"), r.get("discrepancy")) for r in (first, second)]
    candidates = [f.get("candidates") or {} for f in fits]
    after = [_with_effect(r.get("discrepancy")) for r in (first, second)]
    rows = []
    for name in dict.fromkeys([*candidates[0], *candidates[1]]):
        both = [estimates.get(name) or {} for estimates in counted]
        values = [e.get("value") for e in both]
        known = all(v is not None for v in values)
        lines = [c.get(name) or {} for c in candidates]
        rows.append(
            {
                "parameter": name,
                "unit": next((c["unit"] for c in lines if c.get("unit")), ""),
                "given": [c.get("given") for c in lines],
                "values": values,
                "ci95": [e.get("ci95") for e in both],
                "held": [_held(f, name) if not e else "" for f, e in zip(fits, both, strict=True)],
                "change_percent": 100.0 * (values[1] / values[0] - 1.0) if known and values[0] else None,
                "apart": distance(both[0], both[1]) if known else None,
                "without_effect": [
                    ((f.get("estimates") or {}).get(name) or {}).get("value") if a.get(name) is not None else None
                    for f, a in zip(fits, after, strict=True)
                ],
                "with_effect": [a.get(name) for a in after],
            }
        )
    return rows


def _with_effect(diagnosis: Mapping[str, Any]) -> dict[str, float]:
    """The values with the effects of a diagnosis; none that depends on which of the likely effects and places is the true one."""
    depend = diagnosis.get("values_by_place") or {}
    return {n: v for n, v in (diagnosis.get("parameters_after") or {}).items() if n not in depend}


def _held(fit: Mapping[str, Any], name: str) -> str:
    if name not in (fit.get("candidates") or {}):
        return "no candidate" if fit else "no fit"
    return f"held, {str((fit.get('held') or {}).get(name, 'not fitted')).split(':')[0]}"


def _gaps(first: Results, second: Results) -> list[dict[str, Any]]:
    """Return by output the RMSE of both, each recording that both have counting alike, at each set of values."""
    tables = {kind: [_rmse(r, kind) for r in (first, second)] for kind in GAPS}
    units = {**second.units, **first.units}
    rows = []
    for kind, (a, b) in tables.items():
        for output in (o for o in a if o in b):
            names = [n for n, v in a[output].items() if v is not None and b[output].get(n) is not None]
            if names:
                both = [math.sqrt(sum(t[output][n] ** 2 for n in names) / len(names)) for t in (a, b)]
                by = {n: [a[output][n], b[output][n]] for n in names}
                ratio = both[1] / both[0] if both[0] else None
                about = {"recordings": len(names), "by_recording": by}
                rows.append(
                    {"at": kind, "output": output, "unit": units.get(output, ""), "rmse": both, "ratio": ratio, **about}
                )
    return rows


def _rmse(results: Results, kind: str) -> Mapping[str, Mapping[str, Any]]:
    """The RMSE by output and recording with one set of values; empty where that has not been computed."""
    table: dict[str, dict[str, float]] = {}
    for (output, experiment), about in Answers(results).signals("effect" if kind == "augmented" else kind).items():
        table.setdefault(output, {})[experiment] = about["rmse"]
    return table


def _verdict(stage: Stage, results: Results) -> str:
    """The verdict of a stage in one phrase; empty where it has not run."""
    data = results.get(Path(stage.file).stem)
    if not data:
        return ""
    if not data.get("fingerprint"):
        return f"not finished: {data.get('message') or data.get('status') or 'no reason is kept'}"
    return stage.verdict(data)


def _findings(results: Results) -> list[dict[str, Any]] | None:
    """The findings of the diagnosis; None where none has run."""
    data = results.get("discrepancy")
    if "verdict" not in data:
        return None
    keys = ("effect", "probability", "parameters", "text")
    return [
        {**{k: f.get(k) for k in keys}, "places": [p["at"] for p in f.get("places") or []]}
        for f in data.get("findings") or []
    ]
