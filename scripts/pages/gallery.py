"""The gallery of the studies: their list with headlines and figures, and the README of each as a page."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
STUDIES = ROOT / "studies"
ROW = re.compile(r"^\| \[(\w+)\]\(\w+\) \| (.*?) \| (.*?) \|$", re.MULTILINE)
LINK = re.compile(r"(?<!!)\[([^\]]+)\]\((?!https?:|#)([^)]+)\)")


@cache
def listed() -> tuple[tuple[str, str, str], ...]:
    """Return folder, title and headline of each study, in the order of studies/README.md."""
    return tuple(ROW.findall((STUDIES / "README.md").read_text("utf-8")))


def pages() -> dict[str, str]:
    """Return the gallery and the page of each study, by place."""
    made = {f"studies/{name}.md": _page(name) for name, _, _ in listed()}
    return {"studies/index.md": _gallery(), **made}


def figures() -> dict[str, Path]:
    """Return the figure of each study that has one, by place."""
    found = {f"studies/{name}.svg": STUDIES / name / "figure.svg" for name, _, _ in listed()}
    return {place: path for place, path in found.items() if path.exists()}


def navigation() -> list[dict[str, str]]:
    """Return the entries of the navigation."""
    return [
        {"Gallery": "studies/index.md"},
        *({title.replace("`", ""): f"studies/{name}.md"} for name, title, _ in listed()),
    ]


def _gallery() -> str:
    lines = [
        "---",
        "hide: [toc]",
        "---",
        "",
        "# Studies",
        "",
        "The calibration of the paper by Vanfretti, Murad and Gómez López (IEEE PESGM 2017), its tables and figures one by one, and what",
        "lies behind their differences. The reference waveforms come from the average-value link, a substitute for EMTP-RV. Each study",
        "is one command, `python studies/NAME/run.py`, and the tests check its numbers.",
        "",
        '<div class="gallery" markdown>',
        "",
    ]
    for name, title, headline in listed():
        shown = "" if headline == "see the page" else headline
        image = f"[![{title}]({name}.svg)]({name}.md)" if f"studies/{name}.svg" in figures() else ""
        lines += [
            '<div class="study" markdown>',
            "",
            f"### [{title}]({name}.md)",
            "",
            image,
            "",
            shown,
            "",
            "</div>",
            "",
        ]
    return "\n".join([*lines, "</div>", ""])


def _page(name: str) -> str:
    """Return a study's README with links that hold in the site; a link to a file that is not in the site becomes text."""
    text = (STUDIES / name / "README.md").read_text("utf-8").replace("(figure.svg)", f"({name}.svg)")
    known = {n for n, _, _ in listed()}

    def replaced(found: re.Match[str]) -> str:
        shown, target = found.groups()
        other = target.removesuffix("/README.md").removesuffix("/").rpartition("/")[2]
        return f"[{shown}]({other}.md)" if other in known else shown

    return LINK.sub(replaced, text)
