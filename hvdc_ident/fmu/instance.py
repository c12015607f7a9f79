"""One instance of an FMU, used for many runs, and the way in which it is reused. In worker processes only.

Between runs an instance is reset, or replaced by a new one, or the whole process is replaced. The cheapest way is taken
whose second run repeats the first run of a fresh process, over a whole run and in every output. This is found once for an
FMU; values at the start alone do not tell, for the reset of some FMUs restores the start and nothing else. Outputs that
two fresh processes do not repeat either, such as the time that the computation took, are not compared.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array
from hvdc_ident.fmu.description import Description
from hvdc_ident.fmu.fmi import DISCARD, ERROR, FATAL, DiscreteUpdate, FmiError, FmiLibrary, VariableGroup, refusal
from hvdc_ident.processes.server import die_like, in_new_process

TAKEN = 1e-6  # share by which a value may change as it is set: an FMU may keep it in single precision
ITERATIONS = 1000  # of the discrete part at one instant


class RunFailed(Exception):
    """A run that did not reach its end.

    what: what happened. t: the instant, s. hint: what to try. said: the FMU's own last message. fatal: the process is of
    no more use. again: a new process may do better, where this one has made an instance before. resident, space: bytes of
    memory and of address space in the process of its own that it was in; 0 where it was in none.
    """

    resident = 0
    space = 0

    def __init__(
        self,
        what: str,
        t: float | None = None,
        hint: str = "",
        *,
        said: str = "",
        fatal: bool = False,
        again: bool = False,
    ) -> None:
        super().__init__(what)
        self.what, self.t, self.hint, self.said, self.fatal, self.again = what, t, hint, said, fatal, again

    def told(self) -> dict[str, Any]:
        """Return the heading that tells it to another process."""
        return {
            "failed": self.what, "time": self.t, "hint": self.hint, "said": self.said, "fatal": self.fatal,
            "again": int(self.again), "resident": self.resident, "space": self.space,
        }  # fmt: skip

    @classmethod
    def heard(cls, told: Mapping[str, Any]) -> RunFailed:
        """Return the failure that a heading tells."""
        again, fatal = bool(told["again"]), bool(told["fatal"])
        found = cls(told["failed"], told["time"], told["hint"], said=told["said"], fatal=fatal, again=again)
        found.resident, found.space = told["resident"], told["space"]
        return found


class RunEnded(RunFailed):
    """The FMU asked for the end of the run at an instant. rows: (k, names) of outputs that were recorded up to it."""

    def __init__(self, t: float) -> None:
        super().__init__("the FMU asked for the end of the run", t, "a shorter experiment, or other values")
        self.rows: Array | None = None


def failure(error: Exception, messages: Sequence[str] = ()) -> RunFailed:
    """Return the failure that an error amounts to. messages: those of the FMU in this run, told where a call failed."""
    said = messages[-1] if messages else ""
    if isinstance(error, RunFailed):
        return error
    if isinstance(error, FmiError):
        words = {DISCARD: "discard", ERROR: "error", FATAL: "fatal"}.get(error.status, f"status {error.status}")
        fatal = error.status not in (DISCARD, ERROR)
        return RunFailed(f"{error.function} returned {words}", said=said, fatal=fatal)
    if isinstance(error, MemoryError):
        return RunFailed("not enough memory", fatal=True)
    # A library that cannot be loaded or lacks a function; or a bug here.
    return RunFailed(" ".join(f"{type(error).__name__}: {error}".split())[:500], said=said)


class Instance:
    """An FMU with an instance, brought to the start of a run again and again.

    learned: what was found out about the FMU, see `find_reuse`; a restart that is not learned yet is by a
    new instance.
    """

    def __init__(self, description: Description, folder: str, learned: dict[str, Any]) -> None:
        self.description, self.learned = description, learned
        self.library = FmiLibrary(description, folder)
        self.inputs = VariableGroup(self.library, tuple(description.inputs.values()))
        self._running = False
        self._made = 0  # instances in this process so far
        self._set: set[str] = set()  # parameters that this instance was given a value of
        self.agreed = False  # whether directional derivatives agreed with differences where last compared
        self.next_time: float | None = None

    def block(self, names: tuple[str, ...]) -> VariableGroup:
        """Return variables of these names, to be read together: outputs, states, or any other."""
        return VariableGroup(self.library, tuple(self.description.variable(n) for n in names))

    def begin(
        self, values: Mapping[str, float], inputs: Array, start: float, stop: float | None, tolerance: float | None
    ) -> None:
        """Initialise the instance: parameters that differ from their start, inputs, instant in s.

        Model exchange: events at the start are settled and the instance is in continuous-time mode.
        """
        b, known = self.library, self.description.parameters
        self._rest()
        b.messages.clear()
        until = None if stop is None or stop <= start else stop  # some FMUs refuse an experiment of no length
        b.set_up(start, until, tolerance)
        # A reset that keeps what was set would carry a value of one run into the next.
        back = {n: s for n in self._set - values.keys() if (s := known[n].start) is not None}
        given = {**back, **values}
        VariableGroup(b, [known[n] for n in given]).set(list(given.values()))
        self._set |= given.keys()
        b.enter_initialization(start, until, tolerance)
        self._running = True
        self.inputs.set(inputs)  # some FMUs refuse inputs before this mode
        b.exit_initialization()
        self._check_taken(values, start)
        if b.exchange:
            self.iterate(start)
            b.enter_continuous()

    def _check_taken(self, values: Mapping[str, float], start: float) -> None:
        """Raise RunFailed where a parameter does not read as it was set: its run would be that of another value."""
        known = self.description.parameters
        block = VariableGroup(self.library, [known[n] for n in values])
        try:
            read = block.get().tolist()
        except FmiError:  # an FMU that does not show its parameters can still be run
            return
        for (name, value), now in zip(values.items(), read, strict=True):
            if abs(now - value) > TAKEN * abs(value):
                what = f"parameter '{name}' was set to {value:.9g} and reads {now:.9g}: the FMU does not take the value"
                raise RunFailed(what, start, "leave it at its start value, or export it as tunable")

    def _rest(self) -> None:
        """Have an instance that was not initialised since it was made or reset."""
        b = self.library
        if b.component is not None and self._running:
            self._running = False
            with contextlib.suppress(FmiError):  # an FMU that has ended by itself refuses; the next call decides
                b.terminate()
            if self._resets:
                try:
                    b.reset()
                except FmiError:
                    self.learned["restart"] = "instance"
                    b.free()
            else:
                b.free()
        if b.component is None:
            self.instantiate()

    @property
    def _resets(self) -> bool:
        """True where the instance is kept over a reset; before that was tried, only where a second one cannot be made."""
        way = self.learned.get("restart")
        return way == "reset" or (way is None and self.description.once_per_process)

    def renew(self) -> None:
        """Give the instance up: the next run begins with a new one."""
        self.library.free()
        self._running = False

    def instantiate(self) -> None:
        """Make an instance. Raises RunFailed where the FMU gives none."""
        self._set.clear()
        try:
            self.library.instantiate()
        except RuntimeError:
            said = f": {self.library.messages[-1]}" if self.library.messages else ""
            hint = refusal(self.description, said)
            raise RunFailed(f"the FMU gave no instance{said}", hint=hint, again=self._made > 0) from None
        self._made += 1

    def abandon(self) -> None:
        """Forget the instance: after a failure it cannot be trusted even to free itself."""
        self.library.component = self.library.fmu.component = None
        self._running = False

    # --- events, model exchange ---

    def iterate(self, t: float) -> bool:
        """Return whether the states changed, once the discrete part has come to rest; in event mode before and after."""
        changed = False
        for _ in range(ITERATIONS):
            found: DiscreteUpdate = self.library.update()
            changed |= found.states_changed
            self.next_time = found.next_time
            if found.end:
                raise RunEnded(t)
            if not found.again:
                return changed
        raise RunFailed(f"the events at one instant did not settle in {ITERATIONS} iterations", t)

    def nominals(self) -> Array:
        """(nx,) typical sizes of the states, above 0: what the FMU says, else what its description says, else 1."""
        said = np.abs(self.library.get_nominals())
        described = np.array([v.nominal for v in self.description.states.values()])
        return np.where(np.isfinite(said) & (said > 0.0), said, described)


Reuse = Literal["reset", "instance", "process"]
LoadFmu = Callable[[dict[str, Any]], Instance]
"""Loads the FMU into this process, with what is learned of it; what the instance finds out joins that."""

SAME = 1e-9
"""Share of an output's largest value by which a repeated run may differ. The same program from the same state repeats
itself to the last digit; sums in another order, as of threads, change that by rounding: 1e-16 in each of a million."""
SPREAD = 10.0
"""Differences between two fresh processes that a repeated run may have where no output repeats: one difference of a
normal spread is below a tenth of the next in 6 of 100 pairs, and of several outputs hardly ever in all."""


def find_reuse(make: LoadFmu, run: Callable[[Instance], Array]) -> tuple[Reuse, Array]:
    """Return the way and the first run, (n, signals). Raises RunFailed where the first run fails.

    run: a run from the start, the same each time.
    """
    first, reset = _twice(make, run, "reset")
    if _repeats(reset, first, np.zeros(first.shape[1])):
        return "reset", first
    fresh, instance = _twice(make, run, "instance")
    noise = np.nan_to_num(np.abs(fresh - first)).max(axis=0, initial=0.0)
    if _repeats(reset, first, noise):
        return "reset", first
    return ("instance" if _repeats(instance, fresh, noise) else "process"), first


def _twice(make: LoadFmu, run: Callable[[Instance], Array], way: Reuse) -> tuple[Array, Array | None]:
    """Return the first run in a new process, and the second by a way to restart; None where that one failed."""

    def work(hand: Callable[[tuple[dict[str, Any], dict[str, Array]]], None]) -> None:
        instance = make({"restart": way})
        for _ in range(2):
            rows = run(instance)
            if instance.learned["restart"] == way:
                hand(({}, {"rows": rows}))

    parts, end = in_new_process(work, lambda e: failure(e).told())
    runs = [arrays["rows"] for _, arrays in parts]
    if not runs:
        if isinstance(end, dict):
            raise RunFailed.heard(end)
        die_like(end or 0)
    return runs[0], (runs[1] if len(runs) > 1 else None)


def apart(run: Array, other: Array) -> Array:
    """Return the largest difference over rows, (signals,); infinite where only one of them is not a number."""
    off = np.abs(run - other)
    off[np.isnan(run) & np.isnan(other)] = 0.0
    return np.asarray(np.nan_to_num(off, nan=np.inf).max(axis=0, initial=0.0))


def moving(run: Array) -> NDArray[np.bool_]:
    """Return which signals of a run move, (signals,): one at rest throughout cannot tell a start from an end."""
    known = np.nan_to_num(run)
    return np.asarray(np.ptp(known, axis=0) > SAME * np.abs(known).max(axis=0, initial=0.0))


def _repeats(run: Array | None, first: Array, noise: Array) -> bool:
    """Return whether a run repeats the first. noise: (signals,) by how much two fresh processes differ."""
    if run is None:
        return False
    size = np.nan_to_num(np.abs(first)).max(axis=0, initial=0.0)
    off = apart(run, first)
    steady = noise <= SAME * size
    if steady.any() or not noise.size:
        return bool((off <= SAME * size)[steady].all())
    return bool((off <= SPREAD * noise).all())
