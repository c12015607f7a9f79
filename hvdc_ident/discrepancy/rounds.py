"""One round of the search: score everything on the model as it stands, refit the best, judge the winner."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hvdc_ident.discrepancy.candidates import Candidate, candidates, kind_of
from hvdc_ident.discrepancy.options import Options
from hvdc_ident.discrepancy.race import raced
from hvdc_ident.discrepancy.refit import Job, Refit, added, held_out, moved, unseen
from hvdc_ident.discrepancy.scan import joined, scan
from hvdc_ident.discrepancy.scores import Path, Scores, runs, scored, signature_rows
from hvdc_ident.discrepancy.select import (
    Pick,
    Ruler,
    at_edge,
    best_of,
    clear,
    material_gap,
    neighbours,
    shortlist,
)
from hvdc_ident.discrepancy.signatures import Column
from hvdc_ident.discrepancy.tones import tones
from hvdc_ident.effects import effects
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.fit.estimate import Executor, Progress
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.trajectory import Array

LOOKED_AT = 80
"""Candidates, the best by score, whose signatures are compared with each other."""
AGREED = 10.0
"""By how much chi2 of the held-out data has to fall for them to agree."""
SILENT = 30.0
"""Squared difference of held-out answers, in noise units, below which those data cannot judge an effect."""
STEP = 0.05
"""Share of the gap that a second effect has to take away at least."""


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


@dataclass(frozen=True)
class Trial:
    """A candidate that was refitted: its pick, the refit, and what it gains over the model before (BIC)."""

    pick: Pick
    refit: Refit
    gain: float


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


def slot_signals(paths: Mapping[str, Path]) -> dict[str, tuple[Array, ...]]:
    """The signal at every slot that all experiments have, one array an experiment."""
    common = [p for p in next(iter(paths.values())).slots if all(p in a.slots for a in paths.values())]
    return {p: tuple(a.signal(p) for a in paths.values()) for p in common}


def one_round(search: Search, before: Refit, number: int) -> Round:
    """A round on the model as it stands. Raises SimulationError where that model cannot be run."""
    options, nominal = search.options, before.nominal()
    search.tell(0, 1, f"round {number}: the model's answers at every slot")
    paths = runs(before.model, nominal)
    found = candidates(
        before.model,
        slot_signals(paths),
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
    picks = best_of(scores, found)

    def nothing(why: str, significant: bool = False) -> Round:
        return Round(before, paths, found, scores, (), (), {}, None, why, significant, None)

    if not picks:
        return nothing("no candidate leaves a trace in these data")
    p = scores.p(picks[0].score)
    if p > options.significance:
        return nothing(f"the best score of all is what noise gives (p = {p:.2g})")
    return _refitted(search, before, number, paths, found, scores, picks)


def excess(refit: Refit) -> bool:
    """Whether a model leaves more than noise, by size."""
    rows = refit.rows * (1.0 - refit.correlation) / (1.0 + refit.correlation)
    return refit.chi2 / refit.rows > 1.0 + 3.0 * float(np.sqrt(2.0 / max(rows, 4.0)))


def _scanned(
    search: Search, before: Refit, number: int, paths: Mapping[str, Path], found: tuple[Candidate, ...], scores: Scores
) -> tuple[tuple[Candidate, ...], Scores, tuple[Pick, ...]]:
    """Candidates and scores with the sizes that a closer look found, and the picks to refit for them."""
    dense = candidates(
        before.model,
        slot_signals(paths),
        [a.time for a in paths.values()],
        search.effects,
        search.places,
        closer=True,
    )
    known = {(c.effect, c.at): k for k, c in enumerate(found)}
    dense = tuple(c for c in dense if (c.effect, c.at) in known and _worth_a_scan(before, c))
    if not dense:
        return found, scores, ()
    text = f"round {number}: a closer look at {', '.join(dict.fromkeys(c.effect for c in dense))}"
    seen = scan(before, dense, search.options.bootstraps, search.seed + number, search.executor, search.progress, text)
    found = joined(found, [s.candidate for s in seen.spots])
    at = [known[s.candidate.effect, s.candidate.at] for s in seen.spots]
    columns = tuple(Column(k, len(found[k].probes) - 1) for k in at)
    scores = scores.joined(replace(seen.scores, columns=columns, beside=seen.largest))
    picks = [Pick(c.candidate, c.probe, 1.0, s.score) for c, s in zip(columns, seen.spots, strict=True)]
    return found, scores, tuple(picks)


def _worth_a_scan(before: Refit, candidate: Candidate) -> bool:
    """Whether many sizes are run: at one slot that moves; not of levels at a state, which seldom come to rest."""
    if len(candidate.at) > 1 or candidate.still:
        return False
    memory = effects()[candidate.effect].states != "none"
    return memory or kind_of(before.model, candidate.at[0]) != "state"


def _refitted(
    search: Search,
    before: Refit,
    number: int,
    paths: Mapping[str, Path],
    found: tuple[Candidate, ...],
    scores: Scores,
    picks: tuple[Pick, ...],
) -> Round:
    options, nominal = search.options, before.nominal()
    threshold = scores.threshold(0.5)  # what noise reaches every other time is not worth a look
    looked = [p for p in picks[:LOOKED_AT] if p.score > threshold]
    rows = signature_rows(nominal, found, paths, [Column(p.candidate, p.probe) for p in looked])
    chosen, same = shortlist(looked, found, rows, options)
    trials = _trials(search, before, found, chosen, f"round {number}: refits")
    done = [t.pick.candidate for t in trials] + [p.candidate for twins in same.values() for p in twins]
    sound = sorted((t for t in trials if not t.refit.failure), key=lambda t: t.refit.chi2 + 8.0 * t.refit.count)
    best = [found[t.pick.candidate] for t in sound[:2]]
    more = neighbours(looked, found, done, best, max(options.refits // 3, 2))
    trials += _trials(search, before, found, more, f"round {number}: refits beside the best", trials)
    sound = [t for t in trials if not t.refit.failure]
    # Beside an effect that is there already a closer look costs more than it has been seen to find.
    if number == 1 and all(excess(t.refit) for t in sound):
        found, scores, extra = _scanned(search, before, number, paths, found, scores)
        trials += _trials(search, before, found, extra, f"round {number}: refits of the closer look")
        sound = [t for t in trials if not t.refit.failure]
    failed = tuple(t for t in trials if t.refit.failure)
    if not sound:
        return Round(
            before, paths, found, scores, (), failed, same, None, "no candidate could be refitted", True, None
        )  # fmt: skip
    least = min(sound, key=lambda t: t.refit.chi2)
    ruler = Ruler.of(least.refit)
    ranked = sorted((_gained(t, before, ruler) for t in sound), key=lambda t: -t.gain)
    why = ""
    for trial in ranked:
        if ranked[0].gain - trial.gain > options.set_bic:
            break
        against = objections(search, before, trial, scores, first=number == 1)
        if not against:
            return Round(before, paths, found, scores, tuple(ranked), failed, same, trial, "", True, ruler)
        why = why or f"{found[trial.pick.candidate].label}: {against}"
    return Round(before, paths, found, scores, tuple(ranked), failed, same, None, why, True, ruler)


def _gained(trial: Trial, before: Refit, ruler: Ruler) -> Trial:
    more = trial.refit.count - before.count
    return Trial(trial.pick, trial.refit, ruler.gain(before.chi2, trial.refit.chi2, more))


def _trials(
    search: Search,
    before: Refit,
    found: Sequence[Candidate],
    picks: Sequence[Pick],
    text: str,
    earlier: Sequence[Trial] = (),
) -> list[Trial]:
    """The picks refitted, in a race with each other and with those refitted earlier."""
    jobs, of, trials = [], [], []
    for p in picks:
        try:
            jobs.append(_job(before, found[p.candidate], p))
            of.append(p)
        except HvdcIdentError as error:
            none = Refit(before.model, before.placed, before.problem, before.noise, before.theta, failure=str(error))
            trials.append(Trial(p, none, -np.inf))
    texts = [f"{text}: {found[p.candidate].label}" for p in of]
    best = min((t.refit.chi2 for t in earlier if not t.refit.failure), default=np.inf)
    refits = raced(search, before.chi2, jobs, texts, best)
    return [*trials, *(Trial(p, refit, -np.inf) for p, refit in zip(of, refits, strict=True))]


def _job(before: Refit, candidate: Candidate, pick: Pick) -> Job:
    model, problem, placed, start = added(before.model, before.problem, candidate, pick.probe, pick.factor)
    k = len(before.problem.free)
    own = np.concatenate([before.theta[:k], start, before.theta[k:]])
    begins = [own]
    if abs(pick.factor) < 0.5 or abs(pick.factor) > 2.0:
        at = moved(candidate, pick.probe, float(np.sign(pick.factor)) or 1.0)
        plain = np.array([at[n] for n in placed.bounds])
        begins.append(np.concatenate([before.theta[:k], plain, before.theta[k:]]))
    return Job(model, (*before.placed, placed), problem, tuple(begins), before.noise)


def objections(search: Search, before: Refit, trial: Trial, scores: Scores, *, first: bool) -> str:
    """What speaks against naming a trial's effect; empty where nothing does."""
    options, refit = search.options, trial.refit
    last = len(refit.placed) - 1
    if scores.p(trial.pick.score) > options.significance:
        return f"its score is what noise gives somewhere (p = {scores.p(trial.pick.score):.2g})"
    if not trial.gain > options.named_bic:
        return f"it gains {trial.gain:.3g} in BIC, {options.named_bic:g} would be needed"
    if at_edge(refit, last) or not clear(refit, last):
        return "its size cannot be told from nothing"
    was, now = unseen(before), unseen(refit)
    if was is None or now is None:
        return "nothing can be left out to judge it by"
    if not now < was:
        return f"held-out data speak against it ({now:.4g} after {was:.4g}, in noise units)"
    tables = _tables(before, refit) if search.material else None
    # Held-out experiments that hardly excite the effect cannot show much of it: then they have to agree, or to have
    # nothing to say, and the fitted ones show the size.
    agree = (was**2 - now**2) * _unseen_rows(refit) > AGREED or _silent(before, refit)
    fitted = (float(np.sqrt(before.chi2 / refit.rows)), float(np.sqrt(refit.chi2 / refit.rows)))
    if not material_gap(was, now, options.holdout_share, search.material, tables) and not (
        agree and not search.material and material_gap(*fitted, options.holdout_share, None, None)
    ):
        return f"the gap it closes is immaterial ({was:.4g} to {now:.4g} in noise units, held out)"
    if not first and max((was - now) / was, (fitted[0] - fitted[1]) / fitted[0]) < STEP:
        return f"it closes less than {STEP:.0%} of what is left ({was:.4g} to {now:.4g} in noise units, held out)"
    return ""


def _unseen_rows(refit: Refit) -> int:
    """Rows of the data that judge: the held-out ones, or all of the fitted ones, each left out in turn."""
    held = [e for e in refit.problem.experiments if e.role == "holdout" and e.outputs]
    return sum(int(e.compared.sum()) * len(e.outputs) for e in held) or refit.rows


def _silent(before: Refit, after: Refit) -> bool:
    """Whether the held-out experiments would look the same with the effect and without."""
    one, two = (held_out(r.problem, r.theta) for r in (before, after))
    if not one or not two:
        return False
    return sum(float(np.sum((a.residual - b.residual) ** 2)) for a, b in zip(one, two, strict=True)) < SILENT


def _tables(before: Refit, after: Refit) -> tuple[Mapping[str, float], Mapping[str, float]]:
    return _worst(before), _worst(after)


def _worst(refit: Refit) -> dict[str, float]:
    """The largest RMSE of each output over all experiments, in its unit."""
    found: dict[str, float] = {}
    for output, row in refit.problem.rmse(refit.theta).items():
        known = [v for v in row.values() if v is not None]
        if known:
            found[output] = max(known)
    return found
