"""The workbench on a unit of a .dyr file and its record: nothing is cut, a gain moves what is shown, and a fit becomes a .dyr."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

pytest.importorskip("nicegui", reason="the workbench needs: pip install 'hvdc_ident[app]'")

from hvdc_ident.cli import app
from hvdc_ident.psse import read_dyr
from tests.plants.test_units_of_dyr import folder as plant

__all__ = ["plant"]

LONG = 120_000  # ms that something may take on a busy machine before a test gives up
K = 140.0
"""The exciter's gain of the plant; its .dyr states 100."""

# The gain now, of the frequency response; None before it is drawn.
GAIN = """() => {
  const e = document.querySelector('[aria-label="Frequency response"]');
  const data = e && getElement(+e.id.slice(1)).plots[0].data[2];
  return data && data.length ? [...data] : null;
}"""

# Texts that do not have the room they need, and what stands beyond the right edge.
CUT = """() => [...document.querySelectorAll('body *')].filter((e) => {
  if (!e.checkVisibility() || e.matches('input, .q-uploader__input') || !e.clientWidth || !e.textContent.trim()) return false;
  const style = getComputedStyle(e), hides = ['hidden', 'clip'].includes(style.overflowX) || style.textOverflow === 'ellipsis';
  const clamped = style.webkitLineClamp !== 'none' && e.scrollHeight > e.clientHeight + 1;
  return clamped || (hides && e.scrollWidth > e.clientWidth + 1) || e.getBoundingClientRect().right > innerWidth + 1;
}).map((e) => `${e.tagName} ${e.className}: ${e.textContent.slice(0, 80)}`)"""


@pytest.fixture(scope="module")
def study(plant: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The study that `new` writes of the unit, with two of its parameters to be fitted."""
    home = tmp_path_factory.mktemp("unit") / "unit"
    new = [
        "new",
        home,
        "--dyr",
        plant / "plant.dyr",
        "--raw",
        plant / "grid.raw",
        "--bus",
        101,
        "--from",
        plant / "event.csv",
    ]
    assert CliRunner().invoke(app, [str(a) for a in new]).exit_code == 0
    file = home / "study.toml"
    text = re.sub(r'(?m)^"gov\.R"', '# "gov.R"', file.read_text("utf-8"))
    file.write_text(re.sub(r"(?ms)^\[identifiability\].*", "[identifiability]\n[fit]\n", text), "utf-8")
    return file


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
    tab.get_by_text(re.compile("No limit is active|On a limit")).first.wait_for()
    yield tab
    context.close()
    server.send_signal(signal.SIGINT)
    _, words = server.communicate(timeout=60)
    assert server.returncode == 0 and "Traceback" not in words, words
    assert not said


def open_tab(page: Any, name: str) -> None:
    page.get_by_role("tab", name=name, exact=True).click()


def nothing_is_cut(page: Any) -> None:
    for name, text in (
        ("Recording", "What hvdc-ident check says"),
        ("Run", "Take away"),
        ("Explore", "Write to the study"),
    ):
        open_tab(page, name)
        page.get_by_text(text, exact=True).first.wait_for()
        assert page.evaluate(CUT) == [], name


def test_nothing_is_cut_on_a_small_screen(page: Any) -> None:
    nothing_is_cut(page)


def test_the_response_is_the_experiments_and_moves_with_a_gain(page: Any) -> None:
    page.get_by_text("From V to P, at the start of event; 0 dB is 1 MW/pu.").wait_for()
    page.wait_for_function(f"() => ({GAIN})() !== null")
    before = page.evaluate(GAIN)
    page.get_by_role("slider", name="avr.K", exact=True).focus()
    for _ in range(50):
        page.keyboard.press("ArrowRight")
    moved = f"before => {{ const now = ({GAIN})(); return now && Math.max(...now.map((v, k) => Math.abs(v - before[k]))) > 0.1; }}"
    page.wait_for_function(moved, arg=before)
    page.get_by_role("button", name="As given").click()
    page.wait_for_function("() => document.querySelector('[aria-label=\"avr.K, value\"]').value === '100'")


def test_the_fit_button_shows_the_fitted_values(page: Any) -> None:
    value = page.get_by_label("avr.K, value", exact=True)
    assert float(value.input_value()) == 100.0
    page.get_by_role("button", name="Fit", exact=True).click()
    page.wait_for_function("() => document.querySelector('[aria-label=\"avr.K, value\"]').value !== '100'")
    assert float(value.input_value()) == pytest.approx(K, rel=0.02)
    assert "fitted" in page.locator(".q-select", has=page.get_by_role("combobox", name="model with")).inner_text()


def test_what_was_found_is_not_cut_either(page: Any) -> None:
    nothing_is_cut(page)


def test_the_unit_is_taken_away_as_a_dyr_file(page: Any, plant: Path) -> None:
    open_tab(page, "Run")
    with page.expect_download() as told:
        page.get_by_role("button", name=".dyr", exact=True).click()
    assert told.value.suggested_filename.endswith(".dyr")
    path = Path(told.value.path()).rename(plant / "taken.dyr")
    before, after = read_dyr(plant / "plant.dyr"), read_dyr(path)
    assert after.records[1].values[2] == pytest.approx(K, rel=0.02)
    assert after.records[3].values == before.records[3].values  # what was not fitted


def test_explore_opens_with_the_fitted_values(page: Any) -> None:
    page.reload()
    page.get_by_text(re.compile("No limit is active|On a limit")).first.wait_for()
    page.wait_for_function("() => document.querySelector('[aria-label=\"avr.K, value\"]')?.value !== '100'")
    assert float(page.get_by_label("avr.K, value", exact=True).input_value()) == pytest.approx(K, rel=0.02)
    page.get_by_role("button", name="As given").click()
    page.wait_for_function("() => document.querySelector('[aria-label=\"avr.K, value\"]').value === '100'")
    assert "given values" in page.locator(".q-select", has=page.get_by_role("combobox", name="model with")).inner_text()
