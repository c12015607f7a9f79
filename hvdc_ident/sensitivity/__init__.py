"""Derivatives and ranks: sweeps, sensitivities, screening, structural identifiability, information; no optimiser."""

from typing import TYPE_CHECKING

from hvdc_ident.lazy import offered

if TYPE_CHECKING:
    from hvdc_ident.sensitivity.derivatives import (
        Sensitivities,
        SteadySensitivities,
        steady_sensitivities,
        trajectory_sensitivities,
    )
    from hvdc_ident.sensitivity.fisher import Information, marginal
    from hvdc_ident.sensitivity.global_screening import ScreeningResult, morris, sobol
    from hvdc_ident.sensitivity.local_sensitivities import (
        LinearSensitivities,
        LocalSensitivities,
        linear_sensitivities,
        sensitivities,
    )
    from hvdc_ident.sensitivity.sampling import Points, Samples, grid, latin_hypercube, listed, log_grid
    from hvdc_ident.sensitivity.structural import StructuralResult, identifiable_subset, structural_identifiability
    from hvdc_ident.sensitivity.sweep_result import SweepResult
    from hvdc_ident.sensitivity.sweep_run import sweep
else:
    __getattr__ = offered(
        __name__,
        {
            "derivatives": "Sensitivities SteadySensitivities steady_sensitivities trajectory_sensitivities",
            "fisher": "Information marginal",
            "global_screening": "ScreeningResult morris sobol",
            "local_sensitivities": "LinearSensitivities LocalSensitivities linear_sensitivities sensitivities",
            "sampling": "Points Samples grid latin_hypercube listed log_grid",
            "structural": "StructuralResult identifiable_subset structural_identifiability",
            "sweep_result": "SweepResult",
            "sweep_run": "sweep",
        },
    )

__all__ = [
    "Information",
    "LinearSensitivities",
    "LocalSensitivities",
    "Points",
    "Samples",
    "ScreeningResult",
    "Sensitivities",
    "SteadySensitivities",
    "StructuralResult",
    "SweepResult",
    "grid",
    "identifiable_subset",
    "latin_hypercube",
    "linear_sensitivities",
    "listed",
    "log_grid",
    "marginal",
    "morris",
    "sensitivities",
    "sobol",
    "steady_sensitivities",
    "structural_identifiability",
    "sweep",
    "trajectory_sensitivities",
]
