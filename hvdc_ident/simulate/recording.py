"""Changes that an experiment makes to the model that is run: slots driven by recorded columns, outputs seen through instruments,
inputs with an unknown offset, states with a start of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

from hvdc_ident.data import Experiment
from hvdc_ident.expression import symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, fresh, rewritten
from hvdc_ident.parameters import Parameter

if TYPE_CHECKING:
    from hvdc_ident.effects import EffectUse


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
    from hvdc_ident.effects import EffectUse

    chains = []
    for output, chain in instrument.items():
        for name in ("window-mean", "delay"):
            if chain.get(name):
                chains.append(EffectUse(name, (f"outputs.{output}",), FrozenMap({"T": chain[name]})))
    return chains


def with_own(model: Model, names: Sequence[str]) -> tuple[Model, FrozenMap[str]]:
    """The model with what an experiment has for itself as parameters, and the parameter of each name.

    names: inputs, to which a constant is added all along, the steady start included (0 unless given); states, which
    begin at a value instead of at rest. What the model calls free already is its own parameter.
    """
    return _with_own(model, tuple(names)) if names else (model, FrozenMap())


@lru_cache(maxsize=32)
def _with_own(model: Model, names: tuple[str, ...]) -> tuple[Model, FrozenMap[str]]:
    found = {}
    for name in names:
        if name in model.states:
            found[name] = f"{name}_start"
            state = model.states[name]
            if state.start != "free":
                start = Parameter(state.guess or 0.0, state.unit, description=f"{name} at the start")
                free = replace(state, start="free")
                model = replace(
                    model,
                    states=model.states | {name: free},
                    parameters=model.parameters | {found[name]: start},
                )
            continue
        found[name] = offset = fresh(model, f"{name}_offset")
        constant = Parameter(0.0, model.inputs[name].unit, description=f"constant added to {name}")
        model = replace(model, parameters=model.parameters | {offset: constant})
        model = rewritten(model, name, "offset", lambda m, u, offset=offset: (m, u + symbol(offset)))  # type: ignore[misc]
    return model, FrozenMap(found)
