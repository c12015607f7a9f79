"""Which candidates explain the data as well as the one that was put in, and what would tell them apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hvdc_ident.discrepancy.explain import advice
from hvdc_ident.discrepancy.options import Options
from hvdc_ident.discrepancy.result import Rival
from hvdc_ident.discrepancy.rounds import Round, Trial
from hvdc_ident.discrepancy.select import at_edge, clear
from hvdc_ident.frozen import FrozenMap


def rivals(found: Round, options: Options) -> tuple[Rival, ...]:
    """The winner and every candidate within delta BIC of it, the best first; those with its very signature too."""
    assert found.winner is not None
    best = max(t.gain for t in found.trials)
    group: list[Rival] = []
    for trial in found.trials:
        behind = best - trial.gain
        if behind > options.set_bic or (trial is not found.winner and _is_nothing(trial)):
            continue
        c = found.candidates[trial.pick.candidate]
        sizes = trial.refit.sizes(trial.refit.placed[-1])
        group.append(Rival(c.effect, c.at, behind, FrozenMap(sizes), c.source))
        for twin in found.same.get(trial.pick.candidate, ()):
            other = found.candidates[twin.candidate]
            group.append(Rival(other.effect, other.at, behind, FrozenMap(), other.source, refitted=False))
    return tuple(sorted(group, key=lambda r: r.delta_bic))


def _is_nothing(trial: Trial) -> bool:
    last = len(trial.refit.placed) - 1
    return at_edge(trial.refit, last) or not clear(trial.refit, last)


def separating(groups: Sequence[Sequence[Rival]]) -> Mapping[str, Any]:
    """For each set with more than one member what would tell them apart, in words; empty where there is none."""
    texts = []
    for group in groups:
        if len(group) > 1:
            first = group[0]
            told = advice(first.effect, [(r.effect, r.at) for r in group[1:]], first.at)
            if told:
                texts.append(told)
    return {"text": ". ".join(t[:1].upper() + t[1:] for t in texts)} if texts else {}
