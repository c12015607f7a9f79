"""Signatures: how the outputs would differ if an effect were there, at a finite size, without compiling it in.

The effect's own equations turn the slot's signal u into y; y - u is put on the slot of the model as it stands, whose
answer changes u; a few passes close the loop. Where y is a straight line in the effect's size the first pass is the
derivative, and enough.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.options import TOLERANCE
from hvdc_ident.discrepancy.signatures.block import block, parameter
from hvdc_ident.discrepancy.signatures.candidates import CandidateEffect
from hvdc_ident.discrepancy.signatures.closed import Ends
from hvdc_ident.discrepancy.signatures.propagation import replaced
from hvdc_ident.discrepancy.signatures.response import Along
from hvdc_ident.effects import effects, split_sources

PASSES = 4
CLOSED = 0.05
"""A change from pass to pass that counts as none."""
LOOSE = 0.3
"""A change in the last pass from which the signature is not to be used: the loop would not settle, or not so."""
TOGETHER = 4_000_000
"""Numbers of outputs' answers that are kept in memory at a time."""


@dataclass(frozen=True)
class SignatureColumn:
    """One probe of one candidate, by their places in the lists."""

    candidate: int
    probe: int


@dataclass(frozen=True)
class Kind:
    """Key of one set of an effect's equations. present: the parameters away from neutral."""

    effect: str
    present: tuple[str, ...]
    brings: bool


@dataclass(frozen=True)
class Task:
    """One column: its equations, slots, the signals it brings in (none, one for all slots, or one each), its values, its
    place among the columns."""

    kind: Kind
    at: tuple[str, ...]
    sources: tuple[str, ...]
    values: tuple[float, ...]
    index: int


def columns_of(candidates: Sequence[CandidateEffect]) -> tuple[SignatureColumn, ...]:
    """Every probe of every candidate whose signal moves."""
    return tuple(SignatureColumn(i, k) for i, c in enumerate(candidates) if not c.still for k in range(len(c.probes)))


