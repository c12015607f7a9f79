"""Where many runs are done: this machine's processes, or workers of a dask cluster; one kind per file."""

from hvdc_ident.study.executors.choice import open_executor
from hvdc_ident.study.executors.ended import Ended
from hvdc_ident.study.executors.local import LocalPool

__all__ = ["Ended", "LocalPool", "open_executor"]
