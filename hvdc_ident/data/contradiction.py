"""Contradictions: what in a recording cannot be as it is written, where, and what to write so that it is right."""

from __future__ import annotations

from dataclasses import dataclass


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
