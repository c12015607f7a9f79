"""The report in a real browser: nothing asked for, nothing in the console, read by every eye and worked by the keyboard."""

from __future__ import annotations

import io
import json
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from hvdc_ident.cli import app
from hvdc_ident.report.page import sections, write_report
from tests.report.test_letter import diagnosis

PHONE, DESK = {"width": 390, "height": 800}, {"width": 1200, "height": 900}

STAGES = """
[linearize]
inputs = ["Vdcref1"]
outputs = ["Irorder1"]
[[sweep]]
parameter = "KIVDC"
min = 600
max = 900
points = 5
want = ["rmse", "poles"]
"""

# Of every text that is drawn: its colour against what lies under it, by WCAG 2.2; and the contrast it has to have.
CONTRAST = """() => {
  const channels = (css) => { const [r, g, b, a = 1] = css.match(/[\\d.]+/g).map(Number); return [r, g, b, a]; };
  const over = (top, under) => top.slice(0, 3).map((c, i) => c * top[3] + under[i] * (1 - top[3])).concat(1);
  const light = (rgb) => { const [r, g, b] = rgb.map((c) => { c /= 255;
    return c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4; }); return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
  const ratio = (a, b) => { const [x, y] = [light(a), light(b)].sort((p, q) => q - p); return (x + 0.05) / (y + 0.05); };
  const ground = (element, x, y) => {
    const layers = [];
    if (element.closest("svg")) for (const e of document.elementsFromPoint(x, y)) {
      if (!e.closest("svg") || e.tagName === "text" || e.tagName === "tspan" || e.tagName === "svg") continue;
      const style = getComputedStyle(e);
      if (style.fill === "none" || e.tagName === "use") continue;
      const fill = channels(style.fill); fill[3] *= Number(style.fillOpacity) * Number(style.opacity); layers.push(fill);
      if (fill[3] === 1) break;
    }
    for (let e = element; e; e = e.parentElement) layers.push(channels(getComputedStyle(e).backgroundColor));
    return layers.reverse().reduce((under, top) => over(top, under), [255, 255, 255, 1]);
  };
  const found = [];
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const element = walker.currentNode.parentElement, words = walker.currentNode.textContent.trim();
    if (!words || element.closest("script, style") || !element.checkVisibility({ visibilityProperty: true })) continue;
    element.scrollIntoView({ block: "center" });
    const range = document.createRange(); range.selectNodeContents(walker.currentNode);
    const box = range.getBoundingClientRect();
    if (!box.width || !box.height) continue;
    const style = getComputedStyle(element), drawn = element.closest("svg");
    const ink = channels(drawn ? style.fill : style.color);
    for (let e = element; e; e = e.parentElement) ink[3] *= Number(getComputedStyle(e).opacity);
    const under = ground(element, box.x + box.width / 2, box.y + box.height / 2);
    const size = parseFloat(style.fontSize), large = !drawn && (size >= 24 || (size >= 18.66 && style.fontWeight >= 700));
    found.push({ words: words.slice(0, 60), ratio: ratio(over(ink, under), under), wanted: large ? 3 : 4.5 });
  }
  return found;
}"""

# What the focus is on, whether it can be seen, and how its ring stands out from the page.
FOCUS = """() => {
  const e = document.activeElement, style = getComputedStyle(e), box = e.getBoundingClientRect();
  const [r, g, b] = style.outlineColor.match(/[\\d.]+/g).map(Number).map((c) => { c /= 255;
    return c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4; });
  return { tag: e.tagName, name: e.getAttribute("aria-label") || e.textContent.slice(0, 60), outline: style.outlineStyle,
    width: parseFloat(style.outlineWidth), ratio: 1.05 / (0.2126 * r + 0.7152 * g + 0.0722 * b + 0.05),
    seen: box.width > 0 && box.bottom > 0 && box.top < innerHeight };
}"""
ELSEWHERE = ("The truth", "Measured frequency responses", "Global sensitivity")
"""Sections of what this study does not ask for."""
CONTROLS = "a[href], button, input, summary, select, textarea"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results with every part of the page: stages that ran, and a diagnosis as JSON."""
    place = tmp_path_factory.mktemp("whole")
    runner = CliRunner()
    assert runner.invoke(app, ["new", str(place / "s")]).exit_code == 0
    study = place / "s" / "study.toml"
    study.write_text(study.read_text("utf-8") + STAGES, "utf-8")
    results = place / "s" / "results"
    done = runner.invoke(app, ["run", str(study), "--out", str(results), "--quiet"])
    assert done.exit_code == 0, done.output
    fit = json.loads((results / "fit.json").read_text("utf-8"))
    heading = {k: fit[k] for k in ("schema", "study", "model", "software", "seed", "sources")}
    candidate = {"effect": "lag", "at": ["P2_m"], "score": 9e4, "p": 0.005, "delta_bic": 8e4}
    candidate |= {"holdout_rmse": 1.1, "status": "refitted"}
    found = diagnosis(**heading, candidates=[candidate], notes=["a note"])
    found["gap"]["pooled"] = {
        m: {"fit": v, "holdout": 1.1 * v} for m, v in (("nominal", 20.0), ("refitted", 4.0), ("augmented", 1.0))
    }
    (results / "discrepancy.json").write_text(json.dumps(found), "utf-8")
    for judged in fit["judgement"]["sets"].values():  # so many signals that they are folded
        judged["signals"] |= {f"{o}_{k}": line for o, line in list(judged["signals"].items()) for k in range(12)}
    (results / "fit.json").write_text(json.dumps(fit), "utf-8")
    write_report(results)
    return results


@pytest.fixture
def page(browser: Any, folder: Path) -> Iterator[Any]:
    """The page on a desk's screen; at the end of each test nothing was asked for and nothing stood in the console."""
    context = browser.new_context(viewport=DESK, accept_downloads=True)
    tab, asked, said = context.new_page(), [], []
    tab.on("request", lambda r: asked.append(r.url) if not r.url.startswith(("file:", "blob:", "data:")) else None)
    tab.on("console", lambda m: said.append(m.text))
    tab.on("pageerror", lambda e: said.append(str(e)))
    tab.goto((folder / "report.html").as_uri())
    yield tab
    context.close()
    assert not asked and not said


