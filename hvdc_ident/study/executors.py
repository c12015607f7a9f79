"""The executor of a study's work by its name: processes of this machine, or the workers of a dask cluster."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING

from hvdc_ident.errors import InputError
from hvdc_ident.next_step import ON_DASK, NextStep
from hvdc_ident.parallel import LocalPool, OpenPool, PatientPool, available_cores, can_start
from hvdc_ident.parallel.patient import beginning

if TYPE_CHECKING:
    from hvdc_ident.study.dask_executor import DaskExecutor

__all__ = ["LocalPool", "check_executor", "open_executor"]

LOCAL = "local"
DASK = ("dask://", "dask+tls://")


def check_executor(name: str) -> None:
    """Raise InputError for a name of no executor; whether a scheduler answers at its address shows when it is opened."""
    if name not in ("", LOCAL) and not any(name.startswith(kind) and name != kind for kind in DASK):
        raise InputError(
            "no such executor: work is done on this machine or by a dask scheduler",
            where="executor",
            expected=f"{LOCAL}, {' or '.join(f'{kind}HOST:PORT' for kind in DASK)}",
            got=repr(name),
            next=(NextStep("option", "workers = 2", "does the work on this machine"), ON_DASK),
        )


@contextmanager
def open_executor(name: str, workers: int | None) -> Iterator[OpenPool | PatientPool | DaskExecutor | None]:
    """Yield the executor, open; None where the work stays in this process.

    name: "" or "local" for this machine, with so many workers; "dask://HOST:PORT" or "dask+tls://HOST:PORT" for the
    workers of a dask scheduler. workers: None for one on each core available to this process, once the work has proved long
    enough, and for as long as it takes. Raises InputError for another name, or where the scheduler cannot be used.
    """
    check_executor(name)
    if name in ("", LOCAL):
        if workers is None and can_start() and available_cores() > 1:
            with closing(PatientPool(LocalPool(available_cores(), timeout=None), beginning())) as patient:
                yield patient
            return
        if workers is None or workers <= 1:
            yield None
            return
        with LocalPool(workers).open() as pool:
            yield pool
        return
    from hvdc_ident.study.dask_executor import dask_executor

    with dask_executor(name) as cluster:
        yield cluster
