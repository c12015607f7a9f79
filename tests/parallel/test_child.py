"""One function in a process of its own: its value, its error, and every way in which it may end without either."""

from __future__ import annotations

import operator
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from hvdc_ident.parallel import Child, ChildEndedError, call, inside

pytestmark = pytest.mark.skipif(os.name != "posix", reason="this system hands no descriptors on")


def test_a_function_gives_its_value_or_raises_its_error() -> None:
    assert call(operator.truediv, 1.0, 4.0, seconds=60.0) == 0.25
    assert call(os.getpid, seconds=60.0) != os.getpid()
    with pytest.raises(ZeroDivisionError):
        call(operator.truediv, 1.0, 0.0, seconds=60.0)


def test_it_begins_without_threads_of_this_process() -> None:
    stop = threading.Event()
    other = threading.Thread(target=stop.wait)
    other.start()
    assert call(threading.active_count, seconds=60.0) == 1
    stop.set()
    other.join()


def test_one_that_hangs_is_ended_at_its_time_limit() -> None:
    begin = time.monotonic()
    with pytest.raises(TimeoutError, match=r"no result after 0\.5 s"):
        call(time.sleep, 600.0, seconds=0.5)
    assert time.monotonic() - begin < 60.0


@pytest.mark.parametrize(
    ("function", "arguments", "how"),
    [(os.abort, (), "was ended by SIGABRT"), (os._exit, (7,), "ended with exit code 7")],
)
def test_one_that_ends_its_process_says_how(function: object, arguments: tuple[int, ...], how: str) -> None:
    with pytest.raises(ChildEndedError, match=how):
        call(function, *arguments, seconds=60.0)  # type: ignore[arg-type]


def test_one_that_takes_more_memory_than_it_may_raises() -> None:
    assert len(call(bytes, 1000, seconds=60.0, memory=10**8)) == 1000
    with pytest.raises(MemoryError):
        call(bytes, 10**9, seconds=60.0, memory=10**8)


def test_what_it_printed_last_is_told() -> None:
    with pytest.raises(ChildEndedError) as ended:
        call(exec, "import os; print('bad superblock', flush=True); os._exit(3)", seconds=60.0)
    assert ended.value.printed == "bad superblock"


def test_work_begins_again_in_a_new_process_of_the_same_guard() -> None:
    """After an end that was asked for and after a crash; nothing of the one before reaches the next."""
    child = Child(inside.answer, os.getpid, (), None, needs=("sqlite3",))
    first, _ = child.connection.recv()
    assert first == child.pid and child.rest() is not None
    child.again(inside.answer, exec, ("import os; print('bad', flush=True); os.abort()",), None)
    with pytest.raises((EOFError, OSError)):
        child.connection.recv()
    assert "bad" in child.printed
    ended = child.rest()
    assert ended is not None and ended.code == -signal.SIGABRT
    child.again(inside.answer, eval, ("__import__('os').getppid(), 'sqlite3' in __import__('sys').modules",), None)
    (guard, loaded), _ = child.connection.recv()
    assert guard == child.guard.pid and loaded and "bad" not in child.printed
    ended = child.end()
    assert ended is not None and "abort" not in ended.traces
    assert child.guard.returncode is not None


def test_nothing_of_it_stays() -> None:
    call(os.getpid, seconds=60.0)
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(3):
        call(os.getpid, seconds=60.0)
    assert len(os.listdir("/proc/self/fd")) == before


SCRIPT = """\
import h5py, numpy
from hvdc_ident.formats import read_waveforms
with h5py.File("record.h5", "w") as file:
    file["time"], file["u"] = numpy.linspace(0.0, 1.0, 11), numpy.ones(11)
print(len(read_waveforms("record.h5")))
"""


def test_a_script_without_a_guard_around_its_main_part_reads_a_guarded_file(tmp_path: Path) -> None:
    """A process that imports the script again, as those of multiprocessing do, would read the file again."""
    (tmp_path / "script.py").write_text(SCRIPT)
    found = subprocess.run([sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert found.stdout == "11\n", found.stderr
