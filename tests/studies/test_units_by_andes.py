"""The records of the units by andes: what the package simulates with the plant's own .dyr is what was recorded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.study.fitting import problem_of
from tests.studies.study_module import expected, load

pytestmark = pytest.mark.nightly

RUN, UNITS, MISFIT = (load("units_by_andes", script) for script in ("run", "units", "misfit"))
HALF_SECOND = 25
"""Rows of half a second."""


def drift(dyr: str, folder) -> dict[str, float]:
    """Return by output the largest mean difference over half a second, as a share of the record's range."""
    study = hi.load_study(RUN.write_study("steam_regulator_limit", folder, dyr))
    (record,) = study.experiments
    run = hi.simulate(study.model.with_values(record.values), record.time, inputs=record.inputs)
    mean = np.ones(HALF_SECOND) / HALF_SECOND
    recorded = {o: record.measured[o] for o in record.outputs}
    return {o: np.abs(np.convolve(v - run[o], mean, "valid")).max() / np.ptp(v) for o, v in recorded.items()}


def test_the_plant_itself_plays_the_record_back(tmp_path) -> None:
    """Half a per cent of the range is the noise of one row, Q's offset is in the level before the event."""
    apart = drift("true.dyr", tmp_path / "true")
    assert set(apart) == {"P", "Q"} and max(apart.values()) < 0.012
    assert drift("plant.dyr", tmp_path / "vendor")["Q"] > 10.0 * apart["Q"]


@pytest.mark.parametrize("name", RUN.PLANTS)
def test_the_vendors_file_differs_where_the_unit_says(name) -> None:
    """The wrong parameter and the effect: both files are made of the unit's values."""
    from hvdc_ident.psse import read_dyr

    plant, files = RUN.PLANTS[name], RUN.HERE / "recordings" / name
    for file, vendor in (("plant.dyr", True), ("true.dyr", False)):
        recorded = {r.model: list(r.values) for r in read_dyr(files / file).records}
        expected = {m: list(v.values()) for m, v in plant.values(vendor).items()}
        assert set(recorded) == set(expected)
        for model, values in expected.items():
            assert recorded[model] == pytest.approx(values)
    assert plant.values(True) != plant.values(False)
    assert not plant.wrong or plant.truth() != plant.said()


@pytest.mark.parametrize("name", RUN.PLANTS)
def test_the_record_is_finite_and_moves(name) -> None:
    table = np.loadtxt(RUN.HERE / "recordings" / name / "event.csv", delimiter=",", skiprows=1)
    assert (
        np.isfinite(table).all() and (np.diff(table[:, 0]) > 0.0).all() and (np.ptp(table[:, 1:], axis=0) > 0.01).all()
    )


@pytest.mark.parametrize("name", ["gas_load_limit", "steam_regulator_limit", "park_frequency_dead_band"])
def test_what_the_plant_itself_leaves_of_a_record_is_noise(name, tmp_path) -> None:
    """With the plant's own values: white and of size 1, once what the noise of voltage and angle makes of P and Q is counted."""
    problem = problem_of(hi.load_study(RUN.write_study(name, tmp_path / name, "true.dyr")))
    for b in problem.blocks(problem.given):
        r = b.residual
        assert 0.88 < np.sqrt(np.mean(r**2)) < 1.12
        assert abs(r[1:] @ r[:-1]) < 0.12 * (r @ r)
    alone = [e.with_(input_noise={}) for e in problem.experiments]
    blind = replace(problem, experiments=alone, passed={}).blocks(problem.given)
    assert max(np.sqrt(np.mean(b.residual**2)) for b in blind) > 2.0


@pytest.mark.parametrize("name", [*UNITS.CARDS, *UNITS.VALUES])
def test_a_record_tells_what_is_wrong(name) -> None:
    """The plant's own .dyr leaves noise, the vendor's at least three times as much in one output, as the README says."""
    known = expected("units_by_andes")["misfit"][name]
    for dyr, which in (("true.dyr", "plant"), ("plant.dyr", "vendor")):
        found = MISFIT.problem(name, dyr)
        assert MISFIT.misfit(found, found.given) == pytest.approx(known[which], rel=1e-3)
    assert max(known["plant"].values()) <= MISFIT.WHITE
    assert max(known["vendor"].values()) >= MISFIT.WRONG
    assert max(known["fitted"].values()) > MISFIT.WHITE


