"""Where many runs are done: a pool of local processes that outlives any of them.

A worker that dies or hangs costs the item it was at, which becomes a failure with a reason; everything else is done.
Workers share no lock, thread or compiled state with the parent: they are forked from a server, a process that has loaded
the package and does nothing else, or started afresh where forking is not safe. They end with the parent, even where that
is killed.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import operator
import os
import pickle
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from typing import Any

from hvdc_ident.errors import ComputationError, InputError
from hvdc_ident.study.executors.ended import Ended, in_order

BATCH = 0.05  # s of work sent to a worker at a time
REPORT = 1e-4  # s of finished work a worker may hold back: a kill of the parent loses no more of it
START = 180.0  # s a worker may take to begin
MOST = 1000  # items sent to a worker at a time
DEATHS = 2  # of workers at the same item before it is given up
IDLE = -1
START_METHOD = "forkserver" if sys.platform == "linux" else "spawn"
LOADED = ["hvdc_ident.discrepancy"]
"""Module that the server loads, once for all workers: it imports what nearly any work needs."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(eq=False)
class _Worker:
    """A process with what it was given and has not reported. current: the item it is at, in shared memory."""

    process: Any
    connection: Connection
    current: Any
    since: float
    ready: bool = False
    pending: dict[int, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class LocalPool:
    """A pool of processes.

    workers: how many. timeout: s one item may take; None: no limit. memory: bytes of address space a worker may take;
    None: no limit.
    """

    workers: int = 2
    timeout: float | None = 600.0
    memory: int | None = None

    def __post_init__(self) -> None:
        if self.workers < 1 or (self.timeout is not None and not self.timeout > 0):
            raise InputError(
                "a pool's settings are wrong",
                expected="at least 1 worker and a timeout above 0 s",
                got=f"{self.workers} workers, timeout {self.timeout} s",
            )

    def map(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Any]:
        """The function's results in the items' order. Raises ComputationError where an item has none."""
        return in_order(self.run(function, items))

    def run(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Ended]:
        """What became of each item, as it ends. The function and the items must be picklable.

        Raises ComputationError where workers cannot be started at all.
        """
        with self.open() as pool:
            yield from pool.run(function, items)

    @contextlib.contextmanager
    def open(self) -> Iterator[OpenPool]:
        """The pool with workers that stay from one run to the next, until the context ends.

        What they need is loaded from now on, beside what the caller does.
        """
        _serving()
        pool = OpenPool(self)
        try:
            yield pool
        finally:
            pool.close()


class OpenPool:
    """A pool whose workers wait for the next run, with all they have compiled."""

    def __init__(self, settings: LocalPool) -> None:
        self._settings = settings
        self._idle: list[_Worker] = []

    def map(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Any]:
        """The function's results in the items' order. Raises ComputationError where an item has none."""
        return in_order(self.run(function, items))

    def run(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Ended]:
        """What became of each item, as it ends."""
        share = -(-operator.length_hint(items) // (2 * self._settings.workers))
        session = _Session(self._settings, pickle.dumps(function), iter(enumerate(items)), self._idle, share or MOST)
        try:
            yield from session.ends()
        finally:
            session.close()

    def close(self) -> None:
        """End the workers."""
        while self._idle:
            _end(self._idle.pop())


class _Session:
    """One run of a pool."""

    def __init__(
        self, pool: LocalPool, function: bytes, items: Iterator[tuple[int, Any]], idle: list[_Worker], most: int
    ) -> None:
        self.pool, self.function, self.items, self.idle, self.most = pool, function, items, idle, min(most, MOST)
        self.workers: list[_Worker] = []
        self.again: deque[tuple[int, Any]] = deque()
        self.deaths: dict[int, int] = {}
        self.false_starts = 0
        self.cost = 0.0  # s an item takes, as measured
        self.exhausted = False

    def ends(self) -> Iterator[Ended]:
        while True:
            self._feed()
            if not self.workers:
                return
            handles: list[Any] = [w.connection for w in self.workers]
            readable = set(wait(handles, timeout=0.5 if self.pool.timeout is None else min(0.5, self.pool.timeout)))
            for worker in list(self.workers):
                if worker.connection in readable:
                    yield from self._heard(worker)
            for worker in list(self.workers):
                yield from self._overdue(worker)

    # --- work out ---

    def _feed(self) -> None:
        """Every worker without work gets some; a worker is started where work is left, ended where none is."""
        for worker in [w for w in self.workers if w.ready and not w.pending]:
            batch = self._batch()
            if not batch:
                self._retire(worker)
                continue
            worker.pending, worker.since = dict(batch), time.monotonic()
            with contextlib.suppress(OSError):  # it has just died: noticed when it is heard
                worker.connection.send(batch)
        starting = sum(not w.ready for w in self.workers)
        while len(self.workers) < self.pool.workers and (self.again or not self.exhausted) and starting < self._left():
            self._start()
            starting += 1

    def _left(self) -> int:
        """How many items wait, as far as it matters: at most one for each worker."""
        while not self.exhausted and len(self.again) < self.pool.workers:
            nxt = next(self.items, None)
            if nxt is None:
                self.exhausted = True
            else:
                self.again.append(nxt)
        return len(self.again)

    def _batch(self) -> list[tuple[int, Any]]:
        """The next items: one that has ended a worker goes alone."""
        size = max(1, min(self.most, int(BATCH / self.cost))) if self.cost > 0 else 1
        batch: list[tuple[int, Any]] = []
        while len(batch) < size:
            if self.again:
                if batch and self.deaths.get(self.again[0][0]):
                    break
                item = self.again.popleft()
            else:
                found = next(self.items, None)
                if found is None:
                    self.exhausted = True
                    break
                item = found
            batch.append(item)
            if self.deaths.get(item[0]):
                break
        return batch

    def _start(self) -> None:
        """A worker joins the run: one that waits, or a new one. It is ready when it has loaded the function."""
        worker = self.idle.pop() if self.idle else _started(self.pool.memory)
        worker.ready, worker.since = False, time.monotonic()
        with contextlib.suppress(OSError):  # it has just died: noticed when it is heard
            worker.connection.send_bytes(self.function)
        self.workers.append(worker)

    # --- work in ---

    def _heard(self, worker: _Worker) -> Iterator[Ended]:
        try:
            spent, ends = worker.connection.recv()
        except (EOFError, OSError):
            yield from self._died(worker)
            return
        worker.since = time.monotonic()
        if not worker.ready:
            worker.ready, self.false_starts = True, 0
        if ends:
            cost = spent / len(ends)
            self.cost = cost if not self.cost else 0.7 * self.cost + 0.3 * cost
        for index, value, failure in ends:
            worker.pending.pop(index, None)
            yield Ended(index, value, failure)

    def _died(self, worker: _Worker) -> Iterator[Ended]:
        worker.process.join()
        code = worker.process.exitcode
        if not worker.ready:
            self.false_starts += 1
            self._end(worker)
            if self.false_starts >= 3:
                raise ComputationError(
                    "workers cannot be started",
                    got=f"three ended before they began, the last {_exit(code)}",
                    hint="--workers 1; a script that starts workers needs `if __name__ == '__main__':`",
                )
            return
        yield from self._lost(worker, f"its worker {_exit(code)}", retry=True)

    def _overdue(self, worker: _Worker) -> Iterator[Ended]:
        limit = self.pool.timeout if worker.ready else START
        if limit is None or (worker.ready and not worker.pending) or worker not in self.workers:
            return
        if time.monotonic() - worker.since > limit + REPORT:
            if not worker.ready:
                self.false_starts += 1
            yield from self._lost(worker, f"no result after {limit:g} s", retry=False)

    def _lost(self, worker: _Worker, reason: str, *, retry: bool) -> Iterator[Ended]:
        """The item a worker was at is blamed; what it had not begun, or not reported, is done again."""
        self._end(worker)
        blamed = int(worker.current.value)
        for index, item in reversed(list(worker.pending.items())):
            if index == blamed:
                self.deaths[index] = self.deaths.get(index, 0) + 1
                if not retry or self.deaths[index] >= DEATHS:
                    yield Ended(index, None, reason)
                    continue
            self.again.appendleft((index, item))

    def _retire(self, worker: _Worker) -> None:
        """A worker with nothing left to do waits for the next run."""
        self.workers.remove(worker)
        self.idle.append(worker)

    def _end(self, worker: _Worker) -> None:
        if worker in self.workers:
            self.workers.remove(worker)
        _end(worker)

    def close(self) -> None:
        """Let workers that are at nothing wait for the next run, also where nobody asks for what comes after the last item."""
        for worker in list(self.workers):
            if worker.ready and not worker.pending:
                self._retire(worker)
            else:
                self._end(worker)


def _started(memory: int | None) -> _Worker:
    context: Any = multiprocessing.get_context(START_METHOD)
    current = context.RawValue("q", IDLE)
    here, there = context.Pipe()
    process = context.Process(target=_serve, args=(there, current, memory), daemon=True)
    with _one_thread():
        process.start()
    there.close()
    return _Worker(process, here, current, time.monotonic())


def _serving() -> None:
    """Let the server that workers are forked from begin to load, if it has not, with the environment of now."""
    if START_METHOD != "forkserver":
        return
    from multiprocessing import forkserver

    forkserver.set_forkserver_preload(LOADED)
    with _one_thread():
        forkserver.ensure_running()


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """An environment whose new processes do their linear algebra in one thread each, unless it says otherwise already.

    There is a worker for every core: further threads wait for each other, which took two thirds of the time.
    """
    told = () if any(n in os.environ for n in THREADS) else THREADS
    os.environ.update(dict.fromkeys(told, "1"))
    try:
        yield
    finally:
        for name in told:
            os.environ.pop(name, None)


def _end(worker: _Worker) -> None:
    worker.connection.close()
    if worker.pending or not worker.ready:
        worker.process.kill()
    worker.process.join(5.0)
    if worker.process.exitcode is None:
        worker.process.kill()
        worker.process.join()
    worker.process.close()


def _exit(code: int | None) -> str:
    """How a process ended, in words."""
    if code is not None and code < 0:
        try:
            return f"was ended by {signal.Signals(-code).name}"
        except ValueError:
            return f"was ended by signal {-code}"
    return f"ended with exit code {code}"


# --- inside a worker ---


def _serve(connection: Connection, current: Any, memory: int | None) -> None:
    """Load each function sent and run batches with it until the parent closes the connection or ends."""
    _end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if memory is not None:
        with contextlib.suppress(ImportError, ValueError):
            import resource

            resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    work: Callable[[Any], Any] | None = None
    loaded = b""
    with contextlib.suppress(OSError, EOFError):
        while True:
            message = connection.recv_bytes()
            if message == loaded:  # the same work again, with all it has compiled
                connection.send((0.0, []))
                continue
            content = pickle.loads(message)
            if isinstance(content, list):
                assert work is not None  # the function comes before its items
                _run_batch(connection, work, content, current)
            else:
                work, loaded = content, message
                connection.send((0.0, []))


def _run_batch(connection: Connection, work: Callable[[Any], Any], batch: list[tuple[int, Any]], current: Any) -> None:
    ends: list[tuple[int, Any, str]] = []
    begin = time.perf_counter()
    for place, (index, item) in enumerate(batch):
        current.value = index
        try:
            ends.append((index, work(item), ""))
        except MemoryError:
            ends.append((index, None, "not enough memory"))
        except Exception as e:
            ends.append((index, None, " ".join(f"{type(e).__name__}: {e}".split())[:500]))
        now = time.perf_counter()
        if now - begin > REPORT or place == len(batch) - 1:
            connection.send((now - begin, ends))
            ends, begin = [], now
    current.value = IDLE


def _end_with_parent() -> None:
    """End this process when the pool's ends, however it does. Only the server ends by itself, after the last."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
