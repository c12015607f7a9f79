"""Model checks on a fit's residuals: their size beside that of the noise, and whether they are white.

The mean squared residual per degree of freedom (chi2/dof) is 1 where a right model meets the stated noise. A verdict needs it
to differ from 1 by more than chance allows (the F quantile, of the independent samples in the residual and of those behind an
estimated noise), and by enough to matter: from 2 on more than half of the residual's power is not noise, and intervals that
rest on the noise alone cover less than that half. Below 1/2 they are too wide in the same proportion.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from scipy.special import chdtrc, fdtri

from hvdc_ident.codec import NOT_STORED
from hvdc_ident.data import FLOOR_SHARE, MAD_TO_STD, Array, Experiment
from hvdc_ident.fit.noise import GIVEN, MISFIT, from_misfit, scatter_of, source_of
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.residual import Curve, ResidualBlock, stretches
from hvdc_ident.fit.whitening import autoregression, independent_samples, innovation_share
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.next_step import NextStep
from hvdc_ident.text import times_text

LEVEL = 1e-3
"""Chance of a verdict against the model or the noise where both are right, over all outputs, or all parameters, together."""
MATTERS = 2.0
"""Ratio of the residual's power to the noise's from which intervals that rest on the noise are wrong (see above)."""
MOVED = "what the model lacks may move the estimates by more than any noise, so that no interval is given"
"""The consequence of a misfit for what is estimated. A fit leaves of a missing effect what no parameter can make good, and that does
not tell how much of it the parameters have made good."""

CORRELATED = "the model lacks something, or the noise is correlated from row to row, as the intervals take it"
"""The same where no noise is known but what the rows show."""

Verdict = Literal["fits", "does-not-fit", "noise-understated", "noise-overstated", "not-judged"]
TOO_LARGE: tuple[Verdict, ...] = ("does-not-fit", "noise-understated")
WORST_FIRST: tuple[Verdict, ...] = ("does-not-fit", "noise-understated", "noise-overstated", "fits", "not-judged")


@dataclass(frozen=True)
class ResidualSize:
    """The residual of one output. ratio: its power over that of the noise, per degree of freedom.

    low, high: between them the ratio is what chance allows; noise: the standard deviation stated or, where none was, the scatter from
    row to row, in the output's unit; None where there is neither. white: whether the residual has no significant
    autocorrelation. record: the experiment that alone shows it; empty where it is shown by all together.
    """

    ratio: float | None
    low: float
    high: float
    noise: float | None
    white: bool
    verdict: Verdict
    record: str = ""

    @property
    def follows(self) -> bool | None:
        """Return whether the model follows the record to its noise; None where no noise is known but the residual's own."""
        return None if self.verdict == "not-judged" else self.verdict not in TOO_LARGE

    @property
    def times(self) -> float | None:
        """Return the residual as a multiple of the noise."""
        return None if self.ratio is None else float(np.sqrt(self.ratio))


@dataclass(frozen=True)
class Adequacy:
    """The verdict on the size of the residuals.

    verdict: fits; does-not-fit; noise-understated (white residuals above the noise stated: not the mark of a wrong model);
    noise-overstated; not-judged (no noise is known but the residual's own). chi2_per_dof: over all outputs, against the noise
    stated. outputs: by output, of all its records together, or of one that alone is above its noise. signals: by output and
    experiment. text: the verdict in words, empty where it fits; next: what to do, the first thing first.
    systematic: whether a residual is more than a noise that is known: the model lacks something, which moves the estimates by
    what no residual tells. Rows alone do not tell correlated noise from that. foretold: by output of which no noise is known how many
    times the residual is what earlier rows do not foretell of it, where that is less than half of its power.
    """

    verdict: Verdict
    chi2_per_dof: float | None = None
    outputs: FrozenMap[ResidualSize] = field(default_factory=FrozenMap)
    text: str = ""
    next: tuple[NextStep, ...] = ()
    systematic: bool = False
    signals: FrozenMap[FrozenMap[ResidualSize]] = field(default_factory=FrozenMap)
    foretold: FrozenMap[float] = field(default_factory=FrozenMap, metadata=NOT_STORED)

    @property
    def structure(self) -> FrozenMap[float]:
        """By output how many times the residual is what can be white noise in it, where more than half of its power is not.

        White noise is what was stated or, where nothing was, the scatter from row to row, and where no rows show that, what earlier
        rows of the residual do not foretell of it. Of noise that is not known this may be the noise's own colour.
        """
        times = {o: s.times for o, s in self.outputs.items() if s.verdict in TOO_LARGE and s.times is not None}
        return FrozenMap(times) | self.foretold

    @property
    def widening(self) -> float:
        """The factor of the estimates' variances that the excess of the residual over the noise stated calls for.

        The misfit then stands for the noise, as it does where none is stated; 1 where the residual is no larger.
        """
        return max(self.chi2_per_dof or 1.0, 1.0) if self.verdict in TOO_LARGE else 1.0


