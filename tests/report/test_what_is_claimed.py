"""No page claims more than was judged, and all pages of one run say the same."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hvdc_ident.fit.judgement import Count
from hvdc_ident.report.first_screen import first_screen
from hvdc_ident.report.html import estimate, number
from hvdc_ident.report.letter import letter_of, write_letter
from hvdc_ident.report.page import page
from hvdc_ident.report.sections.output_errors import SECTION as ERRORS
from hvdc_ident.summary import Results, summarise
from hvdc_ident.summary.screen import lines_of
from hvdc_ident.summary.tables import values_table
from hvdc_ident.text import figures, interval_text, span, times_text
from tests.report.judgements import judgement
from tests.report.test_first_screen import tile, words
from tests.report.test_letter import HEADING

LIMITS = {"max": 0.05, "mean": 0.02, "mean_absolute": 0.03}
IN_KV = "the limits are in pu, the output is in kV"


OFF = {"gate": 0.001, "Ut": 4.0}
NOISE = {"gate": 0.001, "Ut": 0.02}


def judged(
    off: Mapping[str, float] = OFF,
    noise: Mapping[str, float | None] = NOISE,
    units: Mapping[str, str] | None = None,
    **more: Any,
) -> dict[str, Any]:
    """The judgement as a stage writes it, of outputs with an error each, with the given values and with the effect; limits hold for pu."""
    windows: dict[str, Any] = {}
    for output, high in off.items():
        limited = {"gate": "pu", "Ut": "kV", **(units or {})}[output] == "pu"
        within = high <= LIMITS["max"] if limited else None
        one = {"from": 0.0, "to": 0.4, "n": 40, "limits": LIMITS if limited else None, "within": within}
        one |= {"max": high, "mean": 0.0, "mean_absolute": 0.0}
        about = {"event": 0.5, "end": 0.6, "end_from": "inputs", "within": within, "reason": "" if limited else IN_KV}
        windows[output] = about | dict.fromkeys(("before", "during", "after"), one)
    after = {o: {"jump": n or 1e-3} for o, n in noise.items() if o in off}
    sets = {"given": {o: {"jump": v} for o, v in off.items()}, "effect": after, "fitted": {}}
    return judgement(sets, noise, windows, **more)


def hydro(folder: Path, **stages: Mapping[str, Any] | None) -> Results:
    """Results of a governor: gate in pu and terminal voltage in kV, recorded once; stages as they are changed, or left out."""
    folder.mkdir(exist_ok=True)
    units = {"gate": "pu", "Ut": "kV"}
    noise = {o: {"std": s, "source": "given", "by_row": False} for o, s in NOISE.items()}
    simulation = {
        "units": units,
        "experiments": {"jump": {"role": "fit", "event": 0.5, "window": None}},
        "noise": {"jump": noise},
        "rmse": {o: {"jump": v} for o, v in OFF.items()},
        "judgement": judged(),
        "candidates": {n: {"given": g, "min": 0.01, "max": 9.0, "unit": u} for n, g, u in (("Tg", 0.2, "s"), ("Kd", 1.5, ""))},
    }  # fmt: skip
    for name, data in {"simulation": simulation, **stages}.items():
        if data is not None:
            base = simulation if name == "simulation" else {}
            (folder / f"{name}.json").write_text(json.dumps({**HEADING, **base, **data}), "utf-8")
    t = np.linspace(0.0, 1.0, 50)
    table = np.column_stack([t, t, t, 10.0 + t, 14.0 + t])
    header = "time,gate,gate.measured,Ut,Ut.measured"
    np.savetxt(folder / "simulation.jump.csv", table, "%.6g", ",", header=header, comments="")
    return Results(folder)


def lagging(**changes: Any) -> dict[str, Any]:
    """A diagnosis of the governor: a lag at the gate; with it Tg is the given one, and Kd is 2.4 where 1.5 was given."""
    size = {"T": {"value": 0.018, "ci95": [0.01799, 0.01801], "unit": "s"}}
    lag = {
        "effect": "lag",
        "at": ["gate"],
        "parameters": size,
        "text": "gate follows with a lag of 18 ms",
        "chosen_from": 3,
    }
    place = {"at": ["gate"], "probability": 1.0}
    found = {
        "effect": "lag",
        "same_as": ["lag"],
        "probability": 1.0,
        "parameters": size,
        "places": [place],
        "text": "A lag.",
    }
    return {
        "verdict": "named",
        "text": "A lag.",
        "effects": [lag],
        "findings": [found],
        "ambiguity": [],
        "remaining": {"adequate": True, "material": False},
        "remainder": {"share": 0.0, "p": 0.4, "held_out": 0.0, "at": "Ut", "below_tolerance": True},
        "beyond_noise": False,
        "gap": {"noise_floor": {"gate": 0.001, "Ut": 0.02}, "pooled": {}, "shrink_holdout": None},
        "parameters_before": {"Tg": 0.2, "Kd": 1.5},
        "parameters_refitted": {"Tg": 0.5, "Kd": 1.9},
        "parameters_after": {"Tg": 0.201, "Kd": 2.4},
        "estimates_after": {"Tg": {"value": 0.201, "ci95": [0.199, 0.203]}, "Kd": {"value": 2.4, "ci95": [2.39, 2.41]}},
        "augmented_model": "augmented-model.toml",
        "judgement": judged(),
        **changes,
    }  # fmt: skip


def told(results: Results) -> str:
    """The letter's sentences and its request."""
    letter = letter_of(results)
    return " ".join([*letter.sentences, letter.request])


