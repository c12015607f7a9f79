"""Errors that stated values and recorded levels are known to have, as an explanation in place of an effect.

What a study states of a plant is known to a few per cent, and a transducer has an accuracy class. Many such errors together, each
within what it may be, can look like one effect: a gain of 0.99 for three values that are 1 % off. Their joint answer is had to
first order, each error a normal variable about 0, so chi2 with the best of them is that of a ridge regression.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.hypothesis import Refit
from hvdc_ident.discrepancy.moves import STATED_ERROR, derivative
from hvdc_ident.discrepancy.options import CERTAIN, LISTED, REFUTED, SearchContext
from hvdc_ident.text import listed, percentage, quantity

LEVEL_ERROR = 0.005
"""Share of an output's range by which its recorded level may be off: the accuracy class 0.5 of IEC 61869 and 60688."""
COVERED = 2.0
"""Standard deviations within which an error lies that is known to so much: 95 %."""


@dataclass(frozen=True)
class KnownErrors:
    """The likeliest errors of a model and its records.

    errors: by stated value its relative error, by output that of its level in the output's unit, the most unlikely first;
    levels: the outputs among them, with their units. chi2: of the residuals with these errors, and of the errors themselves. p: the
    chance of errors so large.
    """

    errors: dict[str, float]
    levels: Mapping[str, str]
    chi2: float
    p: float

    def in_place_of(self, before: Refit, after: Refit) -> bool:
        """Return True where they are as large as such errors are, and explain as much as what `after` has more than `before`, the
        model that they are errors of: what they leave of it would not refute a form."""
        return self.p > 1.0 - CERTAIN and self.chi2 - after.chi2 <= REFUTED * (before.chi2 - after.chi2)

    def __str__(self) -> str:
        each = [
            f"the level of {n} by {quantity(e, self.levels[n], 2)}"
            if n in self.levels
            else f"{n} by {percentage(e, 1)}"
            for n, e in list(self.errors.items())[:LISTED]
        ]
        return listed(each)


def known_errors(search: SearchContext, here: Refit) -> KnownErrors:
    """Return the errors of a model's stated values and of its records' levels that suit the residual best.

    here: the model, with free parameters that go with the errors.
    """
    nominal = here.nominal()
    residual = nominal.residual
    stated = [f for f in search.stated if f.name not in here.problem.names]
    value, level = STATED_ERROR / COVERED, LEVEL_ERROR / COVERED  # standard deviations, of a value and of a range
    levels = {o: level * _range(here, o) for o in here.problem.outputs}
    columns = [derivative(here, f, residual) * value * abs(f.given) for f in stated]
    columns += [_of_level(here, o, d, residual) for o, d in levels.items()]
    answers = nominal.projected(np.column_stack(columns))
    asked = answers.T @ nominal.projected(residual[:, None])[:, 0]
    best = -np.linalg.solve(np.eye(answers.shape[1]) + answers.T @ answers, asked)  # in standard deviations
    chance = float(stats.chi2.sf(best @ best, best.size))
    # The records are moved towards the model, so they are off the other way.
    sizes = {f.name: value for f in stated} | {o: -d for o, d in levels.items()}
    names = list(sizes)
    order = np.argsort(-np.abs(best), kind="stable")
    errors = {names[k]: float(best[k] * sizes[names[k]]) for k in order}
    known = here.model.outputs
    units = {o: known[o].unit if o in known else "" for o in levels}
    return KnownErrors(errors, units, here.chi2 + float(asked @ best), chance)


def _range(here: Refit, output: str) -> float:
    """Return the range of an output over the fitted records, in its unit."""
    measured = [e.measured for e in here.problem.fitted_experiments if output in e.outputs]
    records = np.concatenate([m[output] for m in measured if m is not None])
    return float(np.nanmax(records) - np.nanmin(records))


def _of_level(here: Refit, output: str, level: float, residual: Array) -> Array:
    """Return (N,) the change of the whitened residual with records of an output that are higher by so much, in its unit.

    residual: (N,) with the records as they are.
    """
    records = []
    for e in here.problem.experiments:
        if e.measured is None or output not in e.outputs:
            records.append(e)
            continue
        values = np.array(e.measured.values)
        values[:, e.measured.names.index(output)] += level
        records.append(e.with_(measured=replace(e.measured, values=values)))
    moved = replace(here.problem, experiments=tuple(records)).blocks(here.theta, derivatives=False)
    return np.asarray(np.concatenate([b.residual for b in moved]) - residual)
