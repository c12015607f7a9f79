"""Section on the origin of the page: software, seed, files and their hashes; and every number of it, to be saved."""

from __future__ import annotations

import base64
import io
import zipfile

from markupsafe import Markup

from hvdc_ident.report.html import Section, rows_of, text
from hvdc_ident.summary import Results

ARCHIVE = "results.zip"
SUFFIXES = (".json", ".csv", ".toml")
PAGE_BYTES = 20_000_000
"""Bytes of numbers that a page carries at most, uncompressed; beyond it says where they lie."""


def _render(results: Results) -> str:
    heading = results.heading
    rows = [(name, Markup(text(heading.get(name, "")))) for name in ("study", "model", "software", "seed")]
    sources = heading.get("sources") or {}
    rows += [
        ("source", Markup(f"{text(name)}<br><code>sha256 {text(value)}</code>")) for name, value in sources.items()
    ]
    return rows_of(["what", "which"], rows) + _numbers(results)


def _numbers(results: Results) -> str:
    """A link that saves every number of the page as one archive; it works without scripts and without a network."""
    paths = [f"{name}.json" for name in results.stages]
    for stage in results.stages.values():
        paths += [str(n) for n in stage.get("files") or []]
    files = [results.folder / n for n in dict.fromkeys(paths)]
    files = [f for f in files if f.parent == results.folder and f.is_file() and f.suffix in SUFFIXES]
    names = text(", ".join(f.name for f in files))
    if sum(f.stat().st_size for f in files) > PAGE_BYTES:
        return f"<p class='small'>Every number of this page lies beside it: {names}.</p>"
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in files:  # without the time of writing, so the same each time
            archive.writestr(zipfile.ZipInfo(file.name), file.read_bytes(), zipfile.ZIP_DEFLATED)
    data = base64.b64encode(stream.getvalue()).decode()
    link = f'<a download="{ARCHIVE}" href="data:application/zip;base64,{data}">Save every number of this page</a>'
    return f"<p class='saved'>{link} ({ARCHIVE}, {len(stream.getvalue()) / 1e3:.0f} kB)</p><p class='small'>In it: {names}.</p>"


SECTION = Section(
    order=90,
    title="Provenance",
    about="Software, seed and files with their hashes; every number of this page, to be saved.",
    render=_render,
)
