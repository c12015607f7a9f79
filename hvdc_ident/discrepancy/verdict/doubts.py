"""Model checks: signs that something else is missing than what would be named, though nothing tried explains as much."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.options import DiagnosisOptions
from hvdc_ident.discrepancy.refits.constancy import constancy
from hvdc_ident.discrepancy.refits.nominal import Nominal
from hvdc_ident.discrepancy.refits.refit import Refit, signal, unseen
from hvdc_ident.discrepancy.refits.residual_tests import loud_after_breaks
from hvdc_ident.discrepancy.search.forward import SearchOutcome
from hvdc_ident.discrepancy.trials.context import Round
from hvdc_ident.discrepancy.trials.refitted import LOUD
from hvdc_ident.discrepancy.trials.select import CandidateFit
from hvdc_ident.effects import effects
from hvdc_ident.errors import SimulationError

TRIFLE = 0.005
"""Share of what is explained of which nothing is made: of real records no model leaves noise alone."""
VARYING_P = 1e-4
"""Chance under noise of experiments that agree on a size: the test is of first order, and a name is not to be lost by that."""
FORETOLD = 0.95
"""Share of the held-out gap, where it is told from noise, that a name beyond doubt explains."""


@dataclass(frozen=True)
class Doubt:
    """Why something else may stand behind what was put in, as a sentence goes on; advice: the experiment that would show it."""

    why: str
    advice: str


def doubt(
    outcome: SearchOutcome, left: Nominal, explained: float, told: float, floor: float, options: DiagnosisOptions
) -> Doubt | None:
    """The strongest objection to the effects of a search's outcome; None where there is none.

    left: their residuals. explained: by how much chi2 fell; told: the share of the held-out gap that they explain; floor: the
    mean square that noise leaves.
    """
    trifle = TRIFLE * explained
    return (
        _quick(left)
        or _one_way(outcome.refit)
        or _varying(outcome.refit, left, trifle)
        or _not_foretold(outcome.refit, told, floor)
        or _more(outcome, trifle, options)
    )


def remains(names: Sequence[str], left: str) -> Doubt:
    """Doubt because more than noise is left: the true effect leaves nothing, one in its place does.

    A relay looks like a coupling with a backlash, or like a quantiser. names: the effects that were put in; left: where the
    rest is, as a sentence.
    """
    each = list(dict.fromkeys(names))
    apart = "Each of them by itself. " if len(names) > 1 else ""
    return Doubt(left, apart + ". ".join(f"{n}: {effects()[n].excited_by}" for n in each))


def _quick(left: Nominal) -> Doubt | None:
    """Doubt because the first rows after a break are louder than the others."""
    if not loud_after_breaks(left):
        return None
    return Doubt(
        "the first rows after the inputs' breaks are still louder than the others",
        "The same steps, recorded ten times as densely for the first tenth of a second.",
    )


def _one_way(last: Refit) -> Doubt | None:
    """Doubt because a play was passed in one direction only: whatever shifts a signal once it has moved does the same."""
    for placed in last.placed:
        width = last.sizes(placed).get(effects()[placed.candidate.effect].reversal)
        if width is None:
            continue
        try:
            seen = [u for place in placed.candidate.at for u in signal(last, place).values()]
        except SimulationError:  # of a place whose signal cannot be had nothing is known
            continue
        if not any(_turned(u, width) for u in seen):
            return Doubt(
                f"in no record does the signal at {placed.candidate.at[0]} turn by more than {width:.3g}",
                f"{placed.candidate.effect}: {effects()[placed.candidate.effect].excited_by}.",
            )
    return None


def _turned(u: Array, width: float) -> bool:
    """Return True where a signal that has moved turns and goes back by more than a width."""
    risen, fallen = u - np.minimum.accumulate(u), np.maximum.accumulate(u) - u
    # After a turn both are large at once: how far it rose before its highest value yet, and how far it fell from there.
    return bool(
        np.any(np.minimum(np.maximum.accumulate(risen), fallen) > width)
        or np.any(np.minimum(np.maximum.accumulate(fallen), risen) > width)
    )


def _varying(last: Refit, left: Nominal, trifle: float) -> Doubt | None:
    """Doubt because the experiments ask for different sizes of an effect."""
    for placed in last.placed:
        found, label = constancy(last, left, placed), placed.candidate.label
        if found.p < VARYING_P and found.told > trifle:
            why = f"the experiments ask for different sizes of {label} (p = {found.p:.1g})"
            return Doubt(why, f"The same input in several sizes, in which {label} answers.")
    return None


def _not_foretold(last: Refit, told: float, floor: float) -> Doubt | None:
    """Doubt because held-out records are explained in part only, and the rest is louder than noise may be."""
    now = unseen(last)
    if told >= FORETOLD or now is None or now**2 <= LOUD * floor:
        return None
    return Doubt(
        f"only {told:.0%} of the held-out gap is explained",
        "More experiments like the held-out ones, some of them to be fitted.",
    )


def _more(outcome: SearchOutcome, trifle: float, options: DiagnosisOptions) -> Doubt | None:
    """Doubt because another effect beside them is too small to matter and yet no noise."""
    more = _further(outcome.rounds[-1], options)
    if more is None or outcome.refit.chi2 - more.refit.chi2 <= trifle:
        return None
    label = more.refit.placed[-1].candidate.label
    return Doubt(
        f"{label} beside it would explain a little more, and more than noise (delta BIC {more.gain:.3g})",
        f"What moves {label} alone, and by more.",
    )


def _further(last: Round, options: DiagnosisOptions) -> CandidateFit | None:
    """The best further effect of a round that ended the search because none is large enough, where it is no noise."""
    if last.winner is not None:
        return None
    sure = (t for t in last.trials if min(t.gain, t.told) > options.named_bic)
    best = max(sure, key=lambda t: t.told, default=None)
    return best if best is not None and last.scores.p(best.pick.score) <= options.significance else None
