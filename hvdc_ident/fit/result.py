"""Results of a fit and their forms.

A `FitResult` prints as one screen, and gives the JSON of the stage, a data frame and a figure.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from hvdc_ident.budget import Known
from hvdc_ident.codec import INLINE, NOT_STORED, Coded
from hvdc_ident.data import Array
from hvdc_ident.display import Shown, Table, axes_of, data_frame
from hvdc_ident.fit.adequacy import Adequacy, ResidualTests, Whiteness
from hvdc_ident.fit.jump_instants import PlacedInstant
from hvdc_ident.fit.noise import misfit_sentence, of_misfit
from hvdc_ident.fit.residual import Curve
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.next_step import NextStep, next_phrases
from hvdc_ident.text import estimate_texts, interval_text

NOT_ASKED = "not a candidate"
"""Reason of a parameter that is held because it was not asked for."""
FIT_WORDS = {
    "does-not-fit": "The model does not fit these records",
    "noise-understated": "The noise may be understated",
    "noise-overstated": "The noise is overstated",
    "not-judged": "Not judged",
    "fits": "The model fits",
}
"""The first words of a verdict on the residuals."""

Status = Literal["converged", "at-bound", "two-optima", "not-converged", "failed", "unfinished"]


@dataclass(frozen=True)
class Estimate:
    """One estimated quantity, everything in `unit`.

    std: standard deviation, corrected for autocorrelated residuals; std_raw: as if they were independent; None where
    there is none, with the reason. ci95: the 95 % interval; an end that is None is not known.
    method: "covariance" (t times std), "profile" (up to where the cost, the others fitted again, has risen by what noise may),
    "one-sided" (on a bound: the bound and a limit), "between-rows" (it sets the instant of a jump) or "none".
    conditional_on: parameters held without which this one could not be determined.
    ci95_independent: the interval as if the residuals were independent, where they are not.
    """

    value: float
    std: float | None = None
    ci95: tuple[float | None, float | None] | None = None
    method: str = "none"
    conditional_on: tuple[str, ...] = ()
    std_raw: float | None = None
    unit: str = ""
    reason: str = ""
    ci95_independent: tuple[float, float] | None = None

    @property
    def interval(self) -> tuple[float | None, float | None] | None:
        """The 95 % interval, `ci95`."""
        return self.ci95

    def without_interval(self, why: str) -> Estimate:
        """Return the estimate without standard deviation and interval, and why."""
        reason = f"{self.reason}; {why}" if self.reason else why
        return replace(self, std=None, std_raw=None, ci95=None, ci95_independent=None, method="none", reason=reason)


@dataclass(frozen=True)
class StartOutcome:
    """End of one run of the multistart: values by unknown, cost in final weights, None where inadmissible."""

    start: FrozenMap[float]
    end: FrozenMap[float]
    cost: float | None
    status: str
    message: str
    evaluations: int
    group: int | None = None


@dataclass(frozen=True, eq=False)
class FitSoFar(Known):
    """A fit whose estimates have been found, where a budget has ended what was to follow. forced: estimated against the report."""

    result: FitResult | None = None
    forced: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class EachSoFar(Known):
    """Fits to single experiments that a budget has ended. table: of those that have ended, as `per_experiment` of a result."""

    table: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of p unknowns. names: of the unknowns; matrix: (p, p), in their units; dof: of Student's t."""

    names: tuple[str, ...]
    matrix: Array
    dof: float = math.inf


@dataclass(frozen=True)
class SignalQuality:
    """The quality of a curve. n: rows; rmse, in the unit; r2: share of the variance explained, None where the record stands still;
    in_band: share of rows in the 95 % band, None without one."""

    n: int
    rmse: float
    r2: float | None
    in_band: float | None


@dataclass(frozen=True)
class Goodness:
    """The quality of the curves of fitted experiments, by output and experiment."""

    outputs: Mapping[str, Mapping[str, SignalQuality]] = field(default_factory=dict)


@dataclass(frozen=True)
class HeldOutQuality:
    """The quality of a curve of a held-out experiment. rmse_start: at the start. ljung_box: whiteness of the residual.

    of_fit: RMSE over that of the fitted experiments of this output; near 1 the estimates hold there too.
    """

    quality: SignalQuality = field(metadata=INLINE)
    rmse_start: float | None
    of_fit: float | None
    ljung_box: Whiteness


