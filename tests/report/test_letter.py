"""The letter says what the results say, and no more."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from hvdc_ident.cli import app
from hvdc_ident.errors import InputError
from hvdc_ident.report.letter import Letterhead, _asked_of, letter_of, write_letter
from hvdc_ident.study.study import without_letter
from hvdc_ident.summary import Results
from hvdc_ident.summary.run_summary import FindingSummary, PlaceSummary
from tests.app.small_study import write_small_study
from tests.report.judgements import judgement

HEADING = {"schema": 1, "study": "s", "model": "m", "software": "hvdc_ident 0", "seed": 0, "sources": {}}


def diagnosis(**changes: Any) -> dict[str, Any]:
    lag = {
        "effect": "lag",
        "at": ["P2_m"],
        "parameters": {"T": {"value": 0.0016, "ci95": [0.0014, 0.0018], "unit": "s"}},
        "text": "P2_m follows with a lag of 1.6 ms",
        "chosen_from": 5,
    }
    gap = {
        "nominal": {"fit": {"P2": {"step": 0.02}}, "holdout": {}},
        "refitted": {"fit": {"P2": {"step": 0.004}}, "holdout": {"P2": {"ramp": 0.004}}},
        "augmented": {"fit": {"P2": {"step": 0.001}}, "holdout": {"P2": {"ramp": 0.001}}},
        "noise_floor": {"P2": 0.001},
        "pooled": {"augmented": {"holdout": 1.05}},
        "shrink_holdout": 0.75,
        "held_out": "experiments",
    }
    sizes = {
        "effect": "lag",
        "at": ["P2_m"],
        "parameter": "T",
        "unit": "s",
        "experiment": "ramp",
        "output": "P2",
        "output_unit": "pu",
        "time": [0.0, 0.1, 0.2],
        "measured": [0.0, 0.5, 1.0],
        "sizes": [None, 0.0016],
        "shares": [0.0, 1.0],
        "labels": ["without it", "T = 1.6 ms"],
        "curves": [[0.0, 0.6, 1.0], [0.0, 0.5, 1.0]],
        "chosen": 1,
    }
    return {
        **HEADING,
        "verdict": "ambiguous",
        "text": "",
        "effects": [lag],
        "ambiguity": [
            [
                {"effect": "lag", "at": ["P2_m"], "delta_bic": 0.0},
                {"effect": "delay", "at": ["P2_m"], "delta_bic": 2.0},
            ]
        ],
        "separating_experiment": {"text": "Record P2 at 1 kHz"},
        "gap": gap,
        "judgement": judgement(
            {"given": {"P2": {"step": 0.02}}, "effect": {"P2": {"step": 0.001, "ramp": 0.001}}}, {"P2": 0.001}
        ),
        "parameters_before": {"KIP": 30.0},
        "parameters_refitted": {"KIP": 31.5},
        "parameters_after": {"KIP": 30.1},
        "estimates_after": {"KIP": {"value": 30.1, "ci95": [29.8, 30.4]}},
        "augmented_model": "augmented-model.toml",
        "sizes": sizes,
        **changes,
    }


def folder_with(path: Path, found: dict[str, Any]) -> Path:
    path.mkdir(exist_ok=True)
    (path / "discrepancy.json").write_text(json.dumps(found))
    (path / "simulation.json").write_text(json.dumps({**HEADING, "units": {"P2": "pu"}}))
    rows = "".join(f"{t:g},{0.9 * t:g},{t:g}\n" for t in np.linspace(0, 0.1, 5))
    (path / "simulation.step.csv").write_text("time,P2,P2.measured\n" + rows)
    return path


def test_every_sentence_of_an_ambiguous_case(tmp_path: Path) -> None:
    (tmp_path / "augmented-model.toml").touch()
    letter = letter_of(Results(folder_with(tmp_path, diagnosis())))
    missed, consistent, gains, gained = letter.sentences
    assert missed == (
        "With the values it came with, your model misses 1 of 1 recorded signals, most of all P2 in experiment 'step': its RMSE "
        "there is 0.02 pu, 20 times the noise of the recording."
    )
    assert "lag of 1.6 ms" in consistent and "1.4 and 1.8 ms" in consistent and "delay at P2_m" in consistent
    assert gains == (
        "Your value of KIP lies within its 95 % interval. A fit without the effect moves KIP "
        "by +5.0 % to make up for it; with the effect the same fit moves it by +0.3 %."
    )
    assert "75.0 %" in gained and "1.1 times the noise" in gained
    assert letter.following == "To tell them apart: record P2 at 1 kHz."
    assert letter.attached == ("augmented-model.toml",)


def test_what_was_put_in_is_no_rival_of_itself_wherever_it_stands_in_the_set(tmp_path: Path) -> None:
    rivals = [{"effect": n, "at": ["P2_m"], "delta_bic": d} for n, d in (("delay", 0.0), ("lag", 2.0))]
    found = diagnosis(ambiguity=[rivals], remaining={"adequate": False}, beyond_noise=True)
    _, consistent, *_ = letter_of(Results(folder_with(tmp_path, found))).sentences
    assert "cannot tell it from: delay at P2_m. It is not all that is missing" in consistent
    alone = diagnosis(ambiguity=[rivals[1:]], remaining={"adequate": True})
    _, consistent, *_ = letter_of(Results(folder_with(tmp_path, alone))).sentences
    assert "No other effect that was tried" in consistent and "not all" not in consistent
    doubted = diagnosis(ambiguity=[rivals[1:]], remaining={"adequate": True}, doubt="the first rows are loud")
    _, consistent, *_ = letter_of(Results(folder_with(tmp_path, doubted))).sentences
    assert "none of those tried is: the first rows are loud." in consistent and "No other effect" not in consistent
    several = diagnosis(
        ambiguity=[],
        remaining={"adequate": False},
        effects=2 * diagnosis()["effects"],
        doubt="it hums",
        beyond_noise=True,
    )
    _, consistent, *_ = letter_of(Results(folder_with(tmp_path, several))).sentences
    assert consistent.endswith("none of those tried is: it hums. It is not all that is missing.")


def test_a_rival_outside_the_catalogue_is_told_with_its_formula(tmp_path: Path) -> None:
    rivals = [
        {"effect": "lag", "at": ["P2_m"], "delta_bic": 0.0},
        {"effect": "term", "at": ["P2_m"], "delta_bic": 1.0, "expression": "k1*P2**3"},
    ]
    _, consistent, *_ = letter_of(Results(folder_with(tmp_path, diagnosis(ambiguity=[rivals])))).sentences
    assert "cannot tell it from: term k1*P2**3 at P2_m." in consistent


def test_what_the_members_of_a_set_have_in_common_is_said(tmp_path: Path) -> None:
    rivals = [
        {"effect": n, "at": ["P2_m"], "delta_bic": 0.0, "parameters": {"T": late}}
        for n, late in (("lag", 0.0016), ("delay", 0.0014))
    ]
    _, consistent, *_ = letter_of(Results(folder_with(tmp_path, diagnosis(ambiguity=[rivals])))).sentences
    assert "Whichever it is, a slow signal is late by between 1.4 and 1.6 ms." in consistent
    other = {"effect": "gain", "at": ["P2_m"], "delta_bic": 1.0}
    _, consistent, *_ = letter_of(Results(folder_with(tmp_path, diagnosis(ambiguity=[[*rivals, other]])))).sentences
    assert "Whichever" not in consistent


def test_without_evidence_nothing_is_named_and_the_move_of_the_values_is_told(tmp_path: Path) -> None:
    found = diagnosis(verdict="no-evidence", effects=[], ambiguity=[], text="Nothing stands out.", sizes=None)
    letter = letter_of(Results(folder_with(tmp_path, found)))
    told = " ".join(letter.sentences)
    assert "nothing is missing" in told and "A fit moves KIP by +5.0 %." in told
    assert "lag" not in told and "shrinks" not in told


def test_values_are_not_judged_while_something_without_a_name_is_missing(tmp_path: Path) -> None:
    found = diagnosis(verdict="unnameable", effects=[], ambiguity=[], text="Something is missing.", sizes=None)
    told = " ".join(letter_of(Results(folder_with(tmp_path, found))).sentences)
    assert (
        "Your values cannot be judged while that is missing: a fit moves KIP by +5.0 %" in told
        and "interval" not in told
    )


@pytest.mark.parametrize(("kind", "word"), [("term", "formula"), ("curve", "curve")])
def test_a_law_that_was_found_counts_as_an_effect_does_where_it_is_in_the_model(
    tmp_path: Path, kind: str, word: str
) -> None:
    found = diagnosis(verdict="unnameable", effects=[], ambiguity=[], text="A law does.", sizes=None)
    told = " ".join(letter_of(Results(folder_with(tmp_path, {**found, "fallback": {"kind": kind}}))).sentences)
    assert f"A fit without the {word} moves KIP by +5.0 %" in told and "cannot be judged" not in told
    assert "Adding it shrinks the error on" in told
    less = {**found, "fallback": {"kind": kind}, "augmented_model": None}
    told = " ".join(letter_of(Results(folder_with(tmp_path, less))).sentences)
    assert "cannot be judged" in told and "shrinks" not in told


def test_without_a_diagnosis_there_is_no_letter(tmp_path: Path) -> None:
    folder = folder_with(tmp_path, diagnosis())
    (folder / "discrepancy.json").unlink()
    with pytest.raises(InputError, match="hvdc-ident diagnose"):
        write_letter(folder)


def test_the_owner_is_asked_for_what_an_owner_knows(tmp_path: Path) -> None:
    places = [{"at": ["P2_m"], "probability": 0.7}, {"at": ["Q2_m"], "probability": 0.3}]
    lag = {"effect": "lag", "same_as": ["lag"], "probability": 1.0, "text": "", "places": places}
    lag["parameters"] = {"T": {"value": 0.0016, "ci95": None, "unit": "s"}}
    off = {"effect": "parameter", "same_as": ["parameter"], "probability": 1.0, "text": "", "places": []}
    off["parameters"] = {"D": {"value": 1.2, "ci95": None, "unit": ""}}
    asked = letter_of(Results(folder_with(tmp_path, diagnosis(findings=[lag, off])))).request
    assert asked == (
        "Please confirm the time constant of the filter or transducer at P2_m or Q2_m, which the model leaves out (here T = 1.6 ms); "
        "and the values that the recordings ask for: D = 1.2."
    )
    nameless = diagnosis(verdict="unnameable", effects=[], ambiguity=[], augmented_model=None)
    assert "filters, limits and delays" in letter_of(Results(folder_with(tmp_path, nameless))).request
    fitted = diagnosis(verdict="no-evidence", effects=[], ambiguity=[], augmented_model=None)
    folder = folder_with(tmp_path, fitted)
    candidates = {"KIP": {"given": 30.0, "start": 30.0, "min": None, "max": None, "unit": "pu/s"}}
    fit = {"status": "converged", "fitted": ["KIP"], "candidates": candidates, "values": {"KIP": 31.5}, "estimates": {}}
    (folder / "fit.json").write_text(json.dumps({**HEADING, **fit}))
    assert letter_of(Results(folder)).request == "Please confirm the value of KIP: see the table."


def test_a_letter_says_who_writes_to_whom_about_what(tmp_path: Path) -> None:
    head = Letterhead("A. Engineer <TSO>", "Converter Works", "Link North", "3.2", "2026-11-25")
    page = write_letter(folder_with(tmp_path, diagnosis()), head).read_text("utf-8")
    assert "<dt>From</dt><dd>A. Engineer &lt;TSO&gt;</dd>" in page and "2026-11-25" in page
    assert "<dt>Model</dt><dd>m version 3.2</dd>" in page and "<dt>Plant</dt><dd>Link North</dd>" in page
    assert "<dt>To</dt>" not in write_letter(tmp_path, Letterhead(author="A.")).read_text("utf-8")
    row = re.search(r"<td>KIP</td>(.*?)</tr>", page)
    assert row is not None and re.findall(r"<td[^>]*>(.*?)</td>", row[1]) == ["30", "30.10", "29.80 to 30.40"]


@pytest.mark.parametrize(
    "table", ["", "[letter]\nauthor = 'A'\n", "# it\n [letter] # to whom\nto = 'B'\n[fit]\n", "[letter]\n\n[[x]]\n"]
)
def test_no_result_rests_on_the_addressee(table: str) -> None:
    study = "schema = 1\nname = 's'\n"
    kept = without_letter((study + table).encode()).decode()
    assert kept.startswith(study) and "letter" not in kept and "author" not in kept and "to =" not in kept
    assert ("[fit]" in kept) == ("[fit]" in table) and ("[[x]]" in kept) == ("[[x]]" in table)


def tied(**changes: Any) -> dict[str, Any]:
    """A diagnosis whose lag may be behind the output or inside the loop, with another value of a parameter in each case."""
    places, values = [], []
    for at, size, value in (("P2_m", 0.3, 0.1), ("a", 0.075, 0.4)):
        own = {"Ta": {"value": value, "ci95": None, "unit": "s"}, "KIP": {"value": 30.1, "ci95": None, "unit": ""}}
        sizes = {"T": {"value": size, "ci95": None, "unit": "s"}}
        places.append({"at": [at], "probability": 0.5, "effect": "lag", "parameters": sizes, "values": own})
        values.append({"value": value, "ci95": None, "unit": "s", "effect": "lag", "at": [at]})
    finding = {"effect": "lag", "same_as": ["lag"], "probability": 1.0, "parameters": places[0]["parameters"]}
    return diagnosis(
        findings=[{**finding, "places": places, "text": "P2_m lags, where Ta is 0.1 s; or a."}],
        values_by_place={"Ta": values},
        parameters_before={"Ta": 0.1, "KIP": 30.0},
        parameters_refitted={"Ta": 0.408, "KIP": 31.5},
        parameters_after={"Ta": 0.1, "KIP": 30.1},
        **changes,
    )


def test_a_value_that_depends_on_the_place_is_told_by_place_and_blames_nobody(tmp_path: Path) -> None:
    folder = folder_with(tmp_path, tied())
    letter = letter_of(Results(folder))
    told = " ".join(letter.sentences)
    assert "Ta is 0.1 s if the lag is at P2_m, 0.4 s if it is at a." in told and "depends on which of these" in told
    assert "moves Ta" not in told and "without the effect moves KIP by +5.0 %" in told
    assert "at P2_m (then T = 0.3 s and Ta = 0.1 s) or a (then T = 75 ms and Ta = 0.4 s)" in letter.request
    table = re.sub(r"<[^>]+>", " ", write_letter(folder).read_text("utf-8"))
    assert re.search(r"Ta\s+0\.1\s+0\.1 s if the lag is at P2_m, 0\.4 s if it is at a\s", table)


def test_where_an_effect_does_what_a_value_does_the_value_is_not_blamed(tmp_path: Path) -> None:
    other = {"effect": "gain", "at": ["P2"], "text": "P2 is 1.05 times what the model has", "values": {"KIP": 30.0}}
    other |= {"delta_bic": 0.0, "parameters": {}}
    kip = {"value": 31.5, "ci95": None, "unit": ""}
    finding = {"effect": "parameter", "probability": 1.0, "parameters": {"KIP": kip}, "places": []}
    found = diagnosis(
        verdict="no-evidence",
        effects=[],
        ambiguity=[],
        text="No effect is needed: KIP is 31.5.",
        findings=[finding],
        stand_ins=[other],
        sizes=None,
    )
    letter = letter_of(Results(folder_with(tmp_path, found)))
    told = " ".join(letter.sentences)
    assert "nothing is missing" not in told and "Your gains are to blame" not in told
    assert (
        "A fit moves KIP by +5.0 %. An effect that your model leaves out explains them as well, with the values that you gave."
        in told
    )
    assert letter.request.endswith("KIP = 31.5 or that P2 is 1.05 times what the model has.")


def test_after_a_diagnosis_alone_the_letter_shows_before_and_after(tmp_path: Path) -> None:
    """Of a plant whose k lies beyond the bound of the study, and which is late by a lag that three places explain."""
    study = write_small_study(tmp_path)
    study.write_text(study.read_text().replace("k = {min = 0.5, max = 20}", "k = {min = 0.5, max = 4.2}"))
    outputs = []
    for command in ("diagnose", "letter"):
        result = CliRunner().invoke(app, [command, str(study)])
        assert result.exit_code == 0, result.output
        outputs.append(result.output)
    assert re.search(r"^k +1/s ", outputs[0], re.MULTILINE), "with its unit"
    page = (tmp_path / "study-results" / "letter.html").read_text("utf-8")
    assert "recorded and simulated (given values and with the effect)" in page
    assert "at its bound" in page and "What would show more: lag: a step" in page


@pytest.mark.parametrize(("count", "said"), [(1, "x0"), (3, "x0 or x1 or x2"), (5, "x0 or x1 or one of 3 more places")])
def test_no_place_is_counted_that_could_be_named(count: int, said: str) -> None:
    places = tuple(PlaceSummary((f"x{k}",), 1.0 / count) for k in range(count))
    finding = FindingSummary("lag", (), "", 1.0, {}, places)
    assert _asked_of(finding) == f"the time constant of the filter or transducer at {said}"
