"""Pool of processes on this machine that outlives any of them, on the library pebble.

A worker that dies or hangs costs the item it was at, which becomes a failure with a reason; everything else is done.
Workers are forked from multiprocessing's server, one for all pools of this process, which has loaded the package and has one
thread. They share no lock, thread or compiled state with this process, and end with it, even where it is killed.
"""

from __future__ import annotations

import contextlib
import hashlib
import multiprocessing
import operator
import os
import pickle
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import islice
from typing import Any, Protocol

from hvdc_ident.errors import ComputationError, InputError, one_line
from hvdc_ident.executor import Outcome, attempted, in_order
from hvdc_ident.next_step import IN_THIS_PROCESS, ON_DASK
from hvdc_ident.parallel import one_thread
from hvdc_ident.parallel.child import Ending

BATCH = 0.02  # s of work that is sent and reported at a time: a kill of the parent loses no more of each worker's
AHEAD = 2  # batches of quick items that each worker has, so that it works while the last one's outcomes are stored
BATCH_ITEMS = 1000  # items of a batch
LOOK = 1.0  # s between two looks at workers that report nothing
DEATHS = 2  # of workers at the same item before it is given up

Batch = list[tuple[int, Any]]
"""Items with their numbers."""


class Workers(Protocol):
    """What does batches: a pool of so many workers, `count`, here or on a cluster."""

    count: int

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Future[Any]:
        """Return the future of the function's value in a worker."""

    def why(self, error: BaseException) -> tuple[str, bool]:
        """Return why a future has no value, and whether that is the worker's end: another one may have it."""

    def end_lost(self) -> None:
        """End the futures of workers that have ended without a word."""


