"""Forms outside the catalogue, for what no effect of it explains: bends, products, drifts, dry friction, characteristics, filters.

Each is a kind of its own in `hvdc_ident.effects`, which is tried where it is asked for only. They are looked for as effects are, at
the places where effects of the catalogue explain most, and described by their formula, their transfer function or their curve. Where
none stands either, the course over time of what is missing is described.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import sympy as sp

from hvdc_ident.codec import NOT_STORED, Coded
from hvdc_ident.discrepancy.candidates import additive, candidates
from hvdc_ident.discrepancy.expansion import Expansion, ExpansionModel, FoundForm
from hvdc_ident.discrepancy.hypothesis import Refit, built_in, uncertainty_of
from hvdc_ident.discrepancy.misfit import misfit_of
from hvdc_ident.discrepancy.movable import equations, in_proportion
from hvdc_ident.discrepancy.options import REFUTED, SearchContext
from hvdc_ident.discrepancy.pushes import answered, hats
from hvdc_ident.discrepancy.score import (
    CandidateFit,
    Ruler,
    best_each,
    same_answers,
    with_gain,
)
from hvdc_ident.discrepancy.screen import Score
from hvdc_ident.discrepancy.sentences import sentence
from hvdc_ident.effects import effects
from hvdc_ident.expression import parse, symbol, to_text
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import is_white_box
from hvdc_ident.text import listed

FORM_PLACES = 12
"""Insertion points that forms are looked for at."""
REFITS_PER_FORM = 4
"""Refits of one form."""
TIME_KNOTS = 24


@dataclass(frozen=True, eq=False)
class DescribedForm(Coded):
    """A form outside the catalogue, described. kind: term, filter, curve, disturbance or nothing.

    at: the insertion point; expression and coefficients: of a term or a filter; curve: of the others, {over, at, value, std}.
    refit: the model with the form; text: a sentence.
    """

    kind: str
    at: str
    text: str
    expression: str = ""
    coefficients: FrozenMap[Any] = field(default_factory=FrozenMap)
    delta_bic: float | None = None
    curve: Mapping[str, Any] | None = None
    refit: Refit | None = field(default=None, metadata=NOT_STORED)


def refitted_forms(
    search: SearchContext,
    opened: Expansion,
    at: Collection[str] | None = None,
    kinds: Collection[str] = ("term", "filter", "curve"),
) -> tuple[CandidateFit, ...]:
    """Return the refits of forms of these kinds, each none of the catalogue's effects, the best of each candidate.

    at: places; those where effects of the catalogue explain most, where none are given. Values on a curve begin at no addition, so
    that their first step is the linear regression on it: curves are not screened.
    """
    before = opened.before
    if not is_white_box(before.model):
        return ()
    places = _promising(opened) if at is None else at
    times = [e.time for e in before.problem.fitted_experiments]
    names = [n for n, e in effects().items() if e.outside in kinds]
    found = [
        c
        for c in candidates(before.model, opened.signals, times, names, search.places)
        if len(c.at) == 1 and c.at[0] in places and not c.still
    ]
    curves = [k for k, c in enumerate(found) if effects()[c.effect].outside == "curve"]
    expansion_model = ExpansionModel.of(search, before, found, 1)
    screen = expansion_model.screen(found, "outside the catalogue", [k for k in range(len(found)) if k not in curves])
    scores: list[Score] = []
    for effect in {c.effect: None for c in found}:
        scores += [s for k, s in screen.best().items() if found[k].effect == effect][:REFITS_PER_FORM]
    scores += [Score(k, 0, 0.0, before.theta) for k in curves]
    trials = best_each(expansion_model.refitted(found, scores, "outside the catalogue"))
    return tuple(t for t in trials if not t.refit.failure and _is_own(t.refit))


def _promising(opened: Expansion) -> list[str]:
    """Return the places at which an effect of the catalogue, whichever, makes chi2 fall most."""
    order = [opened.candidates[k].at for k in opened.screen.best()]
    return list(dict.fromkeys(at[0] for at in order if len(at) == 1))[:FORM_PLACES]


def _is_own(refit: Refit) -> bool:
    entry = effects()[refit.placed[-1].candidate.effect]
    return entry.is_own is None or entry.is_own(refit.sizes(refit.placed[-1]))


def best_form(
    search: SearchContext, opened: Expansion, trials: Sequence[CandidateFit], best: Refit | None = None
) -> FoundForm | None:
    """Return the form that leaves least for the price of its values, of those that stand the tests of an effect; None where none
    does.

    best: the refit of the catalogue that a form has to beat, and then it has to come near the noise; without one it has to explain
    so much of the gap that what it leaves does not refute it.
    """
    price = search.options.named_bic + float(np.log(opened.before.rows))
    order = sorted((t.refit for t in trials), key=lambda r: r.chi2 + r.count * price)
    for k, refit in enumerate(order):
        if (gain := _gain(search, opened.before, refit, best)) is not None:
            cost = refit.chi2 + refit.count * price
            others = [r for r in order[k + 1 :] if r.chi2 + r.count * price - cost <= search.options.set_bic]
            return FoundForm(opened.before, refit, gain, tuple(others))
    return None


def _gain(search: SearchContext, before: Refit, refit: Refit, best: Refit | None) -> float | None:
    """Return what a form gains, in BIC; None where it does not stand."""
    ruler = Ruler.of(refit)
    gain = ruler.between(before, refit)
    was, now = before.predicted, refit.predicted
    if was is None or now is None or gain <= search.options.named_bic or was - now <= search.options.holdout_share:
        return None
    if best is None:
        return gain if misfit_of(refit).beyond <= REFUTED * misfit_of(before).beyond else None
    ahead = ruler.between(best, refit) > search.options.named_bic
    return gain if ahead and not misfit_of(refit).is_far_from_noise(misfit_of(before)) else None


def alternatives(search: SearchContext, opened: Expansion) -> tuple[tuple[CandidateFit, float], ...]:
    """Return the refits of forms in the stead of a round's winner, each with its prior; none that failed.

    Of what bends a signal or brings one in, without memory, at one place inside a model: terms there, with what the winner brings
    in. No term of signals at one time is a delay: for one kind of these or another filters, wherever they are. A form is as likely
    before any data as an effect of the catalogue, and shares that with all places and sources, as one does. One that does the same
    as a winner that is linear is no other hypothesis, its prior 0: where signals move so little, a form is its own tangent.

    A saturation bends by the third order, a coupling is a product at its operating point: whoever has only the catalogue's name for it
    takes a form for known that the data do not show.
    """
    winner = opened.winner
    assert winner is not None and opened.ruler is not None
    placed = winner.refit.placed[-1]
    effect, (place, *others) = effects()[placed.candidate.effect], placed.candidate.at
    delays = effect.equivalent_delay is not None and not effect.needs_grid
    # Of what is brought in the start value alone is kept: that is no memory of where the signal has been.
    remembers = effect.states != "none" and not effect.needs_source
    if not delays and (remembers or effect.needs_grid or additive(effect) or others):
        return ()
    kind = "filter" if delays else "term"
    refits = opened.forms if delays else None
    if refits is None:
        refits = refitted_forms(search, opened, None if delays else (place,), (kind,))
    count = sum(c.effect == effect.name and len(c.at) == 1 for c in opened.candidates)
    linear = in_proportion(opened.candidates[winner.pick.candidate], winner.pick.probe)
    weighed = []
    for t in refits:
        c = t.refit.placed[-1].candidate
        entry = effects()[c.effect]
        if entry.outside != kind or (
            entry.needs_source and effect.needs_source and c.source != placed.candidate.source
        ):
            continue
        same = linear and not delays and same_answers(winner.refit, t.refit, opened.before)
        trial = with_gain(replace(t, pick=winner.pick), opened.before, opened.ruler)
        weighed.append((trial, 0.0 if same else 1.0 / count))
    return tuple(weighed)


def described(form: FoundForm) -> DescribedForm:
    """Return the description of a form, which is compiled into its model: its formula, its transfer function or its curve."""
    refit = built_in(form.before, form.refit)
    placed = refit.placed[-1]
    if refit.failure:
        text = f"{labelled(form.refit)} explains it, but cannot be put into the model: {refit.failure}"
        return DescribedForm("nothing", placed.candidate.at[0], text)
    entry, (place,) = effects()[placed.candidate.effect], placed.candidate.at
    said = [f"Found from the data, outside the catalogue: {sentence(placed.candidate, refit.sizes(placed))}."]
    if form.others:
        said.append(f"As good: {listed([labelled(r) for r in form.others])}.")
    text = " ".join(said)
    if entry.outside == "curve":
        return DescribedForm("curve", place, text, delta_bic=form.gain, curve=_curve(refit), refit=refit)
    return DescribedForm(entry.outside, place, text, expression(refit), _coefficients(refit), form.gain, refit=refit)


def labelled(refit: Refit) -> str:
    """Return the form that a refit ends with, and where."""
    c = refit.placed[-1].candidate
    return f"{expression(refit, filled=True) or c.effect} at {listed(c.at)}"


def expression(refit: Refit, *, filled: bool = False) -> str:
    """Return what the form that a refit ends with adds, in the model's names, or its transfer function; empty for a curve.

    filled: whether its coefficients stand there as numbers.
    """
    placed = refit.placed[-1]
    c, sizes = placed.candidate, refit.sizes(placed)
    entry = effects()[c.effect]
    if entry.outside == "curve":
        return ""
    if entry.words is not None:
        return entry.words(sizes)["transfer"]
    alone = equations(c.effect, entry.present(sizes))
    names = {"u": c.at[0].removeprefix("outputs."), "source": c.source.removeprefix("outputs.")}
    known = {symbol(n): symbol(name) for n, name in names.items() if name}
    text = to_text((alone.outputs["y"].value - symbol("u")).expand().xreplace(known))
    return with_values(text, sizes) if filled else text


def with_values(text: str, sizes: Mapping[str, float]) -> str:
    """Return a formula with numbers for its coefficients, to four digits."""
    return to_text(parse(text).xreplace({symbol(n): sp.Float(f"{v:.4g}") for n, v in sizes.items()})) if text else ""


def _coefficients(refit: Refit) -> FrozenMap[Any]:
    """Return by parameter of the form its value, and the interval that holds it in 95 of 100 cases where that is known."""
    placed, shown = refit.placed[-1], {}
    for n, name in placed.names.items():
        value, std = refit.sizes(placed)[n], refit.std.get(name)
        shown[n] = {"value": value, "ci95": None if std is None else [value - 1.96 * std, value + 1.96 * std]}
    return FrozenMap(shown)


def _curve(refit: Refit) -> dict[str, Any]:
    """Return the curve {over, at, value, std}: what is added, with its standard deviation where the records determine it."""
    placed = refit.placed[-1]
    entry, sizes = effects()[placed.candidate.effect], refit.sizes(placed)
    assert entry.curve is not None
    known = uncertainty_of(refit.problem, refit.problem.blocks(refit.theta))
    at, value = entry.curve(sizes)
    names = [n for n in placed.bounds if n in placed.names]
    slopes = np.column_stack(
        [entry.curve({**sizes, n: sizes[n] + 1.0})[1] - value for n in names]
    )  # it is linear in each
    where = [known.names.index(placed.names[n]) for n in names]
    variance = np.einsum("ij,jk,ik->i", slopes, known.corrected[np.ix_(where, where)], slopes)
    unknown = [placed.names[n] in known.reasons for n in names]
    hidden = np.any(slopes[:, unknown] != 0.0, axis=1)
    std = [None if h else float(np.sqrt(max(v, 0.0))) for v, h in zip(variance, hidden, strict=True)]
    over = (placed.candidate.source or placed.candidate.at[0]).removeprefix("outputs.")
    return {"over": over, "at": at.tolist(), "value": value.tolist(), "std": std}


def disturbance_course(search: SearchContext, opened: Expansion) -> DescribedForm:
    """Return what would have to be added at the place that explains most, over time and the same in every experiment.

    Each of some hats over time is put on the place as the model runs; its answer at the outputs, whitened and freed of what the
    parameters can make good, is a column of a regression of the residual.
    """
    paths, nominal = opened.answers(), opened.before.nominal()
    experiments = nominal.problem.fitted_experiments
    at = np.linspace(min(e.time[0] for e in experiments), max(e.time[-1] for e in experiments), TIME_KNOTS)
    residual, best = nominal.projected(nominal.residual), None
    for place in [p for p in _promising(opened) if search.looks_at(p)]:
        columns = nominal.projected(
            np.vstack([answered(nominal, e, paths[e.name], place, hats(e.time, at)) for e in experiments])
        )
        columns = np.where(np.isfinite(columns), columns, 0.0)
        norms = np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny)
        values = np.linalg.lstsq(columns / norms, residual, rcond=1e-8)[0] / norms
        worth = float(residual @ residual - np.sum((residual - columns @ values) ** 2)) - at.size * np.log(
            residual.size
        )
        if worth > (0.0 if best is None else best[0]):
            best = worth, place, values, columns
    if best is None:
        return DescribedForm("nothing", "", "No hidden input at any one place explains it.")
    worth, place, values, columns = best
    spread = np.sqrt(np.maximum(np.diag(np.linalg.pinv(columns.T @ columns, rcond=1e-10)), 0.0))
    curve = {"over": "time", "at": at.tolist(), "value": values.tolist(), "std": spread.tolist()}
    if len(experiments) > 1:
        text = f"It acts at {place} at the same times in every experiment, whatever the state: a disturbance."
        return DescribedForm("disturbance", place, text, delta_bic=worth, curve=curve)
    text = f"It acts at {place}; with one experiment a disturbance cannot be distinguished from a form."
    return DescribedForm("curve", place, text, delta_bic=worth, curve=curve)
