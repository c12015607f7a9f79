"""The verdict on each parameter, with one sentence of reason.

Every function makes the verdict of one case and writes its sentence; the numbers come from the stages in `practical`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from hvdc_ident.codec import NOT_STORED
from hvdc_ident.fit.fit_parameter import FitParameter
from hvdc_ident.fit.profile import Profile
from hvdc_ident.text import figures_of, quantity, span, times_text

VerdictName = Literal[
    "structurally-unidentifiable",
    "insensitive",
    "practically-unidentifiable",
    "not-judged",
    "weak",
    "at-bound",
    "locally-identifiable",
    "identifiable",
]
WIDE = 0.5
"""A half-width of more than this share of the value (of the range where 0 is admissible) makes a parameter weak."""
HIDDEN_BY_MISFIT: tuple[VerdictName, ...] = ("insensitive", "practically-unidentifiable", "at-bound")
"""Verdicts that are taken back where the misfit alone led to them: the parameter is then not judged."""
COLLINEAR = 20.0
"""A standard deviation that the others make so many times larger is worded, and so is half of that: a parameter that is known well all the
same is not weak."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """Verdict on one parameter, with its evidence; numbers in `unit`.

    value: at the optimum; of a held one, what it is held at. ci95: from the profile; an end that is None is not known.
    std, relative_std: only of identifiable ones. sensitivity_norm: of its whitened, scaled column. collinearity: by how
    much the others widen its standard deviation. partner: the one most collinear with it. conditional_on: parameters
    held without which it could not be told. profile: the evidence.
    scale: what widths are compared with, the value or, where 0 is admissible, the range. optima: its value at every optimum
    that is as good, the best first, where there are several.
    """

    name: str
    verdict: VerdictName
    reason: str
    value: float
    unit: str = ""
    ci95: tuple[float | None, float | None] | None = None
    std: float | None = None
    relative_std: float | None = None
    sensitivity_norm: float | None = None
    collinearity: float | None = None
    partner: str = ""
    conditional_on: tuple[str, ...] = ()
    profile: Profile | None = field(default=None, metadata=NOT_STORED)
    scale: float | None = None
    optima: tuple[float, ...] = ()

    @property
    def interval(self) -> tuple[float | None, float | None] | None:
        """The 95 % interval, `ci95`."""
        return self.ci95

    def noted(self, *notes: str) -> Verdict:
        """Return the verdict with remarks added to its reason."""
        return replace(self, reason=" ".join([self.reason, *(n for n in notes if n)]))

    def under_misfit(self) -> Verdict:
        """Return the verdict without interval and standard deviation: these records refute the model that they are of."""
        if self.ci95 is None:
            return self
        reason = f"If nothing else is missing, {self.reason[:1].lower()}{self.reason[1:]}"
        if self.verdict != "weak":
            reason = f"If nothing else is missing, it is {self.verdict}; the model leaves more than noise, and no interval of it holds."
        return replace(self, reason=reason, ci95=None, std=None, relative_std=None)


def structural_verdict(
    name: str,
    words: str,
    held_at: float | None,
    unit: str,
    conditional_on: Sequence[str] = (),
    *,
    local: bool = False,
) -> Verdict:
    """Return the verdict where only a combination shows, whatever the data. held_at: its given value where it is one of those held.

    local: that was found from numbers at a few points.
    """
    text = f"{'At every point tried' if local else 'However good the data'}, {words}"
    if held_at is not None:
        text += f": it is held at {quantity(held_at, unit)}."
        return Verdict(name, "structurally-unidentifiable", text, held_at, unit)
    text += f": what is found holds for {', '.join(conditional_on)} as held." if conditional_on else "."
    return Verdict(name, "structurally-unidentifiable", text, float("nan"), unit, conditional_on=tuple(conditional_on))


def insensitive_verdict(
    free: FitParameter, ends: tuple[float, float], rise: float, threshold: float, unit: str, also: str = ""
) -> Verdict:
    """Return the verdict where the whole range moves the outputs by less than noise may.

    rise: of the cost at the worse end. also: a remark.
    """
    effect = "the outputs do not change at all" if rise < 1e-9 else f"it changes the cost by {rise:.2g} at most"
    why = "" if rise < 1e-9 else f", where {threshold:.3g} would be needed to see it"
    return Verdict(
        free.name,
        "insensitive",
        f"Anywhere between {span(*ends, unit)} {effect}{why}. {also}".rstrip(),
        free.given,
        unit,
    )


def open_verdict(profile: Profile, words: str, unit: str) -> Verdict:
    """Return the verdict where the profile is open inside the bounds, or flat at its best.

    words: on the combination that the parameter belongs to, if any.
    """
    low, high = profile.lower.crossing, profile.upper.crossing
    ends = (("below", low, profile.lower.reason), ("above", high, profile.upper.reason))
    text = (
        f"These data do not bound it {' nor '.join(f'from {side} ({why})' for side, end, why in ends if end is None)}"
    )
    if low is not None or high is not None:
        known = f"above {quantity(low, unit)}" if low is not None else f"below {quantity(high or 0.0, unit)}"
        text += f"; with 95 % confidence it is {known}"
    text += "." + (f" Of these data {words}." if words else "")
    return Verdict(profile.name, "practically-unidentifiable", text, profile.value, unit, profile.ci95, profile=profile)


def unjudged_verdict(judged: Verdict, times: float, half: float) -> Verdict:
    """Return a verdict that only the misfit led to, taken back. times: the misfit over the noise. half: what noise alone leaves.

    One at a bound stands there all the same, with the remark.
    """
    why = f"the model misses these records by {times_text(times)} the noise; diagnose first"
    if judged.verdict == "at-bound":
        return judged.noted(f"Not to be believed before the misfit is explained: {why}.")
    text = f"Not judged: {why}. Against that misfit it is {judged.verdict}; "
    text += f"against the noise alone its 95 % confidence interval would be ±{quantity(half, judged.unit)}."
    return replace(judged, verdict="not-judged", reason=text)


def with_misfit_remark(judged: Verdict, times: float, half: float) -> Verdict:
    """Return a weak verdict with the remark that only the misfit makes it so. times: the misfit over the noise. half: as above."""
    return judged.noted(
        f"That is the misfit's doing, {times_text(times)} the noise: against the noise alone its 95 % "
        f"confidence interval would be ±{quantity(half, judged.unit)}; diagnose first."
    )


def null_direction_verdict(name: str, words: str, value: float, unit: str) -> Verdict:
    """Return the verdict where the sensitivity is that of other parameters together: only a combination shows in these data."""
    return Verdict(name, "practically-unidentifiable", f"In these experiments {words}.", value, unit)


def at_bound_verdict(profile: Profile, free: FitParameter, physical: bool, unit: str) -> Verdict:
    """Return the verdict where the optimum lies on a bound; the other end is its one-sided limit."""
    low = profile.value <= free.min
    limit = profile.upper.limit if low else profile.lower.limit
    ci = (profile.value, limit) if low else (limit, profile.value)
    assert limit is not None
    side = "lower" if low else "upper"
    kind = "physical" if physical else "search"
    beyond = "" if physical else "; the optimum may lie beyond it, so widen the bounds"
    text = (
        f"The best value is its {side} {kind} bound {quantity(profile.value, unit)}{beyond}; with 95 % confidence it is "
        f"{'below' if low else 'above'} {quantity(limit, unit)}."
    )
    return Verdict(profile.name, "at-bound", text, profile.value, unit, ci, profile=profile)


def closed_verdict(
    profile: Profile, free: FitParameter, std: float, collinearity: float, partner: str, best: str, unit: str
) -> Verdict:
    """Return the verdict weak or identifiable, where the interval is known. std: in its unit. best: the experiment that
    tells most about it.
    """
    low, high = profile.ci95
    assert low is not None and high is not None
    half = 0.5 * (high - low)
    scale, of = scale_of(free, profile.value)
    share = half / scale if scale > 0 else math.inf
    judged = Verdict(profile.name, "weak", "", profile.value, unit, (low, high), profile=profile)
    judged = replace(judged, collinearity=collinearity, partner=partner)
    interval = span(low, high, unit, word="…")
    if share > WIDE:
        text = _where(profile, interval)
        ends = (profile.lower.crossing, profile.upper.crossing)
        if ends == (None, None):
            pass  # the width of the bounds is no result
        elif share <= 1.0 or math.isfinite(free.max - free.min) or free.min > 0:
            text += f", ±{100 * share:.3g} % {of}"
        else:
            text += ", wider than its value; it has no bounds, and its card no typical size, to compare that with"
        if collinearity > COLLINEAR:
            text += f", and {partner} can make good nearly all it does (collinearity {collinearity:.3g})"
        return replace(judged, reason=f"{text}.")
    text = f"It is known to ±{100 * share:.2g} % {of} (95 %: {interval}), mostly from {best}"
    if collinearity > COLLINEAR:
        text += f", though {partner} can make good nearly all it does (collinearity {collinearity:.3g})"
    elif collinearity > 0.5 * COLLINEAR:
        text += f", though {partner} acts much alike (collinearity {collinearity:.3g})"
    relative = std / abs(profile.value) if profile.value else None
    return replace(judged, verdict="identifiable", reason=f"{text}.", std=std, relative_std=relative)


def _where(profile: Profile, interval: str) -> str:
    """Return the words for the profile of a weak parameter; an end that is only the parameter's own bound is no finding of the data."""
    low, high = profile.lower.crossing, profile.upper.crossing
    if low is not None and high is not None:
        return f"It is known only to lie in {interval}"
    if low is not None or high is not None:
        return f"It is known only to lie in {interval}, where the {'upper' if high is None else 'lower'} end is its physical bound"
    return f"These data do not narrow its physical bounds, {interval}"


