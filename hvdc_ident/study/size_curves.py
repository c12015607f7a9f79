"""Responses of the augmented model over a range of sizes of the named effect, for the report's slider."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from hvdc_ident.data import Array, Experiment
from hvdc_ident.discrepancy.result import Diagnosis, FoundEffect
from hvdc_ident.effects import apply_effects, effects
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model
from hvdc_ident.simulate import simulate
from hvdc_ident.study.augmented import use_of
from hvdc_ident.summary.stage_results import SizeCurves
from hvdc_ident.text import quantity

SHARES = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0)
"""Of the way from the neutral size to the one that was found; 0 is the model without the effect, gains as found with it."""


def size_curves(model: Model, experiments: Iterable[Experiment], diagnosis: Diagnosis) -> SizeCurves | None:
    """Return the output the effect matters most for, recorded and simulated at several sizes; None without an effect.

    The other effects and the parameters stay as found. A size that the effect cannot have, and one at which the model cannot be run,
    is left out.
    """
    if not diagnosis.effects or diagnosis.augmented is None:
        return None
    place = _where_it_matters(diagnosis)
    chosen = next((e for e in experiments if place and e.name == place[1] and e.measured is not None), None)
    if place is None or chosen is None:
        return None
    first = diagnosis.effects[0]
    name = next(iter(first.parameters))
    size = first.parameters[name]
    bounds = effects()[first.effect].parameters[name]
    neutral = _neutral(first, bounds.neutral)
    rows = chosen.compared
    shown: list[tuple[float | None, float, str, Array]] = []
    for share in SHARES:
        value = _size(size.value, neutral, share)
        # On the other side of neutral, or far from it, an effect has no such size: a lead of less than 0 s.
        if value is not None and not bounds.min <= value <= bounds.max:
            continue
        try:
            run = simulate(_with(model, diagnosis, value), chosen, diagnosis.parameters_after, outputs=[place[0]])
        except HvdcIdentError:  # as where a smaller limit leaves no rest to begin at
            continue
        label = "without it" if value is None else f"{name} = {quantity(value, size.unit)}"
        shown.append((value, share, label, run[place[0]][rows]))
    if not shown:
        return None
    assert chosen.measured is not None
    sizes, shares, labels, curves = zip(*shown, strict=True)
    return SizeCurves(
        first.effect, first.at, name, size.unit, chosen.name, place[0],
        model.outputs[place[0]].unit if place[0] in model.outputs else "",
        chosen.time[rows], chosen.measured[place[0]][rows], shares.index(1.0) if 1.0 in shares else None,
        sizes, shares, labels, np.array(curves),
    )  # fmt: skip


def _where_it_matters(diagnosis: Diagnosis) -> tuple[str, str] | None:
    """Output and experiment, held out where there are any, whose error in noise units falls most."""
    best: tuple[float, tuple[str, str]] | None = None
    for role in ("holdout", "fit"):
        before, after = diagnosis.gap.refitted.get(role) or {}, diagnosis.gap.augmented.get(role) or {}
        for output, line in before.items():
            unit = diagnosis.gap.noise_floor.get(output) or 1.0
            for experiment, was in line.items():
                now = (after.get(output) or {}).get(experiment)
                if was is None or now is None:
                    continue
                gain = (was - now) / unit
                if best is None or gain > best[0]:
                    best = gain, (output, experiment)
        if best is not None:
            return best[1]
    return None


def _neutral(effect: FoundEffect, neutral: float | str | None) -> float:
    """The size at which the effect is not there; for some that is the value of another of its parameters."""
    if isinstance(neutral, str):
        other = effect.parameters.get(neutral)
        return other.value if other is not None else 0.0
    return neutral if neutral is not None else 0.0


def _size(value: float, neutral: float, share: float) -> float | None:
    """The size at a share of the way from neutral; None at neutral itself."""
    if share == 0.0:
        return None
    return value / share if math.isinf(neutral) else neutral + share * (value - neutral)


def _with(model: Model, diagnosis: Diagnosis, value: float | None) -> Model:
    """The model with the effects as found, the first one at another size, or without it."""
    first = diagnosis.effects[0]
    for effect in diagnosis.effects:
        if effect is not first:
            model = apply_effects(model, [use_of(effect).within(model)])
        elif value is not None:
            use = use_of(first)
            sizes = use.parameters | {next(iter(first.parameters)): value}
            model = apply_effects(model, [replace(use, parameters=FrozenMap(sizes))])
    return model
