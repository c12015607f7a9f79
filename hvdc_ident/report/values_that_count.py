"""The values that count: those fitted together with the effect that a diagnosis named, else those of the fit without one.

This is the one place that decides it. Report, letter, exported files, linear models and comparisons all ask here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from hvdc_ident.text import form_of, listed, quantity

NO_ESTIMATES = (None, "failed", "not-converged")
"""Ends of a fit whose numbers are no estimates."""


@dataclass(frozen=True)
class ValuesThatCount:
    """Which values of a study count, and why.

    name: "effect" for those fitted together with what a diagnosis named, "fit" for those of the fit without it, "" where nothing
    was fitted. added: what the model with the effect has that the model lacks, in words; empty where nothing was put in.
    doubt: why no values with an effect count though something is missing; empty where a diagnosis named it, found nothing, or
    has not run.
    """

    name: Literal["effect", "fit", ""]
    added: str = ""
    doubt: str = ""


def values_that_count(fit: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> ValuesThatCount:
    """Return which values count. fit, diagnosis: their JSON, empty where they have not run or do not stand."""
    added, verdict = _added(diagnosis), diagnosis.get("verdict")
    if verdict == "named" and added:
        return ValuesThatCount("effect", added)
    doubt = ""
    if verdict == "ambiguous" and added:
        depend = diagnosis.get("values_by_place") or {}
        what = f": {listed(depend)} depend{'s' if len(depend) == 1 else ''} on where the effect is" if depend else ""
        doubt = f"the diagnosis is ambiguous{what}"
    elif verdict == "unnameable":
        doubt = "something is missing that the diagnosis cannot name"
    return ValuesThatCount("" if fit.get("status") in NO_ESTIMATES else "fit", added, doubt)


def estimates_that_count(fit: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the estimates that count, by parameter, as a fit's JSON has them: `value`, `std`, `ci95`, `unit`, ...

    With an effect, a parameter that was estimated without an interval has its value alone.
    """
    if values_that_count(fit, diagnosis).name != "effect":
        return {n: dict(e) for n, e in (fit.get("estimates") or {}).items()}
    after, later = diagnosis.get("parameters_after") or {}, diagnosis.get("estimates_after") or {}
    fitted = (*later, *(fit.get("fitted") or ()))
    return {n: {"value": v, **(later.get(n) or {})} for n, v in after.items() if n in fitted}


def _added(diagnosis: Mapping[str, Any]) -> str:
    """Return the effects with their places and sizes in words, "lag at P (T = 350 ms)"; else the kind of the addition."""
    parts = []
    for e in diagnosis.get("effects") or ():
        sizes = [
            f"{n} = {quantity(p['value'], p.get('unit') or '')}"
            for n, p in (e.get("parameters") or {}).items()
            if p.get("value") is not None
        ]
        source = f" from {e['from']}" if e.get("from") else ""
        parts.append(f"{form_of(e)} at {listed(e['at'])}{source}" + (f" ({', '.join(sizes)})" if sizes else ""))
    kind = (diagnosis.get("fallback") or {}).get("kind", "") if diagnosis.get("augmented_model") else ""
    return "; ".join(parts) or (f"a {'formula' if kind == 'term' else kind}" if kind else "")