def adequacy(
    problem: Problem,
    blocks: Sequence[ResidualBlock],
    sources: Mapping[str, str],
    effective: Mapping[str, float],
    rho: Mapping[str, float],
) -> Adequacy:
    """Return the verdict on the residuals at an optimum of the problem.

    blocks: with residuals in units of sigma. By output: sources (`noise_source`), effective (independent samples), rho (the
    residuals' AR(1) coefficient, 0 where it is not significant).
    """
    samples = sum(b.residual.size for b in blocks)
    unknowns = len(problem.names)
    if samples <= unknowns:
        return Adequacy("not-judged", None, text="no more rows than unknowns: nothing is left to judge the fit by")
    share = 1.0 - unknowns / samples
    sizes: dict[str, ResidualSize] = {}
    signals: dict[str, FrozenMap[ResidualSize]] = {}
    scale = _Scale(share, 1.0 / max(len(problem.outputs), 1), 1.0 / len(blocks), robust=not problem.loss.linear)
    for output in problem.outputs:
        of_output = [b for b in blocks if b.output == output]
        reference = _reference(problem.fitted_experiments, output, of_output, sources[output], problem.noise_dof)
        records = {b.experiment: (b.residual, b.sigma) for b in of_output}
        sizes[output], signals[output] = _sizes(records, reference, effective[output], rho[output], scale)
    known = [b for b in blocks if not from_misfit(sources[b.output])]
    power = sum(scale.power(b.residual) * b.residual.size for b in known)
    chi2 = power / (sum(b.residual.size for b in known) * share) if known else None
    verdict = min((s.verdict for s in sizes.values()), key=WORST_FIRST.index)
    systematic = any(s.verdict == "does-not-fit" and not from_misfit(sources[o]) for o, s in sizes.items())
    foretold = _foretold([o for o, s in sizes.items() if s.verdict == "not-judged"], blocks)
    text, advice = _sentence(sizes, verdict, sources, foretold, systematic=systematic)
    return Adequacy(verdict, chi2, FrozenMap(sizes), text, advice, systematic, FrozenMap(signals), foretold)


def _foretold(outputs: Sequence[str], blocks: Sequence[ResidualBlock]) -> FrozenMap[float]:
    """Return, by output, `foretold` of an `Adequacy`."""
    foretold = {}
    for output in outputs:
        parts = [b.residual[part] for b in blocks if b.output == output for part in b.stretches]
        share = innovation_share(autoregression([r - r.mean() for r in parts]))
        if share * MATTERS < 1.0:
            foretold[output] = 1.0 / math.sqrt(share)
    return FrozenMap(foretold)


def structure_text(foretold: Mapping[str, float]) -> str:
    """Return in words what a residual leaves of which no noise is known; empty where nothing. foretold: as of an `Adequacy`."""
    return "; ".join(
        f"the residual of {o} is {times_text(times)} what its earlier rows do not foretell: a better optimum may exist, the model may "
        "lack something, or the noise is correlated"
        for o, times in foretold.items()
    )


def sizes_of_runs(
    curves: Mapping[str, Mapping[str, Curve]], experiments: Sequence[Experiment]
) -> dict[str, FrozenMap[ResidualSize]]:
    """Return the size of the residuals of runs that no fit has judged, by output and experiment, by the rule of a fit's.

    curves: by experiment and output.
    """
    by_name = {e.name: e for e in experiments}
    outputs = dict.fromkeys(o for line in curves.values() for o in line)
    scale = _Scale(1.0, 1.0 / max(len(outputs), 1), 1.0 / max(sum(map(len, curves.values())), 1))
    sizes = {}
    for output in outputs:
        line = {e: c[output] for e, c in curves.items() if output in c}
        of_output = [by_name[e] for e in line]
        known = source_of(of_output, output) == GIVEN
        behind = min((e.noise_dof.get(output, np.inf) for e in of_output), default=np.inf)
        sigma = _rms([c.sigma for c in line.values()], [c.rows.size for c in line.values()]) if known else None
        reference = _Reference(sigma, behind) if known else _scatter(of_output, output)
        records = {e: (c.residual, c.sigma) if known else (c.misfit, 1.0) for e, c in line.items()}
        rho, effective = independent_samples(
            [records[e][0][part] for e, c in line.items() for part in stretches(c.rows)], 0.0
        )
        sizes[output] = _sizes(records, reference, effective, rho, scale)[1]
    return sizes


