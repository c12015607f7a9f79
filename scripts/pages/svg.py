"""Line drawings as SVG text of a few kilobytes, in the colours of the page around them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

WIDTH, HEIGHT = 640, 240
LEFT, RIGHT, TOP, BOTTOM = 56, 12, 30, 40


@dataclass(frozen=True)
class Curve:
    """A line of a drawing: its name in the legend, its class in the page's style sheet, and its points."""

    name: str
    style: str
    x: Any
    y: Any


def drawing(curves: Sequence[Curve], x_label: str, y_label: str, description: str) -> str:
    """Return an SVG element with axes, the curves and a legend; description: what a reader who cannot see it hears."""
    x_low, x_high = (f([f(c.x) for c in curves]) for f in (np.min, np.max))
    y_low, y_high = (f([f(c.y) for c in curves]) for f in (np.min, np.max))
    margin = 0.08 * (y_high - y_low or 1.0)
    y_low, y_high = y_low - margin, y_high + margin
    wide, high = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM

    def across(v: Any) -> Any:
        return LEFT + wide * (np.asarray(v) - x_low) / (x_high - x_low)

    def up(v: Any) -> Any:
        return TOP + high * (y_high - np.asarray(v)) / (y_high - y_low)

    parts = [
        f'<svg class="drawing" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(description)}">',
        f'<rect class="frame" x="{LEFT}" y="{TOP}" width="{wide}" height="{high}"/>',
    ]
    for v in ticks(x_low, x_high):
        parts.append(f'<line class="grid" x1="{across(v):.1f}" x2="{across(v):.1f}" y1="{TOP}" y2="{TOP + high}"/>')
        parts.append(f'<text class="tick" x="{across(v):.1f}" y="{TOP + high + 15}" text-anchor="middle">{v:g}</text>')
    for v in ticks(y_low, y_high):
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{LEFT + wide}" y1="{up(v):.1f}" y2="{up(v):.1f}"/>')
        parts.append(f'<text class="tick" x="{LEFT - 6}" y="{up(v) + 4:.1f}" text-anchor="end">{v:g}</text>')
    for c in curves:
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in _thinned(across(c.x), up(c.y)))
        parts.append(f'<polyline class="curve {c.style}" points="{points}"/>')
    at = LEFT
    for c in curves:
        parts.append(f'<line class="curve {c.style}" x1="{at}" x2="{at + 22}" y1="14" y2="14"/>')
        parts.append(f'<text class="legend" x="{at + 28}" y="18">{escape(c.name)}</text>')
        at += 46 + 7 * len(c.name)
    middle = LEFT + wide / 2
    parts.append(f'<text class="label" x="{middle:.0f}" y="{HEIGHT - 6}" text-anchor="middle">{escape(x_label)}</text>')
    centre = TOP + high / 2
    turned = f'transform="rotate(-90 12 {centre:.0f})" text-anchor="middle"'
    parts.append(f'<text class="label" x="12" y="{centre:.0f}" {turned}>{escape(y_label)}</text>')
    return "".join([*parts, "</svg>"])


def ticks(low: float, high: float) -> list[float]:
    """Return three to seven round values within a range."""
    raw = (high - low) / 5
    size = 10 ** np.floor(np.log10(raw))
    step = next(size * f for f in (1, 2, 5, 10) if size * f >= raw)
    first = int(np.ceil(low / step - 1e-9))
    return [round(k * step, 12) + 0.0 for k in range(first, int(np.floor(high / step + 1e-9)) + 1)]


def _thinned(x: Any, y: Any) -> list[tuple[float, float]]:
    """Return the points without those within a tenth of a pixel of a straight line between the points that stay."""
    kept = [0]
    for end in range(2, len(x)):
        a, inner = kept[-1], slice(kept[-1] + 1, end)
        is_jump = x[end] <= x[a]
        line = y[a] + (x[inner] - x[a]) / (x[end] - x[a] if not is_jump else 1.0) * (y[end] - y[a])
        if is_jump or np.max(np.abs(line - y[inner])) > 0.1:
            kept.append(end - 1)
    return [(float(x[k]), float(y[k])) for k in [*kept, len(x) - 1]]
