"""Progress on stderr, for work of more than a second that somebody watches."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from hvdc_ident.executor import Progress
from hvdc_ident.study.stage import silent

PATIENCE = 1.0  # s


@contextmanager
def progress(quiet: bool) -> Iterator[Progress]:
    """What stages tell their progress to: a bar on stderr once a second has passed, nothing where quiet."""
    if quiet:
        yield silent
        return
    shown = _Bar()
    try:
        yield shown
    finally:
        shown.close()


class _Bar:
    """A bar that appears when it is worth it."""

    def __init__(self) -> None:
        self._since = time.monotonic()
        self._bar: Any = None
        self._task: Any = None

    def __call__(self, done: int, total: int, text: str) -> None:
        if self._bar is None:
            if time.monotonic() - self._since < PATIENCE:
                return
            self._open()
        self._bar.update(self._task, completed=done, total=total, description=text)

    def close(self) -> None:
        """Nothing; the bar is gone."""
        if self._bar is not None:
            self._bar.stop()

    def _open(self) -> None:
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        columns = (
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.description}", markup=False),
        )
        # What is told meanwhile goes above the bar on a terminal; elsewhere stdout stays what it is.
        shared = sys.stdout.isatty()
        console = Console(file=sys.stderr)
        self._bar = Progress(*columns, console=console, transient=True, redirect_stdout=shared)
        self._task = self._bar.add_task("", total=None)
        self._bar.start()
