"""The catalogue of effects: one file each, found by walking this folder."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.effects.placing import EffectUse, apply, each_its_own, joined
from hvdc_ident.effects.probing import Probe, SlotSignal, alone, clearance, probes, resistances, scanned, sources
from hvdc_ident.errors import unknown_name
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model

__all__ = [
    "Additions",
    "Effect",
    "EffectParameter",
    "EffectUse",
    "Probe",
    "SlotSignal",
    "alone",
    "apply_effects",
    "clearance",
    "each_its_own",
    "effects",
    "joined",
    "probes",
    "resistances",
    "scanned",
    "sources",
]

_NO_EFFECT = ("base", "placing", "probing")


@cache
def effects() -> FrozenMap[Effect]:
    """Every effect by name."""
    modules = (
        importlib.import_module(f"{__name__}.{m.name}")
        for m in pkgutil.iter_modules(__path__)
        if m.name not in _NO_EFFECT
    )
    found = [m.EFFECT for m in modules]
    return FrozenMap({e.name: e for e in sorted(found, key=lambda e: e.name)})


def apply_effects(model: Model, uses: Iterable[EffectUse | Mapping[str, Any]]) -> Model:
    """The model with the effects put on one after the other; neutral ones leave it as it is."""
    catalogue = effects()
    for given in uses:
        use = EffectUse.of(given)
        if use.effect not in catalogue:
            raise unknown_name("effect", use.effect, catalogue)
        model = apply(model, use, catalogue[use.effect])
    return model
