"""One instance of an FMU, used for many runs, and the way in which it is reused. In worker processes only.

Between runs an instance is reset, or replaced by a new one, or the whole process is replaced. The cheapest way is taken
whose second run repeats the first run of a fresh process, over a whole run and in every output; one that fails, crashes or
hangs does not. This is found once for an FMU; values at the start alone do not tell, for the reset of some FMUs restores
the start and nothing else. Outputs that two fresh processes do not repeat either, such as the time that the computation
took, are not compared.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array
from hvdc_ident.errors import one_line
from hvdc_ident.fmu.description import Description, Message
from hvdc_ident.fmu.fmi import DISCARD, ERROR, FATAL, FmiError, FmiLibrary, VariableGroup, quoted, refusal
from hvdc_ident.parallel import Watch
from hvdc_ident.parallel.inside import die_like, in_new_process, resident, space

Reuse = Literal["reset", "instance", "process"]
"""Way in which each run begins: with a reset of the instance, a new instance, or a new process."""
REPEAT_TOLERANCE = 1e-9
"""Share of an output's largest value by which a repeated run may differ. The same program from the same state repeats
itself to the last digit; sums in another order, as of threads, change that by rounding: 1e-16 in each of a million."""
NOISE_FACTOR = 10.0
"""Differences between two fresh processes that a repeated run may have where no output repeats: one difference of a
normal spread is below a tenth of the next in 6 of 100 pairs, and of several outputs hardly ever in all."""
PARAMETER_TOLERANCE = 1e-6  # relative difference of a parameter read back after it was set: single precision passes
EVENT_ITERATIONS = 1000  # of the discrete part at one instant


class RunFailed(Exception):
    """A run that did not reach its end.

    what: what happened. t: the instant, s. hint: what to try. message: the FMU's own last messages. fatal: the process
    cannot be used any more. again: a new process may succeed, where this one has made an instance before. resident,
    space: bytes of memory and of address space of the separate process that it happened in; 0 where there was none.
    """

    _TRANSFERRED = ("t", "hint", "message", "fatal", "again", "resident", "space")

    def __init__(
        self,
        what: str,
        t: float | None = None,
        hint: str = "",
        *,
        message: str = "",
        fatal: bool = False,
        again: bool = False,
    ) -> None:
        super().__init__(what)
        self.what, self.t, self.hint, self.message, self.fatal, self.again = what, t, hint, message, fatal, again
        self.resident = self.space = 0

    def heading(self) -> dict[str, Any]:
        """Return the heading of the message that reports it to another process."""
        return {"failed": self.what, **{n: getattr(self, n) for n in self._TRANSFERRED}}

    @classmethod
    def from_heading(cls, heading: Mapping[str, Any]) -> RunFailed:
        """Return the failure that a heading reports."""
        error = cls(heading["failed"])
        vars(error).update({n: heading[n] for n in cls._TRANSFERRED})
        return error


class RunEnded(RunFailed):
    """The FMU asked for the end of the run at an instant. rows: (k, names) of outputs that were recorded up to it."""

    def __init__(self, t: float) -> None:
        super().__init__("the FMU asked for the end of the run", t, "a shorter experiment, or other values")
        self.rows: Array | None = None


def failure(error: Exception, messages: Sequence[str] = ()) -> RunFailed:
    """Return any error of a run as RunFailed. messages: those of the FMU in this run; the last ones are quoted."""
    message = quoted(messages)
    if isinstance(error, RunFailed):
        return error
    if isinstance(error, FmiError):
        status = {DISCARD: "discard", ERROR: "error", FATAL: "fatal"}.get(error.status, f"status {error.status}")
        fatal = error.status not in (DISCARD, ERROR)
        return RunFailed(f"{error.function} returned {status}", message=message, fatal=fatal)
    if isinstance(error, MemoryError):
        return RunFailed("not enough memory", fatal=True)
    # A library that cannot be loaded or lacks a function; or a bug of this package.
    return RunFailed(one_line(error), message=message)


@contextlib.contextmanager
def quoting(instance: Instance) -> Iterator[None]:
    """Raise any error of the work on an instance as RunFailed with its messages, which end with its process."""
    try:
        yield
    except Exception as e:
        raise failure(e, instance.library.messages) from None


class Instance:
    """An instance of an FMU that is initialised for one run after another.

    learned: what was found out about the FMU, "restart" (a `Reuse`) among it; while that is not known, each run begins
    with a new instance.
    """

    def __init__(self, description: Description, folder: str, learned: dict[str, Any]) -> None:
        self.description, self.learned = description, learned
        self.library = FmiLibrary(description, folder)
        self.inputs = VariableGroup(self.library, tuple(description.inputs.values()))
        self._running = False
        self._made = 0  # instances in this process so far
        self._set: set[str] = set()  # parameters whose values this instance was given
        self.directional_confirmed = (
            False  # whether directional derivatives agreed with differences at the last comparison
        )
        self.next_time: float | None = None

    def variables(self, names: tuple[str, ...]) -> VariableGroup:
        """Return variables of these names, to be read together: outputs, states, or any other."""
        return VariableGroup(self.library, tuple(self.description.variable(n) for n in names))

    def begin(
        self, values: Mapping[str, float], inputs: Array, start: float, stop: float | None, tolerance: float | None
    ) -> None:
        """Initialise the instance: parameters that differ from their start, inputs, instant in s.

        Model exchange: events at the start are processed and the instance is in continuous-time mode.
        """
        library, parameters = self.library, self.description.parameters
        self._make_uninitialised()
        library.messages.clear()
        until = None if stop is None or stop <= start else stop  # some FMUs refuse an experiment of no length
        library.setup_experiment(start, until, tolerance)
        # A reset may keep what was set: a value of the last run must not enter this one.
        restored = {n: s for n in self._set - values.keys() if (s := parameters[n].start) is not None}
        given = {**restored, **values}
        VariableGroup(library, [parameters[n] for n in given]).set(list(given.values()))
        self._set |= given.keys()
        library.enter_initialization(start, until, tolerance)
        self._running = True
        self.inputs.set(inputs)  # some FMUs refuse inputs before this mode
        library.exit_initialization()
        self._check_parameters(values, start)
        if library.exchange:
            self.update_discrete_states(start)
            library.enter_continuous_time_mode()

    def _check_parameters(self, values: Mapping[str, float], start: float) -> None:
        """Raise RunFailed where a parameter does not read as it was set: the run would be that of another value."""
        parameters = VariableGroup(self.library, [self.description.parameters[n] for n in values])
        try:
            read = parameters.get().tolist()
        except FmiError:  # an FMU that does not show its parameters can still be run
            return
        for (name, value), actual in zip(values.items(), read, strict=True):
            if abs(actual - value) > PARAMETER_TOLERANCE * abs(value):
                what = (
                    f"parameter '{name}' was set to {value:.9g} and reads {actual:.9g}: the FMU does not take the value"
                )
                raise RunFailed(what, start, "leave it at its start value, or export it as tunable")

    def _make_uninitialised(self) -> None:
        """Reset the instance, or make a new one, where it has been initialised since; make one where there is none."""
        library = self.library
        if library.component is not None and self._running:
            self._running = False
            with contextlib.suppress(FmiError):  # an FMU that has ended by itself refuses; the next call decides
                library.terminate()
            reuse = self.learned.get("restart")
            if reuse == "reset" or (reuse is None and self.description.once_per_process):
                try:
                    library.reset()
                except FmiError:
                    self.learned["restart"] = "instance"
                    library.free()
            else:
                library.free()
        if library.component is None:
            self.instantiate()

    def renew(self, moved: Iterable[str] = ()) -> None:
        """Let the next run begin with a new instance, or with a reset where that is known to suffice: some can be made once.

        moved: parameters that the FMU may have moved itself; the next run sets them, for a reset may keep them.
        """
        if self.learned.get("restart") == "reset":
            self._set |= self.description.parameters.keys() & set(moved)
            return
        self.library.free()
        self._running = False

    def instantiate(self) -> None:
        """Make an instance. Raises RunFailed where the FMU gives none."""
        self._set.clear()
        self.library.messages.clear()
        try:
            self.library.instantiate()
        except RuntimeError:
            said = self.library.messages
            hint = refusal(self.description, " ".join(said))
            raise RunFailed(
                f"the FMU gave no instance{': ' * bool(said)}{quoted(said)}", hint=hint, again=self._made > 0
            ) from None
        self._made += 1

    def abandon(self) -> None:
        """Forget the instance without freeing it: after a failure it cannot be trusted even to free itself."""
        self.library.component = self.library.fmu.component = None
        self._running = False

    # --- model exchange ---

    def update_discrete_states(self, t: float) -> bool:
        """Iterate the discrete part to its fixed point, in event mode; return whether the continuous states changed."""
        changed = False
        for _ in range(EVENT_ITERATIONS):
            again, end, states_changed, self.next_time = self.library.new_discrete_states()
            changed |= states_changed
            if end:
                raise RunEnded(t)
            if not again:
                return changed
        raise RunFailed(f"the events at one instant did not settle in {EVENT_ITERATIONS} iterations", t)

    def nominals(self) -> Array:
        """(nx,) typical sizes of the states, above 0: those of the FMU, else of its description, else 1."""
        given = np.abs(self.library.get_nominals())
        described = np.array([v.nominal for v in self.description.states.values()])
        return np.where(np.isfinite(given) & (given > 0.0), given, described)


# --- reuse ---

LoadFmu = Callable[[dict[str, Any]], Instance]
"""Loads the FMU into this process, with what is learned of it; what the instance finds out is added to that."""


NewWatch = Callable[[], Watch]
"""Begins to watch the progress of this process's runs, against the deadline of one."""


