"""The worker of an FMU as its owner sees it: started when needed, watched, and replaced when it dies, hangs or is old.

This contains crashes, hangs and leaks. It does not contain malice: load only FMUs you trust.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.util import Finalize
from pathlib import Path
from threading import Lock
from typing import IO, Any

import hvdc_ident
from hvdc_ident.errors import SimulationError
from hvdc_ident.fmu.archive import unpack
from hvdc_ident.fmu.description import Description
from hvdc_ident.fmu.messages import packed, unpacked
from hvdc_ident.trajectory import Array


@dataclass(frozen=True)
class Limits:
    """What an FMU may use. deadline: s for one run; load: s to begin; memory: bytes more than a worker has without it;
    runs: after which a worker is replaced by a new one, as it is where it keeps half of its memory."""

    deadline: float = 60.0
    load: float = 60.0
    memory: int | None = 2 * 2**30
    runs: int = 500


@dataclass(eq=False)
class _Worker:
    process: subprocess.Popen[bytes]
    requests: Connection
    answers: Connection
    said: IO[bytes]
    owner: int
    runs: int = 0
    child: int = 0  # the process with the FMU in it, which the worker forked
    resident: int = 0  # bytes it began with


@dataclass(eq=False)
class Host:
    """The worker of one FMU. It travels to other processes without its worker and starts its own there."""

    description: Description
    limits: Limits = field(default_factory=Limits)

    def __post_init__(self) -> None:
        self._lock = Lock()
        self._worker: _Worker | None = None
        self._folder: Path | None = None
        self._useless: SimulationError | None = None
        self.memory = 0
        self.sensitivity_error = 0.0
        self.started = 0

    def __getstate__(self) -> dict[str, Any]:
        return {"description": self.description, "limits": self.limits}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.__post_init__()

    def ask(self, heading: Mapping[str, Any], arrays: Mapping[str, Array]) -> tuple[dict[str, Any], dict[str, Array]]:
        """The worker's answer. Raises SimulationError where the run failed or the FMU ended, hung or ate its worker.

        An answer {"again": 1} says that a new process may do what this one, which was used before, cannot: the process
        is replaced and asked once more, and only its answer counts.
        """
        with self._lock:
            worker = self._ready()
            fresh = worker.runs == 0
            answer, out = self._asked(worker, heading, arrays)
            if answer.get("again") and not fresh:
                self._end(worker)
                worker = self._ready()
                answer, out = self._asked(worker, heading, arrays)
            if "failed" in answer:
                raise self._failure(answer)
            if answer.get("again"):
                raise self._error("the FMU's worker wants a new process, and had one")
            self.memory = int(answer.get("memory", 0))
            return answer, out

    def _asked(
        self, worker: _Worker, heading: Mapping[str, Any], arrays: Mapping[str, Array]
    ) -> tuple[dict[str, Any], dict[str, Array]]:
        worker.runs += 1
        try:
            worker.requests.send_bytes(packed(heading, arrays))
        except OSError:
            raise self._lost(worker, "before the run") from None
        return self._heard(worker, self.limits.deadline, "run")

    # --- one answer ---

    def _heard(self, worker: _Worker, deadline: float, what: str) -> tuple[dict[str, Any], dict[str, Array]]:
        until = time.monotonic() + deadline
        while True:
            try:
                if not worker.answers.poll(max(until - time.monotonic(), 0.0)):
                    self._end(worker)
                    raise self._error(
                        f"the FMU hangs: no result of the {what} after {deadline:g} s, its process was ended",
                        hint="a longer deadline, if it is only slow",
                    )
                message = worker.answers.recv_bytes()
            except (EOFError, OSError):
                raise self._lost(worker, f"in the {what}") from None
            heading, arrays = unpacked(message)
            if "more" in heading:
                worker.resident = int(heading.get("resident", worker.resident))
                worker.child = int(heading.get("child", worker.child))
                until = time.monotonic() + deadline
                continue
            if "ended" in heading:
                raise self._died(worker, f"in the {what}", int(heading["ended"]), int(heading["peak"]))
            if heading.get("fatal"):
                self._end(worker)
            return heading, arrays

    def _failure(self, heading: Mapping[str, Any]) -> SimulationError:
        """The failure that a worker told."""
        t = heading.get("time")
        said = heading.get("said", "")
        return self._error(
            heading["failed"],
            where="" if t is None else f"t = {t:.6g} s",
            got=f"the FMU said: {said}" if said else "",
            hint=heading.get("hint", ""),
        )

    def _error(self, what: str, where: str = "", got: str = "", hint: str = "") -> SimulationError:
        name = self.description.path.name
        return SimulationError(what, where=f"{name}, {where}" if where else name, got=got, hint=hint)

    def _died(self, worker: _Worker, when: str, code: int, peak: int) -> SimulationError:
        """How the FMU ended its process, in words. peak: the most bytes it had."""
        how = _signal(-code) if code < 0 else f"it ended itself with exit code {code} and no result"
        limit = self.limits.memory
        if limit is not None and peak > worker.resident + 0.7 * limit:
            how += f"; it had used all of its {limit / 2**20:.0f} MiB of memory"
        said = self._said(worker)
        self._end(worker)
        return self._error(f"the FMU crashed {when}: {how}", got=f"the FMU said: {said}" if said else "")

    def _lost(self, worker: _Worker, when: str) -> SimulationError:
        """The worker itself is gone: it was killed from outside, or could not begin."""
        said = self._said(worker)
        self._end(worker)
        code = worker.process.returncode
        return self._error(f"the FMU's worker ended {when}, exit code {code}", got=f"it said: {said}" if said else "")

    def _said(self, worker: _Worker) -> str:
        """The last line the process wrote."""
        worker.said.seek(0, os.SEEK_END)
        worker.said.seek(max(0, worker.said.tell() - 2000))
        lines = worker.said.read().decode("utf-8", "replace").strip().splitlines()
        return " ".join(lines[-1].split())[:300] if lines else ""

    # --- the process ---

    def _ready(self) -> _Worker:
        worker = self._worker
        if worker is not None and worker.owner != os.getpid():  # this process was forked: the worker is another's
            self._worker = worker = self._folder = None
        if worker is not None and (worker.runs >= self.limits.runs or self._leaks(worker)):
            self._end(worker)
            worker = None
        if worker is None:
            if self._useless is not None:
                raise self._useless
            worker = self._start()
        return worker

    def _leaks(self, worker: _Worker) -> bool:
        """Whether the worker kept so much memory that the next run may find too little."""
        return self.limits.memory is not None and self.memory > worker.resident + 0.5 * self.limits.memory

    def _start(self) -> _Worker:
        folder = self._unpacked()
        inward, requests = os.pipe()
        answers, outward = os.pipe()
        said = tempfile.TemporaryFile()  # noqa: SIM115 - it lives as long as the worker
        root = str(Path(hvdc_ident.__file__).resolve().parents[1])
        path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
        one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "hvdc_ident.fmu.worker", str(inward), str(outward)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=said,
            pass_fds=(inward, outward),
            env={**os.environ, **one, "PYTHONPATH": path},
        )
        os.close(inward)
        os.close(outward)
        worker = _Worker(
            process, Connection(requests, readable=False), Connection(answers, writable=False), said, os.getpid()
        )
        self._worker, self.memory = worker, 0
        self._finalizer = Finalize(self, _close, (worker,), exitpriority=20)
        self.started += 1
        try:
            heading = {"parent": os.getpid(), "memory": self.limits.memory, "folder": str(folder)}
            worker.requests.send_bytes(packed(heading))
            worker.requests.send_bytes(pickle.dumps(self.description))
            answer, _ = self._heard(worker, self.limits.load, "loading")
            if "failed" in answer:
                raise self._failure(answer)
        except OSError:
            self._useless = self._lost(worker, "in the loading")
            raise self._useless from None
        except SimulationError as e:
            self._end(worker)
            self._useless = e
            raise
        return worker

    def _unpacked(self) -> Path:
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix="hvdc_ident_fmu_"))
            Finalize(self, shutil.rmtree, (self._folder, True), exitpriority=10)
            unpack(self.description.path, self._folder)
        return self._folder

    def _end(self, worker: _Worker) -> None:
        if self._worker is worker:
            self._worker = None
            self._finalizer.cancel()
        _close(worker)

    def close(self) -> None:
        """Nothing; the worker is gone. The next run starts another."""
        with self._lock:
            if self._worker is not None:
                self._end(self._worker)


def _close(worker: _Worker) -> None:
    """Nothing; the worker's process is gone."""
    for end in (worker.requests, worker.answers, worker.said):
        with contextlib.suppress(OSError):
            end.close()
    if worker.owner == os.getpid() and worker.process.poll() is None:
        if worker.child:
            with contextlib.suppress(OSError):
                os.kill(worker.child, signal.SIGKILL)
        worker.process.kill()
        worker.process.wait()


def _signal(number: int) -> str:
    try:
        return f"its process was ended by {signal.Signals(number).name}"
    except ValueError:
        return f"its process was ended by signal {number}"