@pytest.mark.parametrize(("name", "also"), [(n, also) for n, p in UNITS.CARDS.items() for also in p.hidden.also])
def test_a_card_that_is_right_too_does_the_same(name, also, tmp_path) -> None:
    plant = RUN.PLANTS[name]
    runs = []
    for folder, records in (("plant", plant.values(False)), ("also", plant.values(False, also))):
        file = tmp_path / f"{folder}.dyr"
        file.write_text(UNITS.dyr(records), encoding="utf-8")
        study = hi.load_study(RUN.write_study(name, tmp_path / folder, str(file)))
        (record,) = study.experiments
        run = hi.simulate(study.model.with_values(record.values), record.time, inputs=record.inputs)
        runs.append({o: run[o] for o in record.outputs})
    for output, values in runs[0].items():
        assert np.abs(runs[1][output] - values).max() < 0.01 * np.ptp(values)


def told(verdict, *findings, ambiguity=()) -> dict:
    """Return a diagnosis with these findings."""
    pooled = {n: {"fit": 1.0} for n in ("nominal", "refitted", "augmented")}
    found = {"verdict": verdict, "text": "", "doubt": "", "gap": {"pooled": pooled}, "parameters_after": {}}
    return {**found, "findings": findings, "ambiguity": ambiguity}


def finding(effect, at, source="", parameters=()) -> dict:
    """Return a finding at one place. source: the card's name."""
    sizes = {n: {"value": 1.0, "ci95": [0.9, 1.1]} for n in parameters}
    place = {"at": [at], "values": {}} | ({"from": source} if source else {})
    return {"effect": effect, "same_as": [effect], "places": [place], "parameters": sizes}


OWN, OTHER = finding("card", "gov", "ieeeg1"), finding("card", "gov", "hygov")
LAG = finding("lag", "gov.dw")


@pytest.mark.parametrize(
    ("diagnosis", "outcome"),
    [
        (told("named", OWN), "named"),
        (told("named", finding("card", "gov", "IEESGO")), "named"),
        (told("named", {"effect": "card", "same_as": [], "at": ["gov"], "from": "ieeeg1", "parameters": {}}), "named"),
        (told("named", OWN, LAG), "named, with another"),
        (told("named", OTHER), "wrong"),
        (told("named", finding("card", "avr", "ieeeg1")), "wrong"),
        (told("named", LAG), "wrong"),
        (told("named", finding("parameter", "gov.R", parameters=["gov.R"])), "wrong"),
        (told("ambiguous", OTHER, ambiguity=[[{"effect": "card", "at": ["gov"], "from": "IEEEG1"}]]), "covered"),
        (told("ambiguous", OWN), "covered"),
        (told("ambiguous", LAG), "held"),
        (told("unnameable"), "held"),
    ],
)
def test_a_card_is_judged_by_its_name_and_its_part(diagnosis, outcome) -> None:
    assert RUN.judged(RUN.PLANTS["steam_stages"], diagnosis)["card"] == outcome


T3 = finding("parameter", "gov.T3", parameters=["gov.T3"])


@pytest.mark.parametrize(
    ("diagnosis", "outcome"),
    [
        (told("named", T3), "named"),
        (told("named", finding("parameter", "gov.R", parameters=["gov.R"])), "wrong"),
        (told("named", LAG), "wrong"),
        (told("named", LAG, T3), "named, with another"),
        (told("ambiguous", LAG, ambiguity=[[{"effect": "parameter", "at": ["gov.T3"]}]]), "covered"),
        (told("no-evidence"), "held"),
    ],
)
def test_a_value_is_judged_by_its_name(diagnosis, outcome) -> None:
    assert RUN.judged(RUN.PLANTS["reheater"], diagnosis)["named"] == outcome


def test_a_budget_is_that_of_the_diagnosis(tmp_path) -> None:
    study = hi.load_study(RUN.write_study("reheater", tmp_path / "study", budget=120.0))
    assert study.settings.diagnose.budget == 120.0


def test_the_readme_shows_what_was_found() -> None:
    """Its tables are those of expected.json."""
    known, readme = expected("units_by_andes"), (RUN.HERE / "README.md").read_text(encoding="utf-8")
    assert MISFIT.table(known["misfit"]) in readme
    for asked in RUN.SETS:
        assert RUN.table(asked, list(known[asked].values())) in readme


@pytest.mark.parametrize(
    ("unit", "told"), [("stabiliser_missing", "IEEEST is missing as pss"), ("field_time_constant", "gen.Tpdo is 8.")]
)
def test_a_card_that_is_missing_and_a_value_that_is_wrong_are_named(unit, told, tmp_path) -> None:
    """The records are another simulator's; nothing is told to the study but the vendor's file."""
    found = RUN.one(unit, tmp_path / unit, 120.0)
    assert found["verdict"] == "named" and found["text"].startswith(told), found["text"]
