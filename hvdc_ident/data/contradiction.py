"""Contradictions: what in a recording cannot be as it is written, where, and what to write so that it is right."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Contradiction:
    """One finding about a recording that contradicts itself, its model, or what its files state.

    kind: in a word or two: "stuck", "zeros", "unit", "sign", ... where: the experiment, file or column. what: a sentence, without the
    place and without a full stop. columns: those it is about. rows: the first and the last data row, counted from 1; times: their
    instants in s; None where all rows are alike. write: text for the study that works when it is copied, "" where there is none.
    done: what was done about it already, in words, as "left out"; "" where it is for the reader to mend: only then is it a hindrance.
    """

    kind: str
    where: str
    what: str
    columns: tuple[str, ...] = ()
    rows: tuple[int, int] | None = None
    times: tuple[float, float] | None = None
    write: str = ""
    done: str = ""

    @property
    def text(self) -> str:
        """The finding as one line: where, what, what was done, or what to write."""
        done = f"; {self.done}" if self.done else ""
        write = f"; write: {self.write}" if self.write and not self.done else ""
        otherwise = f" (otherwise write: {self.write})" if self.write and self.done else ""
        return f"{self.where}: {self.what}{done}{write}{otherwise}"


@dataclass(frozen=True)
class Band:
    """A span of time of a recording whose rows cannot be right or were left out. first, last: s. kind, what: of its contradiction."""

    first: float
    last: float
    kind: str
    what: str


def bands(recording: Mapping[str, Any], others: Collection[str]) -> tuple[Band, ...]:
    """Return the bands that a figure of a recording shades. recording: `Experiment.recording`; others: signals that the figure does
    not show, and on which nothing in it depends: what is wrong with these alone is not told.
    """
    return tuple(
        Band(float(c["times"][0]), float(c["times"][1]), c["kind"], c["what"])
        for c in recording.get("contradictions", ())
        if c["times"] and not (c["columns"] and set(c["columns"]) <= set(others))
    )
