"""Every control that the page has is used, whatever it is, and none raises what the page has no words for."""

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

pytest.importorskip("nicegui", reason="the workbench needs: pip install 'hvdc_ident[app]'")

import hvdc_ident as hi
from hvdc_ident.app.runs import StudyRun

sync_api = pytest.importorskip("playwright.sync_api", reason="no playwright: pip install playwright")

SECONDS = 60_000  # ms that something may take on a busy machine before a test gives up
WAIT = 15_000  # ms within which a control that is in sight can be used
REST = 150  # ms for the page to answer one control before the next
CONTROLS = "button, input, summary, [role=tab], [role=combobox], [role=slider], .q-expansion-item .q-item, .q-uploader"
FAILED = "The workbench failed"
START = "from hvdc_ident.cli import main; main()"
BROKEN = f"""
from hvdc_ident.app.exports import ExportButtons
async def report(self):
    raise ZeroDivisionError("broken by hand")
ExportButtons._report = report
{START}
"""

# Of every control in sight: a name that stays when the page is built anew, and its kind. The name is that of its label, its words
# or its place among those alike, so that one that appears later is found, and one that was used is not used again.
LISTED = """(controls) => {
  const seen = {}, found = [];
  for (const e of document.querySelectorAll(controls)) {
    if (!e.checkVisibility() || e.disabled || e.getAttribute("aria-disabled") === "true" || e.closest(".q-notification, .q-menu")) continue;
    if (e.parentElement.closest(".q-expansion-item__container > .q-item")) continue;  // the arrow, which does what its line does
    const box = e.getBoundingClientRect();
    if (!box.width || !box.height) continue;
    const field = e.closest(".q-field"), label = e.getAttribute("aria-label") || field?.querySelector(".q-field__label")?.textContent;
    const part = e.closest(".q-expansion-item"), role = e.getAttribute("role");
    const opens = part && e.matches(".q-item") && e.closest(".q-expansion-item__container > *") === e;
    const own = role || (e.tagName === "INPUT" ? e.type || "text" : e.tagName.toLowerCase());
    const kind = !opens ? own : part.classList.contains("q-expansion-item--expanded") ? "close" : "open";
    const tab = document.querySelector("header [role=tab][aria-selected=true]")?.textContent ?? "";
    const words = (label || e.textContent || e.placeholder || "").replace(/[\\s"\\\\]+/g, " ").trim().slice(0, 60);
    const name = `${tab} | ${opens ? "part" : kind} | ${words}`, number = (seen[name] = (seen[name] ?? 0) + 1);
    e.dataset.control = `${name} | ${number}`;
    found.push([e.dataset.control, kind]);
  }
  return found;
}"""


@pytest.fixture
def study(finished: tuple[hi.Study, StudyRun], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the small study with its results, and other results beside them to compare with; what one test does to it no other sees."""
    folder = tmp_path_factory.mktemp("controls") / "study"
    shutil.copytree(finished[0].path.parent, folder)
    shutil.copytree(folder / "study-results", folder / "other-results")
    return folder / "study.toml"


@pytest.fixture
def opened(browser: Any, request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Any, list[str], list[str]]]:
    """A page of a workbench, what its console said, and at the end what its server said."""
    code, *arguments = request.param(request)
    command = [sys.executable, "-c", code, "app", "--no-open", *arguments]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    assert server.stdout is not None
    address = re.search(r"http://\S+", server.stdout.readline())
    assert address is not None, server.communicate()
    context = browser.new_context(viewport={"width": 1400, "height": 900}, accept_downloads=True)
    page = context.new_page()
    said: list[str] = []
    page.on("console", lambda m: said.append(m.text) if m.type == "error" else None)
    page.on("pageerror", lambda e: said.append(str(e)))
    page.on("filechooser", lambda chooser: None)
    page.set_default_timeout(SECONDS)
    page.goto(address[0])
    page.get_by_text(re.compile("No limit is active|On a limit|Drop a recording")).first.wait_for()
    printed: list[str] = []
    yield page, said, printed
    context.close()
    server.send_signal(signal.SIGINT)
    printed.append(server.communicate(timeout=60)[1])
    assert server.returncode == 0
    if code == START:
        assert "Traceback" not in printed[0], printed[0]


def use(page: Any, name: str, kind: str) -> None:
    """Use one control as a hand would: press it, choose another entry, move it, type into it."""
    control = page.locator(f'[data-control="{name}"]').first
    if not control.is_visible() or not control.is_enabled():
        return  # it has been taken away since it was listed
    if kind == "combobox":
        control.click()
        entry = page.locator(".q-menu .q-item").last
        if entry.count():
            entry.click()
        page.keyboard.press("Escape")
    elif kind == "range" or kind == "slider":
        control.focus()
        page.keyboard.press("ArrowRight")
    elif kind == "checkbox":
        control.click()
    elif kind in ("text", "number", "textbox"):
        before = control.input_value()
        for typed in ("0.25", before):
            control.fill(typed)
            control.press("Enter")
    elif kind == "file":
        return  # the dropping of recordings has tests of its own
    else:
        control.click()


def check_told(page: Any, name: str) -> None:
    told = [t for t in page.locator(".q-notification").all_inner_texts() if FAILED in t]
    assert not told, f"after {name!r}: {told}"


def use_all(page: Any) -> set[str]:
    """Use every control once, those that others bring along too, and return their names; parts are opened first, and closed last."""
    done: set[str] = set()
    tries: dict[str, int] = {}
    page.set_default_timeout(WAIT)
    while True:
        listed = page.evaluate(LISTED, CONTROLS)
        rest = [(name, kind) for name, kind in listed if name not in done]
        rest.sort(key=lambda c: ("open", "", "close", "tab").index(c[1] if c[1] in ("open", "close", "tab") else ""))
        if not rest:
            return done
        name, kind = rest[0]
        done.add(name)
        try:
            use(page, name, kind)
        except sync_api.TimeoutError as error:
            check_told(page, name)  # what was told late may lie over the control
            tries[name] = tries.get(name, 0) + 1
            control = page.locator(f'[data-control="{name}"]').first
            if (control.count() and control.is_visible()) or tries[name] > 3:
                raise AssertionError(f"control {name!r} cannot be used: {error}") from None
            done.discard(
                name
            )  # it was taken away or built anew meanwhile: where it is in sight again, it is listed again
        page.wait_for_timeout(REST)
        check_told(page, name)


def a_study(request: pytest.FixtureRequest) -> tuple[str, ...]:
    return START, str(request.getfixturevalue("study"))


def a_model(_: pytest.FixtureRequest) -> tuple[str, ...]:
    return (START,)


def a_recording(request: pytest.FixtureRequest) -> tuple[str, ...]:
    return START, str(request.getfixturevalue("study").parent / "up.csv")


def a_broken_page(request: pytest.FixtureRequest) -> tuple[str, ...]:
    return BROKEN, str(request.getfixturevalue("study"))


@pytest.mark.nightly
@pytest.mark.parametrize("opened", [a_study, a_model, a_recording], indirect=True)
def test_every_control_works_or_says_why_not(opened: tuple[Any, list[str], list[str]]) -> None:
    page, said, _ = opened
    done = use_all(page)
    assert len(done) > 20 and {n.split(" | ")[0] for n in done} >= {"Explore", "Recording"}
    assert not said, said


@pytest.mark.nightly
@pytest.mark.parametrize("opened", [a_broken_page], indirect=True)
def test_a_control_that_is_broken_is_found(opened: tuple[Any, list[str], list[str]]) -> None:
    with pytest.raises(AssertionError, match="broken by hand"):
        use_all(opened[0])
