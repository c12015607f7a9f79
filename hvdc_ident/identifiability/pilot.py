"""The pilot fit: the optimum at which the verdicts stand, and what is known there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.errors import FitError, SimulationError
from hvdc_ident.executor import Executor, Progress
from hvdc_ident.fit import Problem, fit
from hvdc_ident.fit.adequacy import adequacy
from hvdc_ident.fit.multistart import misfit_weights
from hvdc_ident.fit.noise_model import GIVEN, MISFIT, from_misfit, source_of
from hvdc_ident.fit.nonsmooth import Trend
from hvdc_ident.fit.objective import LeastSquares, descend
from hvdc_ident.fit.residual import ResidualBlock
from hvdc_ident.fit.result import FitResult
from hvdc_ident.fit.simulator import sensitivity_error, unknown_of
from hvdc_ident.fit.uncertainty import Uncertainty, uncertainty
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.sensitivity import Information


@dataclass(frozen=True, eq=False)
class Optimum:
    """A problem at its optimum theta, (p,), each unknown in its unit."""

    problem: Problem
    theta: Array
    trend: Trend | None = None  # where the cost is rough, and this the optimum of its trend

    @property
    def names(self) -> tuple[str, ...]:
        """The free parameters, without the nuisances."""
        return tuple(f.name for f in self.problem.free)

    @property
    def error(self) -> float:
        """The relative error of the sensitivities."""
        return sensitivity_error(self.problem.simulator)

    @cached_property
    def blocks(self) -> tuple[ResidualBlock, ...]:
        """Residuals and derivatives there."""
        return self.problem.blocks(self.theta)

    @cached_property
    def cost(self) -> float:
        """Half the sum of squared residuals."""
        return sum(0.5 * float(b.residual @ b.residual) for b in self.blocks)

    @cached_property
    def slope(self) -> Array:
        """(p,): length of a scaled coordinate's unit: the value where a parameter is positive, else the range."""
        rows = [v if u.min > 0 else u.span for u, v in zip(self.problem.unknowns, self.theta, strict=True)]
        return np.array(rows, dtype=float)

    @cached_property
    def columns(self) -> Array:
        """(n, p): whitened sensitivities in scaled coordinates, nuisances last."""
        return np.vstack([b.jacobian for b in self.blocks]) * self.slope

    @cached_property
    def information(self) -> Information:
        """On the parameters, the nuisances of each experiment marginalised."""
        from hvdc_ident.sensitivity import marginal

        k = len(self.problem.free)
        matrices: dict[str, Array] = {}
        for b in self.blocks:
            scaled = b.jacobian * self.slope
            matrices[b.experiment] = matrices.get(b.experiment, 0.0) + scaled.T @ scaled
        kept = {e: marginal(f, range(k)) if f.shape[0] > k else f for e, f in matrices.items()}
        return Information(self.names, FrozenMap(kept))

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """What the curvature says, corrected for correlated samples."""
        source = {o: source_of(self.problem.fitted_experiments, o) for o in self.problem.outputs}
        spans = np.array([u.span for u in self.problem.unknowns])
        known = uncertainty(self.blocks, self.problem.names, spans, source, noise_dof=self.problem.noise_dof)
        return known.on_trend(self.trend, self.problem.names)

    @property
    def deterministic(self) -> tuple[str, ...]:
        """Outputs whose standard deviation is the misfit's, for their noise is not known."""
        experiments = self.problem.fitted_experiments
        return tuple(o for o in self.problem.outputs if source_of(experiments, o) == MISFIT)

    @cached_property
    def misfit(self) -> float:
        """Mean squared residual per degree of freedom: 1 where the model explains the data down to given noise."""
        n = sum(b.residual.size for b in self.blocks)
        return 2.0 * self.cost / max(n - self.theta.size, 1)

    @cached_property
    def excess(self) -> float:
        """The misfit where `fit.adequacy` calls it larger than the noise told, else 1; 1 without noise."""
        known = self.uncertainty
        sources = {o: source_of(self.problem.fitted_experiments, o) for o in self.problem.outputs}
        return adequacy(self.problem, self.blocks, sources, known.effective, known.rho).widening

    def value(self, name: str) -> float:
        """The value of an unknown, in its unit."""
        return float(self.theta[self.problem.names.index(name)])

    def held(self, why: Mapping[str, str], values: Mapping[str, float]) -> Optimum:
        """The optimum with some parameters held, found from this one; what at is in its problem.

        values: what they are to be held at. Where the rest cannot be simulated there, they stay at their best values.
        Raises FitError where nothing is left to fit.
        """
        left = tuple(f for f in self.problem.free if f.name not in why)
        if not left:
            raise FitError("nothing is left to fit", got=f"{', '.join(why)} held")
        theta = np.array([v for n, v in zip(self.problem.names, self.theta, strict=True) if n not in why])

        def moved(to: Mapping[str, float]) -> Optimum:
            fewer = replace(self.problem, free=left, held=self.problem.held | to, why=self.problem.why | why)
            end = descend(LeastSquares.of(fewer), theta, np.zeros(theta.size, dtype=bool), enough=1e-6)
            return Optimum(fewer, end.theta)

        try:
            return moved(values)
        except SimulationError:
            return moved({n: self.value(n) for n in why})