@dataclass(frozen=True)
class _Reference:
    """The noise that the residual of an output is held against.

    noise: a standard deviation, in the unit, None where there is none; behind: the independent samples that it rests on. known:
    whether it is known apart from these rows, and the residual is in units of it already. exact: the output is met so well that nothing
    of it is noise.
    """

    noise: float | None
    behind: float = np.inf
    known: bool = True
    exact: bool = False

    def of(self, sigma: float) -> _Reference:
        """Return the reference of one record, with the standard deviation sigma, in the unit."""
        return replace(self, noise=sigma) if self.known else self

    def scaled(self, residual: Array, sigma: float) -> Array:
        """Return the residual, which is in units of sigma, in units of the noise."""
        return residual if self.known or self.noise is None else residual * sigma / self.noise


@dataclass(frozen=True)
class _Scale:
    """The scale of a judgement.

    share: of the rows that the unknowns leave free. together, alone: shares of the chance of an error that the judgement of an output,
    and of a single record, may take. robust: whether outliers are no misfit.
    """

    share: float
    together: float
    alone: float
    robust: bool = False

    def power(self, residual: Array) -> float:
        """Return the mean squared residual; by the median where outliers are not noise."""
        if self.robust:
            return (MAD_TO_STD * float(np.median(np.abs(residual)))) ** 2
        return float(np.mean(residual**2))


def _reference(
    experiments: Sequence[Experiment], output: str, blocks: Sequence[ResidualBlock], source: str, behind: float
) -> _Reference:
    """Return the reference of an output by the source of its noise (`noise_source`)."""
    if not from_misfit(source):
        return _Reference(_rms([b.sigma for b in blocks], [b.residual.size for b in blocks]), behind)
    if source != MISFIT:
        return _Reference(None, known=False, exact=True)
    return _scatter(experiments, output)


def _scatter(experiments: Sequence[Experiment], output: str) -> _Reference:
    """Return the scatter of an output from row to row as the reference."""
    scatter = scatter_of(experiments, output)
    return _Reference(None, known=False) if scatter is None else _Reference(*scatter, known=False)


def _rms(deviations: Sequence[float], rows: Sequence[int]) -> float:
    """Return the root mean square of deviations of so many rows each."""
    return float(np.sqrt(np.average(np.square(deviations), weights=rows)))


def _sizes(
    records: Mapping[str, tuple[Array, float]],
    reference: _Reference,
    effective: float,
    rho: float,
    scale: _Scale,
) -> tuple[ResidualSize, FrozenMap[ResidualSize]]:
    """Return the size of an output's residual, and that in each of its records.

    records: by experiment the residual, and the standard deviation that it is in units of. A record can be too large by itself.
    Where only all of them together are, those are that have `MATTERS` times the noise: at least one has.
    """
    residuals = {e: reference.scaled(residual, sigma) for e, (residual, sigma) in records.items()}
    together = np.concatenate(list(residuals.values()))
    whole = _size(together, reference, effective, rho, scale, LEVEL * scale.together)
    signals = {}
    for name, residual in residuals.items():
        own = effective * residual.size / together.size
        size = _size(residual, reference.of(records[name][1]), own, rho, scale, LEVEL * scale.alone)
        if size.verdict == "fits" and whole.verdict in TOO_LARGE and size.ratio is not None and size.ratio > MATTERS:
            size = replace(size, verdict=whole.verdict)
        signals[name] = replace(size, record=name)
    worst = max(signals.values(), key=lambda s: (s.verdict in TOO_LARGE, s.ratio or 0.0))
    alone = worst.verdict in TOO_LARGE and whole.verdict not in TOO_LARGE
    return worst if alone else whole, FrozenMap(signals)


