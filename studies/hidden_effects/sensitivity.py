"""How the diagnosis depends on its numbers: each is halved and doubled, and some hidden effects are diagnosed again.

python studies/hidden_effects/sensitivity.py [--only NAME ...] [--out FOLDER] [--judge-only]

A number that is a share of at least a half is changed by its distance from 1. What is compared is the verdict with the
effect classes found. Results are kept line by line, and a second call resumes the first.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import math
import pkgutil
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

from common.ending import markdown  # noqa: E402
from hidden.cases import designs, made  # noqa: E402
from hidden.diagnosing import experiments_of, free_of, model_of  # noqa: E402
from hidden.plants import FIRST, PLANTS  # noqa: E402

import hvdc_ident.discrepancy  # noqa: E402
from hvdc_ident.discrepancy import DiagnosisOptions, diagnose  # noqa: E402
from hvdc_ident.errors import HvdcIdentError  # noqa: E402

CASES = ((100, "single-000"), (100, "single-007"), (100, "clean-001"))
"""Seed and name: a backlash in slow noise whose size is not stated, a gain, and nothing in such noise."""
OUTSIDE = ((94, "outside-000"),)
"""A cube, for the numbers that only what is outside the catalogue meets."""
MET = ((103, "single-080"), (103, "single-3014"))
"""A sampler and a quantiser, for the numbers of the search for sizes that have to be met."""
WRONG = ((6001, "value-000"), (6001, "value-001"), (100, "single-007"))
"""Two values that the card states wrong, and a gain, for the numbers of stated values."""
FACTORS = (0.5, 2.0)


@dataclass(frozen=True)
class Number:
    """A number of the diagnosis: its module, its name there, its value."""

    module: str
    name: str
    value: float

    @property
    def label(self) -> str:
        """Module and name, as the table has them."""
        return f"{self.module.removeprefix('hvdc_ident.discrepancy.')}.{self.name}"

    @property
    def cases(self) -> tuple[tuple[int, str], ...]:
        """Seed and name of the cases that it is tried on."""
        special = {"outside": OUTSIDE, "sizes": MET, "values": WRONG, "stated": WRONG}
        return next((c for part, c in special.items() if part in self.module.split(".")), CASES)

    def times(self, factor: float) -> float:
        """Return the value times a factor; of a share of at least a half its distance from 1 is multiplied, a count is rounded."""
        if isinstance(self.value, int):
            return max(round(self.value * factor), 1)
        if 0.5 <= self.value < 1.0:
            return 1.0 - min((1.0 - self.value) * factor, 1.0)
        return self.value * factor


def modules() -> list[Any]:
    """Return every module of the diagnosis."""
    room = hvdc_ident.discrepancy
    return [importlib.import_module(m.name) for m in pkgutil.walk_packages(room.__path__, room.__name__ + ".")]


def numbers() -> Iterator[Number]:
    """Return the numeric constants of the modules, then the options that are no switch."""
    for module in modules():
        tree = ast.parse(Path(module.__file__).read_text(encoding="utf-8"))
        targets = [t for statement in tree.body if isinstance(statement, ast.Assign) for t in statement.targets]
        names = [n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name) and n.id.isupper()]
        for name in names:
            value = getattr(module, name)
            if isinstance(value, (int, float)) and not isinstance(value, bool):
                yield Number(module.__name__, name, value)
    for name, value in vars(DiagnosisOptions()).items():
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            yield Number("options", name, value)


@contextmanager
def changed(number: Number, value: float) -> Iterator[DiagnosisOptions]:
    """Set a constant wherever it is used, and yield the options, for as long as the context lasts."""
    if number.module == "options":
        yield DiagnosisOptions(**{number.name: value})
        return
    users = [(m, name) for m in modules() for name in _names(m, number)]
    try:
        for module, name in users:
            setattr(module, name, value)
        yield DiagnosisOptions()
    finally:
        for module, name in users:
            setattr(module, name, number.value)


def _names(module: Any, number: Number) -> list[str]:
    """Return the names that a module has for a constant, its own or imported."""
    if module.__name__ == number.module:
        return [number.name]
    tree = ast.parse(Path(module.__file__).read_text(encoding="utf-8"))
    lines = [n for n in tree.body if isinstance(n, ast.ImportFrom) and n.module == number.module]
    return [a.asname or a.name for n in lines for a in n.names if a.name == number.name]


def found(seed: int, name: str, options: DiagnosisOptions) -> dict[str, Any]:
    """Return the verdict of one case, the effect classes with their insertion points, and the seconds it took."""
    part, number = name.split("-")
    groups = (FIRST, *((p,) for p in PLANTS if p not in FIRST))
    design = next(d for g in groups for d in designs(part, seed, g, False) if d.name == name)
    case = made(design, seed)
    if case is None:
        raise ValueError(f"seed {seed} has no case {name}")
    begin = time.perf_counter()
    try:
        told = diagnose(model_of(design.plant), experiments_of(case), free_of(case), options=options, seed=int(number))
    except HvdcIdentError as error:
        return {"verdict": f"failed: {error}", "found": [], "seconds": time.perf_counter() - begin}
    classes = sorted("/".join(sorted(f.same_as)) for f in told.findings)
    return {"verdict": told.verdict, "found": classes, "seconds": time.perf_counter() - begin}


def main(arguments: Sequence[str] | None = None) -> None:
    """Diagnose the cases with each number changed and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0] if __doc__ else "")
    parser.add_argument("--only", nargs="+", help="numbers, by the table's names")
    parser.add_argument("--out", type=Path, default=HERE / "sensitivity-results", help="folder of the results")
    parser.add_argument("--judge-only", action="store_true", help="write the table of what is there")
    asked = parser.parse_args(arguments)
    if unknown := sorted(set(asked.only or ()) - {n.label for n in numbers()}):
        parser.error(
            f"--only: no such number: {', '.join(unknown)}; expected names such as options.TOLERANCE or score.CLEAR_CHI2"
        )
    asked.out.mkdir(parents=True, exist_ok=True)
    path = asked.out / "runs.jsonl"
    done = [json.loads(text) for text in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []
    if not asked.judge_only:
        there = {(r["number"], r["factor"], r["case"]) for r in done}
        jobs = [(None, 1.0), *((n, f) for n in numbers() for f in FACTORS if not asked.only or n.label in asked.only)]
        with path.open("a", encoding="utf-8") as file:
            for k, (number, factor) in enumerate(jobs):
                for seed, name in dict.fromkeys((*CASES, *OUTSIDE, *MET, *WRONG)) if number is None else number.cases:
                    key = ("" if number is None else number.label, factor, f"{seed} {name}")
                    if key in there:
                        continue
                    if number is None:
                        line = found(seed, name, DiagnosisOptions())
                    else:
                        with changed(number, number.times(factor)) as options:
                            line = found(seed, name, options)
                    line |= {"number": key[0], "factor": factor, "case": key[2]}
                    done.append(line)
                    print(json.dumps(line), file=file, flush=True)
                print(f"{k + 1}/{len(jobs)} {key[0]} {factor:g}", file=sys.stderr, flush=True)
    (asked.out / "table.md").write_text(table(done) + "\n", encoding="utf-8")


def table(runs: Sequence[dict[str, Any]]) -> str:
    """Return the table: by number what changes with the half and the double, the sensitive ones first."""
    base = {r["case"]: r for r in runs if not r["number"]}
    values = {n.label: n.value for n in numbers()}
    rows = []
    for label in dict.fromkeys(r["number"] for r in runs if r["number"] in values):
        own = {f: [r for r in runs if r["number"] == label and r["factor"] == f] for f in FACTORS}
        verdicts = {f: [r for r in own[f] if _differs(r, base[r["case"]])] for f in FACTORS}
        slower = max((r["seconds"] / base[r["case"]]["seconds"] for f in FACTORS for r in own[f]), default=math.nan)
        cells = [_cell(own[f], verdicts[f], base) for f in FACTORS]
        rows.append((-sum(map(len, verdicts.values())), [label, f"{values[label]:g}", *cells, f"{slower:.1f}"]))
    rows.sort(key=lambda r: r[0])
    return markdown(["number", "value", "half", "double", "slowest, times the time"], [r for _, r in rows])


def _differs(run: dict[str, Any], base: dict[str, Any]) -> bool:
    return (run["verdict"], run["found"]) != (base["verdict"], base["found"])


def _cell(runs: Sequence[dict[str, Any]], other: Sequence[dict[str, Any]], base: dict[str, Any]) -> str:
    """Return what changed, of how many cases."""
    if not other:
        return f"same in {len(runs)}"
    return "; ".join(f"{r['case']}: {_told(base[r['case']])} becomes {_told(r)}" for r in other)


def _told(run: dict[str, Any]) -> str:
    return run["verdict"] + (f" ({', '.join(run['found'])})" if run["found"] else "")


if __name__ == "__main__":
    main()
