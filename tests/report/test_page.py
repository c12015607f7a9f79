"""The page: built from files alone, safe against names, small, the same each time."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hvdc_ident.errors import InputError
from hvdc_ident.report.drawing import visible
from hvdc_ident.report.html import number, typeset
from hvdc_ident.report.page import page, write_report
from hvdc_ident.report.sections.discrepancy import SECTION
from hvdc_ident.summary import Results
from hvdc_ident.text import change_text
from tests.report.judgements import judgement
from tests.report.test_letter import diagnosis, folder_with

NASTY = "<script>alert(1)</script>&\"'$x^2$"


def folder_of(path: Path, rows: int = 500, study: str = "a study", output: str = "y", unit: str = "pu") -> Path:
    """A folder of results as the stages write them."""
    heading = {
        "schema": 1,
        "study": study,
        "model": "m",
        "software": "hvdc_ident 0",
        "seed": 0,
        "sources": {"s.toml": "ab"},
    }
    about = {"role": "fit", "event": 0.1, "window": None}
    fit: dict[str, Any] = {
        **heading,
        "status": "converged",
        "message": "2 of 2 runs converged",
        "fitted": ["K"],
        "held": {"L": "its bound is open", "R": "not a candidate"},
        "values": {"K": 2.0, "L": 1.0},
        "estimates": {"K": {"value": 2.0, "std": 0.1, "ci95": [1.8, 2.2], "method": "covariance"}},
        "candidates": {
            "K": {"start": 1.0, "min": 0.0, "max": None, "unit": unit},
            "L": {"start": 1.0, "min": 0.5, "max": 2.0},
        },
        "rmse": {output: {"e": 0.01}},
        "rmse_start": {output: {"e": 0.1}},
        "chi2_per_dof": 1.02,
        "judgement": judgement({"given": {output: {"e": 0.1}}, "fitted": {output: {"e": 0.01}}}, {output: 0.01}),
        "units": {output: unit},
        "experiments": {"e": about},
        "noise": {"e": {output: {"std": 0.01, "source": "given"}}},
    }
    path.mkdir(parents=True, exist_ok=True)
    (path / "fit.json").write_text(json.dumps(fit))
    (path / "simulation.json").write_text(
        json.dumps({**heading, "rmse": {output: {"e": 0.1}}, "experiments": {"e": about}})
    )
    time = np.linspace(0.0, 1.0, rows)
    quoted = '"' + output.replace('"', '""') + '"'
    measured = '"' + output.replace('"', '""') + '.measured"'
    for stage, gain in (("simulation", 0.8), ("fit", 1.0)):
        lines = [f"{t!r},{gain * t!r},{t!r}" for t in time.tolist()]
        (path / f"{stage}.e.csv").write_text(f"time,{quoted},{measured}\n" + "\n".join(lines) + "\n")
    return path


class _Balanced(HTMLParser):
    """Notes every tag that is not closed, and every address."""

    VOID = frozenset({"meta", "br", "link", "hr", "img", "input"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[str] = []
        self.addresses: list[str] = []
        self.scripts: list[str | None] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append(tag)
        if tag == "script":
            self.scripts.append(dict(attrs).get("type"))
        self.addresses += [v or "" for k, v in attrs if k in ("src", "href", "xlink:href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append(tag)
        self.addresses += [v or "" for k, v in attrs if k in ("src", "href", "xlink:href")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-1:]}"
        self.open.pop()


def parsed(text: str) -> _Balanced:
    parser = _Balanced()
    parser.feed(text)
    parser.close()
    assert not parser.open
    return parser


def test_the_page_is_whole_and_needs_no_network(tmp_path: Path) -> None:
    text = page(folder_of(tmp_path))
    found = parsed(text)
    assert found.seen.count("svg") == 2  # the worst signal, and it again among the waveforms
    assert sorted(found.scripts, key=str) == [None, "application/json", "application/json"]
    assert all(a.startswith(("#", "data:application/zip;")) for a in found.addresses)
    for words in (
        "Parameters",
        "Errors",
        "Waveforms",
        "Provenance",
        "its bound is open",
        "1.80 to 2.20",
        "−90.0 %",
    ):
        assert words in text


def test_the_page_is_the_same_each_time(tmp_path: Path) -> None:
    folder_of(tmp_path)
    assert page(tmp_path) == page(tmp_path)


def test_names_are_escaped(tmp_path: Path) -> None:
    text = page(folder_of(tmp_path, study=NASTY, output=NASTY, unit=NASTY))
    assert sorted(parsed(text).scripts, key=str) == [None, "application/json", "application/json"]
    assert "<script>alert" not in text and "&lt;script&gt;" in text


def test_a_figure_that_zooms_carries_names_as_they_are_and_none_ends_its_script(tmp_path: Path) -> None:
    text = page(folder_of(tmp_path, output=NASTY))
    for content in re.findall(r'<script type="application/json">(.*?)</script>', text, re.DOTALL):
        assert json.loads(content)["titles"] == ["time, s", f"{NASTY}, pu", "error, pu"]


def test_only_the_pages_own_script_may_run(tmp_path: Path) -> None:
    text = page(folder_of(tmp_path))
    (code,) = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    mark = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', text)
    assert policy.startswith("default-src 'none'") and policy.endswith(f"script-src 'sha256-{mark}'")


def test_a_page_without_figures_has_no_script(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    for table in folder.glob("*.csv"):
        table.unlink()
    assert "<script" not in page(folder)


def test_long_waveforms_stay_small(tmp_path: Path) -> None:
    small = write_report(folder_of(tmp_path / "a", rows=200)).stat().st_size
    assert write_report(folder_of(tmp_path / "b", rows=200_000)).stat().st_size < small + 500_000
    assert small < 100_000


def test_what_is_drawn_keeps_every_extreme() -> None:
    time = np.linspace(0.0, 1.0, 100_001)
    values = np.zeros(time.size)
    values[51_234], values[51_236] = 3.0, -2.0
    t, v = visible(time, values)
    assert t.size <= 702 and v.max() == 3.0 and v.min() == -2.0
    assert (np.diff(t) > 0).all() and t[0] == 0.0 and t[-1] == 1.0


def test_an_older_result_is_pointed_out(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    old = json.loads((folder / "simulation.json").read_text())
    (folder / "simulation.json").write_text(json.dumps({**old, "sources": {"s.toml": "cd"}}))
    assert "simulation.json comes from an earlier state of the study" in page(folder)


@pytest.mark.parametrize("content", ["", "{", "[" * 100_000])
def test_a_broken_result_is_an_input_error(tmp_path: Path, content: str) -> None:
    (folder_of(tmp_path) / "fit.json").write_text(content)
    with pytest.raises(InputError, match=re.escape("fit.json")):
        page(tmp_path)


def test_a_table_outside_the_folder_is_not_read(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "inner")
    (tmp_path / "fit.x.csv").write_text("time,y,y.measured\n0,1,2\n")
    data = json.loads((folder / "fit.json").read_text())
    data["experiments"] = {"../x": {"role": "fit"}, "/../../x": {}}
    (folder / "fit.json").write_text(json.dumps(data))
    assert page(folder).count("<figure") == 2  # the simulation of `e`, among the waveforms and as the worst signal


@pytest.mark.parametrize(
    ("value", "shown"),
    [(1.0, "1"), (None, "–"), (float("nan"), "–"), (-0.5, "−0.5"), (1e-9, "1·10<sup>−9</sup>"), (True, "–")],
)
def test_numbers(value: object, shown: str) -> None:
    assert number(value) == shown


def test_shares() -> None:
    assert change_text(2.0, 1.0) == "+100.0 %" and typeset(change_text(0.5, 1.0)) == "−50.0 %"
    assert change_text(2.0, 0.0) == change_text(None, 1.0) == ""


def test_a_curve_that_has_no_name_is_drawn_with_its_band(tmp_path: Path) -> None:
    curve = {"over": "w", "at": [0.0, 1.0, 2.0], "value": [-0.1, 0.0, 0.3], "std": [0.01, None, 0.02]}
    found = {
        "verdict": "unnameable",
        "text": "Something is missing.",
        "fallback": {"kind": "curve", "at": "v", "curve": curve},
    }
    (tmp_path / "discrepancy.json").write_text(
        json.dumps({"schema": 1, "study": "s", "model": "m", "software": "h", **found}), "utf-8"
    )
    drawn = SECTION.render(Results(tmp_path))
    assert 'aria-label="what is added to v over w"' in drawn and ">added to v</text>" in drawn
    plain = {**found, "fallback": {"kind": "nothing", "at": "", "curve": None}}
    (tmp_path / "discrepancy.json").write_text(
        json.dumps({"schema": 1, "study": "s", "model": "m", "software": "h", **plain}), "utf-8"
    )
    assert "what is added" not in SECTION.render(Results(tmp_path))


def test_one_size_of_the_effect_is_seen_and_a_slider_shows_the_others(tmp_path: Path) -> None:
    drawn = SECTION.render(Results(folder_with(tmp_path, diagnosis())))
    assert drawn.count('class="size"') == 4 and drawn.count('style="display: none"') == 2
    assert 'type="range"' in drawn and "without it" in drawn


def test_figures_and_their_captions_are_numbered_in_order(tmp_path: Path) -> None:
    text = page(folder_of(tmp_path))
    assert re.findall(r"<figcaption><b>Figure (\d+)\.</b> \S", text) == ["1", "2"]
    assert text.count("<figure") == text.count("<figcaption>") == 2