def _size(
    residual: Array, reference: _Reference, effective: float, rho: float, scale: _Scale, level: float
) -> ResidualSize:
    """Return the size of a residual in units of the noise. level: the chance of a verdict against the model or the noise."""
    white = rho == 0.0
    if reference.noise is None:
        return ResidualSize(None, 0.0, np.inf, None, white, "fits" if reference.exact else "not-judged")
    effective, share = _independent(residual.size, effective, rho), scale.share
    spare = max(effective - residual.size * (1.0 - share), 1.0)
    ratio = scale.power(residual) / share
    high = max(MATTERS, _quantile(spare, reference.behind, 1.0 - level))
    # Of few independent samples the unknowns take a larger share than of the rows.
    low = min(1.0 / MATTERS, _quantile(spare, reference.behind, level) * spare / (effective * share))
    verdict: Verdict = "fits"
    if ratio > high:
        verdict = "noise-understated" if white and reference.known else "does-not-fit"
    elif ratio < low and reference.known:
        verdict = "noise-overstated"
    return ResidualSize(ratio, low, high, reference.noise, white, verdict)


def _independent(rows: int, effective: float, rho: float) -> float:
    """Return the number of independent samples in so many rows, effective ones by the estimate rho of their coefficient.

    Of correlated rows it is taken at the upper end of rho's interval: artanh of it has a standard error of 1/sqrt(rows)
    (Fisher).
    """
    if rho == 0.0:
        return max(effective, 1.0)
    upper = float(np.tanh(np.arctanh(min(rho, 1.0 - 1e-9)) + 3.0 / np.sqrt(rows)))
    return max(min(effective, rows * (1.0 - upper) / (1.0 + upper)), 1.0)


def _quantile(dof: float, behind: float, chance: float) -> float:
    """Return the F quantile of dof and `behind` degrees of freedom; an infinite number of them is a large one."""
    return float(fdtri(dof, min(behind, 1e9), chance))


def _sentence(
    sizes: Mapping[str, ResidualSize],
    verdict: Verdict,
    sources: Mapping[str, str],
    foretold: Mapping[str, float],
    *,
    systematic: bool,
) -> tuple[str, tuple[NextStep, ...]]:
    """Return the verdict in words, and what to do."""
    parts = [_line(o, s, sources[o]) for o, s in sizes.items() if s.verdict == verdict]
    text = "; ".join(p for p in (structure_text(foretold), *parts) if p)
    if verdict == "does-not-fit":
        return f"{text}: {MOVED if systematic else CORRELATED}", (NextStep("diagnose"),)
    values = ", ".join(
        f"{o} = {s.noise * s.times:.3g}" for o, s in sizes.items() if s.verdict == verdict and s.noise and s.times
    )
    if verdict == "noise-understated":
        return text, (NextStep("raise-noise", values), NextStep("diagnose"))
    if verdict == "noise-overstated":
        return text, (NextStep("lower-noise", values),)
    return text, ()


def _line(output: str, size: ResidualSize, source: str) -> str:
    """Return the sentence on one output."""
    if size.verdict == "fits" and size.ratio is None:
        return f"{output} is met to {FLOOR_SHARE:g} of its range, and the intervals are of what is left below that"
    if size.verdict == "not-judged" or size.times is None or size.ratio is None:
        return (
            f"the noise of {output} is taken from the fit's own residual, which then cannot tell whether the model fits"
        )
    where = f"{output} in '{size.record}'" if size.record else output
    kind = "stated" if source == GIVEN else "row-to-row" if from_misfit(source) else "estimated"
    ratio = f"chi2/dof {size.ratio:.3g}"
    if size.times == 0.0:
        return f"the residual of {where} is 0: nothing of the {kind} noise is in these rows ({ratio})"
    if size.verdict == "noise-overstated":
        return f"the {kind} noise of {output} is {times_text(1.0 / size.times)} what the residual shows ({ratio})"
    if size.verdict == "noise-understated":
        return (
            f"the residual of {where} is white and {times_text(size.times)} the {kind} noise ({ratio}): that noise is too "
            "small, or the model lacks something too fast for these rows to show"
        )
    if size.verdict == "does-not-fit":
        return f"the residual of {where} is {times_text(size.times)} the {kind} noise ({ratio})"
    return ""


@dataclass(frozen=True)
class Whiteness:
    """Ljung and Box's statistic over so many lags, with its p."""

    statistic: float | None
    lags: int
    p: float | None


@dataclass(frozen=True)
class RunsTest:
    """The number of runs of one sign against the number that chance gives, with its p."""

    runs: int
    expected: float | None
    p: float | None


