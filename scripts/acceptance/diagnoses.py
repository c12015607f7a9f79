"""Verdicts on effects that another simulator hides (studies/hidden_effects), with the time of each case."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from runs import ROOT, Item, Setting, python

SEED = 105
FOLDER = ROOT / "studies" / "hidden_effects"
QUICK = (("single", "no", 1), ("clean", "no", 1), ("outside", "no", 1))
FULL = (
    ("single", "no", 14), ("pair", "no", 3), ("triple", "no", 1), ("clean", "no", 12), ("outside", "no", 3),
    ("single", "yes", 2), ("clean", "yes", 3),
)  # fmt: skip
"""Part, messy, and how many cases of each group of plants."""


def _cases(table: Sequence[tuple[str, str, int]], setting: Setting) -> dict[str, Any]:
    """Return the cases by name: what was hidden, what was said, and how it is judged."""
    for part, messy, limit in table:
        python(
            FOLDER / "run.py", "--seed", str(SEED), "--plants", "1,2,3,4", "--least", "10", "--parts", part,
            "--messy", messy, "--limit", str(limit), "--workers", str(setting.workers), "--out", setting.folder,
            cwd=setting.folder,
        )  # fmt: skip
    sys.path.insert(0, str(FOLDER))
    from hidden.outcomes import outcome

    lines = [json.loads(t) for t in (setting.folder / "cases.jsonl").read_text(encoding="utf-8").splitlines()]
    made = [x for x in lines if not x.get("unreachable")]
    return {x["case"]: _condensed(x, outcome(x)) for x in sorted(made, key=lambda x: x["case"])}


def _condensed(line: Mapping[str, Any], outcome: str) -> dict[str, Any]:
    hidden = [f"{h['effect']} at {h['at']}" for h in line.get("truth", [])]
    said = [f"{e['effect']} at {', '.join(e['at'])}" for e in line.get("found", [])]
    head = {"plant": line["plant"], "hidden": hidden, "said": said, "verdict": line.get("verdict", "failed")}
    if line["part"] not in ("clean", "outside"):
        head["outcome"] = outcome
    return head | {"text": line.get("text", line.get("failed", "")), "cpu": round(line.get("cpu", 0.0), 1)}


def _compared(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Return the cases whose verdict or outcome is another, and those that are in one run only."""
    found = [f"{name}: only in one of the runs" for name in sorted(set(old) ^ set(new))]
    for name in sorted(set(old) & set(new)):
        a, b = (", ".join(str(x[k]) for k in ("verdict", "outcome", "said") if k in x) for x in (old[name], new[name]))
        if a != b:
            found.append(f"{name} ({'; '.join(old[name]['hidden']) or 'nothing hidden'}): {a} before, {b} now")
    return found


def _beside(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Return outcomes and CPU time of both runs."""
    rows = []
    for title, run in (("before", old), ("now", new)):
        times = sorted(x["cpu"] for x in run.values())
        judged = Counter(x.get("outcome", f"{x['verdict']} (nothing of the catalogue hidden)") for x in run.values())
        counts = ", ".join(f"{n} {k}" for k, n in sorted(judged.items()))
        rows.append(f"{title}: {counts}; CPU: median {times[len(times) // 2]:g} s, largest {times[-1]:g} s")
    return rows


ITEMS = (
    Item("hidden-effects", partial(_cases, QUICK), compare=_compared, beside=_beside),
    Item("hidden-effects-full", partial(_cases, FULL), full=True, compare=_compared, beside=_beside),
)
