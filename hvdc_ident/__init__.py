"""Linearisation, identifiability, calibration and discrepancy diagnosis of converter and power-system models.

    import hvdc_ident as hi

    hi.check        what a study, a model and its data hold      hi.simulate    outputs over time, with exact derivatives
    hi.linearize    A, B, C, D, modes, margins                   hi.bode        a frequency response
    hi.sweep        errors over a range of parameters            hi.sensitivities   exact derivatives of everything
    hi.identify     what the data tell about the parameters      hi.fit         the estimates, with intervals
    hi.diagnose     what the model lacks                         hi.export      to an FMU, Modelica, MATLAB, CSV
    hi.compare_runs two results side by side                     hi.new_study   a study of recordings and a model

Each takes a model (`hi.Model`, a shipped name, a path), data (`hi.Experiment`, a table, a study) or a whole study.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hvdc_ident.api import (
    bode,
    check,
    diagnose,
    export,
    find_operating_point,
    fit,
    identify,
    linearize,
    sensitivities,
    simulate,
    sweep,
)
from hvdc_ident.lazy import offered

if TYPE_CHECKING:
    from hvdc_ident.data import Experiment, InputSignal, Trajectory, multisine, ramp, step
    from hvdc_ident.discrepancy import Diagnosis
    from hvdc_ident.effects import apply_effects
    from hvdc_ident.fit.result import FitResult
    from hvdc_ident.formats import read_waveforms
    from hvdc_ident.identifiability import IdentifiabilityReport
    from hvdc_ident.linearize import (
        LinearModel,
        MeasuredResponse,
        OperatingPoint,
        Port,
        balanced,
        compare,
        continuation,
        gap,
        h2_norm,
        hinf_norm,
        linf_norm,
        loop,
        loop_margins,
        margins,
        ncf_margin,
        nu_gap,
        one_sided,
        plant_and_controller,
        point_at,
        port_admittance,
        port_impedance,
        read_response,
        response_at_tones,
        response_from_record,
        root_locus,
        simulated_response,
        symbolic_transfer,
    )
    from hvdc_ident.model import Model
    from hvdc_ident.models import load_model
    from hvdc_ident.parameters import Input, Parameter
    from hvdc_ident.sensitivity import SweepResult, linear_sensitivities, morris, sobol
    from hvdc_ident.simulate import Simulation
    from hvdc_ident.study.comparison import RunComparison, compare_runs
    from hvdc_ident.study.new_study import new_study
    from hvdc_ident.study.study import Study, load_study

    __version__: str

__all__ = [
    "Diagnosis",
    "Experiment",
    "FitResult",
    "IdentifiabilityReport",
    "Input",
    "InputSignal",
    "LinearModel",
    "MeasuredResponse",
    "Model",
    "OperatingPoint",
    "Parameter",
    "Port",
    "RunComparison",
    "Simulation",
    "Study",
    "SweepResult",
    "Trajectory",
    "__version__",
    "apply_effects",
    "balanced",
    "bode",
    "check",
    "compare",
    "compare_runs",
    "continuation",
    "diagnose",
    "export",
    "find_operating_point",
    "fit",
    "gap",
    "h2_norm",
    "hinf_norm",
    "identify",
    "linear_sensitivities",
    "linearize",
    "linf_norm",
    "load_model",
    "load_study",
    "loop",
    "loop_margins",
    "margins",
    "morris",
    "multisine",
    "ncf_margin",
    "new_study",
    "nu_gap",
    "one_sided",
    "plant_and_controller",
    "point_at",
    "port_admittance",
    "port_impedance",
    "ramp",
    "read_response",
    "read_waveforms",
    "response_at_tones",
    "response_from_record",
    "root_locus",
    "sensitivities",
    "simulate",
    "simulated_response",
    "sobol",
    "step",
    "sweep",
    "symbolic_transfer",
]

_imported = offered(
    __name__,
    {
        "data": "Experiment InputSignal Trajectory multisine ramp step",
        "discrepancy": "Diagnosis",
        "effects": "apply_effects",
        "fit.result": "FitResult",
        "formats": "read_waveforms",
        "identifiability": "IdentifiabilityReport",
        "linearize": "LinearModel MeasuredResponse OperatingPoint Port balanced compare continuation gap h2_norm hinf_norm "
        "linf_norm loop loop_margins margins ncf_margin nu_gap one_sided plant_and_controller point_at port_admittance "
        "port_impedance read_response response_at_tones response_from_record root_locus simulated_response symbolic_transfer",
        "model": "Model",
        "models": "load_model",
        "parameters": "Input Parameter",
        "sensitivity": "SweepResult linear_sensitivities morris sobol",
        "simulate": "Simulation",
        "study.comparison": "RunComparison compare_runs",
        "study.new_study": "new_study",
        "study.study": "Study load_study",
    },
)


if not TYPE_CHECKING:

    def __getattr__(name):
        """Return a public name, imported now; or the version."""
        if name == "__version__":
            from importlib.metadata import version

            return version("hvdc_ident")
        return _imported(name)


def __dir__() -> list[str]:
    return sorted(__all__)
