"""The first screen answers four questions, from whatever a folder of results holds."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hvdc_ident.report.first_screen import first_screen
from hvdc_ident.report.letter import Letterhead, write_letter
from hvdc_ident.report.page import page, write_report
from hvdc_ident.study import StageOptions, load_study, run_stage
from hvdc_ident.summary import Results
from tests.report.demo_like import EXPERIMENTS, GAINS, OUTPUTS, demo_like, judged
from tests.report.test_browser import CLIPPED

DESK = {"width": 1400, "height": 900}
TILES = ("verdict", "values", "figure", "missing", "next")


@pytest.fixture(scope="module")
def like_the_demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = demo_like(tmp_path_factory.mktemp("demo"))
    write_report(folder)
    return folder


def changed(folder: Path, source: Path, **stages: dict[str, Any] | None) -> Path:
    """A folder with the results of another, some of its stages changed, or left out where they are None."""
    folder.mkdir()
    for file in source.iterdir():
        if file.suffix in (".csv", ".json") and file.name.split(".")[0] not in [
            n for n, s in stages.items() if s is None
        ]:
            (folder / file.name).write_bytes(file.read_bytes())
    for name, change in stages.items():
        if change is not None:
            data = (
                json.loads((source / f"{name}.json").read_text("utf-8")) if (source / f"{name}.json").exists() else {}
            )
            heading = json.loads((source / "simulation.json").read_text("utf-8"))
            heading = {k: heading[k] for k in ("schema", "study", "model", "software", "seed", "sources")}
            (folder / f"{name}.json").write_text(json.dumps({**heading, **data, **change}), "utf-8")
    return folder


def judged_anew(source: Path, **more: Any) -> dict[str, dict[str, Any]]:
    """Changes of results like the demo's: every stage judged against a tolerance, or with a profile that the study names."""
    data = {n: json.loads((source / f"{n}.json").read_text("utf-8")) for n in ("simulation", "fit", "discrepancy")}
    rmse = {n: d.get("rmse") or d["rmse_after"] for n, d in data.items()}
    sets = {"simulation": ("given",), "fit": ("given", "fitted"), "discrepancy": ("given", "effect")}
    return {n: {"judgement": judged(rmse, *names, **more)} for n, names in sets.items()}


def words(html: str) -> str:
    """The text of HTML, without its figures."""
    return " ".join(
        re.sub(r"<[^>]+>", " ", re.sub(r"<svg.*?</svg>|<script.*?</script>", "", html, flags=re.DOTALL)).split()
    )


def tile(html: str, name: str) -> str:
    found = re.search(rf"<section class='tile' data-tile='{name}'>(.*?)</section>", html, re.DOTALL)
    return words(found[1]) if found else ""


def test_the_first_screen_holds_verdict_values_finding_next_test_and_figure(browser: Any, like_the_demo: Path) -> None:
    tab = browser.new_page(viewport=DESK)
    tab.goto((like_the_demo / "report.html").as_uri())
    for name in TILES:
        box = tab.locator(f"[data-tile={name}]").bounding_box()
        assert (
            box["x"] >= 0 and box["y"] >= 0 and box["x"] + box["width"] <= 1400 and box["y"] + box["height"] <= 900
        ), name
    drawn = tab.locator("[data-tile=figure] svg").bounding_box()
    assert drawn["width"] > 600 and drawn["height"] > 300
    assert tab.evaluate("document.documentElement.scrollWidth") <= 1400
    tab.close()


def test_the_demo_is_printed_on_eight_pages_at_most_with_nothing_cut_off(browser: Any, like_the_demo: Path) -> None:
    tab = browser.new_page(viewport={"width": 703, "height": 1000})
    tab.goto((like_the_demo / "report.html").as_uri())
    pages = len(re.findall(rb"/Type\s*/Page\b", tab.pdf(prefer_css_page_size=True)))
    assert 3 <= pages <= 8
    tab.emulate_media(media="print")
    assert tab.evaluate(CLIPPED) == []
    tab.close()
    assert (like_the_demo / "report.html").stat().st_size < 3_000_000


CUT = """() => [...document.querySelectorAll(".tile .wide, .letter .wide")].filter((e) => e.scrollWidth > e.clientWidth)
  .map((e) => e.textContent.slice(0, 60))"""


def test_on_a_phone_no_column_of_the_first_screen_and_the_letter_is_cut(browser: Any, like_the_demo: Path) -> None:
    tab = browser.new_page(viewport={"width": 390, "height": 800})
    for shown in (like_the_demo / "report.html", write_letter(like_the_demo, Letterhead())):
        tab.goto(shown.as_uri())
        assert tab.locator(".tile .wide, .letter .wide").count() and tab.evaluate(CUT) == []
    tab.close()


