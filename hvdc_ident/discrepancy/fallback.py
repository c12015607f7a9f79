"""Outside the catalogue: the form of what is missing, found from the data, or the curve of it with its band."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hvdc_ident.discrepancy.adequacy import adequacy
from hvdc_ident.discrepancy.candidates import kind_of, source_signals
from hvdc_ident.discrepancy.formula import at_run, filled, formula_job
from hvdc_ident.discrepancy.hidden import Regression, over_signal, over_time, regression
from hvdc_ident.discrepancy.library import Term, terms
from hvdc_ident.discrepancy.noise import draws
from hvdc_ident.discrepancy.refit import Refit, run, unseen
from hvdc_ident.discrepancy.scores import Path
from hvdc_ident.discrepancy.search import Outcome
from hvdc_ident.discrepancy.select import Ruler
from hvdc_ident.discrepancy.state import Search, slot_signals
from hvdc_ident.effects import effects
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.fit.result import plain
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.trajectory import Array

MOST = 3
STABLE = 0.8
AGAIN = 25
CLOSE = 2.0
"""What a term may leave, in noise units (of chi2 a row, and held out)."""
PLACES = 6
"""Places, the best by regression, at which the form is tried by full simulation."""


@dataclass(frozen=True, eq=False)
class Fallback:
    """What was found outside the catalogue. kind: term, disturbance, curve or nothing.

    at: the slot; expression and coefficients: of a term; stability: share of noise records that choose the same terms;
    curve: of the others, {over, at, value, std}. refit: the model with the term; text: a sentence.
    """

    kind: str
    at: str
    text: str
    expression: str = ""
    coefficients: FrozenMap[Any] = field(default_factory=FrozenMap)
    stability: float | None = None
    delta_bic: float | None = None
    curve: Mapping[str, Any] | None = None
    refit: Refit | None = None

    def to_dict(self) -> dict[str, Any]:
        """As JSON takes it, without the model."""
        return {n: plain(getattr(self, n)) for n in self.__dataclass_fields__ if n != "refit"}


def fallback(search: Search, first: Refit, outcome: Outcome) -> Fallback:
    """A term found from the data and refitted by full simulation; where none is stable, a disturbance or a curve."""
    nominal, paths = first.nominal(), outcome.rounds[0].answers()
    places = _places(search, first, paths)
    signals = source_signals(first.model, slot_signals(paths))
    price = search.options.named_bic + float(np.log(nominal.residual.size))
    ranked = []
    for k, place in enumerate(places):
        search.tell(k, len(places), f"hidden input at {place}")
        library = terms([place, *(s for s in signals if s != place)] if not _is_output(first, place) else signals)
        found = regression(nominal, paths, place, [at_run(t) for t in library])
        chosen = found.selected(MOST, price)
        if chosen:
            coefficients, gain = found.solved(chosen)
            score = gain - len(chosen) * price
            ranked.append((score, place, [library[j] for j in chosen], coefficients, found, chosen))
    ranked.sort(key=lambda item: -item[0])
    tried: list[tuple[float, Fallback]] = []
    for _, place, chosen_terms, coefficients, found, chosen in ranked[:PLACES]:
        stability = _stability(search, first, found, chosen, coefficients, price)
        if stability >= STABLE:
            made = _inserted(search, first, place, chosen_terms, coefficients, stability)
            if made is not None and made.refit is not None:
                tried.append((made.refit.chi2 + len(chosen) * price, made))
    if tried:
        return min(tried, key=lambda item: item[0])[1]
    return _curve(search, first, paths, [p for _, p, *_ in ranked] or places)


def _is_output(first: Refit, place: str) -> bool:
    return kind_of(first.model, place) == "output"


def _places(search: Search, first: Refit, paths: Mapping[str, Path]) -> list[str]:
    """Slots inside the model that are heard at the outputs."""
    inner = [p for p in slot_signals(paths) if kind_of(first.model, p) in ("signal", "algebraic")]
    if search.places is not None:
        named = {p for g in search.places for p in ((g,) if isinstance(g, str) else g)}
        inner = [p for p in inner if p in named]
    path = next(iter(paths.values()))
    heard = []
    for p in inner:
        push = np.zeros((1, path.time.size, 1))
        push[0, path.time.size // 8 :, 0] = 1.0
        if np.any(np.abs(path.answer([p], push)[1]) > 1e-12):
            heard.append(p)
    return heard


def _stability(
    search: Search, first: Refit, found: Regression, chosen: Sequence[int], coefficients: Array, price: float
) -> float:
    """The share of records, the terms' answer with other noise, from which the same terms are chosen."""
    nominal = first.nominal()
    noise = nominal.projected(
        np.vstack(draws(first.problem, nominal.blocks, first.noise, nominal.fitted(), AGAIN, search.seed + 77))
    )
    explained = found.columns[:, list(chosen)] @ coefficients
    same = 0
    for b in range(AGAIN):
        again = Regression(found.columns, explained + noise[:, b])
        same += set(again.selected(MOST, price)) == set(chosen)
    return same / AGAIN


