"""Candidates compared on a model: screened, and refitted in a race."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.context import SearchContext
from hvdc_ident.discrepancy.evidence import CandidateFit, Pick
from hvdc_ident.discrepancy.movable import Form, Movable, present_in
from hvdc_ident.discrepancy.nominal import thinned
from hvdc_ident.discrepancy.race import Race
from hvdc_ident.discrepancy.refit import FAILURES, Refit, RefitJob, failed_at
from hvdc_ident.discrepancy.refit_jobs import job
from hvdc_ident.discrepancy.screen import Bench, Screen, Shot, screened
from hvdc_ident.effects import effects
from hvdc_ident.model import Model


@dataclass(frozen=True, eq=False)
class Stand:
    """The model of a round, and what its candidates are compared on."""

    search: SearchContext
    before: Refit
    bench: Bench

    @classmethod
    def of(cls, search: SearchContext, before: Refit, found: Sequence[CandidateEffect], number: int) -> Stand:
        """Return the stand for some candidates on a model; number: of the round, for its noise."""
        nominal = before.nominal()
        fewer = thinned(nominal)
        noise = fewer.projected(fewer.drawn(search.options.bootstraps, search.seed + number))
        places, sources = {p for c in found for p in c.at}, {s for c in found for s in c.sources}
        slots = before.model.insertion_points
        ends = tuple(p for p in slots if p in places), tuple(s for s in slots if s in sources)
        still = frozenset(c.at[0] for c in found if c.still and len(c.at) == 1)
        return cls(search, before, Bench(before.model, fewer, *ends, before.theta, noise, still))

    def screen(
        self,
        found: Sequence[CandidateEffect],
        text: str,
        which: Sequence[int] | None = None,
        point: Array | None = None,
        *,
        held: bool = False,
    ) -> Screen:
        """Return the screen of candidates in their simplest forms.

        point: where they are looked at from, instead of the optimum; held: whether their sizes are as they are.
        """
        asked = [k for k in (range(len(found)) if which is None else which) if not found[k].still]
        columns = [(k, n) for k in asked for n in _simplest(found[k])]
        bench = replace(self.bench, held=True) if held else self.bench  # it keeps what it has worked out
        if point is not None:
            bench = replace(bench, point=point, noise=bench.noise[:, :0])
        tell = self.search.tell
        return screened(
            bench, found, executor=self.search.executor, tell=lambda n, of: tell(n, of, text), columns=columns
        )

    def movable(self, candidate: CandidateEffect, probe: int) -> Movable | None:
        """Return the model with the candidate's effect to be moved; None where it is put in: at several places, or in a closed model."""
        model = self.bench.model
        if not isinstance(model, Model) or len(candidate.at) > 1:
            return None
        return self.bench.movable(Form.of(model, candidate, candidate.probes[probe].values))

    def refitted(
        self, found: Sequence[CandidateEffect], shots: Sequence[Shot], text: str, earlier: Sequence[CandidateFit] = ()
    ) -> list[CandidateFit]:
        """Return the shots refitted, in a race with each other and with those refitted earlier."""
        jobs: list[RefitJob] = []
        of: list[Pick] = []
        trials: list[CandidateFit] = []
        for s in sorted(shots, key=lambda s: (found[s.candidate].effect, s.candidate)):  # those of one model together
            pick = Pick(s.candidate, s.probe, s.factor, s.fall)
            c = found[s.candidate]
            try:
                jobs.append(job(self.before, c, s.probe, s.factor, s.theta, self.movable(c, s.probe)))
                of.append(pick)
            except FAILURES as error:
                why = str(error) or type(error).__name__
                trials.append(CandidateFit(pick, failed_at(self.before, why), -np.inf))
        texts = [f"{text}: {found[p.candidate].label}" for p in of]
        best = min((t.refit.chi2 for t in earlier if not t.refit.failure), default=np.inf)
        refits = Race().run(self.search, self.before, jobs, texts, best)
        if sound := [r for r in refits if not r.failure]:
            self.search.lead(min(sound, key=lambda r: r.chi2))
        return [*trials, *(CandidateFit(p, refit, -np.inf) for p, refit in zip(of, refits, strict=True))]


def _simplest(candidate: CandidateEffect) -> list[int]:
    """Return the probes whose equations hold no other probe's: what a larger form does, its parts show."""
    forms = _forms(candidate)
    least = {f for f in set(forms) if not any(other < f for other in set(forms))}
    return [n for n, f in enumerate(forms) if f in least]


def larger(candidate: CandidateEffect, probe: int) -> list[int]:
    """Return the probes in whose equations those of one probe are a part."""
    forms = _forms(candidate)
    return [n for n, f in enumerate(forms) if f > forms[probe]]


def _forms(candidate: CandidateEffect) -> list[frozenset[str]]:
    entry = effects()[candidate.effect]
    return [frozenset(present_in(entry, p.values)) for p in candidate.probes]


def gains_of(before: Refit, refit: Refit) -> Array:
    """Return the unknowns of the model before an effect was added, as the refit with it came to them."""
    k, whole = len(before.problem.free), len(refit.problem.free)
    return np.concatenate([refit.theta[:k], refit.theta[whole:]])
