"""Remainder of a hypothesis: the share of the gap that it leaves, and whether anything more could explain that.

The test puts a latent input at every insertion point, beside the effects: any course over time, with a prior that is as
large as the records ask for. Its marginal likelihood is 1 where nothing is missing; how large it becomes by chance, with
the noise and with what is not known of the noise, is had from records of noise alone.

Source: Alvarez, Luengo and Lawrence, Latent force models, AISTATS 2009 (a latent input with a Gaussian prior); Westfall and
Young, 1993 (the largest of several statistics under noise).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, fdtrc

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.expansion import Expansion
from hvdc_ident.discrepancy.hypothesis import Refit, slot_signals
from hvdc_ident.discrepancy.misfit import misfit_of
from hvdc_ident.discrepancy.moves.outside import promising
from hvdc_ident.discrepancy.nominal import Nominal, draws, of_held_out
from hvdc_ident.discrepancy.options import REFUTED, SHORTLIST, TOLERANCE, SearchContext
from hvdc_ident.discrepancy.prediction import root_mean_square_by_record
from hvdc_ident.discrepancy.pushes import Inversion, Pushed, answered, hats, pushed
from hvdc_ident.discrepancy.result import DescribedForm
from hvdc_ident.errors import SimulationError
from hvdc_ident.executor import mapped
from hvdc_ident.fit.noise import freedom_of
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import is_white_box

PROPORTIONAL = 1e-5
"""Of one less the cosine between two answers that are in proportion: runs give them to a few parts in a thousand."""
NOISE_SHARE, RANGE_SHARE = 0.1, 0.01
"""Of an output's noise, and of its range: an error below the larger is of no interest where the study says nothing else."""
TIME_KNOTS = 24
"""Hats over time of which the course of a disturbance is made."""


@dataclass(frozen=True)
class Remainder:
    """Part of the gap that a hypothesis leaves.

    share: of the squared misfit beyond noise, fitted data; held_out: the same of the others, None where they showed no gap.
    beyond: by output the root mean square of what is beyond noise, in tolerances: those of the study, or a tenth of the noise or
    a hundredth of the output's range, whichever is larger. noise_units: root mean square of the fitted residual, in standard
    deviations of the noise. held_out_p: the chance that noise is as loud as the held-out residual, with what is not known of it.
    record: the held-out experiment of which most is left, record_units: so much, in noise units. p: the chance that noise alone
    makes a latent input as likely anywhere, or, where that was not looked for, that it is as loud; at: where it is likeliest, empty where
    it was not looked for. log_evidence: of the latent input there, in nats. of_terms: by term of the hypothesis, what is left as a share
    of that and of what the term explains beside the others: of one term alone it is `share`.
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
    of_terms: tuple[float, ...] = ()

    @property
    def largest(self) -> float:
        """The largest of the shares."""
        return max(self.share, self.held_out or 0.0, *self.of_terms)

    @property
    def below_tolerance(self) -> bool:
        """True where nobody need ask what is left: next to nothing of the gap, or a small part and within every output's tolerance."""
        within = bool(self.beyond) and max(self.beyond.values()) <= 1.0
        return self.largest <= TOLERANCE or (within and self.largest <= REFUTED)


def share_left(first: Refit, last: Refit, floor: float) -> float | None:
    """Return the share of the nominal model's gap that the hypothesis `last` leaves, 0 to 1; None where `first` leaves no gap.

    A gap is the squared misfit beyond noise, on the fitted data. floor: mean square of what noise alone leaves.
    """
    gap = first.chi2 - floor * first.rows
    return float(np.clip((last.chi2 - floor * last.rows) / gap, 0.0, 1.0)) if gap > 0 else None


def remainder_of(search: SearchContext, first: Refit, last: Refit, floor: float) -> Remainder:
    """The remainder of the hypothesis `last`, as a share of the gap of the nominal model `first`.

    floor: mean square of what noise alone leaves.
    """
    was, now = first.unseen, last.unseen
    share = share_left(first, last, floor) or 0.0
    held, held_p = None, 1.0
    if was is not None and now is not None and np.isfinite(was) and was**2 > floor:
        held = float(np.clip((now**2 - floor) / (was**2 - floor), 0.0, 1.0)) if np.isfinite(now) else 1.0
        held_p = _held_out_p(search, last, now**2 / floor)
    records = root_mean_square_by_record(last.problem, last.theta)
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
    if others is None:  # parts of the fitted records, whose noise is known from before the event
        return _loud_p(last, square, last.unseen_rows * last.effective / last.rows)
    held = Nominal(others, last.theta[: len(last.problem.free)], last.noise)
    drawn = draws(others, held.blocks, held.noise, held.fitted(), _least_draws(search), search.seed + 6)
    rows = sum(b.residual.size for b in held.blocks)
    squares = sum(np.sum(d**2, axis=0) + b.spare * b.residual.size for d, b in zip(drawn, held.blocks, strict=True))
    return float((1 + np.count_nonzero(squares / rows >= square)) / (1 + _least_draws(search)))


def _loud_p(last: Refit, square: float, rows: float) -> float:
    """The chance that the mean square of noise in so many independent rows reaches this one, with what is not known of its level."""
    freedom = freedom_of(last.noise, last.problem.outputs)
    return float(chdtrc(rows, square * rows) if np.isinf(freedom) else fdtrc(rows, freedom, square))


