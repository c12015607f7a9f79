"""Derivatives and ranks: sweeps, sensitivities, screening, structural identifiability, information; no optimiser."""

from typing import TYPE_CHECKING

from hvdc_ident.lazy import offered

if TYPE_CHECKING:
    from hvdc_ident.sensitivity.global_screening import ScreeningResult, morris, sobol
    from hvdc_ident.sensitivity.information import (
        SENSITIVITY_ERROR,
        Collinear,
        Information,
        collinear_subsets,
        independent,
        marginal,
        normalised,
        null_directions,
        pivoted_order,
        rise_over_range,
        standard_deviations,
    )
    from hvdc_ident.sensitivity.local_sensitivities import (
        LinearSensitivities,
        LocalSensitivities,
        Ranges,
        Sensitivities,
        SteadySensitivities,
        linear_sensitivities,
        sensitivities,
        steady_sensitivities,
        trajectory_sensitivities,
    )
    from hvdc_ident.sensitivity.structural import (
        Combination,
        StructuralResult,
        identifiable_subset,
        structural_identifiability,
    )
    from hvdc_ident.sensitivity.sweep_points import Points, Quantities, Samples, grid, latin_hypercube, listed, log_grid
    from hvdc_ident.sensitivity.sweep_run import SweepResult, SweepSummary, sweep
else:
    __getattr__ = offered(
        __name__,
        {
            "local_sensitivities": "LinearSensitivities LocalSensitivities Ranges Sensitivities SteadySensitivities "
            "linear_sensitivities sensitivities steady_sensitivities trajectory_sensitivities",
            "information": "SENSITIVITY_ERROR Collinear Information collinear_subsets independent marginal "
            "normalised null_directions pivoted_order rise_over_range standard_deviations",
            "global_screening": "ScreeningResult morris sobol",
            "structural": "Combination StructuralResult identifiable_subset structural_identifiability",
            "sweep_points": "Points Quantities Samples grid latin_hypercube listed log_grid",
            "sweep_run": "SweepResult SweepSummary sweep",
        },
    )

__all__ = [
    "SENSITIVITY_ERROR",
    "Collinear",
    "Combination",
    "Information",
    "LinearSensitivities",
    "LocalSensitivities",
    "Points",
    "Quantities",
    "Ranges",
    "Samples",
    "ScreeningResult",
    "Sensitivities",
    "SteadySensitivities",
    "StructuralResult",
    "SweepResult",
    "SweepSummary",
    "collinear_subsets",
    "grid",
    "identifiable_subset",
    "independent",
    "latin_hypercube",
    "linear_sensitivities",
    "listed",
    "log_grid",
    "marginal",
    "morris",
    "normalised",
    "null_directions",
    "pivoted_order",
    "rise_over_range",
    "sensitivities",
    "sobol",
    "standard_deviations",
    "steady_sensitivities",
    "structural_identifiability",
    "sweep",
    "trajectory_sensitivities",
]
