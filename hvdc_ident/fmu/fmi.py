"""The functions of FMI 2.0 and 3.0 behind one interface, over FMPy's bindings. Used in worker processes only.

Vectors are numpy arrays whose address is taken once: a function that is called ten thousand times a run allocates nothing.
"""

from __future__ import annotations

import contextlib
import shutil
import subprocess
from collections.abc import Callable, Sequence
from ctypes import CFUNCTYPE, addressof, byref, c_bool, c_double, c_int, c_size_t, c_void_p
from math import nan
from pathlib import Path
from typing import Any

import numpy as np
from fmpy.fmi1 import FMICallException

from hvdc_ident.data import Array
from hvdc_ident.fmu.description import REAL, Description, Interface, Variable
from hvdc_ident.parallel.progress import NOW, START, STOP, no_progress

FmiError = FMICallException
"""Raised by a call that returned discard, error or fatal; `.function`, `.status`."""
WARNING, DISCARD, ERROR, FATAL = 1, 2, 3, 4
Function = Callable[..., None]
MESSAGES_KEPT = 30  # of the FMU in a run, that differ
MESSAGES_QUOTED = 3  # the last ones, where the run fails: an FMU reports a cause before its consequence


def why_not_loaded(error: Exception, folder: str, d: Description) -> tuple[str, str]:
    """Return why an FMU's shared library cannot be loaded, and what to try, in words without its temporary folder."""
    from fmpy import platform, platform_tuple, sharedLibraryExtension

    library_folder = Path(folder, "binaries", platform if d.version == 2 else platform_tuple)
    library = library_folder / f"{d.identifier}{sharedLibraryExtension}"
    if missing := _missing_libraries(library):
        hint = "install them, or put the folder they are in into LD_LIBRARY_PATH"
        return f"the FMU's binary needs shared libraries that are not here: {', '.join(missing)}", hint
    message = " ".join(str(error).split()).replace(f"{library.parent}/", "")
    if "undefined symbol" in message:
        function = message.rpartition(":")[2].strip()
        return (
            f"the FMU's binary lacks the function {function}",
            f"export it again{f' from {d.tool}' if d.tool else ''}",
        )
    reason = message.rpartition(f"{library.name}: ")[2] or message
    return f"the FMU's binary {library.name} cannot be loaded: {reason[:200]}", "copy or export the FMU again"


def _missing_libraries(library: Path) -> list[str]:
    """Return what the system's ldd does not find for a library; none where there is no ldd."""
    command = shutil.which("ldd")
    if command is None or not library.is_file():
        return []
    try:
        output = subprocess.run([command, str(library)], capture_output=True, text=True, timeout=10, check=False).stdout
    except (OSError, subprocess.TimeoutExpired):
        return []
    return [line.split()[0] for line in output.splitlines() if line.strip().endswith("not found")]


def refusal(d: Description, message: str) -> str:
    """Return a hint for an FMU that gives no instance, by what its message names."""
    words = message.casefold()
    if "guid" in words or "token" in words:
        return "take binary and modelDescription.xml from one export: they do not belong together"
    if "licen" in words:
        return f"the licence that it asks for{f', of {d.tool}' if d.tool else ''}, or an export that needs none"
    if d.needs_tool:
        return f"install {d.tool or 'its tool'}, in which alone it runs, or export it stand-alone"
    return "look for a wrong GUID, a missing licence or a missing resource, which make an FMU refuse"


def quoted(messages: Sequence[str]) -> str:
    """Return the last messages of an FMU, joined."""
    return "; ".join(messages[-MESSAGES_QUOTED:])


