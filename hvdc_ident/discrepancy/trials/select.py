"""Which candidates are refitted, and what a refit must bring to be named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.options import DiagnosisOptions
from hvdc_ident.discrepancy.refits.refit import Refit
from hvdc_ident.discrepancy.scores.scored import SEEN, Scores
from hvdc_ident.discrepancy.signatures.candidates import CandidateEffect
from hvdc_ident.discrepancy.signatures.finite import is_linear, kind_of
from hvdc_ident.effects import effects

SAME = 1.0
"""Difference of scores, in units of chi2, up to which two signatures of one effect are one: its places cannot be told apart."""
CLEARLY = 30.0
"""In BIC: from where held-out data speak clearly against a candidate, whatever the fitted ones say."""
CLEAR = 2.0
"""Standard deviations by which an effect has to be off doing nothing."""
EACH = 4
"""Places of one effect that are refitted at first; twice as many where they score as well as the best."""
CLOSE = 0.9
"""Share of the best score that is as good."""


@dataclass(frozen=True)
class Pick:
    """A candidate to refit: its best probe, the size asked for in units of the probe's, and its score.

    gains: unknowns of the model before that go with this size, where they are known.
    """

    candidate: int
    probe: int
    factor: float
    score: float
    gains: tuple[float, ...] = ()


@dataclass(frozen=True)
class CandidateFit:
    """A candidate that was refitted: its pick, the refit, and what it gains over the model before (BIC).

    evidence: the same with what it brings on the held-out data, where that is known.
    """

    pick: Pick
    refit: Refit
    gain: float
    evidence: float | None = None

    @property
    def told(self) -> float:
        """Evidence of all data for it, as far as that is known, in BIC."""
        return self.gain if self.evidence is None else self.evidence


def behinds(trials: Sequence[CandidateFit]) -> list[float]:
    """By how much each is behind the best, in BIC: on all data together; or on the fitted ones, where that is less and the
    held-out ones do not speak clearly against it, for a difference of a few units there is not known better than the noise.

    On the fitted ones the best is the best of those that the held-out ones do not speak clearly against either.
    """
    told, gain = max((t.told for t in trials), default=0.0), best_gain(trials)
    return [min(gain - t.gain, told - t.told) if told - t.told < CLEARLY else told - t.told for t in trials]


def best_gain(trials: Sequence[CandidateFit]) -> float:
    """The largest gain of those that the held-out data do not speak clearly against."""
    told = max((t.told for t in trials), default=0.0)
    return max((t.gain for t in trials if told - t.told < CLEARLY), default=0.0)


def best_of(scores: Scores, found: Sequence[CandidateEffect]) -> tuple[Pick, ...]:
    """Each candidate at its best size, by falling score."""
    t, expected = scores.t, scores.expected
    best: dict[int, int] = {}
    for k, column in enumerate(scores.columns):
        c = column.candidate
        if t[k] > 0 and (c not in best or t[k] > t[best[c]]):
            best[c] = k
    picks = [
        # The size of an effect that is scanned is met or it is not.
        Pick(
            c,
            scores.columns[k].probe,
            1.0 if effects()[found[c].effect].needs_grid else float(expected[k]),
            float(t[k]),
        )
        for c, k in best.items()
    ]
    # Of equal scores the simpler: fewer places first, as listed.
    return tuple(sorted(picks, key=lambda p: (-round(p.score, 6), len(found[p.candidate].at), p.candidate)))


def shortlist(
    picks: Sequence[Pick], found: Sequence[CandidateEffect], rows: Array, options: DiagnosisOptions
) -> tuple[tuple[Pick, ...], dict[int, list[Pick]]]:
    """The picks to refit, and for each (by candidate) those whose signature is the same at another place.

    rows: (n, N) residualised signatures of the picks. The best of all; of each effect, places whose signature is like one
    of the best (|cos| > options.collinear) or that score near the best. What is not in proportion to its size is the same
    where its one size is.
    """
    unit = rows / np.maximum(np.linalg.norm(rows, axis=1), 1e-300)[:, None]
    cosines = np.abs(unit @ unit.T)
    chosen: list[int] = []
    same: dict[int, list[Pick]] = {}
    used: dict[str, int] = {}
    top = picks[0].score
    for k, p in enumerate(picks):
        effect = found[p.candidate].effect
        twin = next(
            (j for j in chosen if _same_form(found, picks[j], p) and (1.0 - cosines[j, k] ** 2) * top < SAME),
            None,
        )
        if twin is not None:
            same.setdefault(picks[twin].candidate, []).append(p)
            continue
        near = bool(chosen) and float(cosines[k, chosen[: options.shortlist]].max()) > options.collinear
        each = 2 * EACH if p.score > CLOSE * top else EACH
        wanted = len(chosen) < options.shortlist or ((near or p.score > 0.5 * top) and used.get(effect, 0) < each)
        if wanted and len(chosen) < options.refits and used.get(effect, 0) < 2 * EACH:
            chosen.append(k)
            used[effect] = used.get(effect, 0) + 1
    return tuple(picks[k] for k in chosen), same


def _same_form(found: Sequence[CandidateEffect], one: Pick, other: Pick) -> bool:
    """Return True where two picks with one signature may have one at every size.

    In proportion to their one size they are; a deadband of a load that stands still is one with that of a torque at one
    size only, and two time constants are met at one pair of many.
    """
    a, b = found[one.candidate], found[other.candidate]
    first, second = a.probes[one.probe], b.probes[other.probe]
    same_size = first.values == second.values or is_linear(kind_of(a, one.probe))
    return a.effect == b.effect and len(first.free) == 1 and same_size


def neighbours(
    picks: Sequence[Pick],
    found: Sequence[CandidateEffect],
    done: Sequence[int],
    best: Sequence[CandidateEffect],
    limit: int,
) -> tuple[Pick, ...]:
    """Candidates not refitted yet with the effect of one of the best, or at its places, by falling score."""
    kinds = {c.effect for c in best}
    places = {c.at for c in best}
    left = [p for p in picks if p.candidate not in done]
    near = [p for p in left if found[p.candidate].effect in kinds or found[p.candidate].at in places]
    return tuple(near[:limit])


def others(
    picks: Sequence[Pick], scores: Scores, found: Sequence[CandidateEffect], done: Sequence[int], limit: int
) -> tuple[Pick, ...]:
    """One candidate for every effect and place that was not tried, the best by score first.

    Those that bend the signal and yet score no more than noise, for the answer of a loop that is not near a linear one
    was not to be had beforehand, stand beside those with a score, in turn, at the size in the middle of what was
    probed; those first whose trace is the largest.
    """
    tried = {(found[k].effect, found[k].at) for k in done}
    threshold = scores.threshold(0.5)
    seen: dict[tuple[str, tuple[str, ...]], Pick] = {}
    for p in picks:
        key = found[p.candidate].effect, found[p.candidate].at
        if key not in tried and p.score > threshold:
            seen.setdefault(key, p)
    rest: dict[tuple[str, tuple[str, ...]], Pick] = {}
    for k in np.argsort(-scores.size, kind="stable"):
        c = scores.columns[k]
        key = found[c.candidate].effect, found[c.candidate].at
        if (
            scores.size[k] > SEEN
            and key not in tried
            and key not in seen
            and not is_linear(kind_of(found[c.candidate], c.probe))
        ):
            rest.setdefault(key, Pick(c.candidate, len(found[c.candidate].probes) // 2, 1.0, 0.0))
    pairs = zip_longest(seen.values(), rest.values())
    return tuple([p for pair in pairs for p in pair if p is not None][:limit])


@dataclass(frozen=True)
class Ruler:
    """Scale of BIC. effective: independent residuals; scale: how much larger than noise they are in the best model."""

    rows: int
    effective: float
    scale: float

    @classmethod
    def of(cls, best: Refit) -> Ruler:
        """From the best model found, whose residuals are nearest to noise."""
        return cls(best.rows, best.effective, max(best.chi2 / best.rows, 1.0))

    def gain(self, before: float, after: float, more: int) -> float:
        """The fall of BIC from one chi2 to another with `more` parameters more."""
        share = self.effective / self.rows
        return (before - after) * share / self.scale - more * self.price

    @property
    def price(self) -> float:
        """Price of one more parameter, in BIC."""
        return float(np.log(self.effective))


def clear(refit: Refit, which: int) -> bool:
    """Return True where the parameters of an effect together are clearly off neutral."""
    return refit.apart[which] > CLEAR


def at_edge(refit: Refit, which: int) -> bool:
    """Return True where the effect's size stands on the bound next to neutral: it is not there."""
    placed = refit.placed[which]
    entry, sizes = effects()[placed.candidate.effect], refit.sizes(placed)
    switches = [n for n, q in entry.parameters.items() if q.neutral is not None and n in placed.bounds]
    edges = []
    for n in switches:
        low, high = placed.bounds[n]
        neutral = entry.parameters[n].neutral
        if isinstance(neutral, str):
            edges.append(sizes[n] == sizes[neutral])
        else:
            edges.append(
                (neutral is not None and neutral <= low and sizes[n] <= low)
                or (np.isinf(neutral or 0.0) and sizes[n] >= high)
            )
    return bool(edges) and all(edges)


def material_gap(
    before: float | None, after: float | None, share: float, bands: Mapping[str, float] | None,
    tables: tuple[Mapping[str, float], Mapping[str, float]] | None,
) -> bool:  # fmt: skip
    """Return True where the fall from before to after (pooled, noise units; or by output where bands are given) is of interest."""
    if bands and tables:
        first, second = tables
        return any(first[o] > band and first[o] - second[o] > share * band for o, band in bands.items() if o in first)
    return before is not None and after is not None and before - after > share
