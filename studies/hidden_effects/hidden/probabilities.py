"""Limits of proportions, and the calibration of stated probabilities."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from scipy import stats

from hidden.outcomes import Line, effects_found, is_truth, members

BINS = (0.0, 0.5, 0.8, 0.95, 0.99, 1.0)
"""Edges of the bins of stated probabilities."""
SURE = 0.95
"""The probability from which an effect is named."""


def limit_above(count: int, of: int, level: float = 0.95) -> float:
    """Return the upper Clopper-Pearson limit of a proportion."""
    return 1.0 if count >= of else float(stats.beta.ppf(level, count + 1, of - count))


def limits(count: int, of: int, level: float = 0.95) -> tuple[float, float]:
    """Return the two-sided Clopper-Pearson limits of a proportion."""
    tail = 0.5 * (1.0 - level)
    low = 0.0 if count == 0 else float(stats.beta.ppf(tail, count, of - count + 1))
    return low, limit_above(count, of, 1.0 - tail)


def calibration(lines: Sequence[Line]) -> dict[str, Any]:
    """Return how many findings are right, by their stated probability.

    A finding is right if its effect is hidden, at any insertion point: its probability is the sum over its places. placed: its
    insertion point is one of its likely places too. sure: those said with at least SURE, by plant and cleanliness too. Findings
    in records without an effect are wrong; parameters off their given values are no findings of effects and do not count.
    """
    said: list[tuple[str, float, bool, bool]] = []
    for x in lines:
        if "failed" in x:
            continue
        room = f"{x['plant']}, {'messy' if x.get('messy') else 'tidy'}"
        truths = [] if x["part"] == "clean" else x["truth"]
        for f in effects_found(x):
            told = members(f)
            right = any(is_truth(x, t, m, place=False) for t in truths for m in told)
            said.append((room, f["probability"], right, right and any(is_truth(x, t, m) for t in truths for m in told)))

    def row(part: Sequence[tuple[str, float, bool, bool]]) -> dict[str, Any]:
        n, right = len(part), sum(r for _, _, r, _ in part)
        return {
            "findings": n,
            "stated": float(np.mean([p for _, p, _, _ in part])) if n else None,
            "right": right / n if n else None,
            "limits": list(limits(right, n)) if n else None,
            "placed": sum(q for *_, q in part) / n if n else None,
        }

    edges = list(pairwise(BINS))
    return {
        "bins": {
            f"{low:g} to {high:g}": row([s for s in said if low <= s[1] < high or (high == BINS[-1] and s[1] == high)])
            for low, high in edges
        },
        "sure": row([s for s in said if s[1] >= SURE]),
        "sure_by_plant": {
            r: row([s for s in said if s[0] == r and s[1] >= SURE]) for r in sorted({s[0] for s in said})
        },
    }
