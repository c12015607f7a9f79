"""Chi2 at many sizes of one effect, with the other unknowns' answer to first order."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.nominal import of_held_out, orthonormal
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import Problem
from hvdc_ident.model import AnyModel
from hvdc_ident.simulate import ModelSimulator, Tolerance

BENT = 30
"""Sizes of an effect that need not be met to the last digit, evenly in the logarithm: a refit goes the rest of the way."""
PATIENT = Tolerance(rtol=1e-5, atol=1e-8, max_steps=5000)
"""Of runs at many sizes: one that takes more steps, chattering in a loop, is passed over."""


@dataclass(frozen=True, eq=False)
class SizeLine:
    """Chi2 by the size that stands at one place among the unknowns, with what the others can make good of the fitted data taken
    out to first order.

    held: the problem of the held-out data, where there are any. others: (N, k) orthonormal, what the unknowns can make good.
    """

    problem: Problem
    held: Problem | None
    theta: Array
    at: int
    others: Array

    @classmethod
    def of(cls, model: AnyModel, problem: Problem, theta: Array, at: int) -> SizeLine:
        """The line through theta. Raises SimulationError where the model does not run there."""
        quick = replace(problem, simulator=ModelSimulator(model, PATIENT))
        jacobian = np.vstack([b.jacobian for b in problem.blocks(theta)])
        return cls(quick, of_held_out(quick), theta, at, orthonormal(np.delete(jacobian, at, axis=1)))

    def left(self, size: float) -> float:
        """Chi2 on all data; infinite for a size that could not be run."""
        return self.fitted(size) + self.unseen(size)

    def fitted(self, size: float) -> float:
        """Chi2 on the fitted data; infinite for a size that could not be run."""
        try:
            r = np.concatenate([b.residual for b in self.problem.blocks(self._at(size), derivatives=False)])
        except SimulationError:
            return np.inf
        return float(r @ r - np.sum((self.others.T @ r) ** 2))

    def unseen(self, size: float) -> float:
        """Chi2 on the held-out data; 0 where there are none, infinite for a size that could not be run."""
        if self.held is None:
            return 0.0
        try:
            further = self.held.blocks(self._at(size)[: len(self.held.free)], derivatives=False)
        except SimulationError:
            return np.inf
        return sum(float(b.residual @ b.residual) for b in further if b.output in self.problem.outputs)

    def _at(self, size: float) -> Array:
        """The unknowns with another size of the effect."""
        theta = self.theta.copy()
        theta[self.at] = size
        return theta
