"""A budget ends every stage with what is known by then: tested by clocks that the tests move."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from hvdc_ident.budget import Budget, BudgetSpent
from hvdc_ident.errors import ComputationError
from hvdc_ident.report.page import write_report
from hvdc_ident.study.export import letter, write
from hvdc_ident.study.pipeline import run_stage, run_study
from hvdc_ident.study.stages import StageOptions
from hvdc_ident.study.study import load_study
from tests.app.small_study import write_small_study


@dataclass
class Clock:
    """A clock that stands still until a text of progress has some words in it, and is then at another time.

    to: that time, by default past the end of any budget. said: all texts of progress.
    """

    until: str
    to: float = 1e9
    now: float = 0.0
    said: list[str] = field(default_factory=list)

    def __call__(self) -> float:
        return self.now

    def progress(self, done: int, total: int, text: str) -> None:
        """Take in progress."""
        self.said.append(text)
        self.now = self.to if self.until in text else self.now


def ended(folder: Path, until: str, work: Callable[..., object], to: float = 1e9) -> Clock:
    """Do work on the small study, with a budget of 100 s that ends at a text."""
    clock = Clock(until, to)
    budget = Budget.of(100.0, clock)
    work(load_study(write_small_study(folder)), StageOptions(progress=clock.progress, budget=budget))
    return clock


def test_what_is_left_of_a_budget_leaves_time_to_tell() -> None:
    now = [10.0]
    budget = Budget.of(100.0, lambda: now[0])
    assert budget.left == pytest.approx(95.0) and not budget.spent and budget.to_search < budget.left
    now[0] = 104.0
    assert not budget.spent
    told: list[str] = []
    watched = budget.watched(lambda done, total, text: told.append(text))
    watched(0, 1, "in time")
    now[0] = 105.5
    assert budget.spent
    with pytest.raises(BudgetSpent):
        watched(0, 1, "too late")
    assert told == ["in time", "too late"], "what is done is told, and then it ends"


@pytest.mark.parametrize(
    ("stage", "until", "file", "not_tried"),
    [
        ("identify", "start 2 converged", "identifiability", "the profiles, on which the verdicts rest"),
        ("identify", "profile of k", "identifiability", "what to measure next"),
        ("fit", "fit: search for the optimum", "fit", "the fits to single experiments"),
        ("diagnose", "diagnose: the nominal model", "discrepancy", "rounds of candidates"),
    ],
)
def test_a_stage_ends_with_what_was_not_tried(
    tmp_path: Path, stage: str, until: str, file: str, not_tried: str
) -> None:
    folder = tmp_path / "r"
    ended(tmp_path, until, lambda study, options: run_stage(study, stage, folder, options))
    data = json.loads((folder / f"{file}.json").read_text())
    assert data["status"] == "unfinished" and not data["fingerprint"] and data["failed"] == data["message"]
    assert data["message"].startswith("ended by the budget of 100 s at: ") and not_tried in data["not_tried"]
    if "start 2" in until:
        assert [t.split()[1:3] for t in data["done"]] == [["for", "the"]] * 2 and "start 2" in data["done"][-1]
    write_report(folder)
    # The same stage goes on another time.
    assert not run_stage(load_study(tmp_path / "study.toml"), stage, folder, StageOptions()).failed


def test_a_run_tells_what_it_did_not_come_to(tmp_path: Path) -> None:
    folder = tmp_path / "r"
    ended(tmp_path, "profile of k", lambda study, options: run_study(study, folder, options))
    stages = json.loads((folder / "run.json").read_text())["stages"]
    assert not stages["simulate"]["failed"] and stages["identify"]["failed"].startswith("ended by the budget of 100 s")
    assert stages["fit"]["failed"] == stages["diagnose"]["failed"] == "not tried: the budget of 100 s was over"
    assert "not tried" in (folder / "report.html").read_text()
    study = load_study(tmp_path / "study.toml")
    assert not any(d.failed for d in run_study(study, folder, StageOptions()))


def test_a_diagnosis_ended_by_its_budget_names_no_place(tmp_path: Path) -> None:
    """The small plant is late by a lag; a search that ends after its first look tells none of what it has refitted as found."""
    folder = tmp_path / "r"
    ended(tmp_path, "candidates", lambda study, options: run_study(study, folder, options), to=90.0)
    data = json.loads((folder / "discrepancy.json").read_text())
    assert data["verdict"] == "unfinished" and data["failed"] == data["text"] and not data["fingerprint"]
    assert not data["effects"] and not data["findings"] and not data["ambiguity"] and not data["augmented_model"]
    assert not data["hypotheses"] and "times the noise" in data["text"]
    assert any(line["status"] == "refitted" for line in data["candidates"])
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["diagnosis"] == "unfinished" and not summary["effects"] and not summary["findings"]
    assert "was ended by its budget" in (folder / "report.html").read_text()
    study = load_study(tmp_path / "study.toml")
    with pytest.raises(ComputationError, match=r"no diagnosis to write a letter about.*ended by its budget"):
        letter(study, folder, StageOptions())
    assert "ended by its budget" in write(study, tmp_path / "x.toml", folder=folder).note
