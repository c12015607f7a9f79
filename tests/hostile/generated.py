"""Small studies drawn at random, run through every command: nothing may end in a traceback, a warning or a blank reason.

As a test, a few (test_generated.py). As a program, as many as asked for, with a table of how each command ended:

    python tests/hostile/generated.py --first 0 --runs 200 [--folder DIR] [--commands check,fit]

Deterministic by number; a study that went wrong is left in the folder and can be run alone (`--first 17 --runs 1`).
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from typer.testing import CliRunner

from tests.hostile.plants import Array, Draw, Plant, Seeded, chance, plant, recorded

LONGEST = 120  # s of processor time a command may take
COMMANDS = (
    "check", "simulate", "linearize", "sweep", "identify", "fit", "diagnose", "run", "report", "letter",
    "export .toml", "export .mo", "export .ssv", "export .fmu", "export .mat", "export .json", "export .csv", "export .m",
)  # fmt: skip
EFFECTS = (
    "lag", "delay", "second-order", "limit", "saturation", "rate-limit", "deadband", "backlash", "quantisation",
    "window-mean", "sample-hold", "lead-lag", "gain", "offset", "coupling", "droop", "loss", "disturbance",
)  # fmt: skip
GIVEN = {
    "delay": {"T": 0.03}, "lag": {"T": 0.02}, "sample-hold": {"Ts": 0.05}, "quantisation": {"step": 0.05},
    "limit": {"level": 5.0}, "deadband": {"width": 0.01}, "window-mean": {"T": 0.02}, "rate-limit": {"rate": 50.0},
    "backlash": {"width": 0.01}, "second-order": {"wn": 40.0, "zeta": 0.7},
}  # fmt: skip


# ------------------------------------------------------------------------------------------------------------- a study


def write_study(draw: Draw, folder: Path) -> Path:
    """The path of a study with its card and recordings, drawn anew until the plant can be run."""
    while True:
        drawn = plant(draw)
        try:
            text = _study(draw, drawn, folder)
        except (ArithmeticError, ValueError):
            continue
        path = folder / "study.toml"
        path.write_text(text, "utf-8")
        return path


def _study(draw: Draw, drawn: Plant, folder: Path) -> str:
    bounds = {n: (0.2 * v, 5.0 * v) for n, v in drawn.parameters.items() if chance(draw, 40)}
    (folder / "model.toml").write_text(drawn.card(bounds), "utf-8")
    lines = [
        "schema = 1",
        f'name = "{draw.pick(["drawn", "Prüfstand 7 – Δu", "поле"])}"',
        "[model]",
        'source = "model.toml"',
    ]
    lines += _given_effect(draw, drawn)
    able = drawn.seen() or [*drawn.parameters]
    names = _some(draw, able if chance(draw, 85) else [*drawn.parameters], 3)
    lines += ["[parameters]"] + [_candidate(draw, n, drawn.parameters[n], bounds.get(n)) for n in names]
    others = [n for n in drawn.parameters if n not in names]
    if others and chance(draw, 5):
        lines.append(
            f'{others[0]} = {{tie = "{drawn.parameters[others[0]] / drawn.parameters[names[0]]!r}*{names[0]}"}}'
        )
    roles = draw.pick([["fit"], ["fit", "holdout"], ["fit", "fit"], ["fit", "fit", "holdout"]])
    if chance(draw, 4):
        roles = ["holdout"]
    recordings = [_recording(draw, drawn, folder, k, role) for k, role in enumerate(roles)]
    lines += [line for own in recordings for line in own]
    lines += _settings(draw, drawn, names)
    return "\n".join(lines) + "\n"


def _some(draw: Draw, names: Sequence[str], most: int) -> list[str]:
    first = draw.integer(0, len(names) - 1)
    return [*names[first:], *names[:first]][: draw.integer(1, most)]


def _given_effect(draw: Draw, drawn: Plant) -> list[str]:
    places = [*drawn.inputs, *drawn.signals, *drawn.states]
    if not places or not chance(draw, 20):
        return []
    name = draw.pick([*GIVEN])
    values = ", ".join(f"{n} = {v}" for n, v in GIVEN[name].items())
    return ["[[model.effect]]", f'effect = "{name}"', f'at = ["{draw.pick(places)}"]', f"parameters = {{{values}}}"]


def _candidate(draw: Draw, name: str, value: float, own: tuple[float, float] | None) -> str:
    start = value * draw.pick([1.0, 0.8, 1.25, 1.5])
    low, high = own or (value / 10, value * 10)
    kind = draw.integer(1, 100)
    if kind <= 20:
        return f"{name} = {{start = {start!r}}}"
    if kind <= 30:
        return f"{name} = {{start = {start!r}, min = {start!r}, max = {high!r}}}"
    if kind <= 40:
        return f"{name} = {{start = {start!r}, min = {low!r}, max = {start!r}}}"
    if kind <= 45:
        prior = f"prior = {{mean = {value!r}, std = {0.2 * value!r}}}"
        return f"{name} = {{start = {start!r}, min = {low!r}, max = {high!r}, {prior}}}"
    if kind <= 48:
        return f"{name} = {{start = {start!r}, min = {low!r}, max = {high!r}, per-experiment = true}}"
    return f"{name} = {{start = {start!r}, min = {low!r}, max = {high!r}}}"


def _recording(draw: Draw, drawn: Plant, folder: Path, k: int, role: str) -> list[str]:
    rows = draw.pick([60, 80, 100, 100, 120, 150] * 6 + [1, 2, 2, 3, 5])
    begin, step = draw.pick([0.0, 0.0, 0.0, 5.0, -0.5]), draw.pick([0.02, 0.05])
    steps = np.full(rows - 1, step) * (
        np.array([draw.pick([0.5, 1, 1.5]) for _ in range(rows - 1)]) if chance(draw, 15) else 1.0
    )
    t = np.round(begin + np.concatenate([[0.0], np.cumsum(steps)]), 6)
    inputs = {n: _waveform(draw, rows, rest) for n, rest in drawn.inputs.items()}
    linear = chance(draw, 25)
    y = recorded(drawn, t, inputs, linear)
    noise = draw.pick([0.0, 1e-6, 1e-3, 1e-3, 1e-2, 1e-2])
    seed = draw.integer(0, 10**6)
    spread = noise * np.maximum(np.ptp(y, axis=0), 0.1)
    y = y + spread * np.random.default_rng(seed).normal(size=y.shape)
    columns = {n: draw.pick([n, n, f"{n} [pu]", f"Größe {n}"]) for n in drawn.outputs}
    shown = [*drawn.outputs] if chance(draw, 70) else _some(draw, [*drawn.outputs], 2)
    header = ["time", *inputs, *(f"col {n}" if n in inputs else columns[n] for n in drawn.outputs)]
    table = np.column_stack([t, *inputs.values(), y])
    text = "\n".join([",".join(header), *(",".join(f"{v:.9g}" for v in row) for row in table)])
    (folder / f"e{k}.csv").write_text(text + "\n", "utf-8")
    lines = ["[[experiment]]", f'name = "{draw.pick(["e", "Versuch ü"])}{k}"', f'data = "e{k}.csv"', f'role = "{role}"']
    if inputs:
        lines.append(f"inputs = {json.dumps([*inputs])}")
    lines.append("outputs = {" + ", ".join(f'{n} = "{columns[n]}"' for n in shown) + "}")
    if chance(draw, 40):
        lines.append("noise = {" + ", ".join(f"{n} = {max(noise, 1e-4)!r}" for n in shown) + "}")
    if linear:
        lines.append('interpolation = "linear"')
    middle = float(t[rows // 2])
    if chance(draw, 10) and rows > 10:
        lines.append(f"window = [{float(t[2])!r}, {float(t[-2])!r}]")
    if chance(draw, 15) and rows > 10:
        lines.append(f"event = {middle!r}")
    if chance(draw, 10):
        lines.append(f'nuisance = ["{draw.pick(["time-shift", *inputs])}"]')
    if chance(draw, 10):
        lines.append(f"instrument = {{{shown[0]} = {{window-mean = 0.02, delay = 0.001, class = 0.5}}}}")
    return lines


def _waveform(draw: Draw, rows: int, rest: float) -> Array:
    """(rows,) of an input: mostly at rest at first."""
    k = np.arange(rows) / max(rows - 1, 1)
    size = draw.pick([0.1, 0.3, 0.6, -0.2])
    return np.asarray(
        draw.pick(
            [
                lambda: rest + size * (k > 0.2),
                lambda: rest + size * (k > 0.2) - 0.5 * size * (k > 0.6),
                lambda: rest + size * np.clip(3 * (k - 0.2), 0, 1),
                lambda: rest + size * (k > 0.15) * np.sin(20 * k),
                lambda: rest + size * np.sin(9 * k) ** 2,
                lambda: np.full(rows, rest),
                lambda: rest + 0.1 * np.sin(1000 * k**2),
            ]
        )()
    )


def _settings(draw: Draw, drawn: Plant, names: Sequence[str]) -> list[str]:
    lines = []
    if chance(draw, 50):
        lines.append("[linearize]")
        if chance(draw, 50):
            lines += [
                f"outputs = {json.dumps(_some(draw, [*drawn.outputs], 2))}",
                f'at = "{draw.pick(["steady", "start"])}"',
            ]
    name = draw.pick([*drawn.parameters])
    value = drawn.parameters[name]
    sweep = (
        [f"min = {0.5 * value!r}", f"max = {2 * value!r}", "points = 4"]
        if chance(draw, 60)
        else [f"values = [{value!r}]"]
    )
    wanted = draw.pick(['["rmse"]', '["rmse", "poles"]', '["rmse", "bode"]'])
    lines += [
        "[[sweep]]",
        f'parameter = "{name}"',
        *sweep,
        f"want = {wanted}",
    ]
    lines.append("[identifiability]")
    if len(names) > 1 and chance(draw, 10):
        lines.append(f"pair = {json.dumps(names[:2])}")
    lines += ["[fit]", f"starts = {draw.pick([1, 2, 4])}"]
    extra = draw.pick(
        [
            "",
            "",
            "",
            'whiten = "residual"',
            "whiten = true",
            'loss = "huber"',
            'residual = "frequency"',
            'optimiser = "least-squares"',
            'mode = "individual"\ngroups = [' + ", ".join(f'{{parameters = ["{n}"]}}' for n in names) + "]",
        ]
    )
    if extra:
        lines.append(extra)
    effects = "all" if chance(draw, 5) else [draw.pick(EFFECTS) for _ in range(2)]
    return [*lines, "[diagnose]", f"effects = {json.dumps(effects if effects == 'all' else sorted(set(effects)))}"]


# ------------------------------------------------------------------------------------------------------------- its runs


@dataclass(frozen=True)
class Ended:
    """How one command ended. said: its error, empty where it has none; bug: a traceback or a warning, empty where none."""

    command: str
    code: int
    said: str
    bug: str
    seconds: float


class TookTooLong(BaseException):
    """A command was still running after its time."""


@contextmanager
def limited(seconds: int) -> Iterator[None]:
    def late(*_: Any) -> None:
        raise TookTooLong(f"over {seconds} s")

    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, seconds)  # of this process alone: another one's load does not count
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def run(study: Path, command: str) -> Ended:
    """One command on a study, every warning an error."""
    from hvdc_ident.cli import app

    name, _, ending = command.partition(" ")
    arguments = [name, str(study), "--quiet"]
    if ending:
        arguments += ["--to", str(study.with_name(f"exported{ending}"))]
        arguments += ["--source-only"] if ending == ".fmu" else []
    begin = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            with limited(LONGEST):
                result = CliRunner(env={"HVDC_IDENT_DEBUG": "1"}).invoke(app, arguments)
        except TookTooLong as late:
            return Ended(command, -1, "", str(late), time.process_time() - begin)
    seconds = time.process_time() - begin
    errors = [s for s in result.stderr.splitlines() if s.startswith("error: ")]
    said = errors[-1].removeprefix("error: ") if errors else ""
    bug = ""
    if "a bug in hvdc-ident" in said or "Traceback" in result.stderr or result.exit_code not in (0, 1, 2):
        bug = result.stderr or repr(result.exception)
    elif result.exit_code and len(said) < 20:
        bug = f"exit code {result.exit_code} without a reason: {result.stderr!r}"
    return Ended(command, result.exit_code, said, bug, seconds)


def spoilt_results(study: Path) -> list[str]:
    """The files of the results that are no strict JSON."""
    wrong = []
    for path in sorted(study.with_name("study-results").glob("*.json")):
        try:
            json.loads(path.read_text("utf-8"), parse_constant=lambda n: (_ for _ in ()).throw(ValueError(n)))
        except ValueError as e:
            wrong.append(f"{path.name}: {e}")
    return wrong


def main() -> int:
    """0 where no command of any study ended in a traceback, a warning, a blank reason or too late."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--commands", default=",".join(COMMANDS))
    asked = parser.parse_args()
    folder = asked.folder or Path(tempfile.mkdtemp())
    ends: Counter[tuple[str, str]] = Counter()
    reasons: Counter[tuple[str, str]] = Counter()
    wrong = 0
    for k in range(asked.first, asked.first + asked.runs):
        own = folder / f"{k:04d}"
        own.mkdir(parents=True, exist_ok=True)
        study = write_study(Seeded(np.random.default_rng([37, k])), own)
        bad = []
        for command in asked.commands.split(","):
            end = run(study, command)
            how = "wrong" if end.bug else {0: "done", 1: "failed", 2: "refused"}[end.code]
            ends[command, how] += 1
            if end.said and not end.bug:
                reasons[command, re.sub(r"[-+]?\d[\d.e+-]*", "#", end.said)] += 1
                print(f"{k:04d} {command}: {how} in {end.seconds:.1f} s: {end.said}", flush=True)
            if end.bug:
                bad.append(end)
                print(f"{k:04d} {command}: WRONG in {end.seconds:.1f} s: {end.bug}", flush=True)
        for text in spoilt_results(study):
            bad.append(text)
            print(f"{k:04d} results: WRONG: {text}", flush=True)
        wrong += bool(bad)
        print(f"{k:04d} {'WRONG' if bad else 'good'}", flush=True)
    print(f"\n{asked.runs} studies, {wrong} with something wrong")
    for command in asked.commands.split(","):
        row = ", ".join(
            f"{ends[command, how]} {how}" for how in ("done", "failed", "refused", "wrong") if ends[command, how]
        )
        print(f"{command:14} {row}")
    for (command, text), count in sorted(reasons.items()):
        print(f"{count:4} x {command}: {text[:400]}")
    return 1 if wrong else 0


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(main())
