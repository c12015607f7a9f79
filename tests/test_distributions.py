"""The sdist and the wheel hold what they need, and the installed wheel works away from the sources."""

from __future__ import annotations

import email
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

from hvdc_ident.simulate.core import BUILDS

pytestmark = pytest.mark.nightly

ROOT = Path(__file__).resolve().parents[1]
KEPT_OUT = shutil.ignore_patterns("__pycache__", ".*", "*-results", "build", "dist", "*.egg-info")
BUILD = "import sys; sys.path.insert(0, ''); import build_backend as b; print(getattr(b, sys.argv[1])(sys.argv[2]))"
DATA = re.compile(r"\.(toml|j2|html|css|js|c|h)$|(py\.typed|LICENSE)$")


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The sdist of a copy of the sources, and the wheel of what the sdist unpacks to, as an installer builds it."""
    folder = tmp_path_factory.mktemp("distributions")
    shutil.copytree(ROOT, folder / "copy", ignore=KEPT_OUT)
    sdist = folder / _build("build_sdist", folder / "copy", folder)
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    unpacked = folder / sdist.name.removesuffix(".tar.gz")
    return {"sdist": sdist, "wheel": folder / _build("build_wheel", unpacked, folder)}


def _build(kind: str, source: Path, to: Path) -> str:
    done = subprocess.run([sys.executable, "-c", BUILD, kind, str(to)], cwd=source, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr, done.stderr
    return done.stdout.splitlines()[-1]


def _package_files() -> set[str]:
    """The modules and the data of the package in the sources."""
    paths = (p.relative_to(ROOT) for p in (ROOT / "hvdc_ident").rglob("*") if "__pycache__" not in p.parts)
    return {p.as_posix() for p in paths if p.suffix in (".py", ".pyi") or DATA.search(p.name)}


def test_the_wheel_holds_the_package_with_its_data_and_nothing_else(built: dict[str, Path]) -> None:
    with zipfile.ZipFile(built["wheel"]) as archive:
        held = {n for n in archive.namelist() if ".dist-info/" not in n}
    wanted = _package_files()
    core = {f"hvdc_ident/simulate/core/core-{build}.so.1" for build in BUILDS}
    assert held == wanted | core
    endings = {p.rpartition(".")[2] for p in held}
    assert endings >= {"py", "typed", "toml", "j2", "css", "js", "c", "h"}


def test_the_sdist_holds_the_sources_with_tests_and_guides(built: dict[str, Path]) -> None:
    with tarfile.open(built["sdist"]) as archive:
        held = {m.name.partition("/")[2] for m in archive.getmembers() if m.isfile()}
    own = {p.relative_to(ROOT).as_posix() for room in ("tests", "docs", "studies") for p in (ROOT / room).rglob("*.*")}
    own = {p for p in own if p.endswith((".py", ".md", ".toml", ".csv", ".c")) and "-results/" not in p}
    top = {"README.md", "LICENSE", "CITATION.cff", "CHANGELOG.md", "pyproject.toml", "mkdocs.yml"}
    assert held >= _package_files() | own | top


def test_a_wheel_for_another_platform_asks_for_zig_and_an_unknown_one_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The requirements alone: zig is too large to fetch for a test."""
    monkeypatch.syspath_prepend(str(ROOT))
    import build_backend

    monkeypatch.setattr(build_backend.importlib.util, "find_spec", lambda name: None)  # zig is not there yet
    monkeypatch.setenv("HVDC_IDENT_PLATFORM", "macosx_11_0_arm64")
    assert any(r.startswith("ziglang") for r in build_backend.get_requires_for_build_wheel())
    monkeypatch.setenv("HVDC_IDENT_PLATFORM", "beos")
    with pytest.raises(ValueError, match=r"expected one of manylinux2014_x86_64.*got beos"):
        build_backend.get_requires_for_build_wheel()


def test_the_metadata_say_what_an_index_shows(built: dict[str, Path]) -> None:
    with zipfile.ZipFile(built["wheel"]) as archive:
        name = next(n for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
        data = email.message_from_bytes(archive.read(name))
    description = bytes(data.get_payload(decode=True)).decode("utf-8")  # type: ignore[arg-type]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert data["Version"] == project["version"] and data["Summary"] == project["description"]
    assert data["License-Expression"] == "BSD-3-Clause" and data["Requires-Python"] == ">=3.11"
    assert "Typing :: Typed" in data.get_all("Classifier", [])
    assert (ROOT / "README.md").read_text("utf-8").strip() == description.strip()
    citation = (ROOT / "CITATION.cff").read_text("utf-8")
    assert f"version: {project['version']}\n" in citation


def test_the_installed_wheel_works_away_from_the_sources(built: dict[str, Path], tmp_path: Path) -> None:
    """In an environment of its own; the dependencies are those of the environment that runs the tests."""
    venv.create(tmp_path / "venv", with_pip=False)
    python = tmp_path / "venv" / "bin" / "python"
    arguments = ["--no-deps", "--no-index", "--no-compile", "--quiet", str(built["wheel"])]
    subprocess.run([sys.executable, "-m", "pip", "--python", str(python), "install", *arguments], check=True)
    own = Path(sysconfig.get_path("purelib", vars={"base": str(tmp_path / "venv")}))
    (own / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n", "utf-8")
    work = tmp_path / "work"
    work.mkdir()
    away = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONSAFEPATH")}

    def run(*command: str) -> str:
        done = subprocess.run(command, cwd=work, env=away, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    program = str(python.parent / "hvdc-ident")
    version = built["wheel"].name.split("-")[1]
    assert run(program, "--version").split() == ["hvdc-ident", version]
    assert "vsc-hvdc-link" in run(program, "models")
    assert Path(run(str(python), "-c", "import hvdc_ident as h; print(h.__file__)").strip()).is_relative_to(own)
    run(program, "new", "study")
    run(program, "simulate", "study/study.toml", "--quiet")
    assert (work / "study" / "study-results" / "simulation.json").is_file()
