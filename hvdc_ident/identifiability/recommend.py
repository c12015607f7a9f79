"""What to measure next: the input, level and signal that would tell most about what is known least."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hvdc_ident.errors import SimulationError
from hvdc_ident.experiment import Experiment, InputSignal
from hvdc_ident.fit import Simulator
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.identifiability.pilot import Optimum
from hvdc_ident.sensitivity.fisher import SENSITIVITY_ERROR
from hvdc_ident.trajectory import Array

NEW_SIGNAL = 1.1
"""Recording another signal is advised only where it raises the smallest eigenvalue by more than this factor."""


@dataclass(frozen=True)
class Recommendation:
    """A step that was not made yet.

    input: moved from `before` to `after`, in its unit. record: the signals to record. smallest: eigenvalue of the
    information in scaled coordinates (now, then). predicted: half-width of the 95 % interval by parameter, in its unit,
    linear and only as good as the noise assumed; None where it stays open. text: the advice as a sentence.
    """

    input: str
    before: float
    after: float
    record: tuple[str, ...]
    smallest: tuple[float, float]
    determinant_gain: float
    predicted: FrozenMap[float | None]
    now: FrozenMap[float | None]
    text: str
    others: tuple[FrozenMap[Any], ...] = ()
    failed: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """The recommendation as JSON takes it."""
        return {
            "input": self.input,
            "from": self.before,
            "to": self.after,
            "record": list(self.record),
            "smallest_eigenvalue": {"now": self.smallest[0], "then": self.smallest[1]},
            "determinant_gain": self.determinant_gain,
            "predicted_half_width": dict(self.predicted),
            "half_width_now": dict(self.now),
            "text": self.text,
            "others": [dict(o) for o in self.others],
            "failed": list(self.failed),
        }


def recommend(
    whole: Optimum, inputs: Mapping[str, float], units: Mapping[str, str], *, thresholds: Mapping[str, float]
) -> Recommendation | None:
    """The step that raises the smallest eigenvalue most, over all inputs at three levels; None where none can be run.

    whole: all candidates free, at the values of the optimum. inputs: the model's inputs with their start values.
    thresholds: the rise of the cost at the ends of a parameter's interval, which widens the predicted intervals too.
    """
    names = whole.names
    base = whole.information.matrix
    template = max(whole.problem.fitted_experiments, key=lambda e: float(np.ptp(e.time)))
    recorded = tuple(whole.problem.outputs)
    tried, failed = [], []
    for name, before, after in _steps(whole.problem.fitted_experiments, inputs):
        try:
            gains = _information(whole, _experiment(template, name, before, after))
        except SimulationError as error:
            failed.append(f"{name} from {before:g} to {after:g}: {error.what}")
            continue
        together = sum((gains[o] for o in recorded if o in gains), np.zeros_like(base))
        plain = _merit(base + together)
        tried.append((plain, name, before, after, recorded, together))
        for signal in gains:
            more = _merit(base + together + gains[signal])
            if signal not in recorded and more > (plain[0], plain[1] * NEW_SIGNAL):
                tried.append((more, name, before, after, (*recorded, signal), together + gains[signal]))
    if not tried:
        return None
    tried.sort(key=lambda t: t[0], reverse=True)
    best = tried[0]
    usual = float(np.median(list(thresholds.values()))) if thresholds else 1.92
    unit = whole.slope[: len(names)] * np.sqrt([2.0 * thresholds.get(n, usual) for n in names])
    now, then = _half_widths(base, unit, names), _half_widths(base + best[5], unit, names)
    return Recommendation(
        best[1],
        best[2],
        best[3],
        best[4],
        (_merit(base)[1], best[0][1]),
        _determinant_gain(base, best[5]),
        then,
        now,
        _text(best[1], best[2], best[3], [o for o in best[4] if o not in recorded], now, then, units),
        tuple(
            FrozenMap({"input": t[1], "from": t[2], "to": t[3], "record": list(t[4]), "smallest_eigenvalue": t[0][1]})
            for t in tried[1:6]
        ),
        tuple(failed),
    )


def _steps(experiments: Sequence[Experiment], inputs: Mapping[str, float]) -> Iterator[tuple[str, float, float]]:
    """Input, value before and after: for each input the largest move made so far, its opposite, and its double."""
    for name, value in inputs.items():
        signals = [e.inputs[name] for e in experiments if name in e.inputs and name not in e.drive]
        moves = [s.values - s.values[0] for s in signals]
        move = max((float(m[np.argmax(np.abs(m))]) for m in moves), key=abs, default=0.0)
        move = move or 0.05 * (abs(value) or 1.0)
        for factor in (1.0, -1.0, 2.0):
            yield name, value, float(f"{value + factor * move:.12g}")


def _experiment(template: Experiment, name: str, before: float, after: float) -> Experiment:
    """A plain step where the template has its event, over the template's instants."""
    time = template.time
    event = template.event if template.event is not None else float(time[0] + 0.1 * np.ptp(time))
    signal = InputSignal.step(event, before, after)
    return Experiment(f"step of {name}", time, FrozenMap({name: signal}), event=event)


