"""Blocks of the grammar: functions that the parser writes with others, so that every back end knows them.

Each gives a sympy expression from sympy expressions; effects of the same name are written with them too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import sympy as sp

from hvdc_ident.expression.functions import Max, Min, clip, where

TRACKING_TIME = 2e-4
"""Time constant, s, with which a state follows what it is held at."""
NEAR = 1e-8
"""Distance from a limit, of 1 and its magnitude, from which on a state counts as being at it. A state held exactly there would
lie on the switch itself, where there is no linear model."""
EDGE = 2e-4
"""Width of the edge of a dead band with a step, of the band's own width."""


@dataclass(frozen=True)
class Block:
    """One block of the grammar: what it gives, and how its arguments are called in messages."""

    write: Callable[..., sp.Expr]
    arguments: tuple[str, ...]
    summary: str


def deadband(u: sp.Expr, width: sp.Expr) -> sp.Expr:
    """Return the part of u that lies beyond a band of +-width."""
    return u - clip(u, -width, width)


def deadband_step(u: sp.Expr, width: sp.Expr) -> sp.Expr:
    """Return u outside a band of +-width and 0 inside, over an edge from width to (1 + EDGE) width; u itself where width is 0.

    A loop that is driven back into the band by its own reaction never rests at an ideal step: it slides along the edge. An
    edge of finite width has that sliding rest as its steady state (Filippov's solution, up to the width).
    """
    if width == 0:
        return u
    outside = u * clip((sp.Abs(u) / width - 1) / EDGE, 0, 1)
    return outside if width.is_number else where(width > 0, outside, u)


def nonwindup(rate: sp.Expr, x: sp.Expr, low: sp.Expr | None, high: sp.Expr | None) -> sp.Expr:
    """Return the rate of a state x without what would carry it beyond a limit that it has reached (IEEE 421.5); None: no limit.

    At a limit it goes the rest of the way to it within TRACKING_TIME, so that a state at its limit has a linear model.
    """
    if high is not None:
        left = high - x
        rate = where(left <= NEAR * (1 + sp.Abs(high)), Min(rate, left / TRACKING_TIME), rate)
    if low is not None:
        left = low - x
        rate = where(left >= -NEAR * (1 + sp.Abs(low)), Max(rate, left / TRACKING_TIME), rate)
    return rate


def saturation(x: sp.Expr, x1: sp.Expr, s1: sp.Expr, x2: sp.Expr, s2: sp.Expr) -> sp.Expr:
    """Return the saturation B (x - A)^2/x above A, 0 below, that is s1 at x1 and s2 at x2; 0 everywhere where s2 or x1 is 0.

    Zeros stand in data for no saturation.
    """
    given = x1 * s2
    if given == 0:
        return sp.S.Zero
    ratio = sp.sqrt(x1 * s1 / (x2 * s2))
    foot = (x1 - ratio * x2) / (1 - ratio)
    above = where(x > foot, x2 * s2 / (x2 - foot) ** 2 * (x - foot) ** 2 / x, 0)
    return above if given.is_number else where(given > 0, above, 0)


def saturation_exponential(x: sp.Expr, x1: sp.Expr, s1: sp.Expr, x2: sp.Expr, s2: sp.Expr) -> sp.Expr:
    """Return the saturation s1 (x/x1)^n, with the n that makes it s2 at x2; 0 everywhere where s1 is 0."""
    if s1 == 0:
        return sp.S.Zero
    curve = s1 * (x / x1) ** (sp.log(s2 / s1) / sp.log(x2 / x1))
    return curve if s1.is_number else where(s1 > 0, curve, 0)


def table(x: sp.Expr, at: Sequence[sp.Expr], values: Sequence[sp.Expr]) -> sp.Expr:
    """Return the characteristic that is linear between the points (at, values), and constant before the first and after the last."""
    pieces = [
        (right - left) / (high - low) * (clip(x, low, high) - low)
        for (low, high), (left, right) in zip(pairwise(at), pairwise(values), strict=True)
    ]
    return sp.Add(values[0], *pieces)


BLOCKS: Mapping[str, Block] = {
    "deadband": Block(deadband, ("u", "width"), "0 inside +-width, else u shifted towards 0 by width"),
    "deadband_step": Block(deadband_step, ("u", "width"), "0 inside +-width, else u"),
    "nonwindup": Block(
        nonwindup, ("rate", "x", "low", "high"), "the rate of a state x that is held at low and high without windup"
    ),
    "saturation": Block(
        saturation, ("x", "x1", "s1", "x2", "s2"), "B (x - A)^2/x above A, 0 below, through (x1, s1) and (x2, s2)"
    ),
    "saturation_exponential": Block(
        saturation_exponential, ("x", "x1", "s1", "x2", "s2"), "s1 (x/x1)^n, through (x1, s1) and (x2, s2)"
    ),
    "table": Block(table, ("x", "[x1, x2, ...]", "[y1, y2, ...]"), "linear between the points, constant beyond"),
}
"""The blocks by name."""
