"""The score of hypotheses, by hand on small numbers, and which of them is the answer."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from hvdc_ident.discrepancy.hypothesis import Refit, refitted
from hvdc_ident.discrepancy.moves import MOVES
from hvdc_ident.discrepancy.options import DiagnosisOptions, SearchContext
from hvdc_ident.discrepancy.result import CARD, VALUE
from hvdc_ident.discrepancy.rivals import classes, compared, rivals
from hvdc_ident.discrepancy.score import Ruler
from hvdc_ident.discrepancy.search import CLOCKS, Hypothesis, Search, Term
from hvdc_ident.discrepancy.stated import Errors, with_free
from hvdc_ident.fit import FitParameter
from hvdc_ident.immutable import FrozenMap
from tests.discrepancy.cases import FREE, experiments
from tests.discrepancy.refits import beside, plain

RULER = Ruler(rows=1000, effective=500.0, scale=2.0)
"""A unit of chi2 counts a quarter; a parameter costs log 500."""
PRICE = 6.214608098422191
FRICTION = FitParameter("b", 0.3, 0.03, 3.0)
NONE = Errors({}, {})


@pytest.fixture(scope="module")
def first() -> Refit:
    """The drive, refitted to records of a drive whose controller sees a lagged speed."""
    return plain(experiments(lag=0.03))


@pytest.fixture(scope="module")
def lagged(first: Refit) -> Refit:
    return refitted(beside(first, "lag", "wm", {"T": 0.02}, {"T": (1e-4, 0.3)}))


def context() -> SearchContext:
    return SearchContext(("lag", "gain"), ("wm", "err"), FrozenMap(), DiagnosisOptions(bootstraps=100), seed=0)


def searching(first: Refit, *, opened: bool = False) -> Search:
    """A search; opened: whether effects have been looked for beside the model."""
    search = Search(context(), first, MOVES)
    if opened:
        for move in (m for m in MOVES if m.name == "effects"):
            search.add(move.make(search, search.root))
    return search


def fitted(refit: Refit, chi2: float) -> Refit:
    """A refit as if it had come to this chi2, of fitted records alone."""
    return replace(refit, chi2=chi2, predicted=None)


def test_the_price_of_a_parameter_is_the_logarithm_of_the_independent_rows(first: Refit, lagged: Refit) -> None:
    search = searching(first)
    root = Hypothesis(fitted(first, 3000.0), first)
    assert search.cost(root, RULER, rough=True) == pytest.approx(0.25 * 3000.0 + 2 * PRICE)
    one = Hypothesis(fitted(lagged, 3000.0), first, (Term("lag", ("wm",)),))
    assert search.cost(one, RULER, rough=True) == pytest.approx(0.25 * 3000.0 + 3 * PRICE)
    freed = Hypothesis(fitted(with_free(first, FRICTION), 2900.0), first, (Term(VALUE, ("b",)),))
    assert search.cost(freed, RULER, rough=True) == pytest.approx(725.0 + 3 * PRICE)
    timed = Hypothesis(fitted(first, 2900.0), first, (Term(CLOCKS, ("fit-1", "fit-2", "held")),))
    assert search.cost(timed, RULER, rough=True) == pytest.approx(725.0 + 5 * PRICE)


def test_a_term_costs_minus_twice_the_logarithm_of_its_prior(first: Refit) -> None:
    search, refit = searching(first), fitted(first, 3000.0)
    plainly = search.cost(Hypothesis(refit, first), RULER, rough=True)
    card = Hypothesis(refit, first, (Term(CARD, ("governor",), "IEEEG1", prior=0.01),))
    assert search.cost(card, RULER, rough=True) - plainly == pytest.approx(9.210340371976182)
    two = Hypothesis(refit, first, (*card.terms, Term(CARD, ("exciter",), "SEXS", prior=0.5)))
    assert search.cost(two, RULER, rough=True) - plainly == pytest.approx(9.210340371976182 + 1.3862943611198906)


def test_slight_errors_and_held_out_records_count_as_fitted_ones_do(first: Refit) -> None:
    search, root = searching(first), Hypothesis(fitted(first, 3000.0), first)
    search.errors[root.key] = root.refit, replace(NONE, total=2960.0)
    assert search.cost(root, RULER) == pytest.approx(search.cost(root, RULER, rough=True) - 10.0)
    once, twice = (replace(root, refit=replace(root.refit, predicted=p)) for p in (1.0, 2.0))
    (held,) = [e for e in first.problem.experiments if e.role == "holdout"]
    more = search.cost(twice, RULER, rough=True) - search.cost(once, RULER, rough=True)
    assert more == pytest.approx(0.25 * 3.0 * 2 * held.time.size, rel=0.02)


def test_a_record_that_has_lost_a_row_to_its_clock_counts_as_whole(first: Refit) -> None:
    search, share = searching(first), (first.rows - 4) / first.rows
    whole = Hypothesis(fitted(first, 3000.0), first)
    fewer = Hypothesis(replace(fitted(first, 3000.0 * share), rows=first.rows - 4), first)
    assert search.cost(fewer, RULER, rough=True) == pytest.approx(search.cost(whole, RULER, rough=True))


def test_scores_are_in_units_of_what_the_best_leaves(first: Refit, lagged: Refit) -> None:
    """A hypothesis that leaves twice the noise's power: a unit of chi2 counts half as much."""
    search = searching(first)
    search.add([Hypothesis(replace(lagged, chi2=2.0 * lagged.rows, correlation=0.0), first, (Term("lag", ("wm",)),))])
    best = next(h for h in search.pool.values() if h.terms)
    search.errors[best.key] = best.refit, NONE
    assert search.ruler == Ruler(lagged.rows, float(lagged.rows), pytest.approx(2.0))
    search.errors[best.key] = best.refit, replace(NONE, total=1.0, fall_fitted=0.5 * lagged.rows)
    assert search.ruler.scale == pytest.approx(1.5)


