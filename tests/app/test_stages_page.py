"""The tab Run in a real browser, on a small study of a card of its own: from nothing to the exported letter."""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import hvdc_ident as hi
from hvdc_ident.next_step import next_sentence
from hvdc_ident.summary import Results
from hvdc_ident.summary.phrases import advice, values_line, verdict_sentence
from hvdc_ident.text import probability_text
from tests.app.small_study import LATE, hold, write_small_study

pytest.importorskip("nicegui", reason="the workbench needs: pip install 'hvdc_ident[app]'")
sync_api = pytest.importorskip("playwright.sync_api", reason="no playwright: pip install playwright")

LONG = 120_000  # ms that something may take on a busy machine before a test gives up


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small study whose model waits in a run until the file that `hold` returned is removed."""
    file = write_small_study(tmp_path_factory.mktemp("study"))
    hold(file)
    return file


@pytest.fixture(scope="module")
def pages(browser: Any, study: Path) -> Iterator[tuple[Any, Any]]:
    """Two browsers at one study, with the tab Run open; nothing stands in their consoles at the end."""
    command = [
        sys.executable,
        "-c",
        "from hvdc_ident.cli import main; main()",
        "app",
        str(study),
        "--no-open",
        "--trust",
    ]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert server.stdout is not None
    address = re.search(r"http://\S+", server.stdout.readline())
    assert address is not None, server.communicate()
    opened, said = [], []
    for _ in range(2):
        page = browser.new_context(viewport={"width": 1400, "height": 900}).new_page()
        page.set_default_timeout(LONG)
        page.on("console", lambda m: said.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda e: said.append(str(e)))
        page.goto(address[0])
        page.get_by_role("tab", name="Run", exact=True).click()
        page.get_by_text("Stages that the study asks for").wait_for()
        opened.append(page)
    yield opened[0], opened[1]
    for page in opened:
        page.context.close()
    server.send_signal(signal.SIGINT)
    _, words = server.communicate(timeout=60)
    assert server.returncode == 0 and "Traceback" not in words, words
    assert not said


@pytest.fixture(scope="module")
def ran(pages: tuple[Any, Any], study: Path) -> Any:
    """The first page, once a run is cancelled and another one has come to its end."""
    first, second = pages
    first.get_by_role("button", name="Run all").click()
    for page in pages:  # both see it, and none can start another one
        page.get_by_role("button", name="Cancel").wait_for()
        for button in ("Run all", "Run fit"):
            sync_api.expect(page.get_by_role("button", name=button)).to_be_disabled(timeout=LONG)
    second.get_by_role("button", name="Cancel").click()
    for page in pages:
        page.get_by_text("Cancelled. What was finished is kept").wait_for()
    assert not (study.parent / "study-results" / "fit.json").exists()
    (study.parent / "hold").unlink()
    second.get_by_role("button", name="Run all").click()
    first.get_by_role("button", name="Cancel").wait_for()
    first.get_by_role("button", name="Cancel").wait_for(state="hidden")
    assert first.get_by_role("alert").all_inner_texts() == []
    first.get_by_role("button", name="Run fit").get_by_text("Again").wait_for()
    return first


def opened(page: Any, panel: str) -> Any:
    page.get_by_role("tab", name="Run", exact=True).click()
    page.get_by_role("tab", name=panel, exact=True).click()
    return page.get_by_role("tabpanel").last


def test_the_fit_on_the_page_is_that_of_the_verb(ran: Any, study: Path) -> None:
    opened(ran, "Fit")
    row = ran.get_by_role("row").filter(has_text="1/s").locator("td")
    row.first.wait_for()
    value = hi.fit(hi.load_study(study, trust=True)).values["k"]
    assert float(row.nth(3).inner_text()) == pytest.approx(value, rel=1e-4)


def test_a_parameter_has_its_profile(ran: Any) -> None:
    opened(ran, "What the recordings tell")
    ran.get_by_role("button", name="k", exact=True).click()
    ran.get_by_role("img", name="Profile of k").wait_for()


def test_the_answers_are_those_of_the_summary(ran: Any, study: Path) -> None:
    s = Results(study.parent / "study-results").summary
    brief = ran.locator(".answers .brief")
    shown = {e.get_attribute("data-tile"): e.inner_text() for e in brief.all()}
    assert list(shown) == ["verdict", "values", "missing", "next"]
    assert verdict_sentence(s) in shown["verdict"] and s.verdict.upper() in shown["verdict"]
    assert values_line(s) in shown["values"] and probability_text(s.findings[0].probability) in shown["missing"]
    assert advice(s) in shown["next"] or next_sentence(s.next[0], "page") in shown["next"]


def test_the_size_that_was_found_moves_the_record(ran: Any) -> None:
    opened(ran, "Diagnosis")
    ran.get_by_role("button", name="Explore it with sliders").click()
    name = re.compile("T of the lag at")
    slider, value = ran.get_by_role("slider", name=name), ran.get_by_label(re.compile("T of the lag at .*, value"))
    slider.wait_for()
    assert float(value.input_value()) == pytest.approx(LATE, rel=0.2)
    drawn = "() => getElement(+document.querySelector('[aria-label=Waveforms]').id.slice(1)).plots[0].data[3]"
    told = ran.locator(".live td.n").nth(1)  # the RMSE now
    ran.wait_for_function(f"({drawn})()?.length === 201")
    sync_api.expect(told).to_have_text(re.compile(r"0\.00[45]"), timeout=LONG)  # the noise
    before = ran.evaluate(drawn)
    slider.focus()
    for _ in range(120):
        ran.keyboard.press("ArrowRight")
    ran.wait_for_function(f"before => JSON.stringify(({drawn})()) !== JSON.stringify(before)", arg=before)
    sync_api.expect(told).not_to_have_text(re.compile(r"0\.00"), timeout=LONG)
    ran.get_by_role("button", name="As given").click()


def test_the_next_experiment_is_simulated(ran: Any) -> None:
    opened(ran, "What to record next")
    ran.get_by_role("button", name="Simulate it").click()
    ran.get_by_role("img", name="The experiment as it would be").wait_for()


def test_the_letter_and_a_model_are_handed_over(ran: Any) -> None:
    opened(ran, "Fit")
    with ran.expect_download() as told:
        ran.get_by_role("button", name=".mo", exact=True).click()
    assert told.value.suggested_filename == "lag.mo"
    assert "model" in Path(told.value.path()).read_text()
    with ran.expect_download() as told:
        ran.get_by_role("button", name="Letter", exact=True).click()
    assert told.value.suggested_filename == "letter.html"
    assert "first-order lag" in Path(told.value.path()).read_text()


def test_two_results_are_compared(ran: Any, study: Path) -> None:
    shutil.copytree(study.parent / "study-results", study.parent / "other-results")
    opened(ran, "Comparison")
    ran.get_by_text("k depends on where the effect is, so that there is no one value to compare.").wait_for()


def test_what_the_sliders_say_is_written_into_the_study(ran: Any, study: Path) -> None:
    ran.get_by_role("tab", name="Explore", exact=True).click()
    for label, text in (("k, lower bound", "1"), ("k, upper bound", "9"), ("k, value", "6.5")):
        ran.get_by_label(label, exact=True).fill(text)
        ran.get_by_label(label, exact=True).press("Enter")
    ran.get_by_role("button", name="Write to the study").click()
    ran.get_by_text("study.toml: k ").wait_for()
    (line,) = hi.load_study(study, trust=True).candidates.values()
    assert (line.start, line.min, line.max) == (6.5, 1.0, 9.0)
    assert hi.load_study(study, trust=True).given["k"] == 4.0
    ran.get_by_role("checkbox", name="fit k", exact=True).uncheck()
    ran.get_by_role("button", name="Write to the study").click()
    ran.get_by_text("k is no longer fitted").wait_for()
    after = hi.load_study(study, trust=True)
    assert not after.candidates and after.model.parameters["k"].value == 6.5