class TerminationRequested(Exception):
    """The FMU requested the end of the run during a step. reached: the instant that it has reached, s."""

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
    """Variables of an FMU, of any numeric types, that are read or set together, in their order."""

    def __init__(self, library: FmiLibrary, variables: Sequence[Variable]) -> None:
        self._library = library
        self.variables = tuple(variables)
        self._fast = all(v.kind in ("Real", "Float64") for v in variables)
        self._vector = Vector(len(self.variables))
        self._references = library.references([v.reference for v in variables])
        groups: dict[str, list[int]] = {}
        for i, v in enumerate(variables):
            groups.setdefault(v.kind, []).append(i)
        self._groups = groups

    def get(self) -> Array:
        """Return the present values, (n,); the next call overwrites the array."""
        if self._fast:
            if self._vector.size:
                self._library.get_reals(self._references, self._vector)
            return self._vector.values
        for kind, indices in self._groups.items():
            values = self._accessor("get", kind)([self.variables[i].reference for i in indices])
            self._vector.values[indices] = [float(x) for x in values]
        return self._vector.values

    def set(self, values: Array | Sequence[float]) -> None:
        """Set the variables to the values."""
        if self._fast:
            if self._vector.size:
                self._vector.values[:] = values
                self._library.set_reals(self._references, self._vector)
            return

        for kind, indices in self._groups.items():
            given = [float(values[i]) if kind in REAL else round(float(values[i])) for i in indices]
            exact = [bool(x) for x in given] if kind == "Boolean" else given
            self._accessor("set", kind)([self.variables[i].reference for i in indices], exact)

    def _accessor(self, access: str, kind: str) -> Any:
        """Return FMPy's getter or setter of a type; an enumeration has that of integers."""
        integer = "Integer" if self._library.version == 2 else "Int64"
        return getattr(self._library.fmu, f"{access}{integer if kind == 'Enumeration' else kind}")


def _flag(version: int) -> Any:
    """Return the C type of a truth value, which FMI 2.0 has as a whole number."""
    return c_int if version == 2 else c_bool


def _bound(library: Any, name: str, types: Sequence[Any]) -> Function:
    """Return a function of a library, whose first argument is the instance, as one that raises FmiError."""
    function = CFUNCTYPE(c_int, c_void_p, *types)((name, library))

    def call(*arguments: Any) -> None:
        status = function(*arguments)
        if status > WARNING:
            raise FmiError(function=name, status=status)

    call.__code__ = call.__code__.replace(co_name=name)  # shows in the stack trace of a crash or a hang
    return call


def binding(version: int, interface: Interface) -> Any:
    """Return FMPy's class of an interface: an instance binds the functions of a library."""
    from fmpy.fmi2 import FMU2Model, FMU2Slave
    from fmpy.fmi3 import FMU3Model, FMU3Slave

    exchange = interface == "model-exchange"
    if version == 2:
        return FMU2Model if exchange else FMU2Slave
    return FMU3Model if exchange else FMU3Slave


