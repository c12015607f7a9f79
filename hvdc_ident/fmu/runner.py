"""The FMU of a worker process, and the process in which each run of it takes place. In worker processes only.

Between runs an instance is reset, or replaced by a new one, or the whole process is replaced. The cheapest way is taken
whose second run repeats the first run of a fresh process, over a whole run and in every output; one that fails, crashes or
hangs does not. This is found once for an FMU; values at the start alone do not tell, for the reset of some FMUs restores
the start and nothing else. Outputs that two fresh processes do not repeat either, such as the time that the computation
took, are not compared.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array
from hvdc_ident.fmu.description import Message, Setup
from hvdc_ident.fmu.fmi import why_not_loaded
from hvdc_ident.fmu.instance import Instance, Reuse, RunFailed, failure, work_on
from hvdc_ident.parallel import Watch
from hvdc_ident.parallel.inside import die_like, in_new_process, resident, space
from hvdc_ident.parallel.progress import PROCESS, begin

REPEAT_TOLERANCE = 1e-9
"""Share of an output's largest value by which a repeated run may differ. The same program from the same state repeats
itself to the last digit; sums in another order, as of threads, change that by rounding: 1e-16 in each of a million."""
NOISE_FACTOR = 10.0
"""Differences between two fresh processes that a repeated run may have where no output repeats: one difference of a
normal spread is below a tenth of the next in 6 of 100 pairs, and of several outputs hardly ever in all."""
Run = Callable[[Instance], Array]
"""A run from the start, the same each time: (n, signals)."""


class Runner:
    """Runs of an FMU. progress: shared with those who watch them. learned: what is found out about the FMU, in place.

    runs: performed in the present request.
    """

    def __init__(self, setup: Setup, progress: memoryview[float], learned: dict[str, Any]) -> None:
        self.setup, self.description, self.progress, self.learned = setup, setup.description, progress, learned
        self.runs = 0
        self._loaded: Instance | None = None

    def restart_deadline(self) -> None:
        """Begin the deadline of one run."""
        begin(self.progress)

    def perform(self, work: Callable[[Instance], Message], restart: Reuse | None = None) -> Message:
        """Return the result of work on an instance: this process's, or that of a process of its own where runs need one.

        A process of its own is also taken where the reuse is not known yet. What it finds out is kept. restart: known to
        hold for this work, whatever runs need. Raises RunFailed.
        """
        self.runs += 1
        self.restart_deadline()
        if self.learned.get("restart", "process") != "process":
            self._loaded = self._loaded or self._load(self.learned)
            with work_on(self._loaded):
                return work(self._loaded)

        def told(send: Callable[[Message], None]) -> None:
            learned = {**self.learned, "restart": restart}
            instance = self._load(learned)
            with work_on(instance):
                result, arrays = work(instance)
            send(({**result, "learned": {k: v for k, v in learned.items() if k != "restart"}}, arrays))

        result, arrays = _isolated(told)[0]
        self.learned.update(result.pop("learned"))
        return result, arrays

    def _load(self, learned: dict[str, Any]) -> Instance:
        """Load the FMU into this process. learned: gets what the instance finds out. Raises RunFailed."""
        folder = str(self.setup.folder.binaries)
        try:
            instance = Instance(self.description, folder, learned)
        except MemoryError:
            raise
        except Exception as e:  # FMPy raises bare ones, beside those of ctypes
            what, hint = why_not_loaded(e, folder, self.description)
            raise RunFailed(what, hint=hint) from None
        instance.library.progress = self.progress
        self.progress[PROCESS] = os.getpid()
        return instance

    # --- reuse ---

    def find_reuse(self, run: Run) -> tuple[Reuse, Array]:
        """Return the way of reuse and the rows of the first run. Raises RunFailed where the first run fails."""
        first, reset = self._run_twice(run, "reset")
        if _repeats(reset, first, np.zeros(first.shape[1])):
            return "reset", first
        fresh, instance = self._run_twice(run, "instance")
        noise = np.nan_to_num(np.abs(fresh - first)).max(axis=0, initial=0.0)
        if _repeats(reset, first, noise):
            return "reset", first
        return ("instance" if _repeats(instance, fresh, noise) else "process"), first

    def _run_twice(self, run: Run, reuse: Reuse) -> tuple[Array, Array | None]:
        """Return the first run in a new process, and a second one of the reused instance; None where that failed or hung."""

        def work(send: Callable[[Message], None]) -> None:
            instance = self._load({"restart": reuse})
            for _ in range(2):
                begun = time.monotonic()
                self.restart_deadline()
                with work_on(instance):
                    rows = run(instance)
                send(({"took": time.monotonic() - begun}, {"rows": rows}))

        watch = Watch(self.progress, self.setup.deadline)
        runs = [arrays["rows"] for _, arrays in _isolated(work, _second_hangs(watch))]
        return runs[0], (runs[1] if len(runs) > 1 else None)


def _isolated(
    work: Callable[[Callable[[Message], None]], None], hangs: Callable[[Sequence[Message]], bool] | None = None
) -> list[Message]:
    """Return the messages that the work sends from a new process, at least one.

    work: called with the function that sends. Where it sends none, raises its failure as RunFailed, or ends this process
    as the new one ended. hangs: called with the messages so far, whether to end the new process.
    """

    def failed(error: Exception) -> RunFailed:
        told = failure(error)
        told.resident, told.space = resident(), space()
        return told

    messages, end = in_new_process(work, failed, hangs)
    if not messages and isinstance(end, RunFailed):
        raise end
    if not messages:
        die_like(end if isinstance(end, int) else 0)
    return messages


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
