"""The workers of a dask cluster, on as many machines as it has, through the executor that dask's own client gives.

The same items, the same code, the same results: workers with other sources of this package are refused before any work
is sent. A worker that dies costs the item it was at, as in a pool here; how long an item may take, and how much memory, is
the cluster's own business. What is sent are pickles of this package's objects, which dask's workers run as code: use a
scheduler that only you can reach (a loopback address or an SSH tunnel), or TLS, `dask+tls://`, with the certificates named
in dask's own configuration.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Future
from contextlib import contextmanager
from typing import Any

from hvdc_ident.errors import InputError, one_line
from hvdc_ident.executor import Outcome, in_order
from hvdc_ident.parallel.pool import outcomes_of

CONNECT = 20.0  # s


class DaskExecutor:
    """The work of a dask cluster. executor: a `distributed.cfexecutor.ClientExecutor`. count: threads of all workers."""

    def __init__(self, executor: Any, count: int) -> None:
        self._executor, self.count = executor, count

    def map(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Any]:
        """Return the function's results in the items' order. Raises ComputationError where an item has none."""
        return in_order(self.run(function, items))

    def run(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Outcome]:
        """Yield the outcome of each item, as they come. The function and the items must be picklable."""
        return outcomes_of(self, function, items)

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Future[Any]:
        """Return the future of the function's value in a worker."""
        future: Future[Any] = self._executor.submit(function, *arguments)
        return future

    def why(self, error: BaseException) -> tuple[str, bool]:
        """Return why a future has no value, and whether that is the worker's end."""
        if type(error).__name__ == "KilledWorker":
            return "its worker died", True
        return ("the cluster gave it up", True) if isinstance(error, CancelledError) else (one_line(error), False)

    def end_lost(self) -> None:
        """Do nothing: the scheduler hears of workers that end."""


@contextmanager
def dask_executor(address: str) -> Iterator[DaskExecutor]:
    """Yield the executor of the scheduler at dask://HOST:PORT, or dask+tls://HOST:PORT, while the context lasts.

    Raises InputError where the package is missing, nobody answers, or the workers have other code.
    """
    try:
        import distributed
    except ImportError:
        raise InputError(
            "dask is not installed", where="executor", hint="pip install 'hvdc_ident[distributed]'"
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
        executor = client.get_executor(pure=False, retries=0)
        try:
            yield DaskExecutor(executor, threads)
        finally:
            executor.shutdown(wait=False)


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
            got=one_line(error, 200),
            hint="install the same version of hvdc_ident on every machine",
        ) from None
    other = sorted(worker for worker, version in versions.items() if version != expected)
    if other:
        raise InputError(
            f"{len(other)} of {len(versions)} workers have another version of this package or of numpy, scipy, sympy",
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
