"""Terms that a hidden input may be made of: powers, magnitudes and products of the model's own signals, and their drifts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hvdc_ident.trajectory import Array

MOST = 7
"""Signals the terms are made of."""
TIME = "time"
"""What a drift grows with, s: of a signal from nothing, or with it of its gain."""


@dataclass(frozen=True)
class Term:
    """A term: its text in the model's names, the signals in it, and how it is computed from them."""

    text: str
    signals: tuple[str, ...]
    form: str

    def __call__(self, values: Sequence[Array]) -> Array:
        """The term along a run, (K,)."""
        a = values[0]
        b = values[-1]
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


def along(term: Term, time: Array, values: Mapping[str, Array]) -> Array:
    """The term along a run. time: (K,) its instants, s; values: its signals, (K,) each."""
    return term([time if n == TIME else values[n] for n in term.signals])
