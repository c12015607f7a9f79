"""Two results side by side: values and how far apart they are, gaps, verdicts, findings, and what went into each."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from hvdc_ident.codec import Coded, read_fields
from hvdc_ident.display import Shown, Table
from hvdc_ident.errors import InputError, in_python
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.next_step import NextStep
from hvdc_ident.report.comparison import comparison_page
from hvdc_ident.study.stages import Stage, stages
from hvdc_ident.summary import Results, RunSummary
from hvdc_ident.summary.phrases import by_place, note_text, verdict_sentence
from hvdc_ident.summary.run_summary import FindingSummary, Interval, ParameterSummary
from hvdc_ident.text import change_text, estimate_texts, figures, interval_text, listed, probability_text

T = TypeVar("T")
SIDES = ("first", "second")
APART = (
    "apart: the difference over the half-widths of both 95 % intervals together (root of the sum of their squares); "
    "above 1, chance alone does not explain it."
)
"""The unit of a distance, in words."""


GAPS = {"given": "at the given values", "fitted": "fitted without an effect", "effect": "with the effects found"}
"""The sets of values at which gaps are compared, and their names in text."""


Pair = tuple[float | None, float | None]
"""A number of both results; None where one has none."""


@dataclass(frozen=True)
class ComparedRun:
    """Where results lie, and what they are of."""

    folder: str
    study: str = ""
    model: str = ""
    software: str = ""
    seed: int | None = None


@dataclass(frozen=True)
class ComparedValue:
    """A candidate of either result: both values that count, with their 95 % intervals.

    apart: their distance, `distance`. depends: whether one depends on where the effect is. held: why there is no value; empty
    where there is one. without_effect: of fits with an effect, the value of the fit without it.
    """

    parameter: str
    unit: str
    given: Pair
    values: Pair
    ci95: tuple[Interval | None, Interval | None]
    depends: bool
    held: tuple[str, str]
    change_percent: float | None
    apart: float | None
    without_effect: Pair
    with_effect: Pair

    @property
    def texts(self) -> tuple[str, str]:
        """Both values with their intervals as text, "31.39 (31.37 to 31.41)"; why there is none where it is held."""
        first, second = (
            _with_interval(v, ci) if v is not None else held
            for v, ci, held in zip(self.values, self.ci95, self.held, strict=True)
        )
        return first, second


@dataclass(frozen=True)
class ComparedGap:
    """The RMSE of an output in both results with a set of values, each recording that both have counting alike; ratio: second to first."""

    at: str
    output: str
    unit: str
    rmse: tuple[float, float]
    ratio: float | None
    recordings: int
    by_recording: FrozenMap[tuple[float, float]]


@dataclass(frozen=True)
class ComparedSet:
    """Which of the fitted values count in a result: "fit" or "effect", "" where there are none; and the same in words."""

    name: str
    text: str


@dataclass(frozen=True, eq=False, repr=False)
class RunComparison(Coded, Shown):
    """Two results side by side.

    differing: study, model, software and seed where they differ. sources: names of input files that differ, and of those that
    the first or the second alone has. given_values: those that differ. verdicts: of the model and of each stage; empty where it has not
    run. findings: what each diagnosis found missing; None where none has run.
    """

    runs: tuple[ComparedRun, ComparedRun]
    differing: FrozenMap[tuple[Any, Any]]
    sources: FrozenMap[tuple[str, ...]]
    given_values: FrozenMap[tuple[float, float]]
    sets: tuple[ComparedSet, ComparedSet]
    values: tuple[ComparedValue, ...]
    gaps: tuple[ComparedGap, ...]
    verdicts: FrozenMap[tuple[str, str]]
    findings: tuple[tuple[FindingSummary, ...] | None, tuple[FindingSummary, ...] | None]
    schema: int = 1

    def _screen(self) -> Iterator[str | Table]:
        values, gaps = self.values_table(), self.gaps_table()
        heads = (f"study {r.study} in {r.folder}, model {r.model}, {r.software}, seed {r.seed}" for r in self.runs)
        yield "\n".join(f"{side}: {head}" for side, head in zip(SIDES, heads, strict=True))
        yield "\n".join(self.input_lines)
        yield values if values.rows else ""
        yield APART if any(v.apart is not None for v in self.values) else ""
        yield "RMSE over the recordings that both have:" if gaps.rows else ""
        yield gaps if gaps.rows else ""
        yield "\n".join(self.verdict_lines)
        yield self.conclusion

    @property
    def conclusion(self) -> str:
        """The values that differ beyond their intervals."""
        judged = [v for v in self.values if v.apart is not None]
        beyond = [v.parameter for v in judged if v.apart is not None and v.apart > 1.0]
        if not beyond:
            if judged:
                return "No value differs beyond both intervals."
            if placed := [v.parameter for v in self.values if v.depends]:
                plural = "s" if len(placed) == 1 else ""
                return (
                    f"{listed(placed)} depend{plural} on where the effect is, so that there is no one value to compare."
                )
            fitted = any(None not in v.values for v in self.values)
            return (
                "No value has an interval in both, by which to judge it." if fitted else "No value was fitted in both."
            )
        mixed = self.sets[0].name != self.sets[1].name
        why = " One run is fitted with an effect and the other without one, which moves values too." if mixed else ""
        return f"Apart beyond both intervals: {listed(beyond)}.{why}"

    def values_table(self, names: Sequence[str] = SIDES) -> Table:
        """Return every candidate with both values that count, their intervals, and how far apart they are."""
        rows = []
        for v in self.values:
            change = "" if v.change_percent is None else change_text(v.values[1], v.values[0])
            apart = "" if v.apart is None else figures(v.apart, 3)
            given, without, with_it = map(_both, (v.given, v.without_effect, v.with_effect))
            rows.append((v.parameter, v.unit, given, *v.texts, change, apart, without, with_it))
        header = ("parameter", "unit", "given", *names, "change", "apart", "without the effect", "with the effect")
        return Table(header, tuple(rows)).without_empty() if rows else Table(header, ())

    def gaps_table(self, names: Sequence[str] = SIDES) -> Table:
        """Return the RMSE of each output at each set of values, over the recordings that both have."""
        rows = []
        for g in self.gaps:
            ratio = "" if g.ratio is None else figures(g.ratio, 3)
            rows.append((GAPS[g.at], g.output, g.unit, *map(figures, g.rmse), ratio, str(g.recordings)))
        header = ("at", "output", "unit", *names, "ratio", "recordings")
        return Table(header, tuple(rows)).without_empty() if rows else Table(header, ())

    @property
    def page(self) -> str:
        """The comparison as an HTML page in one file."""
        heads = tuple(
            (side, r.study, r.folder, r.model, r.software, str(r.seed))
            for side, r in zip(SIDES, self.runs, strict=True)
        )
        verdicts = tuple((n, *(v or "has not run" for v in both)) for n, both in self.verdicts.items())
        parts = {
            "What is compared": (self.input_lines, Table(("", "study", "results", "model", "software", "seed"), heads)),
            "Values": ([self.conclusion, APART], self.values_table()),
            "Gaps": ([], self.gaps_table()),
            "Verdicts": ([], Table(("", *SIDES), verdicts)),
            "What the model lacks": (self.finding_lines, None),
        }
        names = [r.study for r in self.runs]
        title = f"{names[0]} and {names[1]}" if names[0] != names[1] else f"{names[0]}, twice"
        return comparison_page(title, parts)

    @property
    def input_lines(self) -> list[str]:
        """The differences in software, model, files and given values, in lines; and which fitted values are compared."""
        lines = [f"{kind}: {a} and {b}" for kind, (a, b) in self.differing.items()]
        files = self.sources
        lines += [f"inputs that differ: {', '.join(files['differ'])}"] if files["differ"] else []
        lines += [f"inputs of the {s} alone: {', '.join(files[s])}" for s in SIDES if files[s]]
        lines += [f"given value of {name}: {a:.6g} and {b:.6g}" for name, (a, b) in self.given_values.items()]
        lines = lines or ["inputs, software, model and given values: the same"]
        return [*lines, *(f"values of the {side}: {v.text}" for side, v in zip(SIDES, self.sets, strict=True))]

    @property
    def verdict_lines(self) -> list[str]:
        """The verdict on the model and of each stage, in one line where both are the same, and what each diagnosis found."""
        lines = []
        for name, both in self.verdicts.items():
            if both[0] == both[1]:
                lines.append(f"{name}: the same: {both[0]}")
            else:
                lines += [f"{name}, {side}: {v or 'has not run'}" for side, v in zip(SIDES, both, strict=True)]
        return lines + self.finding_lines

    @property
    def finding_lines(self) -> list[str]:
        """What each diagnosis found missing, a line each; none where no diagnosis has run."""
        lines = []
        for side, findings in zip(SIDES, self.findings, strict=True):
            if findings is not None:
                said = [f"{f.effect} ({probability_text(f.probability)}): {f.text}" for f in findings]
                lines.append(f"missing, {side}: {' '.join(said) or 'nothing was found'}")
        kinds = [sorted(f.effect for f in findings) for findings in self.findings if findings is not None]
        if len(kinds) == 2 and any(kinds):
            lines.append(f"missing: {'the same effects' if kinds[0] == kinds[1] else 'different effects'} in both")
        return lines


@in_python
def compare_runs(first: str | Path, second: str | Path) -> RunComparison:
    """Return two results side by side.

    Parameters
    ----------
    first : str or Path
        A folder of results, or a study whose results stand beside it.
    second : str or Path
        The other one.

    Returns
    -------
    RunComparison
        `values`, each parameter's estimates in both and how far they are apart in units of both intervals; further the gaps, the
        verdicts, the findings, and the files that differ.

    Raises
    ------
    InputError
        One of them holds no results.

    Examples
    --------
    >>> import tempfile, hvdc_ident as hi
    >>> from pathlib import Path
    >>> from hvdc_ident.study import load_study, run_all, StageOptions, write_starter
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     study = load_study(write_starter(Path(folder) / "a"))
    ...     ran = run_all(study, study.folder, StageOptions())
    ...     comparison = hi.compare_runs(study.path, study.folder)
    >>> [v.apart for v in comparison.values]
    [0.0, 0.0]
    """
    folders = [folder_of(Path(p)) for p in (first, second)]
    results = [Results(f) for f in folders]
    both = [r.summary for r in results]
    headings = [r.heading for r in results]
    given = [dict(r.get("simulation").get("values") or {}) for r in results]
    differing = {k: (headings[0].get(k), headings[1].get(k)) for k in ("study", "model", "software", "seed")}
    sources = _sources(*(dict(h.get("sources") or {}) for h in headings))
    first_run, second_run = (
        read_fields(ComparedRun, {**h, "folder": f.as_posix()}) for f, h in zip(folders, headings, strict=True)
    )
    return RunComparison(
        (first_run, second_run),
        FrozenMap({k: pair for k, pair in differing.items() if pair[0] != pair[1]}),
        FrozenMap(sources),
        FrozenMap({n: (v, given[1][n]) for n, v in given[0].items() if v != given[1].get(n, v)}),
        (_set_of(both[0]), _set_of(both[1])),
        _values(both),
        _gaps(both),
        _verdicts(results),
        (_findings(both[0]), _findings(both[1])),
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
            next=(NextStep("run"),),
        )
    return path


def distance(values: Pair, intervals: Sequence[Interval | None]) -> float | None:
    """Return how far two estimates are apart, in units of both intervals.

    |a - b| / sqrt(ha^2 + hb^2), h being the half of each 95 % interval that faces the other value; of normal estimates that
    are independent the distance is above 1 in 5 % of cases where the true values agree. None where a value or an interval is not
    known, or one is open on that side, but 0 for equal values.
    """
    first, second = values
    if first is None or second is None:
        return None
    if first == second:
        return 0.0
    low, high = (0, 1) if first < second else (1, 0)
    upper, lower = (intervals[low] or (None, None))[1], (intervals[high] or (None, None))[0]
    if upper is None or lower is None:
        return None
    between = abs(first - second)
    width = math.hypot(upper - min(first, second), max(first, second) - lower)
    return between / width if width > 0.0 else None


def _with_interval(value: float, interval: Sequence[float | None] | None) -> str:
    ends = interval_text(interval)
    return estimate_texts(value, interval)[0] + (f" ({ends})" if ends else "")


def _both(values: Pair) -> str:
    """Return one number where both are the same, else both; empty where there is none."""
    first, second = ("–" if v is None else figures(v) for v in values)
    return "" if first == second == "–" else first if first == second else f"{first} / {second}"


def _findings(s: RunSummary) -> tuple[FindingSummary, ...] | None:
    return s.findings if s.diagnosis else None


def _sources(first: dict[str, str], second: dict[str, str]) -> dict[str, tuple[str, ...]]:
    """The names of files that both read and that differ, and of those that one alone read."""
    return {
        "differ": tuple(n for n in first if n in second and first[n] != second[n]),
        "first": tuple(n for n in first if n not in second),
        "second": tuple(n for n in second if n not in first),
    }


def _set_of(s: RunSummary) -> ComparedSet:
    words = "not fitted"
    if s.counting.name == "effect":
        words = f"fitted with {s.counting.added}, as the diagnosis named it"
    elif s.counting.name == "fit":
        words = f"fitted without an effect{f'; {s.counting.doubt}' if s.counting.doubt else ''}"
    return ComparedSet(s.counting.name, words)


def _values(both: Sequence[RunSummary]) -> tuple[ComparedValue, ...]:
    """Return every candidate of either result with both values that count, their intervals and their distance."""
    tables = [{p.name: p for p in s.parameters} for s in both]
    rows = []
    for name in dict.fromkeys([*tables[0], *tables[1]]):
        pair = (tables[0].get(name), tables[1].get(name))
        known = [p for p in pair if p is not None]
        values, intervals = _each(pair, lambda p: p.value), _each(pair, lambda p: p.interval)
        rows.append(
            ComparedValue(
                name,
                next((p.unit for p in known if p.unit), ""),
                _each(pair, lambda p: p.given),
                values,
                intervals,
                any(p.by_place for p in known),
                (_held(both[0], pair[0]), _held(both[1], pair[1])),
                100.0 * (values[1] / values[0] - 1.0) if values[0] and values[1] is not None else None,
                distance(values, intervals),
                _each(pair, lambda p: None if p.effect is None else p.fitted),
                _each(pair, lambda p: p.effect),
            )
        )
    return tuple(rows)


def _each(
    pair: tuple[ParameterSummary | None, ParameterSummary | None], of: Callable[[ParameterSummary], T | None]
) -> tuple[T | None, T | None]:
    """Return the same of both; None where one is not there."""
    first, second = pair
    return None if first is None else of(first), None if second is None else of(second)


def _held(s: RunSummary, p: ParameterSummary | None) -> str:
    """Return why a parameter has no value that counts; empty where it has one."""
    if p is None:
        return "no candidate"
    if p.value is not None:
        return ""
    return f"it is {by_place(p)}" if p.by_place else note_text(p) or ("not fitted" if s.fit else "no fit")


def _gaps(both: Sequence[RunSummary]) -> tuple[ComparedGap, ...]:
    """Return by output the RMSE of both, each recording that both have counting alike, at each set of values."""
    rows = []
    units = {x.output: x.unit for s in reversed(both) for x in s.signals}
    for kind in GAPS:
        first, second = (
            {(x.output, x.experiment): x.errors[kind].rmse for x in s.signals if kind in x.errors} for s in both
        )
        for output in dict.fromkeys(o for o, _ in first):
            by = {e: (rmse, second[o, e]) for (o, e), rmse in first.items() if o == output and (o, e) in second}
            if not by:
                continue
            a, b = (math.sqrt(sum(pair[k] ** 2 for pair in by.values()) / len(by)) for k in (0, 1))
            ratio = b / a if a else None
            rows.append(ComparedGap(kind, output, units.get(output, ""), (a, b), ratio, len(by), FrozenMap(by)))
    return tuple(rows)


def _verdicts(results: Sequence[Results]) -> FrozenMap[tuple[str, str]]:
    """Return the verdict on the model, then of each stage in one phrase; empty where it has not run."""
    first, second = results
    a, b = (verdict_sentence(r.summary) if r.summary.sets else "" for r in results)
    verdicts = {"model": (a, b), **{s.name: (_verdict(s, first), _verdict(s, second)) for s in stages()}}
    return FrozenMap({name: both for name, both in verdicts.items() if any(both)})


def _verdict(stage: Stage, results: Results) -> str:
    data = results.get(Path(stage.file).stem)
    if not data:
        return ""
    if not data.get("fingerprint"):
        return f"not finished: {data.get('message') or data.get('status') or 'no reason is kept'}"
    return stage.verdict(data)
