"""The list of studies names every study and shows what each one's expected.json holds."""

from __future__ import annotations

import sys

import pytest

from tests.studies.study_module import STUDIES

sys.path.insert(0, str(STUDIES))
import index

pytestmark = pytest.mark.nightly

LIST = (STUDIES / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", index.HEADLINES)
def test_the_headline_is_what_the_study_holds(name):
    assert index.row(name) in LIST.splitlines(), "write it anew: python studies/index.py"


@pytest.mark.parametrize("name", index.folders())
def test_every_study_is_listed(name):
    assert f"({name})" in LIST, "write it anew: python studies/index.py"
