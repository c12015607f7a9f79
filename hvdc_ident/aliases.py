"""Names of release 0.2 that are others now: each works for one release more, with a DeprecationWarning that names the new one."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

MOVED: dict[str, str] = {
    "linear": "MeasuredResponse Port balanced compare continuation h2_norm hinf_norm linear_sensitivities linf_norm loop loop_margins "
    "margins ncf_margin nu_gap one_sided plant_and_controller point_at port_admittance port_impedance read_response response_at_tones "
    "response_from_record root_locus simulated_response symbolic_transfer",
    "sensitivity": "morris sobol",
}
"""Names that the package itself had, by the module of it that has them."""
ARGUMENTS: dict[str, dict[str, str]] = {
    verb: {"parameters": "values"} for verb in ("simulate", "find_operating_point", "linearize", "bode")
}
"""Arguments by verb: `parameters` are those that a call is about, `values` are numbers by name."""


def warn(old: str, new: str, above: int = 3) -> None:
    """Say that a name is another one now, at the line of the caller so many calls above."""
    warnings.warn(
        f"{old} is {new} now; the old form goes with the next release", DeprecationWarning, stacklevel=above + 1
    )


def moved(name: str) -> str | None:
    """Return the module that has a name of the top now; None for another one."""
    return next((module for module, names in MOVED.items() if name in names.split()), None)


def current(verb: str, arguments: tuple[Any, ...], named: Mapping[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """Return the arguments of a call under their names of now, in their order of now."""
    given = dict(named)
    for old, new in ARGUMENTS.get(verb, {}).items():
        if old in given:
            warn(f"{verb}({old}=...)", f"{verb}({new}=...)")
            given[new] = given.pop(old)
    if verb == "sweep" and len(arguments) > 1 and _are_points(arguments[1]):
        warn("sweep(model, parameters, data)", "sweep(model, data, parameters)")
        model, points, *data = arguments
        return (model, *data), {"parameters": points, **given}
    return arguments, given


def _are_points(given: Any) -> bool:
    """Return whether an argument says at which values to sweep: no data are a mapping, or axes."""
    axes = given if isinstance(given, list | tuple) else (given,)
    return bool(axes) and all(isinstance(a, Mapping) or type(a).__name__ in ("Samples", "Points") for a in axes)
