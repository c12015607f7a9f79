"""What to measure next: the experiment, its level and the signals that would tell most about what is known least."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit.frequency_data import in_time
from hvdc_ident.identifiability.advice import advice
from hvdc_ident.identifiability.merit import Merit, half_widths, merit
from hvdc_ident.identifiability.pilot import Optimum
from hvdc_ident.identifiability.trial import Move, Trial, double_trials, single_trials
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.parameters import Input

NEW_SIGNAL = 1.1
"""Recording another signal is advised only where it raises the smallest eigenvalue by more than this factor."""
EQUAL = 0.01
"""Trials whose smallest eigenvalue is within this share of the best are equals: the larger determinant is taken."""
ADDED = 0.1
"""A second step that raises the logarithm of the determinant by less adds nothing."""
BEGUN_WITH = 3
"""So many of the best single steps are tried with a second step of every other input."""
LISTED = 8


@dataclass(frozen=True, eq=False)
class Ranked:
    """A trial with the signals to record, and what would be known of the candidates with it added.

    then: how well they are determined together. gain: (p, p) the information it adds, in scaled coordinates.
    """

    trial: Trial
    record: tuple[str, ...]
    new: tuple[str, ...]
    then: Merit
    gain: Array


@dataclass(frozen=True, eq=False)
class Recommendation:
    """The experiment that raises the smallest eigenvalue of the information most (E-optimal), of those tried.

    best: the experiment. by_determinant: the one that raises the determinant most (D-optimal). now: how well the candidates
    are determined without either. half_widths_now, half_widths: of the 95 % intervals by parameter, in its unit, to first
    order, at the values found or held, only as good as the noise assumed; None where it stays open. values: the parameters'
    values there. others: the best of each other kind and input, best first. tried: how many. failed: those that cannot be
    simulated, with the reason. text: the advice in words.
    """

    best: Ranked
    by_determinant: Ranked
    now: Merit
    half_widths_now: FrozenMap[float | None]
    half_widths: FrozenMap[float | None]
    values: FrozenMap[float]
    others: tuple[Ranked, ...]
    tried: int
    failed: tuple[str, ...]
    text: str

    @property
    def input(self) -> str:
        """The input that moves first."""
        return self.best.trial.moves[0].input

    def to_dict(self) -> dict[str, Any]:
        """The recommendation as JSON takes it."""
        first = self.best.trial.moves[0]
        intervals = {
            n: None if h is None else [self.values[n] - h, self.values[n] + h] for n, h in self.half_widths.items()
        }
        return {
            "input": first.input,
            "from": first.before,
            "to": first.after,
            **self._line(self.best),
            "criterion": "E-optimal: the largest smallest eigenvalue of the information in scaled coordinates",
            "predicted_half_width": dict(self.half_widths),
            "predicted_ci95": intervals,
            "half_width_now": dict(self.half_widths_now),
            "text": self.text,
            "d_optimal": self._line(self.by_determinant),
            "others": [self._line(r) for r in self.others],
            "tried": self.tried,
            "failed": list(self.failed),
        }

    def _line(self, r: Ranked) -> dict[str, Any]:
        return {
            "kind": r.trial.kind,
            "moves": [m.to_dict() for m in r.trial.moves],
            "record": list(r.record),
            "new_signals": list(r.new),
            "smallest_eigenvalue": {"now": self.now.smallest, "then": r.then.smallest},
            "directions_seen": {"now": self.now.seen, "then": r.then.seen},
            "determinant_gain": r.then.determinant - self.now.determinant if r.then.seen == self.now.seen else None,
        }


def recommend(
    whole: Optimum, inputs: Mapping[str, Input], units: Mapping[str, str], *, thresholds: Mapping[str, float]
) -> Recommendation | None:
    """The best of the experiments that could be made; None where there is no input to move, or none can be run.

    Tried are, for every input, steps at three levels, a ramp and a multisine; and the best steps followed by a step of
    every other input; each with the signals recorded so far, and with one more. whole: all candidates free, at the
    values of the optimum. inputs: the model's. units: of the parameters. thresholds: the rise of the cost at the ends of
    a parameter's interval, which widens the predicted intervals too.
    """
    recordings = in_time(whole.problem.fitted_experiments)
    if not recordings:
        return None
    template = max(recordings, key=lambda e: float(np.ptp(e.time)))
    values, of_inputs = {n: i.value for n, i in inputs.items()}, {n: i.unit for n, i in inputs.items()}
    tried = _Trials(whole)
    singles = list(single_trials(recordings, values, of_inputs, template))
    ranked = list(tried.ranked(singles))
    ranked += tried.ranked(double_trials(_best_steps(ranked), singles, template))
    if not ranked:
        return None
    base = whole.information.matrix
    best = _e_optimal(ranked)
    by_determinant = max(ranked, key=lambda r: (r.then.seen, r.then.determinant, -len(r.trial.moves)))
    now, then = (half_widths(m, _reach(whole, thresholds), whole.names, whole.error) for m in (base, base + best.gain))
    at = FrozenMap({n: whole.value(n) for n in whole.names})
    text = advice(best, by_determinant, now, then, {**units, **of_inputs}, len(ranked))
    if whole.deterministic:
        text += " The misfit stands for the noise in these intervals."
    others = tuple(_others(ranked, best))
    count = len({r.trial for r in ranked})
    return Recommendation(best, by_determinant, tried.now, now, then, at, others, count, tuple(tried.failed), text)


class _Trials:
    """Trials run and weighed, each with the signals recorded so far and with one more."""

    def __init__(self, whole: Optimum) -> None:
        self.whole = whole
        self.base = whole.information.matrix
        self.recorded = whole.problem.outputs_in_time
        self.now = merit(self.base, whole.error)
        self.failed: list[str] = []

    def ranked(self, trials: Iterable[Trial]) -> Iterator[Ranked]:
        """Every way to record each trial that can be run."""
        for trial in trials:
            try:
                gains = self._gains(trial)
            except SimulationError as error:
                self.failed.append(f"{trial.text({})}: {error.what}")
                continue
            plain = sum((gains[o] for o in self.recorded if o in gains), np.zeros_like(self.base))
            first = merit(self.base + plain, self.whole.error)
            yield Ranked(trial, self.recorded, (), first, plain)
            for signal in gains:
                if signal in self.recorded:
                    continue
                gain = plain + gains[signal]
                more = merit(self.base + gain, self.whole.error)
                if (more.seen, more.smallest) > (first.seen, first.smallest * NEW_SIGNAL):
                    yield Ranked(trial, (*self.recorded, signal), (signal,), more, gain)

    def _gains(self, trial: Trial) -> dict[str, Array]:
        """The information of each output of the run, in scaled coordinates."""
        problem, names = self.whole.problem, self.whole.names
        template = max(in_time(problem.fitted_experiments), key=lambda e: float(np.ptp(e.time)))
        run = problem.simulator.simulate(trial.experiment(template), problem.values(self.whole.theta), names)
        found = {}
        for output in run.trajectory.names:
            gradient = run.gradient(output) * self.whole.slope[: len(names)]
            if not np.isfinite(gradient).all():
                raise SimulationError(f"the sensitivity of '{output}' is not finite")
            gradient = gradient / self._sigma(output, run.trajectory[output], run.trajectory.unit(output))
            found[output] = gradient.T @ gradient
        return found

    def _sigma(self, output: str, values: Array, unit: str) -> float:
        """The noise expected on an output, in its unit: as recorded so far; of a new one, as on others of its unit, or
        the same share of its largest value."""
        problem = self.whole.problem
        by_output = {o: s for table in problem.sigma.values() for o, s in table.items()}
        if output in by_output:
            return by_output[output]
        typical = float(np.median(list(by_output.values())))
        measured = [(e.measured, o) for e in problem.fitted_experiments for o in e.outputs if e.measured is not None]
        if any(m.unit(o) == unit for m, o in measured):
            return typical
        size = float(np.median([np.nanmax(np.abs(m[o])) for m, o in measured]))
        share = typical / size if size > 0 else 0.0
        return share * float(np.abs(values).max()) or typical


def _e_optimal(ranked: Sequence[Ranked]) -> Ranked:
    """The one with most directions seen and the largest smallest eigenvalue; of equals the larger determinant."""
    seen = max(r.then.seen for r in ranked)
    most = [r for r in ranked if r.then.seen == seen]
    largest = max(r.then.smallest for r in most)
    equals = [r for r in most if r.then.smallest >= (1.0 - EQUAL) * largest]
    return max(equals, key=lambda r: (r.then.determinant, -len(r.new), -len(r.trial.moves)))


def _best_steps(ranked: Sequence[Ranked]) -> list[Trial]:
    """The best single steps at the level of those made so far, each of another input."""
    found: dict[str, Trial] = {}
    for r in sorted(ranked, key=_order, reverse=True):
        if r.trial.kind == "step":
            found.setdefault(r.trial.inputs[0], r.trial)
    return list(found.values())[:BEGUN_WITH]


def _others(ranked: Sequence[Ranked], best: Ranked) -> Iterator[Ranked]:
    """The best of each other kind and set of inputs, best first; pairs only where the second step adds something."""
    shown = {(best.trial.kind, frozenset(best.trial.inputs))}
    alone: dict[tuple[tuple[Move, ...], tuple[str, ...]], Ranked] = {
        (r.trial.moves, r.record): r for r in ranked if len(r.trial.moves) == 1
    }
    for r in sorted(ranked, key=_order, reverse=True):
        key = r.trial.kind, frozenset(r.trial.inputs)
        single = alone.get((r.trial.moves[:1], r.record))
        if key in shown or (len(r.trial.moves) > 1 and single is not None and not _adds(r, single)):
            continue
        shown.add(key)
        yield r
        if len(shown) > LISTED:
            return


def _adds(pair: Ranked, single: Ranked) -> bool:
    return pair.then.seen > single.then.seen or pair.then.determinant > single.then.determinant + ADDED


def _order(r: Ranked) -> tuple[int, float, float]:
    """Directions seen, smallest eigenvalue to a hundredth, determinant: larger is better."""
    return r.then.seen, round(float(np.log(max(r.then.smallest, 1e-300))), 2), r.then.determinant


def _reach(whole: Optimum, thresholds: Mapping[str, float]) -> Array:
    """(p,): what one standard deviation of a scaled coordinate is worth in the parameter's unit, times the quantile."""
    usual = float(np.median(list(thresholds.values()))) if thresholds else 1.92
    return whole.slope[: len(whole.names)] * np.sqrt([2.0 * thresholds.get(n, usual) for n in whole.names])
