"""From a dropped recording to the letter in one browser, on the shipped link and on a card of the user's own."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("nicegui", reason="the workbench needs: pip install 'hvdc_ident[app]'")

import hvdc_ident as hi
from tests.app.small_study import CARD, write_small_study
from tests.app.test_mapping import recording

pytestmark = pytest.mark.nightly

LONG = 120_000  # ms that something may take on a busy machine before a test gives up
STAGES = """[fit]
starts = 1
[diagnose]
effects = ["lag", "gain"]
most = 1
"""
SERVE = [sys.executable, "-c", "from hvdc_ident.cli import main; main()", "app", "--no-open"]


def of_the_link(folder: Path) -> tuple[str, bytes, str, str]:
    """Return what the workbench is opened with, a recording of it, the output there, and the parameters to fit."""
    return "vsc-hvdc-link", recording(folder / "step.csv").read_bytes(), "P2", "KIP = {start = 25, min = 5, max = 60}"


def of_a_card(folder: Path) -> tuple[str, bytes, str, str]:
    """The same of a card that the user wrote."""
    write_small_study(folder)
    text = (folder / "up.csv").read_bytes()
    own = folder / "own.toml"
    own.write_text(CARD, "utf-8")
    return str(own), text, "y", "k = {start = 4, min = 0.5, max = 20}"


@pytest.mark.parametrize("made", [of_the_link, of_a_card])
def test_a_recording_becomes_a_letter(made: Any, browser: Any, tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir()
    source, content, output, candidates = made(tmp_path)
    server = subprocess.Popen([*SERVE, source], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=home)
    assert server.stdout is not None
    address = re.search(r"http://\S+", server.stdout.readline())
    assert address is not None, server.communicate()
    context = browser.new_context(viewport={"width": 1400, "height": 900})
    page = context.new_page()
    page.set_default_timeout(LONG)
    page.goto(address[0])
    page.get_by_text("No limit is active.").wait_for()

    page.get_by_role("tab", name="Recording").click()
    page.get_by_text("Drop a recording above").wait_for()
    file = {"name": "test.csv", "mimeType": "text/csv", "buffer": content}
    page.locator(".q-uploader__input").set_input_files(file)
    page.get_by_text(re.compile(r"event at 0\.\d+ s")).first.wait_for()
    page.get_by_role("button", name="Write the study").click()
    page.get_by_text("is written").first.wait_for()
    (study,) = tmp_path.glob("**/*-study/study.toml")
    assert [e.outputs for e in hi.load_study(study).experiments] == [(output,)]

    # What may be estimated is for the user to say, in the file, and the page reads it when it is loaded again.
    text = study.read_text("utf-8")
    assert "\n[parameters]\n" in text and "\n# [fit]" in text
    text = text.replace("\n[parameters]\n", f"\n[parameters]\n{candidates}\n", 1)
    study.write_text(re.sub(r"(?m)^# \[fit\].*$", STAGES, text, count=1), "utf-8")
    page.reload()
    page.get_by_role("tab", name="Run", exact=True).click()
    page.get_by_role("button", name="Run all").click()
    page.get_by_role("button", name="Run fit").get_by_text("Again").wait_for()
    page.get_by_role("button", name="Cancel").wait_for(state="hidden")
    with page.expect_download() as told:
        page.get_by_role("button", name="Letter", exact=True).click()
    letter = Path(told.value.path()).read_text("utf-8")
    context.close()
    server.send_signal(signal.SIGINT)
    _, said = server.communicate(timeout=60)
    assert server.returncode == 0 and "Traceback" not in said, said
    (name, value), *others = hi.fit(hi.load_study(study)).values.items()
    numbers = [float(n) for n in re.findall(r"\d+\.\d+", letter)]
    assert not others and name in letter and any(n == pytest.approx(value, rel=1e-2) for n in numbers)
