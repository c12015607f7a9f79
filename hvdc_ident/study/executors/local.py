"""Pool of processes on this machine that outlives any of them.

A worker that dies or hangs costs the item it was at, which becomes a failure with a reason; everything else is done.
Workers are forked by the supervisor of `hvdc_ident.processes`, one for all pools of this process, which has loaded the
package. They share no lock, thread or compiled state with this process, and end with it, even where it is killed.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib
import operator
import pickle
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from multiprocessing import spawn
from multiprocessing.connection import Connection, wait
from typing import Any

from hvdc_ident.errors import ComputationError, InputError
from hvdc_ident.executor import Outcome, attempted, in_order
from hvdc_ident.processes import ChildProcess, Supervisor
from hvdc_ident.processes.messages import BEGAN, ITEM
from hvdc_ident.processes.server import is_worker

BATCH = 0.05  # s of work sent to a worker at a time
REPORT = 1e-4  # s of finished work a worker may hold back: a kill of the parent loses no more of it
START = 180.0  # s a worker may take to begin
LOOK = 0.5  # s at most between looks at the time limit
MOST = 1000  # items sent to a worker at a time
DEATHS = 2  # of workers at the same item before it is given up
FALSE_STARTS = 3  # workers in a row that end before they begin, from which on none is expected to
IDLE = -1
LOADED = "hvdc_ident.discrepancy"
"""Module that is loaded once for all workers: it imports what nearly any work needs."""
ORIGIN = ("sys_path", "sys_argv", "dir", "init_main_from_name", "init_main_from_path")
"""Entries of `spawn.get_preparation_data` that let a worker import what this process can."""

_shared: Supervisor | None = None


@dataclass(frozen=True)
class LocalPool:
    """A pool of processes. workers: how many. timeout: s one item may take; None: no limit."""

    workers: int = 2
    timeout: float | None = 600.0

    def __post_init__(self) -> None:
        if self.workers < 1 or (self.timeout is not None and not self.timeout > 0):
            raise InputError(
                "a pool's settings are wrong",
                expected="at least 1 worker and a timeout above 0 s",
                got=f"{self.workers} workers, timeout {self.timeout} s",
            )

    def map(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Any]:
        """Return the function's results in the items' order. Raises ComputationError where an item has none."""
        return in_order(self.run(function, items))

    def run(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Outcome]:
        """Yield the outcome of each item, as they come. The function and the items must be picklable.

        Raises ComputationError where workers cannot be started at all.
        """
        with self.open() as pool:
            yield from pool.run(function, items)

    @contextlib.contextmanager
    def open(self) -> Iterator[OpenPool]:
        """Yield the pool with workers that stay from one run to the next, until the context ends.

        What they need is loaded from now on, beside what the caller does. Raises InputError where the system has no
        such workers.
        """
        _supervisor()
        pool = OpenPool(self)
        try:
            yield pool
        finally:
            pool.close()


@dataclass(eq=False)
class _PoolWorker:
    """A worker with the items that it was given and has not reported. ready: whether it has loaded the function."""

    supervisor: Supervisor
    child: ChildProcess
    ready: bool = False
    pending: dict[int, Any] = field(default_factory=dict)

    def send(self, message: bytes) -> None:
        """Send a pickle and count its time from now on; that the worker has just died is noticed when it is heard."""
        self.child.begin()
        with contextlib.suppress(OSError):
            self.child.connection.send_bytes(message)

    def end(self) -> str:
        """End it, and return how it ended, in words."""
        return str(self.supervisor.end(self.child, trace=False) or "is gone, and so is what watched it")


class OpenPool:
    """A pool whose workers wait for the next run, with all they have compiled."""

    def __init__(self, settings: LocalPool) -> None:
        self._settings = settings
        self._idle: list[_PoolWorker] = []

    def map(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Any]:
        """Return the function's results in the items' order. Raises ComputationError where an item has none."""
        return in_order(self.run(function, items))

    def run(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Outcome]:
        """Yield the outcome of each item, as they come."""
        share = -(-operator.length_hint(items) // (2 * self._settings.workers)) or MOST
        session = _Session(self._settings, pickle.dumps(function), iter(enumerate(items)), self._idle, min(share, MOST))
        try:
            yield from session.outcomes()
        finally:
            session.close()

    def close(self) -> None:
        """End the workers."""
        while self._idle:
            self._idle.pop().end()


class _Session:
    """One run of a pool. idle: the pool's workers without work. most: items sent to a worker at a time."""

    def __init__(
        self, pool: LocalPool, function: bytes, items: Iterator[tuple[int, Any]], idle: list[_PoolWorker], most: int
    ) -> None:
        self.pool, self.function, self.items, self.idle, self.most = pool, function, items, idle, most
        self.workers: list[_PoolWorker] = []
        self.queue: deque[tuple[int, Any]] = deque()
        self.deaths: dict[int, int] = {}
        self.false_starts = 0
        self.cost = 0.0  # s an item takes, as measured

    def outcomes(self) -> Iterator[Outcome]:
        """Yield the outcome of each item, as they come."""
        pause = LOOK if self.pool.timeout is None else min(LOOK, self.pool.timeout)
        while True:
            self._feed()
            if not self.workers:
                return
            readable = set(wait([w.child.connection for w in self.workers], pause))
            for worker in [w for w in self.workers if w.child.connection in readable]:
                yield from self._heard(worker)
            for worker in list(self.workers):
                yield from self._overdue(worker)

    def close(self) -> None:
        """Let workers that are at nothing wait for the next run, also where nobody asks for what comes after the last item."""
        for worker in self.workers:
            if worker.ready and not worker.pending:
                self.idle.append(worker)
            else:
                worker.end()
        self.workers.clear()

    def _feed(self) -> None:
        """Give work to every worker without any; let it wait where none is left; start workers for what waits."""
        for worker in [w for w in self.workers if w.ready and not w.pending]:
            batch = self._batch()
            if batch:
                worker.pending = dict(batch)
                worker.send(pickle.dumps(batch))
            else:
                self.workers.remove(worker)
                self.idle.append(worker)
        starting = sum(not w.ready for w in self.workers)
        for _ in range(min(self._waiting(self.pool.workers) - starting, self.pool.workers - len(self.workers))):
            worker = self.idle.pop() if self.idle else _started()
            worker.ready = False
            worker.send(self.function)
            self.workers.append(worker)

    def _waiting(self, most: int) -> int:
        """Return how many items wait, as far as it matters: so many at most."""
        while len(self.queue) < most and (item := next(self.items, None)) is not None:
            self.queue.append(item)
        return min(len(self.queue), most)

    def _batch(self) -> list[tuple[int, Any]]:
        """Return the next items, `BATCH` s of work; one that has ended a worker goes alone."""
        size = max(1, min(self.most, int(BATCH / self.cost))) if self.cost > 0 else 1
        batch: list[tuple[int, Any]] = []
        while len(batch) < size and self._waiting(1):
            alone = self.queue[0][0] in self.deaths
            if batch and alone:
                break
            batch.append(self.queue.popleft())
            if alone:
                break
        return batch

    def _heard(self, worker: _PoolWorker) -> Iterator[Outcome]:
        """Yield what a worker reports; where it has ended, the outcome of the item it was at."""
        try:
            spent, outcomes = worker.child.connection.recv()
        except (EOFError, OSError):
            yield from self._lost(worker, f"its worker {self._ended(worker)}", retry=True)
            return
        if not worker.ready:
            worker.ready, self.false_starts = True, 0
        if outcomes:
            cost = spent / len(outcomes)
            self.cost = cost if not self.cost else 0.7 * self.cost + 0.3 * cost
        for outcome in outcomes:
            worker.pending.pop(outcome.index, None)
        yield from outcomes

    def _overdue(self, worker: _PoolWorker) -> Iterator[Outcome]:
        """Yield the outcome of an item that takes too long, once its worker is ended."""
        limit = self.pool.timeout if worker.ready else START
        at_work = worker.pending or not worker.ready
        if limit is not None and at_work and worker.child.elapsed > limit + REPORT:
            self._ended(worker)
            yield from self._lost(worker, f"no result after {limit:g} s", retry=False)

    def _ended(self, worker: _PoolWorker) -> str:
        """End a worker, and return how it ended. Raises ComputationError where one after the other does not begin."""
        self.workers.remove(worker)
        words = worker.end()
        self.false_starts += not worker.ready
        if self.false_starts >= FALSE_STARTS:
            raise _cannot_start(f"{FALSE_STARTS} ended before they began, the last {words}")
        return words

    def _lost(self, worker: _PoolWorker, reason: str, *, retry: bool) -> Iterator[Outcome]:
        """Yield the failure of the item that an ended worker was at; what it had not begun, or not reported, is done again."""
        blamed = worker.child.item
        for index, item in reversed(list(worker.pending.items())):
            if index == blamed:
                self.deaths[index] = self.deaths.get(index, 0) + 1
                if not retry or self.deaths[index] >= DEATHS:
                    yield Outcome(index, None, reason)
                    continue
            self.queue.appendleft((index, item))


