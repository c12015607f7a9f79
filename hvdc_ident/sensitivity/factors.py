"""What a derivative is multiplied by to be normalised: the parameter's value, or its range."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from hvdc_ident.errors import StudyError, unknown_name
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.model.definition import Model

Ranges = Mapping[str, tuple[float, float]]


def factors(
    model: Model, names: Sequence[str], values: Mapping[str, float], ranges: Ranges
) -> tuple[FrozenMap[float], FrozenMap[float]]:
    """The parameters' values, and what their derivatives are multiplied by."""
    at, found = {}, {}
    for name in names:
        if name not in model.parameters:
            raise unknown_name("parameter", name, model.parameters, where=f"model '{model.name}'")
        own = model.parameters[name]
        at[name] = float(values.get(name, own.value))
        low, high = ranges.get(name, (own.min, own.max))
        width = high - low
        if name in ranges and not (math.isfinite(width) and width > 0):
            raise StudyError(
                f"the range of '{name}' is wrong", expected="finite min < max", got=f"min {low:g}, max {high:g}"
            )
        if name in ranges or (at[name] == 0 and math.isfinite(width) and width > 0):
            found[name] = float(width)
        else:
            found[name] = abs(at[name]) or own.size
    return FrozenMap(at), FrozenMap(found)
