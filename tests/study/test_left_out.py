"""Rows that cannot be right in a unit's record: said with their rows, left out, and mended by the line that is said."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.data import Array, Contradiction, Experiment, InputSignal
from hvdc_ident.model import AnyModel, Model
from hvdc_ident.study.parse import parse_study
from hvdc_ident.study.recordings import Recordings, read_experiments
from tests.study.test_terminal_columns import Columns, machine, new, plant, recorded, stated, written

__all__ = ["machine", "plant"]
CLEARED = InputSignal.corners([(1.0, 1.0), (1.0, 0.4), (1.12, 0.4), (1.12, 0.97)])


@pytest.fixture(scope="module")
def unit(plant: Columns, tmp_path_factory: pytest.TempPathFactory) -> AnyModel:
    """The unit whose terminals are played back."""
    folder = tmp_path_factory.mktemp("unit")
    new(folder, plant)
    return hi.load_study(stated(folder, {})).model


def read(
    unit: AnyModel, folder: Path, columns: Columns, line: str = "", inputs: Iterable[str] = ("V", "theta")
) -> Experiment:
    """The experiment of a record. line: of the study, in place of the one with its key."""
    written(folder, columns)
    path = stated(folder, {"inputs": list(inputs)})
    text = (
        re.sub(rf"^{line.partition(' = ')[0]} = .*\n", "", path.read_text(), flags=re.MULTILINE)
        if line
        else path.read_text()
    )
    path.write_text(text.replace("interpolation = ", f"{line}\ninterpolation = "))
    tables = parse_study(path.read_bytes(), path).experiment
    (experiment,), _ = read_experiments(tables, unit, Recordings(folder), path.name)
    return experiment


def said(experiment: Experiment) -> tuple[Contradiction, ...]:
    assert experiment.measured is not None
    return experiment.measured.origin.contradictions


def not_compared(experiment: Experiment) -> dict[str, set[int]]:
    """By output the numbers of the rows, from 1, in which it is not compared."""
    assert experiment.measured is not None
    return {o: set((np.flatnonzero(np.isnan(experiment.measured[o])) + 1).tolist()) for o in experiment.outputs}


def put(first: int, last: int, values: Callable[[Array], object], *names: str) -> Callable[[Columns], Columns]:
    """How a record is spoilt. first, last: rows, from 1; values: of what stands there."""

    def spoilt(p: Columns) -> Columns:
        found = {n: v.copy() for n, v in p.items()}
        for n in names:
            found[n][first - 1 : last] = values(found[n][first - 1 : last])
        return found

    return spoilt


def again(p: Columns) -> Columns:
    found = {n: v.copy() for n, v in p.items()}
    for n in ("V", "theta", "P", "Q"):
        found[n][150:170] = found[n][110:130]
    return found


def limited(p: Columns) -> Columns:
    found = dict(p)
    found["P"] = p["P"].copy()
    found["P"][120:150] = p["P"].max() + 5.0
    return found


@dataclass(frozen=True)
class Spoilt:
    """A record that is spoilt, and what is found. rows: numbers from 1; write: key of the line to write, "" where nothing is left to do."""

    kind: str
    by: Callable[[Columns], Columns]
    columns: tuple[str, ...]
    rows: tuple[int, int]
    write: str = "leave_out"


ALL = ("V", "theta", "P", "Q")
SPOILT = {
    "a mark in an output": Spoilt("mark", put(101, 104, lambda v: -9999.0, "P"), ("P",), (101, 104)),
    "a mark in an input": Spoilt("mark", put(101, 101, lambda v: 32767.0, "V"), ("V",), (101, 101)),
    "zeros": Spoilt("zeros", put(121, 122, np.zeros_like, "V", "P", "Q"), ("V", "P", "Q"), (121, 122)),
    "zeros in one output": Spoilt("zeros", put(121, 125, np.zeros_like, "Q"), ("Q",), (121, 125)),
    "a recorder that stands": Spoilt("stuck", put(150, 200, lambda v: v[0], *ALL), ALL, (151, 200)),
    "an angle that stands": Spoilt("stuck", put(121, 160, lambda v: v[0], "theta"), ("theta",), (121, 160)),
    "an end of the range": Spoilt("saturated", limited, ("P",), (121, 150)),
    "a line": Spoilt("filled", put(131, 160, lambda v: np.round(np.linspace(v[0], v[-1], 30), 4), "P"), ("P",), (131, 160)),
    "rows again": Spoilt("repeated", again, ALL, (151, 170)),
    "a spike of an output": Spoilt("spike", put(161, 161, lambda v: v + 40.0, "P"), ("P",), (161, 161), ""),
    "a spike of an input": Spoilt("spike", put(161, 162, lambda v: v + 0.2, "V"), ("V",), (161, 162), ""),
    "a step of the angle": Spoilt("angle step", put(171, 200, lambda v: v + 0.5, "theta"), ("theta",), (170, 171), "window"),
    "rows that are missing": Spoilt("gap", lambda p: {n: np.delete(v, slice(120, 150)) for n, v in p.items()}, (), (120, 121), "window"),
}  # fmt: skip


@pytest.mark.parametrize("name", SPOILT)
def test_bad_rows_are_said_left_out_and_mended(name: str, unit: AnyModel, plant: Columns, tmp_path: Path) -> None:
    spoilt = SPOILT[name]
    columns = spoilt.by({n: plant[n] for n in ("time", *ALL)})
    experiment = read(unit, tmp_path, columns)
    (found,) = said(experiment)
    first, last = spoilt.rows
    slack = 1 if spoilt.kind == "filled" else 0  # a line holds between its ends
    assert found.kind == spoilt.kind and set(found.columns) == set(spoilt.columns)
    assert found.rows is not None and abs(found.rows[0] - first) <= slack and abs(found.rows[1] - last) <= slack
    first, last = found.rows
    where = f"row {first} (" if first == last else f"rows {first} to {last} ("
    assert found.what.startswith(where) and found.times == (columns["time"][first - 1], columns["time"][last - 1])
    assert found.write.partition(" = ")[0] == spoilt.write and found.done == ("" if spoilt.write else "left out")

    left_out = spoilt.write != "window"
    assert ("left out here, though the study does not say so" in found.what) is (spoilt.write == "leave_out")
    bad = set(range(first, last + 1)) if left_out else set()
    played = {"V", "theta"} & set(spoilt.columns)
    expected = {o: bad if played or o in spoilt.columns else set() for o in ("P", "Q")}
    assert not_compared(experiment) == expected
    mended = read(unit, tmp_path, columns, found.write)
    assert all(c.done for c in said(mended)) and bool(said(mended)) is left_out
    assert not_compared(mended) == expected
    rows = np.arange(first - 1, last)
    for n in (
        played if left_out else ()
    ):  # bridged by the line between the rows beside them, and to the end of the record by the last
        time, values = (np.delete(columns[c], rows) for c in ("time", n))
        bridge = np.interp(columns["time"][rows], time, values)
        np.testing.assert_allclose(experiment.inputs[n](columns["time"][rows]), bridge, atol=1e-6)
    asked = read(unit, tmp_path, columns, "leave_out = {}")
    assert [c.kind for c in said(asked)] == [spoilt.kind] and not_compared(asked) == {"P": set(), "Q": set()}


def test_a_column_that_does_not_move_is_taken_out(unit: AnyModel, plant: Columns, tmp_path: Path) -> None:
    columns = {n: plant[n] for n in ("time", *ALL)} | {"Q": np.full(200, 19.1234)}
    (found,) = said(read(unit, tmp_path, columns))
    assert found.kind == "constant" and found.columns == ("Q",) and found.rows is None
    text = stated(tmp_path, {}).read_text().replace('outputs = ["P", "Q"]', found.write).replace(', Q0 = "Q"', "")
    (tmp_path / "study.toml").write_text(text)
    tables = parse_study(text.encode(), tmp_path / "study.toml").experiment
    (mended,), _ = read_experiments(tables, unit, Recordings(tmp_path), "study.toml")
    assert mended.outputs == ("P",) and said(mended) == ()
    (input_,) = said(read(unit, tmp_path, columns | {"Q": plant["Q"], "theta": np.zeros(200)}))
    assert input_.columns == ("theta",) and not input_.write


def test_bad_rows_beside_those_that_the_study_leaves_out_are_said(
    unit: AnyModel, plant: Columns, tmp_path: Path
) -> None:
    both = put(161, 161, lambda v: v + 40.0, "P")(put(101, 104, lambda v: -9999.0, "Q")(plant))
    columns = {n: both[n] for n in ("time", *ALL)}
    experiment = read(unit, tmp_path, columns, "leave_out = {Q = [[2.0, 2.06]]}")
    spike, stated_ = said(experiment)
    assert (spike.kind, stated_.kind) == ("spike", "left out") and not spike.done and "though" not in spike.what
    assert not_compared(experiment) == {
        "P": set(),
        "Q": {101, 102, 103, 104},
    }  # what a study states is all that is left out
    mended = read(unit, tmp_path, columns, spike.write)
    assert all(c.done for c in said(mended)) and not_compared(mended) == {"P": {161}, "Q": {101, 102, 103, 104}}


def test_rows_outside_the_window_are_judged_where_an_input_needs_them(
    unit: AnyModel, plant: Columns, tmp_path: Path
) -> None:
    """The model runs from the first row to the window's end, and its outputs are compared within the window."""
    early, late = put(11, 16, np.zeros_like, "V", "Q")(plant), put(191, 196, np.zeros_like, "V", "Q")(plant)
    for columns, expected in ((early, [("zeros", ("V",))]), (late, [])):
        experiment = read(unit, tmp_path, {n: columns[n] for n in ("time", *ALL)}, "window = [0.8, 3.0]")
        assert [(c.kind, c.columns) for c in said(experiment)] == expected


