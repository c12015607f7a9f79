"""Another method's end, followed by the package's own least squares: what is said about an optimum is said at one."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.fit.optimiser import Optimiser, OptimiserResult
from hvdc_ident.fit.optimisers.trust_region import TrustRegion
from hvdc_ident.fit.problem import Problem


@dataclass(frozen=True)
class Refined:
    """A method, then a trust region from where it ended.

    Covariances, bounds and profiles need the optimum itself; methods without derivatives stop some way off. The message
    says what each of the two did.
    """

    method: Optimiser
    polish: TrustRegion = field(default_factory=TrustRegion)

    def run(self, problem: Problem, start: Array) -> OptimiserResult:
        """Where both together ended; the first method's failure stands where it found no admissible point."""
        first = self.method.run(problem, start)
        if first.cost is None:
            return first
        end = self.polish.run(problem, np.asarray(first.theta))
        used = first.evaluations + end.evaluations
        if end.cost is None:
            return OptimiserResult(first.theta, first.cost, "failed", f"{first.message}; {end.message}", used)
        fall = max(first.cost - end.cost, 0.0)
        message = f"{first.message}; then least squares lowered the cost by {fall:.3g}: {end.message}"
        return OptimiserResult(end.theta, end.cost, end.status, message, used)
