"""Runs that the workbench starts: in a process of their own, one in a folder, the same results, nothing lost by a kill."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from typer.testing import CliRunner

import hvdc_ident as hi
from hvdc_ident.app.runs import EVERYTHING, Runs, StudyRun, first_folder, result_folders, signature, standings
from hvdc_ident.cli import app
from hvdc_ident.errors import InputError
from hvdc_ident.study.pipeline import run_stage
from hvdc_ident.study.stages import StageOptions
from hvdc_ident.study.store import exclusive
from tests.app.small_study import CARD, SECONDS, hold, write_small_study


def states(study: hi.Study) -> dict[str, str]:
    return {s.stage.name: s.state for s in standings(study, study.folder) if s.asked}


def test_a_run_writes_what_the_command_line_writes(finished: tuple[hi.Study, StudyRun], tmp_path: Path) -> None:
    study, _ = finished
    assert states(study) == dict.fromkeys(("simulate", "identify", "fit", "diagnose"), "done")
    typed = ["run", str(study.path), "--quiet", "--out", str(tmp_path / "out")]
    assert CliRunner().invoke(app, typed).exit_code == 0
    own, other = ({p.name for p in f.iterdir()} for f in (study.folder, tmp_path / "out"))
    assert own == other and {"report.html", "run.json", "fit.json"} <= own
    fits = [json.loads((f / "fit.json").read_text()) for f in (study.folder, tmp_path / "out")]
    assert fits[0] == fits[1]


def test_the_fit_is_that_of_the_verb(finished: tuple[hi.Study, StudyRun]) -> None:
    study, _ = finished
    fit = next(s.data for s in standings(study, study.folder) if s.stage.name == "fit")
    assert fit["estimates"]["k"]["value"] == pytest.approx(hi.fit(study).values["k"], rel=1e-9)


def test_a_changed_study_is_stale_and_its_signature_another(small_study: hi.Study) -> None:
    study = small_study
    assert set(states(study).values()) == {"not run"}
    before = signature(study, study.folder)
    run_stage(study, "simulate", study.folder, StageOptions())
    assert states(study)["simulate"] == "done" and signature(study, study.folder) != before
    study.path.write_text(study.path.read_text().replace("max = 20", "max = 30"))
    changed = hi.load_study(study.path)
    assert states(changed)["simulate"] == "stale" and signature(changed, study.folder) != before


def test_a_stage_that_fails_says_why(small_study: hi.Study) -> None:
    study = small_study
    (study.path.parent / "lag.toml").write_text(CARD.replace("k*(2.0*u - x)", "k*(2.0*u - x) + exp(40.0*x**2) - 1.0"))
    broken = hi.load_study(study.path)
    assert run_stage(broken, "simulate", broken.folder, StageOptions()).failed
    (found,) = (s for s in standings(broken, broken.folder) if s.stage.name == "simulate")
    assert found.state == "failed" and found.why


def test_what_is_wrong_with_a_study_is_told(small_study: hi.Study) -> None:
    study = small_study
    (study.path.parent / "up.csv").unlink()
    run = Runs().start(study, study.folder)
    assert run.wait(SECONDS) == "failed" and "up.csv" in run.message and not study.folder.exists()


def test_a_run_is_cancelled_and_cannot_be_started_twice(small_study: hi.Study) -> None:
    study = small_study
    hold(study.path)
    held = hi.load_study(study.path, trust=True)
    runs = Runs()
    run = runs.start(held, held.folder, trust=True)
    with pytest.raises(InputError, match="'run' is at work in this folder"):
        runs.start(held, held.folder, "fit", trust=True)
    assert runs.of(held.folder) is run and run.outcome == "running"
    run.cancel()
    assert run.wait(SECONDS) == "cancelled" and run.message == ""


def test_another_process_in_the_folder_is_not_disturbed(small_study: hi.Study) -> None:
    study = small_study
    with exclusive(study.folder):
        run = Runs().start(study, study.folder)
        assert run.wait(SECONDS) == "failed" and "another run is at work in this folder" in run.message


def test_a_killed_server_loses_nothing(finished: tuple[hi.Study, StudyRun], tmp_path: Path) -> None:
    """A server that starts a run is killed once the first stage is written: the work ends with it, and the next goes on."""
    study = hi.load_study(write_small_study(tmp_path))
    server = f"""
        import sys
        import hvdc_ident as hi
        from hvdc_ident.app.runs import Runs
        study = hi.load_study({str(study.path)!r})
        run = Runs().start(study, study.folder)
        print(run._child.guard.pid, flush=True)
        sys.stdin.read()
        """
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(server)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        worker = int(process.stdout.readline())
        ended = os.pidfd_open(worker)
        while not (study.folder / "simulation.json").exists():
            assert not select.select([ended], [], [], 0.1)[0]
        process.send_signal(signal.SIGKILL)
    written = (study.folder / "simulation.json").stat().st_mtime_ns
    assert select.select([ended], [], [], SECONDS)[0]  # it ends by itself
    os.close(ended)
    run = Runs().start(study, study.folder, EVERYTHING)
    assert run.wait(SECONDS) == "done", run.message
    assert (study.folder / "simulation.json").stat().st_mtime_ns == written
    fits = [json.loads((s.folder / "fit.json").read_text())["values"] for s in (study, finished[0])]
    assert fits[0] == fits[1]


def test_results_are_looked_for_beside_the_study_and_nowhere_else(
    finished: tuple[hi.Study, StudyRun], tmp_path: Path
) -> None:
    study = hi.load_study(write_small_study(tmp_path))
    assert result_folders(study) == (study.folder,) and first_folder(study) == study.folder
    (tmp_path / "elsewhere").symlink_to(finished[0].folder)  # a link out of the study's folder
    assert result_folders(study) == (study.folder,)
    for file in finished[0].folder.glob("*.json"):
        (tmp_path / file.name).write_bytes(file.read_bytes())  # as `--out .` writes
    assert result_folders(study) == (study.folder, tmp_path) and first_folder(study) == tmp_path