def test_a_signal_without_limits_has_not_passed_the_windows(tmp_path: Path) -> None:
    results = hydro(tmp_path, discrepancy=lagging())
    given = results.summary.sets["given"]
    assert given.in_limits == Count(passed=1, failed=0, not_judged=1)
    verdict = tile(first_screen(results), "verdict")
    assert "PASS 1, not judged 1" in verdict and f"1 signal not judged: Ut ({IN_KV})" in verdict
    letter = told(results)
    assert (
        f"In 1 signal it is less than the windows of IEC 61400-27-2:2020 allow; 1 signal not judged: Ut ({IN_KV})."
        in letter
    )
    assert "every signal" not in letter and "every recorded signal" not in letter
    section = words(ERRORS.render(results))
    assert "3 windows within the limits, 0 with an error above its limit, 3 not judged" in section
    assert "3 windows not judged" in section and IN_KV in section


def test_a_named_profile_that_judges_only_some_signals_gives_no_pass(tmp_path: Path) -> None:
    results = hydro(tmp_path, simulation={"judgement": judged(named=True)})
    assert results.summary.verdict == "not judged"
    verdict = tile(first_screen(results), "verdict")
    assert f"keeps the tolerance in the 1 signal that is judged; 1 signal not judged: Ut ({IN_KV})" in verdict
    assert not verdict.split("?")[1].strip().startswith("PASS")
    none = {"judgement": judged({"Ut": 4.0}, {}, named=True), "noise": {}}
    results = hydro(tmp_path, simulation=none, discrepancy=lagging(gap={}))
    assert "is not judged: neither the noise of the recordings nor a tolerance is known" in tile(
        first_screen(results), "verdict"
    )
    assert "cannot be judged" in told(results) and "misses" not in told(results)


def test_a_signal_of_unknown_noise_is_not_followed_to_it(tmp_path: Path) -> None:
    known = {"jump": {"gate": {"std": 0.001, "source": "given"}, "Ut": {"std": 0.0, "source": "residual"}}}
    unknown = judged(noise={"gate": 0.001, "Ut": None})
    results = hydro(tmp_path, simulation={"noise": known, "judgement": unknown}, discrepancy=lagging(gap={}))
    assert results.summary.verdict == "not judged"
    assert "follows the 1 signal that is judged to the noise; 1 signal not judged: state the noise of Ut" in tile(
        first_screen(results), "verdict"
    )
    assert "your model follows 1 recorded signal to its noise; 1 signal not judged: state the noise of Ut." in told(
        results
    )


