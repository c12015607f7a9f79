"""Linearisation, identifiability, calibration and discrepancy diagnosis of converter and power-system models.

    import hvdc_ident as hi

    hi.check        what a study, a model and its data hold      hi.simulate    outputs over time, with exact derivatives
    hi.linearize    A, B, C, D, modes, margins                   hi.bode        a frequency response
    hi.sweep        errors over a range of parameters            hi.sensitivities   exact derivatives of everything
    hi.identify     what the data tell about the parameters      hi.fit         the estimates, with intervals
    hi.diagnose     what the model lacks                         hi.export      to an FMU, Modelica, MATLAB, CSV
    hi.compare_runs two results side by side                     hi.new_study   a study of recordings and a model

Each takes a model (`hi.Model`, a shipped name, a path), then data (`hi.Experiment`, a table, a study), then the parameters that it is
about; or a whole study. `values` are numbers by name. Every result has `summary()`, `plot()`, `to_dataframe()`, `to_dict()` and
`from_dict()`. What linear models are analysed with beyond their own methods is in `hi.linear`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hvdc_ident.aliases import moved, warn
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
    from hvdc_ident import linear
    from hvdc_ident.data import Experiment, InputSignal, Trajectory, multisine, ramp, step
    from hvdc_ident.discrepancy import Diagnosis
    from hvdc_ident.effects import apply_effects
    from hvdc_ident.fit.result import FitResult
    from hvdc_ident.formats import read_waveforms
    from hvdc_ident.identifiability import IdentifiabilityReport
    from hvdc_ident.linearize import LinearModel, OperatingPoint
    from hvdc_ident.model import Model
    from hvdc_ident.models import load_model
    from hvdc_ident.parameters import Input, Parameter
    from hvdc_ident.sensitivity import SweepResult
    from hvdc_ident.simulate import Simulation
    from hvdc_ident.study.comparison import RunComparison, compare_runs
    from hvdc_ident.study.new_study import new_study
    from hvdc_ident.study.study import Study, load_study

    __version__: str

_imported = offered(
    __name__,
    {
        "data": "Experiment InputSignal Trajectory multisine ramp step",
        "discrepancy": "Diagnosis",
        "effects": "apply_effects",
        "fit.result": "FitResult",
        "formats": "read_waveforms",
        "identifiability": "IdentifiabilityReport",
        "linearize": "LinearModel OperatingPoint",
        "model": "Model",
        "models": "load_model",
        "parameters": "Input Parameter",
        "sensitivity": "SweepResult",
        "simulate": "Simulation",
        "study.comparison": "RunComparison compare_runs",
        "study.new_study": "new_study",
        "study.study": "Study load_study",
    },
)
__all__ = [
    "Diagnosis",
    "Experiment",
    "FitResult",
    "IdentifiabilityReport",
    "Input",
    "InputSignal",
    "LinearModel",
    "Model",
    "OperatingPoint",
    "Parameter",
    "RunComparison",
    "Simulation",
    "Study",
    "SweepResult",
    "Trajectory",
    "__version__",
    "apply_effects",
    "bode",
    "check",
    "compare_runs",
    "diagnose",
    "export",
    "find_operating_point",
    "fit",
    "identify",
    "linear",
    "linearize",
    "load_model",
    "load_study",
    "multisine",
    "new_study",
    "ramp",
    "read_waveforms",
    "sensitivities",
    "simulate",
    "step",
    "sweep",
]


if not TYPE_CHECKING:

    def __getattr__(name):
        """Return a public name, imported now; or the version."""
        from importlib import import_module

        if name == "__version__":
            from importlib.metadata import version

            return version("hvdc_ident")
        if name in ("linear", "sensitivity"):
            return import_module(f"hvdc_ident.{name}")
        if module := moved(name):
            warn(f"hvdc_ident.{name}", f"hvdc_ident.{module}.{name}", above=2)
            return getattr(import_module(f"hvdc_ident.{module}"), name)
        return _imported(name)


def __dir__() -> list[str]:
    return sorted(__all__)
