"""What a stage works with: an executor that keeps what is finished in the folder of results."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

from hvdc_ident.files import json_text
from hvdc_ident.study.executors import open_executor
from hvdc_ident.study.executors.kept import KeptExecutor
from hvdc_ident.study.store import Store

if TYPE_CHECKING:
    from hvdc_ident.study.executors.dask import DaskPool
    from hvdc_ident.study.executors.local import OpenPool
    from hvdc_ident.study.stage import Options
    from hvdc_ident.study.study import Study


@contextmanager
def workers_of(options: Options) -> Iterator[OpenPool | DaskPool | None]:
    """The pool the options ask for; None where the work stays in this process."""
    with open_executor(options.executor, options.workers) as pool:
        yield pool


@contextmanager
def executor_of(study: Study, options: Options, name: str) -> Iterator[KeptExecutor | OpenPool | DaskPool | None]:
    """An executor for a stage's work of that name, whose finished pieces are kept where the options name a folder.

    The name tells apart the kinds of work of a study; the study's files, the seed and what is forced tell apart its
    states.
    """
    with ExitStack() as stack:
        pool = stack.enter_context(workers_of(options))
        if options.folder is None:
            yield pool
            return
        store = stack.enter_context(Store(options.folder))
        decided = json_text({"sources": dict(study.sources), "seed": options.seed, "force": list(options.force)})
        yield KeptExecutor(store.job(name, decided), pool)
