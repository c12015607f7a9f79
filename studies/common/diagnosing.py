"""A diagnosis in the form that studies report: plain numbers for expected.json and text for the tables."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

from common.ending import interval, markdown, number
from hvdc_ident.discrepancy import Diagnosis
from hvdc_ident.effects import apply_effects
from hvdc_ident.executor import Progress
from hvdc_ident.model import Model

SHOWN = 3
"""Places of a finding that a table names."""
FOUND = (
    "verdict",
    "finding",
    "probability",
    "size (95 %)",
    "delay, ms",
    "places",
    "left of the gap, fitted; held out",
    "times the noise",
)
"""Columns of `findings`."""


def told(found: Diagnosis) -> dict[str, Any]:
    """Return verdict, findings, what is left, effects with sizes, the gap in noise units, and the parameters before and after."""
    return {
        "verdict": found.verdict,
        "text": found.text,
        "findings": found.to_dict()["findings"],
        "remainder": dict(found.remainder),
        "effects": [
            {
                "effect": e.effect,
                "at": list(e.at),
                "from": e.source,
                "parameters": {n: {"value": s.value, "ci95": s.ci95} for n, s in e.parameters.items()},
            }
            for e in found.effects
        ],
        "measure next": (found.separating_experiment or {}).get("text"),
        "pooled": {model: dict(row) for model, row in found.gap.pooled.items()},
        "shrink_holdout": found.gap.shrink_holdout,
        "given": dict(found.parameters_before),
        "refitted": dict(found.parameters_refitted),
        "augmented": dict(found.parameters_after),
    }


def label(line: Mapping[str, Any], digits: int = 3) -> str:
    """Return an effect with its insertion point and sizes: "lag at P2_m (T 0.00146)"."""
    brought = f" from {line['from']}" if line["from"] else ""
    sizes = ", ".join(
        f"{n} {number(s['value'] if isinstance(s, Mapping) else s, digits)}" for n, s in line["parameters"].items()
    )
    return f"{line['effect']} at {', '.join(line['at'])}{brought}" + (f" ({sizes})" if sizes else "")


def effects_of(diagnosed: Mapping[str, Any]) -> str:
    """Return the inserted effects as text; a dash for none."""
    return "; ".join(label(e) for e in diagnosed["effects"]) or "-"


def findings(cases: Mapping[str, Mapping[str, Any]], head: str) -> str:
    """Return the table of what was found in each case, one line for each finding. head: title of the first column."""
    rows = []
    for name, case in cases.items():
        begin, end = [name, case["verdict"]], _left(case["remainder"])
        for f in case["findings"] or [None]:
            rows.append([*begin, *_finding(f), *end])
            begin, end = ["", ""], ["", ""]
    return markdown([head, *FOUND], rows)


def _finding(f: Mapping[str, Any] | None) -> list[str]:
    if f is None:
        return ["-"] * 5
    size = ", ".join(
        f"{n} {number(s['value'], 3)}" + (f" ({interval(s['ci95'], 3)})" if s["ci95"] else "")
        for n, s in f["parameters"].items()
    )
    late = f["equivalent_delay"]
    names = " or ".join(dict.fromkeys((f["effect"], *f["same_as"])))
    return [
        names,
        number(f["probability"], 3),
        size,
        "-" if late is None else number(1e3 * late["value"], 3),
        "-" if f["effect"] == "parameter" else _places(f["places"]),
    ]


def _places(places: Sequence[Mapping[str, Any]]) -> str:
    """Return the likeliest places with their probabilities, the others as a number."""
    named = [
        f"{', '.join(p['at'])}{' from ' + p['from'] if p.get('from') else ''} ({number(p['probability'], 2)})"
        for p in places[:SHOWN]
    ]
    return "; ".join([*named, *([f"{len(places) - SHOWN} more"] if len(places) > SHOWN else [])])


def _left(remainder: Mapping[str, Any]) -> list[str]:
    if not remainder:
        return ["-", "-"]
    shares = [None if remainder[k] is None else 100 * remainder[k] for k in ("share", "held_out")]
    return ["; ".join("-" if s is None else f"{number(s, 2)} %" for s in shares), number(remainder["noise_units"], 3)]


def augmented(model: Model, effects: Sequence[Mapping[str, Any]]) -> Model:
    """Return the model with effects as a diagnosis tells them, at their sizes."""
    uses = []
    for e in effects:
        sizes = {n: s["value"] if isinstance(s, Mapping) else s for n, s in e["parameters"].items()}
        uses.append(
            {"effect": e["effect"], "at": e["at"], "parameters": sizes} | ({"from": e["from"]} if e["from"] else {})
        )
    return apply_effects(model, uses)


def on_stderr(name: str) -> Progress:
    """Return a function that reports the progress of a diagnosis on stderr, one line for each step."""
    begun = time.perf_counter()

    def tell(done: int, total: int, text: str) -> None:
        print(f"{name}: {time.perf_counter() - begun:4.0f} s  {text} {done}/{total}", file=sys.stderr, flush=True)

    return tell
