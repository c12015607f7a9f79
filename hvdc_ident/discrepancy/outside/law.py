"""The hidden input of an equation: what would have to be added to a slot's signal, as terms, over time, or over a signal.

Weak form: nothing is differentiated. Each term is put on the slot as the model runs, and its answer at the outputs,
whitened and freed of what the parameters can make good, is a column of a regression of the residual.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.candidates import source_signals
from hvdc_ident.discrepancy.context import Round, SearchContext
from hvdc_ident.discrepancy.evidence import Ruler
from hvdc_ident.discrepancy.formula import Law, Term, at_run, formula_job, hats, terms
from hvdc_ident.discrepancy.nominal import Nominal
from hvdc_ident.discrepancy.options import BEAM, REFUTED, SHORTLIST
from hvdc_ident.discrepancy.pushes import Pushed, Whitening
from hvdc_ident.discrepancy.race import Race
from hvdc_ident.discrepancy.record_noise import draws
from hvdc_ident.discrepancy.refit import Refit, unseen
from hvdc_ident.discrepancy.refitted import is_far
from hvdc_ident.discrepancy.residual_checks import residual_tests
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.executor import mapped

TIME_KNOTS = 24
INDEPENDENT = 1e-8
"""Share of a column's square that is left beside those chosen: with less it is made of them."""


@dataclass(frozen=True, eq=False)
class Regression:
    """Columns of a linear model of the residual. columns: (N, k) projected; residual: (N,) projected."""

    columns: Array
    residual: Array

    def solved(self, which: Sequence[int]) -> tuple[Array, float]:
        """The coefficients of some columns, and the fall of chi2 they bring."""
        a = self.columns[:, list(which)]
        norms = np.maximum(np.linalg.norm(a, axis=0), 1e-300)
        c = np.linalg.lstsq(a / norms, self.residual, rcond=1e-8)[0]
        return c / norms, float(self.residual @ self.residual - np.sum((self.residual - (a / norms) @ c) ** 2))

    def selected(self, most: int, price: float, residual: Array | None = None) -> list[int]:
        """Columns that lower chi2 by more than their price: the best one, pair, and so on, each found from the pair before.

        Of columns that are much alike none of two that explain the residual together need be the best by itself: pairs are
        all looked at, a further one is added to them. residual: (N,) another one; one of many is asked for in little time.
        """
        asked = self._units.T @ (self.residual if residual is None else residual)
        best = self._pair(asked, price)
        while best and len(best) < most:
            falls = self._further(asked, best)
            k = int(np.argmax(falls))
            if falls[k] <= price:
                break
            best = [*best, k]
        return best

    def _pair(self, asked: Array, price: float) -> list[int]:
        """The best column, or the best two where the second is worth its price; none where none is."""
        alone = asked**2
        k = int(np.argmax(alone))
        left = 1.0 - self._products**2
        sound = left > INDEPENDENT
        cross = self._products * np.outer(asked, asked)
        both = np.where(sound, (alone[:, None] + alone - 2.0 * cross) / np.where(sound, left, 1.0), 0.0)
        i, j = np.unravel_index(int(np.argmax(both)), both.shape)
        if both[i, j] - alone[k] > price:
            return sorted((int(i), int(j)), key=lambda n: -alone[n])
        return [k] if alone[k] > price else []

    def _further(self, asked: Array, chosen: list[int]) -> Array:
        """(k,) by how much chi2 falls with each column beside those chosen; 0 for one that is made of them."""
        half = np.linalg.solve(
            self._products[np.ix_(chosen, chosen)], np.column_stack([self._products[chosen], asked[chosen]])
        )
        square = np.diag(self._products) - np.einsum("ij,ij->j", self._products[chosen], half[:, :-1])
        left = asked - self._products[chosen].T @ half[:, -1]
        sound = square > INDEPENDENT
        return np.where(sound, left**2 / np.where(sound, square, 1.0), 0.0)

    @cached_property
    def _norms(self) -> Array:
        return np.asarray(np.linalg.norm(self.columns, axis=0))

    @cached_property
    def _units(self) -> Array:
        return np.asarray(self.columns / np.where(self._norms > 0, self._norms, 1.0))

    @cached_property
    def _products(self) -> Array:
        return np.asarray(self._units.T @ self._units)