def _least_draws(search: SearchContext) -> int:
    """Records of noise from which a chance as small as the significance can be measured."""
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
    """The remainder with the test for a latent input; as it is where it is noise, for a model that is closed inside, or cannot be
    linearised. Once the budget is over no further place is looked at."""
    nominal = last.nominal()
    if misfit_of(last).is_noise:
        return found
    found = replace(found, p=_loud_p(last, last.chi2 / last.rows, last.effective))
    if not is_white_box(last.model) or search.spent:
        return found
    try:
        signals = slot_signals(last)
        paths = pushed(last, signals)
    except SimulationError:
        return found
    search.tell(0, 1, "anything else that is missing")
    places = _apart(paths, list(signals), search.seed)
    noise = nominal.projected(nominal.drawn(_least_draws(search), search.seed + 5))
    inversions: list[Inversion] = []
    for inversion in mapped(search.executor, _inverted, [(nominal, paths, p) for p in places]):
        inversions.append(inversion)
        if search.spent and len(inversions) < len(places):
            return found  # the best of some places is none: what is left is told without one
    best = sorted(range(len(inversions)), key=lambda k: -_beyond_noise(inversions[k]))[:SHORTLIST]
    table = np.array([_log_evidence(inversions[k], noise) for k in best]).reshape(len(best), -1)
    if not table.size:
        return found
    largest = table.max(axis=0)
    k = int(np.argmax(table[:, 0]))
    p = float((1 + np.count_nonzero(largest[1:] >= largest[0])) / largest.size)
    return replace(found, p=p, at=places[best[k]], log_evidence=float(largest[0]))


def _apart(paths: Mapping[str, Pushed], places: Sequence[str], seed: int) -> list[str]:
    """Return the places, of those that answer every push in proportion to each other the first: what one explains all do.

    Told by one push of random course: of linear answers those are in proportion that are so for it.
    """
    random = np.random.default_rng(seed)
    pushes = {name: random.standard_normal((path.time.size, 1)).cumsum(axis=0) for name, path in paths.items()}
    kept: dict[str, Array] = {}
    for place in places:
        answer = np.concatenate([path.answer(place, pushes[name]).ravel() for name, path in paths.items()])
        size = float(np.linalg.norm(answer))
        unit = answer / size if 0.0 < size < np.inf else np.zeros_like(answer)
        if not any(1.0 - abs(float(unit @ other)) < PROPORTIONAL for other in kept.values()):
            kept[place] = unit
    return list(kept)


def _inverted(job: tuple[Nominal, Mapping[str, Pushed], str]) -> Inversion:
    return Inversion.of(*job)


def _beyond_noise(latent: Inversion) -> float:
    """By how much more chi2 falls with a latent input than noise would."""
    fall, count = latent.reach
    return fall - count


def _log_evidence(latent: Inversion, noise: NDArray[np.float32]) -> Array:
    """(1 + B,) log marginal likelihood of a latent input, in nats: of the residual, then of records of noise."""
    if not latent.strength.size:
        return np.zeros(1 + noise.shape[1])
    return latent.log_evidence(np.column_stack([latent.wanted, latent.against(noise)]))


def disturbance_course(search: SearchContext, opened: Expansion) -> DescribedForm:
    """Return what would have to be added at the place that explains most, over time and the same in every experiment.

    Each of some hats over time is put on the place as the model runs; its answer at the outputs, whitened and freed of what the
    parameters can make good, is a column of a regression of the residual.
    """
    paths, nominal = opened.answers(), opened.before.nominal()
    experiments = nominal.problem.fitted_experiments
    at = np.linspace(min(e.time[0] for e in experiments), max(e.time[-1] for e in experiments), TIME_KNOTS)
    residual, best = nominal.projected(nominal.residual), None
    for place in [p for p in promising(opened) if search.looks_at(p)]:
        columns = nominal.projected(
            np.vstack([answered(nominal, e, paths[e.name], place, hats(e.time, at)) for e in experiments])
        )
        columns = np.where(np.isfinite(columns), columns, 0.0)
        norms = np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny)
        values = np.linalg.lstsq(columns / norms, residual, rcond=1e-8)[0] / norms
        worth = float(residual @ residual - np.sum((residual - columns @ values) ** 2)) - at.size * np.log(
            residual.size
        )
        if worth > (0.0 if best is None else best[0]):
            best = worth, place, values, columns
    if best is None:
        return DescribedForm("nothing", "", "No hidden input at any one place explains it.")
    worth, place, values, columns = best
    spread = np.sqrt(np.maximum(np.diag(np.linalg.pinv(columns.T @ columns, rcond=1e-10)), 0.0))
    curve = {"over": "time", "at": at.tolist(), "value": values.tolist(), "std": spread.tolist()}
    if len(experiments) > 1:
        text = f"It acts at {place} at the same times in every experiment, whatever the state: a disturbance."
        return DescribedForm("disturbance", place, text, delta_bic=worth, curve=curve)
    text = f"It acts at {place}; with one experiment a disturbance cannot be distinguished from a form."
    return DescribedForm("curve", place, text, delta_bic=worth, curve=curve)
