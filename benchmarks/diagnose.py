"""One diagnosis of the link: seconds by phase, processor time, the most memory, and what was found.

    python benchmarks/diagnose.py [--workers 2] [--effects lag,delay] [--outputs 8] [--quiet]

The phasor link with a lag hidden in its measurement of the dc voltage, run by the plain engine: 5 experiments to fit and
3 held out (steps and ramps of P, Q and Vdc), 8 outputs, 1000 rows each, white noise. The whole catalogue is tried at
every slot. Phases are as progress is told: wall time, then processor time of this process.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import usage

from hvdc_ident.data import Experiment, InputSignal, Trajectory, experiment
from hvdc_ident.discrepancy import diagnose
from hvdc_ident.effects import EffectUse, apply_effects
from hvdc_ident.fit import FitParameter
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.models import load_model
from hvdc_ident.parallel import LocalPool
from hvdc_ident.simulate import simulate

ROWS, END, EVENT, NOISE = 1000, 0.999, 0.1, 1e-3
HIDDEN = EffectUse("lag", ("Vdc1_m",), FrozenMap({"T": 0.005}))
OUTPUTS = ("Irorder1", "Irorder2", "Iiorder1", "Iiorder2", "Vdc1", "P1", "P2", "Q1")
FREE = (
    FitParameter("KIP", 25.0, 5.0, 60.0),
    FitParameter("KPVDC", 20.0, 5.0, 60.0),
    FitParameter("KIVDC", 600.0, 100.0, 2000.0),
    FitParameter("KIQ", 25.0, 5.0, 60.0),
    FitParameter("KIQ2", 25.0, 5.0, 60.0),
)
# What is moved, from, to, over so many s; the last three are held out.
MOVES = (
    ("Pref2", 0.4, 0.5, 0.0),
    ("Vdcref1", 1.0, 1.019, 0.0),
    ("Qref1", 0.0, 0.1, 0.0),
    ("Qref2", 0.0, -0.1, 0.05),
    ("Vdcref1", 1.0, 0.99, 0.1),
    ("Pref2", 0.4, 0.2, 0.1),
    ("Vdcref1", 1.0, 1.01, 0.0),
    ("Qref1", 0.0, 0.05, 0.05),
)


@dataclass
class Watch:
    """Wall time, and processor time of this process, by phase, as progress is told."""

    quiet: bool
    phase: str = "start"
    since: tuple[float, float] = field(default_factory=lambda: (time.perf_counter(), time.process_time()))
    spent: dict[str, tuple[float, float]] = field(default_factory=dict)

    def __call__(self, done: int, total: int, text: str) -> None:
        now = (time.perf_counter(), time.process_time())
        wall, own = self.spent.get(self.phase, (0.0, 0.0))
        self.spent[self.phase] = (wall + now[0] - self.since[0], own + now[1] - self.since[1])
        self.phase, self.since = _phase(text), now
        if not self.quiet:
            print(f"  {done}/{total} {text}", file=sys.stderr, flush=True)


def _phase(text: str) -> str:
    """Return the phase of a progress text, without the candidate of the step and the best so far."""
    said = text.partition(";")[0].split(": ")
    return ": ".join(said[: 2 if len(said) > 2 else 1]) if text.startswith("round") else said[0]


def recorded(count: int) -> tuple[Experiment, ...]:
    """The link with what is hidden, recorded."""
    link = apply_effects(load_model("vsc-hvdc-link"), [HIDDEN])
    outputs, time_, random = OUTPUTS[:count], np.linspace(0.0, END, ROWS), np.random.default_rng(0)
    found = []
    for k, (name, before, after, span) in enumerate(MOVES):
        signal = (
            InputSignal.ramp(EVENT, before, EVENT + span, after) if span else InputSignal.step(EVENT, before, after)
        )
        case = experiment(f"{k}-{name}", time_, {name: signal}, role="fit" if k < 5 else "holdout", event=EVENT)
        run = simulate(link, case, outputs=outputs)
        y = np.column_stack([run[o] for o in outputs]) + NOISE * random.standard_normal((ROWS, count))
        found.append(case.with_(measured=Trajectory(time_, y, outputs)))
    return tuple(found)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--effects", default="all")
    parser.add_argument("--outputs", type=int, default=len(OUTPUTS))
    parser.add_argument("--quiet", action="store_true", help="tell no progress")
    asked = parser.parse_args(arguments)
    experiments = recorded(asked.outputs)
    effects: Any = asked.effects if asked.effects == "all" else asked.effects.split(",")
    before, begin, watch = time.process_time(), time.perf_counter(), Watch(asked.quiet)
    pool = LocalPool(asked.workers).open() if asked.workers > 1 else nullcontext()
    with pool as executor:
        found = diagnose(
            load_model("vsc-hvdc-link"), experiments, FREE, effects=effects, executor=executor, progress=watch
        )
        watch(1, 1, "end")
        wall = time.perf_counter() - begin
        there, largest = usage.cpu_below(), usage.peak_below()
    for phase, (seconds, own) in watch.spent.items():
        print(f"{seconds:8.1f} s  {own:8.1f} s  {phase}")
    here = time.process_time() - before
    print(f"{wall:8.1f} s  in all; processor time {here:.1f} s here, {there:.1f} s in {asked.workers} workers")
    print(f"memory at most: {usage.peak():.0f} MiB here, {largest:.0f} MiB in the larger worker")
    print(f"{len(found.candidates)} candidates; {found.verdict}: {found.text}")
    for effect in found.effects:
        print(f"  {effect.text}")


if __name__ == "__main__":
    main()
