"""The process with an FMU's machine code in it: it answers the pool's requests. See `hvdc_ident.parallel`.

Whatever the FMU prints goes to a file, whose last line the pool quotes where the process ends.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.fmu.derivatives import PointEvaluation
from hvdc_ident.fmu.description import Message, Setup
from hvdc_ident.fmu.fmi import VariableGroup
from hvdc_ident.fmu.instance import Instance, Reuse, RunFailed, failure
from hvdc_ident.fmu.runner import Runner
from hvdc_ident.fmu.worker_run import ExperimentRun
from hvdc_ident.parallel.inside import limit_memory, resident, space
from hvdc_ident.parallel.progress import PROCESS


def serve(connection: Connection, progress: memoryview[float], setup: Setup, learned: Mapping[str, Any]) -> None:
    """Answer requests until the connection closes or the FMU ends the process. learned: by other workers."""
    limit_memory(progress, setup.memory)
    runner = Runner(setup, progress, dict(learned))

    def answer(work: Callable[[], Message]) -> bool:
        """Send the work's result or its failure; return whether it succeeded.

        A fatal failure ends the process. One with "again" may have come from what the process did before: the pool asks
        once more in a new one.
        """
        failed: RunFailed | None = None
        heading: dict[str, Any] = {}
        arrays: dict[str, Array] = {}
        try:
            heading, arrays = work()
        except Exception as e:
            failed = failure(e)
            heading = {"failed": failed.what, **vars(failed)}
        progress[PROCESS] = os.getpid()  # the work may have used others
        memory = {"memory": max(resident(), heading.get("resident", 0)), "space": max(space(), heading.get("space", 0))}
        connection.send(({**heading, **memory}, arrays))
        if failed is not None and failed.fatal:
            os._exit(0)
        return failed is None

    if not answer(lambda: runner.perform(_loaded)):
        return
    while True:
        request = connection.recv()
        runner.restart_deadline()
        answer(partial(_answered, runner, *request))


def _loaded(instance: Instance) -> Message:
    """Make a first instance, so that what prevents it is reported at once."""
    instance.instantiate()
    return {}, {}


def _answered(runner: Runner, heading: Mapping[str, Any], arrays: Mapping[str, Array]) -> Message:
    """Return the answer to a request, with what was learned. heading: "learned" in it is what other workers have."""
    runner.runs = 0
    runner.learned.update(heading["learned"])
    if heading["do"] == "run":
        result, out = ExperimentRun(runner, heading, arrays).answer()
        result["whole runs"] = runner.runs
    else:
        result, out = {"point": _point, "initial": _initial}[heading["do"]](runner, heading, arrays)
    return {**result, "learned": runner.learned}, out


def _point(runner: Runner, heading: Mapping[str, Any], arrays: Mapping[str, Array]) -> Message:
    """Return the FMU at a point."""

    def evaluation(instance: Instance) -> PointEvaluation:
        names = tuple(heading["outputs"])
        return PointEvaluation(instance, heading["values"], arrays.get("x"), arrays["u"], heading["time"], names)

    def work(instance: Instance) -> Message:
        point = evaluation(instance)
        return {"point": point.found(heading["parameters"], heading["sizes"], check=heading["check"])}, {}

    restart = _restart_at_point(runner, evaluation, heading["time"]) if heading["parameters"] else None
    return runner.perform(work, restart)


def _restart_at_point(runner: Runner, evaluation: Callable[[Instance], PointEvaluation], t: float) -> Reuse:
    """Return how the FMU is brought back to its start for another value of a parameter at a point.

    Where no run has shown it, or a whole run needs a new process each time, a trial at the point does. Raises RunFailed
    where neither a reset nor a new instance repeats what the FMU gives there.
    """
    known: Reuse | None = runner.learned.get("restart")
    if known in (None, "process"):
        known = runner.learned.get("restart at a point")
    if known is None:
        known, _ = runner.find_reuse(lambda instance: evaluation(instance).beside()[None])
        runner.learned["restart at a point"] = known
    if known == "process":
        raise RunFailed(
            "there are no derivatives by parameters at a point: neither a reset nor a new instance brings the FMU back"
            " to its start",
            t,
            "leave the parameters out; derivatives of runs can be had, each run has a new process",
        )
    return known


def _initial(runner: Runner, heading: Mapping[str, Any], arrays: Mapping[str, Array]) -> Message:
    """Return the states, (n, nx), and the parameters, (n, np), that runs begin with. values: one dictionary a run."""

    def work(instance: Instance) -> Message:
        parameters = VariableGroup(instance.library, tuple(runner.description.parameters.values()))
        states, values = [], []
        for given, u in zip(heading["values"], arrays["u"], strict=True):
            runner.restart_deadline()
            instance.begin(given, u, heading["time"], None, heading["tolerance"])
            states.append(instance.library.get_states())
            values.append(parameters.get().copy())
        return {}, {"states": np.array(states), "parameters": np.array(values)}

    return runner.perform(work)
