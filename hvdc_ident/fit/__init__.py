"""Estimation of parameters from experiments: a fit over the set it is given, for anything that can be simulated."""

from hvdc_ident.fit.estimate import fit
from hvdc_ident.fit.individual import Group, fit_individually
from hvdc_ident.fit.optimiser import Optimiser, OptimiserResult
from hvdc_ident.fit.per_experiment import fit_each
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.result import Estimate, FitResult, StartOutcome
from hvdc_ident.fit.simulator import Simulation, Simulator
from hvdc_ident.fit.unknown import Free

__all__ = [
    "Estimate",
    "FitResult",
    "Free",
    "Group",
    "Optimiser",
    "OptimiserResult",
    "Problem",
    "Simulation",
    "Simulator",
    "StartOutcome",
    "fit",
    "fit_each",
    "fit_individually",
]