def test_the_letter_judges_each_value_by_the_interval_that_counts(tmp_path: Path) -> None:
    """Tg is moved most without the effect and right with it; Kd is wrong with it, and is the one to be told."""
    letter = told(hydro(tmp_path, discrepancy=lagging()))
    assert (
        "With the effect, the recordings ask for other values than you gave: Kd = 2.400 (95 %: 2.390 to 2.410) in place of 1.5 (+60.0 %)."
        in letter
    )
    assert "Your value of Tg lies within its 95 % interval." in letter
    assert (
        "A fit without the effect moves Tg by +150.0 % to make up for it; with the effect the same fit moves it by +0.5 %."
        in letter
    )
    assert "and the value Kd = 2.400 in place of 1.5." in letter
    assert "not to blame" not in letter and "gain" not in letter


def test_without_an_effect_the_values_of_the_fit_are_judged(tmp_path: Path) -> None:
    text = "The data give no sign of a missing effect: its score is what noise gives somewhere (p = 0.31)."
    nothing = lagging(verdict="no-evidence", effects=[], findings=[], augmented_model=None, text=text)
    fit = {"status": "converged", "fitted": ["Tg", "Kd"], "values": {"Tg": 0.2, "Kd": 2.4}, "held": {}}
    fit["estimates"] = {"Tg": {"value": 0.2, "ci95": [0.19, 0.21]}, "Kd": {"value": 2.4, "ci95": [2.3, 2.5]}}
    letter = told(hydro(tmp_path, fit=fit, discrepancy=nothing))
    assert "other values than you gave: Kd = 2.40 (95 %: 2.30 to 2.50) in place of 1.5 (+60.0 %)." in letter
    assert "Your value of Tg lies within its 95 % interval." in letter
    assert "nothing is missing" in letter and "p = " not in letter and "score" not in letter


def test_an_optimum_of_one_start_alone_is_doubted_on_every_page(tmp_path: Path) -> None:
    doubt = "one start of 8 alone reached the lowest cost, 27.8 (7 ended at 5 higher costs from 113 to 5760)"
    fit = {"status": "converged", "message": f"{doubt}; 1 of 8 runs reached this optimum", "search_doubt": doubt}
    fit |= {
        "fitted": ["Tg"],
        "values": {"Tg": 0.2},
        "held": {},
        "estimates": {"Tg": {"value": 0.2, "ci95": [0.19, 0.21]}},
    }
    nothing = lagging(
        verdict="no-evidence", effects=[], findings=[], augmented_model=None, text="No sign of an effect."
    )
    results = hydro(tmp_path, fit=fit, discrepancy=nothing)
    assert f"They may not be the best there are: {doubt}." in tile(first_screen(results), "values")
    page_of_letter = write_letter(tmp_path).read_text(encoding="utf-8")
    assert f"The fitted values may not be the best there are: {doubt}." in words(page_of_letter)


MORE = {
    "remaining": {"adequate": False, "material": True},
    "remainder": {"share": 0.02, "p": 0.01, "held_out": 0.0, "at": "Ut", "below_tolerance": True},
    "beyond_noise": True,
}