def pilot(
    problem: Problem,
    *,
    starts: int = 8,
    seed: int = 0,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> tuple[Optimum, FitResult]:
    """The best optimum of a multistart over the whole set of unknowns, with the weights of the misfit where needed.

    Raises SimulationError, with the experiment's name, where no start could be simulated.
    """
    result = fit(problem, starts=starts, seed=seed, executor=executor, progress=progress, assess=False)
    if result.status == "failed":
        raise _failure(problem, result.message)
    weights = {
        o: next(s[o] for s in result.sigma.values() if o in s)
        for o, source in result.noise_source.items()
        if from_misfit(source)
    }
    weighted = problem.with_(weights={**problem.weights, **weights})
    theta = [result.values[f.name] for f in problem.free]
    theta += [result.nuisance[e.name][n].value for e in problem.fitted_experiments for n in e.nuisance]
    assert len(theta) == len(weighted.names)
    return Optimum(weighted, np.array(theta, dtype=float)), result


def unfitted(problem: Problem) -> tuple[Optimum, FitResult]:
    """The given values in place of an optimum, where the structure leaves no candidate to fit.

    Standard deviations that are not given are the misfit's there. Raises SimulationError as `pilot` does.
    """
    message = "no pilot fit, for the structure leaves no candidate to fit"
    try:
        weights = misfit_weights(problem, problem.given, _not_given(problem))
    except SimulationError as error:
        raise _failure(problem, str(error)) from None
    weighted = problem.with_(weights={**problem.weights, **weights})
    source = FrozenMap({o: source_of(problem.fitted_experiments, o) for o in problem.outputs})
    result = FitResult("failed", message, (), FrozenMap(), FrozenMap(problem.held), noise_source=source)
    return Optimum(weighted, problem.given), result


def _not_given(problem: Problem) -> list[str]:
    """The outputs whose standard deviation is not given."""
    return [o for o in problem.outputs if source_of(problem.fitted_experiments, o) != GIVEN]


def failing(problem: Problem) -> dict[str, SimulationError]:
    """The experiments that cannot be simulated at the start values, each with its error."""
    found = {}
    for e in problem.fitted_experiments:
        alone = problem.with_(experiments=[e])
        try:
            alone.cost(alone.start)
        except SimulationError as error:
            found[e.name] = error
    return found


def _failure(problem: Problem, message: str) -> SimulationError:
    """The error that says which experiments cannot be simulated, and why the first cannot."""
    bad = failing(problem)
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


__all__ = ["Optimum", "failing", "pilot", "unfitted", "unknown_of"]
