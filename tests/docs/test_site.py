"""The built site: every page is there, links and anchors hold, and the reference has what the code has."""

from __future__ import annotations

import html
import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urldefrag

import numpy as np
import pytest
from typer.testing import CliRunner

import hvdc_ident
from hvdc_ident.cli import app
from hvdc_ident.effects import effects
from hvdc_ident.errors import InputError
from hvdc_ident.formats import formats
from hvdc_ident.model import read_card
from hvdc_ident.shelf import card_of, components, record_of
from hvdc_ident.study.json_schema import reference as tables_of
from hvdc_ident.study.stages import stages

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

from pages import effects as pictures  # noqa: E402
from pages import gallery, notebook, reference, results  # noqa: E402

pytestmark = pytest.mark.nightly


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the built site."""
    pytest.importorskip("material")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    environment = {**os.environ, "PYTHONPATH": str(Path(hvdc_ident.__file__).parents[1])}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


class _Page(HTMLParser):
    """Links and anchors of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.anchors |= {v for k in ("id", "name") if (v := values.get(k))}
        self.links += [v for k in ("href", "src") if (v := values.get(k)) and tag in ("a", "img", "link", "script")]


def test_links_and_anchors_lead_somewhere(site: Path) -> None:
    pages = {p: _Page(p.read_text("utf-8")) for p in site.rglob("*.html") if p.name != "404.html"}
    assert len(pages) > 35
    broken = []
    for path, page in pages.items():
        for link in page.links:
            target, anchor = urldefrag(link)
            if re.match(r"[a-z]+:", link):
                continue
            there = (path.parent / unquote(target)).resolve() if target else path
            there = there / "index.html" if there.is_dir() else there
            if not there.is_file() or (anchor and unquote(anchor) not in pages[there].anchors):
                broken.append(f"{path.relative_to(site)}: {link}")
    assert not broken, "\n".join(broken)


def test_no_page_names_an_outside_address_that_was_not_decided_on(site: Path) -> None:
    named = {
        m
        for p in site.rglob("index.html")
        for m in re.findall(r'(?:href|src)="(https?://[^"]+)"', p.read_text("utf-8"))
    }
    assert all(re.match(r"https://(squidfunk\.github\.io|doi\.org)", m) for m in named), named


def _text(site: Path, page: str) -> str:
    return (site / page / "index.html").read_text("utf-8")


@pytest.mark.parametrize("page", ["study", "model-card"])
def test_every_key_that_a_reader_accepts_is_on_its_page(site: Path, page: str) -> None:
    anchors = _Page(_text(site, f"reference/{page}" + ("-file" if page == "study" else ""))).anchors
    top = {"study": "study", "model-card": "card"}[page]
    for path, keys in tables_of(page).items():
        place = path.removesuffix(".NAME") if page == "model-card" else path.replace(".", "-")
        assert anchors >= {f"{place or top}-{k.name}" for k in keys}


def test_every_component_has_its_picture_and_its_parameters(site: Path) -> None:
    page = _text(site, "reference/components")
    assert page.count('<svg class="drawing flow"') == sum(bool(read_card(card_of(n)).inputs) for n in components())
    assert all(f"<code>{n}</code>" in page for name in components() for n in record_of(name) if n != "-")


def test_every_effect_has_its_picture_and_every_format_its_line(site: Path) -> None:
    page = _text(site, "reference/effects")
    assert page.count('<svg class="drawing"') == len(effects())
    assert _Page(page).anchors >= set(effects())
    for e in effects().values():
        assert html.escape(e.excited_by, quote=False) in page
    listed = _text(site, "reference/formats")
    assert all(f"<code>{name}</code>" in listed for name in formats())


def test_pictures_of_effects_show_the_sizes_of_their_captions() -> None:
    caption = pictures.picture(effects()["limit"]).partition("<figcaption>")[2]
    _, u, y, _ = pictures.simulated(effects()["limit"], 1.0)
    level = float(re.findall(r"level = ([\d.]+)", caption)[0])
    assert level < max(abs(u)) and max(abs(y)) == pytest.approx(level, rel=1e-12)
    time, u, y, _ = pictures.simulated(effects()["delay"], 0.05)
    late = float(re.findall(r"T = ([\d.]+) s", pictures.picture(effects()["delay"]))[0])
    assert y[0] == u[0] and y[-1] == pytest.approx(u[-1])
    np.testing.assert_allclose(y[time > 0.03], np.interp(time - late, time, u)[time > 0.03], atol=1e-6)


def test_every_command_is_on_its_page(site: Path) -> None:
    import typer

    commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    assert _Page(_text(site, "reference/command-line")).anchors >= set(commands) | {"exit-codes"}


def test_every_public_name_has_an_entry_with_an_example(site: Path) -> None:
    anchors = _Page(_text(site, "reference/python")).anchors
    special = {n for n in hvdc_ident.linear.__all__ if n not in (*hvdc_ident.__all__, "FrequencyResponse")}
    wanted = (
        {*hvdc_ident.__all__} - {"linear"}
        | {f"linear.{n}" for n in special}
        | {"sensitivity.morris", "sensitivity.sobol"}
    )
    assert anchors >= wanted
    assert sorted(reference.examples()) == sorted(wanted)
    assert sorted(n for names in reference.KINDS.values() for n in names.split()) == sorted(wanted)
    for name, code in reference.examples().items():
        assert re.search(rf"\bhi\.{re.escape(name)}\b", code), name


