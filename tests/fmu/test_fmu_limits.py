"""Limits of an FMU: time, memory, and what is left behind when processes are killed."""

from __future__ import annotations

import fcntl
import os
import pickle
import signal
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hvdc_ident import load_model, simulate
from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.errors import InputError, ModelError, SimulationError
from hvdc_ident.fmu import read_fmu
from hvdc_ident.fmu.archive import LOCK, remove_abandoned_folders, shared_folder, unpacked_folder
from hvdc_ident.fmu.worker_pool import MIB, Budget, Limits, crash, idle_cores, overdue
from hvdc_ident.parallel import Ending
from tests.fmu.c_fmu import build, needs_compiler
from tests.fmu.c_models import FAULTY, FAULTY_CODE, FOUR
from tests.fmu.fmu_limits import PATIENT

pytestmark = needs_compiler

TIME = np.linspace(0.0, 0.5, 26)
STEP = experiment("step", TIME, {"u": InputSignal.step(0.1, 0.0, 1.0)})
SHORT = Limits(deadline=1.0, load=30.0, memory=64 * MIB)
EAT = "char *p, *last = 0; while ((p = malloc(1 << 20))) last = p;"  # it writes on none of it but its headers
THEN = {
    "spins": "for (;;) ;",
    "sleeps": "for (;;) usleep(1000);",
    "says error": "return 3;",
    "says fatal": "return 4;",
    "aborts": "abort();",
    "writes to null": "memset(p, 1, 1);",
    "exits": "exit(1);",
}


def hog(name: str, then: str):
    """The lag that takes all memory there is in its first step, and then does something."""
    code = FAULTY_CODE.split("#define AT_STEP")[0] + f"#define AT_STEP(r) {EAT} {then}\n"
    return replace(FAULTY, name=name, code=code, kinds=("CoSimulation",))


@pytest.mark.parametrize("then", THEN)
def test_an_fmu_that_runs_out_of_memory_is_told_so_however_it_ends(tmp_path, then):
    model = read_fmu(build(hog("hog", THEN[then]), tmp_path), limits=SHORT)
    with pytest.raises(SimulationError, match=r"it had used \d\d of its 64 MiB of memory.*`memory = 128`") as told:
        simulate(model, STEP)
    used = int(str(told.value).split("it had used ")[1].split()[0])
    assert 60 <= used <= 64, "chunks of 1 MiB, and a thread's own heap may be reserved"
    assert "fmi2DoStep" in str(told.value)
    model.pool.close()


def test_a_hang_says_where_it_stands(fmu):
    model = fmu(FAULTY, 2, "co-simulation", SHORT)
    with pytest.raises(
        SimulationError, match=r"hangs.*stood at t = 0 s of 0.5 s, in fmi2DoStep.*`deadline = 5`"
    ) as told:
        simulate(model, STEP, {"fault": 2})
    assert "--deadline 5" in str(told.value) and "MiB" not in str(told.value)


def test_a_slow_run_says_how_far_it_came_and_which_deadline_would_do(tmp_path):
    """Each of its 25 steps takes a tenth of a second at least."""
    slow = replace(
        FAULTY, name="slow", code=FAULTY_CODE.split("#define AT_STEP")[0] + "#define AT_STEP(r) usleep(100000)\n"
    )
    model = read_fmu(build(slow, tmp_path), interface="co-simulation", limits=SHORT)
    with pytest.raises(SimulationError, match=r"is slow: at t = (\S+) s of 0.5 s .* at this pace (\S+) times") as told:
        simulate(model, STEP)
    words = str(told.value).split()
    reached, times = float(words[words.index("=") + 1]), float(words[words.index("pace") + 1])
    assert times == pytest.approx(0.5 / reached, rel=0.05) and reached <= 0.22
    model.pool.close()


@pytest.mark.parametrize(
    ("taken", "words"), [(40, "memory = 128"), (10, ""), (31, "")], ids=["over half", "little", "under half"]
)
def test_memory_is_blamed_from_the_half_on_that_doubling_cannot_pass(taken, words):
    budget = Budget(64 * MIB, 100 * MIB, 1000 * MIB)
    end = Ending(-signal.SIGABRT, (100 + taken) * MIB, (1000 + taken) * MIB)
    what, hint = crash(end, budget, "in the run")
    assert (words in hint) if words else not hint
    assert ("MiB" in what) == bool(words)