def can_start() -> bool:
    """Return whether this process can start workers."""
    return sys.platform == "linux" and not is_worker()


def _supervisor() -> Supervisor:
    """Return what starts this process's workers, with the environment of its first pool. Raises InputError, ComputationError."""
    global _shared
    if is_worker():
        raise _cannot_start("a worker starts none")
    if sys.platform != "linux":
        raise InputError(
            "this system has no workers",
            where="--workers",
            expected="Linux",
            got=sys.platform,
            hint="--workers 1, or --executor dask://HOST:PORT",
        )
    if _shared is None or _shared.gone:
        if _shared is not None:
            atexit.unregister(_shared.close)
            _shared.close()
        _shared = Supervisor(__name__, prints=True)
        atexit.register(_shared.close)
    return _shared


def _started() -> _PoolWorker:
    """Return a new worker. Raises ComputationError."""
    supervisor = _supervisor()
    origin = spawn.get_preparation_data("worker")
    try:
        return _PoolWorker(supervisor, supervisor.start({n: origin[n] for n in ORIGIN if n in origin}))
    except OSError as error:
        raise _cannot_start(f"what starts them is gone: {error}") from None


def _cannot_start(reason: str) -> ComputationError:
    return ComputationError(
        "workers cannot be started",
        got=reason,
        hint="--workers 1; a script that starts workers needs `if __name__ == '__main__':`",
    )


