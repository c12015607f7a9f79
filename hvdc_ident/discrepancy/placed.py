"""Where a refit begins: the model with one more effect, at the size that its score asks for."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.movable import in_proportion
from hvdc_ident.effects import EffectUse, apply_effects, effects
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel, Model
from hvdc_ident.simulate import ModelSimulator, Tolerance, equilibria

PATIENCE = Tolerance(rtol=1e-6, atol=1e-9, max_steps=20_000)
"""Of a refit's runs: a size at which an effect takes more steps (a window of a microsecond, a chatter) is no candidate."""
FAR = 5.0
"""Times a probe's size at most, or this share of it at least, that a refit begins at: a score far from its size says little."""
EXACT = 1e3
"""Largest such factor for an effect in proportion to its size, whose score at one size is that at every."""
ROOM = 3.0
"""Times the size asked for: how far a refit may go."""


@dataclass(frozen=True)
class Placed:
    """An effect in a model: its candidate, its use, and by its own parameter names those of the model.

    movable: whether its place is chosen at run time, so that its use is none of the model's own.
    """

    candidate: CandidateEffect
    use: EffectUse
    names: FrozenMap[str]
    bounds: FrozenMap[tuple[float, float]]
    start: FrozenMap[float]
    movable: bool = False


def added(
    model: AnyModel,
    problem: Problem,
    candidate: CandidateEffect,
    probe: int,
    factor: float,
    made: dict[Hashable, AnyModel] | None = None,
) -> tuple[AnyModel, Problem, Placed, Array]:
    """The model and problem with one more effect, and where it starts: the probe, or the size the score asks for.

    made: models made of this one before, to which this may add another: one of an effect serves for all its free sizes.
    Raises ModelError where the effect cannot be put there.
    """
    candidate = reaching(candidate, probe, factor)
    chosen = candidate.probes[probe]
    values = moved(candidate, probe, factor)
    use = candidate.use(replace(chosen, values=FrozenMap(values)))
    present = [
        n
        for n in effects()[candidate.effect].parameters
        if n not in candidate.named and not _absent(candidate, n, values)
    ]
    settled = tuple((n, values[n]) for n in present if n not in chosen.free)
    key = (candidate.effect, candidate.at, candidate.source, candidate.named, tuple(present), settled)
    made = {} if made is None else made
    larger = made[key] = made.get(key) or apply_effects(model, [use])
    new = [n for n in larger.parameters if n not in model.parameters]
    names = dict(zip(present, new, strict=True))
    bounds = {n: b for n, b in chosen.free.items() if n in names}
    free = tuple(FitParameter(names[n], values[n], low, high) for n, (low, high) in bounds.items())
    more = replace(
        problem,
        simulator=ModelSimulator(larger, PATIENCE),
        free=(*problem.free, *free),
        free_initial_states=problem.free_initial_states or begins_anywhere(larger, model, [use]),
    )
    placed = Placed(candidate, use, FrozenMap(names), FrozenMap(bounds), FrozenMap(values))
    return larger, more, placed, np.array([f.start for f in free])


def begins_anywhere(model: AnyModel, without: AnyModel, uses: Sequence[EffectUse]) -> bool:
    """Return True where a record of the model with these effects need not begin at the steady state that the solver finds.

    An effect moves the model by itself, or effects leave open at which of many steady states it rests, as without them it does
    not: a dead band before an integrator holds it at any level, which is the one that was left by what came before.
    """
    entries = [effects()[u.effect] for u in uses]
    if any(e.self_exciting for e in entries):
        return True
    if not (any(e.holds for e in entries) and isinstance(model, Model) and isinstance(without, Model)):
        return False
    return _determinant(model) == 0.0 and _determinant(without) not in (None, 0.0)


def _determinant(model: Model) -> float | None:
    """Sign of the determinant of the equations at the model's own steady state; None where it has none."""
    anchor = equilibria(model).anchor(model, np.array([i.value for i in model.inputs.values()]))
    return None if anchor is None else anchor.sign


def _absent(candidate: CandidateEffect, name: str, values: Mapping[str, float]) -> bool:
    q = effects()[candidate.effect].parameters[name]
    return q.optional and values[name] == q.neutral


def reaching(candidate: CandidateEffect, probe: int, factor: float) -> CandidateEffect:
    """The candidate with room in the probe's bounds for the size that a score asks for, where it is in proportion to that.

    What a slot carries by itself is no measure of what is added there: a friction that hardly moves may be kicked hard.
    """
    chosen, entry = candidate.probes[probe], effects()[candidate.effect]
    if not np.isfinite(factor) or abs(factor) <= 1.0 or not in_proportion(candidate, probe):
        return candidate
    free = dict(chosen.free)
    for n in (n for n in free if entry.parameters[n].neutral == 0.0):
        asked, (low, high) = ROOM * min(abs(factor), EXACT) * abs(chosen.values[n]), free[n]
        q = entry.parameters[n]
        free[n] = (max(min(low, -asked), q.min) if low < 0 else low, min(max(high, asked), q.max))
    wider = replace(chosen, free=FrozenMap(free))
    return replace(candidate, probes=(*candidate.probes[:probe], wider, *candidate.probes[probe + 1 :]))


def moved(candidate: CandidateEffect, probe: int, factor: float) -> dict[str, float]:
    """The probe's values with its size multiplied, within the refit's bounds; a reversed phase where that is meant."""
    values, free = candidate.probes[probe].values, candidate.probes[probe].free
    entry, found = effects()[candidate.effect], dict(values)
    most = EXACT if in_proportion(candidate, probe) else FAR
    size = float(np.clip(abs(factor), 1.0 / most, most)) if np.isfinite(factor) and factor else 1.0
    if factor < 0 and "phase" in found:
        found["phase"] += np.pi if found["phase"] <= 0 else -np.pi
    sign = -1.0 if factor < 0 and "phase" not in found else 1.0
    for n, q in entry.parameters.items():
        if q.neutral is None or n not in free or (q.optional and values[n] == q.neutral):
            continue
        neutral = values[q.neutral] if isinstance(q.neutral, str) else float(q.neutral)
        if np.isinf(neutral):
            # A delay is in proportion to 1/wn; where a bend begins is in proportion to nothing.
            if entry.equivalent_delay is not None and factor > 0:
                found[n] = values[n] / size
            continue
        found[n] = neutral + sign * size * (values[n] - neutral)
    for n, (low, high) in free.items():
        margin = 1e-3 * (high - low) if low <= 0 else 0.0
        found[n] = float(np.clip(found[n], low + margin if margin else low * 1.001, high - 1e-3 * (high - low)))
    return found