def scale_of(free: FitParameter, value: float) -> tuple[float, str]:
    """Return the scale that a width is compared with, in the parameter's unit, and what that is in words.

    The value where it is positive by its bounds, else the range; without bounds the value too, or the card's typical size
    where that is more. Never the start, which is the user's guess and would make the verdict one.
    """
    if free.min > 0:
        return abs(value), "of its value"
    if math.isfinite(free.max - free.min):
        return free.max - free.min, "of its range"
    return (free.scale, "of its typical size") if free.scale > abs(value) else (abs(value), "of its value")


def local_verdict(judged: Verdict, others: Sequence[float], rise: float) -> Verdict:
    """Return the verdict where several optima are as good. others: its values there; rise: of the cost at the next best."""
    low, high = judged.ci95 or (None, None)
    assert low is not None and high is not None
    values = tuple(dict.fromkeys(others))
    digits = figures_of((low, high), 4)
    this = f"{quantity(judged.value, judged.unit, digits)} (95 %: {span(low, high, word='…')})"
    other = " and ".join(quantity(v, judged.unit, digits) for v in values)
    text = f"{this} explains these records, and so does {other} with other values beside it (cost higher by {max(rise, 0.0):.2g}): "
    reason = f"{text}only other knowledge can choose."
    if judged.verdict != "identifiable":
        reason = f"{reason} About the first: {judged.reason.removeprefix('It is ')}"
    optima = (judged.value, *values)
    return replace(judged, verdict="locally-identifiable", reason=reason, std=None, relative_std=None, optima=optima)