def _inserted(
    search: Search, first: Refit, place: str, chosen: Sequence[Term], coefficients: Array, stability: float
) -> Fallback | None:
    """The term in the model, refitted; None where it does not stand the tests an effect of the catalogue has to."""
    try:
        refit = run(formula_job(first, place, chosen, coefficients))
    except HvdcIdentError:
        return None
    if refit.failure:
        return None
    gain = Ruler.of(refit).gain(first.chi2, refit.chi2, refit.count)
    was, now = unseen(first), unseen(refit)
    if not (
        gain > search.options.named_bic
        and was is not None
        and now is not None
        and was - now > search.options.holdout_share
    ):
        return None
    if refit.chi2 / refit.rows > CLOSE or now > CLOSE:
        return None  # a formula is a claim: what it leaves has to be next to noise
    explained = first.chi2 - refit.chi2
    tests = adequacy(refit.nominal(), {}, bootstraps=100, seed=search.seed)
    if any(b.p <= 0.01 and b.excess > search.options.refuted * explained for b in tests):
        return None
    return formula_found(refit, gain, stability)


def formula_found(refit: Refit, gain: float, stability: float | None = None) -> Fallback:
    """The formula that a refit ends with. gain: delta BIC; stability: share of noise records that choose the same terms."""
    placed = refit.placed[-1]
    (place,) = placed.candidate.at
    shown = {}
    for n, value in refit.sizes(placed).items():
        std = refit.std.get(placed.names[n])
        shown[n] = {"value": value, "ci95": None if std is None else [value - 1.96 * std, value + 1.96 * std]}
    text = effects()["term"].sentence.replace("{at}", place).replace("{expression}", filled(placed, refit))
    return Fallback(
        "term", place, f"Found from the data, outside the catalogue: {text}.", placed.use.expression,
        FrozenMap(shown), stability, gain, None, refit,
    )  # fmt: skip


def _curve(search: Search, first: Refit, paths: Mapping[str, Path], places: Sequence[str]) -> Fallback:
    """The hidden input over time or over a signal, whichever explains more for its number of knots."""
    nominal = first.nominal()
    rows = float(np.log(nominal.residual.size))
    best: tuple[float, str, str, Array, Regression, Array] | None = None
    signals = source_signals(first.model, slot_signals(paths))
    for place in list(places)[:PLACES]:
        begin, end = min(a.time[0] for a in paths.values()), max(a.time[-1] for a in paths.values())
        hats = over_time(paths)
        options = [("time", np.linspace(begin, end, len(hats)), hats)]
        for s in dict.fromkeys([place, *signals[:4]]):
            if np.ptp(np.concatenate([a.signal(s) for a in paths.values()])) > 0:
                options.append((s, *over_signal(paths, s)))
        for over, at, functions in options:
            found = regression(nominal, paths, place, functions)
            values, gain = found.solved(range(len(functions)))
            worth = gain - len(functions) * rows
            if worth > 0 and (best is None or worth > best[0]):
                best = (worth, place, over, at, found, values)
    if best is None:
        return Fallback("nothing", "", "No hidden input at any one place explains it.")
    worth, place, over, at, found, values = best
    spread = np.sqrt(np.maximum(np.diag(np.linalg.pinv(found.columns.T @ found.columns, rcond=1e-10)), 0.0))
    curve = {"over": over, "at": at.tolist(), "value": values.tolist(), "std": spread.tolist()}
    if over == "time":
        repeats = len(first.problem.fitted_experiments) > 1
        text = (
            f"It acts at {place} at the same times in every experiment, whatever the state: a disturbance"
            if repeats
            else (f"It acts at {place}; with one experiment a disturbance cannot be told from a form")
        )
        return Fallback("disturbance" if repeats else "curve", place, f"{text}.", delta_bic=worth, curve=curve)
    text = f"No formula is stable; what is missing at {place} is given as a curve over {over} with its band."
    return Fallback("curve", place, text, delta_bic=worth, curve=curve)
