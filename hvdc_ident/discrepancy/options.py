"""Thresholds and budgets of a diagnosis."""

from __future__ import annotations

from dataclasses import dataclass

from hvdc_ident.errors import StudyError

SURE = 4.0
"""Standard errors beyond which nothing is put down to chance: one in 16 000, where a diagnosis asks some hundred such questions."""
TOLERANCE = 0.01
"""Share of the squared gap, a tenth of its amplitude, that nobody asks about: no model leaves noise alone of real records."""
REFUTED = 0.1
"""Share of the squared gap that, left over and no noise, refutes the form of an effect: the form misses a third of the amplitude."""
SHORTLIST = 6
"""The best by a cheap measure (a score, a regression) that are tried in full: formulas, filters, places, earlier rivals."""
FIELD = 40
"""Proposals refitted at a time."""
BEAM = 2
"""Hypotheses that are followed side by side."""


@dataclass(frozen=True)
class DiagnosisOptions:
    """Thresholds and budgets of a diagnosis.

    significance: largest max-T p of a named effect.
    bootstraps: noise records drawn for it (p is at least 1/(n + 1)).
    named_bic: the delta BIC that a named effect must exceed.
    set_bic: rivals within it join the ambiguity set.
    most: effects, at most.
    holdout_share: the held-out gap has to shrink by more than this share of the noise.
    starts: runs of the nominal multistart.
    fallback: search for a form outside the catalogue.
    thorough: refit four times as many candidates of each effect.
    budget: seconds after which nothing further is looked for; None: no limit.

    Declared nuisances are estimated with the parameters; a start state is one where the card leaves it free.
    """

    significance: float = 0.01
    bootstraps: int = 200
    named_bic: float = 10.0
    set_bic: float = 6.0
    most: int = 3
    holdout_share: float = 0.1
    starts: int = 2
    fallback: bool = True
    thorough: bool = False
    budget: float | None = None

    def __post_init__(self) -> None:
        if not (0 < self.significance < 1 and self.bootstraps * self.significance >= 1):
            raise StudyError(
                "the significance cannot be reached with so few bootstraps",
                where="options of a diagnosis",
                expected=f"at least {1 / self.significance:.0f} bootstraps",
                got=f"{self.bootstraps}",
            )
        if min(self.most, self.starts) < 1:
            raise StudyError("a number of effects or starts is below 1", where="options of a diagnosis")