def regression(
    nominal: Nominal, paths: Mapping[str, Pushed], place: str, functions: Sequence[Callable[[str, Pushed], Array]]
) -> Regression:
    """The regression of the residual on functions of time put on a slot; each gives (K,) for an experiment and its run."""
    parts = []
    for e in nominal.problem.fitted_experiments:
        path = paths[e.name]
        d = np.array([f(e.name, path) for f in functions]).T
        whitening = Whitening.of([b for b in nominal.blocks if b.experiment == e.name], e, nominal)
        parts.append(whitening(path.answer(place, d)))
    columns = nominal.projected(np.vstack(parts))
    return Regression(np.where(np.isfinite(columns), columns, 0.0), nominal.projected(nominal.residual[:, None])[:, 0])


def over_time(paths: Mapping[str, Pushed]) -> list[Callable[[str, Pushed], Array]]:
    """Hats over time, the same in every experiment."""
    begin, end = min(a.time[0] for a in paths.values()), max(a.time[-1] for a in paths.values())
    return [_hat(np.linspace(begin, end, TIME_KNOTS), k, lambda _, a: a.time) for k in range(TIME_KNOTS)]


def over_signal(
    paths: Mapping[str, Pushed], signal: str, knots: int = 9
) -> tuple[Array, list[Callable[[str, Pushed], Array]]]:
    """Knots over the levels of a signal, and hats over them."""
    whole = np.concatenate([a.signal(signal) for a in paths.values()])
    at = np.linspace(float(whole.min()), float(whole.max()), knots)
    return at, [_hat(at, k, lambda _, a: a.signal(signal)) for k in range(knots)]


def _hat(at: Array, k: int, of: Callable[[str, Pushed], Array]) -> Callable[[str, Pushed], Array]:
    unit = np.eye(at.size)[k]
    return lambda name, path: np.asarray(np.interp(of(name, path), at, unit))


MOST = 3
"""Terms of one formula."""
STABLE = 0.8
"""Share of noise records from which the same terms have to be chosen where more than noise is left."""
AGAIN = 25
CLOSE = 2.0
"""Largest chi2 a row, and largest held-out residual in noise units, that a formula may leave."""
KNOTS = 11
"""Of a curve: a tenth of what its signal travels from one to the next."""
MOSTLY = 0.75
"""Share of what is beyond noise that a form has to explain to first order to be tried by full simulation."""
LOOKED_AT = 12
"""Slots that forms are looked for at."""
OVER = 6
"""Signals that a curve at a slot may be over."""


@dataclass(frozen=True, eq=False)
class _SlotLibrary:
    """Candidate terms for the regression at one slot: a library, and curves, each of hats over a signal's levels.

    noise: (N, B) records of it, projected; price: what a term has to bring.
    """

    nominal: Nominal
    paths: Mapping[str, Pushed]
    place: str
    library: tuple[Term, ...]
    curves: tuple[tuple[Term, ...], ...]
    noise: Array
    price: float


@dataclass(frozen=True, eq=False)
class _Form:
    """Terms chosen at a slot with their coefficients. fall: of chi2, to first order. stability: None of the hats of a curve,
    which were not chosen."""

    place: str
    terms: tuple[Term, ...]
    coefficients: Array
    fall: float
    stability: float | None

    def worth(self, price: float) -> float:
        """The fall less the price of the terms."""
        return self.fall - len(self.terms) * price

    @property
    def label(self) -> str:
        """The form and its slot, in words."""
        what = (
            " + ".join(t.text for t in self.terms)
            if self.stability is not None
            else f"a curve over {self.terms[0].signals[0]}"
        )
        return f"{what} at {self.place}"

    def less(self) -> list[_Form]:
        """Return the form, and the form without its last term: linear in a bias of the gains, that term may not be needed."""
        shorter = replace(self, terms=self.terms[:-1], coefficients=self.coefficients[:-1])
        return [self, shorter] if len(self.terms) == MOST else [self]


