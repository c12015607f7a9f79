"""A run of a co-simulation FMU: communication steps from row to row. Runs in the worker alone.

Reading outputs can disturb a run. An FMU may restart its solver at a step only where an input was set to another value
since it last computed its equations, and reading an output computes them: read between the setting and the step, a jump
has no effect until the solver's own next step, which may be many rows later (FMUs of Dymola do so). Outputs right after
a jump can be read all the same: once they are read, inputs are set to what the last step had and then to their new
values, with no reading before the step, which is the sequence that the FMU would have had without the reading. Each FMU
is tested once for whether that is harmless, against a run that reads right after steps alone, as any importer may.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from ctypes import c_int
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array
from hvdc_ident.fmu.description import Description
from hvdc_ident.fmu.fmi import DISCARD, ERROR, FmiError, TerminationRequested, Vector
from hvdc_ident.fmu.instance import Instance, RunEnded, RunFailed
from hvdc_ident.fmu.request import RunRequest
from hvdc_ident.fmu.runner import REPEAT_TOLERANCE, difference, moving

MAX_EARLY_RETURNS = 10_000  # in one communication step
TRIAL_ROWS = 300  # of a trial from the first change of an input on: solvers' own steps may be tens of rows long
TRIAL_PARTS = 4  # of a communication step, in the trial of held inputs on finer steps

Reading = Literal["restored", "recomputed", "never"]
READINGS: tuple[Reading, ...] = ("restored", "recomputed", "never")
"""Preparation of a step after outputs were read with other inputs than those of the last step: the inputs of that step
are set again; they are set again and outputs computed with them; or no such reading is made."""
Inputs = tuple[float, ...]
Slopes = Literal["followed", "ignored", "needless"]
"""Treatment of the slopes of inputs by an FMU; needless: held inputs were as good where it was tried."""


@dataclass(frozen=True)
class CallPattern:
    """The sequence of calls in a step.

    reading: see `READINGS`. sloping: moving inputs are set with their slopes; else they are held at their mean over a
    step. parts: of each step with a moving input. plain: rows are read right after each step, with its inputs.
    """

    reading: Reading = "restored"
    sloping: bool = False
    parts: int = 1
    plain: bool = False

    @classmethod
    def learned(cls, learned: Mapping[str, Any]) -> CallPattern:
        """Return the pattern that trials have shown to be right, where there were any."""
        return cls(learned.get("reading", "restored"), learned.get("sloping") == "followed")


def made(instance: Instance, run: RunRequest, calls: CallPattern | None = None) -> Array:
    """Return the outputs at the instants, shape (n, outputs). Two equal instants are before and after a jump.

    Inputs follow their slope where the FMU was found to follow it, else they are held at their mean over a step; they
    have their own value where outputs are read. FMI 3.0 gives an input during a step only to FMUs that ask for it by
    intermediate updates, which are not used here, so a ramp is a staircase of the rows' width there. Steps end at every row
    and every break of an input. An FMU of fixed steps, and one that refuses others, takes its own step (where it states
    none, the shortest interval): a jump within one enters as the mean over it, and rows between are joined by lines.

    calls: default, those that are learned of the FMU. Raises RunFailed, or what a failing call of FMI raises.
    """
    chosen, learned = calls or CallPattern.learned(instance.learned), instance.learned

    def attempt(stops: Array) -> Array:
        return _stepped(instance, run, stops, chosen)

    even = not instance.description.variable_step or learned.get("steps") == "even"
    stops = _stops(instance.description, run, even)
    uneven = not even and not _is_even(stops)
    try:
        rows = attempt(stops)
    except FmiError as e:
        refused = e.function.endswith("DoStep") and e.status in (DISCARD, ERROR)
        if not (uneven and refused and "steps" not in learned):
            raise
        instance.abandon()
        try:
            rows = attempt(_stops(instance.description, run, even=True))
        except (FmiError, RunFailed):
            raise e from None
        learned["steps"] = "even"
        return rows
    if uneven:
        learned["steps"] = "any"
    return rows


def find_calls(
    learned: dict[str, Any],
    description: Description,
    run: RunRequest,
    trial: Callable[[CallPattern, Array], Array],
) -> None:
    """Learn how the FMU has to be called for this experiment, where that is not known yet, from short runs of it.

    trial: a run of a pattern and the instants, returns outputs, (n, outputs). learned: gets "reading" where inputs change during
    the run and outputs move, and "sloping" where inputs move and the FMU offers to follow their slopes.
    """
    time, d = run.time, description
    if time[0] == time[-1]:
        return
    stops = _stops(d, run, even=False)
    before, after = (run.at(stops, before_jump=b) for b in (True, False))
    moves = (after[:-1] != before[1:]).any(axis=1)
    changes = moves | (before[:-1] != after[:-1]).any(axis=1)  # a jump at the end is followed by no step
    real = bool(d.inputs) and all(v.kind == "Real" for v in d.inputs.values())
    sloping = "sloping" not in learned and d.interpolates and d.variable_step and real and bool(moves.any())
    reading = "reading" not in learned and bool(changes.any())
    if not (sloping or reading):
        return
    last = int(np.searchsorted(time, stops[np.argmax(changes)], side="right")) + TRIAL_ROWS
    span, allowed = time[:last], max(run.tolerance, REPEAT_TOLERANCE)
    if reading and (harmless := _harmless_reading(span, allowed, trial)) is not None:
        learned["reading"] = harmless
    if sloping:
        held = CallPattern(learned.get("reading", "restored"))
        learned["sloping"] = _tried_slopes(span, allowed, held, trial)


def find_held(learned: dict[str, Any], time: Array, run: Callable[[Array], Array]) -> None:
    """Learn from one run with more rows whether outputs are older than their rows, where runs so far cannot tell.

    run: at instants. learned: gets "outputs held", None where that run cannot tell either.
    """
    behind = learned.get("behind", 0.0)
    if behind == 0.0 or "outputs held" in learned or learned.get("steps") == "even":
        return
    learned["outputs held"] = None
    earlier = time[1:] - 0.5 * behind  # after the last own step before the row
    run(np.union1d(time, earlier[earlier > time[:-1]]))
    learned["behind"] = behind  # of the rows that were asked for


# --- trials ---


def _harmless_reading(time: Array, allowed: float, run: Callable[[CallPattern, Array], Array]) -> Reading | None:
    """Return the first way to read outputs after a change that does not disturb the run; None where nothing moves."""
    undisturbed = run(CallPattern("never", plain=True), time)
    size = np.nan_to_num(np.ptp(undisturbed, axis=0))
    if not moving(undisturbed).any():
        return None
    steady: NDArray[np.bool_] = np.ones(size.size, dtype=bool)
    for attempt in range(2):
        for reading in READINGS[:-1]:
            try:
                read = run(CallPattern(reading, plain=True), time)
            except (FmiError, RunFailed):
                continue
            if (difference(read, undisturbed) <= allowed * size)[steady].all():
                return reading
        if attempt == 0:  # an output such as the time that the computation took is never repeated, and does not judge
            steady = difference(run(CallPattern("never", plain=True), time), undisturbed) <= allowed * size
            if not steady.any():
                return None
            if steady.all():
                break
    return "never"


def _tried_slopes(time: Array, allowed: float, held: CallPattern, run: Callable[[CallPattern, Array], Array]) -> Slopes:
    """Return whether slopes of inputs give outputs as near to those of held inputs on finer steps as held inputs do.

    Held at their mean over a step, inputs cause an error that goes with the square of its length: with TRIAL_PARTS times
    as many steps the remaining error is a small part of that, and slopes that are followed leave less still. Slopes that
    are ignored leave one that goes with the length itself. A factor of 2 leaves room for the solver's noise.
    """
    finer, coarse = run(replace(held, parts=TRIAL_PARTS), time), run(held, time)
    deviation, allowance = difference(coarse, finer), allowed * np.nan_to_num(np.ptp(finer, axis=0))
    try:
        sloped = difference(run(replace(held, sloping=True), time), finer)
    except (FmiError, RunFailed):
        return "ignored"
    if (sloped > 2.0 * deviation + allowance).any():
        return "ignored"
    return "followed" if (deviation > allowance).any() else "needless"


# --- one run ---


def _stepped(instance: Instance, run: RunRequest, stops: Array, calls: CallPattern) -> Array:
    """Return the outputs of a run with communication steps between the stops, (n, outputs)."""
    time, sides = run.time, tuple(run.at(stops, before_jump=b) for b in (True, False))
    instance.begin(run.values, sides[0][0], float(time[0]), float(stops[-1]), run.tolerance)
    before, after = (list(map(tuple, side.tolist())) for side in sides)  # compared in every step: tuples are quickest
    outputs = instance.variables(run.names)
    left, right = (np.empty((stops.size, len(run.names))) for _ in range(2))
    belongs = stops.copy()  # instants that the FMU says it has reached by steps of its own
    stepper = _Stepper(instance, calls, before[0], outputs.get)
    reads_changes = calls.reading != "never"
    instants = stops.tolist()
    for k, t in enumerate(instants):
        if k:
            try:
                stepper.step(instants[k - 1], t, after[k - 1], before[k])
            except RunEnded as e:
                count = k
                if float(e.t or 0.0) >= t - _rounding(time):
                    with contextlib.suppress(FmiError):  # the FMU may not answer any more: then there is no row
                        left[k] = right[k] = outputs.get()
                        count += 1
                recorded = time[time <= stops[count - 1] + _rounding(time)]
                e.rows = _rows(recorded, stops[:count], left[:count], right[:count])
                raise
            belongs[k] = stepper.computed
        current = stepper.has_inputs(before[k])
        left[k] = outputs.get() if calls.plain or not reads_changes or current else stepper.read(before[k])
        if calls.plain and reads_changes and not current:
            stepper.read(before[k])
        right[k] = left[k]
        if reads_changes and before[k] != after[k]:
            changed = stepper.read(after[k])
            if not calls.plain:
                right[k] = changed
    if (belongs < stops).any():
        steady = ((sides[0][1:] == sides[1][:-1]) & (sides[0][1:] == sides[0][:-1])).all(axis=1)
        continuous = [v.continuous for v in outputs.variables]
        _learn_held(instance.learned, stops, belongs, steady, left[:, continuous])
    return _rows(time, stops, left, right)


def _learn_held(
    learned: dict[str, Any], stops: Array, belongs: Array, steady: NDArray[np.bool_], outputs: Array
) -> None:
    """Learn by how much outputs are older than their rows, and whether they are.

    belongs: (n,) instants that the FMU says its outputs belong to. Some name the end of a step of their solver there and
    interpolate their outputs all the same. So they have to keep their values, to the last digit, from row to row where
    that instant and the inputs stay, in the midst of a motion. steady: (n - 1,) whether the inputs stay.
    """
    learned["behind"] = max(float((stops - belongs).max()), learned.get("behind", 0.0))
    same = belongs[1:] == belongs[:-1]
    with np.errstate(invalid="ignore"):  # outputs that are not finite are no evidence
        size = np.ptp(outputs, axis=0)
        steps = np.abs(np.diff(outputs, axis=0)) > REPEAT_TOLERANCE * size
    moves = np.vstack([np.zeros_like(size, dtype=bool), steps[~same], np.zeros_like(size, dtype=bool)])
    own = np.cumsum(~same)  # number of the FMU's own step that each row but the first belongs to
    amid = moves[own] & moves[own + 1] & (same & steady)[:, None]
    if amid.any():
        held = bool((outputs[1:] == outputs[:-1])[amid].all())
        learned["outputs held"] = held and learned.get("outputs held") is not False


def _is_even(stops: Array) -> bool:
    gaps = np.diff(stops)
    return gaps.size < 2 or bool(np.allclose(gaps, gaps[0], rtol=1e-9, atol=0.0))


def _stops(description: Description, run: RunRequest, even: bool) -> Array:
    """Return the instants at which communication steps end. even: whether they have to be of one length."""
    time, begin, end = run.time, float(run.time[0]), float(run.time[-1])
    breaks = run.breaks[(run.breaks > begin) & (run.breaks < end)]
    rows = np.unique(time)
    rows[1:-1] = _moved_to(rows[1:-1], breaks, _rounding(time))
    wanted = np.unique(np.concatenate([rows, breaks[breaks < end - _rounding(time)]]))
    if not even or wanted.size < 2:
        return wanted
    gaps = np.diff(wanted)
    step = description.step or float(gaps.min())
    if _is_even(wanted) and (description.step is None or np.isclose(gaps[0], step, rtol=1e-9)):
        return wanted
    count = int(np.ceil((end - begin) / step - 1e-9))
    grid: Array = begin + step * np.arange(count + 1, dtype=float)
    # A row or jump that differs from a step's end by rounding is at it: a jump just before it would be averaged away.
    return _moved_to(grid, wanted, 1e-6 * step)


def _moved_to(instants: Array, targets: Array, near: float) -> Array:
    """Return the instants, each moved to the target that is so near, where there is one. targets: ascending."""
    if not targets.size:
        return instants
    nearest = targets[np.clip(np.searchsorted(targets, instants - near), 0, targets.size - 1)]
    return np.asarray(np.where(np.abs(nearest - instants) <= near, nearest, instants), dtype=float)


def _rounding(time: Array) -> float:
    """Return the difference of instants up to which they are the same: a few last digits of the largest."""
    return 8.0 * float(np.spacing(np.abs(time[[0, -1]]).max()))


def _rows(time: Array, stops: Array, left: Array, right: Array) -> Array:
    """Return the values at the rows; of two equal instants the first has what was before the jump."""
    at = _moved_to(time, stops, _rounding(time))
    index = np.minimum(np.searchsorted(stops, at), stops.size - 1)
    if (stops[index] == at).all():
        before_jump = np.append(time[:-1] == time[1:], False)
        return np.where(before_jump[:, None], left[index], right[index])
    return np.column_stack([np.interp(time, stops, right[:, k]) for k in range(right.shape[1])])


class _Stepper:
    """The steps of one run. computed: the instant that the FMU says it has reached, in steps of its own, in the last one."""

    def __init__(self, instance: Instance, calls: CallPattern, inputs: Inputs, compute: Callable[[], Array]) -> None:
        self.instance, self.calls, self.compute = instance, calls, compute
        self.computed = -np.inf
        self._begun = False  # whether a step was taken
        self._stepped = inputs  # at the end of the last step
        self._current: Inputs | None = inputs
        self._read = False  # whether outputs were read with other inputs since
        self._sloping = False
        if calls.sloping:
            variables = instance.description.inputs.values()
            self._references = instance.library.references([v.reference for v in variables])
            self._orders = (c_int * len(variables))(*([1] * len(variables)))
            self._slopes = Vector(len(variables))

    def has_inputs(self, u: Inputs) -> bool:
        """Return whether these inputs are set."""
        return self._current == u

    def read(self, u: Inputs) -> Array:
        """Return the outputs with these inputs."""
        self._set(u)
        self._read = True
        return self.compute()

    def _set(self, u: Inputs) -> None:
        self.instance.inputs.set(u)
        self._current = u

    def step(self, a: float, b: float, first: Inputs, last: Inputs) -> None:
        """Bring the FMU from a to b while its inputs go from `first` to `last`."""
        moves = first != last
        if self._read:
            self._set(self._stepped)
            if self.calls.reading == "recomputed":
                self.compute()
            self._read = False
        if moves and not self.calls.sloping:
            for x, y in pairwise(np.linspace(0.0, 1.0, self.calls.parts + 1).tolist()):
                share = 0.5 * (x + y)
                self._apply(tuple(u + share * (v - u) for u, v in zip(first, last, strict=True)))
                self._advance(a + x * (b - a), b if y == 1.0 else a + y * (b - a))
            self._current = None  # they are set in the next step, whatever they are
            return
        self._apply(first)
        if moves or self._sloping:
            self._slopes.values[:] = (np.array(last) - np.array(first)) / (b - a)
            self.instance.library.set_input_derivatives(self._references, self._orders, self._slopes)
            self._sloping = moves
        self._advance(a, b)
        self._stepped = last
        self._current = None  # the FMU may have moved its inputs along the slopes, or not

    def _apply(self, u: Inputs) -> None:
        """Set the inputs of the next step: in the first one too, for some FMUs do not step with those of their start."""
        if self._current != u or not self._begun:
            self._set(u)
        self._stepped, self._begun = u, True

    def _advance(self, a: float, b: float) -> None:
        t, rounding = a, 1e-12 * max(abs(b), 1.0)
        for _ in range(MAX_EARLY_RETURNS):
            try:
                reached, computed = self.instance.library.do_step(t, b - t)
            except TerminationRequested as e:
                raise RunEnded(max(e.reached, t)) from None
            if reached >= b - rounding:
                behind = computed < b - rounding and b - computed > 1e-9 * max(abs(b), b - a)
                self.computed = computed if behind else b
                return
            t = reached
        raise RunFailed(f"the FMU returned early {MAX_EARLY_RETURNS} times in one step", t)
