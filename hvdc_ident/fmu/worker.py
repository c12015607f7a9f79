"""The process with an FMU's machine code in it: it answers the pool's requests. See `hvdc_ident.parallel`.

Whatever the FMU prints goes to a file, whose last line the pool quotes where the process ends.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass, field
from functools import partial
from itertools import islice
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.fmu.derivatives import DifferenceStep, PointEvaluation
from hvdc_ident.fmu.description import Description, Message, Setup
from hvdc_ident.fmu.fmi import VariableGroup, why_not_loaded
from hvdc_ident.fmu.instance import Instance, LoadFmu, NewWatch, Reuse, RunFailed, failure, find_reuse, isolated
from hvdc_ident.fmu.sensitivity_run import SensitivityRun
from hvdc_ident.parallel import Watch
from hvdc_ident.parallel.inside import limit_memory, resident, space
from hvdc_ident.parallel.progress import PROCESS, begin


@dataclass
class RequestHandler:
    """A worker's answers to requests, and what it has learned of the FMU.

    load_fmu: loads it into this process. restart_deadline: called between the runs of one request. new_watch: begins to
    watch them. learned: passed on to
    later workers by the pool, see `hvdc_ident.fmu.worker_pool`. steps, noise: of differences, by a digest of the
    experiment. last: digest and outputs of the last run. runs: of the present request.
    """

    description: Description
    load_fmu: LoadFmu
    restart_deadline: Callable[[], None]
    new_watch: NewWatch
    learned: dict[str, Any] = field(default_factory=dict)
    steps: dict[bytes, DifferenceStep] = field(default_factory=dict)
    noise: dict[bytes, Array] = field(default_factory=dict)
    last: tuple[bytes, Array] | None = None
    loaded: Instance | None = None
    runs: int = 0

    @property
    def instance(self) -> Instance:
        """The FMU in this process, loaded when it is first used."""
        if self.loaded is None:
            self.loaded = self.load_fmu(self.learned)
        return self.loaded

    @property
    def isolated(self) -> bool:
        """True where each run has a process of its own: it needs one, or its reuse is not known yet."""
        return self.learned.get("restart", "process") == "process"

    def load(self) -> Message:
        """Make a first instance, so that what prevents it is reported at once."""

        def work() -> Message:
            self.instance.instantiate()
            return {}, {}

        return self._guarded(work)

    def failed(self, error: Exception) -> RunFailed:
        """Return an error as RunFailed, and abandon the instance, which cannot be trusted even to free itself."""
        failed = failure(error, self.loaded.library.messages if self.loaded else ())
        if self.loaded:
            self.loaded.abandon()
        return failed

    def do(self, heading: Mapping[str, Any], arrays: Mapping[str, Array]) -> Message:
        """Return the answer to a request, with what was learned.

        heading: "found" in it has the steps of differences and the noise of runs that other workers have found.
        """
        self.runs = 0
        for name, value in heading.get("found", {}).items():
            kind, _, key = name.partition(" ")
            if kind == "step":
                self.steps.setdefault(bytes.fromhex(key), DifferenceStep(*value))
            else:
                self.noise.setdefault(bytes.fromhex(key), np.array(value))
        known = len(self.steps), len(self.noise)
        if heading["do"] == "simulate":
            result, out = SensitivityRun(self, heading, arrays).answer()
        else:
            if heading["do"] == "point" and heading["parameters"]:
                heading = {**heading, "restart": self._restart_at_point(heading, arrays)}
            work = {"point": self._point, "starts": self._starts}[heading["do"]]
            result, out = self._guarded(lambda: work(heading, arrays))
        found = {f"step {k.hex()}": astuple(s) for k, s in islice(self.steps.items(), known[0], None)}
        found |= {f"noise {k.hex()}": n.tolist() for k, n in islice(self.noise.items(), known[1], None)}
        return {**result, "found": found, "learned": self.learned, "whole runs": self.runs}, out

    def _guarded(self, work: Callable[[], Message]) -> Message:
        """Return the result of work that is done in a separate process where runs are."""

        def told(send: Callable[[Message], None]) -> None:
            try:
                send(work())
            except Exception as e:
                raise self.failed(e) from None

        return isolated(told)[0] if self.isolated else work()

    def _restart_at_point(self, heading: Mapping[str, Any], arrays: Mapping[str, Array]) -> Reuse:
        """Return how the FMU is brought back to its start for another value of a parameter at a point.

        Where no run has shown it, or a whole run needs a new process each time, a trial at the point does. Raises RunFailed
        where neither a reset nor a new instance repeats what the FMU gives there.
        """
        known: Reuse | None = self.learned.get("restart")
        if known in (None, "process"):
            known = self.learned.get("restart at a point")
        if known is None:

            def beside(instance: Instance) -> Array:
                self.restart_deadline()
                return self._evaluation(instance, heading, arrays).beside()[None]

            known, _ = find_reuse(self.load_fmu, beside, self.new_watch)
            self.learned["restart at a point"] = known
        if known == "process":
            raise RunFailed(
                "there are no derivatives by parameters at a point: neither a reset nor a new instance brings the FMU back"
                " to its start",
                float(heading["time"]),
                "leave the parameters out; derivatives of runs can be had, each run has a new process",
            )
        return known

    def _evaluation(
        self, instance: Instance, heading: Mapping[str, Any], arrays: Mapping[str, Array]
    ) -> PointEvaluation:
        """Return the FMU at the point of a request."""
        names = tuple(heading["outputs"])
        return PointEvaluation(instance, heading["values"], arrays.get("x"), arrays["u"], heading["time"], names)

    def _point(self, heading: Mapping[str, Any], arrays: Mapping[str, Array]) -> Message:
        """Return derivatives, outputs and their Jacobian at a point."""
        if self.isolated and "restart" in heading:  # of this process alone
            self.learned = {**self.learned, "restart": heading["restart"]}
        point = self._evaluation(self.instance, heading, arrays)
        derivatives, outputs = point.evaluate()
        jacobian = point.jacobian(heading["parameters"], heading["sizes"], check=heading["check"])
        return {"error": jacobian.error, "near": jacobian.near}, {
            "x": point.x,
            "derivatives": derivatives,
            "outputs": outputs,
            "jacobian": jacobian.matrix,
            "directional": jacobian.directional.astype(float),
            "nominals": self.instance.nominals(),
        }

    def _starts(self, heading: Mapping[str, Any], arrays: Mapping[str, Array]) -> Message:
        """Return the parameters' values where none is set."""
        d = self.description
        self.instance.begin({}, np.array([v.start or 0.0 for v in d.inputs.values()]), 0.0, None, None)
        return {}, {"parameters": VariableGroup(self.instance.library, tuple(d.parameters.values())).get().copy()}


