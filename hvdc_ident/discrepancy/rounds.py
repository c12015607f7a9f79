"""One round of the search: score everything on the model as it stands, refit the best, judge the winner."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hvdc_ident.discrepancy.candidates import Candidate, candidates, kind_of
from hvdc_ident.discrepancy.hops import hop
from hvdc_ident.discrepancy.jobs import as_given, job
from hvdc_ident.discrepancy.nominal import Nominal
from hvdc_ident.discrepancy.objections import evidence, objections, unseen_rows
from hvdc_ident.discrepancy.options import Options
from hvdc_ident.discrepancy.race import Race, done
from hvdc_ident.discrepancy.refit import Job, Placed, Refit, unseen
from hvdc_ident.discrepancy.response import Along
from hvdc_ident.discrepancy.scan import View, bent, joined, scan, widened
from hvdc_ident.discrepancy.scores import Path, Scores, runs, scored, signature_rows
from hvdc_ident.discrepancy.select import Pick, Ruler, Trial, behinds, best_of, neighbours, others, shortlist
from hvdc_ident.discrepancy.signatures import Column
from hvdc_ident.discrepancy.tones import tones
from hvdc_ident.effects import effects
from hvdc_ident.errors import HvdcIdentError, SimulationError
from hvdc_ident.fit.executor import Executor, Progress
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.model.definition import Model
from hvdc_ident.trajectory import Array

LOOKED_AT = 80
"""Candidates, the best by score, whose signatures are compared with each other."""
WIDER = 80
"""Candidates at most that are refitted besides, where none of those picked first comes near the noise."""
RACE = Race()
HEAT = Race(sprint=5, reach=0.4)
"""Of those many a short sprint."""
ELSEWHERE = 40
"""Other places at most at which the best effects are refitted."""
ALIKE = 0.9
"""Share of the best fall of chi2 from which a refit is tried in the effect's other forms."""
FORMS = 16
"""Of these refits at most."""
LEADERS = 4
"""Of the refits the best, whose places other kinds of delay are tried at."""
STARTS = 2
"""Sizes that another kind of delay is begun at."""
PRICE = 8.0
"""Of a parameter, in units of chi2: the logarithm of a few thousand rows."""
LIKE = 0.3
"""Of a logarithm: up to where two delays are alike."""
REFIT_SCORE = 0.5
"""What of a refit's fall of chi2 counts as a score where there is no other: a refit moves more than a score does."""
NEAR = 0.05
"""Share of what the model before leaves beyond noise that a good candidate may leave too: its noise is not known better."""
CLOSE = 0.01
"""The same where a closer look is to be saved."""
AGAIN = 4
"""Refits of one effect at most whose size is looked for again beside the gains they came to."""


@dataclass(frozen=True)
class Search:
    """What stays the same over the rounds."""

    effects: tuple[str, ...] | Literal["all"]
    places: tuple[str | tuple[str, ...], ...] | None
    material: FrozenMap[float]
    options: Options
    seed: int
    executor: Executor | None = None
    progress: Progress | None = None

    def tries(self, effect: str) -> bool:
        """Whether an effect is among those looked for."""
        return self.effects == "all" or effect in self.effects

    def tell(self, done: int, total: int, text: str) -> None:
        """Nothing; whoever watches is told."""
        if self.progress:
            self.progress(done, total, text)


@dataclass(frozen=True, eq=False)
class Round:
    """What one round found. winner: the best trial, where one is good enough; why: what speaks against it otherwise.

    trials: every refit, the best first. same: by candidate, others with the same signature. ruler: what BIC counts by.
    """

    before: Refit
    paths: Mapping[str, Path]
    candidates: tuple[Candidate, ...]
    scores: Scores
    trials: tuple[Trial, ...]
    failed: tuple[Trial, ...]
    same: Mapping[int, list[Pick]]
    winner: Trial | None
    why: str
    significant: bool
    ruler: Ruler | None

    def score_p(self, candidate: int) -> tuple[float, float, int]:
        """The best score of a candidate, its p, and the column it stands in (-1: none)."""
        t = self.scores.t
        own = [k for k, c in enumerate(self.scores.columns) if c.candidate == candidate]
        if not own:
            return 0.0, 1.0, -1
        k = max(own, key=lambda j: t[j])
        return float(t[k]), self.scores.p(float(t[k])), k


def slot_signals(paths: Mapping[str, Path], placed: Sequence[Placed] = ()) -> dict[str, tuple[Array, ...]]:
    """The signal at every slot that all experiments have, one array an experiment.

    placed: effects that are in the model already; nothing is looked for inside them.
    """
    common = [p for p in next(iter(paths.values())).slots if all(p in a.slots for a in paths.values())]
    outer = [p for p in common if not any(one.use.made(p) for one in placed)]
    return {p: tuple(a.signal(p) for a in paths.values()) for p in outer}


