"""Noise of the measured outputs: how large, how correlated and how coarse it is, from where that is known, and how well.

Of each output the records together tell it, from the rows before their events less the run of the model, where both are at rest:
what moves there holds what the model lacks. A fit's own residual holds that everywhere, and stands in only where nothing else
tells. A stated standard deviation stands unless those rows are plainly noisier; what the records say against it is told.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce

import numpy as np

from hvdc_ident.data import (
    FEWEST_QUIET,
    FLOOR_SHARE,
    Array,
    Experiment,
    before_event,
    event_time,
    is_even,
    noise_estimate,
    noise_floor,
    quiet_rows,
    row_scatter,
    segments,
    without_line,
)
from hvdc_ident.data.noise import (
    ESTIMATED,
    ROUNDED,
    SCATTER,
    Colour,
    FirstOrder,
    QuietRows,
    below_rounding,
    common_colours,
    freedom_of_scatter,
    is_coarse,
    white_std,
)
from hvdc_ident.data.rounding import flicker_of, resolution
from hvdc_ident.errors import StudyError
from hvdc_ident.fit.likelihood import QuantisedNoise
from hvdc_ident.fit.whitening import AR, FEWEST, autoregression, sum_of_squares
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.text import listed

GIVEN = "given"
MISFIT = "misfit"
AT_FLOOR = f"{MISFIT}, at the floor of 1e-6 of the range"
MOVING = "estimated before the event, where the model moves: at most so much"
"""The source where inputs that are recorded with their noise keep the model moving. What it lacks is in such rows too, so that the
noise is no more; all rows tell more of what it lacks, and no steps from row to row tell of noise that a recorder has smoothed."""
WHAT_TELLS_NOISE = (
    "state the noise, or record rows at rest before the event (of a frequency response, the sweep once more)"
)
"""What to do about a noise that is taken from the misfit."""
LOUDER, QUIETER = "louder", "quieter"
"""Words for records that are not as loud as was stated."""

SURE = 4.0
"""Standard errors beyond which nothing is put down to chance: one in 16 000, where a diagnosis asks some hundred such questions."""
LONG = 120
"""Rows of a record from which a diagnosis takes several AR coefficients as they are; how uncertain one is, it draws."""
IN_COMMON = 11.5
"""Twice the log-likelihood by which the records' sum has to differ from their differences to hold something in common."""
FINEST = 0.1
"""The least noise below a quantiser, in steps, for a model is not exact to less."""


@dataclass(frozen=True)
class OutputNoise:
    """The noise of one output. std: in its unit, None where the data are deterministic (the misfit stands in).

    model: its AR coefficients; error: the standard error of artanh of a single one, or of the logarithm of the noise below a
    rounding. step: what values are rounded to, 0 for nothing. source: where it is known from, in words: `GIVEN`, `ESTIMATED`,
    `SCATTER`, `ROUNDED`, `MOVING`, `MISFIT`. rows: how many before an event are at rest. freedom: degrees of freedom of the
    standard deviation if the noise were white; 0 for one that is stated. stated: what was stated, None where nothing was; shown:
    what the records show; contradicted: `LOUDER` or `QUIETER` where they are so beyond chance.
    by_record: by experiment the standard deviation and its degrees of freedom, where the records' own differ beyond chance.
    moving: rows before an event of which nothing is told, for the model or the record is not at rest there.
    """

    std: float | None
    model: AR = ()
    error: float = 0.0
    step: float = 0.0
    source: str = GIVEN
    rows: int = 0
    freedom: int = 0
    stated: float | None = None
    shown: float = 0.0
    contradicted: str = ""
    by_record: FrozenMap[tuple[float, int]] = field(default_factory=FrozenMap)
    moving: int = 0

    @property
    def std_error(self) -> float:
        """The relative standard error of the standard deviation; 0 of a stated one."""
        return math.sqrt(sum_of_squares(self.model) / (2.0 * self.freedom)) if self.freedom else 0.0

    @property
    def below(self) -> float:
        """The standard deviation of the noise before rounding, in the output's unit; 0 where rounding is all there is."""
        return math.sqrt(max((self.std or 0.0) ** 2 - self.step**2 / 12.0, 0.0))

    @property
    def quantised(self) -> QuantisedNoise | None:
        """Quantised noise of the record where its white noise does not hide the steps; else None."""
        coarse = self.std is not None and not self.model and self.below < self.step
        return QuantisedNoise(self.step, max(self.below, FINEST * self.step)) if coarse else None