def outcomes_of(workers: Workers, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Outcome]:
    """Yield the outcome of each item, as they come. The function and the items must be picklable.

    A worker is sent the function once. Raises ComputationError where none can begin.
    """
    content = pickle.dumps(function)
    name = hashlib.sha256(content).hexdigest()
    share = min(-(-operator.length_hint(items) // (2 * workers.count)) or BATCH_ITEMS, BATCH_ITEMS)
    numbered, waiting = iter(enumerate(items)), deque[Batch]()  # what goes again, before what is new
    running: dict[Future[Any], Batch] = {}
    unknown: set[int] = set()  # first items of the batches whose worker asked for the function
    deaths: dict[int, int] = {}
    cost, begun = 0.0, False  # s an item takes; whether a worker has loaded the function
    try:
        while True:
            while len(running) < workers.count * (AHEAD if 0.0 < cost < BATCH else 1):
                size = max(1, min(share, int(BATCH / cost))) if cost > 0.0 else 1
                batch = waiting.popleft() if waiting else list(islice(numbered, size))
                if not batch:
                    break
                sent = content if batch[0][0] in unknown else None
                running[workers.submit(work_on, name, sent, batch)] = batch
            if not running:
                return
            for future in _first_done(workers, running):
                batch = running.pop(future)
                error = CancelledError() if future.cancelled() else future.exception()
                if error is None and future.result() is None:
                    unknown.add(batch[0][0])
                    waiting.append(batch)
                elif error is None:
                    spent, outcomes = future.result()
                    begun, cost = True, spent / len(outcomes)
                    waiting.extend(filter(None, [batch[len(outcomes) :]]))
                    yield from outcomes
                elif len(batch) > 1:  # one of them ended or held up the worker: each goes alone
                    waiting.extend([pair] for pair in batch)
                else:
                    (index, _), (reason, ended) = batch[0], workers.why(error)
                    deaths[index] = deaths.get(index, 0) + 1
                    if ended and not begun:
                        begun = _loads(workers, name, content)
                    if ended and deaths[index] < DEATHS:
                        waiting.append(batch)
                    else:
                        yield Outcome(index, None, reason)
    finally:
        for future in running:
            future.cancel()


def _first_done(workers: Workers, running: Iterable[Future[Any]]) -> set[Future[Any]]:
    """Return those futures that are done, once any is."""
    futures = tuple(running)
    while not (done := wait(futures, LOOK, FIRST_COMPLETED).done):
        workers.end_lost()
    return done


def _loads(workers: Workers, name: str, content: bytes) -> bool:
    """Return True where a worker can load the function. Raises ComputationError."""
    (future,) = _first_done(workers, [workers.submit(work_on, name, content, [])])
    error = future.exception()
    if error is not None:
        raise _cannot_begin(workers.why(error)[0])
    return True


def _cannot_begin(reason: str) -> ComputationError:
    return ComputationError(
        "workers cannot be started",
        got=reason,
        hint="a script that starts workers needs `if __name__ == '__main__':`",
        next=(IN_THIS_PROCESS,),
    )


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
        pool = OpenPool(self, _server())
        try:
            yield pool
        finally:
            pool.close()


class OpenPool:
    """A pool whose workers wait for the next run, with all they have compiled. context: starts them."""

    def __init__(self, settings: LocalPool, context: Any) -> None:
        self.count, self._timeout = settings.workers, settings.timeout
        self._workers = [_Worker(context) for _ in range(self.count)]

    def map(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Any]:
        """Return the function's results in the items' order. Raises ComputationError where an item has none."""
        return in_order(self.run(function, items))

    def run(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Outcome]:
        """Yield the outcome of each item, as they come."""
        return outcomes_of(self, function, items)

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Future[Any]:
        """Return the future of the function's value in a worker, which a time limit or the worker's end may prevent.

        Raises ComputationError where no process can be started.
        """
        worker = min(self._workers, key=_Worker.load)  # the first of those: it has compiled most
        try:
            return worker.submit(function, self._timeout, arguments)
        except (OSError, RuntimeError) as error:  # pebble's own are RuntimeErrors
            raise _cannot_begin(str(error.__cause__ or error)) from None

    def why(self, error: BaseException) -> tuple[str, bool]:
        """Return why a future has no value, and whether that is the worker's end."""
        import pebble

        if isinstance(error, pebble.ProcessExpired):
            return f"its worker {Ending(error.exitcode)}", True
        if isinstance(error, BrokenProcessPool):
            return "its worker ended", True
        return f"no result after {self._timeout:g} s" if isinstance(error, TimeoutError) else one_line(error), False

    def end_lost(self) -> None:
        """End the futures of workers that have ended without a word."""
        for worker in self._workers:
            worker.end_lost()

    def close(self) -> None:
        """End the workers."""
        for worker in self._workers:
            worker.stop()
        for worker in self._workers:
            worker.join()


class _Worker:
    """A process that is started when it is first needed, and anew when it has ended.

    It is a pebble pool of its own: in one of several processes (5.2) the task of a process that ends just after it took it may
    never be reported, while others are at work; alone, its end breaks the pool, which is. What is given to a pool that is about to
    break may still be lost.
    """

    def __init__(self, context: Any) -> None:
        self._context = context
        self._pool: Any = None
        self._given: list[Future[Any]] = []
        self._silent = False  # at the last look it had ended, and owed an answer

    def load(self) -> int:
        """Return how many futures it has not done."""
        self._given = [future for future in self._given if not future.done()]
        return len(self._given)

    def submit(self, function: Callable[..., Any], timeout: float | None, arguments: Sequence[Any]) -> Future[Any]:
        """Return the future of the function's value. timeout: s that it may take once it has begun."""
        import pebble

        if self._pool is None or not self._pool.active:
            self.stop()
            self.join()
            self._end_given()
            self._pool = pebble.ProcessPool(1, initializer=_end_with_parent, context=self._context)
        self._given.append(self._pool.submit(function, timeout, *arguments))
        return self._given[-1]

    def end_lost(self) -> None:
        """End the futures that the pool has not ended itself since the last look, where it has broken."""
        silent = self._pool is not None and not self._pool.active and self.load() > 0
        if silent and self._silent:
            self._end_given()
        self._silent = silent

    def _end_given(self) -> None:
        for future in self._given:
            if not future.done():
                future.set_exception(BrokenProcessPool("its worker ended"))

    def stop(self) -> None:
        """Let it end."""
        if self._pool is not None:
            self._pool.stop()

    def join(self) -> None:
        """Return once it has ended."""
        if self._pool is not None:
            self._pool.join()
            self._pool = None


def can_start() -> bool:
    """Return whether this process can start workers."""
    return sys.platform == "linux" and multiprocessing.parent_process() is None


def _server() -> Any:
    """Return the context of workers forked from a server, which begins to load what they need. Raises InputError.

    Its environment is that of this process now: linear algebra in one thread, and no module of the present folder is
    taken for one of Python's.
    """
    if multiprocessing.parent_process() is not None:
        raise _cannot_begin("a worker starts none")
    if sys.platform != "linux":
        raise InputError(
            "this system has no workers",
            where="workers",
            expected="Linux",
            got=sys.platform,
            next=(IN_THIS_PROCESS, ON_DASK),
        )
    from multiprocessing import forkserver

    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["hvdc_ident.parallel.preload"])
    with _environment({**one_thread(), "PYTHONSAFEPATH": "1"}):
        forkserver.ensure_running()
    return context


@contextlib.contextmanager
def _environment(added: Mapping[str, str]) -> Iterator[None]:
    """Let processes that begin inside have these variables as well."""
    before = {name: os.environ.get(name) for name in added}
    os.environ.update(added)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def _forget_server() -> None:
    """Let a process that was forked from this one start a server of its own: multiprocessing takes it for the parent of this one's."""
    from multiprocessing import forkserver

    forkserver._forkserver.__init__()  # type: ignore[misc]


os.register_at_fork(after_in_child=_forget_server)


# --- in a worker ---

KEPT = 2  # functions that a worker keeps, with all they have compiled
_functions: dict[str, Callable[[Any], Any]] = {}


def work_on(name: str, content: bytes | None, batch: Batch) -> tuple[float, list[Outcome]] | None:
    """Return the time in s and the outcomes of a batch's first items, as many as `BATCH` s suffice for, at least one.

    None where the function is not known by its name and its pickle is not given.
    """
    if name not in _functions:
        if content is None:
            return None
        loaded = pickle.loads(content)
        while len(_functions) >= KEPT:
            del _functions[next(iter(_functions))]
        _functions[name] = loaded
    begin, outcomes = time.perf_counter(), []
    for index, item in batch:
        outcomes.append(attempted(_functions[name], index, item))
        if time.perf_counter() - begin > BATCH:
            break
    sys.stdout.flush()
    return time.perf_counter() - begin, outcomes


def _end_with_parent() -> None:
    """Let this process end when its parent does, also while it is at work."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait_for_it() -> None:
        parent.join()
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=wait_for_it, daemon=True).start()
