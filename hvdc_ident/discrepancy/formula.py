"""Terms that a hidden input may be made of: powers, magnitudes and products of the model's own signals, and their drifts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.placed import Placed
from hvdc_ident.discrepancy.pushes import Pushed
from hvdc_ident.discrepancy.refit import Refit, RefitJob
from hvdc_ident.effects import EffectUse, apply_effects
from hvdc_ident.fit import FitParameter
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.simulate import ModelSimulator

MOST = 7
"""Signals the terms are made of."""
TIME = "time"
"""Name of the time, s, in a formula: a signal drifts in proportion to it, or its gain does."""


@dataclass(frozen=True)
class Term:
    """A term: its text in the model's names, the signals in it, and how it is computed from them.

    knots: of a hat over a signal's levels, which is 1 at the one of number `peak` and 0 at the others.
    """

    text: str
    signals: tuple[str, ...]
    form: str
    knots: tuple[float, ...] = ()
    peak: int = 0

    def __call__(self, values: Sequence[Array]) -> Array:
        """The term along a run, (K,)."""
        a = values[0]
        b = values[-1]
        if self.form == "hat":
            return np.asarray(np.interp(a, self.knots, np.eye(len(self.knots))[self.peak]))
        return {
            "x": a, "x2": a**2, "x3": a**3, "xx": a * np.abs(a), "abs": np.abs(a), "xy": a * b, "x2y": a**2 * b,
        }[self.form]  # fmt: skip


def terms(signals: Sequence[str]) -> tuple[Term, ...]:
    """The library over some signals, the simplest first."""
    chosen = list(dict.fromkeys(signals))[:MOST]
    found = [Term(n, (n,), "x") for n in chosen]
    found += [Term(f"{n}**2", (n,), "x2") for n in chosen]
    found += [Term(f"{n}**3", (n,), "x3") for n in chosen]
    found += [Term(f"{n}*abs({n})", (n,), "xx") for n in chosen]
    found += [Term(f"abs({n})", (n,), "abs") for n in chosen]
    found += [Term(f"{a}*{b}", (a, b), "xy") for i, a in enumerate(chosen) for b in chosen[i + 1 :]]
    found += [Term(TIME, (TIME,), "x"), *(Term(f"{n}*{TIME}", (n, TIME), "xy") for n in chosen)]
    return tuple(found)


def hats(signal: str, levels: Array) -> tuple[Term, ...]:
    """A hat for each of some levels of a signal, rising: times its values there, their sum is a curve, level at both ends."""
    knots = tuple(dict.fromkeys(float(f"{v:.6g}") for v in levels))
    rises = [f"(clip({signal}, {a!r}, {b!r}) - {a!r})/{(b - a)!r}" for a, b in pairwise(knots)]
    falls = [f" - {r}" for r in rises]
    texts = [f"({up}{down})" for up, down in zip(["1", *rises], [*falls, ""], strict=True)]
    return tuple(Term(t, (signal,), "hat", knots, k) for k, t in enumerate(texts))


def along(term: Term, time: Array, values: Mapping[str, Array]) -> Array:
    """The term along a run. time: (K,) its instants, s; values: its signals, (K,) each."""
    return term([time if n == TIME else values[n] for n in term.signals])


WIDE = 20.0
"""Times its start value: how large a coefficient may become."""
LESS = (0.3, 0.1)
"""Shares of its start value to begin from where the model does not run with it: a power that is too large runs away."""


@dataclass(frozen=True, eq=False)
class Law:
    """A formula in the model, refitted, or a curve.

    gain: delta BIC over the model without it. stability: share of noise records that choose the same terms. near: whether it
    comes near the noise, and nothing of the catalogue does. terms: those of it; of a curve hats over one signal. others:
    refits of other formulas, or of the same at other places, that explain as much.
    """

    refit: Refit
    gain: float
    stability: float | None = None
    near: bool = False
    terms: tuple[Term, ...] = ()
    others: tuple[Refit, ...] = ()


def formula_job(before: Refit, place: str, chosen: Sequence[Term], coefficients: Array) -> RefitJob:
    """The refit of a model with the sum of k1, k2, … times the terms added at a slot, begun at those coefficients.

    Raises ModelError where the term cannot be put there.
    """
    names = [f"k{i + 1}" for i in range(len(chosen))]
    expression = " + ".join(f"{n}*{t.text}" for n, t in zip(names, chosen, strict=True))
    values = {n: float(c) for n, c in zip(names, coefficients, strict=True)}
    use = EffectUse("term", (place,), FrozenMap(values), expression=expression)
    had = set(before.model.parameters)
    model = apply_effects(before.model, [use])
    new = [n for n in model.parameters if n not in had]
    # Of a curve the largest value tells how large the others may become: one may begin at 0.
    most = max(map(abs, values.values())) if all(t.form == "hat" for t in chosen) else 0.0
    bounds = {n: (-WIDE * max(abs(v), most), WIDE * max(abs(v), most)) for n, v in values.items()}
    free = tuple(FitParameter(m, values[n], *bounds[n]) for n, m in zip(names, new, strict=True))
    problem = replace(before.problem, simulator=ModelSimulator(model), free=(*before.problem.free, *free))
    placed = Placed(
        CandidateEffect("term", (place,), ()),
        use,
        FrozenMap(dict(zip(names, new, strict=True))),
        FrozenMap(bounds),
        FrozenMap(values),
    )
    k = len(before.problem.free)
    begin, *spare = (
        np.concatenate([before.theta[:k], [share * v for v in values.values()], before.theta[k:]])
        for share in (1.0, *LESS)
    )
    return RefitJob(model, (*before.placed, placed), problem, (begin,), before.noise, spare=tuple(spare))


def labelled(refit: Refit) -> str:
    """The formula that a refit ends with, and where."""
    placed = refit.placed[-1]
    return f"{filled(placed.use.expression, refit.sizes(placed))} at {placed.candidate.at[0]}"


def filled(text: str, sizes: Mapping[str, float]) -> str:
    """A formula with its coefficients as they came out."""
    for n, value in sizes.items():
        text = text.replace(f"{n}*", f"{value:.4g}*")
    return text.replace("+ -", "- ")


def at_run(term: Term) -> Callable[[str, Pushed], Array]:
    """The term along an experiment's run, as a regression takes it."""
    return lambda _, path: along(term, path.time, path.values)


def at_runs(term: Term, paths: Mapping[str, Pushed]) -> list[Array]:
    """The term along every run, (K,) each."""
    return [along(term, path.time, path.values) for path in paths.values()]
