"""The page on the JSON results: every key of every stage, with its meaning."""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path

from hvdc_ident.study.stages import stages


@cache
def keys() -> dict[str, dict[str, str]]:
    """Return the meaning of each key by file ("heading" for what all share)."""
    return tomllib.loads(Path(__file__).with_name("results.toml").read_text("utf-8"))


OTHERS = {
    "run": "`run`: which stages ran",
    "summary": "`run` and every stage: what the results say, decided once; report, letter, screens and workbench show it",
}
"""Files beside those of the stages, with what writes them."""


def page() -> str:
    """Return the page: a table for each file, and for each place in it that is described."""
    lines = [
        "# Results",
        "",
        "Each stage writes one JSON file into `STUDY-results/`, with every number at full precision; infinity and *unknown* are `null`.",
        "`hvdc-ident STAGE STUDY --json` prints the same on stdout, and `result.to_dict()` gives it in Python. NAME stands for any name,",
        "`[]` for any entry of a list.",
        "",
        "## Keys of every file {: #heading }",
        "",
        *_table(keys()["heading"]),
        *_inner("heading"),
    ]
    titles = {s.file.removesuffix(".json"): f"`{s.name}`: {s.summary.removesuffix('.')}" for s in stages()} | OTHERS
    for file, title in titles.items():
        lines += [f"## {file}.json {{: #{file} }}", "", f"{title}.", "", *_table(keys()[file]), *_inner(file)]
    return "\n".join(lines)


def _inner(file: str) -> list[str]:
    places = [k for k in keys() if k.startswith(f"{file}.")]
    return [line for k in places for line in (f"### `{k.removeprefix(file + '.')}`", "", *_table(keys()[k]))]


def _table(entries: dict[str, str]) -> list[str]:
    return ["| key | meaning |", "|---|---|", *(f"| `{k}` | {v} |" for k, v in entries.items()), ""]