# --- what is stated, and from where a standard deviation is known ---


def from_misfit(source: str) -> bool:
    """Return whether a `noise_source` says that the standard deviation is that of the fit's own residual."""
    return source.startswith(MISFIT)


def of_misfit(sources: Mapping[str, str]) -> tuple[str, ...]:
    """Return the outputs whose misfit is taken for noise. sources: by output, as in `noise_source`.

    None that a model meets to its last digits: such a record has no noise, and its misfit is none.
    """
    return tuple(o for o, source in sources.items() if source == MISFIT)


def misfit_sentence(outputs: Sequence[str]) -> str:
    """Return what is to be said beside every verdict that rests on noise taken from the misfit of these outputs; "" of none."""
    if not outputs:
        return ""
    return (
        f"The noise of {listed(outputs)} is not known and is taken from the misfit, which can hide a gap or invent one; to settle "
        f"it, {WHAT_TELLS_NOISE}."
    )


def floor_of(experiments: Sequence[Experiment], output: str) -> float:
    """Return the smallest standard deviation an output may have, in its unit: 1e-6 of its largest range within one record.

    Of records that stand still it is that of their size, or of 1.
    """
    return FLOOR_SHARE * _range_of(experiments, output)


def _range_of(experiments: Sequence[Experiment], output: str) -> float:
    records = [e.measured[output] for e in experiments if e.measured is not None and output in e.measured]
    records = [r[np.isfinite(r)] for r in records]
    records = [r for r in records if r.size]
    width = max((float(np.ptp(r)) for r in records), default=0.0)
    size = max((float(np.abs(r).max()) for r in records), default=0.0)
    return width or size or 1.0


def source_of(experiments: Sequence[Experiment], output: str) -> str:
    """Return the source of an output's standard deviation: "given", or "misfit".

    It is the misfit where a record has no noise, or where all noise given is the floor: such data are deterministic.
    """
    noises = [e.noise.get(output) for e in experiments if output in e.outputs]
    limit = floor_of(experiments, output) * (1.0 + 1e-6)
    return GIVEN if noises and all(n is not None for n in noises) and any(n > limit for n in noises if n) else MISFIT


def source_text(experiments: Sequence[Experiment], output: str, weight: float | None) -> str:
    """Return the source of an output's standard deviation, in words. weight: that of the misfit, in the output's unit."""
    if source_of(experiments, output) == MISFIT:
        floor = weight is not None and weight <= floor_of(experiments, output)
        return AT_FLOOR if floor else MISFIT
    measured = [e for e in experiments if output in e.outputs]
    estimated = [e for e in measured if output in e.noise_dof]
    if not estimated:
        return GIVEN
    how = ", ".join(dict.fromkeys(e.noise_from.get(output, ESTIMATED) for e in estimated))
    everywhere = len(estimated) == len(measured)
    return how if everywhere else f"{how} in {', '.join(e.name for e in estimated)}, given for the others"


def unknown_noise(experiments: Sequence[Experiment], sources: Mapping[str, str]) -> dict[str, str]:
    """Return by output, as a clause, the reason why its standard deviation is that of the misfit. sources: `noise_source`.

    Data have no noise only where the model itself meets them to the last digits; a record that was measured has some, if not
    in the rows before the event.
    """
    reasons = {}
    for output, source in sources.items():
        if not from_misfit(source):
            continue
        if source != MISFIT:
            reasons[output] = "the record has no noise (the model meets it to 1e-6 of its range)"
        elif all(_is_still(e, output) for e in experiments if output in e.outputs):
            reasons[output] = "the record shows no noise before the event"
        else:
            reasons[output] = "its noise is not given, and no quiet rows before an event tell it"
    return reasons