def isolated(
    work: Callable[[Callable[[Message], None]], None], hangs: Callable[[Sequence[Message]], bool] | None = None
) -> list[Message]:
    """Return the messages that the work sends from a new process, at least one.

    work: called with the function that sends. Where it sends none, raises its failure as RunFailed, or ends this process
    as the new one ended. hangs: called with the messages so far, whether to end the new process.
    """
    messages, end = in_new_process(
        work, lambda e: {**failure(e).heading(), "resident": resident(), "space": space()}, hangs
    )
    if not messages and isinstance(end, dict):
        raise RunFailed.from_heading(end)
    if not messages:
        die_like(end if isinstance(end, int) else 0)
    return messages


def find_reuse(load: LoadFmu, run: Callable[[Instance], Array], new_watch: NewWatch) -> tuple[Reuse, Array]:
    """Return the way of reuse and the first run, (n, signals). Raises RunFailed where the first run fails.

    run: a run from the start, the same each time.
    """
    first, reset = _run_twice(load, run, "reset", new_watch)
    if _repeats(reset, first, np.zeros(first.shape[1])):
        return "reset", first
    fresh, instance = _run_twice(load, run, "instance", new_watch)
    noise = np.nan_to_num(np.abs(fresh - first)).max(axis=0, initial=0.0)
    if _repeats(reset, first, noise):
        return "reset", first
    return ("instance" if _repeats(instance, fresh, noise) else "process"), first