def law(search: SearchContext, found: Round, best: Refit | None = None) -> Law | None:
    """The formula that explains most of what the model before a round lacks; None where none stands every test.

    None, too, for a model that is closed inside. best: of the refits of the
    catalogue, which a formula has to beat to be near the noise where they are not.
    """
    before, paths = found.before, found.answers()
    if not paths:
        return None
    gap = before.chi2 - before.rows
    forms = [f for f in _forms(search, found, paths) if f.fall > MOSTLY * gap]
    formulas = [
        shorter for form in [f for f in forms if f.stability is not None][:SHORTLIST] for shorter in form.less()
    ]
    told = _best(search, found, formulas, best)
    if told is not None and told.near:
        return told
    return _best(search, found, [f for f in forms if f.stability is None][:BEAM], best) or told


def _best(search: SearchContext, found: Round, forms: Sequence[_Form], best: Refit | None) -> Law | None:
    """The form, refitted, that leaves least for the price of its terms; None where none stands every test."""
    before, jobs, of = found.before, [], []
    for form in forms:
        with suppress(HvdcIdentError):  # it cannot sit there: a loop through itself, or no name of the model's
            jobs.append(formula_job(before, form.place, form.terms, form.coefficients))
            of.append(form)
    texts = [f"outside the catalogue: {form.label}" for form in of]
    refits = Race().run(search, before, jobs, texts)
    k, one = standing(search, found, refits, [form.stability for form in of], best)
    return one and replace(one, terms=of[k].terms)


def standing(
    search: SearchContext, found: Round, refits: Sequence[Refit], stable: Sequence[float | None], best: Refit | None
) -> tuple[int, Law | None]:
    """Of the forms that were refitted the one that leaves least for the price of its terms, of those that stand every test,
    and which it is; None where none does. stable: the share of noise records that each was chosen from."""
    costs = {k: r.chi2 + r.count * _price(search, found) for k, r in enumerate(refits) if not r.failure}
    for k in sorted(costs, key=lambda k: costs[k]):
        one = _tested(search, found.before, refits[k], stable[k], best)
        if one is not None:
            alike = [j for j in costs if j != k and costs[j] - costs[k] <= search.options.set_bic]
            return k, replace(one, others=tuple(refits[j] for j in alike))
    return -1, None


def _price(search: SearchContext, found: Round) -> float:
    return search.options.named_bic + float(np.log(found.before.rows))


def _forms(search: SearchContext, found: Round, paths: Mapping[str, Pushed]) -> list[_Form]:
    """Of every slot the terms that are chosen there; what brings most first."""
    before, nominal = found.before, found.before.nominal()
    signals = found.signals
    sources = source_signals(before.model, signals)
    drawn = draws(before.problem, nominal.blocks, before.noise, nominal.fitted(), AGAIN, search.seed + 77)
    noise, price = nominal.projected(np.vstack(drawn)), _price(search, found)

    @cache
    def curve(signal: str) -> tuple[Term, ...]:
        return hats(signal, _levels([p.values[signal] for p in paths.values()]))

    jobs = []
    for place in _promising(found):
        if search.looks_at(place):
            own = [n for n in (place.removeprefix("outputs."),) if all(n in p.values for p in paths.values())]
            near = list(dict.fromkeys([*own, *sources]))
            library, curves = terms(near), tuple(curve(n) for n in near[:OVER])
            jobs.append(_SlotLibrary(nominal, paths, place, library, curves, noise, price))
    forms = []
    for k, own_forms in enumerate(mapped(search.executor, _at_slot, jobs)):
        search.tell(k + 1, len(jobs), f"hidden input at {jobs[k].place}")
        forms += own_forms
    return sorted(forms, key=lambda f: -f.worth(price))


