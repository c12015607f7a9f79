"""Candidates compared on a model: screened, and refitted in a race; and what a round of the search comes to.

In a race all refits run a little, and those that cannot catch up with the best are left where they are.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.hypothesis import FAILURES, Refit, RefitJob, RefitResult, failed_at, refit_job, refit_result
from hvdc_ident.discrepancy.misfit import misfit_of
from hvdc_ident.discrepancy.movable import Form, Movable
from hvdc_ident.discrepancy.nominal import thinned
from hvdc_ident.discrepancy.options import SearchContext
from hvdc_ident.discrepancy.pushes import Pushed, pushed
from hvdc_ident.discrepancy.score import CandidateFit, Pick, Ruler
from hvdc_ident.discrepancy.screen import NOT_TRIED, Score, Screen, ScreenSetup, distance, screened
from hvdc_ident.effects import effects
from hvdc_ident.executor import mapped
from hvdc_ident.fit import Problem
from hvdc_ident.model import is_white_box

REFITS_PER_BATCH = 6
"""Refits in one piece of work, of one model where they share it: a model takes longer to send than some steps of a refit."""


REFITS_PER_EFFECT = 8
"""Refits of one effect in a field, at least where so many come into question: places that cannot be distinguished are neighbours."""
PROMISING = 0.25
"""Share of the candidates that are run from other unknowns, the best by the answers that they had."""


@dataclass(frozen=True)
class Race:
    """Budget of the successive halving of refits.

    laps: evaluations of every refit that still runs, one lap after the other. reach, near: share of the best refit's fall of chi2
    that one has to come to for another lap, and to be run to its end. least: refits, the best, that run another lap anyway.
    """

    laps: tuple[int, ...] = (2, 5)
    reach: float = 0.4
    near: float = 0.7
    least: int = 12

    def run(
        self, search: SearchContext, before: Refit, jobs: Sequence[RefitJob], texts: Sequence[str], best: float = np.inf
    ) -> list[Refit]:
        """The jobs' refits: some evaluations each, and then those to their ends that are within reach of the best.

        before: the model without what they add. best: the least chi2 of refits done before. In the first lap an effect that may
        begin anywhere begins at rest.
        """
        first = [replace(j, evaluations=self.laps[0], judged=False, problem=_from_rest(j, before)) for j in jobs]
        refits = refits_of(search, first, texts)
        left = [j.evaluations - self.laps[0] for j in jobs]
        for lap in self.laps[1:]:
            running = self._within(self.reach, before.chi2, best, refits, least=self.least)
            refits = _on(search, jobs, refits, running, [min(lap, n) for n in left], texts)
            left = [n - lap if k in running else n for k, n in enumerate(left)]
        near = self._within(self.near, before.chi2, best, refits, least=0)
        ends = [f"{t}, to the end" for t in texts]
        refits = _on(search, jobs, refits, near, [max(n, 1) for n in left], ends, judged=True)
        return [r if r.rows or r.failure else replace(r, failure=LEFT_BEHIND) for r in refits]

    def _within(self, share: float, before: float, best: float, refits: Sequence[Refit], least: int) -> list[int]:
        """Those that come to this share of what the best gains, and the first `least` of all."""
        gained = [-np.inf if r.failure else before - r.chi2 for r in refits]
        leader = max([before - best, *gained], default=0.0)
        # Where none is better than nothing, all are still on their way.
        goal = share * leader if leader > 0.0 else -np.inf
        order = sorted((k for k, g in enumerate(gained) if g > -np.inf), key=lambda k: -gained[k])
        return [k for n, k in enumerate(order) if n < least or gained[k] >= goal]


def _from_rest(job: RefitJob, before: Refit) -> Problem:
    return replace(job.problem, free_initial_states=before.problem.free_initial_states)


LEFT_BEHIND = "left behind: others explain far more"
"""Why a refit was not carried to its end."""


def _on(
    search: SearchContext,
    jobs: Sequence[RefitJob],
    refits: Sequence[Refit],
    which: Sequence[int],
    evaluations: Sequence[int],
    texts: Sequence[str],
    *,
    judged: bool = False,
) -> list[Refit]:
    """The refits, some of them run on from where they are; one that fails stays there, unless it is to be judged."""
    again = [
        replace(jobs[k], begins=(refits[k].theta,), evaluations=evaluations[k], judged=judged)
        for k in which
        if judged or not refits[k].ended
    ]
    asked = [k for k in which if judged or not refits[k].ended]
    further = refits_of(search, again, [texts[k] for k in asked])
    better = {k: r for k, r in zip(asked, further, strict=True) if judged or not r.failure}
    return [better.get(k, r) for k, r in enumerate(refits)]


def refits_of(search: SearchContext, jobs: Sequence[RefitJob], texts: Sequence[str]) -> list[Refit]:
    """The jobs' refits, in their order, wherever they are done; once the budget is over none but the first are begun."""
    if jobs:
        search.tell(0, len(jobs), texts[0])
    batches: list[list[RefitJob]] = []
    for j in jobs:
        if batches and len(batches[-1]) < REFITS_PER_BATCH and batches[-1][-1].model is j.model:
            batches[-1].append(j)
        else:
            batches.append([j])
    outcomes = iter(mapped(search.executor, _all, batches))
    refits: list[Refit] = []
    for n, batch in enumerate(batches):
        if n and search.spent:
            rest = [j for b in batches[n:] for j in b]
            refits += [Refit(j.model, j.placed, j.problem, j.noise, j.begins[0], failure=NOT_TRIED) for j in rest]
            break
        refits += [found.refit(j) for found, j in zip(next(outcomes), batch, strict=True)]
        search.tell(len(refits), len(jobs), texts[len(refits) - 1])
    return refits