def _is_still(experiment: Experiment, output: str) -> bool:
    """Return whether a record has rows at rest before its event and shows no noise there."""
    assert experiment.measured is not None
    values = experiment.measured[output]
    estimate = noise_estimate(experiment.time, values, experiment.event)
    return bool(estimate.source) and estimate.std <= noise_floor(values)


def stated_by(experiment: Experiment, output: str) -> float | None:
    """Return the standard deviation that a record states for an output; None where it was estimated from its rows, or is the floor."""
    value = experiment.noise.get(output)
    if value is None or (output in experiment.noise_dof and experiment.domain == "time"):
        return None
    return value if value > floor_of([experiment], output) * (1.0 + 1e-6) else None


def _stated(output: str, experiments: Sequence[Experiment]) -> float | None:
    """Return the root mean square of the standard deviations stated; None where one is missing or all are the floor."""
    stds = [n for e in experiments if (n := stated_by(e, output)) is not None]
    if len(stds) < len(experiments) or source_of(experiments, output) == MISFIT:
        return None
    return math.sqrt(sum(n**2 for n in stds) / len(stds))


def sigmas(experiment: Experiment, experiments: Sequence[Experiment], weights: Mapping[str, float]) -> dict[str, float]:
    """Return the standard deviation of each output of an experiment, in the output's unit, never below the floor.

    The first that is there: `weights`, the experiment's own noise where `source_of` says "given", a tenth of the range
    (a first weight, to be replaced by the misfit). Raises StudyError for a noise that is not positive.
    """
    deviations: dict[str, float] = {}
    for output in experiment.outputs:
        given = experiment.noise.get(output)
        if given is not None and not (np.isfinite(given) and given >= 0):
            raise StudyError(
                f"the noise of '{output}' is wrong",
                where=f"experiment '{experiment.name}'",
                expected="a finite standard deviation, not negative",
                got=f"{given:g}",
            )
        known = weights.get(output)
        if known is None and given is not None and source_of(experiments, output) == GIVEN:
            known = given
        span = _range_of([*experiments, experiment], output)
        deviations[output] = max(0.1 * span if known is None else known, FLOOR_SHARE * span)
    return deviations


def freedom_of(noise: Mapping[str, OutputNoise], outputs: Iterable[str]) -> float:
    """Return the degrees of freedom of the noise level of some outputs together; infinite where all of it is stated.

    Source: Satterthwaite, Biometrics Bulletin 2 (1946), for outputs with as many rows each.
    """
    shares = [1.0 / n.freedom if (n := noise[o]).freedom else 0.0 for o in outputs]
    return len(shares) ** 2 / sum(shares) if any(shares) else float("inf")


# --- what the records tell ---


@dataclass(frozen=True, eq=False)
class _Pool:
    """The records of one output before its events, and the noise that they show.

    records: rows before the events, less line and what they have in common; given: the standard deviation stated; step: what the
    records are rounded to, floor: the least they can hold, flicker: the noise below the rounding, in steps. scatter: the white noise
    that all rows show from one to the next, and its degrees of freedom. longer: an AR model of several coefficients, where there are
    rows enough; first: the likelihood of one, where rows are even. own: by experiment the standard deviation and the number of its
    rows at rest. moving: rows before the events that are not at rest. restless: whether `records` are such rows.
    """

    records: tuple[Array, ...]
    given: float | None
    step: float
    floor: float
    flicker: float
    scatter: tuple[float, float] | None
    longer: AR
    first: FirstOrder | None
    own: Mapping[str, tuple[float, int]]
    moving: int
    restless: bool

    @property
    def rows(self) -> int:
        """Number of all of them."""
        return sum(r.size for r in self.records)