def at_a_fifth(p: Columns) -> Columns:
    """The powers at a fifth of the rate of the others."""
    rows = 5 * (np.arange(p["time"].size) // 5)
    return p | {"P": p["P"][rows], "Q": p["Q"][rows]}


@pytest.mark.parametrize(
    ("noise", "course", "change"),
    [
        (1.0, CLEARED, dict),
        (0.0, CLEARED, dict),
        (10.0, CLEARED, dict),
        (1.0, InputSignal.corners([(1.0, 1.0), (1.0, 0.9875)]), dict),
        (0.0, InputSignal.corners([(1.0, 1.0), (1.0, 0.9875)]), dict),
        (1.0, InputSignal.corners([(1.0, 1.0), (1.1, 0.9)]), dict),
        (1.0, CLEARED, at_a_fifth),
    ],
    ids=[
        "cleared",
        "cleared no noise",
        "cleared much noise",
        "tap",
        "tap no noise",
        "fast ramp",
        "powers at a fifth of the rate",
    ],
)
def test_sound_records_are_not_nagged(
    noise: float,
    course: InputSignal,
    change: Callable[[Columns], Columns],
    unit: AnyModel,
    machine: Model,
    tmp_path: Path,
) -> None:
    columns = change(recorded(machine, noise, E=course))
    experiment = read(unit, tmp_path, {n: columns[n] for n in ("time", *ALL)})
    assert said(experiment) == () and not_compared(experiment) == {"P": set(), "Q": set()}


def test_a_staircase_is_no_recorder_that_stands(unit: AnyModel, plant: Columns, tmp_path: Path) -> None:
    """A reference that is held in steps, in whose gap its level is known too, beside outputs with noise."""
    stairs = np.select([plant["time"] < 1.0, plant["time"] < 2.5], [1.02, 1.0], 1.01)
    columns = {"time": plant["time"], "V": stairs, "P": plant["P"], "Q": plant["Q"]}
    assert said(read(unit, tmp_path, columns, inputs=["V"])) == ()
    holed = {n: np.delete(v, slice(150, 170)) for n, v in columns.items()}
    assert said(read(unit, tmp_path, holed, inputs=["V"])) == ()
