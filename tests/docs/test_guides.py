"""Every block of the guides is run, in order, in an empty folder."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hvdc_ident.cli import app
from hvdc_ident.study.json_schema import FILES, reference

pytestmark = pytest.mark.nightly

ROOT = Path(__file__).resolve().parents[2]
WITHOUT_BLOCKS = ("workbench.md", "index.md", "report.md")
GUIDES = sorted(p for p in (ROOT / "docs").glob("*.md") if p.name not in WITHOUT_BLOCKS)
TOML = re.compile(r"^ *```toml\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)
BLOCK = re.compile(r"^```(console|python)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("guide", GUIDES, ids=lambda p: p.stem)
def test_a_guide_runs_from_top_to_bottom(guide: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "guide"}
    blocks = BLOCK.findall(guide.read_text("utf-8"))
    assert len(blocks) >= 4
    for kind, code in blocks:
        if kind == "python":
            exec(compile(code, f"{guide.name}", "exec"), names)
        else:
            _shell(code)


def _shell(code: str) -> None:
    for line in code.splitlines():
        prompt, _, command = line.partition(" ")
        assert prompt == "$", line
        program, *arguments = shlex.split(command)
        assert program == "hvdc-ident", line
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 0, f"{line}\n{result.output}"


@pytest.mark.parametrize("name", WITHOUT_BLOCKS)
def test_a_page_without_blocks_has_none(name: str) -> None:
    assert not BLOCK.findall((ROOT / "docs" / name).read_text("utf-8"))


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("*.md")), ids=lambda p: p.stem)
def test_toml_blocks_are_toml_with_keys_that_are_read(page: Path) -> None:
    known = {k.name for file in FILES for keys in reference(file).values() for k in keys}
    for block in TOML.findall(page.read_text("utf-8")):
        assert set(tomllib.loads(block)) <= known, block
