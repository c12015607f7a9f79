"""Gaps between recorded signals and a run of the model, as `simulation.json` holds them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from hvdc_ident.text import figures, quantity


@dataclass(frozen=True)
class SignalGap:
    """Distance of a recorded and a simulated output over the rows that are compared, in the output's unit.

    rmse: root mean square of recorded - simulated. nrmse: the same over the range that was recorded. noise: standard
    deviation of the recording's noise, noise_units: the RMSE over it; None where the noise is not known before a fit.
    largest, at: the difference of largest modulus, and its time in s.
    """

    output: str
    experiment: str
    unit: str
    rmse: float
    nrmse: float | None
    noise: float | None
    noise_units: float | None
    largest: float
    at: float

    @property
    def text(self) -> str:
        """The signal with its errors, as a phrase."""
        over = [f"{figures(100.0 * self.nrmse, 3)} % of the recorded range"] if self.nrmse is not None else []
        over += [f"{figures(self.noise_units, 3)} times the noise"] if self.noise_units is not None else []
        return f"{self.output} in {self.experiment}, RMSE {', '.join([quantity(self.rmse, self.unit), *over])}"


def worst_first(gaps: Sequence[SignalGap]) -> list[SignalGap]:
    """Return the gaps from the largest: in units of the noise where every noise is known, else over the recorded range."""
    known = all(g.noise_units is not None for g in gaps)
    return sorted(gaps, key=lambda g: -((g.noise_units if known else g.nrmse) or 0.0))