def _promising(found: Round) -> list[str]:
    """Return the slots at which an effect of the catalogue, whichever, makes chi2 fall most."""
    order = [found.candidates[k].at for k in found.screen.best()]
    return list(dict.fromkeys(at[0] for at in order if len(at) == 1))[:LOOKED_AT]


def _levels(signals: Sequence[Array]) -> Array:
    """Levels of a signal, one array an experiment, with as much travelled between any two neighbours: more where it moves more."""
    ends = np.sort(np.concatenate([np.column_stack([u[:-1], u[1:]]) for u in signals]), axis=1)
    edges = np.unique(ends)
    # Each level between two edges is passed by the steps that begin below and end above it.
    passed = np.searchsorted(np.sort(ends[:, 0]), edges[:-1], "right") - np.searchsorted(
        np.sort(ends[:, 1]), edges[:-1], "right"
    )
    travelled = np.concatenate([[0.0], np.cumsum(passed * np.diff(edges))])
    return np.interp(np.linspace(0.0, travelled[-1], KNOTS), travelled, edges)


def _at_slot(slot: _SlotLibrary) -> list[_Form]:
    """Best formula and best curve at a slot, as far as they are worth their price."""
    curves = [f for c in slot.curves if len(c) > 2 and (f := _curve(slot, c)) is not None]
    best = max(curves, key=lambda f: f.worth(slot.price), default=None)
    return [f for f in (_formula(slot), best) if f is not None]


def _curve(slot: _SlotLibrary, curve: tuple[Term, ...]) -> _Form | None:
    """A curve at a slot; None where it is not worth its price, or its signal skips a level, as one that steps does."""
    found = regression(slot.nominal, slot.paths, slot.place, [at_run(t) for t in curve])
    if np.linalg.norm(found.columns, axis=0).min() < 1e-6 * np.linalg.norm(found.columns):
        return None
    values, gain = found.solved(range(len(curve)))
    form = _Form(slot.place, curve, values, gain, None)
    return form if form.worth(slot.price) > 0 else None


def _formula(slot: _SlotLibrary) -> _Form | None:
    """Best formula at a slot from its library; None where no term is worth its price."""
    found = regression(slot.nominal, slot.paths, slot.place, [at_run(t) for t in slot.library])
    chosen = found.selected(MOST, slot.price)
    if not chosen:
        return None
    coefficients, gain = found.solved(chosen)
    stability = _stability(found, chosen, coefficients, slot)
    return _Form(slot.place, tuple(slot.library[j] for j in chosen), coefficients, gain, stability)


def _stability(found: Regression, chosen: Sequence[int], coefficients: Array, slot: _SlotLibrary) -> float:
    """The share of records, the terms' answer with other noise, from which the same terms are chosen."""
    explained = found.columns[:, list(chosen)] @ coefficients
    again = [found.selected(MOST, slot.price, explained + noise) for noise in slot.noise.T]
    return sum(set(a) == set(chosen) for a in again) / len(again)


def _tested(
    search: SearchContext, before: Refit, refit: Refit, stability: float | None, best: Refit | None
) -> Law | None:
    """The law; None where it does not stand the tests an effect of the catalogue has to."""
    ruler = Ruler.of(refit)
    gain = ruler.gain(before.chi2, refit.chi2, refit.count - before.count)
    was, now = unseen(before), unseen(refit)
    if was is None or now is None or gain <= search.options.named_bic or was - now <= search.options.holdout_share:
        return None
    if refit.chi2 / refit.rows > CLOSE or now > CLOSE:
        return None  # what it leaves has to be next to noise
    explained = before.chi2 - refit.chi2
    tests = residual_tests(refit.nominal(), {}, bootstraps=100, seed=search.seed)
    if any(b.p <= 0.01 and b.excess > REFUTED * explained for b in tests):
        return None
    ahead = best is None or ruler.gain(best.chi2, refit.chi2, refit.count - best.count) > search.options.named_bic
    near = ahead and not is_far(before, refit)
    return Law(refit, gain, stability, near) if near or (stability or 0.0) >= STABLE else None
