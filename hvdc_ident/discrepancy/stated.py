"""Stated values: what a card says of a plant, each slightly off, and some of them plainly.

What a card states of a plant is known to a few per cent, and a transducer has an accuracy class. Many such errors together, each
within what it may be, can look like one effect: a gain of 0.99 for three values that are 1 % off. So they go with every hypothesis:
each error is a normal variable about 0, and to first order what they explain of a residual is a ridge regression. A value that is
plainly wrong is a term of a hypothesis: it is set free.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.hypothesis import Refit
from hvdc_ident.discrepancy.nominal import of_held_out, orthonormal
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.fit.followed_noise import followed_noise, follows_noise
from hvdc_ident.fit.noise import SURE
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel, is_white_box
from hvdc_ident.text import listed, percentage, quantity

STATED_ERROR = 0.02
"""Share by which a stated value may be off: data sheets and tests are no better."""
LEVEL_ERROR = 0.005
"""Share of an output's range by which its recorded level may be off: the accuracy class 0.5 of IEC 61869 and 60688."""
COVERED = 2.0
"""Standard deviations within which an error lies that is known to so much: 95 %."""
DIFFERENCE_STEP = 1e-3
"""Share of a value by which it is moved for a derivative: runs are exact to a thousandth of that."""
LISTED_ERRORS = 3
"""Errors that a sentence lists, the most unlikely first."""


@dataclass(frozen=True, eq=False)
class Errors:
    """The likeliest slight errors under a hypothesis.

    relative: by stated value its relative error, by output that of its level in the output's unit, the most unlikely first; units: of
    the outputs among them. total: chi2 of all records with them, free parameters at their best for all, and of the errors themselves; None
    where they are not known. fall_fitted: by how much chi2 of the fitted records falls with them. correlation: of neighbours in what they
    leave of those.
    """

    relative: dict[str, float]
    units: Mapping[str, str]
    total: float | None = None
    fall_fitted: float = 0.0
    correlation: float = 0.0

    def __str__(self) -> str:
        each = [
            f"the level of {n} by {quantity(e, self.units[n], 2)}" if n in self.units else f"{n} by {percentage(e, 1)}"
            for n, e in list(self.relative.items())[:LISTED_ERRORS]
        ]
        return listed(each)


