"""One instance of an FMU that is kept over many runs. Runs in the worker alone."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hvdc_ident.fmu.binding import Binding, Block, Failure, Update
from hvdc_ident.fmu.description import Description
from hvdc_ident.trajectory import Array

ITERATIONS = 1000  # of the discrete part at one instant


class RunFailed(Exception):
    """A run that did not reach its end: what happened, at which instant, and what to try."""

    def __init__(self, what: str, t: float | None = None, hint: str = "") -> None:
        super().__init__(what)
        self.what, self.t, self.hint = what, t, hint


class NoInstance(RunFailed):
    """The FMU gave no instance. In a process that had one before, a new process is worth a try: some give only one."""


class Plant:
    """An FMU with an instance, brought to the start of a run again and again.

    A kept instance is reset; where that does not bring the same start back as the first time, each run has its own.
    """

    def __init__(self, description: Description, folder: str) -> None:
        self.description = description
        self.binding = Binding(description, folder)
        self.inputs = Block(self.binding, tuple(description.inputs.values()))
        self.all_outputs = Block(self.binding, tuple(description.outputs.values()))
        self._running = False
        self._first: tuple[dict[str, float], Array, float, Array] | None = None
        self.keeps: bool | None = None
        self.agreed = False  # whether directional derivatives agreed with differences where last compared
        self.next_time: float | None = None

    def block(self, names: tuple[str, ...]) -> Block:
        """Return variables of these names, to be read together: outputs, states, or any other."""
        return Block(self.binding, tuple(self.description.variable(n) for n in names))

    def begin(
        self, values: Mapping[str, float], inputs: Array, start: float, stop: float | None, tolerance: float | None
    ) -> None:
        """Nothing; the instance is initialised: parameters that differ from their start, inputs, instant in s.

        Model exchange: events at the start are settled and the instance is in continuous-time mode.
        """
        if self.keeps is None and self._first is not None:
            self._try_keeping(stop, tolerance)
        self._begin(values, inputs, start, stop, tolerance)
        if self._first is None:
            self._first = (dict(values), np.array(inputs), start, self._signature())

    def _try_keeping(self, stop: float | None, tolerance: float | None) -> None:
        """Nothing; it is known whether a reset brings the first start back."""
        assert self._first is not None
        values, inputs, start, seen = self._first
        self.keeps = True
        self._begin(values, inputs, start, stop, tolerance)
        self.keeps = bool(np.allclose(self._signature(), seen, rtol=1e-12, atol=1e-14, equal_nan=True))

    def _signature(self) -> Array:
        states = self.binding.get_states() if self.binding.exchange else np.empty(0)
        return np.concatenate([states, self.all_outputs.get()])

    def _begin(
        self, values: Mapping[str, float], inputs: Array, start: float, stop: float | None, tolerance: float | None
    ) -> None:
        b = self.binding
        self._rest()
        parameters = [self.description.parameters[n] for n in values]
        Block(b, parameters).set(list(values.values()))
        self.inputs.set(inputs)
        b.enter_initialization(start, stop, tolerance)
        self._running = True
        self.inputs.set(inputs)
        b.exit_initialization()
        if b.exchange:
            self.iterate(start)
            b.enter_continuous()

    def _rest(self) -> None:
        """Nothing; there is an instance that was not initialised since it was made or reset."""
        b = self.binding
        if b.component is not None and self._running:
            self._running = False
            if self.keeps is False:
                b.terminate()
                b.free()
            else:
                try:
                    b.terminate()
                    b.reset()
                except Failure:
                    self.keeps = False
                    b.free()
        if b.component is None:
            self.instantiate()

    def instantiate(self) -> None:
        """Nothing; there is an instance."""
        try:
            self.binding.instantiate()
        except RuntimeError:
            said = f": {self.binding.messages[-1]}" if self.binding.messages else ""
            hint = "a wrong GUID, a missing licence or resource make an FMU refuse"
            raise NoInstance(f"the FMU gave no instance{said}", hint=hint) from None

    def abandon(self) -> None:
        """Nothing; the instance is forgotten, for after a failure it cannot be trusted even to free itself."""
        self.binding.component = self.binding.fmu.component = None
        self._running = False

    # --- events, model exchange ---

    def iterate(self, t: float) -> bool:
        """Whether the states changed; the discrete part has come to rest, in event mode before and after."""
        changed = False
        for _ in range(ITERATIONS):
            found: Update = self.binding.update()
            changed |= found.states_changed
            self.next_time = found.next_time
            if found.end:
                raise RunFailed("the FMU asked for the end of the run", t)
            if not found.again:
                return changed
        raise RunFailed(f"the events at one instant did not settle in {ITERATIONS} iterations", t)

    def nominals(self) -> Array:
        """(nx,) typical sizes of the states, above 0: what the FMU says, else what its description says, else 1."""
        said = np.abs(self.binding.get_nominals())
        described = np.array([v.nominal for v in self.description.states.values()])
        return np.where(np.isfinite(said) & (said > 0.0), said, described)
