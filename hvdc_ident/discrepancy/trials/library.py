"""Terms that a hidden input may be made of: powers, magnitudes and products of the model's own signals, and their drifts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hvdc_ident.data import Array

MOST = 7
"""Signals the terms are made of."""
TIME = "time"
"""What a drift grows with, s: of a signal from nothing, or with it of its gain."""


@dataclass(frozen=True)
class Term:
    """A term: its text in the model's names, the signals in it, and how it is computed from them.

    knots: of a hat over a signal's levels, which is 1 at the one of number `peak` and 0 at the others.
    """

    text: str
    signals: tuple[str, ...]
    form: str
    knots: tuple[float, ...] = ()
    peak: int = 0

    def __call__(self, values: Sequence[Array]) -> Array:
        """The term along a run, (K,)."""
        a = values[0]
        b = values[-1]
        if self.form == "hat":
            return np.asarray(np.interp(a, self.knots, np.eye(len(self.knots))[self.peak]))
        return {
            "x": a, "x2": a**2, "x3": a**3, "xx": a * np.abs(a), "abs": np.abs(a), "xy": a * b, "x2y": a**2 * b,
        }[self.form]  # fmt: skip


def terms(signals: Sequence[str]) -> tuple[Term, ...]:
    """The library over some signals, the simplest first."""
    chosen = list(dict.fromkeys(signals))[:MOST]
    found = [Term(n, (n,), "x") for n in chosen]
    found += [Term(f"{n}**2", (n,), "x2") for n in chosen]
    found += [Term(f"{n}**3", (n,), "x3") for n in chosen]
    found += [Term(f"{n}*abs({n})", (n,), "xx") for n in chosen]
    found += [Term(f"abs({n})", (n,), "abs") for n in chosen]
    found += [Term(f"{a}*{b}", (a, b), "xy") for i, a in enumerate(chosen) for b in chosen[i + 1 :]]
    found += [Term(TIME, (TIME,), "x"), *(Term(f"{n}*{TIME}", (n, TIME), "xy") for n in chosen)]
    return tuple(found)


def hats(signal: str, levels: Array) -> tuple[Term, ...]:
    """A hat for each of some levels of a signal, rising: times its values there, their sum is a curve, level at both ends."""
    knots = tuple(dict.fromkeys(float(f"{v:.6g}") for v in levels))
    rises = [f"(clip({signal}, {a!r}, {b!r}) - {a!r})/{(b - a)!r}" for a, b in pairwise(knots)]
    falls = [f" - {r}" for r in rises]
    texts = [f"({up}{down})" for up, down in zip(["1", *rises], [*falls, ""], strict=True)]
    return tuple(Term(t, (signal,), "hat", knots, k) for k, t in enumerate(texts))


def along(term: Term, time: Array, values: Mapping[str, Array]) -> Array:
    """The term along a run. time: (K,) its instants, s; values: its signals, (K,) each."""
    return term([time if n == TIME else values[n] for n in term.signals])