# --- in the workers' process, see `hvdc_ident.processes.server` ---


def prepare(setup: None) -> None:
    """Load what nearly any work needs."""
    importlib.import_module(LOADED)


def finish(setup: None) -> None:
    """Leave all as it is."""


def serve(connection: Connection, progress: memoryview[float], setup: None, origin: dict[str, Any]) -> None:
    """Load each function sent and run batches with it until the pool closes the connection or ends."""
    spawn.prepare(origin)
    progress[ITEM] = IDLE
    work: Callable[[Any], Any] | None = None
    loaded = b""
    while True:
        message = connection.recv_bytes()
        content = None if message == loaded else pickle.loads(message)  # the same work again, with all it has compiled
        if isinstance(content, list):
            assert work is not None  # the function comes before its items
            _run_batch(connection, work, content, progress)
            continue
        if content is not None:
            work, loaded = content, message
        connection.send((0.0, []))


def _run_batch(
    connection: Connection, work: Callable[[Any], Any], batch: list[tuple[int, Any]], progress: memoryview[float]
) -> None:
    """Run the items and report their outcomes, several that are quick at a time."""
    outcomes: list[Outcome] = []
    begin = time.perf_counter()
    for place, (index, item) in enumerate(batch, 1):
        progress[ITEM], progress[BEGAN] = index, time.monotonic()
        outcomes.append(attempted(work, index, item))
        now = time.perf_counter()
        if now - begin > REPORT or place == len(batch):
            connection.send((now - begin, outcomes))
            outcomes, begin = [], now
    progress[ITEM] = IDLE
    sys.stdout.flush()
