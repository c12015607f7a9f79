"""The last runs of an FMU, which are not run again."""

from __future__ import annotations

from typing import Generic, Protocol, TypeVar

KEPT_BYTES = 64 * 2**20  # bytes


class Sized(Protocol):
    """A run that tells the bytes of its arrays."""

    @property
    def size(self) -> int: ...


Run = TypeVar("Run", bound=Sized)


class LastRuns(Generic[Run]):
    """The last runs by their key, as many as take `most` bytes, the last one in any case.

    Refits of effects at the outputs request the same ones many times.
    """

    def __init__(self, most: int = KEPT_BYTES) -> None:
        self._most, self._bytes = most, 0
        self._runs: dict[bytes, Run] = {}

    def taken(self, key: bytes) -> Run | None:
        """Return a run, which is no longer kept; None where there is none."""
        run = self._runs.pop(key, None)
        self._bytes -= 0 if run is None else run.size
        return run

    def keep(self, key: bytes, run: Run) -> None:
        """Keep a run as the last one."""
        self.taken(key)
        self._runs[key] = run
        self._bytes += run.size
        while self._bytes > self._most and len(self._runs) > 1:
            self.taken(next(iter(self._runs)))

    def clear(self) -> None:
        """Keep none."""
        self._runs.clear()
        self._bytes = 0
