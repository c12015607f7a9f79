"""The pool: every item ends with a value or a reason, whatever happens to its workers."""

from __future__ import annotations

import ast
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pool_jobs
import pytest

from hvdc_ident.errors import ComputationError, InputError
from hvdc_ident.parallel import LocalPool


def ends(pool, job, items):
    found = {e.index: e for e in pool.run(job, items)}
    assert sorted(found) == list(range(len(items)))
    return [found[i] for i in range(len(items))]


def test_dying_hanging_and_failing_items_cost_only_themselves(tmp_path):
    job = pool_jobs.Job(dies={3}, hangs={11}, fails={7}, once=str(tmp_path / "once"))
    found = ends(LocalPool(2, timeout=5.0), job, list(range(40)))
    bad = {i: e.failure for i, e in enumerate(found) if e.failure}
    assert bad == {
        3: "its worker was ended by SIGSEGV",
        7: "ValueError: a bad number",
        11: "no result after 5 s",
    }
    assert all(e.value == i * i for i, e in enumerate(found) if i not in bad)


def test_map_keeps_the_order_and_raises():
    assert list(LocalPool(2).map(pool_jobs.Job(), range(20))) == [i * i for i in range(20)]
    with pytest.raises(ComputationError, match="item 3 failed"):
        list(LocalPool(1).map(pool_jobs.Job(fails={2}), range(5)))


def test_workers_stay_where_nobody_asks_for_more_than_the_last_item():
    with LocalPool(1).open() as pool:
        first = pool.map(pool_jobs.process, [1])
        worker = next(first)
        first.close()
        assert list(pool.map(pool_jobs.process, [1, 2])) == [worker, worker]
        left = pool.map(pool_jobs.process, range(4))
        next(left)
        left.close()  # what it was at when nobody listened any more is never taken for a later run's
        assert list(pool.map(pool_jobs.Job(), range(5))) == [0, 1, 4, 9, 16]


def test_nothing_to_do_and_nothing_that_works():
    assert list(LocalPool(2).run(pool_jobs.Job(), [])) == []
    with pytest.raises(ComputationError, match="cannot be started"):
        list(LocalPool(1).run(pool_jobs.Unloadable(), [1]))
    with pytest.raises(InputError):
        LocalPool(0)


def _script(code, environment):
    """A process of its own that runs the code, with the jobs at hand."""
    here = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    return subprocess.Popen(
        [sys.executable, "-c", code], env={**environment, "PYTHONPATH": here}, stdout=subprocess.PIPE, text=True
    )


@pytest.mark.parametrize(("told", "expected"), [({}, ["1", "1", None]), ({"OMP_NUM_THREADS": "3"}, ["3", None, None])])
def test_workers_compute_in_one_thread_unless_told_otherwise(told, expected):
    """As the environment of the first pool of a process says; the parent's own stays as it is."""
    names = ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NO_SUCH_NUM_THREADS"]
    code = f"""
import os, pool_jobs
from hvdc_ident.parallel import LocalPool
print([list(LocalPool(1).map(pool_jobs.environment, {names})), [os.environ.get(n) for n in {names}]])
"""
    bare = {n: v for n, v in os.environ.items() if not n.endswith("_NUM_THREADS")}
    process = _script(code, {**bare, **told})
    found, _ = process.communicate()
    assert process.returncode == 0
    assert ast.literal_eval(found) == [expected, [told.get(n) for n in names]]


def test_workers_end_with_a_parent_that_is_killed():
    """Though they are at work."""
    code = """
import os, pool_jobs
from hvdc_ident.parallel import LocalPool
list(LocalPool(1).run(pool_jobs.end_and_hang, [os.getpid()]))
"""
    parent = _script(code, dict(os.environ))
    parent.communicate(timeout=120.0)  # ends when the last process that has its output does
    assert parent.returncode == -signal.SIGKILL


def test_a_script_without_a_guard_around_its_main_part_is_told_so(tmp_path):
    """Its workers would start workers without end."""
    script = tmp_path / "script.py"
    script.write_text("from hvdc_ident.parallel import LocalPool\nprint(list(LocalPool(1).map(abs, [1])))\n")
    found = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False)
    assert found.returncode == 1 and "if __name__ == '__main__'" in found.stderr.splitlines()[-1]


def test_what_a_broken_pool_was_given_and_never_reported_is_lost_and_done_again(monkeypatch):
    """As where it breaks while it is given something: the future is neither done nor anybody's."""
    from concurrent.futures import Future

    import pebble

    class Broken:
        active = False

        def __init__(self, *arguments, **settings):
            pass

        def submit(self, *arguments):
            monkeypatch.undo()
            return Future()

        def stop(self):
            pass

        def join(self):
            pass

    monkeypatch.setattr(pebble, "ProcessPool", Broken)
    assert list(LocalPool(1).map(abs, [-1, -2, -3])) == [1, 2, 3]


def test_items_that_end_their_worker_at_once_are_all_told_of(tmp_path):
    """Also where this process is too busy to hear that a worker took an item before it is gone."""
    stop = threading.Event()

    def keep_busy():
        while not stop.is_set():
            sum(range(1000))

    busy = threading.Thread(target=keep_busy)
    busy.start()
    try:
        found = ends(LocalPool(2, timeout=None), pool_jobs.Job(dies=set(range(0, 12, 2))), list(range(12)))
    finally:
        stop.set()
        busy.join()
    assert [e.value for e in found[1::2]] == [i * i for i in range(1, 12, 2)]
    assert all(e.failure.startswith("its worker") for e in found[::2])
