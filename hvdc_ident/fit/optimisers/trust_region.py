"""Bounded Levenberg-Marquardt on exact sensitivities, with a verdict on where it ended.

A run that cannot begin, or whose cost hardly falls from far off, as where a simulation grows without bounds or loses the record's
phase, goes on from where the records' first quarters lead it: over a shorter time a model's answer grows less, and is closer to a linear
one in its parameters.

A run that stands still although the sensitivities promise a fall has met the simulation's own error, or a jump: the scatter of
the cost over tiny steps tells which.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.fit.descent import LEAST_DAMPING, Descent, DescentEnd, DescentOptions
from hvdc_ident.fit.noise import MISFIT
from hvdc_ident.fit.nonsmooth import LUCK, RUNS, roughness, scatter_along
from hvdc_ident.fit.optimiser import OptimiserResult, OptimiserStatus
from hvdc_ident.fit.problem import Problem, shortened
from hvdc_ident.fit.simulator import approximate

NAME = "trust-region"
SUMMARY = "bounded Levenberg-Marquardt with exact sensitivities"

FIRST_PART = 0.25
"""Share of the records' time after their events that a run from far off begins with; again and again a share of that, as needed."""
PROBE = 1e-9
"""Length in scaled coordinates of the tiny step along which the scatter of the cost is estimated."""


@dataclass(frozen=True)
class TrustRegion(DescentOptions):
    """Options of the method, those of a descent."""

    def run(self, problem: Problem, start: Array) -> OptimiserResult:
        """Return the end of the run from `start`: converged, max-evaluations, stalled, flat, or failed with the reason."""
        down = Descent(problem, self, noise_cost=_noise_cost(problem))
        end = down.go(start)
        if end in ("crawling", "inadmissible"):
            down, end = self._from_first_part(problem, start, down, end)
        verdicts: dict[str, tuple[OptimiserStatus, str]] = {
            "inadmissible": ("failed", f"the start cannot be simulated: {down.failure}"),
            "flat": ("flat", "no compared output answers to any of the unknowns there"),
            "stationary": ("converged", "the gradient is zero"),
            "settled": ("converged", "the cost does not fall any more"),
            "enough": ("converged", "no fall of the cost worth a step is left"),
            "spent": ("max-evaluations", f"no optimum within {self.max_evaluations} evaluations"),
        }
        status, message = verdicts[end] if end in verdicts else _standstill(down, problem)
        if down.at is None:
            return OptimiserResult(np.asarray(start, dtype=float), None, status, message, down.evaluations)
        return OptimiserResult(down.at.theta, down.at.cost, status, message, down.evaluations)

    def _from_first_part(
        self, problem: Problem, start: Array, first: Descent, end: DescentEnd
    ) -> tuple[Descent, DescentEnd]:
        """Return the descent from where the records' first part leads and its end, else the first one, gone on with where it crawled."""
        used = first.evaluations
        if (short := shortened(problem, FIRST_PART)) is not None:
            led = self.run(short, start)
            used += led.evaluations
            if led.cost is not None:
                # What a short record does not tell may be anywhere within its bounds: the descent may have to come back from there.
                down = Descent(problem, self, evaluations=used)
                end_of_second = down.go(led.theta)
                if down.at is not None and (first.at is None or down.at.cost < first.at.cost):
                    return down, end_of_second
                used = down.evaluations
        if first.at is None:
            return first, end
        down = Descent(problem, self, evaluations=used)
        return down, down.go(first.at.theta)


OPTIMISER = TrustRegion


def _noise_cost(problem: Problem) -> float | None:
    """Return half the number of rows, the cost of their noise alone; None where the noise is not known."""
    return None if MISFIT in problem.noise_source.values() or not problem.loss.linear else 0.5 * problem.rows


def _standstill(down: Descent, problem: Problem) -> tuple[OptimiserStatus, str]:
    """Return the outcome where steps are too small to count: an optimum, a failing region or a gradient that does not fit."""
    if down.failure:
        return "failed", f"every step down leads to where the simulation fails: {down.failure}"
    here = down.at
    assert here is not None
    low, high = down.room()
    p = here.step(LEAST_DAMPING, here.norms, low, high)
    promise = here.predicted(p)
    if promise <= 1e-4 * here.cost + 1e-12 * here.r.size:
        return "converged", "no smaller step lowers the cost"
    # Adaptive steps of an integrator make the cost jump from one parameter value to the next, however close they are.
    error = scatter_along(problem, here.theta, here.r, PROBE * p / np.abs(p).max())
    down.evaluations += RUNS
    if promise > LUCK * error and approximate(
        problem.simulator
    ):  # smooth near a local minimum, and nonsmooth beyond it
        error = max(error, roughness(problem, here.theta))
        down.evaluations += RUNS
    if promise <= LUCK * error:
        return "converged", f"no step lowers the cost by more than its own scatter there ({error:.2g})"
    return "stalled", "the sensitivities promise a lower cost that no step reaches (a jump, or their error)"
