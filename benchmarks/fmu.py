"""FMUs read and run: the link's FMU 500 times in a row, and linear models from one with 13 states or more.

    python benchmarks/fmu.py

The FMU is written by the project itself, so a C compiler is needed. Times are of whole calls, the way to the worker and
back included; the processor time is the worker's and ours together.
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import numpy as np

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.effects import apply_effects
from hvdc_ident.fmu import FmuModel, Limits, read_fmu
from hvdc_ident.fmu.export import export_fmu
from hvdc_ident.linearize import find_operating_point, linearize
from hvdc_ident.models import load_model

RUNS = 500


def own_memory() -> int:
    """Bytes this process has in use."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")


def processor(model: FmuModel) -> float:
    """Seconds of processor time of this process and the FMU's."""
    fields = Path(f"/proc/{model.pool._processes.workers[0].pid}/stat").read_text().rpartition(") ")[2].split()
    return time.process_time() + (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def successive_runs(path: Path, version: str) -> None:
    model = read_fmu(path, interface="co-simulation", limits=Limits(runs=RUNS + 10))
    run = experiment("step", np.linspace(0.0, 1.0, 500), {"Vdcref1": InputSignal.step(0.1, 1.0, 1.02)})
    times, memory, ours = [], [], []
    model.simulate(run)
    begin = processor(model)
    for k in range(RUNS):
        start = time.perf_counter()
        model.simulate(run, {"KPVDC": 20.0 + 0.01 * k})
        times.append(time.perf_counter() - start)
        memory.append(model.pool.memory)
        ours.append(own_memory())
    each = 1e3 * (processor(model) - begin) / RUNS
    ms = 1e3 * np.array(times)
    print(
        f"FMI {version}, co-simulation, 500 points, {RUNS} runs: median {np.median(ms):.1f} ms, least {ms.min():.1f}, "
        f"95 % under {np.percentile(ms, 95):.1f}, processor {each:.1f} ms a run; workers {model.pool.started}"
    )
    print(
        f"  memory from run 50 to {RUNS}: worker {(memory[-1] - memory[49]) / 1024:+.0f} KiB, "
        f"this process {(ours[-1] - ours[49]) / 1024:+.0f} KiB"
    )
    model.pool.close()


def linear_models(path: Path, version: str) -> None:
    model = read_fmu(path)
    point = find_operating_point(model)
    linearize(model, point)
    rows = {"linearize": lambda: linearize(model, point), "operating point": lambda: find_operating_point(model)}
    for name, work in rows.items():
        times = []
        for _ in range(50):
            start = time.perf_counter()
            work()
            times.append(time.perf_counter() - start)
        ms = 1e3 * np.array(times)
        print(
            f"FMI {version}, {len(model.states)} states, {name}: median {np.median(ms):.1f} ms, least {ms.min():.1f} ms"
        )
    model.pool.close()


def main() -> None:
    folder = Path(tempfile.mkdtemp())
    link = apply_effects(
        load_model("vsc-hvdc-link"), [{"effect": "lag", "at": ["Ir1", "Ir2"], "parameters": {"T": 0.0016}}]
    )
    for version in ("2.0", "3.0"):
        plain = export_fmu(load_model("vsc-hvdc-link"), folder / f"link-{version}.fmu", version=version).path
        successive_runs(plain, version)
        linear_models(plain, version)
    lags = [{"effect": "lag", "at": n, "parameters": {"T": 0.001}} for n in ("P1", "P2", "Vdc1", "Vdc2", "Q1", "Q2")]
    large = export_fmu(apply_effects(link, lags), folder / "large.fmu").path
    linear_models(large, "2.0")


if __name__ == "__main__":
    main()
