"""The part `value` of the study of hidden effects: the card states one value plainly wrong, and how its diagnosis is judged."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import asdict

import numpy as np
import pytest

from hvdc_ident import linearize
from hvdc_ident import simulate as package
from hvdc_ident.errors import StudyError
from tests.studies.study_module import STUDIES, load

sys.path.insert(0, str(STUDIES / "hidden_effects"))

from hidden import cases, diagnosing, judging, mess, outcomes, sizes, values
from hidden.diagnosing import experiments_of, free_of, model_of
from hidden.plants import PLANTS
from hidden.reporting import report
from hidden.simulator import simulate

pytestmark = pytest.mark.nightly

STUDY = load("hidden_effects")


def design(plant, size=10.0, number=0, messy=False):
    return cases.Design("value", number, plant, (), size, "white", "small", False, True, 0.01, 1, messy)


@pytest.fixture(scope="module", params=["drive", "machine", "hydro"])
def wrong(request):
    case = cases.made(design(request.param), 3)
    assert case is not None and case.value is not None
    return case


def test_a_case_is_drawn_by_its_seed(wrong):
    again = cases.made(wrong.design, 3)
    assert again is not None and again.value == wrong.value and again.given == wrong.given
    np.testing.assert_array_equal(again.records, wrong.records)
    plant = PLANTS[wrong.design.plant]
    others = [values.drawn(plant, np.random.default_rng(seed)) for seed in range(200)]
    assert {v.name for v in others} == set(plant.parameters) - set(plant.fitted), "any of them"
    factors = np.log([v.true / v.stated for v in others])
    assert (factors > 0).any() and (factors < 0).any(), "either way"
    assert (np.abs(factors) > np.log(1.25) - 1e-12).all() and (np.abs(factors) < np.log(3) + 1e-12).all()


def test_the_card_states_what_is_wrong_and_all_else_is_as_in_other_cases(wrong):
    value, plant, model = wrong.value, PLANTS[wrong.design.plant], model_of(wrong.design.plant)
    assert model.parameters[value.name].value == value.stated != value.true
    assert value.name not in plant.fitted and not wrong.hidden and wrong.truth == []
    assert set(wrong.given) == set(plant.fitted)
    assert all(f.min < plant.parameters[f.name] < f.max for f in free_of(wrong))


def test_the_records_are_those_of_the_true_value_and_what_is_stated_does_not_explain_them(wrong):
    """By the package, which does not know how they were made; the size is what a refit leaves of it."""
    model, channels = model_of(wrong.design.plant), list(wrong.channels)
    base = sizes.nominal(wrong.design.plant, "small", 1)
    truly = model.with_values({wrong.value.name: wrong.value.true})
    for k, e in enumerate(experiments_of(wrong)):
        of_truth, of_card = (package(m, e, outputs=e.outputs).trajectory.values for m in (truly, model))
        mine, extent = wrong.clean[:, k][:, channels], np.ptp(base.outputs, axis=(0, 1))[channels]
        assert (np.abs(of_truth - mine) < 3e-4 * extent).all()
        assert (np.abs(of_card - mine) > 3e-3 * extent).any()
    size = sizes.units(base, wrong.clean[:, :2, None], wrong.sigma, "white", wrong.channels)[0]
    assert wrong.units == size >= wrong.design.size
    assert 1 <= wrong.tries <= cases.TRIES


def test_a_value_is_drawn_again_until_it_is_excited_enough_and_given_up_in_the_end():
    base = sizes.nominal("drive", "small", 1)
    sigma = 0.01 * np.ptp(base.outputs[:, :2], axis=(0, 1))

    def found(wanted, tries):
        return values.misstated(base, wanted, sigma, "white", (0, 1, 2), np.random.default_rng(0), tries)

    (first, _, size, draws), again = found(0.0, 1), found(0.0, 9)
    assert draws == 1 and again is not None and again[0] == first
    assert found(1.001 * size, 1) is None
    second = found(1.001 * size, 9)
    assert second is not None and second[0] != first and second[2] > 1.001 * size and second[3] > 1


def test_the_mess_is_that_of_a_plant_with_the_true_value():
    base, plant = sizes.nominal("drive", "small", 1), PLANTS["drive"]
    extent = np.ptp(base.outputs[:, :2], axis=(0, 1))
    runs = values.Value("k", 0.7, 0.5).truly(base.runs)
    with_it, without = (mess.recorded(plant, r, [], extent, [1, 2, 3]) for r in (runs, base.runs))
    answer = simulate(plant, runs) - base.outputs
    # In most rows: near a jump, time stamps that are off and the filter change what jumps.
    off = np.median(np.abs(with_it - without - answer), axis=(0, 1))
    assert (off < 0.02 * np.abs(answer).max(axis=(0, 1))).all()


@pytest.mark.parametrize(
    ("plant", "moved", "expected"),
    [
        *((n, {}, True) for n in PLANTS),
        ("machine", {"xe": 1.45}, False),
        ("machine", {"xdp": 1.17}, False),
        # Of these a root finder from the same guess finds a steady state with the field reversed, beyond the pull-out.
        ("machine", {"xq": 3.9}, False),
        ("machine", {"xq": 1.37}, True),
        ("machine", {"xdp": 0.173}, True),
    ],
)
def test_a_plant_is_stable_where_the_package_finds_its_eigenvalues_to_be(plant, moved, expected):
    model = model_of(plant).with_values(moved)
    found = linearize(model, inputs=next(iter(model.inputs)), outputs=PLANTS[plant].outputs[0])
    assert (np.linalg.eigvals(np.asarray(found.A)).real.max() < 0) == expected
    assert values.stable(PLANTS[plant], moved) == expected


def test_a_plant_that_cannot_rest_is_not_stable():
    # The current that carries this power is beyond its limit.
    assert not values.stable(PLANTS["station"], {"Z": 1.0})


def test_sixty_designs_over_all_plants():
    asked = list(STUDY.pending(["value"], 3, None, set()))
    assert len({d.name for d in asked}) == len(asked) == 60
    assert {n: sum(d.plant == n for d in asked) for n in PLANTS} == dict.fromkeys(PLANTS, 10)
    assert {d.size for d in asked} == {10.0, 30.0} and all(d.effects == () for d in asked)
    few = list(STUDY.pending(["value"], 3, 2, set()))
    assert sorted(d.plant for d in few) == sorted([*PLANTS, *PLANTS]) and set(few) < set(asked)
    assert [d.name for d in STUDY.pending(["value"], 3, 2, {few[0].name})] == [d.name for d in few[1:]]
    assert {d.plant for d in STUDY.pending(["single", "value"], 3, 1, set(), plants=("drive",))} == {"drive"}
    assert {d.plant for d in STUDY.pending(["single"], 3, 9, set())} <= {"station", "drive"}


def told(verdict="named", findings=(), ambiguity=(), **more):
    line = {"case": "value-3000", "part": "value", "plant": "machine", "verdict": verdict, "size": 10.0, "effects": []}
    line |= {"value": {"name": "T1", "true": 1.0, "stated": 0.5}, "truth": [], "found": [], "seconds": 2.0, "cpu": 1.5}
    sets = [[{"effect": e, "at": [at], "from": ""} for e, at in group] for group in ambiguity]
    return line | {"findings": list(findings), "ambiguity": sets} | more


def off(*names, value=1.01, ci95=(0.9, 1.1), places=()):
    sizes = {n: {"value": value, "ci95": ci95, "unit": "s"} for n in names}
    likely = [{"at": [n], "probability": 1.0} for n in (*names, *places)]
    return {
        "effect": "parameter",
        "same_as": ["parameter"],
        "probability": 1.0,
        "parameters": sizes,
        "places": likely,
    }


LAG = {"effect": "lag", "same_as": ["lag"], "probability": 0.97, "parameters": {}, "places": [{"at": ["gate"]}]}


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (told(findings=[off("T1")]), "named"),
        (told(findings=[off("T1", "KA")]), "named"),  # a fitted one, which began somewhere else than at its true value
        (told(findings=[off("T1"), off("KA")]), "named"),
        (told(findings=[LAG, off("T1")]), "beside"),
        (told(findings=[off("T1", "T3")]), "beside"),
        (told(findings=[off("T3", places=("T1",))]), "covered"),
        (told(findings=[off("T3")]), "wrong"),
        (told(findings=[LAG]), "wrong"),
        (told(findings=[LAG, off("KA")]), "wrong"),
        (told("ambiguous", [LAG, off("T1")]), "covered"),
        (told("ambiguous", [LAG], [[("lag", "gate"), ("parameter", "T1")]]), "covered"),
        (told("ambiguous", [LAG], [[("lag", "T1"), ("parameter", "T3")]]), "abstained"),
        (told("ambiguous", [off("T3")]), "abstained"),
        (told("no-evidence", [off("T1")]), "abstained"),
        (told("unnameable"), "abstained"),
        (told("unfinished"), "abstained"),
        (told(failed="no steady state"), "failed"),
    ],
)
def test_outcomes_of_wrong_values(line, expected):
    assert outcomes.value_outcome(line) == expected


@pytest.mark.parametrize(
    ("of", "expected"),
    [
        ({}, True),
        ({"value": 1.2, "ci95": (0.9, 1.5)}, True),
        ({"value": 1.2, "ci95": (None, 1.5)}, True),
        ({"value": 1.2, "ci95": (1.1, None)}, False),
        ({"value": 1.049, "ci95": (1.048, 1.05)}, True),
        ({"value": 1.06, "ci95": None}, False),
        ({"value": 0.96, "ci95": None}, True),
    ],
)
def test_an_estimate_is_right_within_its_interval_or_a_twentieth(of, expected):
    assert outcomes.value_estimated(told(findings=[off("T1", **of)])) == expected


def test_the_summary_and_the_report_have_a_section_for_wrong_values():
    lines = [told(findings=[off("T1")]), told(findings=[off("T1", value=2.0, ci95=(1.9, 2.1))])]
    lines += [told("ambiguous", [LAG, off("T1")], plant="hydro", cpu=9.0), told(findings=[LAG], messy=True)]
    lines += [told(failed="no steady state"), {"part": "value", "plant": "park", "unreachable": True}]
    found = judging.summary(lines)
    assert found["cases"]["value"] == 5 and found["unreachable"] == 1
    every = found["values"]["all"]
    assert (every["cases"], every["named"], every["covered"], every["wrong"], every["failed"]) == (4, 2, 1, 0, 1)
    assert every["named_or_covered"] == 0.75 and every["estimated"] == 0.5
    assert every["wrong_names_limit"] == pytest.approx(1 - 0.05**0.25)
    assert (every["cpu"]["median"], every["cpu"]["largest"]) == (1.5, 9.0)
    assert found["values"]["by_plant"]["machine, messy"]["wrong"] == 1
    assert found["calibration"]["sure"]["findings"] == 2 and found["calibration"]["sure"]["right"] == 0.0
    assert json.loads(json.dumps(found)) == found
    assert "| all tidy | 4 | 2 | 1 | 0 | 0 | 0 | 1 | 0.75 |" in report(found)
    assert "Values stated wrong" not in report(judging.summary([]))


def test_a_line_has_the_value_and_the_budget_that_the_diagnosis_was_given(monkeypatch, wrong):
    asked = []

    def diagnose(*_, options, **__):
        asked.append(options.budget)
        raise StudyError("enough is known", where="here")

    monkeypatch.setattr(diagnosing, "diagnose", diagnose)
    monkeypatch.setattr(STUDY, "made", lambda *_: wrong)
    line = STUDY.one(wrong.design, 3, budget=7.0)
    assert line["value"] == asdict(wrong.value) and line["truth"] == [] and line["budget"] == 7.0
    assert STUDY.one(wrong.design, 3)["budget"] is None
    assert asked[0].seconds == 7.0 and asked[0].clock is time.process_time and asked[1] is None
    assert judging.summary([line])["values"]["all"]["failed"] == 1


def test_cases_of_different_budgets_are_not_mixed(tmp_path, capsys):
    (tmp_path / "cases.jsonl").write_text(json.dumps(told(budget=120.0)) + "\n")
    with pytest.raises(SystemExit):
        STUDY.main(["--parts", "value", "--out", str(tmp_path), "--limit", "1"])
    assert "a budget of 120 s, asked was no limit" in capsys.readouterr().err
