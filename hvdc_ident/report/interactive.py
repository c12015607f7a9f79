"""Figures that can be enlarged into ones that zoom; a page that uses none of it carries none of it."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from importlib import resources

from hvdc_ident.data import Array
from hvdc_ident.report.html import text


@dataclass(frozen=True)
class PlottedCurve:
    """A curve of a figure that zooms: columns by name. minus: a column taken off y. lower: in the strip below."""

    name: str
    color: str
    y: str
    minus: str = ""
    lower: bool = False


def zoomable(
    drawn: str, label: str, columns: Mapping[str, Array], curves: Sequence[PlottedCurve], titles: tuple[str, str, str]
) -> str:
    """A `<figure>` with the drawing, which a button turns into an interactive one of the same curves.

    columns: of one length; `x` is the abscissa of all. titles: of the abscissa, the figure and the strip below it.
    """
    data = {
        "columns": {
            name: base64.b64encode(values.astype("<f4").tobytes()).decode() for name, values in columns.items()
        },
        "curves": [asdict(curve) | {"name": text(curve.name)} for curve in curves],
        "titles": [text(title) for title in titles],
    }
    script = f'<script type="application/json">{json.dumps(data)}</script>'
    return f'<figure data-zoom="{text(label)}">{drawn}{script}</figure>'


def scripts(body: str) -> tuple[str, str, str]:
    """Return the page's script and the drawing library that this body needs, and the policy that allows them alone.

    Each is "" where the body needs none.
    """
    zooms, moves = "data-zoom=" in body, "data-sizes=" in body
    if not (zooms or moves):
        return "", "", ""
    code = asset("page.js")
    mark = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
    return code, _library() if zooms else "", f"script-src 'sha256-{mark}' blob:"


@cache
def asset(name: str) -> str:
    """Return the text of a file in `templates/`."""
    return resources.files("hvdc_ident.report").joinpath("templates", name).read_text(encoding="utf-8")


@cache
def _library() -> str:
    """plotly.js, compressed, as text."""
    code = resources.files("plotly").joinpath("package_data", "plotly.min.js").read_bytes()
    return base64.b64encode(gzip.compress(code, 6, mtime=0)).decode()
