"""How time and memory grow: with the points of a sweep, and with the states of a multi-terminal grid.

    python benchmarks/scaling.py sweep  [--most 100000] [--workers 1]
    python benchmarks/scaling.py states [--most 66] [--limit 240]

`sweep`: the phasor link, KPVDC and KIVDC on a grid, one experiment of 1.5 s, as `hvdc-ident sweep` does it, with a store
in the folder. `states`: vsc-mtdc-N, three states a terminal. Every size has a process of its own, so that its memory is
its own; times are processor time, with the wall time beside. A size that takes over
`--limit` s of processor time ends the list.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from usage import cpu_below, peak

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.models import load_model

TERMINALS = (2, 4, 8, 16, 33, 66)
POINTS = (10, 100, 1000, 10_000, 100_000)


def spent(run: Callable[[], Any]) -> tuple[float, float, Any]:
    """Processor time, wall time, s, and what the function returns."""
    cpu, wall = time.process_time(), time.perf_counter()
    value = run()
    return time.process_time() - cpu, time.perf_counter() - wall, value


def least(run: Callable[[], Any], count: int) -> float:
    """The least processor time of several runs, s."""
    return min(spent(run)[0] for _ in range(count))


def of_states(terminals: int) -> dict[str, float]:
    """What a grid of so many terminals costs: seconds of processor time, and MiB."""
    from hvdc_ident.linearize import find_operating_point, linearize
    from hvdc_ident.simulate import simulate

    simulate(
        load_model("vsc-mtdc-2"), experiment("warm", np.linspace(0, 0.1, 3), {})
    )  # the integrators are loaded here
    base = peak()
    row: dict[str, float] = {}
    row["model"], _, model = spent(lambda: load_model(f"vsc-mtdc-{terminals}"))
    case = experiment("step", np.linspace(0.0, 1.0, 1001), {"Vdcref1": InputSignal.step(0.1, 1.0, 1.01)})
    row["first run"] = spent(lambda: simulate(model, case))[0]
    row["run"] = least(lambda: simulate(model, case), 5)
    names = ("KPVDC", "KIVDC")
    row["first run with 2"] = spent(lambda: simulate(model, case, sensitivities=names))[0]
    row["run with 2"] = least(lambda: simulate(model, case, sensitivities=names), 5)
    row["first operating point"], _, point = spent(lambda: find_operating_point(model))
    row["operating point"] = least(lambda: find_operating_point(model), 3)
    row["linearize"] = least(lambda: linearize(model, point), 3)
    return row | {"states": len(model.states), "memory": peak() - base}


def write_sweep(folder: Path, points: int) -> tuple[Path, int]:
    """A study of the phasor link over a grid of KPVDC and KIVDC, and how many points it has, `points` or a few more."""
    from hvdc_ident.files import csv_text

    side = max(1, round(points**0.5))
    other = -(-points // side)
    t = np.round(np.arange(751) * 2e-3, 9)
    step = np.where(t >= 0.1, 1.019, 1.0)
    rows = np.column_stack([t, step, -0.4 + 0.45 * (t >= 0.1) * np.exp(-30 * np.clip(t - 0.1, 0, None))])
    (folder / "v.csv").write_text(csv_text(["time", "Vdcref1", "Irorder1"], rows.tolist()))
    axes = "".join(
        f'[[sweep]]\nparameter = "{n}"\nmin = {low}\nmax = {high}\npoints = {count}\n'
        for n, low, high, count in (("KPVDC", 10, 40, side), ("KIVDC", 250, 1500, other))
    )
    (folder / "s.toml").write_text(
        'schema = 1\nname = "s"\n[model]\nsource = "vsc-hvdc-link"\n[[experiment]]\nname = "v"\ndata = "v.csv"\n'
        f'inputs = ["Vdcref1"]\noutputs = ["Irorder1"]\nevent = 0.1\n{axes}'
    )
    return folder / "s.toml", side * other


def of_sweep(points: int, workers: int) -> dict[str, float]:
    """What a sweep of so many points costs: s and MiB, the bytes it leaves in its store, and of its tables."""
    from hvdc_ident.study.pipeline import run_stage
    from hvdc_ident.study.stages import StageOptions
    from hvdc_ident.study.study import load_study

    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        path, count = write_sweep(folder, points)
        study = load_study(str(path))
        run_stage(study, "simulate", folder / "warm", StageOptions())  # compiled here
        base = peak()
        cpu, wall, done = spent(lambda: run_stage(study, "sweep", folder / "out", StageOptions(workers=workers)))
        assert not done.failed, done.failed
        again = spent(lambda: run_stage(study, "sweep", folder / "out", StageOptions(workers=workers)))[0]
        store = sum(f.stat().st_size for f in (folder / "out" / ".store").iterdir())
        tables = sum((folder / "out" / n).stat().st_size for n in ("sweep.json", "sweep.csv"))
        return {
            "points": count,
            "cpu": cpu + (cpu_below() if workers > 1 else 0.0),
            "wall": wall,
            "again": again,
            "memory": peak() - base,
            "store": store / 1024,
            "tables": tables / 1024,
        }


def rows_of(kind: str, sizes: list[int], limit: float, *more: str) -> list[dict[str, float]]:
    """One row a size, each from a process of its own, until one takes too long."""
    rows = []
    for size in sizes:
        begin = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = subprocess.run(
            [sys.executable, __file__, kind, "--one", str(size), *more], capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise SystemExit(done.stderr)
        rows.append(json.loads(done.stdout.splitlines()[-1]))
        print(" | ".join(f"{k} {v:.4g}" for k, v in rows[-1].items()), flush=True)
        end = resource.getrusage(resource.RUSAGE_CHILDREN)
        if end.ru_utime - begin.ru_utime > limit:
            break
    return rows


def power(x: list[float], y: list[float]) -> float:
    """The exponent with which y grows between the last two sizes."""
    return float(np.log(y[-1] / y[-2]) / np.log(x[-1] / x[-2]))


def main() -> None:
    """Prints the rows, and how they grow."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kind", choices=("sweep", "states"))
    parser.add_argument("--most", type=int)
    parser.add_argument("--limit", type=float, default=240.0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        print(json.dumps(of_states(given.one) if given.kind == "states" else of_sweep(given.one, given.workers)))
        return
    sizes = [n for n in (TERMINALS if given.kind == "states" else POINTS) if given.most is None or n <= given.most]
    rows = rows_of(given.kind, sizes, given.limit, "--workers", str(given.workers))
    along = "states" if given.kind == "states" else "points"
    if len(rows) > 1:
        x = [r[along] for r in rows]
        grown = {
            k: power(x, [r[k] for r in rows]) for k in rows[-1] if k != along and min(rows[-1][k], rows[-2][k]) > 0
        }
        print("grows with the power: " + ", ".join(f"{k} {v:.2f}" for k, v in grown.items()))


if __name__ == "__main__":
    main()