def test_the_letter_is_one_printed_page(browser: Any, like_the_demo: Path) -> None:
    head = Letterhead(
        "A. Engineer, System Studies, TSO", "Converter Works, Modelling", "Link North", "3.2", "2026-11-25"
    )
    tab = browser.new_page(viewport={"width": 703, "height": 1000})
    tab.goto(write_letter(like_the_demo, head).as_uri())
    assert len(re.findall(rb"/Type\s*/Page\b", tab.pdf(prefer_css_page_size=True))) == 1
    assert tab.locator("figure svg").count() == 1 and tab.locator("table").count() == 1
    tab.close()


def test_the_answers_of_the_demo(like_the_demo: Path) -> None:
    found = Results(like_the_demo).summary
    given, fitted, effect = found.sets.values()
    # The worst signal by an own reckoning: the recordings hold nothing but the gap and noise of a known size.
    data = np.genfromtxt(like_the_demo / "simulation.vdc-3.csv", delimiter=",", names=True)
    error = data["Ir1measured"] - data["Ir1"]
    assert given.worst is not None and given.worst[0] in ("Ir1", "Ii1") and given.worst[1].endswith("3")
    worst = found.signal(given.worst)
    assert worst is not None
    assert worst.errors["given"].times_noise == pytest.approx(np.sqrt(np.mean(error**2)) / 1e-4, rel=0.02)
    assert worst.errors["given"].peak == pytest.approx(3.0 * worst.errors["given"].rmse)  # as the judgement has it
    still = 3  # Ir2 does not move in three recordings
    assert (given.on_noise.failed, given.on_noise.judged) == (len(EXPERIMENTS) * len(OUTPUTS) - still, 27)
    assert fitted.on_noise.failed and not effect.on_noise.failed and not given.in_limits.failed
    assert (found.verdict, found.about) == ("fail", "fitted") and not found.by_limits
    assert {p.name: p.value for p in found.parameters} == {n: a for n, (_, _, a) in GAINS.items()}
    screen = first_screen(Results(like_the_demo))
    assert (
        "FAIL The fitted model does not follow the recordings to their noise, but keeps the windows of the tolerance profile; "
        "with the effect it does." in tile(screen, "verdict")
    )
    assert "KIVDC , pu/s 734.7 728.3 724.7 to 731.9 −0.9 %" in tile(screen, "values")
    assert "Without it a fit would put KIVDC at 846.1 pu/s (+15.2 %)" in tile(screen, "values")
    assert tile(screen, "missing").startswith("What does the model lack? Lag , 97 % likely. Each of P1 and Q1")
    assert "P1, Q1 (60 %); P1_m (40 %)" in tile(screen, "missing")
    assert "Not all of it: 19.0 % of the gap is left and is not noise" in tile(screen, "missing")
    assert "Record P1_m as well" in tile(screen, "next")


def test_one_parameter_has_one_value_outside_the_folded_parts(like_the_demo: Path) -> None:
    screen = words(first_screen(Results(like_the_demo)))
    assert screen.count("728.3") == 1 and "846.9" not in screen  # that of the diagnosis without the effect
    whole = words(page(like_the_demo))
    ends = "interval if nothing else is missing"
    named = f"parameter given fitted {ends} change refitted by the diagnosis with the effect {ends} change unit"
    assert named in whole and "846.9" in whole


def test_a_value_that_depends_on_the_place_has_no_single_value(like_the_demo: Path, tmp_path: Path) -> None:
    for file in like_the_demo.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    found = json.loads((tmp_path / "discrepancy.json").read_text("utf-8"))
    line = {"ci95": None, "unit": "pu/s", "effect": "lag"}
    values = [{**line, "value": v, "at": [at]} for at, v in (("P1", 728.3), ("P1_m", 802.0))]
    found["values_by_place"] = {"KIVDC": values}
    found["findings"][0]["text"] = "P1 lags, where KIVDC is 728 pu/s; or P1_m, where KIVDC is 802 pu/s."
    (tmp_path / "discrepancy.json").write_text(json.dumps(found))
    (value,) = [p for p in Results(tmp_path).summary.parameters if p.name == "KIVDC"]
    assert value.value is None and value.effect is None and value.interval is None
    by_place = "728.3 pu/s if the lag is at P1, 802 pu/s if it is at P1_m"
    screen = first_screen(Results(tmp_path))
    assert "KIVDC , pu/s 734.7 by place –" in tile(screen, "values")
    assert f"KIVDC depends on the place: it is {by_place}." in tile(screen, "values")
    assert "or P1_m, where KIVDC is 802 pu/s" in tile(screen, "missing")
    assert by_place in words(page(tmp_path))


def test_a_study_that_names_a_tolerance_is_judged_by_it(like_the_demo: Path, tmp_path: Path) -> None:
    folder = changed(tmp_path / "named", like_the_demo, **judged_anew(like_the_demo, named=True))
    screen = first_screen(Results(folder))
    assert "PASS The fitted model keeps the tolerance." in tile(screen, "verdict") and "named by the study" in screen
    text = page(folder)
    errors = text[text.index("<div id='errors'>") :]
    assert errors.index("Before, during and after the event") < errors.index(
        "RMSE, given values"
    )  # the limits stand in front
    own = changed(tmp_path / "own", like_the_demo, **judged_anew(like_the_demo, tolerance={"Ir1": 2e-4, "Ii1": 1.0}))
    screen = first_screen(Results(own))
    assert "FAIL The fitted model does not keep the tolerance; with the effect it does, where it is judged." in tile(
        screen, "verdict"
    )
    assert "PASS 18, not judged 9" in tile(screen, "verdict") and "states no tolerance for Ir2" in screen
    assert "Tolerance of the RMSE: Ir1 0.0002 pu, Ii1 1 pu." in tile(screen, "verdict")


