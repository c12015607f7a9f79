"""The page: every part that has something to say, styled, in one file that needs no network."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from pathlib import Path

from jinja2 import Environment, StrictUndefined, Template
from markupsafe import Markup

from hvdc_ident.errors import InputError
from hvdc_ident.files import write_bytes, write_text
from hvdc_ident.report.drawing import asset, scripts
from hvdc_ident.report.html import text
from hvdc_ident.report.results import Results, Section
from hvdc_ident.text import with_study

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"


@cache
def sections() -> tuple[Section, ...]:
    """Every part of the page, in order, found by walking `sections/`."""
    from hvdc_ident.report import sections as folder

    found = [
        importlib.import_module(f"{folder.__name__}.{m.name}").SECTION for m in pkgutil.iter_modules(folder.__path__)
    ]
    return tuple(sorted(found, key=lambda s: s.order))


def page(folder: Path) -> str:
    """The page of a folder of results as HTML text. Raises InputError where there are none."""
    results = Results(folder)
    parts = []
    for section in sections():
        body = section.render(results)
        if body:
            parts.append(f"<section>\n<h2>{text(section.title)}</h2>\n{body}\n</section>")
    heading = results.heading
    # The first file read is the study's, and the page's reader stands beside it as well as anywhere.
    body = with_study("\n".join(parts), text(next(iter(heading.get("sources") or {}), "STUDY")))
    return document(str(heading.get("study", "study")), str(heading.get("software", "")), body)


def document(title: str, subtitle: str, body: str) -> str:
    """Return a whole page of a title and a body of HTML, with the scripts and the policy that the body needs."""
    code, library, allowed = scripts(body)
    return _template().render(
        title=title,
        subtitle=subtitle,
        policy=Markup("; ".join(part for part in (POLICY, allowed) if part)),
        style=Markup(asset("page.css")),
        body=Markup(body),
        code=Markup(code),
        library=Markup(library),
    )


@cache
def _template() -> Template:
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    return environment.from_string(asset("page.html.j2"))


def write_report(folder: Path) -> Path:
    """The path of report.html, written from what the folder holds."""
    return write_text(folder / "report.html", page(folder))


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
