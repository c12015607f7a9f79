"""The report: the first screen with the answers, then every part that has something to say, in one file that needs no network."""

from __future__ import annotations

import importlib
import pkgutil
import re
from functools import cache
from itertools import count
from pathlib import Path

from jinja2 import Environment, StrictUndefined, Template
from markupsafe import Markup

from hvdc_ident.errors import InputError
from hvdc_ident.files import write_bytes, write_text
from hvdc_ident.report.drawing import asset, on_paper, script, style_sheet
from hvdc_ident.report.first_screen import first_screen
from hvdc_ident.report.html import Section, text
from hvdc_ident.summary import Results
from hvdc_ident.text import with_study

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"


@cache
def sections() -> tuple[Section, ...]:
    """Every part of the page below its first screen, in order, found by walking `sections/`."""
    from hvdc_ident.report import sections as folder

    every = [
        importlib.import_module(f"{folder.__name__}.{m.name}").SECTION for m in pkgutil.iter_modules(folder.__path__)
    ]
    return tuple(sorted(every, key=lambda s: s.order))


def page(folder: Path) -> str:
    """The page of a folder of results as HTML text. Raises InputError where there are none."""
    results = Results(folder)
    first = first_screen(results)
    parts = [(s, body) for s in sections() if (body := s.render(results))]
    contents = "".join(f"<li><a href='#{_anchor(s)}'>{text(s.title)}</a></li>" for s, _ in parts)
    folds = "\n".join(_folded(s, body, opened=not first) for s, body in parts)
    body = f"{first}\n<nav aria-label='Contents'><h2>Contents</h2><ol>{contents}</ol></nav>\n{folds}"
    # The first file read is the study's, and the page's reader stands beside it as well as anywhere.
    body = with_study(body, text(next(iter(results.heading.get("sources") or {}), "STUDY")))
    return document(f"Study {results.heading.get('study', '')}", _compared(results), body)


def _compared(results: Results) -> str:
    """What was compared with what, as HTML."""
    heading, experiments = results.heading, results.experiments
    held_out = sum(1 for e in experiments.values() if e.role == "holdout")
    kept = f", {held_out} of them held out" if held_out else ""
    words = [f"model <strong>{text(heading.get('model', ''))}</strong>"]
    words += [f"{len(experiments)} recording{'s' if len(experiments) > 1 else ''}{kept}"] if experiments else []
    words += [text(heading.get("software", ""))]
    return " · ".join(words)


def _anchor(section: Section) -> str:
    return re.sub(r"\W+", "-", section.title.lower()).strip("-")


def _folded(section: Section, body: str, *, opened: bool) -> str:
    """The section as a part that opens on demand; a link into it opens it too."""
    heading = f"<summary><h2>{text(section.title)}</h2><span class='about'>{text(section.about)}</span></summary>"
    state = " open" if opened else ""
    return f"<details class='section'{state}>{heading}\n<div id='{_anchor(section)}'>{body}</div></details>"


def document(title: str, subtitle: str, body: str) -> str:
    """Return a whole page with its figures numbered, and the script and the policy that it needs. subtitle, body: HTML."""
    numbers = count(1)
    body = re.sub("<figcaption>", lambda _: f"<figcaption><b>Figure {next(numbers)}.</b> ", body)
    code, allowed = script(body)
    return _template().render(
        title=title,
        subtitle=Markup(subtitle),
        policy=Markup("; ".join(part for part in (POLICY, allowed) if part)),
        style=Markup(style_sheet()),
        body=Markup(body),
        code=Markup(code),
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
    text = on_paper(page.read_text("utf-8"))
    content = HTML(string=text, base_url=page.parent.as_uri(), url_fetcher=_nothing).write_pdf()
    return write_bytes(page.with_suffix(".pdf"), content)


def _nothing(url: str) -> dict[str, object]:
    """The page needs nothing from outside, and nothing from outside is fetched."""
    raise ValueError(f"the page asks for {url}")
