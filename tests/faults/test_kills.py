"""A run killed as it keeps its work goes on from there: same tables, and nothing but the running piece is done again."""

from __future__ import annotations

import os
from collections import Counter

import pytest

from tests.faults import cases, forks

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="processes cannot be forked here")


@pytest.mark.parametrize(
    ("stage", "kills"), [("sweep", (1, 17, 20)), ("identify", (3, 6, 9)), ("diagnose", (2, 100, 9))]
)
def test_after_kills_the_tables_are_those_of_an_undisturbed_run(tmp_path, stage, kills):
    path = cases.write_study(tmp_path, hidden=0.02 if stage == "diagnose" else 0.0)
    log = tmp_path / "killed.log"
    forks.run(stage, path, "--out", tmp_path / "whole")
    for at in kills:
        assert forks.forked((stage, path, "--out", tmp_path / "killed"), log, at=at)[0] == -9
    assert forks.forked((stage, path, "--out", tmp_path / "killed"), log) == (0, "")
    for name in cases.TABLES[stage]:
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    done = Counter(note.work for note in forks.notes(log))
    assert sum(done.values()) == len(done) + len(kills)  # only what was being kept when the kill came
    assert max(done.values()) == 2