NOTHING = {
    "verdict": "no-evidence",
    "text": "The data give no sign of a missing effect.",
    "effects": [],
    "findings": [],
}
NAMELESS = {
    "verdict": "unnameable",
    "text": "Something is missing, but nothing can be named.",
    "effects": [],
    "findings": [],
}
UNMOVED = {"verdict": "not-excited", "text": "None of the effects is excited.", "effects": [], "findings": []}
LESS = {"augmented_model": None, "parameters_after": {}, "rmse_after": None, "separating_experiment": {}}


@pytest.mark.parametrize(
    ("stages", "expected"),
    [
        (
            {"fit": None, "discrepancy": None, "identifiability": None},
            {
                "verdict": "FAIL The model with its given values",
                "values": "No parameter",
                "missing": "needs parameters",
                "next": "no parameter to be determined",
            },
        ),
        (
            {"fit": None, "discrepancy": None},
            {"verdict": "FAIL The model with its given values", "next": "Step Vdcref1 from 1 to 1.05"},
        ),
        (
            {"discrepancy": None},
            {"verdict": "FAIL The fitted", "values": "Fitted; the model has no effect", "missing": "Not asked yet"},
        ),
        (
            {"discrepancy": {**NOTHING, **LESS}},
            {
                "missing": "Nothing that these recordings show. The data give no sign",
                "values": "846",
                "next": "Nothing for the values: each is known to 2 % or better.",
            },
        ),
        ({"discrepancy": {**NAMELESS, **LESS}}, {"missing": "Something without a name. Something is missing, but"}),
        ({"discrepancy": {**UNMOVED, **LESS}}, {"missing": "Not excited. None of the effects"}),
        (
            {"fit": {"status": "failed", "message": "no run came to an end"}, "discrepancy": None},
            {"verdict": "FAIL The model with its given values", "values": "The fit has no estimates"},
        ),
    ],
)
def test_results_of_other_studies_have_a_first_screen_that_makes_sense(
    like_the_demo: Path, tmp_path: Path, stages: dict[str, Any], expected: dict[str, str]
) -> None:
    folder = changed(tmp_path / "other", like_the_demo, **stages)
    whole = page(folder)
    for name, said in expected.items():
        assert said in tile(whole, name), tile(whole, name)
    assert "None" not in tile(whole, "verdict") + tile(whole, "values") + tile(whole, "next")
    assert not re.search(r"\bnan\b", words(whole))


def test_a_failed_stage_is_said_first(like_the_demo: Path, tmp_path: Path) -> None:
    failed = {"status": "failed", "message": "no run came to an end. Try: `hvdc-ident check STUDY`", "stage": "fit"}
    folder = changed(tmp_path / "failed", like_the_demo, fit=failed, discrepancy=None)
    screen = first_screen(Results(folder))
    assert screen.startswith(
        "<p class='warning'><strong>fit failed</strong>: no run came to an end. Try: <code>hvdc-ident check"
    )


def test_a_diagnosis_that_its_budget_ended_is_told_as_unfinished(like_the_demo: Path, tmp_path: Path) -> None:
    ended = {"status": "unfinished", "message": "ended by the budget of 20 s; not tried: round 1", "stage": "diagnose"}
    bare = changed(tmp_path / "bare", like_the_demo, discrepancy=None)
    folder = changed(tmp_path / "ended", bare, discrepancy=ended)
    whole = page(folder)
    assert "<strong>diagnose is unfinished</strong>: ended by the budget of 20 s" in whole
    assert "Asked, and not answered" in tile(whole, "missing")


def test_a_study_without_recordings_shows_its_sections_open(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(
        'schema = 1\n[model]\nsource = "vsc-hvdc-link"\n[linearize]\ninputs = ["Vdcref1"]\n', "utf-8"
    )
    run_stage(load_study(tmp_path / "s.toml"), "linearize", tmp_path / "r", StageOptions())
    text = page(tmp_path / "r")
    assert "data-tile" not in text and text.count("<details class='section' open>") == text.count(
        "<details class='section"
    )


def test_a_signal_that_shows_only_noise_is_not_drawn(like_the_demo: Path) -> None:
    text = page(like_the_demo)
    drawn = re.findall(r'aria-label="(\w+) in ([\w-]+): recorded', text)
    assert len(drawn) == 27 - 3 and ("Ir2", "vdc-1") not in drawn
    assert "nothing but noise: Ir2 in vdc-1, Ir2 in vdc-2 and Ir2 in vdc-3" in text
