"""Results as lines of text."""

from __future__ import annotations

from collections.abc import Sequence


def table_text(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """The lines under the header, columns aligned."""
    rows = [tuple(header), *map(tuple, lines)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(header))]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows)