def _all(jobs: Sequence[RefitJob]) -> list[RefitResult]:
    return [refit_result(j) for j in jobs]


@dataclass(frozen=True, eq=False)
class FoundForm:
    """A form outside the catalogue, refitted. before: the model without it; gain: delta BIC over that. others: refits of other
    forms, or of the same elsewhere, that explain as much."""

    before: Refit
    refit: Refit
    gain: float
    others: tuple[Refit, ...] = ()


@dataclass(frozen=True, eq=False)
class Expansion:
    """What was looked for beside a hypothesis, `before`. winner: the trial that was kept, where one was.

    signals: at the model's slots, those of measured outputs included, one array an experiment, at its rows. trials: every refit,
    the best first. ruler: what BIC counts by. forms: the refits of forms outside the catalogue; None where none was looked for.
    led: by candidate the cost of the refit
    from whose gains others were looked for. promised: candidates that were run beside such gains because they promised most there.
    """

    before: Refit
    signals: Mapping[str, tuple[Array, ...]]
    candidates: tuple[CandidateEffect, ...]
    screen: Screen
    trials: tuple[CandidateFit, ...] = ()
    failed: tuple[CandidateFit, ...] = ()
    winner: CandidateFit | None = None
    ruler: Ruler | None = None
    forms: tuple[CandidateFit, ...] | None = None
    led: Mapping[int, float] = field(default_factory=dict)
    promised: frozenset[int] = frozenset()

    def answers(self) -> Mapping[str, Pushed]:
        """Return the model's runs with their answers to pushes, by experiment; none of a model that is closed inside."""
        return pushed(self.before, self.signals) if is_white_box(self.before.model) else {}


@dataclass(frozen=True, eq=False)
class ExpansionModel:
    """The model of a round, and what its candidates are compared on."""

    search: SearchContext
    before: Refit
    setup: ScreenSetup

    @classmethod
    def of(cls, search: SearchContext, before: Refit, found: Sequence[CandidateEffect], number: int) -> ExpansionModel:
        """Return what candidates are compared on, on a model; number: of the round, for its noise."""
        nominal = before.nominal()
        fewer = thinned(nominal)
        noise = fewer.projected(fewer.drawn(search.options.bootstraps, search.seed + number))
        places, sources = {p for c in found for p in c.at}, {s for c in found for s in c.sources}
        slots = before.model.insertion_points
        ends = tuple(p for p in slots if p in places), tuple(s for s in slots if s in sources)
        still = frozenset(c.at[0] for c in found if c.still and len(c.at) == 1)
        return cls(
            search,
            before,
            ScreenSetup(before.model, fewer, before.patience, before.method, *ends, before.theta, noise, still),
        )

    def screen(
        self,
        found: Sequence[CandidateEffect],
        text: str,
        which: Sequence[int] | None = None,
        point: Array | None = None,
        *,
        held: bool = False,
        known: Screen | None = None,
        few_sizes: bool = False,
    ) -> Screen:
        """Return the screen of candidates in their simplest forms.

        point: where they are looked at from, instead of the optimum; held: whether their sizes are as they are. known: a screen from the
        same point, whose candidates and sizes are not run again. few_sizes: whether each is run in two of its sizes alone.
        """
        asked = [k for k in (range(len(found)) if which is None else which) if not found[k].still]
        sizes = _few if few_sizes else _simplest
        columns = [(k, n) for k in asked for n in sizes(found[k]) if known is None or (k, n) not in known.answers]
        setup = replace(self.setup, held=True) if held else self.setup  # it keeps what it has worked out
        if point is not None:
            setup = replace(setup, point=point, noise=setup.noise[:, :0])
        tell = self.search.tell
        return screened(
            setup, found, executor=self.search.executor, tell=lambda n, of: tell(n, of, text), columns=columns,
            spent=lambda: self.search.spent,
        )  # fmt: skip

    def order(self, screen: Screen, found: Sequence[CandidateEffect], point: Array) -> list[int]:
        """Return the candidates by what they promise from other unknowns, by their answers in a screen (`Screen.reordered`)."""
        return screen.reordered(replace(self.setup, point=point).without, found)

    def promising(self, screen: Screen, found: Sequence[CandidateEffect], point: Array) -> list[int]:
        """Return the candidates that promise most from other unknowns: a share of all, and of each effect as many as are refitted."""
        return first_of(self.order(screen, found, point), found)

    def movable(self, candidate: CandidateEffect, probe: int) -> Movable | None:
        """Return the model with the candidate's effect to be moved; None where it is put in: at several places, or in a closed model."""
        model = self.setup.model
        if not is_white_box(model) or len(candidate.at) > 1:
            return None
        return self.setup.movable(Form.of(model, candidate, candidate.probes[probe].values))

    def refitted(
        self, found: Sequence[CandidateEffect], scores: Sequence[Score], text: str, earlier: Sequence[CandidateFit] = ()
    ) -> list[CandidateFit]:
        """Return the scores refitted, in a race with each other and with those refitted earlier; and their larger forms where none
        leaves noise: beside equations of one size that do, more sizes gain nothing but their price."""
        trials = self._raced(found, scores, text, earlier)
        if any(not t.refit.failure and not misfit_of(t.refit).is_loud for t in (*earlier, *trials)):
            return trials
        wider = {
            (t.pick.candidate, n): t
            for t in trials
            if t.refit.failure in ("", LEFT_BEHIND)
            for n in larger_forms(found[t.pick.candidate], t.pick.probe)
        }
        more = [Score(k, n, t.pick.fall, gains_of(self.before, t.refit)) for (k, n), t in wider.items()]
        return [*trials, *(self._raced(found, more, text, [*earlier, *trials]) if more else ())]

    def _raced(
        self, found: Sequence[CandidateEffect], scores: Sequence[Score], text: str, earlier: Sequence[CandidateFit]
    ) -> list[CandidateFit]:
        jobs: list[RefitJob] = []
        of: list[Pick] = []
        trials: list[CandidateFit] = []
        for s in sorted(scores, key=lambda s: (found[s.candidate].effect, s.candidate)):  # those of one model together
            pick = Pick(s.candidate, s.probe, s.factor, s.fall)
            c = found[s.candidate]
            try:
                jobs.append(refit_job(self.before, c, s.probe, s.factor, s.theta, self.movable(c, s.probe), s.ran))
                of.append(pick)
            except FAILURES as error:
                why = str(error) or type(error).__name__
                trials.append(CandidateFit(pick, failed_at(self.before, why), -np.inf))
        texts = [f"{text}: {found[p.candidate].label}" for p in of]
        least = min((t.refit.chi2 for t in earlier if not t.refit.failure), default=np.inf)
        refits = Race().run(self.search, self.before, jobs, texts, least)
        if sound := [r for r in refits if not r.failure]:
            best = min(sound, key=lambda r: r.chi2)
            self.search.lead(" and ".join(p.candidate.label for p in best.placed), math.sqrt(best.chi2 / best.rows))
        return [*trials, *(CandidateFit(p, refit, -np.inf) for p, refit in zip(of, refits, strict=True))]


