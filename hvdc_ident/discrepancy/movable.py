"""Movable effects: an effect compiled into a model once, whose place, source and sizes are chosen at run time.

With weights c and f that are 1 at the place and the source and 0 elsewhere, an effect y(u, source) of the catalogue acts as

    z = sum_p c_p u_p            the signal at the place
    s = sum_q f_q u_q            the signal that it brings in, where it does
    d = y(z, s) - z              what it changes
    every place p reads          u_p + c_p d

so that all candidates of one effect run on the same machine code. A signal on an algebraic loop is moved by what it moves: z and s
are unknowns there. Elsewhere u_p and u_q are what the model's own equations give without any d, and nothing has to be solved for.
The states, delays and events of the effect are those of the catalogue. An effect on a state's own equation does the same with the
state's derivative. At several places the effect stands once for each, with the sizes in common.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import numpy as np
import sympy as sp

from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.effects import Additions, Effect, effects, leads_back
from hvdc_ident.expression import symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Algebraic, Model, Output, Signal, fresh, insertion_point, rewritten, with_derivative_signal
from hvdc_ident.parameters import Input, Parameter
from hvdc_ident.simulate import Method, ModelSimulator, Tolerance


@dataclass(frozen=True)
class Form:
    """Equations that several candidates share.

    present: the effect's parameters that stand in them, optional ones at neutral left out; copies: places that it sits at
    together; seat: the kind of insertion point and whether it lies on an algebraic loop, as far as the equations depend on it;
    loop: whether it lies on one.
    """

    effect: str
    present: tuple[str, ...]
    copies: int = 1
    seat: tuple[str, bool] = ("signal", False)
    loop: bool = False

    @classmethod
    def of(cls, model: Model, candidate: CandidateEffect, values: Mapping[str, float]) -> Form:
        """Return the form of a candidate with these sizes."""
        present = effects()[candidate.effect].present(values)
        seats = {(insertion_point(model, p)[0], on_loop(model, p)) for p in candidate.at}
        alike = len({equations(candidate.effect, present, *s) for s in (*seats, ("signal", False))}) == 1
        loop = any(circular for _, circular in seats)
        return cls(candidate.effect, present, len(candidate.at), ("signal", False) if alike else max(seats), loop)


@dataclass(frozen=True, eq=False)
class Movable:
    """A model with an effect that can be moved.

    names: the effect's parameters by those of the model; at, sources: by copy the weights of the places, by place.
    """

    model: Model
    form: Form
    names: FrozenMap[str]
    at: tuple[FrozenMap[str], ...]
    sources: tuple[FrozenMap[str], ...]

    def placed(self, candidate: CandidateEffect) -> dict[str, float]:
        """Return the weights, by name, that put the effect where a candidate has it."""
        weights = dict.fromkeys((n for copy in (*self.at, *self.sources) for n in copy.values()), 0.0)
        for copy, place in zip(self.at, candidate.at, strict=True):
            weights[copy[place]] = 1.0
        for copy, source in zip(self.sources, candidate.sources, strict=True):
            weights[copy[source]] = 1.0
        return weights

    def simulator(self, tolerance: Tolerance, method: Method) -> ModelSimulator:
        """Return the simulator of its runs. method: of them all; the engine would choose it by the first that a process runs, and the
        last digits of the others would hang on that."""
        return ModelSimulator(self.model, tolerance, method)

    def sized(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return the effect's sizes by the names that they have in the model."""
        return {name: values[n] for n, name in self.names.items()}


def movable(model: Model, form: Form, places: Sequence[str], sources: Sequence[str]) -> Movable:
    """Return the model with a movable effect of this form, absent until it is placed.

    places: insertion points that it may sit at; sources: signals that it may bring in, where it brings any in.
    """
    return _movable(model, form, tuple(places), tuple(sources) if effects()[form.effect].needs_source else ())


