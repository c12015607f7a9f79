"""From a model to trajectories with exact sensitivities."""

from typing import TYPE_CHECKING

from hvdc_ident.lazy import offered

if TYPE_CHECKING:
    from hvdc_ident.simulate.engine import Engine, Tolerance, simulate
    from hvdc_ident.simulate.result import Simulation, Statistics
else:
    __getattr__ = offered(__name__, {"engine": "Engine Tolerance simulate", "result": "Simulation Statistics"})

__all__ = ["Engine", "Simulation", "Statistics", "Tolerance", "simulate"]
