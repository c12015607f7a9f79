"""Parameters and inputs: a value with its unit, its bounds and what it means."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from hvdc_ident.errors import ModelError
from hvdc_ident.immutable import FrozenMap


@dataclass(frozen=True)
class Parameter:
    """A constant of the model that may be estimated.

    value: start value in `unit`. min, max: bounds that the physics sets, in `unit` (infinite: none).
    scale: a typical size in `unit`, used to compare parameters; 0 means: take |value|, or 1 where that is 0.
    usual: lowest and highest of the values that plants have, in `unit`; empty: not known.
    """

    value: float
    unit: str = ""
    min: float = -math.inf
    max: float = math.inf
    scale: float = 0.0
    description: str = ""
    usual: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in ("value", "min", "max", "scale"):
            object.__setattr__(self, name, float(getattr(self, name)))
        object.__setattr__(self, "usual", tuple(float(v) for v in self.usual))
        if math.isnan(self.value):
            raise ModelError("a parameter's value is not a number")
        if self.usual and not (len(self.usual) == 2 and self.usual[0] <= self.usual[1]):
            raise ModelError(
                "a parameter's usual values are no range", expected="[low, high]", got=f"{list(self.usual)}"
            )
        if not self.min <= self.max:
            raise ModelError(
                "a parameter's bounds are in the wrong order",
                expected="min <= max",
                got=f"min {self.min:g}, max {self.max:g}",
                hint=f"min = {self.max:g}, max = {self.min:g}",
            )
        if math.isnan(self.scale) or self.scale < 0:
            raise ModelError("a parameter's scale is wrong", expected="a number of at least 0", got=f"{self.scale:g}")
        if not self.min <= self.value <= self.max:
            raise ModelError(
                "a parameter's value lies outside its own bounds",
                expected=f"a value in [{self.min:g}, {self.max:g}]",
                got=f"{self.value:g}",
            )

    @property
    def size(self) -> float:
        """A typical size in the parameter's unit, never 0."""
        return self.scale or abs(self.value) or 1.0

    @property
    def about(self) -> str:
        """The description with the usual values."""
        usual = " to ".join(f"{v:g}" for v in self.usual)
        return "; ".join(filter(None, (self.description, usual)))


@dataclass(frozen=True)
class Input:
    """A signal that enters the model from outside; `value` is what it is where an experiment does not say.

    settable: whether a person can move it for an experiment. A set-point is; the voltage of a grid is not.
    """

    value: float = 0.0
    unit: str = ""
    description: str = ""
    settable: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "value", float(self.value))
        if not math.isfinite(self.value):
            raise ModelError("an input's value is not finite", expected="a finite number", got=f"{self.value}")


def with_values(
    parameters: Mapping[str, Parameter],
    inputs: Mapping[str, Input],
    values: Mapping[str, float],
    unknown: Callable[[str], Exception],
) -> tuple[FrozenMap[Parameter], FrozenMap[Input]]:
    """Return parameters and inputs with other values.

    Raises ModelError for a value outside a parameter's bounds, and what `unknown` gives for a name of neither.
    """
    changed_parameters, changed_inputs = dict(parameters), dict(inputs)
    for name, value in values.items():
        if name in parameters:
            try:
                changed_parameters[name] = replace(parameters[name], value=float(value))
            except ModelError as e:
                raise e.at(f"parameter '{name}'") from None
        elif name in inputs:
            changed_inputs[name] = replace(inputs[name], value=float(value))
        else:
            raise unknown(name)
    return FrozenMap(changed_parameters), FrozenMap(changed_inputs)
