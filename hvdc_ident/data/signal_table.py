"""What all results with named signals over time have in common, by the names that pandas has for it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hvdc_ident.data.trajectory import Array, Trajectory


class SignalTable:
    """A result of named signals over time, which behaves as a pandas DataFrame does: `"P" in run`, `run["P"]`, names when it is gone
    through, rows by `len`, `items()`, `to_frame()`.
    """

    @abstractmethod
    def table(self) -> Trajectory:
        """Return the signals over time."""

    def __getitem__(self, name: str) -> Array:
        """Return the samples of a signal, (n,), in its unit. Raises UnknownNameError, which says which signals there are."""
        table = self.table()
        return table.values[:, table.column(name)]

    def __contains__(self, name: object) -> bool:
        return name in self.table().names

    def __iter__(self) -> Iterator[str]:
        return iter(self.table().names)

    def __len__(self) -> int:
        """Return the number of rows."""
        return int(self.table().time.size)

    def keys(self) -> tuple[str, ...]:
        """Return the names of the signals."""
        return self.table().names

    def items(self) -> Iterator[tuple[str, Array]]:
        """Yield each signal's name and samples, (n,)."""
        table = self.table()
        return zip(table.names, table.values.T, strict=True)

    def to_frame(self) -> Any:
        """Return the signals as a pandas DataFrame over time in s. Raises InputError where pandas is not installed."""
        return self.table().to_dataframe()
