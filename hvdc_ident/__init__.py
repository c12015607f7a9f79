"""Linearisation, identifiability, calibration and discrepancy diagnosis of converter models.

The verbs and the nouns of the package; each is imported when it is first used.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import inspect

    from hvdc_ident.discrepancy import diagnose
    from hvdc_ident.experiment import Experiment, InputSignal
    from hvdc_ident.fit import fit
    from hvdc_ident.formats import read_waveforms
    from hvdc_ident.identifiability import identifiability
    from hvdc_ident.linearize import (
        LinearModel,
        OperatingPoint,
        continuation,
        find_operating_point,
        linearize,
        one_sided,
        point_at,
    )
    from hvdc_ident.linearize.compare import compare
    from hvdc_ident.linearize.gap import gap, ncf_margin, nu_gap
    from hvdc_ident.linearize.locus import root_locus
    from hvdc_ident.linearize.loop import loop, plant_and_controller
    from hvdc_ident.linearize.margins import loop_margins, margins
    from hvdc_ident.linearize.measured import (
        MeasuredResponse,
        response_at_tones,
        response_from_record,
        simulated_response,
    )
    from hvdc_ident.linearize.norms import h2_norm, hinf_norm, linf_norm
    from hvdc_ident.linearize.port import Port, port_admittance, port_impedance
    from hvdc_ident.linearize.reduce import balanced
    from hvdc_ident.linearize.response_file import read_response
    from hvdc_ident.linearize.symbolic import symbolic_transfer
    from hvdc_ident.model.definition import Model
    from hvdc_ident.models import load_model
    from hvdc_ident.parameters import Input, Parameter
    from hvdc_ident.sensitivity.global_screening import morris, sobol
    from hvdc_ident.sensitivity.linear import linear_sensitivities
    from hvdc_ident.sensitivity.local import sensitivities
    from hvdc_ident.sensitivity.sweep import sweep
    from hvdc_ident.simulate import simulate
    from hvdc_ident.study.export import export
    from hvdc_ident.study.study import load_study
    from hvdc_ident.trajectory import Trajectory

    __version__: str

__all__ = [
    "Experiment",
    "Input",
    "InputSignal",
    "LinearModel",
    "MeasuredResponse",
    "Model",
    "OperatingPoint",
    "Parameter",
    "Port",
    "Trajectory",
    "__version__",
    "balanced",
    "compare",
    "continuation",
    "diagnose",
    "export",
    "find_operating_point",
    "fit",
    "gap",
    "h2_norm",
    "hinf_norm",
    "identifiability",
    "linear_sensitivities",
    "linearize",
    "linf_norm",
    "load_model",
    "load_study",
    "loop",
    "loop_margins",
    "margins",
    "morris",
    "ncf_margin",
    "nu_gap",
    "one_sided",
    "plant_and_controller",
    "point_at",
    "port_admittance",
    "port_impedance",
    "read_response",
    "read_waveforms",
    "response_at_tones",
    "response_from_record",
    "root_locus",
    "sensitivities",
    "simulate",
    "simulated_response",
    "sobol",
    "sweep",
    "symbolic_transfer",
]

_HOME = {
    "Experiment": "experiment",
    "Input": "parameters",
    "InputSignal": "experiment",
    "LinearModel": "linearize",
    "MeasuredResponse": "linearize.measured",
    "Model": "model.definition",
    "OperatingPoint": "linearize",
    "Parameter": "parameters",
    "Port": "linearize.port",
    "Trajectory": "trajectory",
    "balanced": "linearize.reduce",
    "compare": "linearize.compare",
    "continuation": "linearize",
    "diagnose": "discrepancy",
    "export": "study.export",
    "find_operating_point": "linearize",
    "fit": "fit",
    "gap": "linearize.gap",
    "h2_norm": "linearize.norms",
    "hinf_norm": "linearize.norms",
    "identifiability": "identifiability",
    "linear_sensitivities": "sensitivity.linear",
    "linearize": "linearize",
    "linf_norm": "linearize.norms",
    "load_model": "models",
    "load_study": "study.study",
    "loop": "linearize.loop",
    "loop_margins": "linearize.margins",
    "margins": "linearize.margins",
    "morris": "sensitivity.global_screening",
    "ncf_margin": "linearize.gap",
    "nu_gap": "linearize.gap",
    "one_sided": "linearize",
    "plant_and_controller": "linearize.loop",
    "point_at": "linearize",
    "port_admittance": "linearize.port",
    "port_impedance": "linearize.port",
    "read_response": "linearize.response_file",
    "read_waveforms": "formats",
    "response_at_tones": "linearize.measured",
    "response_from_record": "linearize.measured",
    "root_locus": "linearize.locus",
    "sensitivities": "sensitivity.local",
    "simulate": "simulate",
    "simulated_response": "linearize.measured",
    "sobol": "sensitivity.global_screening",
    "sweep": "sensitivity.sweep",
    "symbolic_transfer": "linearize.symbolic",
}


_VERBS = ("fit", "identifiability", "linearize", "simulate")
"""Names of a function and of the folder it lives in."""


class _Verb(ModuleType):
    """A folder that can be called: it runs the function of its own name."""

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        return self._function(*arguments, **named)

    @property
    def _function(self) -> Any:
        return self.__dict__[self.__name__.rpartition(".")[2]]

    @property
    def __signature__(self) -> inspect.Signature:
        import inspect

        return inspect.signature(self._function)


class _Package(ModuleType):
    """The package; importing `hvdc_ident.fit` puts that folder under the verb's name: it answers the call."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name in _VERBS and isinstance(value, ModuleType):
            value.__class__ = _Verb
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    """The public name, imported now; or the version."""
    if name == "__version__":
        from importlib.metadata import version

        return version("hvdc_ident")
    if name not in _HOME:
        raise AttributeError(f"module 'hvdc_ident' has no attribute '{name}'")
    module = importlib.import_module(f"hvdc_ident.{_HOME[name]}")
    return module if name in _VERBS else getattr(module, name)


def __dir__() -> list[str]:
    return sorted(__all__)
