"""The store: what was kept survives a kill at any instant, one run at a time, the same table in the end."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hvdc_ident.cli import app
from hvdc_ident.errors import InputError
from hvdc_ident.study.store import Store, exclusive

CARD = """
schema = 1
name = "lag"
[parameters]
k = {value = 2.0, min = 0.0, max = 1000.0}
[inputs]
u = {value = 1.0}
[states]
x = {derivative = "u - k*x"}
[outputs]
y = "x"
"""
STUDY = """
schema = 1
[model]
source = "lag.toml"
[[experiment]]
name = "e"
data = "e.csv"
inputs = ["u"]
outputs = ["y"]
event = 0.5
"""
GRID = '[[sweep]]\nparameter = "k"\nmin = 0\nmax = 4\npoints = {points}\n'
WORKER = """
import os, signal, sys, threading
from pathlib import Path
from hvdc_ident.sensitivity import sweep_points
from hvdc_ident.study.pipeline import run_stage
from hvdc_ident.study.stages import StageOptions
from hvdc_ident.study.study import load_study
study, points, delay = load_study(sys.argv[1]), int(sys.argv[3]), float(sys.argv[4])
run, done = sweep_points.PointTask.__call__, []


def counted(self, p):
    done.append(p)
    if len(done) == points:  # and any instant of the next points
        threading.Timer(delay, os.kill, (os.getpid(), signal.SIGKILL)).start()
    return run(self, p)


