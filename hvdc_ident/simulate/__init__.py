"""From a model to trajectories with exact sensitivities."""

from typing import TYPE_CHECKING

from hvdc_ident.lazy import offered

if TYPE_CHECKING:
    from hvdc_ident.simulate.c_code import c_array, c_function, c_number, c_solve, c_string
    from hvdc_ident.simulate.codegen import NAMES, Elimination, Function
    from hvdc_ident.simulate.core import core_sources
    from hvdc_ident.simulate.engine import Engine, Method, Tolerance, check_times, engine_of
    from hvdc_ident.simulate.equations import ACCURACY, ModelEquations, by_structure, torn
    from hvdc_ident.simulate.experiment_run import ModelSimulator, chains_of, simulate, with_recording
    from hvdc_ident.simulate.graph import Graph
    from hvdc_ident.simulate.machine_code import Code, evaluate
    from hvdc_ident.simulate.simulation import Simulation, Statistics
    from hvdc_ident.simulate.steady_state import Equilibria, equilibria, resting, with_guesses
else:
    __getattr__ = offered(
        __name__,
        {
            "c_code": "c_array c_function c_number c_solve c_string",
            "core": "core_sources",
            "codegen": "NAMES Elimination Function",
            "engine": "Engine Method Tolerance check_times engine_of",
            "equations": "ACCURACY ModelEquations by_structure torn",
            "graph": "Graph",
            "machine_code": "Code evaluate",
            "experiment_run": "ModelSimulator chains_of simulate with_recording",
            "simulation": "Simulation Statistics",
            "steady_state": "Equilibria equilibria resting with_guesses",
        },
    )

__all__ = [
    "ACCURACY",
    "NAMES",
    "Code",
    "Elimination",
    "Engine",
    "Equilibria",
    "Function",
    "Graph",
    "Method",
    "ModelEquations",
    "ModelSimulator",
    "Simulation",
    "Statistics",
    "Tolerance",
    "by_structure",
    "c_array",
    "c_function",
    "c_number",
    "c_solve",
    "c_string",
    "chains_of",
    "check_times",
    "core_sources",
    "engine_of",
    "equilibria",
    "evaluate",
    "resting",
    "simulate",
    "torn",
    "with_guesses",
    "with_recording",
]
