"""Estimation of parameters from experiments, for anything that can be simulated.

`fit` solves a `Problem`: the parameters to estimate, the experiments, the noise. `fit_each` and `fit_individually` fit parts
of it. Profile likelihoods and uncertainties are in modules of their own.
"""

from typing import TYPE_CHECKING

from hvdc_ident.lazy import offered

if TYPE_CHECKING:
    from hvdc_ident.fit.estimate import fit
    from hvdc_ident.fit.fit_parameter import FitParameter
    from hvdc_ident.fit.optimiser import Optimiser, OptimiserResult
    from hvdc_ident.fit.partial_fits import Group, fit_each, fit_individually
    from hvdc_ident.fit.problem import Problem
    from hvdc_ident.fit.result import Estimate, FitResult, StartOutcome
    from hvdc_ident.fit.simulator import SimulationRun, Simulator
else:
    __getattr__ = offered(
        __name__,
        {
            "estimate": "fit",
            "fit_parameter": "FitParameter",
            "optimiser": "Optimiser OptimiserResult",
            "partial_fits": "Group fit_each fit_individually",
            "problem": "Problem",
            "result": "Estimate FitResult StartOutcome",
            "simulator": "SimulationRun Simulator",
        },
    )

__all__ = [
    "Estimate",
    "FitParameter",
    "FitResult",
    "Group",
    "Optimiser",
    "OptimiserResult",
    "Problem",
    "SimulationRun",
    "Simulator",
    "StartOutcome",
    "fit",
    "fit_each",
    "fit_individually",
]
