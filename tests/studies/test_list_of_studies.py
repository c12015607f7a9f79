"""The list of studies names every study and shows what each one's expected.json holds."""

from __future__ import annotations

import sys

from tests.studies.study_module import STUDIES

sys.path.insert(0, str(STUDIES))
import index


def test_the_list_is_what_the_studies_hold():
    written = (STUDIES / "README.md").read_text(encoding="utf-8")
    assert written == index.text(), "write it anew: python studies/index.py"
    for folder in STUDIES.glob("*/run.py"):
        assert f"({folder.parent.name})" in written