@dataclass(frozen=True)
class InputCorrelation:
    """The largest correlation of a residual with an input, its lag in rows, the input leading, and the p of all lags."""

    correlation: float | None
    lag: int | None
    p: float | None


@dataclass(frozen=True)
class ResidualTest:
    """The tests of one residual; mean and std in sigma. p is the chance of such a value from white noise, None where not defined."""

    n: int
    mean: float
    std: float
    ljung_box: Whiteness
    runs: RunsTest
    inputs: Mapping[str, InputCorrelation]


ResidualTests = Mapping[str, Mapping[str, ResidualTest]]
"""Tests by output and experiment."""


def residual_tests(
    blocks: Sequence[ResidualBlock], experiments: Sequence[Experiment]
) -> dict[str, dict[str, ResidualTest]]:
    """Return the tests by output and experiment."""
    by_name = {e.name: e for e in experiments}
    table: dict[str, dict[str, ResidualTest]] = {}
    for block in blocks:
        r, experiment = block.residual, by_name[block.experiment]
        inputs = {n: signal(experiment.time)[block.rows] for n, signal in experiment.inputs.items()}
        table.setdefault(block.output, {})[block.experiment] = ResidualTest(
            int(r.size),
            float(r.mean()),
            float(r.std()),
            ljung_box(r, parts=block.stretches),
            runs(r),
            {n: cross_correlation(r, u) for n, u in inputs.items() if np.ptp(u) > 0},
        )
    return table


def ljung_box(r: Array, parts: Sequence[slice] = ()) -> Whiteness:
    """Return Ljung and Box's (1978) statistic over the first 10 lags, or a fifth of the rows, with its p.

    parts: stretches of rows between which some are missing; none for one stretch.
    """
    n = r.size
    lags = min(10, n // 5)
    centred = r - r.mean()
    power = float(centred @ centred)
    if lags < 1 or power == 0.0:
        return Whiteness(None, lags, None)
    records = [centred[part] for part in parts] or [centred]
    acf = np.array([sum(float(c[k:] @ c[:-k]) for c in records) / power for k in range(1, lags + 1)])
    statistic = float(n * (n + 2) * np.sum(acf**2 / (n - np.arange(1, lags + 1))))
    return Whiteness(statistic, lags, float(chdtrc(lags, statistic)))


def runs(r: Array) -> RunsTest:
    """Return the number of runs of one sign against what chance gives (Wald and Wolfowitz 1940), with its two-sided p."""
    signs = np.sign(r)
    signs = signs[signs != 0]
    up, down = int((signs > 0).sum()), int((signs < 0).sum())
    count = int(1 + (np.diff(signs) != 0).sum()) if signs.size else 0
    n = up + down
    if not up or not down or n < 3:
        return RunsTest(count, None, None)
    expected = 1.0 + 2.0 * up * down / n
    variance = (expected - 1.0) * (expected - 2.0) / (n - 1.0)
    if variance <= 0:
        return RunsTest(count, expected, None)
    return RunsTest(count, expected, math.erfc(abs(count - expected) / math.sqrt(2.0 * variance)))


def cross_correlation(r: Array, u: Array) -> InputCorrelation:
    """Return the largest correlation of the residual with the same or an earlier input row, its lag, and the p of all lags.

    Both are first filtered by their own AR(1) coefficient, so that two slow signals do not count as related; the
    statistic n sum(ccf^2) over lags 0 to 20 (or a fifth of the rows) is chi-square (Box and Jenkins, section 11.3).
    """
    n = r.size
    lags = min(20, n // 5)
    a, b = _innovation(r), _innovation(u)
    power = math.sqrt(float(a @ a) * float(b @ b))
    if power == 0.0 or n < 5:
        return InputCorrelation(None, None, None)
    ccf = np.array([float(a[k:] @ b[: b.size - k]) / power for k in range(lags + 1)])
    lag = int(np.argmax(np.abs(ccf)))
    return InputCorrelation(float(ccf[lag]), lag, float(chdtrc(lags + 1, n * float(ccf @ ccf))))


def _innovation(signal: Array) -> Array:
    """Return the signal less its mean, filtered by its own AR(1) coefficient."""
    centred = signal - signal.mean()
    power = float(centred @ centred)
    rho = float(centred[1:] @ centred[:-1]) / power if power else 0.0
    return centred[1:] - rho * centred[:-1]
