"""Drawing of profiles and intervals of an identifiability report or a fit, on given axes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.colours import FITTED, MARK
from hvdc_ident.data import Array
from hvdc_ident.text import with_unit

if TYPE_CHECKING:
    from hvdc_ident.fit.profile import Profile
    from hvdc_ident.fit.result import Estimate
    from hvdc_ident.identifiability.verdicts import Verdict

HELD = "#b0b0b0"
FINEST = 1e-4
"""%: below this the axis of the intervals is linear."""


def draw_profile(axes: Any, profile: Profile, verdict: Verdict) -> None:
    """Draw the rise of the cost over one parameter, in units of the 95 % level, with the ends of the interval."""
    x, y = profile.values, profile.rises / profile.threshold
    axes.plot(*joined(x, y), color=FITTED, linewidth=1.2)
    axes.plot(x, y, color=FITTED, linewidth=0, marker="o", markersize=2.5)
    axes.axhline(1.0, color=MARK, linewidth=0.8, linestyle="--")
    for end in profile.ci95:
        if end is not None:
            axes.axvline(end, color=MARK, linewidth=0.7, linestyle=":")
    axes.set_xlabel(with_unit(verdict.name, verdict.unit), fontsize=8)
    axes.set_ylabel("rise of the cost / 95 % level", fontsize=8)
    axes.set_title(verdict.verdict, fontsize=8)
    axes.set_ylim(-0.05, min(max(1.6, float(np.nanmax(y, initial=0.0)) * 1.05), 4.0))
    axes.ticklabel_format(axis="x", useOffset=False)
    _plain(axes)


def joined(x: Array, y: Array) -> tuple[Array, Array]:
    """Return the points joined by pieces of parabolas: straight lines in the signed root of the rise."""
    root = np.sqrt(np.clip(y, 0.0, None)) * np.where(x < x[int(np.argmin(y))], -1.0, 1.0)
    dense = np.unique(np.concatenate([x, np.linspace(x[0], x[-1], 200)]))
    return dense, np.interp(dense, x, root) ** 2


def draw_intervals(axes: Any, parameters: Mapping[str, Verdict] | Mapping[str, Estimate]) -> None:
    """Draw the 95 % interval of each parameter about its value, in % of its scale, open ends as arrows, with any verdict."""
    names = list(parameters)
    ends = {n: _relative(parameters[n]) for n in names}
    known = [abs(e) for pair in ends.values() if pair is not None for e in pair if e is not None and e != 0]
    smallest, reach = max(min(known, default=1.0), FINEST), 3.0 * max([*known, 1.0])
    for row, name in enumerate(names):
        pair = ends[name]
        if pair is None:
            axes.plot([0.0], [row], marker="x", color=HELD)
            continue
        low, high = (edge if e is None else e for e, edge in zip(pair, (-reach, reach), strict=True))
        axes.plot([low, high], [row, row], color=FITTED, linewidth=2)
        axes.plot([0.0], [row], marker="o", color=FITTED, markersize=4)
        for end, at, arrow in ((pair[0], low, "<"), (pair[1], high, ">")):
            axes.plot([at], [row], marker="|" if end is not None else arrow, color=FITTED, markersize=8)
    axes.set_xscale("symlog", linthresh=smallest)
    axes.set_xlim(-1.5 * reach, 1.5 * reach)
    ticks = _decades(smallest, reach)
    axes.set_xticks(ticks, [f"{t:g}" for t in ticks], minor=False)
    axes.set_xticks([], minor=True)
    axes.set_yticks(
        range(len(names)), [f"{n}\n{getattr(p, 'verdict', '')}".rstrip() for n, p in parameters.items()], fontsize=7
    )
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_xlabel("95 % interval, % of the value (of the range where 0 is admissible); x: held", fontsize=8)
    _plain(axes)


def _decades(low: float, high: float) -> list[float]:
    """0 and powers of ten on both sides of it, at most about four a side, from above low up to high; one or two numbers of the
    series 1, 2, 5 a side where no power of ten lies between."""
    first, last = int(np.floor(np.log10(low))) + 1, int(np.floor(np.log10(high)))
    sides = [10.0**k for k in range(last, first - 1, -max(1, (last - first + 4) // 4))]
    if not sides:
        sides = [m * 10.0**k for k in (last, last - 1) for m in (5, 2, 1) if m * 10.0**k <= high][:2]
    return sorted([-s for s in sides] + [0.0] + sides)


def _relative(parameter: Verdict | Estimate) -> tuple[float | None, float | None] | None:
    """Return the interval's ends about the value, in % of what widths are compared with; None where there is no interval."""
    if not parameter.ci95:
        return None
    value, scale = parameter.value, getattr(parameter, "scale", abs(parameter.value)) or 1.0
    low, high = (None if e is None else 100.0 * (e - value) / scale for e in parameter.ci95)
    return low, high


def _plain(axes: Any) -> None:
    axes.tick_params(labelsize=7)
    axes.grid(True, color="#e4e4e4", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
