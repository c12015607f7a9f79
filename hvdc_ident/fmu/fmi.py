"""The functions of FMI 2.0 and 3.0 behind one interface, over FMPy's bindings. Used in worker processes only.

Vectors are numpy arrays whose address is taken once: a function that is called ten thousand times a run allocates nothing.
"""

from __future__ import annotations

import contextlib
import shutil
import subprocess
from collections.abc import Callable, Sequence
from ctypes import CFUNCTYPE, addressof, byref, c_bool, c_double, c_int, c_size_t, c_void_p
from dataclasses import dataclass
from math import nan
from pathlib import Path
from typing import Any

import numpy as np
from fmpy.fmi1 import FMICallException

from hvdc_ident.data import Array
from hvdc_ident.fmu.description import REAL, Description, Variable
from hvdc_ident.processes.messages import NOW, START, STOP, no_progress

FmiError = FMICallException
"""Raised by a call that returned discard, error or fatal; `.function`, `.status`."""
WARNING, DISCARD, ERROR, FATAL = 1, 2, 3, 4
Function = Callable[..., None]
KEPT = 30  # messages of the FMU that are kept


def why_not_loaded(error: Exception, folder: str, d: Description) -> tuple[str, str]:
    """Return why an FMU's shared library cannot be loaded, and what to try, in words without its temporary folder."""
    from fmpy import platform, platform_tuple, sharedLibraryExtension

    place = Path(folder, "binaries", platform if d.version == 2 else platform_tuple)
    library = place / f"{d.identifier}{sharedLibraryExtension}"
    if missing := _missing_libraries(library):
        hint = "install them, or put the folder they are in into LD_LIBRARY_PATH"
        return f"the FMU's binary needs shared libraries that are not here: {', '.join(missing)}", hint
    said = " ".join(str(error).split()).replace(f"{library.parent}/", "")
    if "undefined symbol" in said:
        function = said.rpartition(":")[2].strip()
        return (
            f"the FMU's binary lacks the function {function}",
            f"export it again{f' from {d.tool}' if d.tool else ''}",
        )
    reason = said.rpartition(f"{library.name}: ")[2] or said
    return f"the FMU's binary {library.name} cannot be loaded: {reason[:200]}", "copy or export the FMU again"


def _missing_libraries(library: Path) -> list[str]:
    """Return what the system's ldd does not find for a library; none where there is no ldd."""
    command = shutil.which("ldd")
    if command is None or not library.is_file():
        return []
    try:
        said = subprocess.run([command, str(library)], capture_output=True, text=True, timeout=10, check=False).stdout
    except (OSError, subprocess.TimeoutExpired):
        return []
    return [line.split()[0] for line in said.splitlines() if line.strip().endswith("not found")]


def refusal(d: Description, said: str) -> str:
    """Return what to try where an FMU gives no instance. said: its own words."""
    words = said.casefold()
    if "guid" in words or "token" in words:
        return "take binary and modelDescription.xml from one export: they do not belong together"
    if "licen" in words:
        return f"the licence that it asks for{f', of {d.tool}' if d.tool else ''}, or an export that needs none"
    if d.needs_tool:
        return f"install {d.tool or 'its tool'}, in which alone it runs, or export it stand-alone"
    return "look for a wrong GUID, a missing licence or a missing resource, which make an FMU refuse"


@dataclass(frozen=True)
class DiscreteUpdate:
    """Result of one event iteration: another iteration wanted, the end, states or nominals changed, the next time event, s."""

    again: bool
    end: bool
    states_changed: bool
    next_time: float | None


class TerminationRequested(Exception):
    """The FMU asked for the end of the run in a step. reached: the instant that it stands at, s."""

    def __init__(self, reached: float) -> None:
        super().__init__("the FMU asked for the end of the run")
        self.reached = reached


class Vector:
    """A vector of doubles with its address."""

    __slots__ = ("address", "pointer", "size", "values")

    def __init__(self, size: int) -> None:
        self.values: Array = np.zeros(size)
        self.size = size
        self.pointer = (c_double * size).from_buffer(self.values.data) if size else (c_double * 1)()
        self.address = addressof(self.pointer)