def first_of(order: Sequence[int], found: Sequence[CandidateEffect]) -> list[int]:
    """Return of candidates in some order the first: a share of all, and of each effect as many as are refitted."""
    count: Counter[str] = Counter()
    kept = []
    for n, k in enumerate(order):
        count[found[k].effect] += 1
        if n < PROMISING * len(order) or count[found[k].effect] <= REFITS_PER_EFFECT:
            kept.append(k)
    return kept


def _simplest(candidate: CandidateEffect) -> list[int]:
    """Return the probes whose equations hold no other probe's: what a larger form does, its parts show."""
    forms = _forms(candidate)
    least = {f for f in set(forms) if not any(other < f for other in set(forms))}
    return [n for n, f in enumerate(forms) if f in least]


def _few(candidate: CandidateEffect) -> list[int]:
    """Return of each of the simplest equations of a candidate two probes: the one in the middle, and the one nearest to doing nothing.

    A large size in a loop may bend everything and tell nothing of a small one.
    """
    forms, by_form = _forms(candidate), dict[frozenset[str], list[int]]()
    for n in _simplest(candidate):
        by_form.setdefault(forms[n], []).append(n)
    both = ((own[len(own) // 2], min(own, key=lambda n: distance(candidate, n))) for own in by_form.values())
    return list(dict.fromkeys(n for pair in both for n in pair))


def larger_forms(candidate: CandidateEffect, probe: int) -> list[int]:
    """Return the probes in whose equations those of one probe are a part."""
    forms = _forms(candidate)
    return [n for n, f in enumerate(forms) if f > forms[probe]]


def _forms(candidate: CandidateEffect) -> list[frozenset[str]]:
    entry = effects()[candidate.effect]
    return [frozenset(entry.present(p.values)) for p in candidate.probes]


def gains_of(before: Refit, refit: Refit) -> Array:
    """Return the unknowns of the model before an effect was added, as the refit with it came to them."""
    k, whole = len(before.problem.free), len(refit.problem.free)
    return np.concatenate([refit.theta[:k], refit.theta[whole:]])


def with_candidate(expansion: Expansion, candidate: CandidateEffect) -> tuple[Expansion, int]:
    """Return the expansion with the candidate among its own, and where it stands there."""
    for k, c in enumerate(expansion.candidates):
        if c.label == candidate.label:
            return expansion, k
    return replace(expansion, candidates=(*expansion.candidates, candidate)), len(expansion.candidates)