def _information(whole: Optimum, experiment: Experiment) -> dict[str, Array]:
    """The information of each output of the run, in scaled coordinates."""
    simulator: Simulator = whole.problem.simulator
    run = simulator.simulate(experiment, whole.problem.values(whole.theta), whole.names)
    sigmas = [s for table in whole.problem.sigma.values() for s in table.values()]
    typical = float(np.median(sigmas))
    sizes = [np.abs(e.measured[o]).max() for e in whole.problem.fitted_experiments for o in e.outputs if e.measured]
    unit = {run.trajectory.unit(o) for o in whole.problem.outputs if o in run.trajectory}
    found = {}
    for output in run.trajectory.names:
        known = [t[output] for t in whole.problem.sigma.values() if output in t]
        relative = typical / max(float(np.median(sizes)), 1e-300) * float(np.abs(run.trajectory[output]).max())
        sigma = known[0] if known else typical if run.trajectory.unit(output) in unit else relative
        gradient = run.gradient(output) * whole.slope[: len(whole.names)] / (sigma or typical)
        if not np.isfinite(gradient).all():
            raise SimulationError(f"the sensitivity of '{output}' is not finite")
        found[output] = gradient.T @ gradient
    return found


def _merit(matrix: Array) -> tuple[int, float]:
    """How many directions are seen, and the smallest eigenvalue."""
    values = np.linalg.eigvalsh(matrix)
    return int((values > SENSITIVITY_ERROR**2 * max(values[-1], 1e-300)).sum()), float(max(values[0], 0.0))


def _determinant_gain(base: Array, more: Array) -> float:
    """Log of the ratio of the determinants after and before; infinite where a new direction is seen."""
    now, then = _merit(base), _merit(base + more)
    if now[0] < base.shape[0]:
        return float("inf") if then[0] > now[0] else 0.0
    return float(np.linalg.slogdet(base + more)[1] - np.linalg.slogdet(base)[1])


def _half_widths(matrix: Array, unit: Array, names: Sequence[str]) -> FrozenMap[float | None]:
    """Half the linear 95 % interval by parameter; None where it is not determined, or wider than any range.

    unit: (p,) what one standard deviation of a scaled coordinate is worth, times the interval's quantile.
    """
    values, vectors = np.linalg.eigh(matrix)
    good = values > SENSITIVITY_ERROR**2 * max(values[-1], 1e-300)
    lost = (vectors[:, ~good] ** 2).sum(axis=1) > 1e-6
    variance = (vectors[:, good] ** 2 / values[good]).sum(axis=1)
    half = np.sqrt(variance)
    return FrozenMap({n: None if lost[i] or half[i] > 1e3 else float(half[i] * unit[i]) for i, n in enumerate(names)})


def _text(
    name: str,
    before: float,
    after: float,
    new: Sequence[str],
    now: Mapping[str, float | None],
    then: Mapping[str, float | None],
    units: Mapping[str, str],
) -> str:
    """The advice and what it would give for the parameter that gains most."""

    def gain(n: str) -> float:
        a, b = now[n], then[n]
        return 0.0 if b is None else np.inf if a is None else a / b

    most = max(then, key=gain)
    record = f" and record {', '.join(new)} too" if new else ", recording the same signals"
    text = f"Step {name} from {before:g} to {after:g} {units.get(name, '')}".rstrip() + record
    if then[most] is None:
        return f"{text}; no single step of an input makes every parameter visible."
    was = "not at all" if now[most] is None else f"to ±{now[most]:.3g}"
    return f"{text}: {most} would be known to ±{then[most]:.3g} {units.get(most, '')}".rstrip() + f" (now {was})."
