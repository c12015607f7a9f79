"""A notebook from a script in cells: executed when the site is built, shown as a page and offered as .ipynb.

The file format of notebooks is JSON, and the cells run in this process: neither needs Jupyter.
"""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import json
import os
import re
import tempfile
from functools import cache
from html import escape
from pathlib import Path
from typing import Any

SOURCE = Path(__file__).with_name("notebook_cells.py")
CELL = re.compile(r"^# %%(?: \[(markdown)\])?\n", re.MULTILINE)


def cells() -> list[tuple[str, str]]:
    """Return kind ("markdown" or "code") and source of each cell."""
    parts = CELL.split(SOURCE.read_text("utf-8"))[1:]
    return [_cell(kind, text.strip("\n")) for kind, text in zip(parts[::2], parts[1::2], strict=True)]


def _cell(kind: str | None, text: str) -> tuple[str, str]:
    if kind == "markdown":
        return "markdown", re.sub(r"^# ?", "", text, flags=re.MULTILINE)
    return "code", text


@cache
def executed() -> tuple[tuple[str, str, tuple[dict[str, Any], ...]], ...]:
    """Return kind, source and outputs of each cell, the code run in order in an empty folder."""
    import matplotlib

    matplotlib.use("Agg")
    names: dict[str, Any] = {"__name__": "notebook"}
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            return tuple((k, s, tuple(_run(s, names)) if k == "code" else ()) for k, s in cells())
        finally:
            os.chdir(before)


def _run(source: str, names: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the outputs of a cell as a notebook keeps them: what it prints, and the value of its last expression."""
    tree = ast.parse(source)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    printed = io.StringIO()
    value = None
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, SOURCE.name, "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), SOURCE.name, "eval"), names)
    outputs: list[dict[str, Any]] = []
    if printed.getvalue():
        outputs.append({"output_type": "stream", "name": "stdout", "text": printed.getvalue()})
    if value is not None:
        outputs.append({"output_type": "execute_result", "data": _shown(value), "metadata": {}})
    return outputs


def _shown(value: Any) -> dict[str, str]:
    """Return the forms in which a notebook shows a value: text, and a picture or a table where it has one."""
    first = value.flat[0] if hasattr(value, "flat") and value.size else value  # several axes of one figure
    figure = getattr(first, "figure", first)
    if hasattr(figure, "savefig"):
        stream = io.BytesIO()
        figure.savefig(stream, format="png", dpi=90, bbox_inches="tight", metadata={"Software": None})
        return {"image/png": base64.b64encode(stream.getvalue()).decode(), "text/plain": "a figure"}
    shown = {"text/plain": repr(value)}
    if hasattr(value, "_repr_html_"):
        shown["text/html"] = value._repr_html_()
    return shown


def pages() -> dict[str, str]:
    """Return the page and the notebook file, by place."""
    return {"notebook.md": _page(), "files/calibration.ipynb": _file()}


def _page() -> str:
    parts = []
    for kind, source, outputs in executed():
        parts += [source, ""] if kind == "markdown" else ["```python", source, "```", ""]
        for output in outputs:
            parts += [_output(output), ""]
    return "\n".join(parts)


def _output(output: dict[str, Any]) -> str:
    data = output.get("data", {})
    if "image/png" in data:
        return f'<img class="output" alt="output of the cell" src="data:image/png;base64,{data["image/png"]}">'
    if "text/html" in data:
        return f'<div class="output">{re.sub(chr(10) + "+", " ", data["text/html"])}</div>'
    text = escape(output.get("text", data.get("text/plain", "")), quote=False).rstrip()
    return f'<pre class="output"><code>{text}</code></pre>'


def _file() -> str:
    """Return the notebook in nbformat 4.5."""
    made: list[dict[str, Any]] = []
    count = 0
    for number, (kind, source, outputs) in enumerate(executed()):
        cell: dict[str, Any] = {"id": f"cell-{number}", "cell_type": kind, "metadata": {}, "source": source}
        if kind == "code":
            count += 1
            numbered = [{**o, "execution_count": count} if o["output_type"] == "execute_result" else o for o in outputs]
            cell |= {"execution_count": count, "outputs": numbered}
        made.append(cell)
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    notebook = {"cells": made, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"
