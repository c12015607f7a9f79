"""The worker processes of an FMU: started when needed, watched, and replaced when one crashes, hangs or grows old.

This contains crashes, hangs and leaks. It does not contain malice: load only FMUs you trust.
"""

from __future__ import annotations

import contextlib
import linecache
import math
import multiprocessing
import os
import re
import signal
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from multiprocessing.util import Finalize
from pathlib import Path
from threading import Lock
from typing import Any

from hvdc_ident.data import Array
from hvdc_ident.errors import InputError, SimulationError, require_known
from hvdc_ident.fmu.archive import Folder, shared_folder, unpacked_folder
from hvdc_ident.fmu.description import Description, Message, Setup
from hvdc_ident.fmu.differences import DifferenceStep
from hvdc_ident.fmu.last_runs import LastRuns
from hvdc_ident.parallel import Child, Ending, Watch, available_cores
from hvdc_ident.parallel.progress import RESIDENT, SPACE, begin

MIB = 2**20
NEEDS = ("hvdc_ident.fmu.worker", "fmpy.fmi2", "fmpy.fmi3", "scipy.integrate")
"""Modules that a worker imports before it loads an FMU."""
EXHAUSTED = 0.5
"""Share of its memory from which a process may have run out of it: one that grows by doubling is refused from half on."""


