"""Plants of other code, through the command line alone: the values come out of clean records, the hidden effect out of others.

scipy integrates each plant and writes its records as odd a file as such records come in; see `plant.py` and `plants/`.
"""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import t
from typer.testing import CliRunner

from hvdc_ident import find_operating_point, load_model
from hvdc_ident.cli import app
from tests.foreign.plant import Plant

pytestmark = pytest.mark.nightly

PLANTS = sorted(p.stem for p in Path(__file__).with_name("plants").glob("[a-z]*.py"))
TRIED = ("lag", "delay", "gain", "offset", "limit", "deadband")
"""Effects that a diagnosis tries here: the hidden ones and some that might be taken for them."""


def plant(name: str) -> Plant:
    found: Plant = importlib.import_module(f"tests.foreign.plants.{name}").PLANT
    return found


def results(path: Path, stage: str) -> dict[str, Any]:
    """What `run` wrote of a stage."""
    outcome = CliRunner().invoke(app, ["run", str(path), "--quiet"])
    assert outcome.exit_code == 0, outcome.output
    found: dict[str, Any] = json.loads((path.parent / "study-results" / f"{stage}.json").read_text(encoding="utf-8"))
    return found


def off(estimate: dict[str, Any], true: float) -> float:
    """How far the true value lies from the estimate, in half-widths of the 95 % interval on its side."""
    low, high = estimate["ci95"]
    value = estimate["value"]
    return (true - value) / (high - value) if true > value else (value - true) / (value - low)


@pytest.mark.parametrize("name", PLANTS)
def test_a_model_starts_where_its_plant_rests(name: str, tmp_path: Path) -> None:
    p = plant(name)
    (tmp_path / "model.toml").write_text(p.card, encoding="utf-8")
    found = find_operating_point(load_model(tmp_path / "model.toml"))
    x = p.steady_state(p.given, p.rest, None, list(p.begin.values()))
    assert list(found.states.values()) == pytest.approx(list(x), rel=1e-6, abs=1e-7)
    assert dict(found.outputs) == pytest.approx(dict(p.outputs(x, p.rest, p.given, None)), rel=1e-6, abs=1e-7)


@pytest.mark.parametrize("name", PLANTS)
def test_a_clean_record_gives_the_values(name: str, tmp_path: Path) -> None:
    p = plant(name)
    found = results(p.study(tmp_path, hidden=False, seed=1, tables="[identifiability]\n[fit]\nstarts = 4"), "fit")
    assert found["status"] == "converged", found["message"]
    assert set(found["estimates"]) == set(p.bounds)
    # A chance of 1 in 2 000 for each value: 3.5 standard deviations, 1.8 half-widths, where the noise is known.
    dof = found["dof"] or np.inf
    farthest = t.isf(2.5e-4, dof) / t.isf(0.025, dof)
    distance = {n: off(e, p.true[n]) for n, e in found["estimates"].items()}
    assert max(distance.values()) < farthest, distance
    assert found["adequacy"]["verdict"] == "fits", found["adequacy"]["text"]


@pytest.mark.parametrize("name", PLANTS)
def test_a_hidden_effect_is_found(name: str, tmp_path: Path) -> None:
    p = plant(name)
    tables = f"[identifiability]\n[fit]\nstarts = 2\n[diagnose]\neffects = {json.dumps(TRIED)}"
    found = results(p.study(tmp_path, hidden=True, seed=2, tables=tables), "discrepancy")
    assert found["verdict"] in ("named", "ambiguous"), found["text"]
    places = {(c["effect"], place) for group in found["ambiguity"] for c in group for place in c["at"]}
    places |= {(e["effect"], place) for e in found["effects"] for place in e["at"]}
    right = {(e, place) for e in (p.hidden.effect, *p.hidden.others) for place in p.hidden.at}
    assert places & right, (found["text"], places)
    (size,) = p.hidden.parameters.items()
    for e in found["effects"]:
        if e["effect"] == p.hidden.effect and set(e["at"]) == set(p.hidden.at):
            assert off(e["parameters"][size[0]], size[1]) < 1.8
    assert found["gap"]["shrink_holdout"] > 0.5
