"""One instance of an FMU, used for many runs, and the failures of these. In worker processes only."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.errors import one_line
from hvdc_ident.fmu.description import Description
from hvdc_ident.fmu.fmi import DISCARD, ERROR, FATAL, FmiError, FmiLibrary, VariableGroup, quoted, refusal

Reuse = Literal["reset", "instance", "process"]
"""Way in which each run begins: with a reset of the instance, a new instance, or a new process."""
PARAMETER_TOLERANCE = 1e-6  # relative difference of a parameter read back after it was set: single precision passes
EVENT_ITERATIONS = 1000  # of the discrete part at one instant


class RunFailed(Exception):
    """A run that did not reach its end.

    what: what happened. t: the instant, s. hint: what to try. message: the FMU's own last messages. fatal: the process
    cannot be used any more. again: a new process may succeed, where this one has made an instance before. resident,
    space: bytes of memory and of address space of the separate process that it happened in; 0 where there was none.
    """

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
def work_on(instance: Instance) -> Iterator[None]:
    """Raise any error of the work as RunFailed with the FMU's messages; abandon the instance then.

    After a failure it cannot be trusted even to free itself.
    """
    try:
        yield
    except Exception as e:
        instance.abandon()
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
        self._set: set[str] = set()  # parameters whose values this process was given
        self._own: dict[str, float] = {}  # values that parameters have in this process where they are not set
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
        """Initialise the instance: parameters, inputs, instant in s. Parameters without a value are left as the FMU has them.

        Model exchange: events at the start are processed and the instance is in continuous-time mode.
        """
        library, parameters = self.library, self.description.parameters
        self._make_uninitialised()
        library.messages.clear()
        until = None if stop is None or stop <= start else stop  # some FMUs refuse an experiment of no length
        library.setup_experiment(start, until, tolerance)
        # A reset may keep what was set: a value of the last run must not enter this one.
        own = {n: self._own.get(n, parameters[n].start) for n in self._set - values.keys()}
        moved = {n: v for n, v in values.items() if v != parameters[n].start or n in self._set}
        self._assign({**{n: v for n, v in own.items() if v is not None}, **moved})
        library.enter_initialization(start, until, tolerance)
        self._running = True
        self._assign(self._held_otherwise({n: v for n, v in values.items() if n not in moved}))
        self.inputs.set(inputs)  # some FMUs refuse inputs before this mode
        library.exit_initialization()
        self._check_parameters(values, start)
        if library.exchange:
            self.update_discrete_states(start)
            library.enter_continuous_time_mode()

    def _assign(self, values: Mapping[str, float]) -> None:
        """Set parameters."""
        VariableGroup(self.library, [self.description.parameters[n] for n in values]).set(list(values.values()))
        self._set |= values.keys()

    def _held_otherwise(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return those of some starts that the instance does not have: its description need not be that of its binary.

        What it has itself is kept for later. Learned: "own values", where those are others, and in "unread" the parameters
        that were set before they could be read.
        """
        parameters = self.description.parameters
        wanted = values if "own values" in self.learned else parameters.keys() - self._set
        described = {n: s for n in wanted if (s := parameters[n].start) is not None}
        read = self._read(described)
        if read is None:
            return {}
        self._own.update(read)
        other = {n: v for n, v in read.items() if _differ(v, described[n])}
        self.learned.setdefault("unread", tuple(sorted(self._set)))
        self.learned["own values"] = {**self.learned.get("own values", {}), **other}
        return {n: v for n, v in values.items() if n in other}

    def _read(self, names: Iterable[str]) -> dict[str, float] | None:
        """Return the values of parameters; None where the FMU does not show them, with which it can still be run."""
        wanted = tuple(names)
        try:
            read = VariableGroup(self.library, [self.description.parameters[n] for n in wanted]).get().tolist()
        except FmiError:
            return None
        return dict(zip(wanted, read, strict=True))

    def _check_parameters(self, values: Mapping[str, float], start: float) -> None:
        """Raise RunFailed where a parameter does not read as it was set: the run would be that of another value."""
        for name, actual in (self._read(values) or {}).items():
            if _differ(actual, values[name]):
                raise RunFailed(
                    f"parameter '{name}' was set to {values[name]:.9g} and reads {actual:.9g}: the FMU does not take the value",
                    start,
                    "leave it at its start value, or export it as tunable",
                )

    def _make_uninitialised(self) -> None:
        """Reset the instance, or make a new one, where it has been initialised since; make one where there is none."""
        library = self.library
        if library.component is not None and self._running:
            self._running = False
            with contextlib.suppress(FmiError):  # an FMU that has ended by itself refuses; the next call decides
                library.terminate()
            if self.learned.get("restart") == "reset":
                library.reset()
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
        """Forget the instance without freeing it."""
        self.library.component = self.library.fmu.component = None
        self._running = False

    # --- model exchange ---

    def handle_event(self, t: float, inputs: Array | None = None) -> bool:
        """Go through event mode, in which inputs are set where they are given; return whether the states changed."""
        self.library.enter_event_mode()
        if inputs is not None:
            self.inputs.set(inputs)
        changed = self.update_discrete_states(t)
        self.library.enter_continuous_time_mode()
        return changed

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


def _differ(actual: float, value: float) -> bool:
    """Return whether a parameter reads otherwise than it was set."""
    return abs(actual - value) > PARAMETER_TOLERANCE * abs(value)
