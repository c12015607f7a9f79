"""The workbench in a real browser: its server as a user starts it, its page, a slider, and what a stranger gets."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("nicegui", reason="the workbench needs: pip install 'hvdc_ident[app]'")

import hvdc_ident as hi

sync_api = pytest.importorskip("playwright.sync_api", reason="no playwright: pip install playwright")
DESK = {"width": 1400, "height": 900}
SECONDS = 60_000  # ms that a page may take on a busy machine before a test gives up

# The curve "now" of the first waveform.
NOW = "() => { const e = document.querySelector('.plot'); return e && getElement(+e.id.slice(1)).plots[0].data[2]; }"


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """The address that `hvdc-ident app` prints; at the end it is interrupted, and ends well."""
    command = [sys.executable, "-c", "from hvdc_ident.cli import main; main()", "app", "--no-open"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert server.stdout is not None
    found = re.search(r"http://\S+", server.stdout.readline())
    assert found is not None, server.communicate()
    yield found[0]
    server.send_signal(signal.SIGINT)
    _, said = server.communicate(timeout=60)
    assert server.returncode == 0, said
    assert "Traceback" not in said


@pytest.fixture
def page(browser: Any, address: str) -> Iterator[Any]:
    """The page with its first answer; nothing is asked of another server, and nothing stands in the console."""
    context = browser.new_context(viewport=DESK)
    tab, elsewhere, said = context.new_page(), [], []
    own = address.partition("?")[0]
    tab.on("request", lambda r: elsewhere.append(r.url) if not r.url.startswith((own, "data:", "blob:")) else None)
    tab.on("console", lambda m: said.append(m.text) if m.type == "error" else None)
    tab.on("pageerror", lambda e: said.append(str(e)))
    tab.set_default_timeout(SECONDS)
    tab.goto(address, timeout=SECONDS)
    tab.wait_for_selector("text=No limit is active.", timeout=SECONDS)
    yield tab
    context.close()
    assert not elsewhere and not said


def test_the_address_keeps_no_token(page: Any) -> None:
    assert "token" not in page.url


def test_a_slider_moves_the_waveform_and_undo_moves_it_back(page: Any) -> None:
    before = page.evaluate(NOW)
    assert len(before) == 1001
    page.get_by_role("slider", name="KIVDC", exact=True).focus()
    for _ in range(40):
        page.keyboard.press("ArrowRight")
    page.wait_for_function(f"before => JSON.stringify(({NOW})()) !== before", arg=_json(page, before))
    page.get_by_role("button", name="As given").click()
    page.wait_for_function(f"before => JSON.stringify(({NOW})()) === before", arg=_json(page, before))
    page.get_by_role("button", name="Undo").click()
    page.wait_for_function(f"before => JSON.stringify(({NOW})()) !== before", arg=_json(page, before))


def _json(page: Any, value: Any) -> str:
    return page.evaluate("v => JSON.stringify(v)", value)


def _choose(page: Any, label: str, option: str) -> None:
    page.get_by_role("combobox", name=label, exact=True).fill(option)
    page.get_by_role("option", name=option, exact=True).click()


def test_an_effect_becomes_a_slider_of_its_size_and_goes_again(page: Any) -> None:
    before = page.evaluate(NOW)
    page.get_by_text("Effects", exact=True).click()
    _choose(page, "at", "Ir1")
    page.get_by_role("button", name="Add", exact=True).click()
    page.get_by_role("slider", name="T of the lag at Ir1", exact=True).wait_for()
    page.wait_for_function(f"before => JSON.stringify(({NOW})()) !== before", arg=_json(page, before))
    page.get_by_role("button", name="Remove lag at Ir1").click()
    page.get_by_role("slider", name="T of the lag at Ir1", exact=True).wait_for(state="detached")
    page.wait_for_function(f"before => JSON.stringify(({NOW})()) === before", arg=_json(page, before))


def test_a_value_and_bounds_are_typed(page: Any) -> None:
    slider, value = page.get_by_role("slider", name="KIVDC", exact=True), page.get_by_label("KIVDC, value")
    model = hi.load_model("vsc-hvdc-link")
    steps = {"Vdcref1": hi.step(1.0, 1.02, at=0.1)}
    output = next(iter(model.outputs))
    expected = hi.simulate(model, np.linspace(0.0, 1.0, 1001), {"KIVDC": 900.0}, inputs=steps)[output]
    value.fill("900")
    value.press("Enter")
    page.wait_for_function(f"y => Math.abs(({NOW})()[150] - y) < 1e-5", arg=float(expected[150]))
    page.get_by_label("KIVDC, lower bound").fill("800")
    page.get_by_label("KIVDC, upper bound").fill("1000")
    page.get_by_label("KIVDC, upper bound").press("Enter")
    assert slider.input_value() == "250"  # in the middle of 500 steps
    slider.press("End")
    page.wait_for_function("() => document.querySelector('[aria-label=\"KIVDC, value\"]').value === '1000'")
    value.fill("much")
    value.press("Enter")
    assert "wrong" in (value.get_attribute("class") or "") and slider.input_value() == "500"


def test_margins_are_those_of_the_loop_that_is_opened(page: Any) -> None:
    _choose(page, "or loop opened at", "Irorder1")
    page.wait_for_selector("text=phase 65.26 degrees")


def test_sensitivities_stand_in_a_table_once_the_slider_rests(page: Any) -> None:
    page.get_by_text("Sensitivities of the waveforms").click()
    row = page.locator("tbody tr", has_text="KIVDC")
    row.wait_for()
    assert re.search(r"KIVDC\s+[0-9.]+ pu", row.inner_text())


@pytest.mark.parametrize("query", ["", "?token=wrong"])
def test_a_stranger_gets_nothing(address: str, query: str) -> None:
    own = address.partition("?")[0]
    for path in ("", "assets/uPlot.iife.min.js", "_nicegui_ws/socket.io/?EIO=4&transport=polling"):
        with pytest.raises(urllib.error.HTTPError) as told:
            urllib.request.urlopen(own + path + ("" if "?" in path else query))
        assert told.value.code == 403 and b"token" in told.value.read()