@dataclass(frozen=True)
class Limits:
    """Limits of an FMU's processes.

    deadline: s for one run. load: s to begin. memory: bytes more than a worker has without the FMU. runs: after which a
    worker is replaced by a new one, as it is where it keeps half of its memory. workers: processes at once for
    differences of whole runs, None: as many as there are idle cores, or one in a process of a pool.
    """

    deadline: float = 60.0
    load: float = 60.0
    memory: int | None = 2 * 2**30
    runs: int = 2000
    workers: int | None = None

    def __post_init__(self) -> None:
        for name in ("deadline", "load", "memory", "runs", "workers"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InputError("a limit is not above 0", where=f"limits of an FMU, {name}", got=f"{value:g}")

    @classmethod
    def of(cls, stated: Limits | Mapping[str, float] | None) -> Limits:
        """Return the limits that a study's keys state: deadline and load in s, memory in MiB."""
        if isinstance(stated, Limits):
            return stated
        values: dict[str, Any] = dict(stated or {})
        require_known("limit", values, [f.name for f in fields(cls)], "limits of an FMU")
        if "memory" in values:
            values["memory"] = round(values["memory"] * MIB)
        return cls(**values)


@dataclass(frozen=True)
class Budget:
    """The memory that a worker may take, in bytes: `most` more than it began with. None: no limit."""

    most: int | None
    resident: int = 0
    space: int = 0

    def taken(self, resident: int, space: int) -> int:
        """Return the bytes taken since the worker began: of the address space, which the limit is on, where it is known."""
        return max(resident - self.resident if resident else 0, space - self.space if space else 0, 0)

    def exhausted(self, taken: int) -> bool:
        """Return whether the worker may have run out of it."""
        return self.most is not None and taken >= EXHAUSTED * self.most

    def told(self, taken: int) -> str:
        """Return the memory taken, in words."""
        assert self.most is not None
        return f"it had used {taken / MIB:.0f} of its {self.most / MIB:.0f} MiB of memory"

    @property
    def larger(self) -> int:
        """A limit of twice as much, in MiB."""
        assert self.most is not None
        return math.ceil(2 * self.most / MIB)


@dataclass(eq=False)
class _FmuWorker:
    """A process with the FMU in it. memory: bytes that the FMU may take. runs: requests so far.

    resident, space: bytes of memory and of address space after its last answer.
    """

    process: Child
    memory: int | None
    runs: int = 0
    resident: int = 0
    space: int = 0

    @property
    def pid(self) -> int:
        """Number of its process, 0 before it began."""
        return self.process.pid

    @property
    def budget(self) -> Budget:
        """The memory that it may take."""
        return Budget(self.memory, int(self.process.progress[RESIDENT]), int(self.process.progress[SPACE]))

    @property
    def last_line(self) -> str:
        """The last line that it printed."""
        return " ".join(self.process.printed.rpartition("\n")[2].split())[:300]


@dataclass(eq=False)
class _Processes:
    """The processes of a pool and its folder. They end with the pool.

    spare: started processes whose worker has ended: the next one begins there with everything imported.
    """

    owner: int
    folder: Folder
    workers: dict[int, _FmuWorker] = field(default_factory=dict)
    spare: list[Child] = field(default_factory=list)

    def close(self) -> None:
        """End all processes; remove the folder where no other process uses it."""
        for child in (*(w.process for w in self.workers.values()), *self.spare):
            child.close()
        self.workers.clear()
        self.spare.clear()
        if self.owner == os.getpid():
            self.folder.release()
        else:
            self.folder.disown()


@dataclass(eq=False)
class WorkerPool:
    """The workers of one FMU. A pickled pool has none; it starts its own where it is unpickled.

    learned: what workers have found out about the FMU in its first runs, for all: "restart", how it is brought back to its
    start (see `hvdc_ident.fmu.runner`), "restart at a point", and how a co-simulation is called (see
    `hvdc_ident.fmu.co_simulation`). confirmed: by parameter or input, whether a run confirmed the FMU's own derivatives.
    steps, noise: of differences of runs, by a digest of the experiment. cache: the last runs. memory: bytes of the first
    worker after its last answer. sensitivity_error: largest relative error of a derivative by differences. started: processes
    so far. runs: whole runs of the FMU so far, those for derivatives among them.
    """

    description: Description
    limits: Limits = field(default_factory=Limits)
    learned: dict[str, Any] = field(default_factory=dict)
    confirmed: dict[str, bool] = field(default_factory=dict)
    unpacked: Path | None = None  # the folder of the process it comes from, used again where it is still there

    def __post_init__(self) -> None:
        self._lock = Lock()
        self._processes: _Processes | None = None
        self._broken: SimulationError | None = None  # why no worker can begin
        self._single = False  # no second worker begins
        self._loading_time = self._shareable_time = (
            0.0  # s that a worker takes to begin; of requests that workers can share
        )
        self._busy = 1  # workers of the last request
        self.steps: dict[bytes, DifferenceStep] = {}
        self.noise: dict[bytes, Array] = {}
        self.cache: LastRuns[Any] = LastRuns()
        self.memory = 0
        self.sensitivity_error = 0.0
        self.started = 0
        self.runs = 0

    def __getstate__(self) -> dict[str, Any]:
        at = self._processes.folder.path if self._processes is not None else self.unpacked
        kept = {n: getattr(self, n) for n in ("description", "limits", "learned", "confirmed")}
        return {**kept, "unpacked": at}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.__post_init__()

    @property
    def isolated(self) -> bool:
        """True where each run has a process of its own, as far as is known."""
        return self.learned.get("restart", "process") == "process"

    def ask(self, heading: Mapping[str, Any], arrays: Mapping[str, Array]) -> Message:
        """Return a worker's answer. Raises SimulationError where the run failed or the FMU ended, hung or used up memory.

        An answer {"again": 1} says that a new process may do what this one, which was used before, cannot: the process
        is replaced and asked once more, and only its answer counts.
        """
        return self.ask_all([(dict(heading), dict(arrays))])[0]

    def ask_all(self, requests: Sequence[Message]) -> list[Message]:
        """Return the answers to requests that several workers may share. Raises what `ask` raises, of the first that fails."""
        with self._lock:
            begun, answers = time.monotonic(), list[Message]()
            count = self._workers_for(len(requests))
            for k in range(0, len(requests), count):
                answers += self._together(requests[k : k + count])
            if len(requests) > 1:
                self._shareable_time += time.monotonic() - begun
            self.runs += sum(int(answer.get("whole runs", 0)) for answer, _ in answers)
            return answers

    def close(self) -> None:
        """End the processes; the next run starts others."""
        with self._lock:
            self._close()

    def rest(self) -> None:
        """End the workers; the next run begins one of its own."""
        with self._lock:
            for worker in [*self._own_processes().workers.values()]:
                self._end(worker)

    # --- several requests ---

    def _workers_for(self, requests: int) -> int:
        """Return the number of workers that share requests: they are started once requests took as much time as their start takes.

        The total is then at most twice the least possible. A number that the limits state is started at once. An FMU
        that begins in one process only, as for its licence, stays in one.
        """
        count = min(self.limits.workers or idle_cores(self._busy), requests)
        worthwhile = self.limits.workers or self._shareable_time >= self._loading_time
        if self._single or count < 2 or not worthwhile:
            return 1
        try:
            for number in range(count):
                self._ready(number)
        except SimulationError:
            if 0 not in self._own_processes().workers:
                raise
            self._single, self._broken = True, None
            return 1
        return count

    def _together(self, requests: Sequence[Message]) -> list[Message]:
        """Return the answers of as many workers as requests, all asked at once. Raises the first failure among them."""
        sent = [self._sent(self._ready(number), request) for number, request in enumerate(requests)]
        self._busy = len(sent)
        answers: list[Message] = []
        failures: list[SimulationError] = []
        for number, (worker, request) in enumerate(zip(sent, requests, strict=True)):
            try:
                answers.append(self._answer(number, worker, request))
            except SimulationError as e:  # the others are heard all the same, so that they can be asked again
                failures.append(e)
        if failures:
            raise failures[0]
        return answers

    def _answer(self, number: int, worker: _FmuWorker, request: Message) -> Message:
        """Return the answer of a worker that was asked, or of the one that replaces it."""
        fresh = worker.runs == 1
        answer, out = self._heard(worker, "run")
        if answer.get("again") and not fresh:
            self._end(worker)
            worker = self._sent(self._ready(number), request)
            answer, out = self._heard(worker, "run")
        if "failed" in answer:
            raise self._failure(worker, answer)
        if answer.get("again"):
            raise self._error("the FMU's worker wants a new process, and had one")
        if number == 0:
            self.memory = worker.resident
        self.learned |= answer["learned"]
        return answer, out

    # --- one answer ---

    def _sent(self, worker: _FmuWorker, request: Message) -> _FmuWorker:
        """Send a request to a worker, with what others have found out meanwhile; return the worker."""
        worker.runs += 1
        begin(worker.process.progress)
        heading, arrays = request
        with contextlib.suppress(OSError):  # it is gone: noticed when it is heard
            worker.process.connection.send(({**heading, "learned": self.learned}, arrays))
        return worker

    def _heard(self, worker: _FmuWorker, what: str) -> Message:
        """Return the answer of a worker. Raises SimulationError where it ends or hangs."""
        deadline = self.limits.load if what == "loading" else self.limits.deadline
        watch = Watch(worker.process.progress, deadline)
        while True:
            try:
                if not worker.process.connection.poll(watch.pause()):
                    if watch.over():
                        raise self._hung(worker, what, watch)
                    continue
                heading, arrays = worker.process.connection.recv()
            except (EOFError, OSError):
                return self._lost(worker, f"in the {what}")
            worker.resident = int(heading.get("memory", worker.resident))
            worker.space = int(heading.get("space", worker.space))
            if heading.get("fatal"):
                self._end(worker)
            return heading, arrays

    def _failure(self, worker: _FmuWorker, heading: Mapping[str, Any]) -> SimulationError:
        """Return the failure that a worker reports, with its memory where that was used up."""
        what, t, hint = heading["failed"], heading["t"], heading["hint"]
        budget = worker.budget
        taken = budget.taken(worker.resident, worker.space)
        if budget.exhausted(taken):
            what, hint = f"{what}; {budget.told(taken)}", more_memory(budget)
        return self._error(what, where="" if t is None else f"t = {t:.6g} s", message=heading["message"], hint=hint)

    def _error(self, what: str, *, where: str = "", message: str = "", hint: str = "") -> SimulationError:
        name = self.description.path.name
        got = f"the FMU said: {message}" if message else ""
        return SimulationError(what, where=f"{name}, {where}" if where else name, got=got, hint=hint)

    def _hung(self, worker: _FmuWorker, what: str, watch: Watch) -> SimulationError:
        """End a worker that is past its deadline; return the error."""
        instants, still = watch.instants(), watch.still()
        message = worker.last_line
        end = self._end(worker, trace=True) or Ending(-9)
        limit = "load" if what == "loading" else "deadline"
        text, hint = overdue(end, worker.budget, what, (limit, watch.deadline), instants, still)
        return self._error(text, message=message, hint=hint)

    def _lost(self, worker: _FmuWorker, when: str) -> Message:
        """Return the answer of a worker that has ended. Raises SimulationError where a new one cannot be expected to succeed."""
        message = worker.last_line
        end = self._end(worker)
        if end is None:
            what = (
                f"the process that watches the FMU's worker ended {when}, exit code {worker.process.guard.returncode}"
            )
            raise self._error(what, message=message)
        if worker.runs > 1 and "Instantiate" in call_of(end):
            return {"again": 1}, {}  # some FMUs allow one instance a process, and crash at the second
        text, hint = crash(end, worker.budget, when)
        raise self._error(text, message=message, hint=hint)

    # --- processes ---

    def _ready(self, number: int) -> _FmuWorker:
        """Return a worker that waits for a request."""
        if self._broken is not None:
            raise self._broken
        processes = self._own_processes()
        worker = processes.workers.get(number)
        if worker is not None and (worker.runs >= self.limits.runs or self._leaks(worker)):
            self._end(worker)
            worker = None
        return worker or self._start(number)

    def _leaks(self, worker: _FmuWorker) -> bool:
        """Return whether the worker kept so much memory that the next run may find too little."""
        budget = worker.budget
        return budget.exhausted(budget.taken(worker.resident, worker.space))

    def _own_processes(self) -> _Processes:
        """Return this process's own workers; those of a process that it was forked from are left to that."""
        if self._processes is not None and self._processes.owner != os.getpid():
            self.unpacked = self._processes.folder.path
            self._close()
        if self._processes is None:
            folder = shared_folder(self.unpacked) if self.unpacked is not None else None
            self._processes = _Processes(os.getpid(), folder or unpacked_folder(self.description.path))
            self._finalizer = Finalize(self, self._processes.close, exitpriority=20)
        return self._processes

    def _start(self, number: int) -> _FmuWorker:
        """Start a worker; return it once it has loaded the FMU."""
        from hvdc_ident.fmu.worker import serve

        processes, begun = self._own_processes(), time.monotonic()
        self.memory = 0
        self.started += 1
        worker: _FmuWorker | None = None
        setup = Setup(self.description, processes.folder, self.limits.deadline, self.limits.memory)
        try:
            if processes.spare:
                child = processes.spare.pop()
                child.again(serve, setup, self.learned)
            else:
                folder = processes.folder
                child = Child(serve, setup, self.learned, keeps=[folder.lock], needs=NEEDS, finish=folder.release)
            worker = processes.workers[number] = _FmuWorker(child, self.limits.memory)
            answer, _ = self._heard(worker, "loading")
            if "failed" in answer:
                raise self._failure(worker, answer)
        except OSError as e:
            what = "no process can be started for the FMU"
            self._broken = SimulationError(what, where=self.description.path.name, got=str(e))
            self._close()
            raise self._broken from None
        except SimulationError as e:
            if worker is not None:
                self._end(worker)
            self._broken = e
            raise
        self._loading_time = time.monotonic() - begun
        return worker

    def _end(self, worker: _FmuWorker, *, trace: bool = False) -> Ending | None:
        """End a worker; return how it ended, or None where that is not known. trace: where it is, if it is at work."""
        processes = self._own_processes()
        at = next((n for n, known in processes.workers.items() if known is worker), None)
        if at is None:  # ended before
            return None
        del processes.workers[at]
        ending = worker.process.rest(trace=trace)
        if ending is not None:
            processes.spare.append(worker.process)
        return ending

    def _close(self) -> None:
        if self._processes is not None:
            self._finalizer.cancel()
            self._processes.close()
            self._processes = None


def idle_cores(busy: int) -> int:
    """Return the number of processes that may work at once, one for each idle core and at least 1.

    busy: processes that worked for the caller lately; they count as load. A process that a pool has started is one of several
    that share the cores already.
    """
    if multiprocessing.parent_process() is not None:
        return 1
    try:
        others = max(os.getloadavg()[0] - busy, 0.0)
    except OSError:
        others = 0.0
    return max(1, round(available_cores() - others))


CALL = re.compile(r"\b(fmi[23][A-Z]\w*)\s*\(|\b_(dlopen)\(")
BOUND_NAME = re.compile(r"fmi[23][A-Z]\w*")  # name of a function that `hvdc_ident.fmu.fmi` has bound


def setting(name: str, value: float) -> str:
    """Return how a limit is set: in the study, on the command line and in Python."""
    text = f"{value:.10g}"
    return f'`{name} = {text}` in the study\'s [model], --{name} {text}, or limits={{"{name}": {text}}} in Python'


def call_of(end: Ending) -> str:
    """Return where in the FMU a process was when it ended: "in fmi2DoStep"; empty where that is not known."""
    for file, line, name in end.frames():
        if BOUND_NAME.fullmatch(name):
            return f"in {name}"
        if call := CALL.search(linecache.getline(file, line)):
            return f"in {call[1]}" if call[1] else "in loading its library"
    return ""


def more_memory(budget: Budget) -> str:
    """Return the hint how to give more memory."""
    return f"a larger limit in MiB, if it needs that much: {setting('memory', budget.larger)}"


def crash(end: Ending, budget: Budget, when: str) -> tuple[str, str]:
    """Return the message on a process that ended by itself, and a hint. when: "in the run"."""
    how = f"its process {end}" if end.code < 0 else f"it ended itself with exit code {end.code} and no result"
    call = call_of(end)
    taken = budget.taken(end.resident, end.space)
    what = f"the FMU crashed {when}{f', {call}' if call else ''}: {how}"
    if budget.exhausted(taken):
        return f"{what}; {budget.told(taken)}", more_memory(budget)
    if end.code == -signal.SIGKILL:
        what += f", from outside, as the system does where memory is short; it had used {taken / MIB:.0f} MiB"
    return what, ""


def overdue(
    end: Ending, budget: Budget, what: str, limit: tuple[str, float], instants: Sequence[float], still: float | None
) -> tuple[str, str]:
    """Return the message on a process that was ended at its deadline, and a hint.

    what: the work. limit: the deadline's key and value, s. instants: first, last and present instant of the run, s, nan
    where not known. still: for how long, in s, the instant had not moved; None where it moved to the end.
    """
    name, deadline = limit
    start, stop, now = instants
    reached = not math.isnan(now)
    scale = "" if math.isnan(stop) else f" of {stop:.6g} s"
    taken = budget.taken(end.resident, end.space)
    if still is None and reached and now > start and not math.isnan(stop):
        times = (stop - start) / (now - start)
        enough = deadline * times
        text = (
            f"the FMU is slow: at t = {now:.6g} s{scale} when the deadline of {deadline:g} s for one run came, its process"
            f" was ended; at this pace {times:.2g} times the deadline would do"
        )
        hint = f"a longer deadline: {setting(name, _above(1.2 * enough))}"
    else:
        text = f"the FMU hangs: no result of the {what} after {deadline:g} s, its process was ended"
        position = ", ".join(filter(None, [f"at t = {now:.6g} s{scale}" if reached else "", call_of(end)]))
        if reached and still is not None:
            text += f"; it had stood {position} for {still:.2g} s"
        elif position:
            text += f"; it was {position}"
        hint = f"a longer deadline, if it is only slow: {setting(name, _above(5.0 * deadline))}"
    if budget.exhausted(taken):
        return f"{text}; {budget.told(taken)}", more_memory(budget)
    return text, hint


def _above(seconds: float) -> float:
    """Return the number rounded up to two figures."""
    step = 10.0 ** (math.floor(math.log10(seconds)) - 1)
    return float(f"{math.ceil(seconds / step - 1e-9) * step:.12g}")
