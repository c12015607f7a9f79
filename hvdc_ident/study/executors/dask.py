"""The workers of a dask cluster, on as many machines as it has.

The same items, the same code, the same results: workers with other sources of this package are refused before any work
is sent. A worker that dies costs the item it was at, as in the local pool; how long an item may take, and how much
memory, is the cluster's own business. What is sent are pickles of this package's objects, which dask's workers run as
code: use a scheduler that only you can reach (a loopback address or an SSH tunnel), or TLS, `dask+tls://`, with the
certificates named in dask's own configuration.
"""

from __future__ import annotations

import hashlib
import itertools
import pickle
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

from hvdc_ident.errors import InputError
from hvdc_ident.executor import Outcome, attempted, in_order

AHEAD = 4  # batches that wait for each thread
MOST = 64  # items of a batch
CONNECT = 20.0  # s


class DaskPool:
    """A connection to a dask scheduler. Use `DaskPool.at(address)` as a context."""

    def __init__(self, client: Any, threads: int) -> None:
        self._client, self._threads = client, threads
        self._sent: tuple[str, Any] = ("", None)  # the last function's digest, and where the cluster has it

    @staticmethod
    @contextmanager
    def at(address: str) -> Iterator[DaskPool]:
        """The pool of the scheduler at dask://HOST:PORT, while the context lasts.

        Raises InputError where the package is missing, nobody answers, or the workers have other code.
        """
        try:
            import distributed
        except ImportError:
            raise InputError(
                "dask is not installed", where="--executor", hint="pip install 'hvdc_ident[distributed]'"
            ) from None
        secure = address.startswith("dask+tls://")
        place = ("tls://" if secure else "tcp://") + address.split("://", 1)[1]
        try:
            client = distributed.Client(place, timeout=CONNECT, set_as_default=False, name="hvdc_ident")
        except (OSError, ValueError, TypeError) as error:
            raise InputError(
                "no dask scheduler answers",
                where=f"--executor {address}",
                got=" ".join(str(error).split())[:200] or type(error).__name__,
                hint="start one with 'dask scheduler' and workers with 'dask worker', or check host, port and TLS",
            ) from None
        with client:
            threads = _checked(client, address)
            yield DaskPool(client, threads)

    def map(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Any]:
        """Return the function's results in the items' order. Raises ComputationError where an item has none."""
        return in_order(self.run(function, items))

    def run(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Outcome]:
        """Yield the outcome of each item, as they come. The function and the items must be picklable."""
        from distributed import as_completed

        content = pickle.dumps(function)
        name = hashlib.sha256(content).hexdigest()
        shared = self._shared(name, content)
        batches = _batches(items)
        size = {}
        running = as_completed(loop=self._client.loop, with_results=False, raise_errors=False)

        def send(batch: list[tuple[int, Any]]) -> None:
            future = self._client.submit(_do, name, shared, batch, pure=False, retries=0)
            size[future.key] = batch
            running.add(future)

        for batch in itertools.islice(batches, AHEAD * self._threads):
            send(batch)
        for future in running:
            batch = size.pop(future.key)
            if future.status == "finished":
                yield from future.result()
            elif len(batch) > 1:  # one of them ended a worker: each goes alone
                for item in batch:
                    send([item])
                continue
            else:
                yield Outcome(batch[0][0], None, _reason(future))
            following = next(batches, None)
            if following is not None:
                send(following)

    def _shared(self, name: str, content: bytes) -> Any:
        """Return the function as the cluster has it. One sent again is not sent: its release would race with the sending."""
        if self._sent[0] != name:
            [future] = self._client.scatter([content], broadcast=True, hash=False)
            self._sent = name, future
        return self._sent[1]


def _batches(items: Iterable[Any]) -> Iterator[list[tuple[int, Any]]]:
    """Batches that grow from one item, so that slow items are spread and quick ones do not go one by one."""
    numbered = iter(enumerate(items))
    size = 1
    while batch := list(itertools.islice(numbered, size)):
        yield batch
        size = min(MOST, size * 2)


def _checked(client: Any, address: str) -> int:
    """The number of threads of all workers. Raises InputError where there are none, or they cannot do this work."""
    client.wait_for_workers(1, timeout=CONNECT)
    from hvdc_ident.study.store import code_version

    expected = code_version()
    try:
        versions = client.run(code_version)
    except Exception as error:  # whatever the workers' environment lacks
        raise InputError(
            "the workers cannot run this package",
            where=f"--executor {address}",
            got=" ".join(f"{type(error).__name__}: {error}".split())[:200],
            hint="install the same version of hvdc_ident on every machine",
        ) from None
    other = sorted(worker for worker, version in versions.items() if version != expected)
    if other:
        raise InputError(
            f"{len(other)} of {len(versions)} workers have another version of this package or of numpy, scipy, sympy, numba",
            where=f"--executor {address}",
            got=other[0],
            hint="the same environment on every machine: results are the same bit for bit or not given",
        )
    threads = client.nthreads()
    if any(n > 1 for n in threads.values()):
        raise InputError(
            "a worker has several threads",
            where=f"--executor {address}",
            expected="one thread a worker, for a simulation keeps its own",
            hint="dask worker ... --nthreads 1 --nworkers N",
        )
    return len(threads)


def _reason(future: Any) -> str:
    error = future.exception() if future.status == "error" else None
    if error is None:
        return f"the cluster gave it up ({future.status})"
    if type(error).__name__ == "KilledWorker":
        return "its worker died"
    return " ".join(f"{type(error).__name__}: {error}".split())[:500]


# --- inside a worker ---


@lru_cache(maxsize=2)
def _loaded(name: str, content: bytes) -> Callable[[Any], Any]:
    return pickle.loads(content)


def _do(name: str, content: bytes, batch: list[tuple[int, Any]]) -> list[Outcome]:
    work = _loaded(name, content)
    return [attempted(work, index, item) for index, item in batch]
