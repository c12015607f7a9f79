"""The first look of a diagnosis: processor time of one screen of candidates, and the share that its integrations have.

    python benchmarks/screen.py [--cases machine park link] [--times 3] [--against OTHER]

The cases are the first record of a single hidden effect (seed 1) of the machine and of the park of `studies/hidden_effects`, with the whole
catalogue, and the link of `benchmarks/diagnose.py` with four effects. Each is diagnosed up to its first screen, which is then run and
timed in a process of its own, machine code included; the least of several times is told. --against: another checkout, measured by turns.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[1]
CASES = ("machine", "park", "link")


class _CapturedError(Exception):
    """Raised in place of a screen, with what it was asked."""


def asked_of_screen(case: str) -> tuple[Any, Any, list[tuple[int, int]]]:
    """Return the setup, the candidates and the columns of a case's first screen."""
    from hvdc_ident.discrepancy import diagnose, expansion

    whole = expansion.screened

    def captured(setup: Any, candidates: Any, *, columns: Any, **_: Any) -> Any:
        raise _CapturedError(setup, candidates, list(columns))

    expansion.screened = captured
    try:
        if case == "link":
            import diagnose as link

            from hvdc_ident.models import load_model

            records = link.recorded(len(link.OUTPUTS))
            diagnose(load_model("vsc-hvdc-link"), records, link.FREE, effects=["lag", "delay", "limit", "deadband"])
        else:
            sys.path.insert(0, str(HERE / "studies" / "hidden_effects"))
            from hidden.cases import designs, made
            from hidden.diagnosing import experiments_of, free_of, model_of

            design = designs("single", 1, (case,), False)[0]
            made_case = made(design, 1)
            assert made_case is not None
            diagnose(model_of(case), experiments_of(made_case), free_of(made_case), effects="all", seed=design.number)
    except _CapturedError as found:
        setup, candidates, columns = found.args
        return setup, candidates, columns
    finally:
        expansion.screened = whole
    raise AssertionError(f"{case}: nothing was screened")


def measured(case: str) -> tuple[float, float, int, int]:
    """Return the processor time of a case's first screen and of its integrations, s, and how many candidates and sizes it ran."""
    from hvdc_ident.discrepancy.screen import screened
    from hvdc_ident.simulate import engine

    setup, candidates, columns = asked_of_screen(case)
    inside, integrate = 0.0, engine.integrate

    def timed(*arguments: Any) -> Any:
        nonlocal inside
        begin = time.process_time()
        try:
            return integrate(*arguments)
        finally:
            inside += time.process_time() - begin

    engine.integrate = timed
    begin = time.process_time()
    screened(setup, candidates, columns=columns)
    return time.process_time() - begin, inside, len(candidates), len(columns)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--times", type=int, default=3)
    parser.add_argument("--against", type=Path, help="another checkout, whose core is built")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args(arguments)
    if asked.one:
        print(*measured(asked.cases[0]))
        return
    places = [p.resolve() for p in (asked.against, HERE) if p is not None]
    print(
        f"{'case':8s} {'candidates':>10s} {'sizes':>6s}  " + "  ".join(f"s, integrating s ({p.name})" for p in places)
    )
    for case in asked.cases:
        found: dict[Path, list[tuple[float, ...]]] = {p: [] for p in places}
        for _ in range(asked.times):
            for place in places:
                environment = {**os.environ, "PYTHONPATH": str(place), "OMP_NUM_THREADS": "1"}
                command = [sys.executable, __file__, "--one", "--cases", case]
                told = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
                found[place].append(tuple(float(x) for x in told.split()))
        best = {p: min(runs) for p, runs in found.items()}
        _, _, candidates, sizes = best[HERE]
        print(
            f"{case:8s} {candidates:10.0f} {sizes:6.0f}  "
            + "  ".join(f"{a:8.2f} {b:6.2f}" for a, b, *_ in best.values())
        )


if __name__ == "__main__":
    main()
