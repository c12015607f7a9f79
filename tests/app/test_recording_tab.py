"""The tab Recording in a real browser: a recording is dropped and mapped, the study written, and the file stays the truth."""

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
from tests.app.test_mapping import recording
from tests.app.test_workbench import DESK, SECONDS

SERVE = [sys.executable, "-c", "from hvdc_ident.cli import main; main()", "app", "--no-open"]
EVENT = "[aria-label='event, s'][role=slider]"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("workbench")


@pytest.fixture(scope="module")
def page(browser: Any, folder: Path) -> Iterator[Any]:
    """The tab of a workbench that was opened with a model alone; nothing stands in its console."""
    server = subprocess.Popen(SERVE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder)
    assert server.stdout is not None
    found = re.search(r"http://\S+", server.stdout.readline())
    assert found is not None, server.communicate()
    context = browser.new_context(viewport=DESK)
    tab, said = context.new_page(), []
    tab.on("console", lambda m: said.append(m.text) if m.type == "error" else None)
    tab.on("pageerror", lambda e: said.append(str(e)))
    tab.set_default_timeout(SECONDS)
    tab.goto(found[0])
    tab.get_by_text("No limit is active.").wait_for()  # the integrators are compiled, and the server is at rest
    tab.get_by_role("tab", name="Recording").click()
    tab.get_by_text("Drop a recording above").wait_for()
    yield tab
    context.close()
    server.send_signal(signal.SIGINT)
    _, printed = server.communicate(timeout=60)
    assert server.returncode == 0 and "Traceback" not in printed, printed
    assert not said


def drop(page: Any, name: str, content: bytes) -> None:
    page.locator(".q-uploader__input").set_input_files({"name": name, "mimeType": "text/csv", "buffer": content})


DROPPED = """([name, text]) => {
  const data = new DataTransfer();
  data.items.add(new File([text], name, { type: "text/csv" }));
  document.querySelector(".plot, .q-page").dispatchEvent(new DragEvent("drop", { dataTransfer: data, bubbles: true, cancelable: true }));
}"""


def test_a_broken_file_is_told_and_leaves_nothing(page: Any, folder: Path) -> None:
    drop(page, "../../broken.csv", b"time [s],P2 [pu]\n0,0.4\n1,0.4\n0.5,0.4\n")
    page.get_by_text("broken.csv, line 4, column 1").wait_for()
    assert list(folder.iterdir()) == []


def test_a_dropped_recording_is_mapped_and_written(page: Any, folder: Path, tmp_path: Path) -> None:
    text = recording(tmp_path / "step.csv", "P2 [MW]", 1000.0).read_text("utf-8")
    page.evaluate(DROPPED, ["step.csv", text])  # beside the place for it
    study = folder / "vsc-hvdc-link-study" / "study.toml"
    page.get_by_text("at least one recorded output").wait_for()
    page.get_by_role("button", name="take as output P2, base 1000 MW").click()
    page.get_by_text("event at 0.1 s").wait_for()  # what check says, of the mapping that is not written yet
    assert not study.exists()
    marker = page.locator(EVENT).bounding_box()
    x, y = marker["x"] + marker["width"] / 2, marker["y"] + marker["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 40, y, steps=4)
    page.mouse.up()
    page.wait_for_function("() => +document.querySelector('input[aria-label=\"event, s\"]').value > 0.1")
    page.get_by_role("button", name="Write the study").click()
    page.get_by_text("is written").first.wait_for()
    (experiment,) = hi.load_study(study).experiments
    assert 0.1 < experiment.event < 0.2 and experiment.event in experiment.time
    assert experiment.measured["P2"][0] == pytest.approx(0.4, abs=1e-3)
    assert "good" in str(hi.check(study))


def test_the_file_and_the_page_follow_each_other_and_neither_is_overwritten(page: Any, folder: Path) -> None:
    study = folder / "vsc-hvdc-link-study" / "study.toml"
    event = page.locator("input[aria-label='event, s']")
    text = re.sub(r"(?m)^event = .*$", "event = 0.125 # by hand", study.read_text("utf-8"))
    study.write_text(text, "utf-8")
    page.wait_for_function("() => document.querySelector('input[aria-label=\"event, s\"]').value === '0.125'")
    event.fill("0.15")
    page.get_by_text("not written yet").wait_for()
    theirs = text.replace("0.125", "0.175")
    study.write_text(theirs, "utf-8")
    page.get_by_role("button", name="Keep mine").wait_for()
    assert study.read_text("utf-8") == theirs
    page.get_by_role("button", name="Keep mine").click()
    page.get_by_role("button", name="Keep mine").wait_for(state="detached")
    page.get_by_role("button", name="Write the study").click()
    page.get_by_text("not written yet").wait_for(state="detached")
    assert study.read_text("utf-8") == theirs.replace("0.175", "0.15")
