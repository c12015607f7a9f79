"""Modes named by the parts of the plant that take part in them; a part is what states share as their description."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hvdc_ident.frozen import FrozenMap
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.modal import Mode
from hvdc_ident.model.definition import Model

SHARE = 0.5
"""A part names a mode where it takes part at least so much as the part that takes part most."""


@dataclass(frozen=True, eq=False)
class NamedMode:
    """A mode, the parts that name it joined by " + ", and the participation of each part (they sum to 1)."""

    mode: Mode
    name: str
    parts: FrozenMap[float]


def parts_of(model: Model) -> FrozenMap[str]:
    """The part of each state: its description, or its name where it has none; a delay belongs to the state it feeds."""
    parts = {name: s.description or name for name, s in model.states.items()}
    for delay in (*model.delays, *model.sampled):
        fed = [n for n, s in model.states.items() if any(v.name == delay for v in s.derivative.free_symbols)]
        parts[delay] = parts[fed[0]] if fed else delay
    return FrozenMap(parts)


def named_modes(linear: LinearModel, parts: Mapping[str, str]) -> tuple[NamedMode, ...]:
    """The modes of a linear model with their names; of a conjugate pair the upper one.

    parts: the part of each state, as `parts_of` gives it. States of a delay's approximant go with the delay.
    """
    found = []
    for mode in linear.modes():
        if mode.eigenvalue.imag < 0:
            continue
        shares: dict[str, float] = {}
        for state, share in mode.participation.items():
            part = parts.get(state) or parts.get(state.split(".")[0], state)
            shares[part] = shares.get(part, 0.0) + share
        ranked = sorted(shares.items(), key=lambda item: -item[1])
        name = " + ".join(part for part, share in ranked if share >= SHARE * ranked[0][1])
        found.append(NamedMode(mode, name, FrozenMap(ranked)))
    return tuple(found)


def path_delay(linear: LinearModel, source: str, before: str, after: str, omega: float = 1.0) -> float:
    """The delay in s from one output to another at omega in rad/s, both driven by one input: -arg(after/before)/omega."""
    response = linear.response(np.array([omega]))[0, :, linear.input_names.index(source)]
    ratio = response[linear.output_names.index(after)] / response[linear.output_names.index(before)]
    return float(-np.angle(ratio) / omega)