def noise_of(
    experiments: Sequence[Experiment], runs: Mapping[str, Mapping[str, Array]] | None = None
) -> FrozenMap[OutputNoise]:
    """Return the noise of every measured output, from all its records together; AR coefficients from all outputs together.

    runs: by experiment and output the run of the model, (n,) at the experiment's rows; without one a level is taken for it.
    """
    outputs = dict.fromkeys(o for e in experiments for o in e.outputs)
    pools = {o: _pooled(o, [e for e in experiments if o in e.outputs], runs or {}) for o in outputs}
    colours = _colours(pools)
    return FrozenMap({o: _noise(p, colours.get(o, Colour())) for o, p in pools.items()})


def _pooled(output: str, experiments: Sequence[Experiment], runs: Mapping[str, Mapping[str, Array]]) -> _Pool:
    rest = {e.name: _rest(e, output, runs.get(e.name, {}).get(output)) for e in experiments}
    scatter = scatter_of(experiments, output, runs)
    restless = scatter is None and not any(q.rows.size for q in rest.values())
    moving = sum(q.moving for q in rest.values())
    if restless:
        rest = {e.name: _moving(e, output, runs[e.name][output]) for e in experiments if output in runs.get(e.name, {})}
    rest = {name: q for name, q in rest.items() if q.rows.size}
    whole = [e.measured[output] for e in experiments if e.measured is not None]
    step, given = max((resolution(v) for v in whole), default=0.0), _stated(output, experiments)
    floor = max((noise_floor(v) for v in whole), default=0.0)
    even = all(is_even(e.time) for e in experiments)
    quiet = [q.values for q in rest.values()]
    if even:
        starts = {e.name: e.time - e.time[0] for e in experiments}
        quiet = without_common([starts[name][q.rows] for name, q in rest.items()], quiet)
    std = white_std(quiet)
    # A model that meets a record to its last digits, or a thousand times better than was stated, leaves no noise to tell of.
    shows = std > (floor if given is None else max(1e-12 * _range_of(experiments, output), 1e-3 * given))
    coarse = is_coarse(quiet, step)
    longer = autoregression(quiet) if shows and even and sum(r.size for r in quiet) >= LONG * len(quiet) else ()
    return _Pool(
        records=tuple(quiet) if shows or coarse else tuple(0.0 * r for r in quiet),
        given=given,
        step=step,
        floor=floor,
        flicker=flicker_of(whole, step) if step else 0.0,
        scatter=scatter,
        longer=longer if len(longer) > 1 else (),
        first=FirstOrder.of(quiet) if shows and even and len(longer) < 2 and not coarse else None,
        own={name: (white_std([q.values]), q.rows.size) for name, q in rest.items()},
        moving=moving,
        restless=restless and bool(rest),
    )


def _event_of(experiment: Experiment) -> float | None:
    if experiment.domain != "time":
        return None
    return experiment.event if experiment.event is not None else event_time(experiment.inputs)


def _rest(experiment: Experiment, output: str, run: Array | None) -> QuietRows:
    """Return the rows of an output before the event that are at rest. run: (n,) of the model at the experiment's rows, or None."""
    assert experiment.measured is not None
    profile = experiment.noise_profile.get(output)
    return quiet_rows(experiment.time, experiment.measured[output], _event_of(experiment), run, profile)


def _moving(experiment: Experiment, output: str, run: Array) -> QuietRows:
    """Return the rows before the event less the model's run, whether they are at rest or not; none where they are too few."""
    assert experiment.measured is not None
    rows = np.flatnonzero(before_event(experiment.time, experiment.measured[output], _event_of(experiment)))
    if rows.size < FEWEST_QUIET:
        return QuietRows(rows[:0], np.zeros(0), 0)
    left, near = without_line(experiment.time[rows], (experiment.measured[output] - run)[rows])
    return QuietRows(rows[near], left[near], rows.size)


