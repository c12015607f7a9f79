"""The pilot fit, and the local analysis of a problem at a point: its optimum, or the given values before any search.

The analysis holds what follows from the residuals and their first derivatives: information, uncertainty, misfit. At the given
values it bounds the standard deviations from below (Cramer and Rao).
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from hvdc_ident.codec import NOT_STORED, Coded
from hvdc_ident.data import Array
from hvdc_ident.errors import FitError, SimulationError
from hvdc_ident.executor import Executor, Progress
from hvdc_ident.fit import Problem, fit
from hvdc_ident.fit.adequacy import MATTERS, Adequacy, adequacy
from hvdc_ident.fit.assessment import deviations_from_misfit
from hvdc_ident.fit.descent import descend
from hvdc_ident.fit.noise import GIVEN, MISFIT, from_misfit
from hvdc_ident.fit.nonsmooth import Trend
from hvdc_ident.fit.residual import ResidualBlock
from hvdc_ident.fit.result import FitResult, StartOutcome
from hvdc_ident.fit.search import misfit_weights
from hvdc_ident.fit.simulator import sensitivity_error
from hvdc_ident.fit.uncertainty import TWO_SIDED, Uncertainty, uncertainty
from hvdc_ident.identifiability.structural import combinations_of, parameter_directions, scaled_slope
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.sensitivity import Information, independent, marginal, standard_deviations
from hvdc_ident.text import listed, quantity

HALF_95 = math.sqrt(2.0 * TWO_SIDED)
"""Half the width of a normal distribution's central 95 %, in standard deviations."""


@dataclass(frozen=True, eq=False)
class LocalAnalysis:
    """A problem at a point theta, (p,), each unknown in its unit: the optimum of a fit, or the given values.

    All that follows from the residuals and their first derivatives there. trend: where the cost is rough, the trend of
    which the point is the optimum.
    """

    problem: Problem
    theta: Array
    trend: Trend | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters, without the nuisances."""
        return tuple(f.name for f in self.problem.free)

    @property
    def error(self) -> float:
        """Relative error of the sensitivities."""
        return sensitivity_error(self.problem.simulator)

    @cached_property
    def blocks(self) -> tuple[ResidualBlock, ...]:
        """Residuals and derivatives."""
        return self.problem.blocks(self.theta)

    @cached_property
    def cost(self) -> float:
        """Half the sum of squared residuals."""
        return sum(0.5 * float(b.residual @ b.residual) for b in self.blocks)

    @cached_property
    def slope(self) -> Array:
        """(p,): length of a scaled coordinate's unit: the value where a parameter is positive, else the range."""
        return scaled_slope(self.problem, self.theta)

    @cached_property
    def columns(self) -> Array:
        """(n, p): whitened sensitivities in scaled coordinates, nuisances last."""
        return np.vstack([b.jacobian for b in self.blocks]) * self.slope

    @cached_property
    def information(self) -> Information:
        """Fisher information on the parameters, the nuisances of each experiment marginalised."""
        k = len(self.problem.free)
        matrices: dict[str, Array] = {}
        for b in self.blocks:
            scaled = b.jacobian * self.slope
            matrices[b.experiment] = matrices.get(b.experiment, 0.0) + scaled.T @ scaled
        kept = {e: marginal(f, range(k)) if f.shape[0] > k else f for e, f in matrices.items()}
        return Information(self.names, FrozenMap(kept))

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Covariance from the curvature, corrected for correlated samples."""
        spans = np.array([u.span for u in self.problem.unknowns])
        known = uncertainty(
            self.blocks, self.problem.names, spans, self.problem.noise_source, noise_dof=self.problem.noise_dof
        )
        return known.on_trend(self.trend, self.problem.names)

    @property
    def deterministic(self) -> tuple[str, ...]:
        """Outputs whose standard deviation is the misfit's, for their noise is not known."""
        return tuple(o for o, source in self.problem.noise_source.items() if source == MISFIT)

    @cached_property
    def misfit(self) -> float:
        """Mean squared residual per degree of freedom: 1 where the model explains the data down to given noise."""
        n = sum(b.residual.size for b in self.blocks)
        return 2.0 * self.cost / max(n - self.theta.size, 1)

    @cached_property
    def adequacy(self) -> Adequacy:
        """The verdict on the size of the residuals."""
        known = self.uncertainty
        return adequacy(self.problem, self.blocks, self.problem.noise_source, known.effective, known.rho)

    @property
    def excess(self) -> float:
        """The misfit where it is larger than the noise told, else 1; 1 without noise."""
        return self.adequacy.widening

    def value(self, name: str) -> float:
        """The value of an unknown, in its unit."""
        return float(self.theta[self.problem.names.index(name)])

    def with_held(self, why: Mapping[str, str], values: Mapping[str, float]) -> LocalAnalysis:
        """Return the optimum with some parameters held, found from this one; its problem has the values they are held at.

        why: the reason by parameter. values: what they are to be held at; where the model cannot be simulated so, they stay
        at their best values.
        Raises FitError where nothing is left to fit.
        """
        remaining = tuple(f for f in self.problem.free if f.name not in why)
        if not remaining:
            raise FitError("nothing is left to fit", got=f"{', '.join(why)} held")
        theta = np.array([v for n, v in zip(self.problem.names, self.theta, strict=True) if n not in why])

        def moved(to: Mapping[str, float]) -> LocalAnalysis:
            reduced = replace(self.problem, free=remaining, held=self.problem.held | to, why=self.problem.why | why)
            end = descend(reduced, theta, enough=1e-6)
            return LocalAnalysis(reduced, end.theta)

        try:
            return moved(values)
        except SimulationError:
            return moved({n: self.value(n) for n in why})


