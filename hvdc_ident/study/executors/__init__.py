"""Executors of many runs: a pool of this machine's processes, or the workers of a dask cluster; one kind a file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from hvdc_ident.errors import InputError
from hvdc_ident.study.executors.local import LocalPool, OpenPool

if TYPE_CHECKING:
    from hvdc_ident.study.executors.dask import DaskPool


__all__ = ["LocalPool", "open_executor"]


LOCAL = "local"


@contextmanager
def open_executor(name: str, workers: int) -> Iterator[OpenPool | DaskPool | None]:
    """The executor, open; None where the work stays in this process.

    name: "" or "local" for this machine, with so many workers; "dask://HOST:PORT" or "dask+tls://HOST:PORT" for the
    workers of a dask scheduler. Raises InputError for another name, or where the scheduler cannot be used.
    """
    if name in ("", LOCAL):
        if workers <= 1:
            yield None
            return
        with LocalPool(workers).open() as pool:
            yield pool
        return
    if not name.startswith(("dask://", "dask+tls://")):
        raise InputError(
            "no such executor: work is done on this machine or by a dask scheduler",
            where="--executor",
            expected="local, dask://HOST:PORT or dask+tls://HOST:PORT",
            got=repr(name),
            hint="--workers 2 for this machine, or --executor dask://127.0.0.1:8786 once `dask scheduler` runs",
        )
    from hvdc_ident.study.executors.dask import DaskPool

    with DaskPool.at(name) as cluster:
        yield cluster