def test_the_examples_of_public_names_run_in_their_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "session"}
    for name, code in reference.examples().items():
        exec(compile(code, f"example of {name}", "exec"), names)


def test_every_study_is_in_the_gallery(site: Path) -> None:
    folders = {p.parent.name for p in (ROOT / "studies").glob("*/README.md")}
    assert {name for name, _, _ in gallery.listed()} == folders
    page = _text(site, "studies")
    assert all(f"{name}/" in page for name in folders)
    assert page.count(".svg") == len(list((ROOT / "studies").glob("*/figure.svg")))


def test_the_notebook_is_valid_and_holds_what_its_cells_gave(site: Path) -> None:
    made = json.loads((site / "files" / "calibration.ipynb").read_text("utf-8"))
    assert (made["nbformat"], made["nbformat_minor"]) == (4, 5)
    cells = made["cells"]
    assert [(c["cell_type"], c["source"]) for c in cells] == notebook.cells()
    assert len({c["id"] for c in cells}) == len(cells)
    outputs = [o for c in cells if c["cell_type"] == "code" for o in c["outputs"]]
    shown = [set(o["data"]) for o in outputs if o["output_type"] == "execute_result"]
    assert sum("image/png" in s for s in shown) == 2 and any("text/html" in s for s in shown)
    assert any("KIVDC" in o["text"] for o in outputs if o["output_type"] == "stream")


STUDY = """
schema = 1
[model]
source = "motor.toml"
[parameters]
b = {start = 0.08, min = 0.02, max = 0.5}
J = {start = 0.02, min = 0.002, max = 0.05}
[[experiment]]
name = "step"
data = "step.csv"
inputs = ["v"]
outputs = ["w", "i"]
[[experiment]]
name = "again"
data = "step.csv"
role = "holdout"
inputs = ["v"]
outputs = ["w", "i"]
[linearize]
[[sweep]]
parameter = "b"
values = [0.05, 0.1]
want = ["rmse", "poles", "bode"]
[screening]
trajectories = 4
[identifiability]
[fit]
starts = 2
[diagnose]
effects = ["lag", "gain"]
most = 1
"""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The JSON of every stage of a study of a small model that lacks a lag, by file; of those that it does not ask for, too."""
    folder = tmp_path_factory.mktemp("results")
    (folder / "motor.toml").write_text((ROOT / "scripts" / "pages" / "card.toml").read_text("utf-8"), "utf-8")
    motor = hvdc_ident.load_model(folder / "motor.toml")
    plant = hvdc_ident.apply_effects(motor, [{"effect": "lag", "at": "torque", "parameters": {"T": 0.003}}])
    time, v = np.linspace(0, 0.4, 201), hvdc_ident.step(1.0, 10.0, at=0.05)
    run, random = hvdc_ident.simulate(plant, time, inputs={"v": v}), np.random.default_rng(3)
    noisy = [run[o] + 0.03 * random.standard_normal(time.size) for o in ("w", "i")]
    table = np.column_stack([time, v(time), *noisy])
    np.savetxt(folder / "step.csv", table, delimiter=",", header="time,v,w,i", comments="")
    (folder / "study.toml").write_text(STUDY, "utf-8")
    asked = ["run", *(s.name for s in stages() if not s.wanted(hvdc_ident.load_study(folder / "study.toml")))]
    for command in asked:
        done = CliRunner().invoke(app, [command, str(folder / "study.toml"), "--out", str(folder / "out"), "--quiet"])
        assert done.exit_code == 0, done.output
    return {p.stem: json.loads(p.read_text("utf-8")) for p in (folder / "out").glob("*.json")}


def _at(data: Any, place: list[str]) -> list[Any]:
    """What stands at a place: NAME is every name, [] every entry."""
    if not place:
        return [data] if isinstance(data, dict) else []
    first, rest = place[0], place[1:]
    if first.endswith("[]"):
        return [v for entry in data.get(first[:-2]) or [] for v in _at(entry, rest)]
    inner = list(data.values()) if first == "NAME" else [data[first]] if data.get(first) else []
    return [v for entry in inner for v in _at(entry, rest)]


def test_every_key_of_real_results_is_described(written: Mapping[str, Any]) -> None:
    assert set(written) >= {s.file.removesuffix(".json") for s in stages()}
    assert set(written) <= set(results.keys()), "a file without a section in scripts/pages/results.toml"
    heading, unknown = set(results.keys()["heading"]), set()
    for place, texts in results.keys().items():
        file, *inner = place.split(".")
        files = [written[file]] if file in written else written.values() if inner else ()
        for data in (found for whole in files for found in _at(whole, inner)):
            unknown |= {f"{place}: {k}" for k in set(data) - set(texts) - (set() if inner else heading)}
    assert not unknown, "\n".join(sorted(unknown))


def test_no_description_is_of_a_key_that_the_package_does_not_know() -> None:
    source = "".join(p.read_text("utf-8") for p in (ROOT / "hvdc_ident").rglob("*.py"))
    stale = [
        f"{place}: {k}"
        for place, texts in results.keys().items()
        for k in texts
        if not re.search(rf"\b{re.escape(k)}\b", source)
    ]
    assert not stale, stale


def test_the_card_of_the_page_is_read() -> None:
    try:
        model = hvdc_ident.load_model(ROOT / "scripts" / "pages" / "card.toml")
    except InputError as e:
        pytest.fail(str(e))
    assert list(model.states) == ["w"]