def scatter_of(
    experiments: Sequence[Experiment], output: str, runs: Mapping[str, Mapping[str, Array]] | None = None
) -> tuple[float, float] | None:
    """Return the white noise that an output's compared rows show from one to the next, and its degrees of freedom.

    In the output's unit, over all its records, each by its rows, less the model's run where there is one; None where one of them
    does not show it (`row_scatter`), has rows of different noise, or is a frequency response, which is as rough as the plant makes it.
    """
    power = freedom = 0.0
    for e in experiments:
        if output not in e.outputs or e.measured is None:
            continue
        if e.domain != "time" or output in e.noise_profile:
            return None
        keep = e.compared & np.isfinite(e.measured[output])
        left = e.measured[output] - (runs or {}).get(e.name, {}).get(output, np.zeros(e.time.size))
        scatter = row_scatter(e.time[keep], left[keep])
        if scatter is None:
            return None
        own = freedom_of_scatter(left[keep])
        power, freedom = power + own * scatter**2, freedom + own
    return (math.sqrt(power / freedom), freedom) if freedom else None


def without_common(times: Sequence[Array], records: Sequence[Array]) -> list[Array]:
    """Return the differences of the records, as records of the same noise, where what they have in common is no noise; else all.

    times: (n,) s each, since the start. A model at rest may ripple (a quantiser or a backlash in its loop), in every record alike.
    Orthonormal combinations of records of independent noise are such records too: their sum, which holds the ripple, and their
    differences. Rows count that all records have.
    """
    if len(records) < 2:
        return list(records)
    # The shortest step: of records with gaps a longer one would put two rows at one place.
    step = min(float(np.diff(t).min()) for t in times)
    places = [np.round(t / step).astype(int) for t in times]
    shared = reduce(np.intersect1d, places)
    alike = [
        without_line(p[k], r[k])[0] for p, r in zip(places, records, strict=True) if (k := np.isin(p, shared)).any()
    ]
    if shared.size < FEWEST_QUIET or not all(np.any(r) for r in alike):
        return list(records)
    count = len(alike)
    turn = np.linalg.qr(np.column_stack([np.ones(count), np.eye(count)[:, 1:]]))[0]
    turned = list((np.column_stack(alike) @ turn).T)
    if not all(np.any(r) for r in turned):
        return list(records)
    parts = [float(FirstOrder.of(r).profile.max()) for r in (turned[:1], turned[1:], turned)]
    return turned[1:] if 2.0 * (parts[0] + parts[1] - parts[2]) > IN_COMMON else list(records)


def _colours(pools: Mapping[str, _Pool]) -> dict[str, Colour]:
    """Return the AR(1) coefficient of each output: told by the records alone first, then with the standard deviations given."""
    short = {o: p.first for o, p in pools.items() if p.first is not None}
    if not short:
        return {}
    alone = dict(zip(short, common_colours(list(short.values())), strict=True))
    known = [pools[o].given if alone[o].tanh and _agrees(first, pools[o].given) else None for o, first in short.items()]
    sharper = dict(zip(short, common_colours(list(short.values()), known), strict=True))
    return {o: sharper[o] if alone[o].tanh and sharper[o].tanh else alone[o] for o in short}


def _agrees(first_order: FirstOrder, given: float | None) -> bool:
    """Return whether a given standard deviation is compatible with the records."""
    return given is not None and 2.0 * float(first_order.profile.max() - first_order.at(given).max()) < SURE**2