def pilot_fit(
    problem: Problem,
    *,
    starts: int | None = None,
    seed: int = 0,
    begun: Sequence[StartOutcome] = (),
    executor: Executor | None = None,
    progress: Progress | None = None,
    misfit_expected: bool = False,
) -> tuple[LocalAnalysis, FitResult]:
    """Return the best optimum of a multistart over the whole set of unknowns, with the weights of the misfit where needed.

    starts, seed, begun, misfit_expected: as in `fit`. Raises SimulationError, with the experiment's name, where no start could be
    simulated.
    """
    result = fit(
        problem, starts=starts, seed=seed, executor=executor, progress=progress, assess=False, begun=begun,
        misfit_expected=misfit_expected,
    )  # fmt: skip
    if result.status == "failed":
        raise _failure(problem, result.message)
    weighted = problem.with_(weights=problem.weights | deviations_from_misfit(result))
    theta = [result.values[f.name] for f in problem.free]
    theta += [result.nuisance[e.name][n].value for e in problem.fitted_experiments for n in e.nuisance]
    assert len(theta) == len(weighted.names)
    return LocalAnalysis(weighted, np.array(theta, dtype=float)), result


def at_given_values(problem: Problem) -> tuple[LocalAnalysis, FitResult]:
    """Return the analysis at the given values in place of an optimum, where the structure leaves no candidate to fit.

    Standard deviations that are not given are the misfit's there. Raises SimulationError as `pilot_fit` does.
    """
    message = "no pilot fit, for the structure leaves no candidate to fit"
    try:
        unknown = [o for o, source in problem.noise_source.items() if source != GIVEN]
        weights = misfit_weights(problem, problem.given, unknown)
    except SimulationError as error:
        raise _failure(problem, str(error)) from None
    weighted = problem.with_(weights={**problem.weights, **weights})
    result = FitResult("failed", message, (), FrozenMap(), FrozenMap(problem.held), noise_source=problem.noise_source)
    return LocalAnalysis(weighted, problem.given), result


def failing_experiments(problem: Problem) -> dict[str, SimulationError]:
    """Return the experiments that cannot be simulated at the start values, each with its error."""
    errors = {}
    for e in problem.fitted_experiments:
        alone = problem.with_(experiments=[e])
        try:
            alone.cost(alone.start)
        except SimulationError as error:
            errors[e.name] = error
    return errors


def _failure(problem: Problem, message: str) -> SimulationError:
    """Return the error that says which experiments cannot be simulated, and why the first cannot."""
    bad = failing_experiments(problem)
    if not bad:
        return SimulationError("nothing can be told: the pilot fit failed", got=message, hint="other starts or bounds")
    first = next(iter(bad.values()))
    names = ", ".join(f"'{n}'" for n in bad)
    return SimulationError(
        f"nothing can be told: {first.what}",
        where=f"experiment{'s' if len(bad) > 1 else ''} {names}, at the start values",
        expected=first.expected,
        got=", ".join(t for t in (first.where.removeprefix(f"experiment '{next(iter(bad))}': "), first.got) if t),
        hint=f"other start values or bounds, or leave {'them' if len(bad) > 1 else 'it'} out; {first.hint}".rstrip(
            "; "
        ),
    )


