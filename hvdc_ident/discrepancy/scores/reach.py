"""Where anything at all would explain the records: how much of what is beyond noise could be made good at each slot.

Whatever an effect is, to the rest of the model it is something that is added to its slot's signal. What the best of all
additions over time brings, one value for every row, no effect there can surpass; where that is far less than it is at
another slot, what is missing sits elsewhere, and none need be refitted. Linear in the model's answer, like the scores.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hvdc_ident.discrepancy.refits.nominal import Nominal
from hvdc_ident.discrepancy.scores.inversion import KNOTS, Inversion
from hvdc_ident.discrepancy.scores.scored import Path
from hvdc_ident.discrepancy.signatures.response import Along
from hvdc_ident.executor import Executor, mapped
from hvdc_ident.immutable import FrozenMap

SHARE = 0.7
"""Of what the best slot could make good, up to which another one is too little. Of 222 hidden effects of at least ten times
what can be detected the own slot had less than nine tenths for three, and for none less than eight."""
SURE = 4.0
"""Standard deviations of chance by which it has to be too little."""


@dataclass(frozen=True, eq=False)
class Reach:
    """Upper bound of the misfit that an addition at each slot could explain.

    shares: of the gap beyond noise, by slot, the largest first; above 1 where noise is fitted too. enough: the slots at
    which it is not far less than at the best.
    """

    shares: FrozenMap[float]
    enough: frozenset[str]


@dataclass(frozen=True, eq=False)
class _SlotJob:
    """One slot's share of the work."""

    nominal: Nominal
    paths: Mapping[str, Along]
    place: str


def reach(nominal: Nominal, paths: Mapping[str, Path], slots: Sequence[str], executor: Executor | None) -> Reach | None:
    """Upper bound of the explainable misfit at each of the slots, which all runs have; None where that cannot be told.

    It cannot of a model that is closed inside, nor where the records have more rows than what is added has values: a
    quick one would not be followed then; nor where there is no gap beyond what chance leaves.
    """
    inner = {n: p for n, p in paths.items() if isinstance(p, Along)}
    if len(inner) < len(paths) or max(p.count for p in inner.values()) > KNOTS // len(inner):
        return None
    left, rows = nominal.projected(nominal.residual[:, None]), nominal.residual.size - nominal.basis.shape[1]
    gap = float(np.sum(left**2)) - rows
    if not gap > SURE * np.sqrt(2.0 * rows):
        return None
    jobs = [_SlotJob(nominal, {n: p.only(s) for n, p in inner.items()}, s) for s in slots]
    found = np.array(list(mapped(executor, _at_slot, jobs)))
    brings, count = found[:, 0] - found[:, 1], found[:, 1]
    chance = SURE * np.sqrt(2.0 * count + 4.0 * np.maximum(brings, 0.0))
    best = int(np.argmax(brings))
    enough = brings + chance >= SHARE * (brings[best] - chance[best])
    order = np.argsort(-brings, kind="stable")
    return Reach(
        FrozenMap({slots[k]: float(max(brings[k], 0.0) / gap) for k in order}),
        frozenset(s for s, near in zip(slots, enough, strict=True) if near),
    )


def _at_slot(slot: _SlotJob) -> tuple[float, int]:
    return Inversion.of(slot.nominal, slot.paths, slot.place).reach
