"""Remainder of a hypothesis: the share of the gap that it leaves, and whether anything more could explain that.

The test puts a latent input at every insertion point, beside the effects: any course over time, with a prior that is as
large as the records ask for. Its marginal likelihood is 1 where nothing is missing; how large it becomes by chance, with
the noise and with what is not known of the noise, is had from records of noise alone.

Source: Alvarez, Luengo and Lawrence, Latent force models, AISTATS 2009 (a latent input with a Gaussian prior); Westfall and
Young, 1993 (the largest of several statistics under noise).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc
from scipy.stats import chi2

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.context import SearchContext, slot_signals
from hvdc_ident.discrepancy.evidence import unseen_rows
from hvdc_ident.discrepancy.latent import Inversion
from hvdc_ident.discrepancy.nominal import Nominal, of_held_out
from hvdc_ident.discrepancy.options import REFUTED, SHORTLIST, TOLERANCE
from hvdc_ident.discrepancy.record_noise import draws, freedom_of
from hvdc_ident.discrepancy.refit import Refit, held_out_by_record, unseen
from hvdc_ident.discrepancy.refitted import left_by
from hvdc_ident.discrepancy.scores import runs
from hvdc_ident.discrepancy.signatures.response import Along, alone
from hvdc_ident.errors import SimulationError
from hvdc_ident.executor import Made, mapped
from hvdc_ident.immutable import FrozenMap

NOISE_SHARE, RANGE_SHARE = 0.1, 0.01
"""Of an output's noise, and of its range: an error below the larger is of no interest where the study says nothing else."""


@dataclass(frozen=True)
class Remainder:
    """Part of the gap that a hypothesis leaves.

    share: of the squared misfit beyond noise, fitted data; held_out: the same of the others, None where they showed no gap.
    beyond: by output the root mean square of what is beyond noise, in tolerances: those of the study, or a tenth of the noise or
    a hundredth of the output's range, whichever is larger. noise_units: root mean square of the fitted residual, in standard
    deviations of the noise. held_out_p: the chance that noise is as loud as the held-out residual, with what is not known of it.
    record: the held-out experiment of which most is left, record_units: so much, in noise units. p: the chance that noise alone
    makes a latent input as likely anywhere; at: where it is likeliest, empty where it was not looked for. log_evidence: of the
    latent input there, in nats.
    """

    share: float
    held_out: float | None
    noise_units: float
    held_out_p: float = 1.0
    p: float = 1.0
    at: str = ""
    log_evidence: float = 0.0
    record: str = ""
    record_units: float = 0.0
    beyond: FrozenMap[float] = field(default_factory=FrozenMap)

    @property
    def largest(self) -> float:
        """The larger of the two shares."""
        return max(self.share, self.held_out or 0.0)

    @property
    def below_tolerance(self) -> bool:
        """True where nobody need ask what is left: next to nothing of the gap, or a small part and within every output's tolerance."""
        within = bool(self.beyond) and max(self.beyond.values()) <= 1.0
        return self.largest <= TOLERANCE or (within and self.largest <= REFUTED)


def is_small(search: SearchContext, first: Refit, last: Refit) -> bool:
    """Return True where the hypothesis `last` leaves a small part of the gap of `first`, and no output more than its tolerance."""
    if not left_by(last) <= REFUTED * left_by(first):
        return False
    return max(_beyond(search.tolerance, last, 1.0).values(), default=np.inf) <= 1.0


@dataclass(frozen=True, eq=False)
class _LatentJob:
    """One insertion point's share of the work; noise: (N, B) records of noise, projected, or None."""

    nominal: Nominal
    paths: Mapping[str, Along]
    place: str
    noise: NDArray[np.float32] | None


def remainder_of(search: SearchContext, first: Refit, last: Refit, floor: float) -> Remainder:
    """The remainder of the hypothesis `last`, as a share of the gap of the nominal model `first`.

    floor: mean square of what noise alone leaves.
    """
    was, now = unseen(first), unseen(last)
    gap = first.chi2 - floor * first.rows
    share = float(np.clip((last.chi2 - floor * last.rows) / gap, 0.0, 1.0)) if gap > 0 else 0.0
    held, held_p = None, 1.0
    if was is not None and now is not None and np.isfinite(was) and was**2 > floor:
        held = float(np.clip((now**2 - floor) / (was**2 - floor), 0.0, 1.0)) if np.isfinite(now) else 1.0
        held_p = _held_out_p(search, last, now**2 / floor)
    records = held_out_by_record(last)
    most = max(records, key=lambda n: records[n], default="")
    units = float(np.sqrt(last.chi2 / last.rows))
    found = Remainder(
        share, held, units, held_p,
        record=most, record_units=records.get(most, 0.0), beyond=_beyond(search.tolerance, last, floor),
    )  # fmt: skip
    return _tested(search, last, found)


