"""Candidates compared on a model: screened, and refitted in a race; and what a round of the search comes to.

In a race all refits run a little, and those that cannot catch up with the best are left where they are.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.candidates import CandidateEffect, source_signals
from hvdc_ident.discrepancy.hypothesis import FAILURES, Refit, RefitJob, RefitResult, failed_at, refit_job, refit_result
from hvdc_ident.discrepancy.misfit import misfit_of
from hvdc_ident.discrepancy.movable import Form, Movable
from hvdc_ident.discrepancy.nominal import thinned
from hvdc_ident.discrepancy.options import SearchContext
from hvdc_ident.discrepancy.pushes import Pushed, pushed
from hvdc_ident.discrepancy.score import P_EFFECT, TIED, off_given
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
class Trial:
    """A refit of a candidate, and the score that it began at."""

    score: Score
    refit: Refit


@dataclass(frozen=True, eq=False)
class Expansion:
    """Candidates beside a hypothesis, `before`: their screen, and the refits of some.

    signals: at the model's slots, those of measured outputs included, one array an experiment, at its rows. trials: of each candidate
    that was refitted the best refit, failed ones too. led: by candidate the cost of the refit from whose gains others were looked for.
    promised: candidates that were run beside such gains because they promised most there.
    """

    before: Refit
    signals: Mapping[str, tuple[Array, ...]]
    candidates: tuple[CandidateEffect, ...]
    screen: Screen
    trials: tuple[Trial, ...] = ()
    led: Mapping[int, float] = field(default_factory=dict)
    promised: frozenset[int] = frozenset()

    def answers(self) -> Mapping[str, Pushed]:
        """Return the model's runs with their answers to pushes, by experiment; none of a model that is closed inside."""
        return pushed(self.before, self.signals) if is_white_box(self.before.model) else {}

    @cached_property
    def _sources(self) -> tuple[str, ...]:
        return source_signals(self.before.model, self.signals)

    @cached_property
    def _counts(self) -> Counter[str]:
        return Counter(c.effect for c in self.candidates)

    def prior(self, effect: str) -> float:
        """Return the probability of an effect at one of its places and sources, before any data: every effect is as likely as another, and
        shares that with all its candidates; a form outside the catalogue with all places, and with all signals where it brings one in."""
        many = self._counts
        sources = len(self._sources) if effects()[effect].needs_source else 1
        return P_EFFECT / max(len(many), 1) / (many[effect] or len(self.signals) * max(sources, 1))

    def with_trials(self, more: Sequence[Trial]) -> Expansion:
        """Return the expansion with further trials, of each candidate the best."""
        return replace(self, trials=tuple(best_each([*self.trials, *more])))


def best_each(trials: Sequence[Trial]) -> list[Trial]:
    """Of the trials of each candidate the best, in their order; of those that are as good the one with the values nearest to the
    given ones."""
    kept: dict[int, Trial] = {}
    for t in trials:
        had = kept.get(t.score.candidate)
        if had is None or had.refit.failure:
            kept[t.score.candidate] = t
        elif not t.refit.failure:
            first, other = sorted((had, t), key=cost_of)
            tied = cost_of(other) - cost_of(first) <= TIED and off_given(other.refit) < off_given(first.refit)
            kept[t.score.candidate] = other if tied else first
    return list(kept.values())


def by_cost(trials: Sequence[Trial]) -> list[Trial]:
    """Those that came to a result, the best first."""
    return sorted((t for t in trials if not t.refit.failure), key=cost_of)


def cost_of(trial: Trial) -> float:
    """Chi2 of a refit on all data plus the price of its parameters, before the scale of BIC is known."""
    refit, held = trial.refit, trial.refit.predicted
    price = refit.count * math.log(max(refit.effective, 1.0))
    return refit.chi2 + price + (held**2 * refit.unseen_rows if held is not None else 0.0)


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
        self, found: Sequence[CandidateEffect], scores: Sequence[Score], text: str, earlier: Sequence[Trial] = ()
    ) -> list[Trial]:
        """Return the scores refitted, in a race with each other and with those refitted earlier; and their larger forms where none
        leaves noise: beside equations of one size that do, more sizes gain nothing but their price."""
        trials = self._raced(found, scores, text, earlier)
        if any(not t.refit.failure and not misfit_of(t.refit).is_loud for t in (*earlier, *trials)):
            return trials
        wider = {
            (t.score.candidate, n): t
            for t in trials
            if t.refit.failure in ("", LEFT_BEHIND)
            for n in larger_forms(found[t.score.candidate], t.score.probe)
        }
        more = [Score(k, n, t.score.fall, gains_of(self.before, t.refit)) for (k, n), t in wider.items()]
        return [*trials, *(self._raced(found, more, text, [*earlier, *trials]) if more else ())]

    def _raced(
        self, found: Sequence[CandidateEffect], scores: Sequence[Score], text: str, earlier: Sequence[Trial]
    ) -> list[Trial]:
        jobs: list[RefitJob] = []
        of: list[Score] = []
        trials: list[Trial] = []
        for s in sorted(scores, key=lambda s: (found[s.candidate].effect, s.candidate)):  # those of one model together
            c = found[s.candidate]
            try:
                jobs.append(refit_job(self.before, c, s.probe, s.factor, s.theta, self.movable(c, s.probe), s.ran))
                of.append(s)
            except FAILURES as error:
                why = str(error) or type(error).__name__
                trials.append(Trial(s, failed_at(self.before, why)))
        texts = [f"{text}: {found[s.candidate].label}" for s in of]
        least = min((t.refit.chi2 for t in earlier if not t.refit.failure), default=np.inf)
        refits = Race().run(self.search, self.before, jobs, texts, least)
        if sound := [r for r in refits if not r.failure]:
            best = min(sound, key=lambda r: r.chi2)
            self.search.lead(" and ".join(p.candidate.label for p in best.placed), math.sqrt(best.chi2 / best.rows))
        return [*trials, *(Trial(s, refit) for s, refit in zip(of, refits, strict=True))]


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