@dataclass(frozen=True, eq=False)
class SlightErrors:
    """What slight errors do to the records of a model, to first order, one standard deviation of each.

    names: of the stated values, then of the outputs whose levels are off. fitted: (N, m) change of the whitened residuals of the fitted
    records; held: (H, m) of the held-out ones; followed: (m,) of the sum of squares that the noise of played inputs makes of them.
    sizes: the standard deviations, relative of a value, in its unit of a level. units: of the outputs.
    """

    names: tuple[str, ...]
    fitted: Array
    held: Array
    followed: Array
    sizes: tuple[float, ...]
    units: Mapping[str, str]

    @classmethod
    def of(cls, first: Refit, stated: Sequence[FitParameter]) -> SlightErrors:
        """Return those of a model. stated: its parameters that are not fitted."""
        levels = {o: LEVEL_ERROR / COVERED * _range(first, o) for o in first.problem.outputs}
        # Of a value that is 0 a share is nothing.
        values = tuple(f for f in stated if f.given)
        problems = [first.problem, of_held_out(first.problem)]
        parts = [_answers(p, first.theta, values, levels) for p in problems if p is not None]
        held = parts[1] if len(parts) > 1 else np.zeros((0, parts[0].shape[1]))
        sizes = (*(STATED_ERROR / COVERED for _ in values), *levels.values())
        known = first.model.outputs
        units = {o: known[o].unit if o in known else "" for o in levels}
        followed = np.concatenate([_followed(first, values), np.zeros(len(levels))])
        return cls((*(f.name for f in values), *levels), parts[0], held, followed, sizes, units)

    def without(self, component: str) -> SlightErrors:
        """Return those of a model in which a component is another: what that one stated is none of its values."""
        kept = [k for k, n in enumerate(self.names) if not n.startswith(f"{component}.")]
        names, sizes = tuple(self.names[k] for k in kept), tuple(self.sizes[k] for k in kept)
        fitted, held, followed = self.fitted[:, kept], self.held[:, kept], self.followed[kept]
        return replace(self, names=names, sizes=sizes, fitted=fitted, held=held, followed=followed)

    def under(self, refit: Refit) -> Errors:
        """Return the likeliest errors under a hypothesis, within what such errors are together; none where its records are others.

        Free parameters go with them: those that fitted and held-out records determine together. What the errors do is worked out beside
        the model without terms; what they leave is that of a run with them.
        """
        problems, blocks = [refit.problem], [refit.problem.blocks(refit.theta)]
        unseen = of_held_out(refit.problem)
        if unseen is not None and self.held.shape[0]:
            with suppress(SimulationError):  # held-out records that cannot be run say nothing
                blocks.append(unseen.blocks(refit.theta[: len(unseen.free)]))
                problems.append(unseen)
        free, answers = len(refit.problem.free), [self.fitted, self.held]
        if any(sum(b.residual.size for b in part) != a.shape[0] for part, a in zip(blocks, answers, strict=False)):
            return Errors({}, self.units)
        residual = np.concatenate([b.residual for part in blocks for b in part])
        jacobian = np.vstack([b.jacobian[:, :free] for part in blocks for b in part])
        basis = orthonormal(jacobian)
        every = np.vstack(answers[: len(blocks)])
        every, wanted = (x - basis @ (basis.T @ x) for x in (every, residual))
        strength, directions = np.linalg.eigh(every.T @ every)
        asked = directions.T @ (every.T @ wanted - 0.5 * self.followed)
        most = strength.size + SURE * math.sqrt(2.0 * strength.size)
        weight = _weight(np.maximum(strength, 0.0), asked, most)
        errors = -directions @ (asked / (weight + np.maximum(strength, 0.0)))
        left, less = wanted, 0.0
        run = self._run_with(errors, refit, problems)
        rest = None if run is None else run - basis @ (basis.T @ run)
        if rest is not None and rest @ rest + errors @ errors - self.followed @ errors < wanted @ wanted:
            left, less = rest, float(self.followed @ errors)
        else:
            errors = np.zeros(errors.size)
        rows = self.fitted.shape[0]
        # The records are moved towards the model, so their levels are off the other way.
        signed = np.array(self.sizes) * np.where([n in self.units for n in self.names], -1.0, 1.0)
        order = np.argsort(-np.abs(errors), kind="stable")
        relative = {self.names[k]: float(errors[k] * signed[k]) for k in order}
        ends = np.cumsum([b.residual.size for b in blocks[0]])
        power = float(left[:rows] @ left[:rows])
        fell = float(wanted[:rows] @ wanted[:rows]) - power + less
        near = sum(float(r[1:] @ r[:-1]) for r in np.split(left[:rows], ends[:-1])) / power if power else 0.0
        correlation = near if near > 2.0 / math.sqrt(rows) else 0.0
        return Errors(relative, self.units, float(left @ left + errors @ errors) - less, max(fell, 0.0), correlation)

    def _run_with(self, errors: Array, refit: Refit, problems: Sequence[Problem]) -> Array | None:
        """Return (N,) the residuals of a run of a hypothesis with errors of its stated values and of the recorded levels; None where it
        does not run with them. An error of a value that the hypothesis has set free is none.
        """
        values, levels = {}, np.zeros(errors.size)
        for k, (name, size) in enumerate(zip(self.names, self.sizes, strict=True)):
            if name in self.units:
                levels[k] = errors[k]
            elif name not in refit.problem.names:
                values[name] = refit.values.get(name, refit.model.parameters[name].value) * (1.0 + size * errors[k])
        rows = [a @ levels for a, _ in zip((self.fitted, self.held), problems, strict=False)]
        try:
            runs = [p.residuals(p.misfits(refit.theta[: len(p.names)], values)[:, None])[:, 0] for p in problems]
        except SimulationError:
            return None
        return np.concatenate(runs) + np.concatenate(rows)


def _weight(strength: Array, asked: Array, most: float) -> float:
    """Return the weight of the errors' own squares, 1 or so much more that their sum is no more than `most`."""
    low, high = 0.0, 0.0
    while float(np.sum((asked / (10.0**high + strength)) ** 2)) > most:
        low, high = high, high + 1.0
    for _ in range(20 if high else 0):
        middle = 0.5 * (low + high)
        inside = float(np.sum((asked / (10.0**middle + strength)) ** 2)) <= most
        low, high = (low, middle) if inside else (middle, high)
    return float(10.0**high)


def _answers(problem: Problem, theta: Array, values: Sequence[FitParameter], levels: Mapping[str, float]) -> Array:
    """Return (N, m) changes of the whitened residual by one standard deviation of each error; 0 where the model does not run with it."""
    theta = theta[: len(problem.names)]
    spreads = np.array([STATED_ERROR / COVERED * abs(f.given) for f in values])
    of_values = differences(problem, theta, values, [f.given for f in values]) * spreads
    residual = np.concatenate([b.residual for b in problem.blocks(theta, derivatives=False)])
    of_levels = [_of_level(problem, theta, o, d, residual) for o, d in levels.items()]
    return np.column_stack([of_values, *of_levels])


