"""Memory over many runs of one structure and over many structures, compiled and from disk: resident KiB before and after.

python benchmarks/memory.py [RUNS] [STRUCTURES]
"""

from __future__ import annotations

import gc
import sys
from pathlib import Path

import numpy as np

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.models import load_model
from hvdc_ident.simulate import Engine, simulate

CASE = experiment("steps", np.linspace(0.0, 0.5, 501), {"Vdcref1": InputSignal.step(0.1, 1.0, 1.019)})
GAINS = ("KPVDC", "KIVDC", "KIP", "KIQ")


def resident() -> int:
    """Resident memory of this process, KiB."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4


def main(runs: int = 10_000, structures: int = 1_000) -> None:
    link = load_model("vsc-hvdc-link")
    for _ in range(200):
        simulate(link, CASE, sensitivities=GAINS)
    before = resident()
    for _ in range(runs):
        simulate(link, CASE, sensitivities=GAINS)
    print(f"{runs} runs: {before} -> {resident()} KiB")
    names = list(link.parameters)
    pairs = [(a, b, c) for a in names for b in names for c in names if len({a, b, c}) == 3]
    for three in pairs[:50]:
        Engine(link, three)
    before = resident()
    for three in pairs[50 : 50 + structures]:
        Engine(link, three)
    print(f"{structures} structures: {before} -> {resident()} KiB", flush=True)


if __name__ == "__main__":
    main(*(int(a) for a in sys.argv[1:]))
