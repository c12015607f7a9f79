"""The many sizes that a candidate is looked at with, and which candidates are.

Levels of a quantiser and periods of a sampler have to be met (`has_to_be_met`); what bends its signal (`bent`) has to be
near. Thousands of sizes are kept as numbers: a probe of each would take longer to send than its trace to work out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.signatures.candidates import CandidateEffect
from hvdc_ident.discrepancy.signatures.finite import is_linear, kind_of
from hvdc_ident.effects import Probe, SignalScales, effects, size_grid
from hvdc_ident.immutable import FrozenMap

BENT = 50
"""Sizes of an effect that has not to be met."""
WIDE = 20.0
"""Below the least and above the largest probe of such an effect: how far its sizes reach."""
BETWEEN = 7
"""Sizes between one of the scan and its neighbour, then."""
TOGETHER = 400
"""Sizes whose traces are worked out at a time."""


@dataclass(frozen=True, eq=False)
class Dense:
    """A candidate with one size, and (C,) all those that it is looked at with, the least first."""

    candidate: CandidateEffect
    sizes: Array

    @property
    def place(self) -> tuple[str, tuple[str, ...]]:
        """The effect, and where."""
        return self.candidate.effect, self.candidate.at

    def alone(self, k: int) -> CandidateEffect:
        """The candidate with one of the sizes."""
        return replace(
            self.candidate, probes=(_resized(self.candidate.probes[0], sized(self.candidate), float(self.sizes[k])),)
        )

    def only(self, k: int) -> Dense:
        """One of the sizes."""
        return replace(self, sizes=self.sizes[k : k + 1])

    def around(self, k: int) -> Dense:
        """One of the sizes and those between it and its neighbours, evenly in the logarithm."""
        own, last = self.sizes[k], self.sizes.size - 1
        beside = [self.sizes[max(k - 1, 0)], self.sizes[min(k + 1, last)]]
        return replace(
            self, sizes=np.unique(np.concatenate([[own], *(np.geomspace(own, b, BETWEEN + 2)[1:-1] for b in beside)]))
        )

    def parts(self) -> list[Dense]:
        """A part of the sizes each: of all at once the traces would fill the memory."""
        return [replace(self, sizes=self.sizes[k : k + TOGETHER]) for k in range(0, self.sizes.size, TOGETHER)]


def has_to_be_met(candidate: CandidateEffect) -> bool:
    """Return True where the size has to be met exactly (levels of a quantiser, periods of a sampler)."""
    return effects()[candidate.effect].needs_grid


def by_level(candidate: CandidateEffect) -> bool:
    """Return True where the size has to be met exactly and is a level of the signal, not a time."""
    return has_to_be_met(candidate) and effects()[candidate.effect].equivalent_delay is None


def bent(candidate: CandidateEffect) -> bool:
    """Return True for a nonlinear effect at one slot with one parameter that need not be met exactly, and no kind of delay."""
    entry = effects()[candidate.effect]
    single = len(candidate.at) == 1 and not candidate.source and all(len(p.free) == 1 for p in candidate.probes)
    return single and entry.equivalent_delay is None and not entry.needs_grid and not is_linear(kind_of(candidate, 0))


def widened(candidate: CandidateEffect) -> Dense:
    """Many sizes of a candidate that bends its signal, evenly in the logarithm."""
    name = sized(candidate)
    low, high = candidate.probes[0].free[name]
    tried = [p.values[name] for p in candidate.probes]
    return Dense(candidate, np.geomspace(max(low, min(tried) / WIDE), min(high, max(tried) * WIDE), BENT))


def every_size(candidate: CandidateEffect, signal: SignalScales) -> Dense:
    """Every size worth a look of a candidate whose size has to be met. signal: that of its slot."""
    probe, sizes = size_grid(effects()[candidate.effect], signal)
    return Dense(replace(candidate, probes=(probe,)), np.sort(sizes))


def sized(candidate: CandidateEffect) -> str:
    """The parameter whose size is looked for: the one that has to be met, or the only one."""
    parameters = effects()[candidate.effect].parameters
    return next((n for n, q in parameters.items() if q.grid is not None), next(iter(parameters)))


def _resized(probe: Probe, name: str, size: float) -> Probe:
    low, high = probe.free[name]
    free = FrozenMap({**probe.free, name: (min(low, 0.9 * size), max(high, 1.1 * size))})
    return replace(probe, values=FrozenMap({**probe.values, name: size}), free=free)
