"""What to measure next, in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hvdc_ident.identifiability.recommend import Ranked

WORTH = 0.9
"""An interval that does not shrink below this share of what it is now is no gain to speak of."""
NAMED = 3


def advice(
    best: Ranked,
    by_determinant: Ranked,
    now: Mapping[str, float | None],
    then: Mapping[str, float | None],
    units: Mapping[str, str],
    tried: int,
) -> str:
    """The advice, what it would give for the parameters that gain most, and what is open after it all the same."""
    gains = sorted((n for n in then if _left(now[n], then[n]) < WORTH), key=lambda n: _left(now[n], then[n]))
    if not gains:
        return (
            f"None of the {tried} experiments tried (steps, ramps, multisines and pairs of steps) would narrow an interval "
            f"by a tenth; the most would come from: {_made(best, units)}."
        )
    told = ", ".join(_told(n, now[n], then[n], units.get(n, "")) for n in gains[:NAMED])
    text = f"{_made(best, units)}: {told}."
    if best.new:
        text += f" That takes the noise of {_listed(best.new)} to be like that of the signals recorded."
    open_ = [n for n, half in then.items() if half is None]
    if open_:
        text += f" {_listed(open_)} would stay open: only together with others, or not at all, do they show."
    if by_determinant.trial != best.trial:
        text += f" For all parameters taken together most would come from another: {_made(by_determinant, units)}."
    return text


def _made(r: Ranked, units: Mapping[str, str]) -> str:
    record = f", recording {_listed(r.new)} besides the signals so far" if r.new else ", recording the same signals"
    return r.trial.text(units) + record


def _left(now: float | None, then: float | None) -> float:
    """The share of the interval that is left; 0 where it was open."""
    return 1.0 if then is None else 0.0 if now is None else then / now if now else 1.0


def _told(name: str, now: float | None, then: float | None, unit: str) -> str:
    was = "not at all" if now is None else f"±{now:.3g}"
    return f"{name} would be known to ±{then:.3g} {unit}".rstrip() + f" (now {was})"


def _listed(names: tuple[str, ...] | list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
