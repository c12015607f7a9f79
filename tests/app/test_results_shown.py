"""What the tab Run shows of results, against the results and against simulations made by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.app.result_panels import overlay_columns, profile_columns
from hvdc_ident.app.runs import StudyRun
from hvdc_ident.app.supposed import planned_experiments, refitted, suppositions
from hvdc_ident.data import trajectory
from hvdc_ident.identifiability import identifiability
from hvdc_ident.identifiability.experiment_design import Move
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.next_step import NextStep, next_sentence
from hvdc_ident.report.overlay import Overlay, overlay_of
from hvdc_ident.summary import Results
from hvdc_ident.summary.stage_results import diagnosis_of, identified_of
from hvdc_ident.summary.tables import findings_table, sets_table, verdicts_table
from tests.app.small_study import LATE


@pytest.fixture(scope="module")
def study(finished: tuple[hi.Study, StudyRun]) -> hi.Study:
    return finished[0]


def told(study: hi.Study, name: str) -> dict[str, Any]:
    return json.loads((study.folder / f"{name}.json").read_text())


def overlay(study: hi.Study) -> Overlay:
    found = overlay_of(Results(study.folder), "up", "y")
    assert found is not None
    return found


def test_the_best_model_has_the_plants_size_and_the_rivals_explain_the_record_as_well(study: hi.Study) -> None:
    best, *rivals = suppositions(study, diagnosis_of(told(study, "discrepancy")), study.folder)
    (size,) = best.sizes
    assert best.model.parameters[size].value == pytest.approx(LATE, rel=0.2) and rivals
    (record, *_) = study.experiments
    run = hi.simulate(best.model, record)["y"]
    np.testing.assert_allclose(run, overlay(study).runs["effect"]["y"], rtol=1e-9, atol=1e-12)
    for rival in rivals:  # two lags in a row, whichever is the sensor's: far below the noise of 0.005
        model = refitted(study, rival).model
        assert np.abs(hi.simulate(model, record)["y"] - run).max() < 0.0005
        assert rival.name != best.name and rival.sizes


def test_without_a_finding_there_is_no_supposition(study: hi.Study, tmp_path: Path) -> None:
    assert suppositions(study, None, study.folder) == ()
    assert suppositions(study, diagnosis_of(told(study, "discrepancy")), tmp_path) == ()  # the card is not there


@pytest.mark.parametrize(
    "move",
    [
        Move("u", "step", 0.4, 0.2, 0.1),
        Move("u", "ramp", 0.4, 0.2, 0.1, 0.3),
        Move("u", "multisine", 0.4, 0.5, 0.1, 0.4),
    ],
)
def test_a_move_is_read_as_it_was_told(move: Move) -> None:
    again = Move.from_dict(json.loads(json.dumps(move.to_dict())))
    t = np.linspace(0.0, 1.0, 101)
    assert again == move
    np.testing.assert_array_equal(again.signal(1.0)(t), move.signal(1.0)(t))


def test_the_first_experiment_is_the_one_that_is_recommended(study: hi.Study) -> None:
    """Of a wide interval of k, which a record of more noise leaves; the model of the plant, so that there is no misfit."""
    best = suppositions(study, diagnosis_of(told(study, "discrepancy")), study.folder)[0].model
    random = np.random.default_rng(7)
    noisy = [
        e.with_(
            measured=trajectory(e.time, {"y": e.measured["y"] + 0.2 * random.standard_normal(e.time.size)}),
            noise={"y": 0.2},
        )
        for e in study.experiments
        if e.measured is not None
    ]
    identified = identifiability(best, noisy, study.candidates.values(), starts=1).to_dict()
    advice = identified["recommended_experiment"]
    first, *others = planned_experiments(study, identified_of(identified))
    assert advice["text"].startswith(first.words) and others
    planned = first.experiment(study)
    (move, *_) = advice["moves"]
    signal = planned.inputs[move["input"]]
    assert (float(signal(0.0)), planned.event) == (move["from"], move["at"])
    assert planned.time[-1] == max(e.time[-1] for e in study.experiments)


def test_where_none_is_recommended_every_move_of_a_settable_input_can_be_looked_at(study: hi.Study) -> None:
    identified = told(study, "identifiability")
    assert (
        identified["recommended_experiment"] is None
        and "by which a width is uncertain" in identified["not_recommended"]
    )
    found = planned_experiments(study, identified_of(identified))
    assert {p.design.inputs for p in found} == {("u",)} and {p.design.kind for p in found} == {
        "step",
        "ramp",
        "multisine",
    }
    grid = {n: replace(i, settable=False) for n, i in study.model.inputs.items()}
    assert (
        planned_experiments(
            replace(study, model=replace(study.model, inputs=FrozenMap(grid))), identified_of(identified)
        )
        == ()
    )


def test_a_profile_passes_its_level_at_the_ends_of_the_interval(study: hi.Study) -> None:
    profile = identified_of(told(study, "identifiability")).profiles["k"]
    at, between, computed, level, ends = profile_columns(profile)
    np.testing.assert_allclose(at[np.isfinite(ends)], profile.ci95)
    np.testing.assert_allclose(between[np.isfinite(ends)], 1.0, atol=0.02)
    assert (level == 1.0).all() and np.isfinite(computed).sum() == len(set(profile.values.tolist()))


def test_the_errors_drawn_are_those_that_the_fit_states(study: hi.Study) -> None:
    time, given, fitted, absent = overlay_columns(overlay(study), ("given", "fitted", "other"), errors=True)
    assert time.size == 201 and np.isnan(absent).all()
    fit = told(study, "fit")
    assert np.sqrt(np.mean(fitted**2)) == pytest.approx(fit["rmse"]["y"]["up"])
    assert np.sqrt(np.mean(given**2)) == pytest.approx(fit["rmse_given"]["y"]["up"])
    _, recorded, run = overlay_columns(overlay(study), ("fitted",))
    np.testing.assert_allclose(recorded - run, fitted)


def test_tables_hold_verdicts_findings_and_gaps(study: hi.Study) -> None:
    identified, diagnosis = told(study, "identifiability"), told(study, "discrepancy")
    (row,) = verdicts_table(identified_of(identified)).rows
    assert row[:2] == ("k", identified["parameters"]["k"]["verdict"]) and "1/s" in row
    assert float(row[2]) == pytest.approx(identified["parameters"]["k"]["value"], rel=1e-3)
    assert len(findings_table(Results(study.folder).summary).rows) == len(diagnosis["findings"]) > 0
    errors = {row[0]: float(row[1]) for row in sets_table(Results(study.folder).summary).rows}
    assert errors["with the effect"] < errors["fitted"] <= errors["given values"]


def test_what_to_do_next_is_called_as_it_is_where_it_is_read() -> None:
    said = {door: next_sentence(NextStep("letter"), door) for door in ("shell", "python", "page")}
    assert said["page"] == "Next: the button Letter writes one page on this for the model's owner."
    assert said["shell"].startswith("Next: `hvdc-ident letter STUDY` writes")
    assert next_sentence(NextStep("diagnose"), "python") == "Next: `hi.diagnose(...)` looks for what the model lacks."
    assert next_sentence(NextStep("narrow", "Step u."), "page") == "Measure next: Step u."