@dataclass(frozen=True)
class CramerRaoBound:
    """Bound of one parameter, in its unit, at a value. std: beside the others, None where it is held, for these records do not tell it
    apart from others there, or not at all. conditional_on: for a member of a combination the members that are held."""

    value: float
    std: float | None
    unit: str
    conditional_on: tuple[str, ...] = ()


@dataclass(frozen=True)
class CramerRaoBounds(Coded):
    """Cramer and Rao's bounds at the given values: valid as far as the model is linear.

    parameters: by name. combinations: in words, what alone is seen of some. chi2_per_dof: of the misfit at the given values; None where
    no noise is known. seconds: what one evaluation with derivatives took.
    """

    parameters: FrozenMap[CramerRaoBound]
    combinations: tuple[str, ...]
    chi2_per_dof: float | None
    seconds: float = field(default=0.0, metadata=NOT_STORED)
    at: Literal["given"] = "given"

    @property
    def lines(self) -> list[str]:
        """Lines of text."""
        lines = ["First answer, from the curvature at the given values; the search for the optimum follows."]
        misses = self.chi2_per_dof is not None and self.chi2_per_dof > MATTERS
        if self.chi2_per_dof is not None:
            left = ": no interval holds there, and none is told" if misses else ""
            lines.append(f"Misfit of the given values: chi2/dof {self.chi2_per_dof:.3g}{left}.")
        width = max(map(len, self.parameters), default=0)
        for name, p in self.parameters.items():
            at = f"{name:{width}}  {quantity(p.value, p.unit)}"
            if p.std is None:
                lines.append(f"{at}: not determined there, held")
            elif misses:
                lines.append(
                    f"{at}: determined there" + (f" with {listed(p.conditional_on)} held" if p.conditional_on else "")
                )
            else:
                share = f" ({100.0 * HALF_95 * p.std / abs(p.value):.2g} %)" if p.value else ""
                held = f" with {listed(p.conditional_on)} held" if p.conditional_on else ""
                lines.append(
                    f"{at}: expected 95 % confidence interval \u00b1{quantity(HALF_95 * p.std, p.unit, 2)}{share}{held}"
                )
        return [*lines, *(f"{words[:1].upper()}{words[1:]}." for words in self.combinations)]


def cramer_rao_bounds(problem: Problem) -> CramerRaoBounds:
    """Return the local analysis of a fit's parameters at their given values; two evaluations with derivatives.

    Standard deviations that are not given are the misfit's there. Raises SimulationError where it cannot be made.
    """
    at, result = at_given_values(problem)
    begun = (
        time.perf_counter()
    )  # only now: the first evaluation also compiles the model and factors the covariance of its noise
    columns = at.columns
    seconds = time.perf_counter() - begun
    names, k = at.names, len(at.names)
    null = parameter_directions(columns, k, at.error)
    logs = [f.min > 0 for f in problem.free]
    combos = combinations_of(null, names, logs, at.theta[:k].tolist(), "practical")
    kept = independent(at.information.matrix, at.error)
    held = [n for i, n in enumerate(names) if i not in kept]
    std: dict[str, float | None] = dict.fromkeys(names)
    if kept:
        widths = standard_deviations(at.information.select([names[i] for i in kept]).matrix) * at.slope[list(kept)]
        std |= {names[i]: float(s) for i, s in zip(kept, widths, strict=True)}
    conditional = {
        n: tuple(m for m in held if any(m in c.members and n in c.members for c in combos))
        for n in names
        if n not in held and any(n in c.members for c in combos)
    }
    known = not any(from_misfit(s) for s in result.noise_source.values())
    units = {n: problem.simulator.parameters[n].unit for n in names}
    bounds = {n: CramerRaoBound(at.value(n), std[n], units[n], conditional.get(n, ())) for n in names}
    return CramerRaoBounds(FrozenMap(bounds), tuple(c.words for c in combos), at.misfit if known else None, seconds)
