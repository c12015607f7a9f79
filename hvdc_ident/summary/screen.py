"""The screen of a summary: what a terminal and a notebook show of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from hvdc_ident.display import Table
from hvdc_ident.next_step import Door, next_sentence
from hvdc_ident.summary.phrases import (
    condition,
    counting_sentence,
    gained_sentence,
    noise_sentence,
    remainder_sentence,
    verdict_sentence,
    worst_text,
)
from hvdc_ident.summary.run_summary import RunSummary
from hvdc_ident.summary.tables import findings_table, values_table


def blocks(s: RunSummary, door: Door, truth: str = "", more: str = "") -> Iterator[str | Table]:
    """Yield the verdict, what noise is not known, the values, what they rest on, what is missing and what is left, and what to do next.

    truth: the values beside the true ones, where these are known, in place of the table of values. more: lines before the last.
    """
    if s.judged is not None:
        worst = worst_text(s) if s.verdict == "fail" else ""
        yield f"{s.verdict.upper()}. {verdict_sentence(s)}" + (f"\nWorst signal: {worst}." if worst else "")
    yield noise_sentence(s)
    if s.fit or s.diagnosis:
        values = values_table(s)
        yield truth or (values if values.rows else "")
        subject = "The values with the effect" if s.counting.name == "effect" else "The fitted values"
        left = remainder_sentence(s)
        told = (condition(s, subject), counting_sentence(s, door), f"Not all of it: {left}." if left else "")
        yield "\n".join(line for line in told if line)
    if s.rivals or len(s.findings) > 1:
        yield findings_table(s)
    yield "\n".join(line for line in (gained_sentence(s), more) if line)
    yield "\n".join(next_sentence(step, door) for step in s.next)


def lines_of(s: RunSummary, truth: Sequence[str] = (), more: Sequence[str] = ()) -> list[str]:
    """Return the screen of a terminal in lines."""
    screen = blocks(s, "shell", "\n".join(truth), "\n".join(more))
    return "\n\n".join(text for block in screen if (text := str(block))).splitlines()
