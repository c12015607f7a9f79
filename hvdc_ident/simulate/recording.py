"""How an experiment changes the model that is run: slots driven by recorded columns, outputs seen through instruments."""

from __future__ import annotations

from functools import lru_cache

from hvdc_ident.effects import EffectUse
from hvdc_ident.experiment import Experiment
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.model.definition import Model


def with_recording(model: Model, experiment: Experiment) -> Model:
    """The model with the experiment's driven slots as inputs and its recording chains on the outputs."""
    if not experiment.drive and not experiment.instrument:
        return model
    return _with_recording(model, experiment.drive, experiment.instrument)


@lru_cache(maxsize=32)
def _with_recording(model: Model, drive: tuple[str, ...], instrument: FrozenMap[FrozenMap[float]]) -> Model:
    chains = []
    for output, chain in instrument.items():
        for name in ("window-mean", "delay"):
            if chain.get(name):
                chains.append(EffectUse(name, (f"outputs.{output}",), FrozenMap({"T": chain[name]})))
    return model.driven(drive).with_effects(chains)
