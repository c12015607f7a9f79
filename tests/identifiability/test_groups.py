"""The individual mode: each group judged on its own data, the others held; the fit states the group's intervals."""

from __future__ import annotations

import json

import pytest

from hvdc_ident.data import InputSignal
from hvdc_ident.errors import StudyError
from hvdc_ident.fit import FitParameter, Group
from hvdc_ident.identifiability import identifiability, identifiability_by_group
from tests.identifiability.cases import on_model, pi_loop

STEP = {"r": InputSignal.step(1.0, 0.0, 1.0)}
GROUPS = [Group(("a", "b"), ("y",)), Group(("kp", "ki"), ("control",))]


def case(outputs=("y", "control")):
    model = pi_loop()
    free = [FitParameter(n, v, v / 10, v * 10) for n, v in model.values.items()]
    return model, [on_model(model, "e", STEP, list(outputs), 1e-3)], free


def test_every_group_is_judged_on_its_own_data() -> None:
    """From y alone a, b, kp and ki cannot be told together; each pair can while the other is held."""
    model, data, free = case()
    report = identifiability_by_group(model, data, free, GROUPS, starts=1)
    assert tuple(report.parameters) == report.identifiable == ("a", "b", "kp", "ki") and not report.combinations
    alone = identifiability(
        model,
        [data[0].with_(measured=data[0].measured.select(["y"]))],
        free[:2],
        held={"kp": 2.0, "ki": 1.1},
        starts=1,
    )
    assert report.parameters["a"].ci95 == pytest.approx(alone.parameters["a"].ci95)
    assert any(n == "a, b: judged alone, on y in e, the other candidates held." for n in report.notes)
    assert set(report.experiments["e"].information) == set(model.values)


def test_later_groups_hold_what_earlier_ones_found() -> None:
    model, data, free = case()
    begun = [FitParameter("a", 0.4, 0.08, 8), FitParameter("b", 0.9, 0.15, 15), *free[2:]]
    report = identifiability_by_group(model, data, begun, GROUPS, starts=2)
    first = {n: report.parameters[n].value for n in ("a", "b")}
    seen = [data[0].with_(measured=data[0].measured.select(["control"]))]
    second = identifiability(model, seen, free[2:], held=first, starts=2)
    for n in ("kp", "ki"):
        assert report.parameters[n].value == pytest.approx(second.parameters[n].value, rel=1e-6)


def test_one_report_in_json_with_advice_for_who_needs_it() -> None:
    model, _, free = case()
    still = [FitParameter("a", 0.8, 0.799, 0.801), *free[1:]]  # its range is too small to be seen in coarse data
    coarse = [on_model(model, "e", STEP, ["y", "control"], 0.05)]
    groups = [Group(("kp", "ki"), ("control",)), Group(("b", "a"), ("y",))]
    report = identifiability_by_group(model, coarse, still, groups, pair=("a", "kp"), starts=1)
    assert report.parameters["a"].verdict == "insensitive" and report.held["a"].value == 0.8
    found = report.to_dict()
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert list(found["parameters"]) == ["a", "b", "kp", "ki"] and len(found["pilot"]["groups"]) == 2
    assert any(n.startswith("To measure next for kp, ki: ") for n in report.notes)
    assert any("No common profile of a and kp" in n for n in report.notes)


def test_groups_hold_every_candidate_once() -> None:
    model, data, free = case()
    with pytest.raises(StudyError, match="every free parameter once"):
        identifiability_by_group(model, data, free, GROUPS[:1])
