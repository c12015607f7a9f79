"""Work in a thread of which only the newest request is answered: what follows faster than answers is skipped."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

from nicegui import background_tasks, context, run

REST = 0.25
"""Seconds without a request, after which what takes longer than a frame begins."""


class Latest:
    """Answers requests one after the other.

    work: makes the answer, in a thread. show: takes it, on the page. rested: called once nothing has been asked for `REST`.
    """

    def __init__(
        self,
        work: Callable[[Any], Any],
        show: Callable[[Any], None],
        rested: Callable[[], Awaitable[None]] | None = None,
    ) -> None:
        self._work, self._show, self._rested = work, show, rested
        self._client = context.client  # that of the page, which outlasts the element whose handler asks
        self._asked: list[Any] = []
        self._number = 0
        self._busy = False

    def ask(self, request: Any) -> None:
        """Ask for the answer of a request in place of those that wait."""
        self._asked = [request]
        self._number += 1
        if not self._busy:
            self._busy = True
            background_tasks.create(self._catch_up(), context=self._client)  # which shows what it raises

    async def _catch_up(self) -> None:
        try:
            while self._asked:
                answer = await run.io_bound(self._work, self._asked.pop())
                if answer is None:
                    return  # the server is ending
                self._show(answer)
        finally:
            self._busy = False
        if self._rested is not None:
            number = self._number
            await asyncio.sleep(REST)
            if number == self._number:
                await self._rested()
