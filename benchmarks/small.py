"""Small problems diagnosed one after the other: seconds of each by phase, and how they are spread.

    python benchmarks/small.py [--seed 1] [--part single] [--cases 20] [--least 10] [--workers 2]

The problems are those of `studies/hidden_effects`: another simulator hides an effect in a small plant, 2 to 3 outputs, 300 rows,
two experiments to fit and one held out. The whole catalogue is tried at every slot. Making a case is not counted, nor is the
start of the workers, which stay; the first diagnosis loads what is compiled.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path

import numpy as np
from diagnose import Watch

from hvdc_ident.discrepancy import diagnose
from hvdc_ident.parallel import LocalPool

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "studies" / "hidden_effects"))

from hidden.cases import PARTS, Case, designs, made
from hidden.diagnosing import experiments_of, free_of, model_of
from run import pending


def cases(part: str, seed: int, least: float, count: int, numbers: Sequence[int]) -> Iterator[Case]:
    """The first cases of a part, or those of some numbers, each made when it is asked for; those that no place holds are not."""
    named = [d for d in designs(part, seed) if d.number in numbers]
    for design in named if numbers else pending([part], seed, count, set(), least=least):
        case = made(design, seed)
        if case is not None:
            yield case


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--part", choices=list(PARTS), default="single")
    parser.add_argument("--cases", type=int, default=20)
    parser.add_argument("--numbers", type=int, nargs="+", default=[], help="these cases of the part instead")
    parser.add_argument("--least", type=float, default=10.0)
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args(arguments)
    walls: list[float] = []
    spent: dict[str, float] = {}
    pool = LocalPool(asked.workers).open() if asked.workers > 1 else nullcontext()
    with pool as executor:
        for case in cases(asked.part, asked.seed, asked.least, asked.cases, asked.numbers):
            watch, begin = Watch(quiet=True), time.perf_counter()
            told = diagnose(
                model_of(case.design.plant),
                experiments_of(case),
                free_of(case),
                seed=case.design.number,
                executor=executor,
                progress=watch,
            )
            watch(1, 1, "end")
            walls.append(time.perf_counter() - begin)
            for phase, (seconds, _) in watch.spent.items():
                spent[phase] = spent.get(phase, 0.0) + seconds
            longest = sorted(watch.spent.items(), key=lambda s: -s[1][0])[:4]
            where = ", ".join(f"{phase} {seconds:.1f}" for phase, (seconds, _) in longest)
            print(f"{walls[-1]:7.1f} s  {case.design.name} {told.verdict}: {where}", flush=True)
    if not walls:
        parser.error("there is no such case: no number of the part, or no place holds one")
    for phase, seconds in sorted(spent.items(), key=lambda s: -s[1]):
        print(f"{seconds:8.1f} s  {phase}")
    low, middle, high = np.quantile(walls, [0.0, 0.5, 0.95])
    print(
        f"{len(walls)} diagnoses, {asked.workers} workers: least {low:.1f} s, median {middle:.1f}, 95 % {high:.1f}, most {max(walls):.1f}"
    )


if __name__ == "__main__":
    main()