def one_round(search: Search, before: Refit, number: int) -> Round:
    """A round on the model as it stands. Raises SimulationError where that model cannot be run."""
    options, nominal = search.options, before.nominal()
    search.tell(0, 1, f"round {number}: the model's answers at every slot")
    paths = runs(before.model, nominal)
    found = candidates(
        before.model,
        slot_signals(paths, before.placed),
        [a.time for a in paths.values()],
        search.effects,
        search.places,
        tones(nominal),
    )
    there = {(p.candidate.effect, p.candidate.at, p.candidate.source) for p in before.placed}
    found = tuple(c for c in found if (c.effect, c.at, c.source) not in there and c.probes)
    search.tell(0, 1, f"round {number}: scores of {len(found)} candidates")
    scores = scored(
        nominal, found, paths, bootstraps=options.bootstraps, seed=search.seed + number,
        executor=search.executor,
    )  # fmt: skip
    opened = Round(before, paths, found, scores, (), (), {}, None, "", False, None)
    picks = best_of(scores, found)
    if not picks:
        return replace(opened, why="no candidate leaves a trace in these data")
    p = scores.p(picks[0].score)
    if p > options.significance:
        nothing = replace(opened, why=f"the best score of all is what noise gives (p = {p:.2g})")
        return _met(search, nothing, nominal) if number == 1 and excess(before) else nothing
    return _refitted(search, replace(opened, significant=True), nominal, number, picks)


def _met(search: Search, opened: Round, nominal: Nominal) -> Round:
    """The round after a closer look alone, where nothing else has a score though more than noise is left."""
    text = "round 1: refits of the closer look"
    seen, picks = _scanned(search, opened, nominal, 1)
    if not picks or seen.scores.p(max(p.score for p in picks)) > search.options.significance:
        return opened
    trials = _trials(search, seen, picks, text)
    if _far(opened.before, trials):
        trials = _again(search, seen.candidates, trials, "round 1: once more")
    return closed(search, replace(seen, significant=True, why=""), trials, 1)


def excess(refit: Refit) -> bool:
    """Whether a model leaves more than noise, by size."""
    return refit.chi2 / refit.rows > 1.0 + 3.0 * float(np.sqrt(2.0 / refit.effective))


def _scanned(
    search: Search, opened: Round, nominal: Nominal, number: int, wanted: Callable[[Candidate], bool] = lambda _: True
) -> tuple[Round, tuple[Pick, ...]]:
    """The round with the sizes that a closer look found, and the picks to refit for them. wanted: what is looked at."""
    before, found, options = opened.before, opened.candidates, search.options
    dense = candidates(
        before.model,
        slot_signals(opened.paths, before.placed),
        [a.time for a in opened.paths.values()],
        search.effects,
        search.places,
        closer=True,
    )
    known = {(c.effect, c.at): k for k, c in enumerate(found)}
    dense = tuple(c for c in dense if (c.effect, c.at) in known and _worth_a_scan(before, c))
    if all(isinstance(p, Along) for p in opened.paths.values()):
        dense += tuple(widened(c) for c in found if not c.still and bent(c))
    dense = tuple(c for c in dense if wanted(c))
    if not dense:
        return opened, ()
    text = f"round {number}: a closer look at {', '.join(dict.fromkeys(c.effect for c in dense))}"
    seen = scan(
        before,
        _views(before, nominal, opened.paths),
        dense,
        options.bootstraps,
        search.seed + number,
        search.executor,
        search.progress,
        text,
    )
    found = joined(found, [s.candidate for s in seen.spots])
    at = [known[s.candidate.effect, s.candidate.at] for s in seen.spots]
    columns = tuple(Column(k, len(found[k].probes) - 1) for k in at)
    scores = opened.scores.joined(replace(seen.scores, columns=columns, beside=seen.largest))
    picks = [
        Pick(c.candidate, c.probe, 1.0, s.score, tuple(s.theta.tolist()))
        for c, s in zip(columns, seen.spots, strict=True)
    ]
    return replace(opened, candidates=found, scores=scores), tuple(picks)


def _views(before: Refit, nominal: Nominal, paths: Mapping[str, Path]) -> list[View]:
    """The model at its optimum, and with the gains as they were given, where one has moved so far that it may stand for what
    is missing: a loop with such gains answers otherwise."""
    views, given = [View(nominal, paths)], as_given(before)
    if given is not None and isinstance(before.model, Model):
        there = replace(nominal, theta=given)
        with suppress(SimulationError):  # with the gains as given it need not run
            views.append(View(there, runs(before.model, there)))
    return views