def unfold(page: Any) -> None:
    """Open every part of the page."""
    page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")


def _too_faint(page: Any) -> list[dict[str, Any]]:
    texts = page.evaluate(CONTRAST)
    assert len(texts) > 80
    return [t for t in texts if t["ratio"] < t["wanted"]]


def test_every_part_and_every_figure_is_there(page: Any) -> None:
    titles = [s.title for s in sections() if s.title not in ELSEWHERE]
    shown = page.eval_on_selector_all("details.section > summary h2", "all => all.map((h) => h.textContent)")
    assert shown == titles, "what this study does not ask for belongs in ELSEWHERE"
    assert page.eval_on_selector_all("nav a", "all => all.map((a) => a.textContent)") == titles
    unfold(page)
    sizes = page.eval_on_selector_all(
        "figure svg", "all => all.map((s) => { const b = s.getBoundingClientRect(); return [b.width, b.height]; })"
    )
    assert page.locator("svg").count() == len(sizes) >= 8 and all(w > 300 and h > 50 for w, h in sizes)
    assert page.eval_on_selector_all("figure", "all => all.every((f) => f.querySelector('svg'))")


@pytest.mark.parametrize(("media", "scheme"), [("screen", "light"), ("screen", "dark"), ("print", "dark")])
def test_every_text_stands_out_from_its_ground(page: Any, media: str, scheme: str) -> None:
    unfold(page)
    page.emulate_media(media=media, color_scheme=scheme)
    dark = page.evaluate("matchMedia('(prefers-color-scheme: dark)').matches && !matchMedia('print').matches")
    ground = page.evaluate("getComputedStyle(document.querySelector('.tile')).backgroundColor")
    assert (ground != "rgb(255, 255, 255)") == dark
    assert _too_faint(page) == []


def test_the_measure_finds_faint_text(page: Any) -> None:
    # On white, #767676 is the lightest grey that WCAG AA allows.
    unfold(page)
    page.evaluate("document.querySelector('.tile p').style.color = '#767676'")
    assert _too_faint(page) == []
    page.evaluate("document.querySelector('.tile p').style.color = '#777777'")
    page.evaluate("document.querySelector('figure svg text').style.fill = '#999'")
    assert [round(t["ratio"], 2) for t in _too_faint(page)] == [4.48, 2.85]


def test_every_control_is_reached_by_tab_and_shows_it(page: Any) -> None:
    unfold(page)
    expected, seen = page.locator(CONTROLS).count(), []
    while len(seen) < expected:
        page.keyboard.press("Tab")
        focus = page.evaluate(FOCUS)
        if focus["tag"] != "DIV":  # a table that is wider than its place, which arrow keys scroll
            seen.append(focus)
    assert expected >= 5 and {s["tag"] for s in seen} == {"A", "BUTTON", "INPUT", "SUMMARY"}
    assert len({s["name"] for s in seen}) == expected
    for s in seen:
        assert s["seen"] and s["outline"] != "none" and s["width"] >= 2 and s["ratio"] >= 3.0, s


def test_the_arrow_keys_move_the_slider_and_the_curve_follows(page: Any) -> None:
    def shown() -> tuple[list[str], str]:
        curves = page.eval_on_selector_all(
            "[data-sizes] svg .size", "all => all.filter((g) => g.style.display !== 'none').map((g) => g.dataset.k)"
        )
        return curves, page.locator("[data-sizes] output").inner_text()

    unfold(page)
    page.locator("[data-sizes] input").focus()
    assert shown() == (["1", "1"], "T = 1.6 ms")
    page.keyboard.press("ArrowLeft")
    assert shown() == (["0", "0"], "without it")
    page.keyboard.press("ArrowRight")
    assert shown() == (["1", "1"], "T = 1.6 ms")


