"""The same sweep on one worker, on two, and on a dask cluster of two on loopback: points a second, memory, and the hash.

    python benchmarks/executors.py [--points 10000 40000]     (needs the extra `distributed`)

Each run is the command `hvdc-ident sweep` in a process of its own; the cluster is a scheduler and two workers started for
this, bound to 127.0.0.1, and stays from one size to the next. Memory is what each process of the cluster holds after a run;
processor time is that of all processes. A run whose tables are not those of one worker, byte for byte, ends the program.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
from scaling import write_sweep  # of this folder

SWEEP = "from hvdc_ident.cli import main; main()"


@contextlib.contextmanager
def cluster(workers: int) -> Iterator[tuple[str, list[psutil.Process]]]:
    """The scheduler's address, and its process before those of its workers."""
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        log = Path(folder) / "log"
        started: list[subprocess.Popen[bytes]] = []

        def start(*arguments: str) -> None:
            with log.open("ab") as stream:
                command = [sys.executable, "-m", "distributed.cli." + arguments[0], *arguments[1:]]
                started.append(subprocess.Popen(command, stdout=stream, stderr=stream, cwd=folder))

        def end() -> None:
            for process in reversed(started):
                process.terminate()
            for process in started:
                process.wait()

        stack.callback(end)
        start("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        address = _found(log, started[0], r"Scheduler at:\s+(tcp://127\.0\.0\.1:\d+)")
        for _ in range(workers):
            start("dask_worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1")
        for k in range(workers):
            _found(log, started[1 + k], rf"(?s)(?:Registered to:.*?){{{k + 1}}}")
        yield address.replace("tcp://", "dask://"), [psutil.Process(p.pid) for p in started]


def _found(log: Path, process: subprocess.Popen[bytes], pattern: str, patience: float = 60.0) -> str:
    """The first group of the pattern, or all of it, once the log has it."""
    until = time.monotonic() + patience
    while time.monotonic() < until and process.poll() is None:
        if log.exists() and (match := re.search(pattern, log.read_text(errors="replace"))):
            return match.group(match.lastindex or 0)
        time.sleep(0.1)
    raise SystemExit(f"the cluster does not start:\n{log.read_text(errors='replace')}")


def spent(others: list[psutil.Process]) -> float:
    """Processor time so far of ended children and of these processes, s."""
    own = resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + sum(p.cpu_times().user + p.cpu_times().system for p in others)


def main() -> None:
    """Prints a row for each size and way."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, nargs="+", default=[10_000, 40_000])
    given = parser.parse_args()
    print("| points | workers | wall, s | processor, s | points a second | scheduler, MiB | a worker, MiB | sha256 |")
    print("|---|---|---|---|---|---|---|---|")
    with cluster(2) as (address, processes), tempfile.TemporaryDirectory() as text:
        ways = {"1": ["--workers", "1"], "2": ["--workers", "2"], "2 of dask": ["--executor", address]}
        for points in given.points:
            folder = Path(text) / str(points)
            folder.mkdir()
            path, count = write_sweep(folder, points)
            hashes = set()
            for way, options in ways.items():
                at_work = processes if "dask" in way else []
                out = folder / way.replace(" ", "-")
                command = [sys.executable, "-c", SWEEP, "sweep", str(path), "--out", str(out), "--quiet", *options]
                cpu, wall = spent(at_work), time.perf_counter()
                subprocess.run(command, check=True)
                wall, cpu = time.perf_counter() - wall, spent(at_work) - cpu
                tables = b"".join((out / name).read_bytes() for name in ("sweep.csv", "sweep.json"))
                hashes.add(hashlib.sha256(tables).hexdigest())
                memory = [p.memory_info().rss / 2**20 for p in at_work]
                held = f"{memory[0]:.1f} | {max(memory[1:]):.1f}" if memory else "|"
                print(
                    f"| {count} | {way} | {wall:.1f} | {cpu:.1f} | {count / wall:.0f} | {held} | "
                    f"{hashlib.sha256(tables).hexdigest()[:12]} |",
                    flush=True,
                )
            if len(hashes) > 1:
                raise SystemExit("the tables differ")


if __name__ == "__main__":
    main()
