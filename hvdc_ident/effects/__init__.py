"""The catalogue of effects, one file each, and what inserts them into a model and sizes them for a search."""

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.effects.placement import EffectUse, apply_effects, effects, joined_sources, leads_back, split_sources
from hvdc_ident.effects.probing import (
    SMALLEST,
    Probe,
    SignalScales,
    admissible_sources,
    distance_from_neutral,
    effect_model,
    probes,
    resistance_parameters,
    size_grid,
)

__all__ = [
    "SMALLEST",
    "Additions",
    "Effect",
    "EffectParameter",
    "EffectUse",
    "Probe",
    "SignalScales",
    "admissible_sources",
    "apply_effects",
    "distance_from_neutral",
    "effect_model",
    "effects",
    "joined_sources",
    "leads_back",
    "probes",
    "resistance_parameters",
    "size_grid",
    "split_sources",
]
