"""Hooks of mkdocs: the pages that are made from the code join those in docs/."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from hvdc_ident.study.json_schema import FILES, schema_text  # noqa: E402
from pages import effects, gallery, notebook, reference, results, shelf  # noqa: E402

PAGES: dict[str, Callable[[], str]] = {
    "reference/study-file.md": reference.study_file,
    "reference/model-card.md": reference.model_card,
    "reference/effects.md": effects.page,
    "reference/components.md": shelf.page,
    "reference/formats.md": reference.waveform_formats,
    "reference/results.md": results.page,
    "reference/python.md": reference.python_names,
    "reference/command-line.md": reference.command_line,
}


@cache
def made() -> dict[str, str]:
    """Return the text of every file that is made, by its place in the site's sources."""
    pages = {place: make() for place, make in PAGES.items()}
    pages |= {f"schema/{name}.json": schema_text(name) for name in FILES}
    return pages | gallery.pages() | notebook.pages()


def on_config(config: Any) -> Any:
    """Put the pages of the studies into the navigation."""
    for entry in config.nav:
        if entry.get("Studies") == "studies/":
            entry["Studies"] = gallery.navigation()
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the made pages and the figures of the studies to the files of the site."""
    for place, text in made().items():
        files.append(File.generated(config, place, content=text))
    for place, path in gallery.figures().items():
        files.append(File.generated(config, place, abs_src_path=str(path)))
    return files


def on_post_build(config: Any) -> None:
    """Leave out what the theme ships for languages of search that the site does not have."""
    shutil.rmtree(Path(config.site_dir) / "assets" / "javascripts" / "lunr", ignore_errors=True)
