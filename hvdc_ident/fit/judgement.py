"""The judgement of whether a model follows its recordings: against their noise, the study's tolerance and the windows of a profile.

It is made once for a set of values, by signal (an output of an experiment), and every page reads it. The error is model - record.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.codec import Coded, stored_as
from hvdc_ident.data import Array, Experiment
from hvdc_ident.data.units import same_unit
from hvdc_ident.fit.adequacy import ResidualSize, sizes_of_runs
from hvdc_ident.fit.residual import Curve
from hvdc_ident.fit.tolerance_profile import WINDOWS, ToleranceProfile
from hvdc_ident.immutable import FrozenMap

Span = tuple[float, float]
Yardstick = Literal["noise", "tolerance", "windows"]
"""The measure that the error of a signal is held against."""


@dataclass(frozen=True)
class Window:
    """The error of a signal in a window. begin, end: s; n: rows. limits: by kind of error, None where there is none for the unit.

    max, mean, mean_absolute: in the output's unit. within: None where there is no limit, or no row.
    """

    begin: float = field(metadata=stored_as("from"))
    end: float = field(metadata=stored_as("to"))
    n: int
    limits: Mapping[str, float] | None
    max: float | None = None
    mean: float | None = None
    mean_absolute: float | None = None
    within: bool | None = None


@dataclass(frozen=True)
class WindowErrors:
    """The errors of a signal in the windows of a profile. event: s, None where there is none, and then no window.

    within: whether it keeps its limits in every window that is judged; None where none is, with the reason. end: the instant the event
    is over, s; end_from: "inputs" or "settling".
    """

    event: float | None = None
    within: bool | None = None
    reason: str = ""
    end: float | None = field(default=None, metadata=stored_as("end", optional=True))
    end_from: str = field(default="", metadata=stored_as("end_from", optional=True))
    before: Window | None = field(default=None, metadata=stored_as("before", optional=True))
    during: Window | None = field(default=None, metadata=stored_as("during", optional=True))
    after: Window | None = field(default=None, metadata=stored_as("after", optional=True))

    @property
    def by_name(self) -> dict[str, Window]:
        """The windows by name."""
        named = {"before": self.before, "during": self.during, "after": self.after}
        return {name: window for name, window in named.items() if window is not None}


@dataclass(frozen=True)
class SignalJudgement:
    """One output of one experiment. rmse, peak: root mean square and largest modulus of the error, in the output's unit.

    noise: its standard deviation, in the unit; None where none is known. tolerance: of the RMSE, in the unit; None without one.
    windows: the errors in the windows. follows: by what the error is held against, None where it is not judged.
    """

    rmse: float
    peak: float
    noise: float | None
    tolerance: float | None
    windows: WindowErrors
    follows: FrozenMap[bool | None]


@dataclass(frozen=True)
class Count:
    """How many signals passed, failed and were not judged."""

    passed: int
    failed: int
    not_judged: int

    @property
    def judged(self) -> int:
        """How many were judged."""
        return self.passed + self.failed

    @property
    def verdict(self) -> bool | None:
        """False where a signal fails, None where one is not judged and no other fails, or where there is none; else True."""
        return False if self.failed else None if self.not_judged or not self.passed else True


@dataclass(frozen=True)
class Judgement(Coded):
    """The verdict on the model with one set of values: whether it follows its recordings.

    by: what the verdict is held against: the study's tolerance where it states one, else the windows of a profile that it names,
    else the noise. signals: by output and experiment, of those that were compared.
    """

    by: Yardstick
    signals: FrozenMap[FrozenMap[SignalJudgement]]
    stored_properties: ClassVar[tuple[str, ...]] = ("follows", "counts")

    @property
    def follows(self) -> bool | None:
        """The verdict by what the errors are held against."""
        return self.count(self.by).verdict

    @property
    def counts(self) -> dict[Yardstick, Count]:
        """How many signals passed, failed and were not judged, by what the errors are held against."""
        return {by: self.count(by) for by in get_args(Yardstick)}

    def count(self, by: Yardstick) -> Count:
        """Return how many signals passed, failed and were not judged."""
        each = [s.follows[by] for line in self.signals.values() for s in line.values()]
        return Count(each.count(True), each.count(False), each.count(None))


@dataclass(frozen=True)
class Judgements(Coded):
    """The judgements that a stage makes, by set of values: given, fitted, effect.

    tolerance: of the RMSE that the study states, by output. profile: of the windows; its `named` says whether the study names it.
    """

    tolerance: Mapping[str, float] = field(default_factory=dict)
    profile: Mapping[str, Any] = field(default_factory=dict)
    sets: Mapping[str, Judgement] = field(default_factory=dict)


def judge(
    curves: Mapping[str, Mapping[str, Curve]],
    experiments: Sequence[Experiment],
    units: Mapping[str, str],
    profile: ToleranceProfile,
    *,
    tolerance: Mapping[str, float] | None = None,
    named: bool = False,
    sizes: Mapping[str, Mapping[str, ResidualSize]] | None = None,
) -> Judgement:
    """Return the judgement of the model's runs beside their records.

    curves: by experiment and output. units: of the outputs. tolerance: of the RMSE by output, in its unit. named: whether the study
    itself names the profile. sizes: by output and experiment, the size of the residuals where a fit has told it; else it is told by
    the same rule.
    """
    by_name = {e.name: e for e in experiments}
    known = sizes_of_runs(curves, experiments)
    signals: dict[str, dict[str, SignalJudgement]] = {}
    for name, line in curves.items():
        for output, curve in line.items():
            size = (sizes or {}).get(output, {}).get(name) or known[output][name]
            windows = _errors(by_name[name], curve, profile, units.get(output, ""))
            signals.setdefault(output, {})[name] = _signal(curve, size, (tolerance or {}).get(output), windows)
    each = [s for line in signals.values() for s in line.values()]
    by: Yardstick = "noise"
    if any(s.tolerance is not None for s in each):
        by = "tolerance"
    elif named and not tolerance and any(s.follows["windows"] is not None for s in each):
        by = "windows"
    return Judgement(by, FrozenMap({o: FrozenMap(line) for o, line in signals.items()}))


def _signal(curve: Curve, size: ResidualSize, tolerance: float | None, windows: WindowErrors) -> SignalJudgement:
    rmse = curve.rmse
    follows = FrozenMap(
        {
            "noise": size.follows,
            "tolerance": None if tolerance is None else rmse <= tolerance,
            "windows": windows.within,
        }
    )
    return SignalJudgement(rmse, float(np.abs(curve.misfit).max()), size.noise, tolerance, windows, follows)


def _errors(e: Experiment, curve: Curve, profile: ToleranceProfile, unit: str) -> WindowErrors:
    """Return the errors of a signal within the windows of a profile."""
    if e.event is None:
        return WindowErrors(reason="no event: no input moves and none is given")
    end, source = event_end(e, curve.measured, profile.windows["settling"])
    spans = windows(e, end, profile)
    rows = np.zeros(e.time.size, dtype=bool)
    rows[curve.rows] = True
    limited = same_unit(unit, profile.unit)
    by_window = {w: _window(e.time, spans[w], rows, curve, profile.limits[w] if limited else None) for w in WINDOWS}
    judged = [w.within for w in by_window.values() if w.within is not None]
    reason = f"the limits are in {profile.unit}, the output is {f'in {unit}' if unit else 'without a unit'}"
    reason = "" if judged else "no row in any window" if limited else reason
    return WindowErrors(e.event, all(judged) if judged else None, reason, end, source, **by_window)


def _window(
    time: Array, span: Span, rows: NDArray[np.bool_], curve: Curve, limits: Mapping[str, float] | None
) -> Window:
    inside = rows & (time >= span[0]) & (time <= span[1])
    n = int(inside.sum())
    empty = Window(*span, n, dict(limits) if limits else None)
    if n == 0:
        return empty
    error = curve.model[inside] - curve.measured[inside]
    kinds = {
        "max": float(np.abs(error).max()),
        "mean": float(error.mean()),
        "mean_absolute": float(np.abs(error).mean()),
    }
    within = all(abs(kinds[k]) <= v for k, v in limits.items()) if limits else None
    return replace(empty, within=within, max=kinds["max"], mean=kinds["mean"], mean_absolute=kinds["mean_absolute"])


def windows(e: Experiment, end: float, profile: ToleranceProfile) -> dict[str, Span]:
    """Return from and to, in s, of each window around an event that is over at `end`; one that is empty ends before it begins."""
    assert e.event is not None
    w = profile.windows
    first, last = float(e.time[0]), float(e.time[-1])
    until = e.event - w["gap_before"]
    cleared = end + w["gap_cleared"]
    return {
        "before": (max(first, until - w["before"]), until),
        "during": (e.event + w["gap_start"], end - w["gap_end"]),
        "after": (cleared, min(last - w["gap_end"], cleared + w["after"])),
    }


def event_end(e: Experiment, reference: Array, settling: float) -> tuple[float, str]:
    """Return the instant the event is over, s, and its source.

    "inputs": the last change of an input, where that is later than the event (the end of a ramp, the clearing of a
    dip). "settling": for a step, the last instant the reference is farther from its last value than the given share of
    its whole change.
    """
    assert e.event is not None
    ends = [e.event]
    for signal in e.inputs.values():
        moving = np.flatnonzero(np.diff(signal.values) != 0)
        if moving.size:
            ends.append(float(signal.times[moving[-1] + 1]))
    over = max(t for t in ends if t <= e.time[-1]) if any(t <= e.time[-1] for t in ends) else float(e.time[-1])
    if over > e.event:
        return over, "inputs"
    later = (e.time >= e.event) & np.isfinite(reference)
    y, t = reference[later], e.time[later]
    if y.size < 2 or np.ptp(y) == 0:
        return e.event, "settling"
    last = float(np.mean(y[-max(1, y.size // 50) :]))
    out = np.flatnonzero(np.abs(y - last) > settling * float(np.ptp(y)))
    return (float(t[min(out[-1] + 1, t.size - 1)]) if out.size else e.event), "settling"