def _run_twice(
    load: LoadFmu, run: Callable[[Instance], Array], reuse: Reuse, new_watch: NewWatch
) -> tuple[Array, Array | None]:
    """Return the first run in a new process, and a second one of the reused instance; None where that failed or hung."""

    def work(send: Callable[[Message], None]) -> None:
        instance = load({"restart": reuse})
        for _ in range(2):
            begun = time.monotonic()
            with quoting(instance):
                rows = run(instance)
            if instance.learned["restart"] == reuse:
                send(({"took": time.monotonic() - begun}, {"rows": rows}))

    runs = [arrays["rows"] for _, arrays in isolated(work, _second_hangs(new_watch()))]
    return runs[0], (runs[1] if len(runs) > 1 else None)


def _second_hangs(watch: Watch) -> Callable[[Sequence[Message]], bool]:
    """Return what tells whether the second of two equal runs hangs. A first one has the pool's deadline.

    It hangs where it stands still at one instant for longer than the whole first run took, or where more than half of the
    time is over that this one left until the deadline: then the pool would end more than the trial.
    """

    def hangs(runs: Sequence[Message]) -> bool:
        over = watch.over()
        if not runs:
            return False
        took, still = float(runs[0][0]["took"]), watch.still()
        return over or (still is not None and still > took) or watch.elapsed() > 0.5 * (took + watch.deadline)

    return hangs


def difference(run: Array, other: Array) -> Array:
    """Return the largest difference over rows, (signals,); infinite where only one of them is not a number."""
    absolute = np.abs(run - other)
    absolute[np.isnan(run) & np.isnan(other)] = 0.0
    return np.asarray(np.nan_to_num(absolute, nan=np.inf).max(axis=0, initial=0.0))


def moving(run: Array) -> NDArray[np.bool_]:
    """Return which signals of a run move, (signals,): one at rest throughout cannot tell a start from an end."""
    finite = np.nan_to_num(run)
    return np.asarray(np.ptp(finite, axis=0) > REPEAT_TOLERANCE * np.abs(finite).max(axis=0, initial=0.0))


def _repeats(run: Array | None, first: Array, noise: Array) -> bool:
    """Return whether a run repeats the first. noise: (signals,) by how much two fresh processes differ."""
    if run is None:
        return False
    allowed = REPEAT_TOLERANCE * np.nan_to_num(np.abs(first)).max(axis=0, initial=0.0)
    differences = difference(run, first)
    repeatable = noise <= allowed
    if repeatable.any() or not noise.size:
        return bool((differences <= allowed)[repeatable].all())
    return bool((differences <= NOISE_FACTOR * noise).all())
