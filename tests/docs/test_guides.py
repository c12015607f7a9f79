"""Every block of the guides is run, in order, in an empty folder; the site builds without a warning."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hvdc_ident.cli import app

ROOT = Path(__file__).resolve().parents[2]
GUIDES = sorted(p for p in (ROOT / "docs").glob("*.md") if p.name != "index.md")
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


def test_the_site_builds(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert {p.stem for p in (tmp_path / "site").iterdir()} >= {g.stem for g in GUIDES}
