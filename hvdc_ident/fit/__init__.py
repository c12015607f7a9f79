"""Estimation of parameters from experiments: a fit over the set it is given, for anything that can be simulated."""

from typing import TYPE_CHECKING

from hvdc_ident.lazy import offered

if TYPE_CHECKING:
    from hvdc_ident.fit.estimate import fit
    from hvdc_ident.fit.individual import Group, fit_individually
    from hvdc_ident.fit.optimiser import Optimiser, OptimiserResult
    from hvdc_ident.fit.per_experiment import fit_each
    from hvdc_ident.fit.problem import Problem
    from hvdc_ident.fit.result import Estimate, FitResult, StartOutcome
    from hvdc_ident.fit.simulator import SimulationRun, Simulator
    from hvdc_ident.fit.unknown import FitParameter
else:
    __getattr__ = offered(
        __name__,
        {
            "estimate": "fit",
            "individual": "Group fit_individually",
            "optimiser": "Optimiser OptimiserResult",
            "per_experiment": "fit_each",
            "problem": "Problem",
            "result": "Estimate FitResult StartOutcome",
            "simulator": "SimulationRun Simulator",
            "unknown": "FitParameter",
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
