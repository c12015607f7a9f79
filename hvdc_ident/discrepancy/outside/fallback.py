"""Outside the catalogue: the form of what is missing, found from the data, or the curve of it with its band."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.candidates import kind_of, source_signals
from hvdc_ident.discrepancy.context import Round, SearchContext
from hvdc_ident.discrepancy.formula import Law, filled, labelled
from hvdc_ident.discrepancy.options import SHORTLIST
from hvdc_ident.discrepancy.outside.filtered import shape, transfer_function
from hvdc_ident.discrepancy.outside.law import STABLE, Regression, law, over_signal, over_time, regression
from hvdc_ident.discrepancy.pushes import Pushed
from hvdc_ident.discrepancy.refit import Refit
from hvdc_ident.effects import effects
from hvdc_ident.files import plain
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.text import listed, percentage


@dataclass(frozen=True, eq=False)
class Fallback:
    """A form found outside the catalogue. kind: term, filter, disturbance, curve or nothing.

    at: the slot; expression and coefficients: of a term or a filter; stability: share of noise records that choose the same terms;
    curve: of the others, {over, at, value, std}. as_good: terms, {at, expression}, that explain as much. refit: the model with
    the term; text: a sentence.
    """

    kind: str
    at: str
    text: str
    expression: str = ""
    coefficients: FrozenMap[Any] = field(default_factory=FrozenMap)
    stability: float | None = None
    delta_bic: float | None = None
    curve: Mapping[str, Any] | None = None
    as_good: tuple[Mapping[str, str], ...] = ()
    refit: Refit | None = None

    def to_dict(self) -> dict[str, Any]:
        """As JSON takes it, without the model."""
        return {n: plain(getattr(self, n)) for n in self.__dataclass_fields__ if n != "refit"}


def fallback(search: SearchContext, opened: Round) -> Fallback:
    """A law found from the data; where none stands, a disturbance or a curve. opened: the search's first round, which may have
    looked for a law already."""
    found = law(search, opened) if opened.laws is None else next(iter(opened.laws), None)
    if found is not None:
        return law_found(found)
    return _curve(search, opened)


def _places(search: SearchContext, opened: Round) -> list[str]:
    """Slots inside the model that are heard at the outputs."""
    paths = opened.answers()
    inner = [p for p in opened.signals if kind_of(opened.before.model, p) in ("signal", "algebraic")]
    inner = [p for p in inner if search.looks_at(p)]
    path = next(iter(paths.values()))
    push = np.zeros((path.time.size, 1))
    push[path.time.size // 8 :] = 1.0
    return [p for p in inner if np.any(np.abs(path.answer(p, push)) > 1e-9)]


def law_found(found: Law) -> Fallback:
    """The formula, the curve or the filter that a refit ends with."""
    if found.refit.placed[-1].use.effect == "filter":
        return _filter_found(found)
    return _curve_found(found) if found.terms and found.terms[0].knots else _formula_found(found)


def _formula_found(found: Law) -> Fallback:
    refit = found.refit
    placed = refit.placed[-1]
    (place,) = placed.candidate.at
    text = (
        effects()["term"]
        .sentence.replace("{at}", place)
        .replace("{expression}", filled(placed.use.expression, refit.sizes(placed)))
    )
    said = [f"Found from the data, outside the catalogue: {text}."]
    if found.others:
        said.append(f"As good: {listed([labelled(r) for r in found.others])}.")
    if found.stability is not None and found.stability < STABLE:
        said.append(
            f"With other noise other terms would have been chosen in {percentage(1 - found.stability)} of all cases."
        )
    return Fallback(
        "term", place, " ".join(said), placed.use.expression, _sizes(refit), found.stability, found.gain, None,
        tuple({"at": r.placed[-1].candidate.at[0], "expression": r.placed[-1].use.expression} for r in found.others), refit,
    )  # fmt: skip


def _filter_found(found: Law) -> Fallback:
    refit, others = found.refit, found.others
    text = f"{_at(refit)} passes {shape(refit)}, H(s) = {transfer_function(refit)}"
    said = [f"Found from the data, outside the catalogue: {text}."]
    if others:
        said.append(f"As good: one at {listed([_at(r) for r in others])}.")
    return Fallback(
        "filter", _at(refit), " ".join(said), transfer_function(refit), _sizes(refit), delta_bic=found.gain,
        as_good=tuple({"at": _at(r), "expression": transfer_function(r)} for r in others), refit=refit,
    )  # fmt: skip


def _at(refit: Refit) -> str:
    """Where what was put in last sits."""
    return ", ".join(refit.placed[-1].candidate.at)


def _sizes(refit: Refit) -> FrozenMap[Any]:
    """By parameter of what was put in last its value, and the interval that holds it in 95 of 100 cases where that is known."""
    placed, shown = refit.placed[-1], {}
    for n, value in refit.sizes(placed).items():
        std = refit.std.get(placed.names[n])
        shown[n] = {"value": value, "ci95": None if std is None else [value - 1.96 * std, value + 1.96 * std]}
    return FrozenMap(shown)


def _curve_found(found: Law) -> Fallback:
    placed, (over,) = found.refit.placed[-1], found.terms[0].signals
    (place,) = placed.candidate.at
    std = [found.refit.std.get(name) for name in placed.names.values()]
    curve = {
        "over": over, "at": list(found.terms[0].knots), "value": list(found.refit.sizes(placed).values()), "std": std,
    }  # fmt: skip
    text = f"Found from the data, outside the catalogue: {place} is off by what hangs on {over} alone, a curve given with its band."
    return Fallback("curve", place, text, placed.use.expression, delta_bic=found.gain, curve=curve, refit=found.refit)


@dataclass(frozen=True, eq=False)
class _Shape:
    """A hidden input at a place as hats over time or a signal. worth: the fall of chi2 less the price of its knots."""

    worth: float
    place: str
    over: str
    at: Array
    values: Array
    found: Regression


def _curve(search: SearchContext, opened: Round) -> Fallback:
    """The hidden input over time or over a signal, whichever explains more for its number of knots."""
    paths, nominal = opened.answers(), opened.before.nominal()
    begin, end = min(a.time[0] for a in paths.values()), max(a.time[-1] for a in paths.values())
    signals = source_signals(opened.before.model, opened.signals)
    hats = over_time(paths)

    def shape(place: str, over: str, at: Array, functions: Sequence[Callable[[str, Pushed], Array]]) -> _Shape:
        found = regression(nominal, paths, place, functions)
        values, gain = found.solved(range(len(functions)))
        return _Shape(gain - len(functions) * float(np.log(nominal.residual.size)), place, over, at, values, found)

    in_time = [shape(p, "time", np.linspace(begin, end, len(hats)), hats) for p in _places(search, opened)]
    in_time.sort(key=lambda s: -s.worth)
    shapes = [s for s in in_time if s.worth > 0]
    for place in [s.place for s in in_time[:SHORTLIST]]:
        for over in dict.fromkeys([place, *signals[:4]]):
            if np.ptp(np.concatenate([a.signal(over) for a in paths.values()])) > 0:
                shapes.append(shape(place, over, *over_signal(paths, over)))
    best = max(shapes, key=lambda s: s.worth, default=None)
    if best is None or best.worth <= 0:
        return Fallback("nothing", "", "No hidden input at any one place explains it.")
    place, columns = best.place, best.found.columns
    spread = np.sqrt(np.maximum(np.diag(np.linalg.pinv(columns.T @ columns, rcond=1e-10)), 0.0))
    curve = {"over": best.over, "at": best.at.tolist(), "value": best.values.tolist(), "std": spread.tolist()}
    if best.over == "time":
        repeats = len(opened.before.problem.fitted_experiments) > 1
        text = (
            f"It acts at {place} at the same times in every experiment, whatever the state: a disturbance"
            if repeats
            else (f"It acts at {place}; with one experiment a disturbance cannot be told from a form")
        )
        return Fallback("disturbance" if repeats else "curve", place, f"{text}.", delta_bic=best.worth, curve=curve)
    text = f"No formula is stable; what is missing at {place} is given as a curve over {best.over} with its band."
    return Fallback("curve", place, text, delta_bic=best.worth, curve=curve)