def test_intervals_of_a_model_that_leaves_more_than_noise_claim_no_chance(tmp_path: Path) -> None:
    """The two intervals miss what the recordings were made with, 0.21 s and 2.5, as those of a wrong model do."""
    true = {"plant": "hydro", "lacking": [], "delays": []}
    true["parameters"] = {"Tg": {"value": 0.21, "unit": "s"}, "Kd": {"value": 2.5, "unit": ""}}
    fit = {"status": "converged", "fitted": ["Tg", "Kd"], "values": {"Tg": 0.5, "Kd": 1.9}, "held": {}}
    fit["estimates"] = {"Tg": {"value": 0.5, "ci95": [0.4, 0.6]}, "Kd": {"value": 1.9, "ci95": [1.8, 2.0]}}
    fit |= {
        "adequacy": {"verdict": "does-not-fit", "text": "it is off"},
        "candidates": {n: {"given": g, "unit": u} for n, g, u in (("Tg", 0.2, "s"), ("Kd", 1.5, ""))},
    }
    results = hydro(tmp_path, fit=fit, discrepancy=lagging(**MORE), truth=true)
    whole = words(page(tmp_path))
    for part in ("values", "verdict"):
        assert "95 %" not in tile(page(tmp_path), part)
    assert "They hold only if nothing else is missing" in tile(page(tmp_path), "values")
    assert (
        "interval if nothing else is missing" in whole and "these are the values that count, if nothing else" in whole
    )
    assert "With the effect: They hold only if nothing else is missing" in whole  # beside the truth
    letter = words(write_letter(tmp_path).read_text("utf-8"))
    assert "95 %" not in letter and "The values hold only if nothing else is missing" in letter
    assert "Kd = 2.400 in place of 1.5 (+60.0 %)" in letter and "That holds only if nothing else is missing." in letter
    assert "interval if nothing else is missing, with the effect" in values_table(results.summary).header
    sure = summarise({"fit": {**fit, "adequacy": {"verdict": "fits"}}})
    assert "95 % interval" in values_table(sure).header


@pytest.mark.parametrize(
    ("changes", "left"),
    [
        ({}, False),
        (MORE, True),
        ({**MORE, "remainder": {"share": 0.2, "p": 0.01, "at": "Ut", "below_tolerance": False}}, True),
        ({**MORE, "doubt": "2 % of the gap is left"}, True),
        ({"remaining": {"adequate": False, "material": False}}, False),  # no louder than noise, of another colour
        ({"beyond_noise": None}, False),
    ],
)
def test_tile_and_letter_say_together_whether_it_is_all(tmp_path: Path, changes: dict[str, Any], left: bool) -> None:
    found = {k: v for k, v in lagging(**changes).items() if v is not None}
    results = hydro(tmp_path, discrepancy=found)
    assert results.summary.remainder.more_than_noise is left
    assert ("Not all of it" in tile(first_screen(results), "missing")) is left
    assert ("It is not all that is missing" in told(results)) is left
    assert ("hold only if nothing else" in first_screen(results)) is left


def test_a_value_on_its_bound_says_so(tmp_path: Path) -> None:
    fit = {"status": "at-bound", "fitted": ["Kd"], "values": {"Kd": 2.4, "Tg": 0.01}, "held": {"Tg": "at-bound: ..."}}
    fit["estimates"] = {
        "Tg": {"value": 0.01, "ci95": [0.01, 0.04], "method": "one-sided"},
        "Kd": {"value": 2.4, "ci95": [2.3, 2.5]},
    }
    held = {**lagging(), "verdict": "no-evidence", "effects": [], "findings": [], "augmented_model": None}
    results = hydro(tmp_path, fit=fit, discrepancy=held)
    row = re.search(r"<td>Tg</td>(.*?)</tr>", write_letter(tmp_path).read_text("utf-8"))
    assert row is not None and "0.010 to 0.040 at its bound" in words(row[1])
    assert "at its bound" in tile(first_screen(results), "values")
    also = hydro(tmp_path, fit={**fit, "fitted": [], "held": {"Kd": "insensitive: no output moves", "Tg": "at-bound"}})
    row = re.search(r"<td>Kd</td>(.*?)</tr>", write_letter(tmp_path).read_text("utf-8"))
    assert row is not None and "held, insensitive" in row[1] and also.get("fit")


