"""The README's examples run, and what it links to is there."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from hvdc_ident.study.examples import write_starter
from hvdc_ident.study.study import load_study

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "README.md").read_text("utf-8")
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def test_the_python_example_prints_a_fit_and_a_linear_model(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = (c for kind, c in BLOCK.findall(TEXT) if kind == "python")
    exec(compile(code, "README.md", "exec"), {"__name__": "readme"})
    printed = capsys.readouterr().out
    assert re.search(r"^KIVDC +700(\.0+)? ", printed, re.MULTILINE) and "stable" in printed


def test_the_study_is_one_that_is_read(tmp_path: Path) -> None:
    (study,) = (c for kind, c in BLOCK.findall(TEXT) if kind == "toml")
    write_starter(tmp_path)
    (tmp_path / "study.toml").write_text(study, "utf-8")
    loaded = load_study(tmp_path / "study.toml")
    assert list(loaded.candidates) == list(tomllib.loads(study)["parameters"])
    assert loaded.experiments[0].name == "step-up"


def test_links_lead_to_files() -> None:
    targets = re.findall(r"\]\(([^)#]+)\)", TEXT)
    assert len(targets) > 10
    assert not [t for t in targets if not (ROOT / t).exists()]
