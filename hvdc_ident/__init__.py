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

from importlib import import_module, metadata
from typing import Any

import lazy_loader

from hvdc_ident import api
from hvdc_ident.aliases import moved, warn

_offered, _, _names = lazy_loader.attach_stub(__name__, __file__)
__all__ = sorted([*_names, "__version__"])

# The verbs now: a package of a verb's name, once imported, would stand in its place.
for _verb in set(_names) & set(vars(api)):
    globals()[_verb] = getattr(api, _verb)


def __getattr__(name: str) -> Any:
    """Return a public name, imported now; or the version."""
    if name == "__version__":
        return metadata.version("hvdc_ident")
    if name == "sensitivity":
        return import_module("hvdc_ident.sensitivity")
    if module := moved(name):
        warn(f"hvdc_ident.{name}", f"hvdc_ident.{module}.{name}", above=2)
        return getattr(import_module(f"hvdc_ident.{module}"), name)
    return _offered(name)


def __dir__() -> list[str]:
    return __all__