def _held_out_p(search: SearchContext, last: Refit, square: float) -> float:
    """The chance that the mean square of noise in the held-out data reaches this one, with what is not known of the noise."""
    others = of_held_out(last.problem)
    if not np.isfinite(square):
        return 0.0
    if others is None:  # parts of the fitted records, which noise before the event has told of
        rows = unseen_rows(last) * last.effective / last.rows
        freedom = freedom_of(last.noise, last.problem.outputs)
        return float(chi2.sf(square * rows, rows) if np.isinf(freedom) else fdtrc(rows, freedom, square))
    held = Nominal(others, last.theta[: len(last.problem.free)], last.noise)
    drawn = draws(others, held.blocks, held.noise, held.fitted(), _least_draws(search), search.seed + 6)
    rows = sum(b.residual.size for b in held.blocks)
    squares = sum(np.sum(d**2, axis=0) + b.spare * b.residual.size for d, b in zip(drawn, held.blocks, strict=True))
    return float((1 + np.count_nonzero(squares / rows >= square)) / (1 + _least_draws(search)))


def _least_draws(search: SearchContext) -> int:
    """Records of noise from which a chance as small as the significance can be told."""
    return math.ceil(1.0 / search.options.significance)


def _beyond(tolerance: Mapping[str, float], last: Refit, floor: float) -> FrozenMap[float]:
    """By output the root mean square beyond noise over all records, in units of its tolerance."""
    found = {}
    for output, row in last.problem.rmse(last.theta).items():
        std = last.noise[output].std or 0.0
        values = [
            e.measured[output] for e in last.problem.experiments if e.measured is not None and output in e.outputs
        ]
        extent = max((float(np.nanmax(v) - np.nanmin(v)) for v in values), default=0.0)
        band = tolerance.get(output) or max(NOISE_SHARE * std, RANGE_SHARE * extent)
        squares = [np.inf if v is None else v**2 for v in row.values()]
        found[output] = float(np.sqrt(max(float(np.mean(squares)) - floor * std**2, 0.0))) / band if band > 0 else 0.0
    return FrozenMap(found)


def _tested(search: SearchContext, last: Refit, found: Remainder) -> Remainder:
    """The remainder with the test for a latent input; as it is for a model that is closed inside, or cannot be linearised."""
    nominal = last.nominal()
    try:
        paths = runs(last.model, nominal)
    except SimulationError:
        return found
    inner = {n: p for n, p in paths.items() if isinstance(p, Along)}
    if len(inner) < len(paths):
        return found
    places = list(slot_signals(last.model, inner, last.placed))
    search.tell(0, 1, "anything else that is missing")

    def job(place: str, noise: NDArray[np.float32] | None = None) -> _LatentJob:
        return _LatentJob(nominal, alone(inner, place), place, noise)

    falls = list(mapped(search.executor, _fall, Made(job, places)))
    best = sorted(range(len(places)), key=lambda k: -falls[k])[:SHORTLIST]
    noise = nominal.projected(nominal.drawn(_least_draws(search), search.seed + 5))
    jobs = [job(places[k], noise) for k in best]
    table = np.array(list(mapped(search.executor, _log_evidence, jobs))).reshape(len(jobs), -1)
    if not table.size:
        return found
    largest = table.max(axis=0)
    k = int(np.argmax(table[:, 0]))
    p = float((1 + np.count_nonzero(largest[1:] >= largest[0])) / largest.size)
    return replace(found, p=p, at=jobs[k].place, log_evidence=float(largest[0]))


def _fall(job: _LatentJob) -> float:
    """By how much more chi2 falls with a latent input at the place than noise would."""
    fall, count = Inversion.of(job.nominal, job.paths, job.place).reach
    return fall - count


def _log_evidence(job: _LatentJob) -> Array:
    """(1 + B,) log marginal likelihood of a latent input at the place, in nats: of the residual, then of records of noise."""
    latent = Inversion.of(job.nominal, job.paths, job.place)
    assert job.noise is not None
    if not latent.strength.size:
        return np.zeros(1 + job.noise.shape[1])
    return latent.log_evidence(np.column_stack([latent.wanted, latent.against(job.noise)]))
