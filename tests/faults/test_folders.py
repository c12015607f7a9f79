"""A full disk, a folder that cannot be written to, data that vanish, a second run: said clearly, and the store is whole."""

from __future__ import annotations

import ctypes
import resource
import sqlite3
import sys

import pytest
from typer.testing import CliRunner

from hvdc_ident.cli import app
from hvdc_ident.study import store
from tests.faults import cases, forks

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits of a process as Linux has them")


def kept(folder) -> int:
    """How many pieces of work the store of a folder holds; AssertionError where it is damaged."""
    with sqlite3.connect(folder / store.FOLDER / store.FILE) as base:
        assert base.execute("PRAGMA integrity_check").fetchone()[0] == "ok"
        return base.execute("SELECT count(*) FROM kept").fetchone()[0]


def no_larger_than(size: int):
    """A function after which no file of this process can grow beyond so many bytes: a disk that is full there."""
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def test_a_full_disk_is_said_and_the_run_goes_on_when_there_is_room(tmp_path):
    path = cases.write_study(tmp_path, points=300)
    out, log = tmp_path / "out", tmp_path / "work.log"
    forks.run("sweep", path, "--out", tmp_path / "whole")
    code, said = forks.forked(("sweep", path, "--out", out), log, first=no_larger_than(200_000))
    assert code == 2
    assert "the store cannot be used" in said and "free some space" in said and "Traceback" not in said
    before = kept(out)
    assert 0 < before < 300
    assert not [f.name for f in out.iterdir() if f.name != store.FOLDER]
    forks.forked(("sweep", path, "--out", out), second := tmp_path / "second.log")
    assert len(forks.notes(second)) == 300 - before
    for name in cases.TABLES["sweep"]:
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_a_disk_full_at_the_table_leaves_the_old_one_and_the_store(tmp_path):
    path = cases.write_study(tmp_path, points=20)
    out, log = tmp_path / "out", tmp_path / "work.log"
    forks.run("sweep", path, "--out", out)
    before = {n: (out / n).read_bytes() for n in cases.TABLES["sweep"]}
    smallest = min(len(b) for b in before.values())
    code, said = forks.forked(("sweep", path, "--out", out), log, first=no_larger_than(smallest // 2))
    assert code == 2
    assert "Traceback" not in said and str(out) in said
    assert {n: (out / n).read_bytes() for n in before} == before
    assert not list(out.glob(".*.part"))
    assert kept(out) == 20


def test_a_folder_that_is_a_file_is_said(tmp_path):
    path = cases.write_study(tmp_path, points=3)
    (tmp_path / "out").write_text("mine")
    result = CliRunner().invoke(app, ["sweep", str(path), "--out", str(tmp_path / "out")])
    assert result.exit_code == 2
    assert str(tmp_path / "out") in result.stderr
    assert (tmp_path / "out").read_text() == "mine"


def powerless() -> None:
    """Let permissions bind this process even where it is root's: it may no longer override them."""
    libc = ctypes.CDLL(None, use_errno=True)
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)  # version 3 of the interface, this process
    sets = (ctypes.c_uint32 * 6)()  # effective, permitted, inheritable, twice
    assert libc.capget(header, sets) == 0
    sets[0] &= ~(1 << 1)  # CAP_DAC_OVERRIDE
    assert libc.capset(header, sets) == 0


def test_a_read_only_folder_is_said_and_left_as_it_was(tmp_path):
    path = cases.write_study(tmp_path, points=3)
    out = tmp_path / "out"
    forks.run("sweep", path, "--out", out)
    (out / store.FOLDER / store.FILE).chmod(0o444)
    for folder in (out / store.FOLDER, out):
        folder.chmod(0o555)

    try:
        log = tmp_path / "work.log"
        code, said = forks.forked(("sweep", path, "--out", out), log, first=powerless)
    finally:
        for folder in (out, out / store.FOLDER):
            folder.chmod(0o755)
    assert code == 2, said
    assert "Traceback" not in said and str(out) in said
    assert "--out DIR" in said or "permission" in said.lower()
    assert kept(out) == 3


def test_data_that_vanish_between_two_runs_are_named_and_the_store_serves_when_they_are_back(tmp_path):
    path = cases.write_study(tmp_path, points=12)
    out, log = tmp_path / "out", tmp_path / "work.log"
    forks.run("sweep", path, "--out", out)
    before = (out / "sweep.csv").read_bytes()
    (tmp_path / "e1.csv").rename(tmp_path / "away")
    result = CliRunner().invoke(app, ["sweep", str(path), "--out", str(out)])
    assert result.exit_code == 2
    assert "e1.csv" in result.stderr and "Traceback" not in result.stderr
    assert (out / "sweep.csv").read_bytes() == before
    (tmp_path / "away").rename(tmp_path / "e1.csv")
    assert forks.forked(("sweep", path, "--out", out), log)[0] == 0
    assert forks.notes(log) == []
    assert (out / "sweep.csv").read_bytes() == before


def test_of_two_runs_on_one_folder_the_second_is_refused(tmp_path):
    path = cases.write_study(tmp_path, points=3)
    with store.exclusive(tmp_path / "out"):
        code, said = forks.forked(
            ("sweep", path, "--out", tmp_path / "out"), tmp_path / "work.log", first=store._HELD.clear
        )
        assert code == 2
        assert "another run is at work in this folder" in said
    assert forks.forked(("sweep", path, "--out", tmp_path / "out"), tmp_path / "work.log")[0] == 0
