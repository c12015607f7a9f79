"""Context of a search, which stays over its rounds, and the result of one round."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hvdc_ident.data import Array, Experiment
from hvdc_ident.discrepancy.evidence import CandidateFit, Ruler
from hvdc_ident.discrepancy.formula import Law
from hvdc_ident.discrepancy.latent import Reach
from hvdc_ident.discrepancy.options import DiagnosisOptions
from hvdc_ident.discrepancy.placed import Placed
from hvdc_ident.discrepancy.refit import Refit
from hvdc_ident.discrepancy.scores import Path, Scores, runs
from hvdc_ident.discrepancy.signatures.candidates import CandidateEffect
from hvdc_ident.executor import Executor, Progress
from hvdc_ident.fit import FitParameter
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel

STEPS_AFTER = 60
"""Steps that the bar leaves room for behind those that are known: about what one more round of refits takes."""


@dataclass(eq=False)
class Course:
    """Progress of a search as people see it: in per cent, never backwards, with the best hypothesis so far.

    How many steps there will be is not known before the end, so the bar leaves room for one more round.
    """

    progress: Progress
    finished: int = 0
    batch: int = 0
    done: int = 0
    percent: int = 0
    best: str = ""
    left: float = math.inf

    def step(self, done: int, total: int, text: str) -> None:
        """Report that so many steps of a batch are done."""
        if done < self.done or total != self.batch:
            self.finished, self.batch = self.finished + self.batch, total
        self.done = done
        reached = 100 * (self.finished + done) // (self.finished + total + STEPS_AFTER)
        self.percent = max(self.percent, reached)
        best = f"; best so far: {self.best}, {self.left:.3g} times the noise is left" if self.best else ""
        self.progress(self.percent, 100, text + best)

    def lead(self, label: str, left: float) -> None:
        """Remember a hypothesis that leaves less than those before. left: root mean square of its residual, in noise units."""
        if left < self.left:
            self.best, self.left = label, left


@dataclass(frozen=True)
class SearchContext:
    """Settings of a search, which stay over its rounds.

    deadline: instant at which its budget ends (`time.monotonic`), s. held: candidates of the fit that the nominal
    model holds; stated: its other parameters, with bounds as near as they are known. records: the experiments, on their
    own clocks; none where it is not asked whether these are off.
    """

    effects: tuple[str, ...] | Literal["all"]
    places: tuple[str | tuple[str, ...], ...] | None
    tolerance: FrozenMap[float]
    options: DiagnosisOptions
    seed: int
    executor: Executor | None = None
    course: Course | None = None
    deadline: float = math.inf
    held: tuple[FitParameter, ...] = ()
    stated: tuple[FitParameter, ...] = ()
    records: tuple[Experiment, ...] = ()

    @property
    def spent(self) -> bool:
        """True once the budget is over, by the monotonic clock."""
        return time.monotonic() > self.deadline

    def tries(self, effect: str) -> bool:
        """Return True for an effect that is searched for."""
        return self.effects == "all" or effect in self.effects

    def looks_at(self, slot: str) -> bool:
        """Return True for a slot that is searched."""
        return self.places is None or any(slot in ((g,) if isinstance(g, str) else g) for g in self.places)

    def tell(self, done: int, total: int, text: str) -> None:
        """Report progress."""
        if self.course:
            self.course.step(done, total, text)

    def lead(self, refit: Refit) -> None:
        """Report the best of the hypotheses that were just refitted."""
        if self.course:
            label = " and ".join(p.candidate.label for p in refit.placed)
            self.course.lead(label, math.sqrt(refit.chi2 / refit.rows))


@dataclass(frozen=True, eq=False)
class Round:
    """Result of one round. winner: the best trial, where one is good enough; why: what speaks against it otherwise.

    trials: every refit, the best first. ruler: what BIC counts by. reach: what of the gap could be made good at each slot; None
    where that is not known. laws: the formula outside the catalogue that explains most, or nothing; None where none was
    looked for. filters: the refits of linear filters; None where there are none. untried: proposals that were not refitted
    though nothing came near the noise.
    """

    before: Refit
    paths: Mapping[str, Path]
    candidates: tuple[CandidateEffect, ...]
    scores: Scores
    trials: tuple[CandidateFit, ...]
    failed: tuple[CandidateFit, ...]
    winner: CandidateFit | None
    why: str
    significant: bool
    ruler: Ruler | None
    reach: Reach | None = None
    laws: tuple[Law, ...] | None = None
    filters: tuple[CandidateFit, ...] | None = None
    untried: int = 0

    @property
    def law(self) -> Law | None:
        """The formula that leaves next to nothing but noise, where no effect that was refitted does."""
        return next((one for one in self.laws or () if one.near), None)

    def reaches(self, candidate: CandidateEffect) -> bool:
        """Return True for a candidate at a slot where enough of the gap could be explained."""
        return self.reach is None or any(p in self.reach.enough for p in candidate.at)

    def bound(self, candidate: CandidateEffect) -> float:
        """The share of the gap that anything at the candidate's slots could explain; infinite where that is not known."""
        return math.inf if self.reach is None else max(self.reach.shares.get(p, math.inf) for p in candidate.at)

    def answers(self) -> Mapping[str, Path]:
        """The model's answers at its slots, by experiment: computed again where the round has released them."""
        return self.paths or runs(self.before.model, self.before.nominal())

    def shown(self, at: tuple[str, ...], added: Sequence[Array]) -> Array:
        """Return what the records show of additions to the signals of slots, (K,) each: all of it, one behind the other; less
        their mean where an offset was looked for at the slots and none could be seen."""
        whole = np.concatenate(added)
        offsets = {i for i, c in enumerate(self.candidates) if c.effect == "offset" and c.at == at}
        seen = {c.candidate for c, usable in zip(self.scores.columns, self.scores.usable, strict=True) if usable}
        return whole - np.mean(whole) if offsets and not offsets & seen else whole

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
