"""The one place that decides whether what a stage found may be told as a result; the stage runner asks it of every stage.

It looks at the JSON that the stage is about to write, so that what is checked is what is told. A violation is a bug of the
package or a case that it does not see through: the stage then counts as failed, with the violation as its message, and what
it found is kept beside it under `implausible`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

Check = Callable[[Mapping[str, Any]], Iterator[str]]
"""From a stage's JSON to the violations in it, in words."""

ROUNDING = 1e-9
"""An interval may miss its estimate by this share of the two: they went through different arithmetic."""
FINISHED = ("converged", "at-bound", "two-optima")
"""Statuses of a fit that call its values estimates."""


def violations(stage: str, data: Mapping[str, Any]) -> list[str]:
    """Return what keeps a stage's JSON from being told as a result, in words; empty where nothing does.

    stage: its name. A stage without checks of its own has those that hold for every result.
    """
    return [words for check in (*EVERY, *OWN.get(stage, ())) for words in check(data)]


def intervals_contain(data: Mapping[str, Any]) -> Iterator[str]:
    """Every value told with a 95 % interval lies in it."""
    for place, entry in _with_intervals(data, ()):
        for key in ("ci95", "ci95_independent"):
            low, high = entry.get(key) or (None, None)
            if not _contains(low, high, entry["value"]):
                yield f"{place} = {entry['value']:.6g} lies outside its own interval {_end(low)} to {_end(high)}"


def best_cost_is_told(data: Mapping[str, Any]) -> Iterator[str]:
    """No start of a fit reached a cost lower than the one told, by more than two costs that are as good may differ.

    Costs of groups fitted one after the other are not comparable with that of all together.
    """
    costs = [s["cost"] for s in data.get("starts") or () if s.get("cost") is not None and s.get("group") is None]
    cost = data.get("cost")
    if data.get("status") not in FINISHED or cost is None or not costs:
        return
    from hvdc_ident.fit.starts import DISTINCT, TIE

    rows = sum(t["n"] for line in (data.get("residual_tests") or {}).values() for t in line.values())
    effective = sum((data.get("effective_samples") or {}).values())
    worth = min(1.0, effective / rows) if rows and effective > 0 else 1.0
    fall = cost - min(costs)
    if fall > max(TIE * cost, DISTINCT / worth):
        yield f"a start reached a cost {fall:.3g} below the one told ({cost:.6g}): the estimates are not the best that was seen"


def fit_is_judged(data: Mapping[str, Any]) -> Iterator[str]:
    """Beside the intervals of a fit stands chi2/dof, or that the noise is the residual's own, and what a misfit means."""
    stated = [n for n, e in (data.get("estimates") or {}).items() if e.get("ci95")]
    if not stated or data.get("status") not in FINISHED:
        return
    judged = data.get("adequacy") or {}
    sources = (data.get("noise_source") or {}).values()
    told = any(not str(s).startswith("misfit") for s in sources)
    if not judged.get("verdict"):
        yield f"the intervals of {', '.join(stated)} stand without a verdict on the residuals"
    elif told and not _finite(judged.get("chi2_per_dof")) and judged["verdict"] != "not-judged":
        yield f"the intervals of {', '.join(stated)} stand without chi2/dof"
    elif judged["verdict"] == "does-not-fit" and not (judged.get("text") and judged.get("next")):
        yield "the model does not fit, and neither by how much nor what to do is said"


def pilot_is_judged(data: Mapping[str, Any]) -> Iterator[str]:
    """Beside the verdicts of `identify` stands the size of the pilot fit's residuals, of each group's where there are groups."""
    known = data.get("parameters") or {}
    stated = [n for n in data.get("identifiable") or () if any(e is not None for e in known[n].get("ci95") or ())]
    pilot = data.get("pilot") or {}
    if stated and not all(_finite(p.get("chi2_per_dof")) for p in pilot.get("groups") or [pilot]):
        yield f"the intervals of {', '.join(stated)} stand without chi2/dof of the pilot fit"


def branch_is_told(data: Mapping[str, Any]) -> Iterator[str]:
    """An operating point on another branch of steady states than the model's own says so."""
    point = data.get("operating_point") or {}
    branch = point.get("branch", "own")
    if branch in ("unconnected", "other") and not point.get("notes"):
        yield f"the operating point lies on another branch of steady states ('{branch}') than the model's own, and does not say so"


EVERY: tuple[Check, ...] = (intervals_contain, branch_is_told)
OWN: Mapping[str, tuple[Check, ...]] = {
    "fit": (best_cost_is_told, fit_is_judged),
    "identify": (pilot_is_judged,),
}


def _with_intervals(value: Any, path: tuple[str, ...]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Every mapping inside that has a number `value` and a `ci95`, with its place in words.

    A parameter that `identify` holds is told at the value it is held at, with what the data say of it: not an estimate.
    """
    if isinstance(value, Mapping):
        if _finite(value.get("value")) and value.get("ci95") and not _is_held(value):
            yield " ".join(path), value
        for key, inner in value.items():
            yield from _with_intervals(inner, (*path, str(key)))
    elif isinstance(value, list | tuple):
        for inner in value:
            if isinstance(inner, Mapping | list | tuple):
                yield from _with_intervals(inner, path)


def _is_held(entry: Mapping[str, Any]) -> bool:
    return entry.get("verdict") not in (None, "identifiable", "locally-identifiable", "weak", "at-bound")


def _contains(low: float | None, high: float | None, value: float) -> bool:
    slack = ROUNDING * max(abs(value), *(abs(end) for end in (low, high) if end is not None), 0.0)
    return (low is None or low <= value + slack) and (high is None or value - slack <= high)


def _finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _end(value: float | None) -> str:
    return "open" if value is None else f"{value:.6g}"
