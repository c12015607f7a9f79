"""The page of two results side by side, from the lines and tables of a comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from hvdc_ident.display import Table
from hvdc_ident.report.html import table_of, text
from hvdc_ident.report.page import document


def comparison_page(title: str, parts: Mapping[str, tuple[Sequence[str], Table | None]]) -> str:
    """Return the page as HTML. parts: by heading, lines and a table; one without either is left out."""
    body = []
    for heading, (lines, table) in parts.items():
        has_rows = table is not None and bool(table.rows)
        if not lines and not has_rows:
            continue
        told = "".join(f"<p>{text(line)}</p>" for line in lines)
        drawn = table_of(table) if table is not None and has_rows else ""
        body.append(f"<section class='tile'>\n<h2>{heading}</h2>\n{drawn}{told}\n</section>")
    return document(title, "two results side by side", "\n".join(body))
