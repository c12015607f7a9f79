"""Where the page comes from: software, seed, files and their hashes."""

from __future__ import annotations

from hvdc_ident.report.html import table, text
from hvdc_ident.report.results import Results
from hvdc_ident.report.section import Section


def _render(results: Results) -> str:
    heading = results.heading
    rows = [["study", text(heading.get("study", ""))], ["model", text(heading.get("model", ""))]]
    rows += [["software", text(heading.get("software", ""))], ["seed", text(heading.get("seed", ""))]]
    rows += [["result", text(f"{name}.json")] for name in results.stages]
    sources = heading.get("sources") or {}
    rows += [["source", f"{text(name)}<br><code>sha256 {text(value)}</code>"] for name, value in sources.items()]
    return table(["what", "which"], rows, words=(0, 1))


SECTION = Section(order=90, title="Provenance", render=_render)