class VariableGroup:
    """Some variables of an FMU, to be read or set together: values in their order, whatever their types."""

    def __init__(self, library: FmiLibrary, variables: Sequence[Variable]) -> None:
        self._library = library
        self.variables = tuple(variables)
        self.values: Array = np.zeros(len(self.variables))
        self._fast = all(v.kind in ("Real", "Float64") for v in variables)
        self._vector = Vector(len(self.variables))
        self._references = library.references([v.reference for v in variables])
        groups: dict[str, list[int]] = {}
        for i, v in enumerate(variables):
            groups.setdefault(v.kind, []).append(i)
        self._groups = groups

    def get(self) -> Array:
        """The values now, (n,); the array is used again by the next call."""
        if self._fast:
            if self._vector.size:
                self._library.get_reals(self._references, self._vector)
            return self._vector.values
        for kind, places in self._groups.items():
            found = getattr(self._library.fmu, f"get{_call_of(kind, self._library.version)}")(
                [self.variables[i].reference for i in places]
            )
            self.values[places] = [float(x) for x in found]
        return self.values

    def set(self, values: Array | Sequence[float]) -> None:
        """Set the variables to the values."""
        if self._fast:
            if self._vector.size:
                self._vector.values[:] = values
                self._library.set_reals(self._references, self._vector)
            return
        for kind, places in self._groups.items():
            given = [float(values[i]) if kind in REAL else round(float(values[i])) for i in places]
            exact = [bool(x) for x in given] if kind == "Boolean" else given
            getattr(self._library.fmu, f"set{_call_of(kind, self._library.version)}")(
                [self.variables[i].reference for i in places], exact
            )


def _call_of(kind: str, version: int) -> str:
    """Name of the type in FMPy's getters and setters; an enumeration has those of whole numbers."""
    return ("Integer" if version == 2 else "Int64") if kind == "Enumeration" else kind


@dataclass(frozen=True)
class FmiFunctions:
    """The functions of an FMU that are called in every step, each of which raises FmiError.

    Vectors go in as addresses. They are bound here because FMPy's own way to them, which can log each call, takes as
    long as a small FMU does.
    """

    get_reals: Function
    set_reals: Function
    directional: Function
    set_time: Function
    set_states: Function
    get_states: Function
    get_slopes: Function
    get_indicators: Function
    completed_step: Function
    step: Function

    @classmethod
    def of(cls, library: Any, version: int, exchange: bool) -> FmiFunctions:
        """Return those of a library; of what its interface has not, calls that raise."""
        sized = [c_size_t] if version == 3 else []
        real, slopes = ("Real", "Derivatives") if version == 2 else ("Float64", "ContinuousStateDerivatives")
        vector, flag = [c_void_p, c_size_t], _flag(version)

        def bound(name: str, *types: Any) -> Function:
            return _bound(library, f"fmi{version}{name}", types)

        def none(name: str, *types: Any) -> Function:
            return _missing(f"fmi{version}{name}")

        me, cs = (bound, none) if exchange else (none, bound)
        return cls(
            bound(f"Get{real}", *vector, c_void_p, *sized),
            bound(f"Set{real}", *vector, c_void_p, *sized),
            bound("GetDirectionalDerivative", *vector, *vector, c_void_p, *sized, c_void_p, *sized),
            me("SetTime", c_double),
            me("SetContinuousStates", *vector),
            me("GetContinuousStates", *vector),
            me(f"Get{slopes}", *vector),
            me("GetEventIndicators", *vector),
            me("CompletedIntegratorStep", flag, c_void_p, c_void_p),
            cs("DoStep", c_double, c_double, c_int),
        )


def _flag(version: int) -> Any:
    """Return the C type of a truth value, which FMI 2.0 has as a whole number."""
    return c_int if version == 2 else c_bool


def _bound(library: Any, name: str, types: Sequence[Any]) -> Function:
    """Return a function of a library, whose first argument is the instance."""
    function = CFUNCTYPE(c_int, c_void_p, *types)((name, library))

    def call(*arguments: Any) -> None:
        status = function(*arguments)
        if status > WARNING:
            raise FmiError(function=name, status=status)

    call.__code__ = call.__code__.replace(co_name=name)  # by which a crash or a hang tells where it was
    return call


def _missing(name: str) -> Function:
    def call(*arguments: Any) -> None:
        raise FmiError(function=name, status=ERROR)

    return call


