"""The page: every part that has something to say, styled, in one file that needs no network."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from pathlib import Path

from hvdc_ident.errors import InputError
from hvdc_ident.files import write_bytes, write_text
from hvdc_ident.report.html import text
from hvdc_ident.report.interactive import scripts
from hvdc_ident.report.results import Results, Section
from hvdc_ident.text import with_study

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
STYLE = """
:root { --ink: #1c1c1c; --soft: #5b5b5b; --line: #ddd; --accent: #1f5fa8; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 62rem; padding: 2rem 1.5rem 4rem; color: var(--ink); background: #fff;
  font: 16px/1.5 system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.7rem; margin: 0 0 .2rem; }
h2 { font-size: 1.25rem; margin: 2.4rem 0 .6rem; padding-top: .6rem; border-top: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 1.6rem 0 .3rem; }
header p, .small { color: var(--soft); font-size: .9rem; } header { margin-bottom: 1.2rem; }
.wide { overflow-x: auto; } table { border-collapse: collapse; font-size: .9rem; width: 100%; }
th, td { text-align: left; padding: .35rem .6rem; border-bottom: 1px solid var(--line); vertical-align: top; }
th { font-weight: 600; color: var(--soft); border-bottom: 2px solid var(--line); white-space: nowrap; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
tbody tr:hover { background: #f6f8fa; }
code { font: .8rem ui-monospace, "Cascadia Mono", Menlo, Consolas, monospace; }
sup { line-height: 0; font-size: .75em; }
code { color: var(--soft); overflow-wrap: anywhere; }
button, input[type=range] { font: inherit; } figure { position: relative; }
figure > button { position: absolute; right: 0; bottom: 0; font-size: .8rem; padding: .1rem .5rem; color: var(--accent);
  background: #fff; border: 1px solid var(--accent); border-radius: .3rem; cursor: pointer; }
button:focus-visible, input:focus-visible, a:focus-visible, summary:focus-visible, [tabindex]:focus-visible {
  outline: 3px solid #b35900; outline-offset: 2px; } a { color: var(--accent); } summary { cursor: pointer; }
.letter { border: 1px solid var(--line); padding: 1rem 1.4rem; border-radius: .4rem; } .letter p { margin: .5rem 0; }
figure { margin: .4rem 0 1rem; break-inside: avoid; } figure svg { width: 100%; height: auto; display: block; }
.keys { color: var(--soft); font-size: .8rem; }
@media (max-width: 40rem) { body { padding: 1rem .8rem 3rem; } .letter { padding: .6rem .8rem; }
  figure { overflow-x: auto; } figure > svg { min-width: 34rem; } figure > button { position: sticky; left: 0; } }
@media print {
  figure > button, input[type=range], .saved, .keys { display: none; } details::details-content { content-visibility: visible; }
  body { max-width: none; padding: 0; font-size: 10pt; }
  h2, h3 { break-after: avoid; } tr { break-inside: avoid; }
}
"""


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
    """A whole page of a title and a body of HTML, with the scripts and the policy that the body needs."""
    title = text(title)
    needed, allowed = scripts(body)
    policy = "; ".join(part for part in (POLICY, allowed) if part)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        f"<title>{title}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        f"<header><h1>{title}</h1><p>{text(subtitle)}</p></header>\n{body}\n{needed}</body>\n</html>\n"
    )


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