@lru_cache(maxsize=64)
def _movable(model: Model, form: Form, places: tuple[str, ...], sources: tuple[str, ...]) -> Movable:
    entry, prefix = effects()[form.effect], fresh(model, "moved")
    copies = tuple(f"{prefix}{c}" for c in range(1, form.copies + 1))
    names = {n: f"{prefix}_{n}" for n in form.present}
    brought = [{s: f"{c}_from_{k}" for k, s in enumerate(sources)} for c in copies] if entry.needs_source else []
    # A refit has bounds of its own; the values stand for nothing, but have to be finite: an effect that is absent is run too.
    sizes = {
        names[n]: Parameter(entry.example.get(n, 1.0), entry.parameters[n].unit, -math.inf, math.inf)
        for n in form.present
    }
    weights = {n: Parameter(0.0, min=0.0, max=1.0) for copy in brought for n in copy.values()}
    seated = _seated(model, prefix, copies, places, of_derivative=entry.of_derivative)
    model = replace(seated.model, parameters=seated.model.parameters | sizes | weights)
    solved = form.loop or form.copies > 1
    for k, c in enumerate(copies):
        model = _with_copy(model, entry, form, c, names, seated, k, brought[k] if brought else {}, solved=solved)
    model = replace(model, origin=None)
    return Movable(model, form, FrozenMap(names), seated.at, tuple(FrozenMap(b) for b in brought))


@dataclass(frozen=True, eq=False)
class _Seated:
    """A model whose places read what is added there, which effects that may sit at the same places have in common.

    moved: by place the signal before that; own: by name the expression of each place and signal of the model's own equations.
    at: by copy the weights of the places. What each copy adds is a signal, 0 until the copy is there.
    """

    model: Model
    moved: FrozenMap[sp.Expr]
    own: FrozenMap[sp.Expr]
    at: tuple[FrozenMap[str], ...]


@lru_cache(maxsize=16)
def _seated(
    model: Model, prefix: str, copies: tuple[str, ...], places: tuple[str, ...], *, of_derivative: bool
) -> _Seated:
    at = tuple(FrozenMap({p: f"{c}_at_{k}" for k, p in enumerate(places)}) for c in copies)
    unmoved = {symbol(n): symbol(f"{prefix}_own_{n}") for n in model.signals}
    own: dict[str, sp.Expr] = {n.name: seen for n, seen in unmoved.items()}
    for place in places:
        kind, name = insertion_point(model, place)
        if of_derivative:
            own[place] = model.states[name].derivative.xreplace(unmoved)
        elif kind == "output":
            own[place] = model.outputs[name].value.xreplace(unmoved)
        elif kind == "algebraic":
            own[place] = model.algebraic[name].equation.xreplace(unmoved)
    beside = {unmoved[symbol(n)].name: Signal(s.value.xreplace(unmoved)) for n, s in model.signals.items()}
    model = replace(
        model,
        parameters=model.parameters | {n: Parameter(0.0, min=0.0, max=1.0) for copy in at for n in copy.values()},
        signals=model.signals | {f"{c}_d": Signal(sp.S.Zero) for c in copies},
        origin=None,
    )
    moved: dict[str, sp.Expr] = {}
    for place in places:

        def read(m: Model, u: sp.Expr, place: str = place) -> tuple[Model, sp.Expr]:
            moved[place] = u
            return m, sp.Add(u, *(symbol(c_at[place]) * symbol(f"{c}_d") for c, c_at in zip(copies, at, strict=True)))

        model, changed = with_derivative_signal(model, place) if of_derivative else (model, place)
        model = rewritten(model, changed, prefix, read)
    return _Seated(replace(model, signals=model.signals | beside), FrozenMap(moved), FrozenMap(own), at)


