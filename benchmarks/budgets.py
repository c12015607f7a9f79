"""Budgets asked for and wall clock used: every stage of studies of three plants.

    python benchmarks/budgets.py [--seconds 20 60 200] [--stages identify fit diagnose letter run] [--study FILE.toml ...]

The plants are made here, unless studies are named: a loop of two states with two records; the shipped HVDC link with the records of
the demo; and a machine with exciter and governor, played back from a dip of 15 s, recorded at 60 rows/s. Each stage is a command of its
own in a folder of its own, so that the stages before it count as well; beside the ratio stands whether it came to its end. The time of
a command includes the interpreter's start. On a machine that does other work the ratio of user and system time to wall clock (cpu/wall)
says how much of the time was this command's.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import hvdc_ident as hi
from hvdc_ident.plants import UnitPart, unit_card
from hvdc_ident.study.examples import write_demo

STAGES = ("identify", "fit", "diagnose", "letter", "run")
LOOP = """schema = 1
name = "loop"
[parameters]
K = {value = 4.0, unit = "1/s", min = 0.01, description = "gain"}
T = {value = 0.05, unit = "s", min = 0.001, description = "time constant of the drive"}
[inputs]
u = {value = 0.0, unit = "pu", description = "reference"}
[states]
v = {derivative = "(K*(u - x) - v)/T"}
x = {derivative = "v"}
[outputs]
y = {value = "x", unit = "pu", description = "position"}
"""
HEAD = 'schema = 1\nname = "{name}"\n[model]\nsource = "{source}"\n[parameters]\n{parameters}\n[identifiability]\n[fit]\n[diagnose]\n'


def loop(folder: Path) -> Path:
    """Return the study of a loop whose gain is off and whose reference is late by a lag."""
    folder.mkdir()
    (folder / "loop.toml").write_text(LOOP)
    plant = hi.apply_effects(
        hi.load_model(folder / "loop.toml"), [{"effect": "lag", "at": "u", "parameters": {"T": 0.1}}]
    )
    text = HEAD.format(
        name="loop", source="loop.toml", parameters="K = {min = 1, max = 20}\nT = {min = 0.01, max = 0.5}"
    )
    random, times = np.random.default_rng(1), np.arange(400) * 0.01
    for name, to in (("up", 1.0), ("down", -0.5)):
        y = hi.simulate(plant, times, {"K": 5.0}, inputs={"u": hi.step(0.0, to, at=0.5)})["y"]
        rows = np.column_stack([times, np.where(times >= 0.5, to, 0.0), y + 0.005 * random.standard_normal(times.size)])
        np.savetxt(folder / f"{name}.csv", rows, delimiter=",", header="time,u,y", comments="")
        text += f'[[experiment]]\nname = "{name}"\ndata = "{name}.csv"\ninputs = ["u"]\noutputs = ["y"]\n'
    (folder / "study.toml").write_text(text)
    return folder / "study.toml"


def unit(folder: Path) -> Path:
    """Return the study of a machine that is played back, whose inertia and exciter gain are off."""
    folder.mkdir()
    parts = {"gen": UnitPart("genrou", {"Sn": 250.0}), "avr": UnitPart("sexs"), "gov": UnitPart("tgov1")}
    (folder / "unit.toml").write_text(unit_card(parts, network="playback"))
    model = hi.load_model(folder / "unit.toml")
    times = np.arange(900) / 60.0
    dip = 1.0 - 0.1 * ((times > 2.0) & (times < 2.15)) - 0.02 * (times >= 2.15) * np.exp(-(times - 2.15))
    swing = 0.1 * np.exp(-0.5 * np.maximum(times - 2.0, 0.0)) * np.sin(6.0 * np.maximum(times - 2.0, 0.0))
    recorded = {n: hi.InputSignal.corners(zip(times, v, strict=True)) for n, v in (("V", dip), ("theta", swing))}
    values = {"gen.H": 1.2 * model.values["gen.H"], "avr.K": 0.8 * model.values["avr.K"]}
    run = hi.simulate(model, times, values, inputs=recorded)
    random = np.random.default_rng(1)
    columns = [dip, swing, *(run[n] + 0.1 * random.standard_normal(times.size) for n in "PQ")]
    np.savetxt(
        folder / "dip.csv", np.column_stack([times, *columns]), delimiter=",", header="time,V,theta,P,Q", comments=""
    )
    bounds = "\n".join(f'"{n}" = {{min = {v / 4}, max = {4 * v}}}' for n, v in values.items())
    text = HEAD.format(name="unit", source="unit.toml", parameters=bounds)
    text += '[[experiment]]\nname = "dip"\ndata = "dip.csv"\ninterpolation = "linear"\nevent = 2.0\n'
    (folder / "study.toml").write_text(text + 'inputs = ["V", "theta"]\noutputs = ["P", "Q"]\n')
    return folder / "study.toml"


def timed(study: Path, stage: str, seconds: float, folder: Path) -> tuple[float, float, str]:
    """Return wall clock, user and system time of a command, s, and how its stage ended."""
    command = [sys.executable, "-c", "from hvdc_ident.cli import main; main()", stage, str(study)]
    before, begun = os.times(), time.monotonic()
    done = subprocess.run(
        [*command, "--budget", f"{seconds:g}", "--out", str(folder), "--quiet"],
        capture_output=True,
        text=True,
        check=False,
    )
    wall, after = time.monotonic() - begun, os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    end = "done" if done.returncode == 0 else (done.stderr.strip().splitlines() or ["no word"])[-1]
    return wall, cpu, end


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, nargs="+", default=[20.0, 60.0, 200.0])
    parser.add_argument("--stages", nargs="+", default=list(STAGES), choices=STAGES)
    parser.add_argument("--study", type=Path, nargs="*", default=[])
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        studies = asked.study or [loop(place / "loop"), write_demo(place / "link"), unit(place / "unit")]
        print(f"{'plant':10} {'stage':9} {'asked s':>8} {'used s':>8} {'used/asked':>10} {'cpu/wall':>8}  end")
        for study in studies:
            for stage in asked.stages:
                for seconds in asked.seconds:
                    folder = place / f"{study.parent.name}-{stage}-{seconds:g}"
                    wall, cpu, end = timed(study, stage, seconds, folder)
                    row = f"{study.parent.name:10} {stage:9} {seconds:8g} {wall:8.1f} {wall / seconds:10.2f} {cpu / wall:8.2f}"
                    print(f"{row}  {end[:150]}", flush=True)


if __name__ == "__main__":
    main()
