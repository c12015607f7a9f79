"""One stream of a run: what fails does not hide what asks why, and no stage runs another one again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from hvdc_ident.budget import Budget
from hvdc_ident.cli import app
from hvdc_ident.study import pipeline
from hvdc_ident.study.pipeline import have_stage, run_all, run_stage
from hvdc_ident.study.stages import StageOptions
from hvdc_ident.study.study import load_study
from tests.app.small_study import write_small_study


@pytest.fixture
def run_stages(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the stages that really ran, in their order."""
    names: list[str] = []
    plain = pipeline._run

    def counted(study: Any, wanted: Any, *rest: Any) -> Any:
        names.append(wanted.name)
        return plain(study, wanted, *rest)

    monkeypatch.setattr(pipeline, "_run", counted)
    return names


def ample() -> Budget:
    """Return a budget whose clock stands still."""
    return Budget(1000.0, 0.0, lambda: 0.0)


def bounded(folder: Path, low: float, high: float) -> Path:
    """Return the small study, whose k is 5 1/s, with other bounds."""
    study = write_small_study(folder)
    study.write_text(study.read_text().replace("k = {min = 0.5, max = 20}", f"k = {{min = {low}, max = {high}}}"))
    return study


def test_where_the_fit_is_refused_the_diagnosis_asks_why(tmp_path: Path, run_stages: list[str]) -> None:
    study = load_study(bounded(tmp_path, 0.5, 4.2))
    done = {d.stage.name: d for d in run_all(study, tmp_path / "r", StageOptions())}
    assert "k is" in done["fit"].failed and not done["diagnose"].failed
    assert done["diagnose"].data["verdict"] in ("named", "ambiguous", "unnameable")
    assert run_stages == ["simulate", "identify", "fit", "diagnose"], "each once"


def test_no_stage_runs_another_one_again(tmp_path: Path, run_stages: list[str]) -> None:
    """Neither one that failed, nor one that ended with other options."""
    study, folder = load_study(bounded(tmp_path, 0.5, 4.2)), tmp_path / "r"
    run_all(study, folder, StageOptions())
    run_stages.clear()
    run_stage(study, "diagnose", folder, StageOptions(budget=ample()))
    assert run_stages == ["diagnose"]
    run_stages.clear()
    assert have_stage(study, "diagnose", folder, StageOptions(seed=3)).data["seed"] == 0
    run_all(study, folder, StageOptions(budget=ample()))
    assert run_stages == ["fit"], "a run asks again what failed, and that alone"


def test_a_letter_reads_the_diagnosis_that_is_there(tmp_path: Path, run_stages: list[str]) -> None:
    path = write_small_study(tmp_path)
    for command in ("run", "letter", "letter --seed 3"):
        result = CliRunner().invoke(app, [*command.split(), str(path)])
        assert result.exit_code == 0, result.output
        written = (tmp_path / "study-results" / "discrepancy.json").stat().st_mtime_ns
        if command == "run":
            first = written
            run_stages.clear()
    assert written == first and run_stages == []
