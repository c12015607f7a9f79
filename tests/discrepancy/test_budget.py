"""The extent of a search: larger where a thorough one is asked for, smaller once its budget is over."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hvdc_ident import Experiment
from hvdc_ident.budget import Budget
from hvdc_ident.discrepancy import Diagnosis, DiagnosisOptions, diagnose, hypothesis
from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.hypothesis import Refit, RefitJob
from hvdc_ident.discrepancy.moves import effects as effect_moves
from tests.discrepancy.cases import FREE, TRUE, experiments, model

NAMES = ["lag", "gain", "limit", "deadband"]
ENDLESS = Budget(1.0, 0.0, lambda: 0.0)


class Ending:
    """A budget, and progress with which it ends: once a text begins so."""

    def __init__(self, text: str) -> None:
        self.text, self.over, self.told = text, False, list[str]()
        self.budget = Budget(1.0, 0.0, lambda: 2.0 if self.over else 0.0)

    def __call__(self, done: int, total: int, text: str) -> None:
        self.told.append(text)
        self.over = self.over or text.startswith(self.text)


def rough() -> tuple[Experiment, ...]:
    """Records of the drive whose meter of the torque jumps where the speed passes a level, either way by itself."""
    found = []
    for e in experiments():
        assert e.measured is not None
        w, torque = e.measured["w"], e.measured["torque"]
        values = np.column_stack([w, torque + 0.05 * np.tanh((w - 1.02) / 0.01)])
        found.append(replace(e, measured=replace(e.measured, values=values)))
    return tuple(found)


def test_more_is_refitted_where_a_thorough_search_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(effect_moves, "REFITS_PER_EFFECT", 1)
    begun: list[str] = []
    plain = hypothesis.refit_job

    def counted(before: Refit, candidate: CandidateEffect, *given: Any) -> RefitJob:
        begun.append(candidate.label)
        return plain(before, candidate, *given)

    monkeypatch.setattr("hvdc_ident.discrepancy.expansion.refit_job", counted)
    count, done = dict[bool, int](), dict[bool, Diagnosis]()
    for thorough in (False, True):
        options = DiagnosisOptions(bootstraps=100, most=1, thorough=thorough, fallback=False, budget=ENDLESS)
        begun.clear()
        done[thorough] = diagnose(model(), rough(), FREE, effects=NAMES, options=options)
        count[thorough] = len(set(begun))
    assert count[True] > 2 * count[False]
    assert any("thorough" in note for note in done[False].notes)
    assert not any("thorough" in note for note in done[True].notes)


def test_a_budget_ends_the_search_and_what_was_not_tried_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(effect_moves, "REFITS_PER_EFFECT", 1)
    ending = Ending("round 1: lag")
    options = DiagnosisOptions(bootstraps=100, budget=ending.budget)
    found = diagnose(model(), rough(), FREE, effects=NAMES, options=options, progress=ending)
    assert ending.over and any("The budget ended before" in note for note in found.notes)
    assert len({line.round for line in found.candidates}) == 1
    # What was refitted is told as no verdict: the others, which say why they were not, may explain more.
    assert found.verdict == "unfinished" and not found.effects and not found.findings and found.augmented is None
    status = [line.status for line in found.candidates]
    assert status.count("refitted") >= 1 and any("the budget ended" in s for s in status)


@pytest.mark.parametrize("text", ["", "with J free", "round 1: the signals", "round 1: 40 candidates"])
def test_wherever_a_budget_ends_what_was_found_so_far_is_told(text: str) -> None:
    """Before anything was tried nothing is; after the stated values the wrong one is, and that effects were not tried."""
    ending = Ending(text)
    options = DiagnosisOptions(bootstraps=100, budget=ending.budget)
    card = model().with_values({"J": 0.12})
    found = diagnose(card, experiments(), FREE, effects=NAMES, options=options, progress=ending)
    assert ending.over and not found.effects and found.notes
    if not text:
        assert found.verdict == "unfinished" and not found.findings and not found.candidates
        return
    assert [f.effect for f in found.findings] == ["parameter"]
    low, high = found.findings[0].parameters["J"].ci95 or (None, None)
    assert low is not None and high is not None and low < TRUE["J"] < high
    assert any("budget" in note for note in found.notes)


def test_a_search_without_a_budget_has_a_minute_of_the_processor_or_with_workers_of_the_clock() -> None:
    alone = DiagnosisOptions().budget_from_now(None)
    assert alone is not None and (alone.seconds, alone.clock) == (60.0, time.process_time)
    with ThreadPoolExecutor(1) as pool:
        shared = DiagnosisOptions(budget=5.0).budget_from_now(pool)
    assert shared is not None and (shared.seconds, shared.clock) == (5.0, time.monotonic)
    assert DiagnosisOptions(thorough=True).budget_from_now(None) is None
    asked = DiagnosisOptions(thorough=True, budget=7.0).budget_from_now(None)
    assert asked is not None and asked.seconds == 7.0
    begun = Budget(3.0, 0.0, lambda: 1.0)
    assert DiagnosisOptions(budget=begun).budget_from_now(None) is begun