def test_enter_unfolds_and_folds(page: Any) -> None:
    page.locator("summary").first.focus()
    table = page.locator("details table").first
    assert not table.is_visible()
    page.keyboard.press("Enter")
    assert table.is_visible()
    assert _too_faint(page) == []
    page.keyboard.press("Enter")
    assert not table.is_visible()


def test_a_figure_is_enlarged_and_zoomed_by_keys(page: Any) -> None:
    page.locator("figure > button").first.focus()
    page.keyboard.press("Enter")
    page.locator("figure .chart svg path").first.wait_for()
    assert page.evaluate("document.activeElement.className") == "chart"

    def span() -> float:
        low, high = page.evaluate("[document.activeElement.dataset.from, document.activeElement.dataset.to]")
        return float(high) - float(low)

    assert page.evaluate(FOCUS)["outline"] != "none"
    whole = span()
    for key, share in (("+", 0.5), ("ArrowRight", 0.5), ("-", 1.0), ("+", 0.5), ("0", 1.0)):
        page.keyboard.press(key)
        page.wait_for_function(
            "(wanted) => { const { from, to } = document.activeElement.dataset;"
            " return Math.abs(to - from - wanted) < 1e-6 * wanted; }",
            arg=share * whole,
        )
    assert _too_faint(page) == []


def test_a_span_is_enlarged_by_dragging_over_it(page: Any) -> None:
    page.locator("figure > button").first.click()
    chart = page.locator("figure .chart")
    box = chart.locator("> svg").bounding_box()
    whole = chart.evaluate("(c) => c.dataset.to - c.dataset.from")
    page.mouse.move(box["x"] + 0.4 * box["width"], box["y"] + 0.5 * box["height"])
    assert "recorded -" in chart.inner_text() or "recorded 0" in chart.inner_text()  # its value under the cursor
    page.mouse.down()
    page.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + 0.5 * box["height"])
    page.mouse.up()
    share = chart.evaluate("(c) => c.dataset.to - c.dataset.from") / whole
    inner = box["width"] - 70.0  # without the room of the axis' numbers
    assert share == pytest.approx(0.2 * box["width"] / inner, rel=0.02)
    chart.locator("> svg").dblclick()
    assert chart.evaluate("(c) => c.dataset.to - c.dataset.from") == whole


def test_a_phone_scrolls_down_only(page: Any) -> None:
    page.set_viewport_size(PHONE)
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    unfold(page)
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    assert _too_faint(page) == []


CLIPPED = """() => [...document.querySelectorAll("body *")].filter((e) => !e.closest("svg") && e.checkVisibility()
  && e.scrollWidth > e.clientWidth + 1 && getComputedStyle(e).display !== "inline")
  .map((e) => e.className + " " + e.textContent.slice(0, 60))"""


def test_printed_every_part_is_open_and_nothing_is_cut_off(page: Any) -> None:
    page.emulate_media(media="print")
    page.set_viewport_size({"width": 703, "height": 1000})  # of A4 between margins of 12 mm
    assert page.evaluate(CLIPPED) == []
    for title in (s.title for s in sections() if s.title not in ELSEWHERE):
        part = page.locator(
            "details.section", has=page.locator("summary h2", has_text=re.compile(f"^{re.escape(title)}$"))
        )
        assert part.get_attribute("open") is None and part.locator("> div").is_visible(), title
        assert part.locator("> summary .about").is_visible()
    assert page.locator("figure > button").first.is_hidden() and page.locator("input[type=range]").is_hidden()
    inner = page.locator("details details:not([open]) > :not(summary)")
    assert inner.count() and all(part.is_visible() for part in inner.all())  # no line without what it announces


def test_without_scripts_every_figure_and_number_stands(browser: Any, folder: Path) -> None:
    context = browser.new_context(java_script_enabled=False, viewport=DESK)
    tab = context.new_page()
    tab.goto((folder / "report.html").as_uri())
    assert tab.locator("figure svg").count() >= 9 and tab.locator("figure > button").count() == 0
    assert tab.locator("input[type=range]").is_hidden()
    context.close()


def test_every_number_can_be_saved(page: Any, folder: Path, tmp_path: Path) -> None:
    unfold(page)
    with page.expect_download() as waiting:
        page.locator("a[download]").press("Enter")
    waiting.value.save_as(tmp_path / "results.zip")
    with zipfile.ZipFile(io.BytesIO((tmp_path / "results.zip").read_bytes())) as archive:
        names = archive.namelist()
        assert {"fit.json", "discrepancy.json", "sweep.csv", "fit.step-up.csv"} <= set(names)
        assert all(archive.read(n) == (folder / n).read_bytes() for n in names)
    assert all(re.fullmatch(r"[\w.-]+", n) for n in names)
