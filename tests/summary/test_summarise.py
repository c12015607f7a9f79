"""What is decided once: which values count, what is stale, what to do next; and the form that it has as JSON."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hvdc_ident.colours import DARK, LIGHT
from hvdc_ident.errors import InputError
from hvdc_ident.summary import Results, RunSummary, summarise
from hvdc_ident.text import estimate_text, estimate_texts, interval_text
from tests.report.demo_like import HEADING, advice, demo_like

ADVICE = {"recommended_experiment": advice("u", "step u")}


def fit(half: float, verdict: str = "fits") -> dict[str, Any]:
    """A fit of k = 2 that is known to so much either way."""
    return {
        "status": "converged",
        "fitted": ["k"],
        "candidates": {"k": {"given": 1.0, "unit": "s"}},
        "values": {"k": 2.0},
        "estimates": {"k": {"value": 2.0, "ci95": [2.0 - half, 2.0 + half]}},
        "adequacy": {"verdict": verdict},
    }


def kinds(**stages: dict[str, Any]) -> list[str]:
    return [step.kind for step in summarise(stages).next]


def test_a_recording_is_advised_where_a_value_is_not_known_closely() -> None:
    assert kinds(fit=fit(0.05), identifiability=ADVICE) == ["narrow"]
    assert kinds(fit=fit(0.03), identifiability=ADVICE) == ["export"]
    verdict = {"name": "k", "verdict": "identifiable", "reason": "", "value": 2.0, "ci95": [1.99, 2.01]}
    known = {"parameters": {"k": verdict}, "candidates": {"k": {"given": 1.0}}, **ADVICE}
    assert kinds(identifiability=known) == []


def test_advice_that_rests_on_a_model_without_a_named_effect_is_void() -> None:
    lag = {"effect": "lag", "at": ["y"], "text": "y lags", "parameters": {}}
    found = {"verdict": "named", "effects": [lag], "parameters_after": {"k": 1.0}, "augmented_model": "a.toml"}
    assert kinds(fit=fit(0.5), identifiability=ADVICE, discrepancy=found) == ["letter"]
    apart = {**found, "verdict": "ambiguous", "separating_experiment": {"text": "record x"}}
    assert kinds(fit=fit(0.5), identifiability=ADVICE, discrepancy=apart) == ["separate", "letter"]
    assert kinds(fit=fit(0.5, "does-not-fit")) == ["diagnose"]


def test_results_of_an_earlier_state_of_the_study_decide_nothing(tmp_path: Path) -> None:
    folder = demo_like(tmp_path / "demo")
    now = Results(folder).summary
    assert now.counting.name == "effect"
    for name in ("simulation", "fit", "identifiability"):
        path = folder / f"{name}.json"
        data = json.loads(path.read_text("utf-8"))
        path.write_text(json.dumps({**data, "sources": {"s.toml": "cd"}}), "utf-8")
    later = Results(folder).summary
    assert later.counting.name == "fit" and not later.findings and "effect" not in later.sets
    assert [p.value for p in later.parameters] == [p.fitted for p in now.parameters]


def test_a_summary_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    summary = Results(demo_like(tmp_path / "demo")).summary
    data = json.loads(json.dumps(summary.to_dict()))
    assert RunSummary.from_dict(data) == summary
    assert {k: data[k] for k in ("study", "model", "seed", "sources")} == {
        k: HEADING[k] for k in ("study", "model", "seed", "sources")
    }
    with pytest.raises(InputError, match="not the JSON of a RunSummary"):
        RunSummary.from_dict({**data, "parameters": [{"name": 1}]})


@pytest.mark.parametrize(
    ("value", "interval", "shown"),
    [
        (1485.83, (1433.6, 1538.1), ("1486", "1434", "1538")),
        (2.4, (2.39, 2.41), ("2.400", "2.390", "2.410")),
        (0.10015, (0.09982, 0.10049), ("0.10015", "0.09982", "0.10049")),
        (31.4, (None, 32.0), ("31.4", "", "32")),
        (2.0e6, None, ("2e+06", "", "")),
    ],
)
def test_a_value_has_the_digits_that_its_interval_leaves(value: float, interval: Any, shown: tuple[str, ...]) -> None:
    assert estimate_texts(value, interval) == shown
    assert interval_text(interval) == (
        f"{shown[1]} to {shown[2]}" if shown[1] else f"below {shown[2]}" if shown[2] else ""
    )


def test_a_value_and_its_interval_have_one_unit() -> None:
    assert estimate_text(0.01796, "s", (0.01787, 0.01805)) == "17.960 ms (17.870 to 18.050 ms)"
    assert estimate_text(2.0, "", None) == "2"


# Machado, Oliveira and Fernandes (2009), severity 1; linear RGB to XYZ by IEC 61966-2-1; colour difference by CIE 1976.
SEEN = {
    "protan": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deutan": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "normal": np.eye(3),
}
XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)


def linear(colour: str) -> np.ndarray:
    c = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def lab(rgb: np.ndarray) -> np.ndarray:
    x = XYZ @ np.clip(rgb, 0.0, 1.0) / XYZ.sum(axis=1)
    f = np.where(x > 0.008856, np.cbrt(x), 7.787 * x + 16.0 / 116.0)
    return np.array([116.0 * f[1] - 16.0, 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])])


@pytest.mark.parametrize(("colours", "ground"), [(LIGHT, "#ffffff"), (DARK, "#1b1f24")])
def test_curves_are_told_apart_by_every_eye_and_from_the_page(colours: dict[str, str], ground: str) -> None:
    curves = {n: c for n, c in colours.items() if n != "mark"}
    for colour in curves.values():
        light, dark = sorted((0.05 + XYZ[1] @ linear(c) for c in (colour, ground)), reverse=True)
        assert light / dark >= 3.0  # WCAG 2.2, 1.4.11
    for kind, seen in SEEN.items():
        for a, b in itertools.combinations(curves, 2):
            apart = np.linalg.norm(lab(np.array(seen) @ linear(curves[a])) - lab(np.array(seen) @ linear(curves[b])))
            assert apart > 25.0, (kind, a, b)  # ten times a difference that is just seen