def tasks(
    candidates: Sequence[CandidateEffect], columns: Sequence[SignatureColumn], size: int
) -> tuple[tuple[Task, ...], ...]:
    """The columns in parcels; those at the same slots, which are computed together, stand in one. size: of one answer."""
    most = max(TOGETHER // max(size, 1), 50)
    by_place: dict[tuple[str, ...], list[Task]] = {}
    for k, column in enumerate(columns):
        c = candidates[column.candidate]
        present = _present(c.effect, c.probes[column.probe].values)
        values = tuple(float(c.probes[column.probe].values[n]) for n in present)
        own = c.sources if len(set(c.sources)) > 1 else c.sources[:1]
        task = Task(Kind(c.effect, present, bool(own)), c.at, own, values, k)
        by_place.setdefault((*c.at, *own), []).append(task)
    parcels: list[list[Task]] = [[]]
    for members in by_place.values():
        if parcels[-1] and len(parcels[-1]) + len(members) > most:
            parcels.append([])
        parcels[-1] += members
    return tuple(tuple(p) for p in parcels if p)


def _present(effect: str, values: Mapping[str, float]) -> tuple[str, ...]:
    return tuple(
        n for n, q in effects()[effect].parameters.items() if not (q.optional and values.get(n, q.neutral) == q.neutral)
    )


def kind_of(candidate: CandidateEffect, probe: int) -> Kind:
    """The equations that a probe of a candidate asks for."""
    return Kind(candidate.effect, _present(candidate.effect, candidate.probes[probe].values), bool(candidate.source))


def additions(
    effect: str, values: Mapping[str, float], at: Sequence[str], source: str, paths: Iterable[Along | Ends]
) -> list[Array]:
    """Return what an effect with these values adds to the signals of its slots, (K,) each, by run and slot, without the plant.

    source: the signals that it brings in, as a candidate has them; paths: the runs of the model without it.
    """
    present = _present(effect, values)
    own = {parameter(n): np.array([values[n]]) for n in present}
    run = block(effect, present, bool(source)).run
    found = []
    sources = split_sources(source, at)
    for path in paths:
        for k, place in enumerate(at):
            u = path.signal(place)[:, None]
            brought = path.signal(sources[k])[:, None] if sources else None
            found.append(np.asarray(run(own, path.time, u, brought) - u)[:, 0])
    return found


def alike(one: Array, other: Array) -> bool:
    """Return True for two additions whose difference is within the tolerance: that share of the square of the larger."""
    return bool(np.sum((one - other) ** 2) <= TOLERANCE * max(np.sum(one**2), np.sum(other**2)))


@lru_cache(maxsize=256)
def is_linear(kind: Kind) -> bool:
    """Return True where the effect adds to its slot in proportion to its size."""
    entry = effects()[kind.effect]
    own = [n for n in kind.present if entry.parameters[n].neutral is not None]
    return bool(own) and block(kind.effect, kind.present, kind.brings).linear(tuple(parameter(n) for n in own))


def signatures(
    model: Along | Ends, parcels: Sequence[tuple[Task, ...]]
) -> Iterator[tuple[NDArray[np.intp], Array, Array]]:
    """(columns' places, (o, R, nc) differences of the outputs, (nc,) change in the last pass) by parcel."""
    for parcel in parcels:
        work = _Parcel(model, parcel)
        work.close()
        yield np.array([t.index for t in parcel]), work.y, work.change


class _Parcel:
    """Some columns on their way to a closed loop. u: by column what its slots, then the brought signals, see (m, K)."""

    def __init__(self, model: Along | Ends, parcel: tuple[Task, ...]) -> None:
        self.model, self.parcel = model, parcel
        self.places = [(*t.at, *t.sources) for t in parcel]
        self.base = [np.array([model.signal(p) for p in at]) for at in self.places]
        self.u = list(self.base)
        self.y = np.zeros((len(model.outputs), model.count, len(parcel)))
        self.change = np.full(len(parcel), np.inf)

    def close(self) -> None:
        """Passes until the loops are closed; columns that are there already are left out of the next."""
        left = list(range(len(self.parcel)))
        for step in range(PASSES):
            d = self._disturbances(left)
            left = [c for c in left if c in d]
            self._answers(left, d, step)
            left = [c for c in left if self.change[c] > CLOSED and not (step == 0 and is_linear(self.parcel[c].kind))]
            if not left:
                break
        for c, t in enumerate(self.parcel):
            if np.isinf(self.change[c]) and is_linear(t.kind) and np.isfinite(self.y[:, :, c]).all():
                self.change[c] = 0.0

    def _disturbances(self, which: Sequence[int]) -> dict[int, Array]:
        """Additions of each effect to its slots' signals, (m, K); columns where these are not finite are left out."""
        groups: dict[Kind, list[int]] = {}
        for c in which:
            groups.setdefault(self.parcel[c].kind, []).append(c)
        found: dict[int, Array] = {}
        for kind, members in groups.items():
            widths = [len(self.parcel[c].at) for c in members]
            u = np.concatenate([self.u[c][: len(self.parcel[c].at)] for c in members]).T
            brought = None
            if kind.brings:
                brought = np.concatenate(
                    [np.resize(self.u[c][w:], (w, self.u[c].shape[1])) for c, w in zip(members, widths, strict=True)]
                ).T
            own = {
                parameter(n): np.repeat([self.parcel[c].values[k] for c in members], widths)
                for k, n in enumerate(kind.present)
            }
            d = (block(kind.effect, kind.present, kind.brings).run(own, self.model.time, u, brought) - u).T
            for c, part in zip(members, np.split(d, np.cumsum(widths)[:-1]), strict=True):
                if np.isfinite(part).all():
                    found[c] = part
        return found

    def _answers(self, which: Sequence[int], d: dict[int, Array], step: int) -> None:
        """Puts the disturbances on the model: new outputs, new signals at the slots, and how far the outputs moved."""
        groups: dict[tuple[str, ...], list[int]] = {}
        for c in which:
            groups.setdefault(self.places[c], []).append(c)
        for places, members in groups.items():
            put = np.zeros((len(places), self.model.time.size, len(members)))
            for k, c in enumerate(members):
                put[: d[c].shape[0], :, k] = d[c]
            du, y = self.model.answer(places, put)
            size, moved = np.zeros(len(members)), np.zeros(len(members))
            replaced(y, np.array(members, dtype=np.intp), self.y, size, moved)
            size, moved = np.sqrt(size), np.sqrt(moved)
            with np.errstate(invalid="ignore", divide="ignore"):
                ratio = np.where(size > 0, moved / size if step else np.inf, 0.0)
            for k, c in enumerate(members):
                self.change[c] = ratio[k]
                self.u[c] = self.base[c] + du[:, :, k]