def _noise(pool: _Pool, colour: Colour) -> OutputNoise:
    """Return the noise of an output. colour: its coefficient."""
    given, std = pool.given, white_std(pool.records)
    noise = OutputNoise(std, (), 0.0, pool.step, GIVEN, pool.rows, stated=given, shown=std, moving=pool.moving)
    still = given is None and std <= pool.floor
    if not pool.rows and pool.scatter is not None and not pool.step:
        return _from_scatter(noise, *pool.scatter)
    if pool.step and (still or is_coarse(pool.records, pool.step)):
        # A level tells its own flicker only: none in the middle of a step, most at its edge. So all rows are asked beside those at rest.
        told = below_rounding(pool.records, pool.step, pool.flicker)
        if given is not None and given >= told.std:
            return replace(noise, std=given)
        return replace(noise, std=told.std, error=told.error, source=ROUNDED, freedom=max(round(told.freedom), 1))
    if still:
        return replace(noise, std=None, source=MISFIT)
    freedom = max(pool.rows - 2 * len(pool.records), 1)
    if pool.first is not None and colour.tanh:
        std = pool.first.std(colour)
    elif pool.first is not None:
        level, known = pool.first.level
        std, freedom = max(level, std), max(round(known), 1)
    noise = replace(
        noise,
        std=std,
        model=(colour.rho,) if colour.tanh else pool.longer,
        error=colour.error,
        source=MOVING if pool.restless else ESTIMATED,
        freedom=freedom,
        shown=std,
    )
    if given is None:
        return replace(noise, by_record=FrozenMap(_by_record(pool, noise)))
    if colour.tanh and pool.first is not None:
        differs = not _agrees(pool.first, given)
    else:
        differs = max(std, given) > min(std, given) * (1.0 + SURE * noise.std_error)
    if differs and std > given:
        return replace(noise, contradicted=LOUDER)
    return replace(noise, std=given, source=GIVEN, freedom=0, contradicted=QUIETER if differs and pool.rows else "")


def _from_scatter(noise: OutputNoise, scatter: float, freedom: float) -> OutputNoise:
    """Return the noise where no rows before an event tell it: as stated, unless that is plainly less than what all rows show."""
    shown = replace(noise, std=scatter, source=SCATTER, freedom=int(freedom), shown=scatter)
    if noise.stated is None:
        return shown
    # What is not followed from row to row is in the scatter too, as far as its orders agree all the same: three standard errors.
    if scatter > noise.stated * math.exp((SURE + 3.0) * shown.std_error):
        return replace(shown, contradicted=LOUDER)
    return replace(noise, std=noise.stated)


def _by_record(pool: _Pool, noise: OutputNoise) -> dict[str, tuple[float, int]]:
    """Return by experiment its standard deviation and degrees of freedom, where one of them is not that of all; else nothing."""
    if pool.step > 0.0 or len(pool.own) < 2 or noise.std is None:
        return {}
    scale = noise.std / white_std(pool.records)
    own = {n: (scale * std, rows - 2) for n, (std, rows) in pool.own.items()}
    differ = any(
        s <= 0.0 or abs(math.log(s / noise.std)) > SURE * replace(noise, freedom=rows).std_error
        for s, rows in own.values()
    )
    return own if differ and all(s > pool.floor for s, _ in own.values()) else {}


def models_before_event(experiments: Sequence[Experiment], outputs: Sequence[str]) -> Mapping[str, AR]:
    """Return the noise model of each output, from the rows before the event of every experiment that are at rest.

    Raises StudyError for an output with fewer than 20 such rows, or whose record shows no noise there.
    """
    recorded = [e for e in experiments if e.domain == "time" and e.measured is not None]
    noise = noise_of(recorded)
    for output in outputs:
        rows = noise[output].rows if output in noise else 0
        if rows < FEWEST or noise[output].shown <= 0.0:
            raise StudyError(
                f"no noise of '{output}' before the event to whiten with",
                expected=f"at least {FEWEST} rows before the event, at rest and with noise in them",
                got=f"{rows} rows",
                hint='whiten = "residual" takes the model of the noise from the residuals',
            )
        for e in recorded:
            segments(
                e.time[_rest(e, output, None).rows] if output in e.outputs else e.time[:0], f"experiment '{e.name}'"
            )
    return {o: noise[o].model for o in outputs}
