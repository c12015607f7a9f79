"""The records of the units by andes: what the package simulates with the plant's own .dyr is what was recorded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.study.fitting import problem_of
from tests.studies.study_module import load

pytestmark = pytest.mark.nightly

RUN = load("units_by_andes")
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
    assert plant.truth() != plant.said()


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
