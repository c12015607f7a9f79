"""What a handler of the page raises is shown on the page, and a model that is chosen is the one that is written."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("nicegui", reason="the workbench needs: pip install 'hvdc_ident[app]'")

import hvdc_ident as hi
from hvdc_ident.app.page_errors import words_of
from hvdc_ident.errors import InputError
from tests.app.test_workbench import DESK, SECONDS

CARD = """\
schema = 1
name = "{name}"
[parameters]
T = {{value = {T}, unit = "s", min = 0.01, max = 1.0}}
[inputs]
valve = {{value = 0.0}}
[states]
x = {{derivative = "(valve - x)/T"}}
[outputs]
head = "x"
"""
START = "from hvdc_ident.cli import main; main()"
FAULTS = f"""
import hvdc_ident as hi
from hvdc_ident.app.latest import Latest
from hvdc_ident.app.tabs.recording import Mapper
load, ask, rows = hi.load_model, Latest.ask, Mapper._build_rows
def load_model(source, **settings):
    if str(source).endswith("odd.toml"):
        raise TypeError("odd: nobody expected this while a model is loaded")
    return load(source, **settings)
def build_rows(self):
    if self._search.value == "boom":
        raise ZeroDivisionError("nobody expected this in a handler")
    rows(self)
def broken(asked):
    raise KeyError("nobody expected this in a thread")
def asked(self, request):
    self._work = broken
    ask(self, request)
hi.load_model, Mapper._build_rows, Latest.ask = load_model, build_rows, asked
{START}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two cards and a recording of a first-order lag of 0.2 s."""
    t = np.arange(200) * 0.01
    x = np.where(t > 0.5, 1.0 - np.exp(-(t - 0.5) / 0.2), 0.0)
    rows = "".join(f"{a:.2f},{b:g},{c:.8f}\n" for a, b, c in zip(t, t > 0.5, x, strict=True))
    (tmp_path / "run.csv").write_text(f"time [s],valve,head\n{rows}")
    for name, T in (("penstock", 0.3), ("odd", 0.4)):
        (tmp_path / f"{name}.toml").write_text(CARD.format(name=name, T=T))
    return tmp_path


@contextmanager
def workbench(browser: Any, folder: Path, code: str, *arguments: str) -> Iterator[Any]:
    """The page of a workbench, which ends well."""
    command = [sys.executable, "-c", code, "app", "--no-open", *arguments]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=folder)
    assert server.stdout is not None
    found = re.search(r"http://\S+", server.stdout.readline())
    context = browser.new_context(viewport=DESK)
    try:
        assert found is not None
        page = context.new_page()
        page.set_default_timeout(SECONDS)
        page.goto(found[0], timeout=SECONDS)
        yield page
    finally:
        context.close()
        server.send_signal(signal.SIGINT)
        server.communicate(timeout=60)
    assert server.returncode == 0


def choose_model(page: Any, name: str) -> None:
    page.get_by_role("combobox", name="model").click()
    page.get_by_role("option", name=re.compile(rf"{name}\.toml$")).click()


def write(page: Any) -> None:
    page.get_by_role("button", name="Write the study").click()
    page.get_by_text("is written").first.wait_for()


def test_the_model_chosen_for_a_recording_is_the_one_that_is_written(browser: Any, folder: Path) -> None:
    with workbench(browser, folder, START, "run.csv") as page:
        page.get_by_text("at least one recorded output").wait_for()  # none of them is one of the link's
        choose_model(page, "penstock")
        page.get_by_text("experiment run").first.wait_for()
        write(page)
    study = hi.load_study(folder / "run-study" / "study.toml")
    assert study.model.name == "penstock" and study.model.parameters["T"].value == 0.3
    (experiment,) = study.experiments
    assert list(experiment.inputs) == ["valve"] and experiment.outputs == ("head",)


def test_an_error_of_a_handler_is_shown_and_the_model_before_stays(browser: Any, folder: Path) -> None:
    with workbench(browser, folder, FAULTS, "run.csv") as page:
        page.get_by_text("at least one recorded output").wait_for()
        choose_model(page, "penstock")
        page.get_by_text("experiment run").first.wait_for()
        choose_model(page, "odd")
        told = page.get_by_role("alert").filter(has_text="TypeError: odd: nobody expected this while a model is loaded")
        told.wait_for()
        told.get_by_role("button", name="Close").click()
        told.wait_for(state="detached")
        assert "penstock.toml" in page.locator(".q-select", has=page.get_by_role("combobox", name="model")).inner_text()
        page.get_by_label("search signals").fill("boom")
        page.get_by_text("ZeroDivisionError: nobody expected this in a handler").wait_for()
        write(page)
    assert hi.load_study(folder / "run-study" / "study.toml").model.name == "penstock"


def test_an_error_in_the_background_is_shown(browser: Any, folder: Path) -> None:
    with workbench(browser, folder, FAULTS, "penstock.toml") as page:
        page.get_by_text("KeyError: 'nobody expected this in a thread'").wait_for()


def test_errors_of_the_package_speak_for_themselves() -> None:
    error = InputError("no such file", where="a.csv", hint="check the path")
    assert words_of(error) == str(error)
    assert "AssertionError." in words_of(AssertionError())
