"""The extent of a search: larger where a thorough one is asked for, smaller once its budget is over."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hvdc_ident import Experiment
from hvdc_ident.budget import Budget
from hvdc_ident.discrepancy import Diagnosis, DiagnosisOptions, diagnose, hypothesis, search
from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.hypothesis import Refit, RefitJob
from tests.discrepancy.cases import FREE, experiments, model

NAMES = ["lag", "gain", "limit", "deadband"]


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
    monkeypatch.setattr(search, "REFITS_PER_EFFECT", 1)
    begun: list[str] = []
    plain = hypothesis.refit_job

    def counted(before: Refit, candidate: CandidateEffect, *given: Any) -> RefitJob:
        begun.append(candidate.label)
        return plain(before, candidate, *given)

    monkeypatch.setattr("hvdc_ident.discrepancy.rounds.refit_job", counted)
    count, done = dict[bool, int](), dict[bool, Diagnosis]()
    for thorough in (False, True):
        options = DiagnosisOptions(bootstraps=100, thorough=thorough, fallback=False)
        begun.clear()
        done[thorough] = diagnose(model(), rough(), FREE, effects=NAMES, options=options)
        count[thorough] = len(set(begun))
    assert count[True] > 2 * count[False]
    assert any("thorough" in note for note in done[False].notes)
    assert not any("thorough" in note for note in done[True].notes)


def test_a_budget_ends_the_search_and_what_was_not_tried_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search, "REFITS_PER_EFFECT", 1)
    options = DiagnosisOptions(bootstraps=100, budget=Budget(1.0, 0.0, lambda: 2.0))
    found = diagnose(model(), rough(), FREE, effects=NAMES, options=options)
    assert any("The budget ended before" in note for note in found.notes)
    assert len({line.round for line in found.candidates}) == 1
    # What was refitted is told as no verdict: the others, which say why they were not, may explain more.
    assert found.verdict == "unfinished" and not found.effects and not found.findings and found.augmented is None
    status = [line.status for line in found.candidates]
    assert status.count("refitted") >= 1 and any("the budget ended" in s for s in status)