class FmiLibrary:
    """An FMU's library with at most one instance. Methods are the calls of FMI, without their prefixes."""

    def __init__(self, description: Description, folder: str) -> None:
        from fmpy.fmi2 import FMU2Model, FMU2Slave
        from fmpy.fmi3 import FMU3Model, FMU3Slave

        self.description, self.version = description, description.version
        self.exchange = description.interface == "model-exchange"
        kind: Any = {(2, True): FMU2Model, (2, False): FMU2Slave, (3, True): FMU3Model, (3, False): FMU3Slave}[
            self.version, self.exchange
        ]
        self.messages: list[str] = []
        self.progress = no_progress()  # where it is noted how far a run is
        self.fmu: Any = kind(
            guid=description.token,
            unzipDirectory=folder,
            modelIdentifier=description.identifier,
            instanceName="hvdc_ident",
        )
        self._call = FmiFunctions.of(self.fmu.dll, self.version, self.exchange)
        self._flags = (_flag(self.version)(), _flag(self.version)())
        self._sized = int(self.version == 3)  # FMI 3.0 gives the number of values, too
        self._callbacks = self._made_callbacks()
        self.component: Any = None
        self.nx = len(description.states)
        self.states, self.slopes = Vector(self.nx), Vector(self.nx)
        self.indicators = Vector(description.indicators)

    def _made_callbacks(self) -> Any:
        if self.version == 3:
            return None
        from fmpy import calloc, free
        from fmpy.fmi2 import (
            fmi2CallbackAllocateMemoryTYPE,
            fmi2CallbackFreeMemoryTYPE,
            fmi2CallbackFunctions,
            fmi2CallbackLoggerTYPE,
        )

        made = fmi2CallbackFunctions()
        made.logger = fmi2CallbackLoggerTYPE(lambda _env, _name, status, _category, text: self._heard(status, text))
        made.allocateMemory = fmi2CallbackAllocateMemoryTYPE(calloc)
        made.freeMemory = fmi2CallbackFreeMemoryTYPE(free)
        with contextlib.suppress(ImportError, OSError, AttributeError):  # only formats the FMU's messages
            from fmpy.logging import addLoggerProxy

            addLoggerProxy(byref(made))
        return made

    def _heard(self, status: int, text: bytes | None) -> None:
        if status > 0 and text:
            self.messages.append(" ".join(text.decode("utf-8", "replace").split())[:300])
            del self.messages[:-KEPT]

    # --- instances ---

    def instantiate(self) -> None:
        """Make an instance. Raises RuntimeError where the FMU gives none."""
        fmu = self.fmu
        try:
            if self.version == 2:
                fmu.instantiate(callbacks=self._callbacks, loggingOn=False)
            else:
                fmu.instantiate(logMessage=lambda _env, status, _category, text: self._heard(status, text))
        except FMICallException:
            raise
        except Exception as e:  # FMPy raises a bare Exception where the FMU returns no instance
            raise RuntimeError(str(e)) from None
        self.component = fmu.component

    def free(self) -> None:
        """Free the instance, where there is one."""
        if self.component is not None:
            (self.fmu.fmi2FreeInstance if self.version == 2 else self.fmu.fmi3FreeInstance)(self.component)
            self.component = self.fmu.component = None

    def reset(self) -> None:
        self.fmu.reset()

    def terminate(self) -> None:
        self.fmu.terminate()

    # --- initialisation ---

    def set_up(self, start: float, stop: float | None, tolerance: float | None) -> None:
        """Tell the experiment, FMI 2.0; before values are set, for some FMUs put their own values back here."""
        self.progress[START] = self.progress[NOW] = start
        self.progress[STOP] = nan if stop is None else stop
        if self.version == 2:
            self.fmu.setupExperiment(tolerance=tolerance, startTime=start, stopTime=stop)

    def enter_initialization(self, start: float, stop: float | None, tolerance: float | None) -> None:
        if self.version == 2:
            self.fmu.enterInitializationMode()
        else:
            self.fmu.enterInitializationMode(tolerance=tolerance, startTime=start, stopTime=stop)

    def exit_initialization(self) -> None:
        self.fmu.exitInitializationMode()

    # --- values ---

    def references(self, numbers: Sequence[int]) -> Any:
        """Value references as C takes them."""
        from ctypes import c_uint

        return (c_uint * len(numbers))(*numbers)

    def get_reals(self, references: Any, into: Vector) -> None:
        n = into.size
        self._call.get_reals(self.component, addressof(references), n, into.address, *(n,) * self._sized)

    def set_reals(self, references: Any, values: Vector) -> None:
        n = values.size
        self._call.set_reals(self.component, addressof(references), n, values.address, *(n,) * self._sized)

    def directional(self, unknowns: Any, n: int, knowns: Any, m: int, seed: Vector, into: Vector) -> None:
        """Put the derivatives of the unknowns along the seed into `into`."""
        u, k = addressof(unknowns), addressof(knowns)
        if self._sized:
            self._call.directional(self.component, u, n, k, m, seed.address, m, into.address, n)
        else:
            self._call.directional(self.component, u, n, k, m, seed.address, into.address)

    # --- model exchange ---

    def set_time(self, t: float) -> None:
        self.progress[NOW] = t
        self._call.set_time(self.component, t)

    def set_states(self, x: Array) -> None:
        if self.nx:
            self.states.values[:] = x
            self._call.set_states(self.component, self.states.address, self.nx)

    def get_states(self) -> Array:
        """(nx,), a copy."""
        if self.nx:
            self._call.get_states(self.component, self.states.address, self.nx)
        return self.states.values.copy()

    def get_slopes(self) -> Array:
        """(nx,) the derivatives; the array is used again by the next call."""
        if self.nx:
            self._call.get_slopes(self.component, self.slopes.address, self.nx)
        return self.slopes.values

    def get_nominals(self) -> Array:
        """(nx,) typical sizes of the states, as the FMU says them."""
        found = Vector(self.nx)
        if self.nx:
            if self.version == 2:
                self.fmu.fmi2GetNominalsOfContinuousStates(self.component, found.pointer, self.nx)
            else:
                self.fmu.fmi3GetNominalsOfContinuousStates(self.component, found.pointer, self.nx)
        return found.values

    def get_indicators(self) -> Array:
        """(nz,), a copy."""
        if self.indicators.size:
            self._call.get_indicators(self.component, self.indicators.address, self.indicators.size)
        return self.indicators.values.copy()

    def enter_events(self) -> None:
        self.fmu.enterEventMode()

    def enter_continuous(self) -> None:
        self.fmu.enterContinuousTimeMode()

    def update(self) -> DiscreteUpdate:
        """One iteration of the discrete part."""
        found = self.fmu.newDiscreteStates() if self.version == 2 else self.fmu.updateDiscreteStates()
        again, end, _, states, defined, when = found
        return DiscreteUpdate(bool(again), bool(end), bool(states), float(when) if defined else None)

    def completed_step(self) -> tuple[bool, bool]:
        """Return whether the FMU wants an event, and whether it wants to end."""
        event, end = self._flags
        self._call.completed_step(self.component, 1, addressof(event), addressof(end))
        return bool(event.value), bool(end.value)

    # --- co-simulation ---

    def step(self, t: float, h: float) -> tuple[float, float]:
        """Return the instant from which to go on, and the one that outputs belong to.

        They differ for an FMU of FMI 3.0 whose own steps do not end at t + h: it goes on from there all the same, and
        early return alone moves the communication point. Raises TerminationRequested where the FMU asks for the end of the run.
        """
        self.progress[NOW] = t
        if self.version == 2:
            try:
                self._call.step(self.component, t, h, 1)
            except FMICallException as e:
                if e.status != DISCARD:
                    raise
                reached = self._discarded(t, e)
                return reached, reached
            return t + h, t + h
        _, end, early, reached = self.fmu.doStep(t, h)
        if end:
            raise TerminationRequested(float(reached))
        return float(reached) if early else t + h, float(reached)

    def _discarded(self, t: float, discard: FMICallException) -> float:
        """Return the time that a discarded step of FMI 2.0 reached. Raises the discard where that is not beyond t."""
        from fmpy.fmi2 import fmi2LastSuccessfulTime, fmi2Terminated

        try:
            end = self.fmu.getBooleanStatus(fmi2Terminated)
        except FMICallException:  # the FMU does not say
            end = False
        try:
            reached = float(self.fmu.getRealStatus(fmi2LastSuccessfulTime))
        except FMICallException:
            if end:
                raise TerminationRequested(t) from None
            raise discard from None
        if end:
            raise TerminationRequested(reached)
        if not reached > t:
            raise discard
        return reached

    def set_slopes_of_inputs(self, references: Any, orders: Any, slopes: Vector) -> None:
        """FMI 2.0 only: the time derivatives of inputs over the next step."""
        self.fmu.fmi2SetRealInputDerivatives(self.component, references, slopes.size, orders, slopes.pointer)