def _worth_a_scan(before: Refit, candidate: Candidate) -> bool:
    """Whether many sizes are run: at one slot that moves; not of levels at a state, which seldom come to rest."""
    if len(candidate.at) > 1 or candidate.still:
        return False
    memory = effects()[candidate.effect].states != "none"
    return memory or kind_of(before.model, candidate.at[0]) != "state"


def _refitted(search: Search, opened: Round, nominal: Nominal, number: int, picks: tuple[Pick, ...]) -> Round:
    options, before, found, scores = search.options, opened.before, opened.candidates, opened.scores
    threshold = scores.threshold(0.5)  # what noise reaches every other time is not worth a look
    looked = [p for p in picks[:LOOKED_AT] if p.score > threshold]
    rows = signature_rows(nominal, found, opened.paths, [Column(p.candidate, p.probe) for p in looked])
    chosen, same = shortlist(looked, found, rows, options)
    opened = replace(opened, same=same)
    trials = _trials(search, opened, chosen, f"round {number}: refits")
    tried = [t.pick.candidate for t in trials] + [p.candidate for twins in same.values() for p in twins]
    sound = _sound(trials)
    best = [found[t.pick.candidate] for t in sound[:2]]
    more = neighbours(looked, found, tried, best, max(options.refits // 3, 2))
    trials += _trials(search, opened, more, f"round {number}: refits beside the best", trials)
    trials += _elsewhere(search, opened, picks, trials, number)
    forms = _other_forms(opened, trials, before.chi2)
    trials = _best_each([*trials, *_trials(search, opened, forms, f"round {number}: in another form", trials, HEAT)])
    kin = _as_late(opened, trials)
    trials = _begun(search, opened, trials, kin, number)
    # Beside an effect that is there already a closer look costs more than it has been seen to find.
    if number == 1:
        far = _far(before, trials, CLOSE)
        opened, extra = _scanned(search, opened, nominal, number, lambda c: far or _akin(c, opened, trials))
        closer = _trials(search, opened, extra, f"round {number}: refits of the closer look", trials)
        trials = _best_each([*trials, *closer])
    if number == 1 and _far(before, trials):
        trials = _again(search, opened.candidates, trials, f"round {number}: once more")
    if number == 1 and _far(before, trials):
        tried += [t.pick.candidate for t in trials]
        wide = others(picks, scores, found, tried, WIDER)
        trials += _trials(search, opened, wide, f"round {number}: the other candidates", trials, HEAT)
        trials = _begun(search, opened, trials, [p for p in _as_late(opened, trials) if p not in kin], number)
    return closed(search, opened, trials, number)


def _other_forms(opened: Round, trials: Sequence[Trial], was: float) -> list[Pick]:
    """The best candidates with other parts of the effect, where it is made of optional ones: a score is that of one of them.

    was: chi2 of the model before. A loss in proportion to a current is no better told from its square by the gains as they
    are than other sizes are.
    """
    found, scores = opened.candidates, opened.scores
    sound = _sound(trials)
    most = was - min((t.refit.chi2 for t in sound), default=was)
    good = [t for t in sound if was - t.refit.chi2 > ALIKE * most]
    picks: list[Pick] = []
    for k in dict.fromkeys(t.pick.candidate for t in good):
        done_here = {frozenset(found[k].probes[t.pick.probe].free) for t in trials if t.pick.candidate == k}
        columns = [(float(scores.t[n]), n, c.probe) for n, c in enumerate(scores.columns) if c.candidate == k]
        for score, n, probe in sorted(columns, reverse=True):
            form = frozenset(found[k].probes[probe].free)
            if score > 0 and form not in done_here:
                done_here.add(form)
                picks.append(Pick(k, probe, float(scores.expected[n]), score))
    return picks[:FORMS]


def _akin(candidate: Candidate, opened: Round, trials: Sequence[Trial]) -> bool:
    """Whether a candidate is worth a closer look because of what is best so far: the same at any place, where its size has
    to be met; a bend at any place, where something bends its signal; a sampler where something delays it."""
    leading = [opened.candidates[t.pick.candidate] for t in _sound(trials)[:LEADERS]]
    if effects()[candidate.effect].scanned and leading and leading[0].effect == candidate.effect:
        return True
    if effects()[candidate.effect].late is not None:
        return any(effects()[c.effect].late is not None and c.at == candidate.at for c in leading)
    return any(bent(c) for c in leading) and not effects()[candidate.effect].scanned


def _as_late(opened: Round, trials: Sequence[Trial]) -> list[Pick]:
    """The other kinds of delay at the best places of one, to be begun where they delay a slow signal by as much.

    A score is had at few sizes, and from a wrong one no slope leads to the right one: a window to another of its zeros.
    """
    found = opened.candidates
    sound = _sound(trials)
    goals: dict[tuple[str, ...], float] = {}
    for t in sound[:LEADERS]:
        late = _late(t)
        if late and late > 0.0:
            goals.setdefault(found[t.pick.candidate].at, late)
    done_here = {t.pick.candidate: late for t in sound if (late := _late(t)) and late > 0.0}
    picks = []
    for k, c in enumerate(found):
        late_of, goal = effects()[c.effect].late, goals.get(c.at)
        if late_of is None or goal is None or (k in done_here and _apart(done_here[k], goal) < LIKE):
            continue
        lates = {n: late_of(p.values) for n, p in enumerate(c.probes)}
        nearest = sorted((n for n in lates if lates[n] > 0.0), key=lambda n: _apart(lates[n], goal))
        picks += [Pick(k, n, goal / lates[n], opened.score_p(k)[0]) for n in nearest[:STARTS]]
    return picks


def _begun(search: Search, opened: Round, trials: Sequence[Trial], picks: Sequence[Pick], number: int) -> list[Trial]:
    """The trials with those picks, of each candidate the best.

    A period that has to be met is looked for where there is something left for it to explain.
    """
    text = f"round {number}: as late as the best"
    begun = _trials(search, opened, picks, text, trials)
    sound = _sound(trials)
    if sound and (excess(sound[0].refit) or _misses(sound[0].refit)):
        begun = _again(search, opened.candidates, begun, text, most=1)
    return _best_each([*trials, *begun])


def _sound(trials: Sequence[Trial]) -> list[Trial]:
    """Those that came to a result, the best first."""
    return sorted((t for t in trials if not t.refit.failure), key=_cost)


def _apart(a: float, b: float) -> float:
    """How far two times are from each other, as a logarithm."""
    return abs(math.log(a / b))


def _late(trial: Trial) -> float | None:
    """By how long the effect that a trial added delays a slow signal, s; None for what is no kind of delay."""
    placed = trial.refit.placed[-1]
    return effects()[placed.candidate.effect].late_by(trial.refit.sizes(placed))


def _best_each(trials: Sequence[Trial]) -> list[Trial]:
    """Of the trials of each candidate the best, in their order."""
    kept: dict[int, Trial] = {}
    for t in trials:
        had = kept.get(t.pick.candidate)
        if had is None or had.refit.failure or (not t.refit.failure and _cost(t) < _cost(had)):
            kept[t.pick.candidate] = t
    return list(kept.values())


def _cost(trial: Trial) -> float:
    """What a refit leaves of all data, and what its parameters cost, before it is known what BIC counts by."""
    refit, held = trial.refit, unseen(trial.refit)
    return refit.chi2 + PRICE * refit.count + (held**2 * unseen_rows(refit) if held is not None else 0.0)


def _elsewhere(
    search: Search, opened: Round, picks: Sequence[Pick], trials: Sequence[Trial], number: int
) -> list[Trial]:
    """Refits of the best effects at every other place where they score more than noise: the places that cannot be told from
    theirs are to be had by no other way, for a score is that of one size and of gains that are biased."""
    found = opened.candidates
    sound = _sound(trials)
    if not sound:
        return []
    margin = 2.0 * search.options.set_bic
    least, cost = min(t.refit.chi2 for t in sound) + margin, _cost(sound[0]) + margin
    leading = {found[t.pick.candidate].effect for t in sound if t.refit.chi2 < least or _cost(t) < cost}
    twins = {
        p.candidate for k, same in opened.same.items() for p in same if found[p.candidate].source == found[k].source
    }
    tried = {t.pick.candidate for t in trials} | twins
    threshold = opened.scores.threshold(search.options.significance)
    left = [
        p for p in picks if found[p.candidate].effect in leading and p.candidate not in tried and p.score > threshold
    ]
    return _trials(
        search, opened, left[:ELSEWHERE], f"round {number}: {', '.join(sorted(leading))} elsewhere", trials, HEAT
    )


def _far(before: Refit, trials: Sequence[Trial], near: float = NEAR) -> bool:
    """Whether no refit comes near the noise, on the fitted data and on the others, or near enough: to a share of what was."""
    was = _left(before)
    return all(
        (excess(t.refit) or _misses(t.refit)) and _left(t.refit) > near * was for t in trials if not t.refit.failure
    )


def _misses(refit: Refit) -> bool:
    """Whether a model leaves more of data it has not seen than of those it was fitted to, by more than chance."""
    seen, now = max(refit.chi2 / refit.rows, 1.0), unseen(refit)
    return now is not None and now**2 > seen * (1.0 + 3.0 * float(np.sqrt(2.0 / refit.effective)))


def _left(refit: Refit) -> float:
    """What a model leaves beyond noise, a row, of the fitted data or of the others."""
    return max(refit.chi2 / refit.rows, (unseen(refit) or 0.0) ** 2) - 1.0


def closed(search: Search, opened: Round, trials: Sequence[Trial], number: int) -> Round:
    """The round with its refits ranked and its winner, or what speaks against the best.

    Ranked by what the fitted and the held-out data say together.
    """
    before, found = opened.before, opened.candidates
    sound, failed = [t for t in trials if not t.refit.failure], tuple(t for t in trials if t.refit.failure)
    if not sound:
        return replace(opened, failed=failed, why="no candidate could be refitted")
    ruler = Ruler.of(min(sound, key=lambda t: t.refit.chi2).refit)
    ranked = sorted((gained(t, before, ruler) for t in sound), key=lambda t: -t.told)
    level = [t for t, behind in zip(ranked, behinds(ranked), strict=True) if behind <= search.options.set_bic]
    refused = {id(t): against(search, before, t, opened.scores, first=number == 1) for t in level}
    winner = next((t for t in level if not refused[id(t)]), None)
    why = "" if winner else f"{found[level[0].pick.candidate].label}: {refused[id(level[0])]}"
    return replace(opened, trials=tuple(ranked), failed=failed, winner=winner, why=why, ruler=ruler)


def gained(trial: Trial, before: Refit, ruler: Ruler) -> Trial:
    """The trial with what it gains in BIC over the model before, and what the held-out data add to that."""
    more = trial.refit.count - before.count
    own = Trial(trial.pick, trial.refit, ruler.gain(before.chi2, trial.refit.chi2, more))
    return replace(own, evidence=evidence(before, own, ruler.effective / ruler.rows / ruler.scale))


def against(search: Search, before: Refit, trial: Trial, scores: Scores, *, first: bool) -> str:
    """What speaks against naming a trial's effect; empty where nothing does."""
    # A candidate whose answer no expansion gave was scored by its refit.
    score = trial.pick.score or REFIT_SCORE * (before.chi2 - trial.refit.chi2)
    return objections(before, trial, scores.p(score), search.options, search.material, first=first)


def _again(
    search: Search, found: Sequence[Candidate], trials: Sequence[Trial], text: str, most: int = AGAIN
) -> list[Trial]:
    """The trials, with another size where one is found beside the gains that a refit came to."""
    chosen: dict[str, list[Trial]] = {}
    for t in sorted(trials, key=lambda t: t.refit.chi2):
        effect = found[t.pick.candidate].effect
        if effects()[effect].scanned and not t.refit.failure and len(chosen.setdefault(effect, [])) < most:
            chosen[effect].append(t)
    again = [t for group in chosen.values() for t in group]
    jobs = [Job(t.refit.model, t.refit.placed, t.refit.problem, (t.refit.theta,), t.refit.noise) for t in again]
    refits = done(search, jobs, [f"{text}: {found[t.pick.candidate].label}" for t in again], hop)
    better = {id(t): replace(t, refit=r) for t, r in zip(again, refits, strict=True) if not r.failure}
    return [better.get(id(t), t) for t in trials]


def _trials(
    search: Search, opened: Round, picks: Sequence[Pick], text: str, earlier: Sequence[Trial] = (), race: Race = RACE
) -> list[Trial]:
    """The picks refitted, in a race with each other and with those refitted earlier."""
    before, found = opened.before, opened.candidates
    jobs, of, trials = [], [], []
    for p in picks:
        try:
            jobs.append(job(before, found, [p]))
            of.append(p)
        except HvdcIdentError as error:
            none = Refit(before.model, before.placed, before.problem, before.noise, before.theta, failure=str(error))
            trials.append(Trial(p, none, -np.inf))
    texts = [f"{text}: {found[p.candidate].label}" for p in of]
    best = min((t.refit.chi2 for t in earlier if not t.refit.failure), default=np.inf)
    refits = race.run(search, before.chi2, jobs, texts, best)
    return [*trials, *(Trial(p, refit, -np.inf) for p, refit in zip(of, refits, strict=True))]
