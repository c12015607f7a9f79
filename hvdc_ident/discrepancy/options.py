"""Thresholds and budgets of a diagnosis, and what else stays over the rounds of its search."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from typing import Literal

from hvdc_ident.budget import Budget
from hvdc_ident.data import Experiment
from hvdc_ident.errors import StudyError
from hvdc_ident.executor import Executor, Progress
from hvdc_ident.fit import FitParameter
from hvdc_ident.immutable import FrozenMap

TOLERANCE = 0.01
"""Share of the squared gap, a tenth of its amplitude, that nobody asks about: no model leaves noise alone of real records."""
REFUTED = 0.1
"""Share of the squared gap that, left over and no noise, refutes the form of an effect: the form misses a third of the amplitude."""
CERTAIN = 0.95
"""Probability of an effect class from which it is named, and within which an error lies that is known to so much."""
SHORTLIST = 6
"""The best by a cheap measure (a score, a regression) that are tried in full: formulas, filters, places, earlier rivals."""
FIELD = 40
"""Proposals refitted at a time."""
BUDGET = 60.0
"""Seconds of a search for which no budget is given."""
LISTED = 3
"""Items that a sentence lists; of more it says how many there are."""
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
    starts: runs of the nominal multistart; None: 8, and more where only one of them came to the lowest cost.
    fallback: search for a form outside the catalogue.
    thorough: refit four times as many candidates of each effect, and, unless a budget is given, look until nothing is left to look for.
    budget: after which nothing further is looked for; in seconds one that begins with the diagnosis, of the processor's time, or with
    workers of the clock; None: `BUDGET`.

    Declared nuisances are estimated with the parameters; a start state is one where the card leaves it free.
    """

    significance: float = 0.01
    bootstraps: int = 200
    named_bic: float = 10.0
    set_bic: float = 6.0
    most: int = 3
    holdout_share: float = 0.1
    starts: int | None = None
    fallback: bool = True
    thorough: bool = False
    budget: float | Budget | None = None

    def __post_init__(self) -> None:
        if not (0 < self.significance < 1 and self.bootstraps * self.significance >= 1):
            raise StudyError(
                "the significance cannot be reached with so few bootstraps",
                where="options of a diagnosis",
                expected=f"at least {1 / self.significance:.0f} bootstraps",
                got=f"{self.bootstraps}",
            )
        if min(self.most, self.starts or 1) < 1:
            raise StudyError("a number of effects or starts is below 1", where="options of a diagnosis")

    def budget_from_now(self, executor: Executor | None) -> Budget | None:
        """Return the budget of a diagnosis that begins now; None: no limit."""
        if isinstance(self.budget, Budget) or (self.budget is None and self.thorough):
            return self.budget
        seconds = BUDGET if self.budget is None else self.budget
        return Budget.of(seconds, time.process_time if executor is None else time.monotonic)


@dataclass(eq=False)
class Course:
    """Progress of a search as people see it: the steps of the batch at work, with the best hypothesis so far.

    How many batches there will be depends on what they find, and is not known before the end.
    """

    progress: Progress
    best: str = ""
    left: float = math.inf

    def step(self, done: int, total: int, text: str) -> None:
        """Report that so many steps of a batch are done."""
        count = f", {done} of {total}" if total > 1 else ""
        best = f"; best so far: {self.best}, {self.left:.3g} times the noise is left" if self.best else ""
        self.progress(done, total, f"{text}{count}{best}")

    def lead(self, label: str, left: float) -> None:
        """Remember a hypothesis that leaves less than those before. left: root mean square of its residual, in noise units."""
        if left < self.left:
            self.best, self.left = label, left


@dataclass(frozen=True)
class SearchContext:
    """Settings of a search, which stay over its rounds.

    budget: after which it begins nothing further; None: no limit. held: candidates of the fit that the nominal
    model holds; stated: its other parameters, with bounds as near as they are known. records: the experiments, on their
    own clocks; none where it is not asked whether these are off. components: those of the model, by name, with their cards.
    """

    effects: tuple[str, ...] | Literal["all"]
    places: tuple[str | tuple[str, ...], ...] | None
    tolerance: FrozenMap[float]
    options: DiagnosisOptions
    seed: int
    executor: Executor | None = None
    course: Course | None = None
    budget: Budget | None = None
    held: tuple[FitParameter, ...] = ()
    stated: tuple[FitParameter, ...] = ()
    records: tuple[Experiment, ...] = ()
    components: FrozenMap[str] = field(default_factory=FrozenMap)

    def may_exchange(self, component: str) -> bool:
        """Return True where a component may be of another type: a search for some effects, or at other places, is for these alone."""
        slots = [p for g in self.places or () for p in ((g,) if isinstance(g, str) else g)]
        return self.effects == "all" and (self.places is None or any(p.startswith(f"{component}.") for p in slots))

    @property
    def spent(self) -> bool:
        """True once the budget is over."""
        return self.budget is not None and self.budget.spent

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

    def lead(self, label: str, left: float) -> None:
        """Report the best of the hypotheses that were just refitted. left: root mean square of its residual, in noise units."""
        if self.course:
            self.course.lead(label, left)
