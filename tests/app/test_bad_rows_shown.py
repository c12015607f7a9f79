"""Rows that cannot be right are marked wherever the workbench draws them: shaded, with their kind, and with what they are."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("nicegui", reason="the workbench needs: pip install 'hvdc_ident[app]'")

import hvdc_ident as hi
from hvdc_ident.study import StageOptions, run_stage
from tests.app.small_study import write_small_study

LONG = 120_000  # ms that something may take on a busy machine before a test gives up
DROPOUT = range(150, 160)
"""Rows of `up` in which y is 0: from 1.5 to 1.59 s."""

# Whether the ground is shaded at some instants of a plot's grid, close to its upper edge, where no curve is.
SHADED = """([name, grid, times]) => {
  const e = document.querySelector(`[aria-label="${name}"]`), u = e && getElement(+e.id.slice(1))?.plots?.[grid];
  if (!u || !u.data[0].length) return null;
  const at = (t) => [...u.ctx.getImageData(Math.round(u.valToPos(t, "x", true)), u.bbox.top + 4, 1, 1).data].join();
  return times.map((t) => at(t) !== at(0.26));
}"""
TIMES = [0.74, 1.505, 1.545, 1.585, 1.74]
SEEN = [False, True, True, True, False]


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small study with a dropout in y, and its fit."""
    path = write_small_study(tmp_path_factory.mktemp("dropout"))
    rows = (path.parent / "up.csv").read_text("utf-8").splitlines()
    for k in DROPOUT:
        rows[k + 1] = f"{rows[k + 1].rpartition(',')[0]},0"
    (path.parent / "up.csv").write_text("\n".join(rows) + "\n", "utf-8")
    loaded = hi.load_study(path)
    run_stage(loaded, "fit", loaded.folder, StageOptions(folder=loaded.folder))
    return path


@pytest.fixture(scope="module")
def page(browser: Any, study: Path) -> Iterator[Any]:
    """The page on a small screen, with its first answer; nothing stands in its console at the end."""
    command = [sys.executable, "-c", "from hvdc_ident.cli import main; main()", "app", str(study), "--no-open"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert server.stdout is not None
    address = re.search(r"http://\S+", server.stdout.readline())
    assert address is not None, server.communicate()
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    tab, said = context.new_page(), []
    tab.set_default_timeout(LONG)
    tab.on("console", lambda m: said.append(m.text) if m.type == "error" else None)
    tab.on("pageerror", lambda e: said.append(str(e)))
    tab.goto(address[0])
    tab.get_by_text("No limit is active.").wait_for()
    yield tab
    context.close()
    server.send_signal(signal.SIGINT)
    _, words = server.communicate(timeout=60)
    assert server.returncode == 0 and "Traceback" not in words, words
    assert not said


@pytest.mark.parametrize(
    ("tabs", "plot", "grid", "others"),
    [
        (["Explore"], "Waveforms", 0, ()),
        (["Recording"], "The recording", 1, (0,)),  # u, the other column, is sound
        (["Run", "Fit"], "Waveforms of up", 0, ()),
    ],
)
def test_a_dropout_is_shaded_and_told(
    page: Any, tabs: list[str], plot: str, grid: int, others: tuple[int, ...]
) -> None:
    for name in tabs:
        page.get_by_role("tab", name=name, exact=True).click()
    page.wait_for_function(f"seen => JSON.stringify(({SHADED})(seen[0])) === seen[1]", arg=_expected(plot, grid))
    for other in others:
        assert page.evaluate(SHADED, [plot, other, TIMES]) == [False] * len(TIMES)
    over = page.locator(f"[aria-label='{plot}'] .u-over").nth(grid)
    box = over.bounding_box()
    spot = "([name, grid]) => getElement(+document.querySelector(`[aria-label='${name}']`).id.slice(1)).plots[grid].valToPos(1.545, 'x')"
    over.hover(position={"x": page.evaluate(spot, [plot, grid]), "y": box["height"] / 2})
    told = "zeros: rows 151 to 160 (1.5 to 1.59 s): y is exactly zero; left out here"
    over.and_(page.locator(f"[title^='{told}']")).wait_for()
    over.hover(position={"x": 60, "y": box["height"] / 2})
    over.and_(page.locator("[title='']")).wait_for()


def _expected(plot: str, grid: int) -> list[Any]:
    return [[plot, grid, TIMES], f"[{','.join(str(s).lower() for s in SEEN)}]"]