def test_a_run_that_stands_is_not_called_slow():
    budget = Budget(None)
    told = [overdue(Ending(-9), budget, "run", ("deadline", 10.0), (0.0, 10.0, 2.5), still)[0] for still in (None, 4.0)]
    assert "is slow: at t = 2.5 s of 10 s" in told[0] and "4 times the deadline would do" in told[0]
    assert "hangs" in told[1] and "stood at t = 2.5 s of 10 s for 4 s" in told[1]


def test_limits_are_stated_by_the_keys_of_a_study(tmp_path):
    path = build(FAULTY, tmp_path)
    assert load_model(path, limits={"deadline": 300.0, "memory": 4096}).pool.limits == Limits(300.0, memory=4096 * MIB)
    with pytest.raises(InputError, match=r"no limit 'dedline'.*did you mean 'deadline'"):
        load_model(path, limits={"dedline": 300.0})
    with pytest.raises(InputError, match="deadline: a limit is not above 0"):
        load_model(path, limits={"deadline": 0.0})
    with pytest.raises(ModelError, match="limits of an FMU's process"):
        load_model("vsc-hvdc-link", limits={"deadline": 300.0})


# --- what is left behind ---

HOST = """
import os, sys, time
import numpy as np
from hvdc_ident import load_model, simulate
from hvdc_ident.data import InputSignal, experiment
model = load_model(sys.argv[1], interface="co-simulation")
step = experiment("step", np.linspace(0.0, 0.5, 26), {"u": InputSignal.step(0.1, 0.0, 1.0)})
simulate(model, step)
own = model.pool._processes
print(own.workers[0].process.guard.pid, own.workers[0].pid, own.folder.path, flush=True)
if "hang" in sys.argv:
    simulate(model, step, {"fault": 2.0})
if "crash" in sys.argv:
    os.abort()
time.sleep(600)
"""


def start(path: Path, temporary: Path, *words: str):
    """A host in a process of its own, with its supervisor, its worker and its folder."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOST, str(path), *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "TMPDIR": str(temporary)},
    )
    supervisor, worker, folder = process.stdout.readline().split()
    process.stdout.close()
    return process, int(supervisor), int(worker), Path(folder)


def wait_until_gone(*pids: int) -> None:
    """Wait until processes that are no children of this one have ended; the test's own time limit ends a wait in vain."""
    for pid in pids:
        try:
            ended = os.pidfd_open(pid)
        except OSError:
            continue
        import select

        select.select([ended], [], [])
        os.close(ended)


@pytest.mark.parametrize(
    ("how", "words"),
    [(signal.SIGTERM, ()), (signal.SIGKILL, ("hang",)), (signal.SIGINT, ("hang",)), (None, ("crash",))],
    ids=["terminated", "killed in a hang", "interrupted in a hang", "crashed"],
)
def test_nothing_stays_of_a_host_that_is_killed(tmp_path, how, words):
    process, supervisor, worker, folder = start(build(FAULTY, tmp_path), tmp_path, *words)
    if how is not None:
        process.send_signal(how)
    process.wait()
    wait_until_gone(supervisor, worker)
    assert not folder.exists()


def test_nothing_runs_on_when_the_supervisor_is_killed_and_the_next_host_cleans_up_behind_both(tmp_path, monkeypatch):
    process, supervisor, worker, folder = start(build(FAULTY, tmp_path), tmp_path, "hang")
    process.send_signal(signal.SIGSTOP)
    os.kill(supervisor, signal.SIGKILL)
    process.kill()
    process.wait()
    wait_until_gone(worker)
    with open(
        folder / LOCK, "rb"
    ) as lock:  # the process that the hang is in holds it until the system has ended that, too
        fcntl.flock(lock, fcntl.LOCK_EX)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    remove_abandoned_folders()
    assert not folder.exists()


def test_a_worker_that_is_killed_costs_a_message(fmu):
    model = fmu(FAULTY, 2, "co-simulation", PATIENT)
    rows = simulate(model, STEP)["out"]
    model.pool.cache.clear()  # the last runs are not run again
    worker = model.pool._processes.workers[0].pid
    os.kill(worker, signal.SIGKILL)
    wait_until_gone(worker)
    with pytest.raises(SimulationError, match="ended by SIGKILL, from outside"):
        simulate(model, STEP)
    assert np.array_equal(simulate(model, STEP)["out"], rows)
    model.pool.cache.clear()
    supervisor, worker = model.pool._processes.workers[0].process.guard.pid, model.pool._processes.workers[0].pid
    os.kill(supervisor, signal.SIGKILL)
    wait_until_gone(supervisor, worker)
    with pytest.raises(SimulationError, match=r"process that watches the FMU's worker ended .*exit code -9"):
        simulate(model, STEP)
    assert np.array_equal(simulate(model, STEP)["out"], rows)


