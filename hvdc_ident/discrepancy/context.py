"""Context of a search, which stays over its rounds, and the result of one round."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hvdc_ident.data import Array, Experiment
from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.evidence import CandidateFit, Ruler
from hvdc_ident.discrepancy.options import DiagnosisOptions
from hvdc_ident.discrepancy.pushes import Pushed, pushed
from hvdc_ident.discrepancy.refit import Refit, signal
from hvdc_ident.discrepancy.screen import Screen
from hvdc_ident.executor import Executor, Progress
from hvdc_ident.fit import FitParameter
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, insertion_point
from hvdc_ident.simulate import ModelSimulator, simulate

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
class Form:
    """A form outside the catalogue, refitted. before: the model without it; gain: delta BIC over that. others: refits of other
    forms, or of the same elsewhere, that explain as much."""

    before: Refit
    refit: Refit
    gain: float
    others: tuple[Refit, ...] = ()


@dataclass(frozen=True, eq=False)
class Round:
    """Result of one round. winner: the best trial, where one is good enough; why: what speaks against it otherwise.

    signals: at the model's slots, those of measured outputs included, one array an experiment, at its rows. trials: every refit,
    the best first. ruler: what BIC counts by. forms: the refits of forms outside the catalogue; None where none was looked for.
    form: the one that leaves next to nothing but noise, where no effect that was refitted does.
    """

    before: Refit
    signals: Mapping[str, tuple[Array, ...]]
    candidates: tuple[CandidateEffect, ...]
    screen: Screen
    trials: tuple[CandidateFit, ...] = ()
    failed: tuple[CandidateFit, ...] = ()
    winner: CandidateFit | None = None
    why: str = ""
    significant: bool = False
    ruler: Ruler | None = None
    forms: tuple[CandidateFit, ...] | None = None
    form: Form | None = None

    def answers(self) -> Mapping[str, Pushed]:
        """Return the model's runs with their answers to pushes, by experiment; none of a model that is closed inside."""
        return pushed(self.before, self.signals) if isinstance(self.before.model, Model) else {}


def slot_signals(before: Refit) -> dict[str, tuple[Array, ...]]:
    """The signal at every slot of the model that all experiments have, one array an experiment, at its rows.

    An instrument has slots of its own in the run of its experiment, which are none of the model's. Nothing is looked for
    inside the effects that are in the model already.
    """
    model, experiments = before.model, before.problem.fitted_experiments
    slots = [p for p in model.insertion_points if not any(one.use.made(p) for one in before.placed)]
    if not isinstance(model, Model):
        inputs = {p: tuple(signal(before, p).values()) for p in slots if p in model.inputs}
        outputs = [o for o in experiments[0].outputs if all(o in e.outputs for e in experiments)]
        runs = [simulate(model, e.with_(measured=None), before.values, outputs=outputs) for e in experiments]
        ends = {o if o not in model.inputs else f"outputs.{o}": o for o in outputs}
        return inputs | {p: tuple(np.asarray(r[o]) for r in runs) for p, o in ends.items() if p in slots}
    # Of outputs those that are recorded: an effect at another one is not seen.
    recorded = {o for e in experiments for o in e.outputs}
    kinds = {p: insertion_point(model, p) for p in slots}
    kept = [p for p in slots if kinds[p][0] != "output" or kinds[p][1] in recorded]
    names = list(dict.fromkeys(kinds[p][1] for p in kept))
    tolerance = before.problem.simulator.tolerance if isinstance(before.problem.simulator, ModelSimulator) else None
    found: dict[str, list[Array]] = {p: [] for p in kept}
    for e in experiments:
        run = simulate(model, e.with_(measured=None, instrument={}), before.values, outputs=names, tolerance=tolerance)
        for p in kept:
            found[p].append(np.asarray(run[kinds[p][1]]))
    return {p: tuple(own) for p, own in found.items()}