def _followed(first: Refit, values: Sequence[FitParameter]) -> Array:
    """Return (m,) by how much more of the noise of played inputs is followed with one standard deviation of each value's error."""
    if not follows_noise(first.problem):
        return np.zeros(len(values))
    found = np.zeros(len(values))
    for k, f in enumerate(values):
        with suppress(SimulationError):  # a value that the model does not run with has no answer either
            there = followed_noise(first.problem, first.theta, {f.name: f.given * (1.0 + STATED_ERROR / COVERED)})
            found[k] = (there - first.followed) * math.copysign(1.0, f.given)
    return found


def differences(problem: Problem, theta: Array, held: Sequence[FitParameter], at: Sequence[float]) -> Array:
    """Return (N, m) the derivatives of the whitened residual by held parameters, by differences; 0 where the model does not run.

    at: their values.
    """
    here = problem.misfits(theta, {})
    runs, steps = [here], [1.0]
    for f, value in zip(held, at, strict=True):
        step = DIFFERENCE_STEP * (abs(value) or f.size)
        try:
            runs.append(problem.misfits(theta, {f.name: value + step}))
        except SimulationError:
            runs.append(here)
        steps.append(step)
    whole = problem.residuals(np.column_stack(runs))
    return np.asarray((whole[:, 1:] - whole[:, :1]) / np.array(steps[1:]))


def _range(first: Refit, output: str) -> float:
    """Return the range of an output over the fitted records, in its unit."""
    measured = [e.measured for e in first.problem.fitted_experiments if output in e.outputs]
    records = np.concatenate([m[output] for m in measured if m is not None])
    return float(np.nanmax(records) - np.nanmin(records))


def _of_level(problem: Problem, theta: Array, output: str, level: float, residual: Array) -> Array:
    """Return (N,) the change of the whitened residual with records of an output that are higher by so much, in its unit.

    residual: (N,) with the records as they are.
    """
    records = []
    for e in problem.experiments:
        if e.measured is None or output not in e.outputs:
            records.append(e)
            continue
        values = np.array(e.measured.values)
        values[:, e.measured.names.index(output)] += level
        records.append(e.with_(measured=replace(e.measured, values=values)))
    moved = replace(problem, experiments=tuple(records)).blocks(theta, derivatives=False)
    return np.asarray(np.concatenate([b.residual for b in moved]) - residual)


FARTHEST = 10.0
"""Times its stated value, or the inverse, that a value which is plainly wrong lies off at most: a base or a unit mistaken for another."""


def stated(model: AnyModel, candidates: Sequence[FitParameter]) -> tuple[FitParameter, ...]:
    """Return the parameters of a model that are no candidates, with bounds as near as they are known.

    One that is 0, as a lead that a plant may have, has a range where its card knows its usual values. None of a model that is closed
    inside: each derivative would be a run.
    """
    if not is_white_box(model):
        return ()
    fitted, found = {f.name for f in candidates}, []
    for n, p in model.parameters.items():
        ends = (p.value / FARTHEST, p.value * FARTHEST) if p.value else p.usual
        low, high = max(min([p.value, *ends]), p.min), min(max([p.value, *ends]), p.max)
        if n not in fitted and low < high and (low < p.value < high or p.value == 0.0):
            found.append(FitParameter(n, p.value, low, high, scale=0.0 if p.value else high - low))
    return tuple(found)


def with_held(refit: Refit, parameter: FitParameter) -> Refit:
    """Return the nominal model with one parameter less among the free ones, at its given value."""
    at = refit.problem.names.index(parameter.name)
    free = tuple(f for f in refit.problem.free if f.name != parameter.name)
    held = FrozenMap({**refit.problem.held, parameter.name: parameter.given})
    return replace(refit, problem=replace(refit.problem, free=free, held=held), theta=np.delete(refit.theta, at))


def with_free(refit: Refit, parameter: FitParameter) -> Refit:
    """Return the nominal model with one parameter more among the free ones, at its start."""
    count = len(refit.problem.free)
    held = {n: v for n, v in refit.problem.held.items() if n != parameter.name}
    problem = replace(refit.problem, free=(*refit.problem.free, parameter), held=FrozenMap(held))
    return replace(refit, problem=problem, theta=np.insert(refit.theta, count, parameter.start))