def test_a_folder_is_shared_and_goes_with_its_last_user(tmp_path):
    mine = unpacked_folder(build(FAULTY, tmp_path))
    other, late = shared_folder(mine.path), shared_folder(mine.path)
    assert other is not None and late is not None
    mine.release()
    remove_abandoned_folders()
    assert (other.binaries / "modelDescription.xml").is_file()
    other.release()
    late.release()
    assert not mine.path.exists() and shared_folder(mine.path) is None


def test_a_model_that_travels_uses_the_folder_it_finds(fmu):
    model = fmu(FAULTY, 2, "co-simulation", PATIENT)
    rows = simulate(model, STEP)["out"]
    there = pickle.loads(pickle.dumps(model))
    assert np.array_equal(simulate(there, STEP)["out"], rows)
    assert there.pool._processes.folder.path == model.pool._processes.folder.path
    there.pool.close()
    assert np.array_equal(simulate(model, STEP)["out"], rows)


# --- several workers ---


def test_columns_are_the_same_from_one_worker_and_from_two(tmp_path):
    """From the first request, whose steps one worker chose, to later ones, and after a worker was replaced."""
    path, names = build(FOUR, tmp_path), ("T", "k", "b", "c")
    one, two = (load_model(path, limits={"workers": n}) for n in (1, 2))
    for i, lag in enumerate((0.1, 0.11, 0.25)):
        if i == 2:
            os.kill(two.pool._processes.workers[1].pid, signal.SIGKILL)
            wait_until_gone(two.pool._processes.workers[1].pid)
            two.pool.cache.clear()  # the last runs are not run again
            with pytest.raises(SimulationError, match="SIGKILL"):
                two.simulate(STEP, {"T": 0.11}, names)
        runs = [m.simulate(STEP, {"T": lag}, names) for m in (one, two)]
        assert np.array_equal(runs[0].sensitivities, runs[1].sensitivities)
        assert np.array_equal(runs[0].trajectory.values, runs[1].trajectory.values)
        assert dict(runs[0].notes) == dict(runs[1].notes)
    assert len(one.pool._processes.workers) == 1 and len(two.pool._processes.workers) == 2
    s = np.maximum(TIME - 0.1, 0.0)
    exact = [-2.0 * s / lag**2 * np.exp(-s / lag), 2.0 * (1.0 - np.exp(-s / lag)), 1.0 - np.exp(-s / lag), np.ones(26)]
    assert np.abs(runs[1].sensitivities[:, 0, :] - np.column_stack(exact)).max() < 1e-4
    one.pool.close()
    two.pool.close()


def test_the_first_failure_of_several_workers_is_told_and_all_go_on(tmp_path):
    """A value that one column's runs cannot take: T moves below where the model says error."""
    code = FOUR.code + "#define AT_STEP(r) if (r[3] > 1) return 3\n"
    path, names = build(replace(FOUR, name="edge", code=code), tmp_path), ("T", "k", "b", "c")
    model = load_model(path, limits={"workers": 2})
    model.simulate(STEP, {"k": 0.5}, names)
    for _ in range(2):
        with pytest.raises(SimulationError, match="fmi2DoStep returned error"):
            model.simulate(STEP, {"k": 1.0}, names)
        assert model.simulate(STEP, {"k": 0.5}, names).sensitivities.shape == (26, 1, 4)
    model.pool.close()


def test_a_process_of_a_pool_uses_one_core(monkeypatch):
    monkeypatch.setattr("multiprocessing.parent_process", lambda: object())
    assert idle_cores(1) == 1
    monkeypatch.setattr("multiprocessing.parent_process", lambda: None)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(8)), raising=False)
    for load, own, idle in ((0.5, 1, 8), (3.2, 1, 6), (8.0, 8, 8), (30.0, 1, 1)):
        monkeypatch.setattr("os.getloadavg", lambda load=load: (load, 0.0, 0.0))
        assert idle_cores(own) == idle
