"""The page as a PDF, by WeasyPrint, which is an extra."""

from __future__ import annotations

from pathlib import Path

from hvdc_ident.errors import InputError
from hvdc_ident.files import write_bytes


def write_pdf(page: Path) -> Path:
    """The path of the PDF beside a page. Raises InputError where the package is not installed."""
    try:
        from weasyprint import HTML
    except (ImportError, OSError) as error:  # OSError: the system's text libraries are missing
        raise InputError(
            "a PDF cannot be written",
            where=str(page),
            got=str(error).splitlines()[0],
            hint="pip install 'hvdc_ident[pdf]', or print the page from a browser",
        ) from None
    content = HTML(string=page.read_text("utf-8"), base_url=page.parent.as_uri(), url_fetcher=_nothing).write_pdf()
    return write_bytes(page.with_suffix(".pdf"), content)


def _nothing(url: str) -> dict[str, object]:
    """The page needs nothing from outside, and nothing from outside is fetched."""
    raise ValueError(f"the page asks for {url}")
