"""How an experiment changes the model that is run: slots driven by recorded columns, outputs seen through instruments,
inputs with an unknown offset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

from hvdc_ident.effects import EffectUse
from hvdc_ident.experiment import Experiment
from hvdc_ident.expression.functions import symbol
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.model.definition import Model
from hvdc_ident.model.transform import fresh, rewritten
from hvdc_ident.parameters import Parameter


def with_recording(model: Model, experiment: Experiment) -> Model:
    """The model with the experiment's driven slots as inputs and its recording chains on the outputs."""
    if not experiment.drive and not experiment.instrument:
        return model
    return _with_recording(model, experiment.drive, experiment.instrument)


@lru_cache(maxsize=32)
def _with_recording(model: Model, drive: tuple[str, ...], instrument: FrozenMap[FrozenMap[float]]) -> Model:
    return model.driven(drive).with_effects(chains_of(instrument))


def chains_of(instrument: FrozenMap[FrozenMap[float]]) -> list[EffectUse]:
    """The recording chains as effects at the outputs: what the instrument does to the signal, in its order."""
    chains = []
    for output, chain in instrument.items():
        for name in ("window-mean", "delay"):
            if chain.get(name):
                chains.append(EffectUse(name, (f"outputs.{output}",), FrozenMap({"T": chain[name]})))
    return chains


def with_offsets(model: Model, inputs: Sequence[str]) -> tuple[Model, FrozenMap[str]]:
    """The model that adds an unknown constant to each of these inputs, and the constant's parameter by input.

    The constant acts from the start on, the steady start included, and is 0 unless a value is given.
    """
    return _with_offsets(model, tuple(inputs)) if inputs else (model, FrozenMap())


@lru_cache(maxsize=32)
def _with_offsets(model: Model, inputs: tuple[str, ...]) -> tuple[Model, FrozenMap[str]]:
    names = {}
    for name in inputs:
        unit = model.inputs[name].unit
        names[name] = offset = fresh(model, f"{name}_offset")
        constant = Parameter(0.0, unit, description=f"constant added to {name}")
        model = replace(model, parameters=model.parameters | {offset: constant})
        model = rewritten(model, name, "offset", lambda m, u, offset=offset: (m, u + symbol(offset)))  # type: ignore[misc]
    return model, FrozenMap(names)