sweep_points.PointTask.__call__ = counted
run_stage(study, "sweep", Path(sys.argv[2]), StageOptions())
"""
HOLD = "import sys; from pathlib import Path; from hvdc_ident.study.store import exclusive\n"
HOLD += "with exclusive(Path(sys.argv[1])):\n print('held', flush=True); sys.stdin.read()"


def study(folder: Path, sweep: str) -> Path:
    t = np.arange(101) * 0.01
    u = np.where(t >= 0.5, 2.0, 1.0)
    y = 0.5 + np.where(t >= 0.5, 0.5 * (1 - np.exp(-2 * (t - 0.5))), 0)
    rows = "\n".join(f"{a:.2f},{b:g},{c:.9f}" for a, b, c in zip(t, u, y, strict=True))
    (folder / "e.csv").write_text(f"time,u,y\n{rows}\n")
    (folder / "lag.toml").write_text(CARD)
    (folder / "s.toml").write_text(STUDY + sweep)
    return folder / "s.toml"


def sweep(*arguments: object) -> str:
    result = CliRunner().invoke(app, ["sweep", *map(str, arguments), "--quiet"])
    assert result.exit_code == 0, result.output
    return result.output


def test_killed_at_random_instants_the_table_is_the_same(tmp_path):
    path = study(tmp_path, GRID.format(points=4000))
    sweep(path, "--out", tmp_path / "whole")
    draws = random.Random(5)
    for _ in range(4):
        # A point takes well over 10 us, so that the points left outlast the delay on any machine.
        points, delay = draws.randint(1, 600), draws.uniform(0.0, 0.01)
        arguments = [sys.executable, "-c", WORKER, *map(str, (path, tmp_path / "killed", points, delay))]
        assert subprocess.run(arguments).returncode == -signal.SIGKILL, "the sweep ended before it was killed"
    with Store(tmp_path / "killed") as store:
        assert store._base is not None
        kept = store._base.execute("SELECT count(*) FROM kept").fetchone()[0]
        assert store._base.execute("PRAGMA integrity_check").fetchone()[0] == "ok"
    assert 0 < kept < 4000
    sweep(path, "--out", tmp_path / "killed")
    for name in ("sweep.csv", "sweep.json"):
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_one_run_at_a_time_and_no_lock_left_behind(tmp_path):
    path = study(tmp_path, GRID.format(points=5))
    folder = tmp_path / "r"
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        result = CliRunner().invoke(app, ["sweep", str(path), "--out", str(folder)])
        assert result.exit_code == 2
        assert "another run is at work in this folder" in result.stderr and str(folder) in result.stderr
        process.kill()
    sweep(path, "--out", folder)
    with exclusive(folder), exclusive(folder):
        pass  # within one process it may be asked for again


def test_a_folder_made_for_nothing_is_removed(tmp_path):
    with pytest.raises(InputError, match="stop"), exclusive(tmp_path / "new"):
        raise InputError("stop")
    assert not (tmp_path / "new").exists()


def test_jobs_are_apart_and_a_second_run_finds_them(tmp_path):
    with Store(tmp_path) as store:
        store.job("a").put(b"1", b"one")
        store.job("b").put(b"1", b"other")
    with Store(tmp_path) as store:
        keys = [b"%d" % i for i in range(1200)]
        assert store.job("a").get(keys) == {b"1": b"one"} and store.job("b").get(keys) == {b"1": b"other"}
        assert store.job("c").get(keys) == {}


def test_a_file_that_is_no_store_is_said_and_left_alone(tmp_path):
    file = tmp_path / ".store" / "results.sqlite"
    file.parent.mkdir()
    file.write_bytes(b"not a database" * 100)
    with pytest.raises(InputError, match="the store cannot be used"), Store(tmp_path):
        pass
    assert file.read_bytes() == b"not a database" * 100


def test_only_what_is_missing_is_run(tmp_path, monkeypatch):
    calls = []
    path = study(tmp_path, GRID.format(points=5))
    sweep(path)
    from hvdc_ident.sensitivity import sweep_points

    run = sweep_points.PointTask.__call__
    monkeypatch.setattr(
        sweep_points.PointTask, "__call__", lambda self, p: (calls.append(float(p[0])), run(self, p))[1]
    )
    sweep(path)
    assert calls == []
    path.write_text(STUDY + GRID.format(points=9))
    sweep(path)
    assert calls == [0.5, 1.5, 2.5, 3.5]


def test_two_workers_give_the_bytes_of_one(tmp_path):
    cube = '[[sweep]]\nparameter = "k"\nmin = 0\nmax = 4\npoints = 40\nsampling = "latin-hypercube"\nwant = ["rmse", "poles"]\n'
    path = study(tmp_path, cube)
    sweep(path, "--out", tmp_path / "one", "--seed", 3)
    sweep(path, "--out", tmp_path / "two", "--seed", 3, "--workers", 2)
    for name in ("sweep.csv", "sweep.json"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    sweep(path, "--out", tmp_path / "other", "--seed", 4)
    assert (tmp_path / "other" / "sweep.csv").read_bytes() != (tmp_path / "one" / "sweep.csv").read_bytes()


def test_a_sweep_of_two_tables_is_their_product_and_reaches_the_page(tmp_path):
    path = study(tmp_path, GRID.format(points=4) + 'want = ["rmse", "poles", "bode"]\n')
    assert CliRunner().invoke(app, ["run", str(path), "--quiet"]).exit_code == 0
    page = (tmp_path / "s-results" / "report.html").read_text()
    assert "RMSE over k" in page and "poles over k" in page and "1 points failed" in page
    assert "frequency response of y over u over k" in page
    found = json.loads((tmp_path / "s-results" / "sweep.json").read_text())
    gains = [abs(complex(*p["bode"]["y"]["u"][0])) for p in found["points"] if p["status"] == "done"]
    wanted = [1 / np.hypot(k, found["omega"][0]) for k in (4 / 3, 8 / 3, 4)]  # 1/(s + k)
    assert gains == pytest.approx(wanted)


@pytest.mark.parametrize("against", ["other.toml", "base"])
def test_a_sweep_is_compared_with_another_model_or_the_base(tmp_path, against):
    """The other model is the same lag with k = 3: it is met there, as the base is at k = 2."""
    path = study(tmp_path, f'[[sweep]]\nparameter = "k"\nvalues = [1, 2, 3]\nagainst = "{against}"\n')
    (tmp_path / "other.toml").write_text(CARD.replace("value = 2.0", "value = 3.0").replace('"lag"', '"other"'))
    result = CliRunner().invoke(app, ["sweep", str(path), "--json"])
    assert result.exit_code == 0, result.stderr
    found = json.loads(result.stdout)
    errors = [p["rmse"]["y"]["e"] for p in found["points"]]
    assert found["against"] == ("other" if against != "base" else "base")
    assert errors.index(min(errors)) == (2 if against != "base" else 1) and min(errors) < 1e-9
    assert ("other.toml" in found["sources"]) == (against != "base")


@pytest.mark.parametrize(
    ("extra", "text"),
    [
        ("", "the study names none"),
        (GRID.format(points=5) * 2, "swept twice"),
        ('[[sweep]]\nparameter = "q"\nvalues = [1]\n', "no parameter 'q'"),
        ('[[sweep]]\nparameter = "k"\nvalues = [-1]\n', "bounds"),
        ('[[sweep]]\nparameter = "k"\nvalues = [1]\nagainst = "vsc-hvdc-lnk"\n', "did you mean 'vsc-hvdc-link'"),
        ('[[sweep]]\nparameter = "k"\nvalues = [1]\nagainst = "gone.toml"\n', "no model file 'gone.toml'"),
        ('[[sweep]]\nparameter = "k"\nvalues = [1]\nsampling = "latin-hypercube"\n', "Latin hypercube"),
    ],
)
def test_a_wrong_sweep_is_refused(tmp_path, extra, text):
    result = CliRunner().invoke(app, ["sweep", str(study(tmp_path, extra))])
    assert result.exit_code == 2 and text in result.stderr
