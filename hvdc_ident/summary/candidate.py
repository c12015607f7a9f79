"""A candidate of a study as the results hold it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Candidate:
    """A line of a study's [parameters]. searched: the range that starts are drawn from. None: not stated, or without an end."""

    given: float | None = None
    start: float | None = None
    min: float | None = None
    max: float | None = None
    searched: tuple[float | None, float | None] | None = None
    unit: str = ""
