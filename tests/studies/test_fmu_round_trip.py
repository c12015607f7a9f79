"""The round trip through FMUs, on its smallest model; and that the study's limits can fail."""

from __future__ import annotations

import pytest

from hvdc_ident.fmu.compile import compiler
from hvdc_ident.model import parse_card
from tests.studies.study_module import expected, load

pytestmark = pytest.mark.nightly

STUDY, KNOWN = load("fmu_round_trip"), expected("fmu_round_trip")
CARD = """
schema = 1
name = "first order with a limit"
[parameters]
T = {value = 0.02, unit = "s", min = 0.0}
[inputs]
Pref = {value = 0.4}
[states]
y = {derivative = "clip((Pref - y) / T, -2, 2)"}
[outputs]
y = "y"
rate = "clip((Pref - y) / T, -2, 2)"
"""


@pytest.mark.skipif(compiler() is None, reason="there is no C compiler")
def test_a_small_model_comes_back_the_same(tmp_path, monkeypatch):
    monkeypatch.setenv("CFLAGS", "-O0")
    row = STUDY.agreement(parse_card(CARD), tmp_path)
    assert {"ME 2", "CS 2", "ME 3", "CS 3", "A, B, C, D"} == set(row)
    assert STUDY.beyond({"agreement": {"small": row}, "studies": {}}, KNOWN["limits"]) == []


def test_what_is_beyond_a_limit_is_named():
    apart = {"identifiable": ["a"], "CS": {"identifiable": ["a", "b"], "share of std": 0.1}}
    found = STUDY.beyond(
        {"agreement": {"m": {"CS 2": 1.0, "A, B, C, D": 1e-8}}, "studies": {"s": apart}}, KNOWN["limits"]
    )
    assert len(found) == 4 and "m, CS 2" in found[0] and "identifiable" in found[2]


def test_the_pinned_numbers_are_within_the_limits():
    assert KNOWN["values"] and STUDY.beyond(KNOWN["values"], KNOWN["limits"]) == []