def _with_copy(
    model: Model,
    entry: Effect,
    form: Form,
    copy: str,
    names: Mapping[str, str],
    seated: _Seated,
    number: int,
    sources: Mapping[str, str],
    *,
    solved: bool,
) -> Model:
    """Return the model with one copy of the effect, which acts on the sum of the signals at its places by their weights.

    solved: whether that sum is an unknown.
    """
    at, before = seated.at[number], seated.moved if solved else seated.own
    z = symbol(f"{copy}_z")
    sums = {z.name: sp.Add(*(symbol(w) * before.get(p, symbol(p)) for p, w in at.items()))}
    p: dict[str, sp.Expr] = {n: symbol(name) for n, name in names.items()}
    if sources:
        p["from"] = symbol(f"{copy}_s")
        sums[f"{copy}_s"] = sp.Add(*(symbol(w) * before.get(s, symbol(s)) for s, w in sources.items()))
    if entry.of_derivative:
        p["state"] = symbol(f"{copy}_x")
        sums[f"{copy}_x"] = sp.Add(*(symbol(w) * symbol(place) for place, w in at.items()))
    if solved:
        model = replace(model, algebraic=model.algebraic | {n: Algebraic(e) for n, e in sums.items()})
    else:
        model = replace(model, signals=model.signals | {n: Signal(e) for n, e in sums.items()})
    add = Additions(model, copy, *form.seat)
    y = entry.rewrite(z, p, add)
    return replace(add.model, signals=add.model.signals | {f"{copy}_d": Signal(y - z)})


@lru_cache(maxsize=1024)
def on_loop(model: Model, place: str) -> bool:
    """Return True for an insertion point on an algebraic loop: its signal depends on itself at the same instant."""
    kind, name = insertion_point(model, place)
    return kind in ("signal", "algebraic") and leads_back(model, name)


@cache
def equations(effect: str, present: tuple[str, ...], kind: str = "signal", circular: bool = False) -> Model:
    """Return the effect's equations on a signal by itself, as they are at such an insertion point."""
    entry, u = effects()[effect], symbol("u")
    through = Model(
        "effect",
        FrozenMap({n: Parameter(0.0) for n in present}),
        inputs=FrozenMap({"u": Input(), "source": Input(), "x": Input()}),
        outputs=FrozenMap({"y": Output(u)}),
    )
    p = {n: symbol(n) for n in present} | {"from": symbol("source"), "state": symbol("x")}
    add = Additions(through, "e", kind, circular)
    y = entry.rewrite(u, p, add)
    return replace(add.model, outputs=FrozenMap({"y": Output(y)}))


@cache
def is_proportional(form: Form) -> bool:
    """Return True where the effect adds to its signal in proportion to one of its sizes, whatever the others are, and remembers
    nothing that hangs on that size."""
    entry = effects()[form.effect]
    alone = equations(form.effect, form.present, *form.seat)
    added = sp.expand(alone.outputs["y"].value - symbol("u"))
    held = [s.derivative for s in alone.states.values()] + [s.rest for s in alone.states.values() if s.rest is not None]
    held += [d.of for d in alone.delays.values()] + [d.time for d in alone.delays.values()]
    held += [q.value for q in alone.sampled.values()] + [s.value for s in alone.signals.values()]
    remembered = {s for e in held if isinstance(e, sp.Basic) for s in e.free_symbols}

    symbols = sorted(added.free_symbols, key=str)
    random = np.random.default_rng(0)
    others = dict(zip(symbols, random.uniform(0.2, 0.8, (len(symbols), 8)), strict=True))
    evaluated = sp.lambdify(symbols, added)

    def counts(name: str) -> bool:
        k, neutral = symbol(name), entry.parameters[name].neutral
        if entry.parameters[name].fixed or not isinstance(neutral, float) or not math.isfinite(neutral):
            return False
        if k in remembered or k not in others:
            return False
        with np.errstate(all="ignore"):  # an edge of no width divides by it
            none, once, twice = (evaluated(*(others | {k: np.full(8, neutral + h)}).values()) for h in (0.0, 0.5, 1.0))
        return bool(np.allclose(none, 0.0, atol=1e-12) and np.allclose(twice, 2.0 * once, rtol=1e-9, atol=1e-12))

    return any(counts(n) for n in form.present)


def in_proportion(candidate: CandidateEffect, probe: int) -> bool:
    """Return True where a candidate adds to its signal in proportion to its size, as it stands in a probe."""
    entry, values = effects()[candidate.effect], candidate.probes[probe].values
    return is_proportional(Form(candidate.effect, entry.present(values)))