def test_of_two_with_the_same_terms_the_one_that_leaves_least_stays(first: Refit, lagged: Refit) -> None:
    search, terms = searching(first), (Term("lag", ("wm",)), Term(VALUE, ("b",)))
    given = np.array([*(f.given for f in FREE), *lagged.theta[2:]])
    one = Hypothesis(replace(lagged, chi2=2000.0), first, terms)
    nearer = Hypothesis(replace(lagged, chi2=2001.0, theta=given), first, terms[::-1])
    worse = Hypothesis(replace(lagged, chi2=2003.0, theta=given), first, terms)
    failed = Hypothesis(replace(lagged, chi2=1.0, failure="it does not run"), first, terms)
    search.add([one, worse, failed])
    assert search.pool[one.key] is one
    search.add([nearer])
    assert search.pool[one.key] is nearer, "as good, and its values are those that were given"
    search.add([one])
    assert search.pool[one.key] is nearer
    search.add([better := replace(one, refit=replace(lagged, chi2=1990.0))])
    assert search.pool[one.key] is better


def test_a_form_outside_the_catalogue_is_no_answer_and_is_told_as_what_it_is(first: Refit) -> None:
    search = searching(first, opened=True)
    best, against = search.answer()
    assert [t.label for t in best.terms] == ["lag at wm"] and not against
    terms = (Term("polynomial", ("wm",), prior=best.terms[0].prior),)
    form = Hypothesis(replace(best.refit, chi2=best.refit.chi2 - 200.0), first, terms)
    search.add([form])
    for h in (search.root, best, form):
        search.errors[h.key] = h.refit, NONE
    assert search.ranked()[0] is form
    answer, against = search.answer()
    assert answer.key == best.key and not against
    outcome = search.outcome(exhausted=False)
    assert outcome.best.key == best.key and [h.refit for h in outcome.ahead] == [form.refit]
    near = replace(form, refit=replace(best.refit, chi2=best.refit.chi2 - 1.0))
    search.pool[form.key], search.errors[form.key] = near, (near.refit, NONE)
    assert not search.outcome(exhausted=False).ahead, "no better than chance"


def test_of_hypotheses_that_are_as_likely_the_one_with_the_values_nearest_to_the_given_is_the_answer(
    first: Refit,
) -> None:
    """Free parameters that make up for an effect elsewhere are no estimates: one that leaves them as given is preferred."""
    search = searching(first, opened=True)
    best, _ = search.answer()
    given = np.array([*(f.given for f in FREE), *best.refit.theta[2:]])
    away = np.array([*(0.5 * f.given for f in FREE), *best.refit.theta[2:]])

    def beside_it(place: str, theta: np.ndarray, behind: float) -> Hypothesis:
        # The score counts chi2; the ruler is what the best leaves.
        refit = replace(best.refit, theta=theta, chi2=best.refit.chi2 + behind)
        h = Hypothesis(refit, first, (replace(best.terms[0], at=(place,)),))
        search.pool[h.key], search.errors[h.key] = h, (refit, NONE)
        return h

    search.pool = {h.key: h for h in (search.root, best)}
    search.errors[best.key] = best.refit, NONE
    as_good = beside_it("err", given, 0.5)
    assert search._preferred(best) is as_good
    search.pool.pop(as_good.key)
    beside_it("err", away, 0.5)
    beside_it("torque", given, 20.0)
    assert search._preferred(best) is best


def test_a_stated_value_that_is_likely_beforehand_stays_beside_an_effect_of_more_evidence(
    first: Refit, lagged: Refit
) -> None:
    """The effect is at one of ten thousand places: a little more evidence is worth less than that."""
    search = searching(first)
    lag, value = Term("lag", ("wm",), prior=4e-5), Term(VALUE, ("b",), prior=0.4)
    free = with_free(first, FRICTION)
    told = Hypothesis(fitted(lagged, 1000.0), first, (lag,))
    search.add([told, Hypothesis(fitted(free, 1012.0), free, (value,))])
    for h in search.pool.values():
        search.errors[h.key] = h.refit, NONE
    group = rivals(replace(search.outcome(exhausted=True), best=told), lag, DiagnosisOptions())
    assert {r.effect for r in group} == {"lag", VALUE}
    likeliest = classes(group)[0]
    assert likeliest.names == (VALUE,) and likeliest.probability > 0.9


def test_the_probabilities_of_hypotheses_are_those_of_their_scores() -> None:
    """Half the difference of two scores is the logarithm of the ratio of their probabilities: of a lag and a delay as long, say."""
    both = replace(context(), effects=("lag", "delay"), places=("wm",))
    outcome = Search(both, plain(experiments(lag=0.0015)), MOVES).run()
    (root,) = [score for h, score in outcome.pool if not h.terms]
    first, second = outcome.pool[:2]
    assert root == 0.0 and first[1] <= second[1] < 0.0
    assert {h.kind for h, _ in (first, second)} == {"lag", "delay"}
    told = compared(outcome)
    assert math.log(told[0].probability / told[1].probability) == pytest.approx(0.5 * (second[1] - first[1]))
    assert sum(h.probability for h in told) == pytest.approx(1.0)
