"""The pool of the default: here while work is short, in workers when it is not, and the same answers either way."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pool_jobs
import pytest
from typer.testing import CliRunner

from hvdc_ident.cli import app
from hvdc_ident.command import Work
from hvdc_ident.executor import Made, Outcome
from hvdc_ident.parallel import LocalPool, PatientPool
from hvdc_ident.study.executors import open_executor
from hvdc_ident.study.pipeline import workers_of
from hvdc_ident.study.stages import StageOptions


class Clock:
    """Processor time that grows by 1 s at every look: an item takes 1 s."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        self.now += 1.0
        return self.now


def pool(patience: float) -> PatientPool:
    return PatientPool(LocalPool(2), patience, Clock())


def test_short_work_stays_in_this_process() -> None:
    patient = pool(5.0)
    assert list(patient.map(pool_jobs.process, range(2))) == 2 * [os.getpid()]
    assert list(patient.map(pool_jobs.process, range(3))) == 3 * [os.getpid()]
    assert list(patient.run(pool_jobs.process, [0])) == [Outcome(0, os.getpid())]  # one item is no work for several
    assert list(patient.map(pool_jobs.process, [])) == []


def test_long_work_goes_on_in_workers_once_it_took_as_long_as_their_start() -> None:
    patient = pool(4.0)
    try:
        first = list(patient.map(pool_jobs.process, range(3)))
        second = list(patient.map(pool_jobs.process, Made(int, range(9))))
        assert first == 3 * [os.getpid()] and second[0] == os.getpid() and os.getpid() not in second[1:]
        assert list(patient.map(pool_jobs.Job(), range(50))) == [i * i for i in range(50)]
        assert sorted(e.index for e in patient.run(pool_jobs.Job(), iter(range(30)))) == list(range(30))
    finally:
        patient.close()


@pytest.mark.parametrize("patience", [0.0, 100.0])
def test_an_item_that_fails_raises_what_it_raises_without_workers(patience: float) -> None:
    patient = pool(patience)
    try:
        found = patient.map(pool_jobs.Job(fails={3}), range(9))
        assert [next(found) for _ in range(3)] == [0, 1, 4]
        with pytest.raises(ValueError, match="a bad number"):
            next(found)
    finally:
        patient.close()


def test_what_works_in_this_process_alone_is_done_here() -> None:
    patient = pool(0.0)
    try:
        assert list(patient.map(pool_jobs.OnlyIn(os.getpid()), range(6))) == [0, 1, 4, 9, 16, 25]
    finally:
        patient.close()


def test_the_default_is_a_worker_for_each_core_available(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Work().workers is None

    def opened(cores: int, system: str = "linux") -> Any:
        monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(cores)), raising=False)
        monkeypatch.setattr("sys.platform", system)
        with open_executor("", None) as found:
            return found and found._settings

    assert opened(3) == LocalPool(3, timeout=None)  # in this process there is no limit on an item's time either
    assert opened(1) is None and opened(3, "darwin") is None


def test_an_fmu_keeps_to_its_own_processes_unless_more_are_asked_for() -> None:
    study: Any = SimpleNamespace(model=object())
    with workers_of(study, StageOptions(workers=None)) as found:
        assert found is None
    with workers_of(study, StageOptions(workers=2)) as found:
        assert found is not None


CARD = """\
schema = 1
name = "filter"
[parameters]
w = {value = 9.0, min = 1, max = 60}
z = {value = 0.5, min = 0.05, max = 2}
[inputs]
u = {value = 0.0}
[states]
x = {derivative = "v"}
v = {derivative = "w**2*(u - x) - 2*z*w*v"}
[outputs]
x = "x"
"""
STUDY = """\
schema = 1
name = "filter"
[model]
source = "filter.toml"
[parameters]
w = {start = 8, min = 2, max = 40}
z = {start = 0.6, min = 0.1, max = 1.5}
[[experiment]]
name = "step"
data = "step.csv"
inputs = ["u"]
outputs = ["x"]
noise = {x = 0.01}
[fit]
starts = 4
"""


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """A step of a second-order lag, 11 rad/s, damping 0.4, in closed form, with noise of 0.01."""
    t, w, z = np.arange(150) * 0.01, 11.0, 0.4
    s = np.maximum(t - 0.3, 0.0)
    d = w * np.sqrt(1 - z**2)
    x = 1 - np.exp(-z * w * s) * (np.cos(d * s) + z * w / d * np.sin(d * s))
    x = x + 0.01 * np.random.default_rng(8).standard_normal(t.size)
    rows = "".join(f"{a:.2f},{b:g},{c:.6f}\n" for a, b, c in zip(t, t >= 0.3, x, strict=True))
    (tmp_path / "step.csv").write_text(f"time,u,x\n{rows}")
    (tmp_path / "filter.toml").write_text(CARD)
    (tmp_path / "study.toml").write_text(STUDY)
    return tmp_path / "study.toml"


def test_answers_do_not_depend_on_the_number_of_processes(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hvdc_ident.study.executors.beginning", lambda: 0.0)  # workers at once
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1}, raising=False)
    for folder, workers in (("one", ("--workers", "1")), ("default", ())):
        done = CliRunner().invoke(app, ["fit", str(study), "--out", str(study.parent / folder), "--quiet", *workers])
        assert done.exit_code == 0, done.output
    for name in ("identifiability.json", "fit.json"):
        assert (study.parent / "one" / name).read_bytes() == (study.parent / "default" / name).read_bytes()
