"""A diagnosis in the form that studies report: plain numbers for expected.json and text for the tables."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from typing import Any

from common.ending import number
from hvdc_ident.discrepancy import Diagnosis
from hvdc_ident.executor import Progress


def told(found: Diagnosis) -> dict[str, Any]:
    """Return verdict, effects with sizes, ambiguity sets, gap in noise units, and given, refitted and augmented parameters."""
    return {
        "verdict": found.verdict,
        "text": found.text,
        "effects": [
            {
                "effect": e.effect,
                "at": list(e.at),
                "from": e.source,
                "parameters": {n: {"value": s.value, "ci95": s.ci95} for n, s in e.parameters.items()},
            }
            for e in found.effects
        ],
        "ambiguity": [
            [
                {"effect": r.effect, "at": list(r.at), "from": r.source, "delta_bic": r.delta_bic,
                 "parameters": dict(r.parameters)}
                for r in group
            ]
            for group in found.ambiguity
        ],
        "measure next": (found.separating_experiment or {}).get("text"),
        "pooled": {model: dict(row) for model, row in found.gap.pooled.items()},
        "shrink_holdout": found.gap.shrink_holdout,
        "explained_share": found.remaining["explained_share"],
        "adequate": found.remaining["adequate"],
        "given": dict(found.parameters_before),
        "refitted": dict(found.parameters_refitted),
        "augmented": dict(found.parameters_after),
    }  # fmt: skip


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


def on_stderr(name: str) -> Progress:
    """Return a function that reports the progress of a diagnosis on stderr, one line for each step."""
    begun = time.perf_counter()

    def tell(done: int, total: int, text: str) -> None:
        print(f"{name}: {time.perf_counter() - begun:4.0f} s  {text} {done}/{total}", file=sys.stderr, flush=True)

    return tell