def serve(connection: Connection, progress: memoryview[float], setup: Setup, learned: Mapping[str, Any]) -> None:
    """Answer requests until the connection closes or the FMU ends the process. learned: by earlier workers."""
    folder = str(setup.folder.binaries)
    limit_memory(progress, setup.memory)

    def load(learned: dict[str, Any]) -> Instance:
        try:
            instance = Instance(setup.description, folder, learned)
        except MemoryError:
            raise
        except Exception as e:  # FMPy raises bare ones, beside those of ctypes
            what, hint = why_not_loaded(e, folder, setup.description)
            raise RunFailed(what, hint=hint) from None
        instance.library.progress = progress
        progress[PROCESS] = os.getpid()
        return instance

    def restart_deadline() -> None:
        begin(progress)  # the deadline is that of one run

    def answer(work: Callable[[], tuple[Mapping[str, Any], Mapping[str, Any]]]) -> bool:
        """Send the work's result or its failure; return whether it succeeded.

        A fatal failure ends the process. One with "again" may have come from what the process did before: the pool asks
        once more in a new one.
        """
        try:
            result, arrays = work()
            heading, fatal = {**result, "done": 1}, False
        except Exception as e:
            failed = handler.failed(e)
            heading, arrays, fatal = failed.heading(), {}, failed.fatal
        progress[PROCESS] = os.getpid()  # the work may have used others
        memory = {"memory": max(resident(), heading.get("resident", 0)), "space": max(space(), heading.get("space", 0))}
        connection.send(({**heading, **memory}, arrays))
        if fatal:
            os._exit(0)
        return "done" in heading

    def new_watch() -> Watch:
        return Watch(progress, setup.deadline)

    handler = RequestHandler(setup.description, load, restart_deadline, new_watch, dict(learned))
    if not answer(handler.load):
        return
    while True:
        heading, arrays = connection.recv()
        restart_deadline()
        answer(partial(handler.do, heading, arrays))
