"""From a model to trajectories with exact sensitivities."""

from hvdc_ident.simulate.engine import Engine, Tolerance, engine, simulate
from hvdc_ident.simulate.result import Simulation, Statistics

__all__ = ["Engine", "Simulation", "Statistics", "Tolerance", "engine", "simulate"]