def test_a_place_is_asked_for_once(tmp_path: Path) -> None:
    places = [{"at": ["gate"], "from": f"u{k}", "probability": p} for k, p in ((1, 0.6), (2, 0.4))]
    twice = [{"at": ["gate"], "probability": 0.5}, {"at": ["gate"], "probability": 0.5}]
    found = lagging()
    (one,) = found["findings"]
    letter = told(hydro(tmp_path, discrepancy={**found, "findings": [{**one, "places": twice}]}))
    assert "transducer at gate, which" in letter
    results = hydro(tmp_path, discrepancy={**found, "findings": [{**one, "places": places}]})
    assert "transducer at gate from u1 or gate from u2, which" in told(results)
    assert "gate from u1 (60 %); gate from u2 (40 %)" in tile(first_screen(results), "missing")


def test_a_letter_after_a_diagnosis_alone_names_the_curves_that_it_draws(tmp_path: Path) -> None:
    hydro(tmp_path, discrepancy=lagging())
    for file in ("simulation.json", "simulation.jump.csv"):
        (tmp_path / file).rename(tmp_path / file.replace("simulation", "discrepancy")) if file.endswith("csv") else (
            tmp_path / file
        ).unlink()
    letter = words(write_letter(tmp_path).read_text("utf-8"))
    assert "recorded and simulated (with the effect)" in letter and "before and after" not in letter


@pytest.mark.parametrize(
    ("low", "high", "unit", "said"),
    [
        (0.01799, 0.01801, "s", "17.99 and 18.01 ms"),
        (0.0179999, 0.0180001, "s", "17.9999 and 18.0001 ms"),
        (1.49996, 1.50004, "pu", "1.49996 and 1.50004 pu"),
        (14200.0, 15800.0, "kW", "14200 and 15800 kW"),
        (-0.5, 1.5, "", "-0.5 and 1.5"),
    ],
)
def test_the_ends_of_an_interval_never_look_the_same(low: float, high: float, unit: str, said: str) -> None:
    assert span(low, high, unit) == said
    first, last = interval_text((low, high)).split(" to ")
    assert float(first) < float(last) and float(first) == pytest.approx(low) and float(last) == pytest.approx(high)
    _, shown = estimate(0.5 * (low + high), (low, high))
    first, last = (float(e.replace("−", "-")) for e in shown.split(" to "))
    assert first < last and first == pytest.approx(low, abs=0.1 * (high - low))


def test_a_hundred_and_fifty_has_no_exponent() -> None:
    assert figures(153.2, 2) == "153" and figures(99.7, 2) == "100" and figures(1.25e5) == "125000"
    assert figures(2.5e6) == "2.5e+06" and figures(0.0001234, 2) == "0.00012"
    assert times_text(153.2) == "153 times" and times_text(99.7) == "100 times" and times_text(1030.0) == "1,030 times"
    assert number(1486.2, 3) == "1486" and number(2.5e6, 2) == "2.5·10<sup>6</sup>"


def test_the_screen_of_a_run_says_what_its_values_rest_on(tmp_path: Path) -> None:
    condition = "The values with the effect hold only if nothing else is missing: what remains is more than the noise."
    for found, holds in ((lagging(**MORE), True), (lagging(), False)):
        summary = hydro(tmp_path, discrepancy=found).summary
        assert (condition in lines_of(summary)) is holds


def test_values_are_conditional_by_what_remains_where_it_remains(tmp_path: Path) -> None:
    """Noise remains of the fitted recordings, and more of the held-out one: "more than the noise" of all would contradict the diagnosis."""
    left = {
        "share": 0.0,
        "p": 0.2,
        "held_out": 0.06,
        "record": "dip",
        "record_units": 1.2,
        "at": "Ut",
        "below_tolerance": False,
    }
    lines = lines_of(hydro(tmp_path, discrepancy=lagging(**(MORE | {"remainder": left}))).summary)
    said = "hold only if nothing else is missing: in the held-out recording dip more than the noise remains."
    assert any(line.endswith(said) for line in lines)
