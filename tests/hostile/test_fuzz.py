"""Spoilt inputs of every kind, 500 each: no exception but an InputError, nothing written beside the input."""

from __future__ import annotations

from pathlib import Path

import fuzz
import pytest

pytestmark = pytest.mark.nightly

RUNS = 500
SEED = 20_261_121


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", sorted(fuzz.KINDS))
def test_spoilt_inputs_are_refused_or_read(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "work"
    folder.mkdir()
    monkeypatch.chdir(tmp_path)
    kind = fuzz.KINDS[name]
    kind.good(folder)
    wrong = {}
    for number, content in fuzz.cases(kind, folder, SEED, 8 if kind.slow else RUNS):
        if bad := fuzz.outcome(kind, content, folder):
            wrong[number] = bad
    assert not wrong, f"{len(wrong)} of {RUNS}: {dict(list(wrong.items())[:5])}"
    assert [p.name for p in tmp_path.iterdir()] == ["work"]


@pytest.mark.parametrize("name", sorted(fuzz.KINDS))
def test_the_examples_themselves_are_good(name: str, tmp_path: Path) -> None:
    kind = fuzz.KINDS[name]
    for example in kind.good(tmp_path):
        kind.use(example, tmp_path)
