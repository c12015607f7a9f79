"""The JSON of every stage of eight studies, and of those that stand beside the project, where they are there.

Long lists are kept as their length, first and last entries and norm, so that a frozen document stays readable.
"""

from __future__ import annotations

import importlib
import json
import math
import shutil
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from runs import ROOT, Item, Setting, command, settled

NUMBERS, ROWS = 12, 40
"""Entries of a list of numbers, and of other entries, that are kept whole."""
VOLATILE = frozenset({"software", "fingerprint", "sources", "seconds", "created", "date", "elapsed", "evaluations"})
OUTSIDE = ROOT.parent / "shared" / "foreign"
"""Studies of other plants beside the project."""

LINK = """schema = 1
name = "link"
[model]
source = "vsc-hvdc-link"
[linearize]
inputs = ["Vdcref1", "Pref2"]
outputs = ["Irorder1", "P2"]
break_at = ["Vdc1"]
"""
AVERAGE = """schema = 1
name = "average"
[model]
source = "vsc-hvdc-avm"
[linearize]
inputs = ["Pref2"]
outputs = ["P2"]
"""
STAGES = """
[linearize]
[[sweep]]
parameter = "{parameter}"
points = 5
min = {low}
max = {high}
[identifiability]
[fit]
starts = 4
[diagnose]
"""


def _demo(setting: Setting) -> dict[str, Any]:
    return _results("demo", "--workers", str(setting.workers), setting=setting, out=setting.folder / "results")


def _new(setting: Setting) -> dict[str, Any]:
    _fresh(setting.folder / "new")
    _succeed(setting, "new", "new")
    return _run(setting, setting.folder / "new" / "study.toml")


def _text(text: str, setting: Setting) -> dict[str, Any]:
    path = setting.folder / "study.toml"
    path.write_text(text, encoding="utf-8")
    return _run(setting, path)


def _plant(name: str, setting: Setting) -> dict[str, Any]:
    """Return the results of a plant of other code, with its hidden effect, through every stage."""
    sys.path.insert(0, str(ROOT))
    plant = importlib.import_module(f"tests.foreign.plants.{name}").PLANT
    parameter, (low, high) = next(iter(plant.bounds.items()))
    tables = STAGES.format(parameter=parameter, low=low, high=high)
    return _run(setting, plant.study(setting.folder, hidden=True, seed=3, tables=tables))


def _fmu(setting: Setting) -> dict[str, Any]:
    """Return the results of the starting study with its model as an FMU."""
    folder = _fresh(setting.folder / "new")
    _succeed(setting, "new", "new")
    _succeed(setting, "export", folder / "study.toml", "--to", folder / "link.fmu", "--values", "given")
    text = (folder / "study.toml").read_text(encoding="utf-8").replace('"vsc-hvdc-link"', '"link.fmu"', 1)
    (folder / "study.toml").write_text(text + "\n[diagnose]\n", encoding="utf-8")
    return _run(setting, folder / "study.toml")


def _outside(path: str, setting: Setting) -> dict[str, Any]:
    return _run(setting, OUTSIDE / path)


def _run(setting: Setting, study: Path) -> dict[str, Any]:
    out = setting.folder / "results"
    return _results("run", study, "--workers", str(setting.workers), setting=setting, out=out)


def _results(*arguments: str | Path, setting: Setting, out: Path) -> dict[str, Any]:
    """Return the exit code and every JSON file that a command writes to `out`, condensed."""
    _fresh(out)
    code, _, errors = command(*arguments, "--quiet", "--out", out, cwd=setting.folder)
    if code == 2:
        raise RuntimeError(f"{' '.join(map(str, arguments))}: exit 2\n{errors}")
    files = sorted(p for p in out.glob("*.json"))
    return {"exit": code} | {p.stem: condensed(json.loads(p.read_text(encoding="utf-8"))) for p in files}


def _succeed(setting: Setting, *arguments: str | Path) -> None:
    code, said, errors = command(*arguments, cwd=setting.folder)
    if code:
        raise RuntimeError(f"{' '.join(map(str, arguments))}: exit {code}\n{errors or said}")


def _fresh(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    return folder


def condensed(value: Any) -> Any:
    """Return a result with long lists shortened, numbers of six digits, and without what differs from run to run."""
    if isinstance(value, Mapping):
        return {k: condensed(v) for k, v in value.items() if k not in VOLATILE}
    if isinstance(value, list):
        if len(value) > NUMBERS and all(isinstance(v, int | float) for v in value):
            norm = math.sqrt(sum(float(v) ** 2 for v in value))
            return condensed({"entries": len(value), "first": value[0], "last": value[-1], "norm": norm})
        if len(value) > ROWS:
            return {"entries": len(value), "first": condensed(value[:ROWS])}
        return [condensed(v) for v in value]
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, str):
        return settled(value, [])
    return value


def _there(path: Path) -> Callable[[], str]:
    return lambda: "" if path.exists() else f"{path.name} is not beside the project"


ITEMS = (
    Item("demo", _demo),
    Item("new", _new),
    Item("link", partial(_text, LINK)),
    Item("average", partial(_text, AVERAGE)),
    Item("heater", partial(_plant, "heater")),
    Item("dc-motor", partial(_plant, "dc_motor")),
    Item("machine", partial(_plant, "machine"), full=True),
    Item("fmu", _fmu),
    *(
        Item(name, partial(_outside, path), full=full, missing=_there(OUTSIDE / path))
        for name, path, full in (
            ("letter-gains", "reports/letter-gains/study.toml", False),
            ("tie-place", "reports/tie-place/study.toml", False),
            ("windows-mixed", "reports/windows-mixed/study.toml", False),
            ("gain-absorbed", "fmus/gain_absorbed/study.toml", True),
            ("noise-before-event", "fmus/noise_before_event/study.toml", True),
            ("smib", "smib/study.toml", True),
            ("smib-2", "smib/study2.toml", True),
            ("hydro", "hydro/st/study.toml", True),
            ("hydro-stated", "hydro/st2/study.toml", True),
            ("converter", "gfl/s2/study.toml", True),
        )
    ),
)