@dataclass(frozen=True)
class HeldOut:
    """A held-out experiment at the estimates, by output. status: "done", or "failed" where it cannot be simulated.

    nuisance: what was estimated from the experiment itself.
    """

    status: Literal["done", "failed"]
    nuisance: Mapping[str, float]
    outputs: Mapping[str, HeldOutQuality]


@dataclass(frozen=True, eq=False, repr=False)
class FitResult(Coded, Shown):
    """The outcome of a fit; `to_dict` is the JSON.

    fitted: names of the free parameters. held: the reason for each other one. values: fitted ones and those held at
    given values, as the model takes them. estimates: by parameter. nuisance: by experiment and nuisance.
    cost: half the sum of squared residuals in units of sigma, None where the fit failed.
    adequacy: whether the residuals are of the size of the noise, with the verdict in words and what to do.
    rmse, rmse_given, rmse_start: by output and experiment, at the optimum, at the given values and at the start, in the
    output's unit.
    roughness: empty, or where the cost jumps from one parameter value to the next: {delta_chi2, by how much at random; text}.
    noise_source: by output, in words. sigma: standard deviation by experiment and output, in the output's unit.
    rho, effective_samples: AR(1) coefficient of the residuals and independent samples, by output.
    correlation: between the estimates. residual_tests: by output and experiment. starts: outcomes of the multistart.
    search_doubt: in words, that one start alone reached the lowest cost; the message begins with it. Empty otherwise.
    next: what to try where nothing was fitted. per_experiment: statistics over fits to single experiments, where they were made.
    loss, whitening: what residuals cost, and the AR coefficients they were whitened with, by output.
    dof: degrees of freedom of Student's t behind the intervals, None where the noise is known and white (its square is
    the F quantile of one parameter). goodness: of the fitted curves; validation: held-out experiments by name.
    covariance: of the unknowns that have one; not in the JSON, which has std and correlation.
    instants: what the rows tell of each parameter that sets the instant of a jump; not in the JSON, whose estimates say it.
    curves: every output of every experiment at the estimates, where assessed; in the files of waveforms, not in the JSON.
    """

    status: Status
    message: str = ""
    fitted: tuple[str, ...] = ()
    held: FrozenMap[str] = field(default_factory=FrozenMap)
    values: FrozenMap[float] = field(default_factory=FrozenMap)
    estimates: FrozenMap[Estimate] = field(default_factory=FrozenMap)
    nuisance: FrozenMap[FrozenMap[Estimate]] = field(default_factory=FrozenMap)
    cost: float | None = None
    chi2_per_dof: float | None = None
    adequacy: Adequacy | None = None
    rmse: Mapping[str, Mapping[str, float | None]] = field(default_factory=dict)
    rmse_start: Mapping[str, Mapping[str, float | None]] = field(default_factory=dict)
    rmse_given: Mapping[str, Mapping[str, float | None]] = field(default_factory=dict)
    roughness: Mapping[str, Any] = field(default_factory=dict)
    noise_source: FrozenMap[str] = field(default_factory=FrozenMap)
    sigma: FrozenMap[FrozenMap[float]] = field(default_factory=FrozenMap)
    rho: FrozenMap[float] = field(default_factory=FrozenMap)
    effective_samples: FrozenMap[float] = field(default_factory=FrozenMap)
    correlation: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    residual_tests: ResidualTests = field(default_factory=dict)
    starts: tuple[StartOutcome, ...] = ()
    search_doubt: str = ""
    next: tuple[NextStep, ...] = ()
    per_experiment: Mapping[str, Any] = field(default_factory=dict)
    loss: str = "linear"
    whitening: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    dof: float | None = None
    goodness: Goodness = field(default_factory=Goodness)
    validation: Mapping[str, HeldOut] = field(default_factory=dict)
    covariance: Covariance | None = field(default=None, metadata=NOT_STORED)
    instants: Mapping[str, PlacedInstant] = field(default_factory=dict, metadata=NOT_STORED)
    curves: Mapping[str, Mapping[str, Curve]] = field(default_factory=dict, metadata=NOT_STORED)

    def _screen(self) -> Iterator[str | Table]:
        yield f"Fit: {self.status}. {self.message[:1].upper()}{self.message[1:]}."
        yield self._quality()
        yield self.noise_note
        yield f"{self.roughness['text']}." if self.roughness else ""
        start = self.starts[0].start if self.starts else {}
        rows = [(n, *_cells(e), e.std, start.get(n), e.reason) for n, e in self.estimates.items()]
        yield (
            Table(("parameter", "estimate", "unit", "95 % interval", "std", "start", "remark"), tuple(rows))
            if rows
            else ""
        )
        yield self._held_at() if rows else ""
        own = [(x, n, *_cells(e)) for x, table in self.nuisance.items() for n, e in table.items()]
        yield Table(("experiment", "nuisance", "estimate", "unit", "95 % interval"), tuple(own)) if own else ""
        yield self._held()
        columns = (self.rmse_given, self.rmse_start, self.rmse)
        errors = [
            (f"{o}, {x}", *((c.get(o) or {}).get(x) for c in columns)) for o, line in self.rmse.items() for x in line
        ]
        yield Table(("RMSE of", "given", "start", "fitted"), tuple(errors)) if errors else ""
        yield f"Next: {next_phrases(self.what_next, 'python')}." if self.what_next else ""

    @property
    def params(self) -> FrozenMap[Estimate]:
        """Every parameter by name with its `value` and `interval`: the estimated ones, then those held, with the reason."""
        held = {n: Estimate(v, reason=self.held.get(n, "")) for n, v in self.values.items() if n not in self.estimates}
        return self.estimates | held

    @property
    def noise_note(self) -> str:
        """Return in a sentence that the noise of some outputs is that of the misfit; "" where it is of none."""
        return misfit_sentence(of_misfit(self.noise_source))

    @property
    def what_next(self) -> tuple[NextStep, ...]:
        """What to do, the first thing first: where nothing was fitted, else by the verdict on the residuals."""
        return self.next or (self.adequacy.next if self.adequacy is not None else ())

    def _quality(self) -> str:
        """Return the verdict on the residuals, in a line."""
        if self.adequacy is None:
            return ""
        chi2 = "" if self.adequacy.chi2_per_dof is None else f" (chi2/dof {self.adequacy.chi2_per_dof:.3g})"
        words = FIT_WORDS[self.adequacy.verdict]
        return f"{words}{chi2}" + (f": {self.adequacy.text}." if self.adequacy.text else ".")

    def _held_at(self) -> str:
        """Return the values at which candidates and partners are held, under which the intervals of the table hold; "" without any."""
        asked = {n for n, why in self.held.items() if why != NOT_ASKED and n not in self.estimates}
        needed = {n for e in self.estimates.values() for n in e.conditional_on}
        held = {n: self.values[n] for n in self.values if n in asked | needed and n not in self.fitted}
        values = ", ".join(f"{n} = {v:.6g}" for n, v in held.items())
        return f"The intervals hold at {values}, held." if values else ""

    def _held(self) -> str:
        """Return the parameters that are held, a line each; those not asked about in one."""
        explained = {n: why for n, why in self.held.items() if why != NOT_ASKED and n not in self.estimates}
        others = [n for n, why in self.held.items() if why == NOT_ASKED]
        lines = [f"{n}: {why}" for n, why in explained.items()]
        return "\n".join([*lines, *([f"Not asked about: {', '.join(others)}."] if others else [])])

    def plot(self, ax: Any = None) -> Any:
        """Draw the 95 % interval of each estimate about its value, in % of it, and return the axes."""
        from hvdc_ident.axes import draw_intervals

        axes = axes_of(ax, 7.0, 1.2 + 0.4 * max(len(self.estimates), 1))
        draw_intervals(axes, self.estimates)
        return axes

    def to_dataframe(self) -> Any:
        """Return the estimates as a pandas DataFrame, a row a parameter. Raises InputError where pandas is missing."""
        ends = [e.ci95 or (None, None) for e in self.estimates.values()]
        columns: dict[str, Any] = {
            "estimate": [e.value for e in self.estimates.values()],
            "unit": [e.unit for e in self.estimates.values()],
            "std": [e.std for e in self.estimates.values()],
            "ci95_low": [low for low, _ in ends],
            "ci95_high": [high for _, high in ends],
        }
        return data_frame(columns, list(self.estimates), "parameter")


def _cells(e: Estimate) -> tuple[str, str, str]:
    """Return value, unit and interval as text."""
    return estimate_texts(e.value, e.ci95)[0], e.unit, interval_text(e.ci95)
