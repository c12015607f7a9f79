"""Noise, and recorded levels against the model's, as the rows before the events tell them and the results hold them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

PLAIN = ("offset", "difference")
"""Suggestions where nothing more is known than that the levels differ."""


@dataclass(frozen=True)
class InitialValue:
    """One output of one experiment before the event, in the output's unit; None where it is not known. A remark has no output.

    recorded: the mean of the recorded rows before the event; error: its standard error. model: the model's at its given
    values; low, high: what it can be with the candidates within their bounds. difference: recorded - model;
    noise_units: the same over the noise of a single row. slope: the recorded movement over the simulated.
    channel: what the suggestion is about: the output, two outputs ("P, Q"), "input NAME" or "time". factor: what the
    recording seems to be multiplied by; suggestion: what that is, in a few words; text: in a sentence, empty where there
    is nothing to say.
    """

    experiment: str
    output: str
    unit: str = ""
    recorded: float | None = None
    error: float | None = None
    model: float | None = None
    low: float | None = None
    high: float | None = None
    difference: float | None = None
    noise_units: float | None = None
    slope: float | None = None
    channel: str = ""
    factor: float | None = None
    suggestion: str | None = None
    text: str = ""

    @property
    def is_mistake(self) -> bool:
        """True where the recording seems wrong, not the model: a positive factor may as well be a gain of the model."""
        if self.suggestion is None or self.suggestion in PLAIN:
            return False
        return self.suggestion != "factor" or (self.factor or 0.0) < 0.0


@dataclass(frozen=True)
class NoiseNote:
    """The standard deviation an output's noise is taken to have, in its unit, and where that comes from.

    source: "given"; "estimated", from the rows before the event; "floor": those rows show no noise, and weights come from
    the misfit of the fit; "residual": no rows lie before an event, so that the fit's own residual has to tell, std being
    the least it may be. by_row: whether rows differ; std is then their root mean square.
    """

    std: float
    source: Literal["given", "estimated", "floor", "residual"]
    by_row: bool = False
