"""A budget ends every stage with what is known by then: tested by clocks that the tests move."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from hvdc_ident.budget import Budget, BudgetSpent
from hvdc_ident.errors import ComputationError
from hvdc_ident.fit.profile import ProfilesSoFar
from hvdc_ident.fit.profile_path import Side
from hvdc_ident.identifiability.unfinished import NOT_ENDED
from hvdc_ident.report.page import write_report
from hvdc_ident.run_commands import run_lines
from hvdc_ident.study.export import letter, write
from hvdc_ident.study.pipeline import run_stage, run_study
from hvdc_ident.study.stages import StageOptions
from hvdc_ident.study.stages.identify import lines_of, verdict
from hvdc_ident.study.study import load_study
from tests.app.small_study import CARD, write_small_study


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
        ("identify", "start 2 converged", "identifiability", "starts 3 to 4 of the search for the optimum"),
        ("identify", "profile of k", "identifiability", "the rest of the profile of k"),
        ("identify", "profile of k", "identifiability", "what to measure next"),
        ("fit", "fit: search for the optimum", "fit", "the fits to single experiments"),
        ("fit", "fit: 'up' alone", "fit", "the fits to 'down' alone"),
        ("fit", "fit: comparison", "fit", "the rest of the comparison of the fitted model with the recordings"),
        ("diagnose", "diagnose: the nominal model", "discrepancy", "rounds of candidates"),
    ],
)
def test_a_stage_ends_with_what_was_not_tried(
    tmp_path: Path, stage: str, until: str, file: str, not_tried: str
) -> None:
    folder = tmp_path / "r"
    ended(tmp_path, until, lambda study, options: run_stage(study, stage, folder, options))
    data = json.loads((folder / f"{file}.json").read_text())
    estimated = "alone" in until or "comparison" in until
    assert (
        (data["status"] == "unfinished") != estimated and not data["fingerprint"] and data["failed"] == data["message"]
    )
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


def test_a_diagnosis_ended_by_its_budget_tells_what_it_found_and_what_was_not_tried(tmp_path: Path) -> None:
    """The small plant is late by a lag; a search that ends after its first look has an answer, and no confident one."""
    folder = tmp_path / "r"
    ended(tmp_path, "candidates", lambda study, options: run_study(study, folder, options), to=90.0)
    data = json.loads((folder / "discrepancy.json").read_text())
    assert data["verdict"] == "ambiguous"
    assert any("budget ended" in note for note in data["notes"])
    assert data["hypotheses"] and any("the budget ended" in line["status"] for line in data["candidates"])
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["diagnosis"] == "ambiguous"


def test_a_diagnosis_ended_before_anything_was_found_says_so(tmp_path: Path) -> None:
    folder = tmp_path / "r"
    ended(tmp_path, "with clocks", lambda study, options: run_study(study, folder, options), to=90.0)
    data = json.loads((folder / "discrepancy.json").read_text())
    assert data["verdict"] == "unfinished" and data["failed"] == data["text"] and not data["fingerprint"]
    assert not data["effects"] and not data["findings"] and not data["ambiguity"] and not data["augmented_model"]
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["diagnosis"] == "unfinished" and not summary["effects"] and not summary["findings"]
    assert "was ended by its budget" in (folder / "report.html").read_text()
    study = load_study(tmp_path / "study.toml")
    with pytest.raises(ComputationError, match=r"no diagnosis to write a letter about.*ended by its budget"):
        letter(study, folder, StageOptions())
    assert "ended by its budget" in write(study, tmp_path / "x.toml", folder=folder).note


def unsettled_of(folder: Path) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = json.loads((folder / "identifiability.json").read_text())["unsettled"]
    return found


@pytest.mark.parametrize(
    ("until", "known"),
    [
        ("start 1 of", "The search for the optimum has not come to any end."),
        ("start 1 converged", "Its value is that of the lowest start so far"),
        (
            "profile of k, step 1 of",
            "Its profile has come to no end: no interval of it is known. The model leaves more than noise",
        ),
    ],
)
def test_a_candidate_without_a_verdict_says_what_is_known_of_it(tmp_path: Path, until: str, known: str) -> None:
    folder = tmp_path / "r"
    ended(tmp_path, until, lambda study, options: run_stage(study, "identify", folder, options))
    k = unsettled_of(folder)["k"]
    assert k["text"].startswith(known) and k["profile_ends"] is None and k["unit"] == "1/s"
    assert k["value"] is None if "any end" in known else 3.0 < k["value"] < 7.0
    data = json.loads((folder / "identifiability.json").read_text())
    assert not data["parameters"] and not data["identifiable"] and data["candidates"]
    assert known.split(";")[0] in "\n".join(lines_of(data)) and "identifiable" not in verdict(data)
    write_report(folder)
    assert "none yet" in (folder / "report.html").read_text()


def test_the_ends_of_profiles_that_were_found_are_told_without_a_verdict(tmp_path: Path) -> None:
    """The first side that comes to its end does so before the other: the clock goes on at the step after."""
    path = write_small_study(tmp_path, late=0.0)
    whole = run_stage(load_study(path), "identify", tmp_path / "whole", StageOptions()).data["parameters"]["k"]
    low, high = whole["ci95"]
    steps, texts = 0, [""]
    seen: list[tuple[float | None, float | None]] = []
    while not seen or None in seen[-1]:
        steps += 1
        clock = Clock(f"profile of k, step {steps} of")
        options = StageOptions(progress=clock.progress, budget=Budget.of(100.0, clock))
        done = run_stage(load_study(path), "identify", tmp_path / f"r{steps}", options)
        if not done.unfinished:
            break
        found = done.data["unsettled"]["k"]
        seen.append(tuple(found["profile_ends"] or (None, None)))
        texts.append(found["text"])
    ends = {e for e in seen if e != (None, None)}
    assert seen[0] == (None, None) and texts[1] == NOT_ENDED
    assert ends and all(e[0] in (None, pytest.approx(low)) and e[1] in (None, pytest.approx(high)) for e in ends)
    assert "was not walked to its end" in texts[-1] and "whether another optimum is as good was not asked" in texts[-1]


TWO = (
    CARD.replace("[inputs]", 'a = {value = 2.0, min = 0.01, max = 100.0}\nb = {value = 1.0, min = 0.01, max = 100.0}\n[inputs]')
    .replace("2.0*u", "a*b*u")
)  # fmt: skip


def two_gains(folder: Path, more: str = "") -> Path:
    """The small study of a model of whose gains only the product is seen. more: text for its [fit]."""
    path = write_small_study(folder)
    (folder / "lag.toml").write_text(TWO)
    text = path.read_text().replace("k = {min = 0.5, max = 20}", "k = {min = 0.5, max = 20}\na = {min = 0.1, max = 20}")
    path.write_text(text.replace("[diagnose]", more + "[diagnose]"))
    return path


def test_a_verdict_that_stands_is_told_though_the_search_was_not_ended(tmp_path: Path) -> None:
    path = two_gains(tmp_path)
    path.write_text(path.read_text().replace("[fit]", "b = {min = 0.1, max = 20}\n[fit]"))
    clock = Clock("start 1 of")
    options = StageOptions(progress=clock.progress, budget=Budget.of(100.0, clock))
    done = run_stage(load_study(path), "identify", tmp_path / "r", options)
    said = {n: v["verdict"] for n, v in done.data["parameters"].items()}
    assert said == {"a": "structurally-unidentifiable", "b": "structurally-unidentifiable"}
    assert list(done.data["unsettled"]) == ["k"] and not done.data["identifiable"]
    told = "\n".join(run_lines([done], None))
    assert "; structurally-unidentifiable: a, b; no verdict: k" in told


def test_a_report_by_groups_keeps_the_verdicts_of_the_groups_before(tmp_path: Path) -> None:
    groups = '[[fit.groups]]\nparameters = ["k"]\n[[fit.groups]]\nparameters = ["a"]\n'
    path = two_gains(tmp_path, f'mode = "individual"\n{groups}')
    clock = Clock("profile of a")
    options = StageOptions(progress=clock.progress, budget=Budget.of(100.0, clock))
    done = run_stage(load_study(path), "identify", tmp_path / "r", options)
    assert list(done.data["parameters"]) == ["k"] and list(done.data["unsettled"]) == ["a"]
    assert done.data["not_tried"][0] == "the rest of the profile of a"
    clock = Clock("profile of k")
    options = StageOptions(progress=clock.progress, budget=Budget.of(100.0, clock))
    done = run_stage(load_study(path), "identify", tmp_path / "s", options)
    assert not done.data["parameters"] and done.data["not_tried"][-1] == "all of a"
    assert done.data["unsettled"]["a"]["text"] == "Nothing of it was tried: its group had not been begun."


@pytest.mark.parametrize("until", ["'up' alone", "comparison"])
def test_estimates_that_were_found_are_told_though_what_follows_was_not_done(tmp_path: Path, until: str) -> None:
    folder = tmp_path / "r"
    path = write_small_study(tmp_path)
    whole = run_stage(load_study(path), "fit", tmp_path / "s", StageOptions()).data
    clock = Clock(f"fit: {until}")
    options = StageOptions(progress=clock.progress, budget=Budget.of(100.0, clock))
    done = run_stage(load_study(path), "fit", folder, options)
    assert done.unfinished and done.failed and done.data["status"] == whole["status"]
    assert done.data["estimates"] == whole["estimates"]
    if "up" in until:
        assert list(done.data["per_experiment"]["k"]["experiments"]) == ["up"]
    else:
        assert done.data["per_experiment"] == whole["per_experiment"]
    summary = json.loads((folder / "summary.json").read_text())
    assert "fit" in summary["failures"] and summary["parameters"][0]["fitted"] is not None


def test_a_fit_that_was_not_begun_says_so(tmp_path: Path) -> None:
    """Its budget was over in what it builds on: nothing is fitted of a report that was not ended."""
    folder = tmp_path / "r"
    clock = ended(tmp_path, "profile of k", lambda study, options: run_stage(study, "fit", folder, options))
    data = json.loads((folder / "fit.json").read_text())
    assert data["status"] == "unfinished" and "the search for the optimum" in data["not_tried"]
    assert not any(text.startswith("fit:") for text in clock.said)


def test_sides_that_were_walked_to_their_ends_are_told() -> None:
    walked = {("k", -1.0): Side("closed", 3.5), ("k", 1.0): Side("closed", 6.0), ("a", -1.0): Side("closed", 1.0)}
    found = ProfilesSoFar.of(walked, [(n, d) for n in ("k", "a", "b") for d in (-1.0, 1.0)])
    assert found.done == ("profile of k walked",) and found.not_tried == ("the rest of the profiles of a and b",)
    assert found.ends["a"][1] is None and found.ends["b"] == (None, None)
