"""Figures that can be enlarged into ones that zoom; a page that uses none of it carries none of it."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
from functools import cache
from importlib import resources
from typing import Any

from hvdc_ident.report.html import text
from hvdc_ident.trajectory import Array

DIGITS = 6


def zoomable(drawn: str, label: str, traces: list[dict[str, Any]], layout: dict[str, Any]) -> str:
    """A `<figure>` with the drawing, which a button turns into an interactive one of the same curves.

    traces, layout: as plotly takes them, numbers as lists.
    """
    data = json.dumps({"traces": traces, "layout": layout}, allow_nan=False).replace("<", "\\u003c")
    script = f'<script type="application/json">{data}</script>'
    return f'<figure data-zoom="{text(label)}">{drawn}{script}</figure>'


def numbers(values: Array) -> list[float]:
    """The values with the digits that can be seen."""
    return [float(f"{v:.{DIGITS}g}") for v in values.tolist()]


def scripts(body: str) -> tuple[str, str]:
    """The scripts a page with this body needs, as HTML, and the part of its policy that allows them and no others."""
    zooms, moves = "data-zoom=" in body, "data-sizes=" in body
    if not (zooms or moves):
        return "", ""
    code = _asset("page.js")
    mark = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
    library = f'<script type="application/gzip" id="plotly">{_library()}</script>\n' if zooms else ""
    return f"{library}<script>{code}</script>\n", f"script-src 'sha256-{mark}' blob:"


@cache
def _asset(name: str) -> str:
    return resources.files("hvdc_ident.report").joinpath("assets", name).read_text(encoding="utf-8")


@cache
def _library() -> str:
    """plotly.js, compressed, as text."""
    code = resources.files("plotly").joinpath("package_data", "plotly.min.js").read_bytes()
    return base64.b64encode(gzip.compress(code, 9, mtime=0)).decode()