class FmiLibrary:
    """An FMU's library with at most one instance. Methods are the calls of FMI, without their prefixes."""

    def __init__(self, description: Description, folder: str) -> None:
        self.description, self.version = description, description.version
        self.exchange = description.interface == "model-exchange"
        self.messages: list[str] = []
        self.progress = no_progress()  # where it is noted how far a run is
        self.fmu = binding(self.version, description.interface)(
            guid=description.token,
            unzipDirectory=folder,
            modelIdentifier=description.identifier,
            instanceName="hvdc_ident",
        )
        self._flags = (_flag(self.version)(), _flag(self.version)())
        self._sized = int(self.version == 3)  # FMI 3.0 passes the number of values, too
        self._bind()
        self._callbacks = self._made_callbacks()
        self.component: Any = None
        self.nx = len(description.states)
        self.states, self.derivatives = Vector(self.nx), Vector(self.nx)
        self.indicators = Vector(description.indicators)

    def _bind(self) -> None:
        """Bind the functions that are called in every step; vectors are passed as addresses.

        FMPy's own way to them, which can log each call, takes as long as a small FMU does.
        """
        real, derivatives = ("Real", "Derivatives") if self.version == 2 else ("Float64", "ContinuousStateDerivatives")
        vector, sized = [c_void_p, c_size_t], [c_size_t] * self._sized

        def bound(name: str, *types: Any) -> Function:
            return _bound(self.fmu.dll, f"fmi{self.version}{name}", types)

        self._get_reals = bound(f"Get{real}", *vector, c_void_p, *sized)
        self._set_reals = bound(f"Set{real}", *vector, c_void_p, *sized)
        self._directional = bound("GetDirectionalDerivative", *vector, *vector, c_void_p, *sized, c_void_p, *sized)
        if not self.exchange:
            self._do_step = bound("DoStep", c_double, c_double, c_int)
            return
        self._set_time = bound("SetTime", c_double)
        self._set_states = bound("SetContinuousStates", *vector)
        self._get_states = bound("GetContinuousStates", *vector)
        self._get_derivatives = bound(f"Get{derivatives}", *vector)
        self._get_indicators = bound("GetEventIndicators", *vector)
        self._completed_step = bound("CompletedIntegratorStep", _flag(self.version), c_void_p, c_void_p)

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
            message = " ".join(text.decode("utf-8", "replace").split())[:300]
            with contextlib.suppress(ValueError):  # one that repeats is kept once, as the last
                self.messages.remove(message)
            self.messages.append(message)
            del self.messages[:-MESSAGES_KEPT]

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

    def setup_experiment(self, start: float, stop: float | None, tolerance: float | None) -> None:
        """Set up the experiment, FMI 2.0; before values are set, for some FMUs restore their own values in it."""
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
        self._get_reals(self.component, addressof(references), n, into.address, *(n,) * self._sized)

    def set_reals(self, references: Any, values: Vector) -> None:
        n = values.size
        self._set_reals(self.component, addressof(references), n, values.address, *(n,) * self._sized)

    def directional(self, unknowns: Any, n: int, knowns: Any, m: int, seed: Vector, into: Vector) -> None:
        """Write the derivatives of the unknowns along the seed into `into`."""
        u, k = addressof(unknowns), addressof(knowns)
        if self._sized:
            self._directional(self.component, u, n, k, m, seed.address, m, into.address, n)
        else:
            self._directional(self.component, u, n, k, m, seed.address, into.address)

    # --- model exchange ---

    def set_time(self, t: float) -> None:
        self.progress[NOW] = t
        self._set_time(self.component, t)

    def set_states(self, x: Array) -> None:
        if self.nx:
            self.states.values[:] = x
            self._set_states(self.component, self.states.address, self.nx)

    def get_states(self) -> Array:
        """(nx,), a copy."""
        if self.nx:
            self._get_states(self.component, self.states.address, self.nx)
        return self.states.values.copy()

    def get_derivatives(self) -> Array:
        """(nx,) the derivatives; the array is used again by the next call."""
        if self.nx:
            self._get_derivatives(self.component, self.derivatives.address, self.nx)
        return self.derivatives.values

    def get_nominals(self) -> Array:
        """(nx,) typical sizes of the states, as the FMU says them."""
        nominals = Vector(self.nx)
        if self.nx:
            if self.version == 2:
                self.fmu.fmi2GetNominalsOfContinuousStates(self.component, nominals.pointer, self.nx)
            else:
                self.fmu.fmi3GetNominalsOfContinuousStates(self.component, nominals.pointer, self.nx)
        return nominals.values

    def get_indicators(self) -> Array:
        """(nz,), a copy."""
        if self.indicators.size:
            self._get_indicators(self.component, self.indicators.address, self.indicators.size)
        return self.indicators.values.copy()

    def enter_event_mode(self) -> None:
        self.fmu.enterEventMode()

    def enter_continuous_time_mode(self) -> None:
        self.fmu.enterContinuousTimeMode()

    def new_discrete_states(self) -> tuple[bool, bool, bool, float | None]:
        """Return the result of one event iteration: another one needed, the end wanted, states changed, next time event, s."""
        update = self.fmu.newDiscreteStates() if self.version == 2 else self.fmu.updateDiscreteStates()
        again, end, _, states_changed, defined, next_time = update
        return bool(again), bool(end), bool(states_changed), float(next_time) if defined else None

    def completed_integrator_step(self) -> tuple[bool, bool]:
        """Return whether the FMU wants an event, and whether it wants to end."""
        event, end = self._flags
        self._completed_step(self.component, 1, addressof(event), addressof(end))
        return bool(event.value), bool(end.value)

    # --- co-simulation ---

    def do_step(self, t: float, h: float) -> tuple[float, float]:
        """Return the instant from which to go on, and the one that outputs belong to.

        They differ for an FMU of FMI 3.0 whose own steps do not end at t + h: it goes on from there all the same, and
        early return alone moves the communication point. Raises TerminationRequested where the FMU asks for the end of the run.
        """
        self.progress[NOW] = t
        if self.version == 2:
            try:
                self._do_step(self.component, t, h, 1)
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

    def set_input_derivatives(self, references: Any, orders: Any, derivatives: Vector) -> None:
        """FMI 2.0 only: the time derivatives of inputs over the next step."""
        self.fmu.fmi2SetRealInputDerivatives(self.component, references, derivatives.size, orders, derivatives.pointer)
