"""Context of a search, which stays over its rounds, and the result of one round."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.options import DiagnosisOptions
from hvdc_ident.discrepancy.refits.begin import Placed
from hvdc_ident.discrepancy.refits.refit import Refit
from hvdc_ident.discrepancy.scores.reach import Reach
from hvdc_ident.discrepancy.scores.scored import Path, Scores, runs
from hvdc_ident.discrepancy.signatures.candidates import CandidateEffect
from hvdc_ident.discrepancy.trials.formula import Law
from hvdc_ident.discrepancy.trials.select import CandidateFit, Pick, Ruler
from hvdc_ident.executor import Executor, Progress
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel


@dataclass(frozen=True)
class SearchContext:
    """Settings of a search, which stay over its rounds."""

    effects: tuple[str, ...] | Literal["all"]
    places: tuple[str | tuple[str, ...], ...] | None
    material: FrozenMap[float]
    options: DiagnosisOptions
    seed: int
    executor: Executor | None = None
    progress: Progress | None = None

    def tries(self, effect: str) -> bool:
        """Return True for an effect that is searched for."""
        return self.effects == "all" or effect in self.effects

    def looks_at(self, slot: str) -> bool:
        """Return True for a slot that is searched."""
        return self.places is None or any(slot in ((g,) if isinstance(g, str) else g) for g in self.places)

    def tell(self, done: int, total: int, text: str) -> None:
        """Report progress."""
        if self.progress:
            self.progress(done, total, text)


@dataclass(frozen=True, eq=False)
class Round:
    """Result of one round. winner: the best trial, where one is good enough; why: what speaks against it otherwise.

    trials: every refit, the best first. same: by candidate, others with the same signature. ruler: what BIC counts by.
    reach: what of the gap could be made good at each slot; None where that is not known. laws: the formula outside the
    catalogue that explains most, or nothing; None where none was looked for. filters: the refits of linear filters; None
    where there are none. spared: whether nothing came near the noise and what a thorough search would refit was not.
    """

    before: Refit
    paths: Mapping[str, Path]
    candidates: tuple[CandidateEffect, ...]
    scores: Scores
    trials: tuple[CandidateFit, ...]
    failed: tuple[CandidateFit, ...]
    same: Mapping[int, list[Pick]]
    winner: CandidateFit | None
    why: str
    significant: bool
    ruler: Ruler | None
    reach: Reach | None = None
    laws: tuple[Law, ...] | None = None
    filters: tuple[CandidateFit, ...] | None = None
    spared: bool = False

    @property
    def law(self) -> Law | None:
        """The formula that leaves next to nothing but noise, where no effect that was refitted does."""
        return next((one for one in self.laws or () if one.near), None)

    def reaches(self, candidate: CandidateEffect) -> bool:
        """Return True for a candidate at a slot where enough of the gap could be explained."""
        return self.reach is None or any(p in self.reach.enough for p in candidate.at)

    def answers(self) -> Mapping[str, Path]:
        """The model's answers at its slots, by experiment: computed again where the round has released them."""
        return self.paths or runs(self.before.model, self.before.nominal())

    def light(self) -> Round:
        """The round without those answers, which are hundreds of MiB of a large model."""
        return replace(self, paths={})

    def score_p(self, candidate: int) -> tuple[float, float, int]:
        """The best score of a candidate, its p, and the column it stands in (-1: none)."""
        t = self.scores.t
        own = [k for k, c in enumerate(self.scores.columns) if c.candidate == candidate]
        if not own:
            return 0.0, 1.0, -1
        k = max(own, key=lambda j: t[j])
        return float(t[k]), self.scores.p(float(t[k])), k


def slot_signals(
    model: AnyModel, paths: Mapping[str, Path], placed: Sequence[Placed] = ()
) -> dict[str, tuple[Array, ...]]:
    """The signal at every slot of the model that all experiments have, one array an experiment.

    An instrument has slots of its own in the run of its experiment, which are none of the model's. placed: effects that
    are in the model already; nothing is looked for inside them.
    """
    first, *others = (a.slots for a in paths.values())
    common = [p for p in first if p in model.insertion_points and all(p in slots for slots in others)]
    outer = [p for p in common if not any(one.use.made(p) for one in placed)]
    return {p: tuple(a.signal(p) for a in paths.values()) for p in outer}
