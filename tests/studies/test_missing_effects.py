"""The studies of what is missing: other causes, the named effects' consequences, Dymola's and two other tools' waveforms."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from tests.studies.study_module import STUDIES, expected, load

sys.path.insert(0, str(STUDIES))
from common import diagnosing, ending, paper

pytestmark = pytest.mark.nightly

WHY, TOOLS, DYMOLA = load("why_table_3_is_biased"), load("two_tools_one_link"), load("dymola_missing")
needs_tools = pytest.mark.skipif(not TOOLS.DATA.exists(), reason="reference data not found beside the project: dynawo")
needs_dymola = pytest.mark.skipif(
    not DYMOLA.DATA.exists(), reason="reference data not found beside the project: Dymola"
)


def off(name, found):
    known = expected(name)
    return ending.differences(known["values"], ending.rounded(found), known["tolerance"], whole=False)


@pytest.mark.parametrize(("name", "study"), [("two_tools_one_link", TOOLS), ("dymola_missing", DYMOLA)])
def test_the_readme_shows_the_pinned_numbers(name, study):
    text = (STUDIES / name / "README.md").read_text(encoding="utf-8")
    for mark, table in study.tables(expected(name)["values"]).items():
        assert f"<!-- {mark} -->\n{table}\n<!-- end -->" in text, mark


def test_the_papers_own_numbers_have_no_distance_from_the_paper():
    by_mode = {m: {n: paper.TABLE_3[n][label] for n in paper.GAINS} for label, m in paper.MODES.items()}
    own = {
        "mean": {m: {n: row["mean"] for n, row in by.items()} for m, by in by_mode.items()},
        "std": {m: {n: row["std"] for n, row in by.items()} for m, by in by_mode.items()},
        "ratios": WHY.hypotheses.paper_ratios(),
        "figure 8": {f"{k:g}": v for k, v in WHY.hypotheses.PAPER_8.items()},
    }
    assert WHY.hypotheses.scores(own) == pytest.approx(dict.fromkeys(("means", "spreads", "ratios", "figure 8"), 0.0))
    own["mean"]["individual"]["KIP"] += 4.5  # a tenth of its range, in one of twelve
    assert WHY.hypotheses.scores(own)["means"] == pytest.approx(10.0 / np.sqrt(12.0))


def test_a_cause_gives_what_is_pinned():
    found = WHY.causes(["measurement delay"])
    assert off("why_table_3_is_biased", {"causes": found}) == []
    mean = found["measurement delay"]["mean"]["individual"]
    assert mean["KIP"] > 31 and mean["KIVDC"] > 850 and mean["KPVDC"] > 25


def test_the_gains_of_a_coarse_solver_give_the_exact_response():
    h, gains = WHY.hypotheses.COARSE, WHY.hypotheses.coarse_solver()
    steps = np.arange(1, 60)
    np.testing.assert_allclose((1 + h * gains["KIP"]) ** -steps.astype(float), np.exp(-30.0 * h * steps), rtol=1e-9)
    matrix = np.array([[0.0, 1.0], [-gains["KIVDC"] / 0.4, -gains["KPVDC"] / 0.4]])
    exact = np.array([[0.0, 1.0], [-734.7 / 0.4, -24.0 / 0.4]])
    solved = np.sort_complex(np.log(np.linalg.eigvals(np.linalg.inv(np.eye(2) - h * matrix)).astype(complex)) / h)
    np.testing.assert_allclose(solved, np.sort_complex(np.linalg.eigvals(exact)), rtol=1e-9)


def test_figure_8_follows_from_what_was_put_in():
    pinned = expected("why_table_3_is_biased")["values"]
    for signals, told in pinned["put in"].items():
        found = {signals: WHY.diagnosed.figure_8(told)}
        # The augmented link from six digits of each size: its curve follows to a little less.
        for link, line in found[signals].items():
            assert line == pytest.approx(pinned["figure 8"][signals][link], rel=1e-3), (signals, link)


def test_the_diagnosed_records_are_five_to_fit_and_three_held_out():
    for asked in WHY.diagnosed.ASKED.values():
        found = WHY.diagnosed.experiments(asked.outputs)
        assert [e.role for e in found].count("fit") == 5 and [e.role for e in found].count("holdout") == 3
        assert all(e.outputs == asked.outputs for e in found)


@needs_tools
def test_the_card_and_the_tools_differ_as_pinned():
    card = TOOLS.card()
    found = {
        "as described": {tool: TOOLS.errors(card, tool) for tool in TOOLS.TOOLS},
        "tools apart": TOOLS.apart(),
        "left out": {part: TOOLS.errors(card.with_values(v), "Eurostag") for part, v in TOOLS.LEFT_OUT.items()},
    }
    assert off("two_tools_one_link", found) == []
    without = TOOLS.errors(card.with_values(TOOLS.LEFT_OUT[TOOLS.MEASUREMENT]), "Dynawo")
    assert off("two_tools_one_link", {"Dynawo without the measurement": without}) == []
    # Eurostag measures the dc voltage through 10 ms and Dynawo does not: that is what tells them apart.
    assert without["Vdc step"]["Ip1"] < 0.2 * found["as described"]["Dynawo"]["Vdc step"]["Ip1"]
    described, left = found["as described"]["Eurostag"], found["left out"]
    worse = {
        "10 ms measurement of the dc voltage": ("Vdc step", "Ip1"),
        "droop of the ac voltage controls": ("voltage steps", "Q1"),
        "slew of the power set-point": ("P ramp", "P2"),
        "limit of the capacitors' current": ("Vdc step", "U1"),
    }
    for part, (window, output) in worse.items():
        assert left[part][window][output] > 2 * described[window][output], part


@pytest.mark.parametrize(
    ("part", "effect", "size", "described", "place"),
    [
        ("slew of the power set-point", "rate-limit", "rate", "slew", ["Pref2"]),
        ("droop of the ac voltage controls", "coupling", "k", "droop", ["eq1", "eq2"]),
    ],
)
def test_a_removed_part_is_named_with_the_described_size(part, effect, size, described, place):
    told = expected("two_tools_one_link")["values"]["named"][part]
    first = told["findings"][0]
    assert told["verdict"] == "named" and first["effect"] == effect
    low, high = sorted(abs(end) for end in first["parameters"][size]["ci95"])
    assert low < TOOLS.card().values[described] < high
    assert place in [p["at"] for p in first["places"]]


@needs_dymola
def test_dymolas_record_is_even_and_the_true_gains_leave_what_is_pinned():
    model, even, free = DYMOLA.setup()
    assert np.ptp(np.diff(even.time)) < 1e-9 and {f.name for f in free} == set(DYMOLA.TRUE)
    found = {"refits": {"true gains": {"rmse": DYMOLA.errors(model, even, DYMOLA.TRUE)}}}
    assert off("dymola_missing", found) == []


def test_what_dymolas_link_lacks_is_the_resistance_that_the_card_has_too_much():
    values = expected("dymola_missing")["values"]
    drop, late = values["told nothing"]["findings"][:2]
    both_stations = (
        2 * 0.267 / 409.6
    )  # ohm of the authors' model, which the study's Rdc has in it and the terminals do not
    (share,) = drop["parameters"].values()  # by the power, which is negative there, or by its magnitude
    low, high = sorted(abs(end) for end in share["ci95"])
    assert drop["places"][0]["at"] == ["outputs.Vdc2"] and low < both_stations < high and drop["probability"] > 0.95
    assert late["places"][0]["at"] == ["Pdc2"]
    plain, found = (values["refits"][c] for c in ("fitted", "with the findings"))
    assert found["rmse"]["Vdc2"] < 0.1 * plain["rmse"]["Vdc2"]
    for gain, true in DYMOLA.TRUE.items():
        assert found["values"][gain] == pytest.approx(true, rel=0.01), gain


@needs_dymola
def test_without_that_resistance_the_card_leaves_as_little():
    cases = expected("dymola_missing")["values"]["refits"]
    model, even, _ = DYMOLA.setup()
    assert model.values["Rdc"] == pytest.approx(DYMOLA.LINE + 2 * 0.267 / 409.6, rel=1e-9)
    size = cases["the same, and the found delay"]["sizes"]["delay_Pdc2_T"]
    late = {"effect": "delay", "at": ["Pdc2"], "from": "", "parameters": {"T": size}}
    corrected = diagnosing.augmented(model.with_values({"Rdc": DYMOLA.LINE}), [late])
    row = DYMOLA.errors(corrected, even, cases["the same, and the found delay"]["values"])
    assert off("dymola_missing", {"refits": {"the same, and the found delay": {"rmse": row}}}) == []
    assert row["Vdc2"] < 0.1 * cases["fitted"]["rmse"]["Vdc2"]


def test_an_effect_in_words():
    line = {"effect": "droop", "at": ["eq1", "eq2"], "from": "Q1", "parameters": {"k": {"value": 0.1316, "ci95": None}}}
    assert diagnosing.label(line) == "droop at eq1, eq2 from Q1 (k 0.132)"
    assert diagnosing.effects_of({"effects": []}) == "-"


def test_findings_in_a_table_each_on_its_line():
    lag = {
        "effect": "lag", "same_as": ["lag", "window-mean"], "probability": 0.97, "parameters": {
            "T": {"value": 1.46e-3, "ci95": [1.4e-3, 1.5e-3], "unit": "s"}
        },
        "places": [{"at": [p], "probability": q} for p, q in (("P2", 0.5), ("P2_m", 0.3), ("Pdc2", 0.1), ("Ir2", 0.1))],
        "equivalent_delay": {"value": 1.46e-3, "ci95": None, "unit": "s"},
    }  # fmt: skip
    loss = {
        "effect": "coupling", "same_as": ["coupling"], "probability": 1.0, "equivalent_delay": None,
        "parameters": {"k": {"value": -0.5, "ci95": None, "unit": ""}},
        "places": [{"at": ["Idc"], "probability": 1.0, "from": "P2"}],
    }  # fmt: skip
    both = {
        "verdict": "named",
        "findings": [lag, loss],
        "remainder": {"share": 0.02, "held_out": None, "noise_units": 1.1},
    }
    none = {"verdict": "no-evidence", "findings": [], "remainder": {}}
    lines = diagnosing.findings({"filters": both, "nothing": none}, "case").splitlines()
    first = (
        "| filters | named | lag or window-mean | 0.970 | T 0.00146 (0.00140 to 0.00150) | 1.46 "
        "| P2 (0.50); P2_m (0.30); Pdc2 (0.10); 1 more | 2.0 %; - | 1.10 |"
    )
    assert lines[2:] == [
        first,
        "|  |  | coupling | 1.00 | k -0.500 | - | Idc from P2 (1.0) |  |  |",
        "| nothing | no-evidence | - | - | - | - | - | - | - |",
    ]
