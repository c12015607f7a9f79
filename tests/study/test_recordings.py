"""Recordings as they are: gaps, units, offsets, several files, dropped rows; through a study of a motor made here."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.optimize import curve_fit

from hvdc_ident import load_study
from hvdc_ident.data import Experiment, noise_estimate
from hvdc_ident.errors import InputError, StudyError
from hvdc_ident.fit import FitResult, Problem, fit
from hvdc_ident.report.page import write_report
from hvdc_ident.simulate import ModelSimulator
from hvdc_ident.study.pipeline import run_stage
from hvdc_ident.study.recordings import with_noise
from hvdc_ident.study.stages import StageOptions
from hvdc_ident.study.study import Study
from hvdc_ident.study.summary import Summary
from hvdc_ident.summary import Results

CARD = """schema = 1
name = "motor"
[parameters]
J = {value = 0.01, unit = "kg.m2", min = 0.001, max = 0.1}
[inputs]
v = {value = 1.0, unit = "V"}
[states]
w = {derivative = "(0.5*i - 0.1*w) / J", unit = "rad/s"}
[signals]
i = {value = "v - 0.5*w", unit = "A"}
[outputs]
w = {value = "w", unit = "rad/s"}
i = {value = "i", unit = "A"}
"""
TIME = np.arange(241) * 0.005
EVENT = 0.3
TRUE = 0.013


def exact(time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """v, w and i of the motor of inertia TRUE: J w' = 0.5 v - 0.35 w from rest, so an exponential."""
    v = np.where(time < EVENT, 1.0, 1.5)
    w = (0.5 / 0.35) * (1.0 + 0.5 * np.where(time < EVENT, 0.0, 1.0 - np.exp(-0.35 / TRUE * (time - EVENT))))
    return v, w, v - 0.5 * w


def write(
    folder: Path, rows: np.ndarray, *, header: str = "time,v,w,i", experiment: str = "", outputs: str = '["w", "i"]'
) -> Path:
    """A study of the motor with one recording; NaN is written as an empty cell."""
    (folder / "motor.toml").write_text(CARD)
    text = "\n".join(",".join("" if np.isnan(x) else repr(float(x)) for x in row) for row in rows)
    (folder / "d.csv").write_text(f"{header}\n{text}\n", "utf-8")
    (folder / "s.toml").write_text(
        'schema = 1\n[model]\nsource = "motor.toml"\n[parameters]\nJ = {start = 0.01, min = 0.002, max = 0.05}\n'
        f'[[experiment]]\nname = "d"\ndata = "d.csv"\ninputs = ["v"]\noutputs = {outputs}\ninterpolation = "hold"\n'
        f"{experiment}\n[fit]\nstarts = 1\n"
    )
    return folder / "s.toml"


def record(noise: float = 1e-3, seed: int = 1) -> np.ndarray:
    v, w, i = exact(TIME)
    e = noise * np.random.default_rng(seed).standard_normal((2, TIME.size))
    return np.column_stack([TIME, v, w + e[0], i + e[1]])


def holed() -> np.ndarray:
    rows = record()
    rows[70:80, 2] = np.nan
    rows[[3, 50, 200], 3] = np.nan
    return rows


def fitted(study: Study) -> FitResult:
    problem = Problem(ModelSimulator(study.model), study.experiments, tuple(study.candidates.values()))
    return fit(problem, starts=1)


def told(study: Study) -> str:
    return str(Summary.of(study))


def test_gaps_of_outputs_are_not_compared_and_said(tmp_path: Path) -> None:
    study = load_study(write(tmp_path, holed()))
    assert "w: 10 of 241 rows not recorded" in told(study) and "i: 3 of 241 rows not recorded" in told(study)
    assert study.noise["d"]["i"].std == pytest.approx(1e-3, rel=0.5)
    found = fitted(study)
    assert found.estimates["J"].ci95 is not None
    low, high = found.estimates["J"].ci95
    assert low < TRUE < high and high - low < 0.05 * TRUE
    assert found.goodness.outputs["w"]["d"].n == 231


def test_gaps_reach_every_file_and_the_page(tmp_path: Path) -> None:
    study = load_study(write(tmp_path, holed()))
    folder = tmp_path / "out"
    run_stage(study, "fit", folder, StageOptions(folder=folder))
    done = run_stage(study, "simulate", folder, StageOptions(folder=folder))
    assert done.data["experiments"]["d"]["recording"]["not_recorded"] == {"w": 10, "i": 3}
    _, w, _ = exact(TIME)
    table = Results(folder).table("fit.d.csv")
    assert table is not None
    assert np.isnan(table["w.measured"]).sum() == 10 and np.isfinite(table["w"]).all()
    assert np.abs(table["w"] - w).max() < 1e-3
    rms = np.sqrt(np.nanmean((table["w.measured"] - table["w"]) ** 2))
    assert Results(folder).get("fit")["rmse"]["w"]["d"] == pytest.approx(rms, rel=1e-6)
    assert "w: 10 of 241 rows not recorded" in write_report(folder).read_text("utf-8")
    assert ",nan" not in (folder / "fit.d.csv").read_text()


def test_where_an_input_is_not_recorded_it_is_bridged_and_no_output_compared(tmp_path: Path) -> None:
    rows = record()
    rows[[4, 9, 10], 1] = np.nan
    line = "leave_out = {v = [[0.02, 0.02], [0.045, 0.05]]}"
    with pytest.raises(StudyError, match=r"column 'v' is not recorded in 3 of 241 rows, the first at 0.02 s") as error:
        load_study(write(tmp_path, rows))
    assert str(error.value).endswith(f"write: {line}")
    (experiment,) = load_study(write(tmp_path, rows, experiment=line)).experiments
    assert np.flatnonzero(np.isnan(experiment.measured["w"])).tolist() == [4, 9, 10]
    assert np.isfinite(experiment.inputs["v"].values).all()
    assert [c.done for c in experiment.measured.origin.contradictions] == ["left out, as the study says"] * 2


def test_a_column_that_is_not_recorded_at_all_is_an_error(tmp_path: Path) -> None:
    for column in (1, 3):
        rows = record()
        rows[:, column] = np.nan
        with pytest.raises(StudyError, match="not recorded in any row"):
            load_study(write(tmp_path, rows))


def of_three_rates(folder: Path, gap: int = 0) -> Path:
    """The study of `write` with v every 5 ms, w every 2 ms and i every 15 ms, from 0.05 s on, each with its own time in an HDF5 file."""
    study = write(folder, record())
    text = study.read_text().replace('"d.csv"', '"d.h5"').replace('["v"]', '{v = "in/v"}')
    study.write_text(text.replace('["w", "i"]', '{w = "speed/w", i = "arm/i"}'))
    random = np.random.default_rng(3)
    with h5py.File(folder / "d.h5", "w") as file:
        for name, step, first, column in (
            ("in/v", 5e-3, 0.0, 0),
            ("speed/w", 2e-3, 0.0, 1),
            ("arm/i", 1.5e-2, 0.05, 2),
        ):
            time = first + step * np.arange(round((1.2 - first) / step))
            values = exact(time)[column] + (1e-3 * random.standard_normal(time.size) if column else 0.0)
            if gap and column == 0:
                values[gap] = np.nan
                file["in/other"] = np.zeros(time.size)
            file[name], file[f"{name.partition('/')[0]}/time"] = values, time
            file[f"{name.partition('/')[0]}/time"].attrs["units"] = "s"
    return study


def test_outputs_of_other_rates_than_the_inputs_are_compared_at_their_own_rows(tmp_path: Path) -> None:
    study = load_study(of_three_rates(tmp_path))
    (experiment,) = study.experiments
    assert experiment.event == pytest.approx(EVENT) and experiment.time[-1] <= 1.195
    text = told(study)
    assert "77 rows of arm/i, 240 rows of in/v, 600 rows of speed/w" in text and "not recorded" not in text
    for output, rows in (("w", 150), ("i", 17)):  # before the event
        assert study.noise["d"][output].source == "estimated"
        assert study.noise["d"][output].std == pytest.approx(1e-3, rel=3.0 / np.sqrt(2 * rows))
    found = fitted(study)
    counted = {o: found.goodness.outputs[o]["d"].n for o in ("w", "i")}
    assert counted == {"w": 598, "i": 77}  # of w, those until the last of v
    assert found.estimates["J"].ci95 is not None
    low, high = found.estimates["J"].ci95
    assert low < TRUE < high and high - low < 0.05 * TRUE


def test_a_gap_of_an_input_leaves_out_the_rows_of_faster_records_within_it(tmp_path: Path) -> None:
    path = of_three_rates(tmp_path, gap=4)
    path.write_text(path.read_text().replace('{w = "speed/w"', '{o = "in/other", w = "speed/w"'))
    (tmp_path / "motor.toml").write_text(CARD + 'o = {value = "0", unit = "V"}\n')
    with pytest.raises(StudyError, match=r"column 'in/v' is not recorded in 1 of 240 rows, the first at 0.02 s"):
        load_study(path)
    line = "leave_out = {v = [[0.02, 0.02]]}"
    path.write_text(path.read_text().replace("interpolation = ", f"{line}\ninterpolation = "))
    (experiment,) = load_study(path).experiments
    stands = experiment.time[np.isfinite(experiment.measured["w"])]
    np.testing.assert_allclose(stands[6:10], [0.012, 0.014, 0.026, 0.028])  # v is known at 0.015 and 0.025 s


def test_a_gap_splits_the_rows_that_noise_is_estimated_from() -> None:
    random = np.random.default_rng(2)
    time = np.arange(400) * 1e-3
    values = 1e-3 * random.standard_normal(400)
    values[100:300] += 5.0  # a level of its own, recorded only in parts
    values[95:105] = values[295:305] = np.nan
    assert noise_estimate(time, values, None).std == pytest.approx(1e-3, rel=0.2)
    sparse = np.where(np.arange(400) % 4 == 0, values, np.nan)
    assert noise_estimate(time, sparse, None).std == pytest.approx(1e-3, rel=0.4)


@pytest.mark.parametrize(
    ("change", "noise", "shown"),
    [
        ({}, 0.01, True),
        ({"moves": False}, 0.01, False),  # no event: the fit's residual tells
        ({"at": 3}, 0.01, False),  # too few rows before it
        ({"holes": True}, 0.01, True),
        ({}, 1e-9, False),  # below the floor
        ({"event": 0.2}, 0.01, True),
        ({"noise": {"w": 0.02}}, 0.01, True),
    ],
)
def test_an_experiment_shows_the_event_and_the_noise_that_are_found(change: dict, noise: float, shown: bool) -> None:
    more = {k: v for k, v in change.items() if k in ("event", "noise")}
    v = (
        np.where(np.arange(TIME.size) < change.get("at", 60), 1.0, 1.5)
        if change.get("moves", True)
        else np.ones(TIME.size)
    )
    w = exact(TIME)[1] + noise * np.random.default_rng(4).standard_normal(TIME.size)
    if change.get("holes"):
        w[[3, 4, 30, 100]] = np.nan
    e = Experiment(TIME, inputs={"v": v}, outputs={"w": w}, **more)
    found, _ = with_noise(e)
    lines = str(e).splitlines()
    assert lines[0].endswith("no event" if found.event is None else f"event at {found.event:g} s")
    cells = lines[-1].split()
    assert ("w" in found.noise) is shown and len(cells) == (5 if shown else 4)
    if shown:
        assert float(cells[-2]) == pytest.approx(found.noise["w"], rel=1e-5)


def test_units_are_converted_and_said(tmp_path: Path) -> None:
    rows = record()
    rows[:, 0] *= 1e3
    rows[:, 2] *= 30.0 / np.pi
    rows[:, 3] *= 1e3
    study = load_study(write(tmp_path, rows, header="t/ms,v / V,w (1/min),i [mA]"))
    (e,) = study.experiments
    assert e.measured is not None
    np.testing.assert_allclose(e.time, TIME, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(e.measured.values, record()[:, 2:], rtol=1e-12)
    for line in ("time in ms, converted to s", "w: from 1/min to rad/s", "i: from mA to A"):
        assert line in told(study)
    assert "v:" not in told(study)


def test_offset_and_scale_of_a_column(tmp_path: Path) -> None:
    rows = record()
    rows[:, 2] = (rows[:, 2] - 5.0) / 2.0
    extra = "columns = {w = {scale = 2.0, offset = 5.0}, i = {offset = -0.25}}"
    (e,) = load_study(write(tmp_path, rows, experiment=extra)).experiments
    assert e.measured is not None
    np.testing.assert_allclose(e.measured["w"], record()[:, 2], rtol=1e-12)
    np.testing.assert_allclose(e.measured["i"], record()[:, 3] - 0.25, rtol=1e-12)


def test_the_file_s_unit_of_time_is_not_applied_twice(tmp_path: Path) -> None:
    rows = record()
    rows[:, 0] *= 1e3
    same = load_study(write(tmp_path, rows, header="t [ms],v,w,i", experiment='columns = {time = {unit = "ms"}}'))
    assert same.experiments[0].time[-1] == pytest.approx(1.2)
    with pytest.raises(StudyError, match="contradicts the file's"):
        load_study(write(tmp_path, rows, header="t [ms],v,w,i", experiment='columns = {time = {unit = "s"}}'))


def test_rows_dropped_and_jumps_are_told(tmp_path: Path) -> None:
    rows = record()
    at = int(EVENT / 0.005) + 1
    rows = np.vstack([rows[:at], np.repeat(rows[at - 1 : at], 3, axis=0), rows[at:]])
    study = load_study(write(tmp_path, rows))
    assert study.experiments[0].recording["dropped"] == 2
    assert "2 rows of the file dropped" in told(study) and "1 instant with two rows: a jump" in told(study)


def test_a_change_of_the_data_file_behind_a_header_is_a_change_of_the_study(tmp_path: Path) -> None:
    path = write(tmp_path, record())
    head = "ST,REC,1999\n3,3A,0D\n" + "".join(
        f"{n + 1},{c},,,,1e-4,0,0,-99999,99999,1,1,P\n" for n, c in enumerate("vwi")
    )
    (tmp_path / "d.cfg").write_text(
        f"{head}50\n1\n200,241\n01/01/2020,00:00:00.000000\n01/01/2020,00:00:00.300000\nASCII\n1\n"
    )
    raw = np.round(1e4 * record()[:, 1:]).astype(int)
    lines = [f"{n + 1},{5000 * n},{a},{b},{c}\n" for n, (a, b, c) in enumerate(raw.tolist())]
    (tmp_path / "d.dat").write_text("".join(lines))
    path.write_text(path.read_text().replace("d.csv", "d.cfg"))
    before = load_study(path).sources
    assert {"d.cfg", "d.dat"} <= set(before)
    lines[-1] = f"241,1200000,{raw[-1, 0]},{raw[-1, 1] + 1},{raw[-1, 2]}\n"
    (tmp_path / "d.dat").write_text("".join(lines))
    after = load_study(path).sources
    assert {n for n in after if after[n] != before[n]} == {"d.dat"}


def with_deviations() -> np.ndarray:
    """The record with a column of standard deviations: the noise is five times larger after 0.35 s."""
    v, w, i = exact(TIME)
    sd = np.where(TIME < 0.35, 2e-3, 1e-2)
    return np.column_stack([TIME, v, w + sd * np.random.default_rng(5).standard_normal(TIME.size), i, sd])


def test_standard_deviations_of_every_row_weigh_as_scipy_weighs_them(tmp_path: Path) -> None:
    rows = with_deviations()
    rows[100:110, 2] = np.nan
    path = write(tmp_path, rows, header="time,v,w,i,sd", outputs='["w"]', experiment='noise = {w = {column = "sd"}}')
    study = load_study(path)
    assert study.noise["d"]["w"].by_row and "(given, row by row)" in told(study)
    found = fitted(study)

    def curve(time: np.ndarray, J: float) -> np.ndarray:
        return (0.5 / 0.35) * (1.0 + 0.5 * np.where(time < EVENT, 0.0, 1.0 - np.exp(-0.35 / J * (time - EVENT))))

    there = ~np.isnan(rows[:, 2])
    value, covariance = curve_fit(
        curve, TIME[there], rows[there, 2], p0=[0.01], sigma=rows[there, 4], absolute_sigma=True, xtol=1e-12
    )
    assert found.estimates["J"].value == pytest.approx(value[0], rel=1e-6)
    assert found.estimates["J"].std_raw == pytest.approx(np.sqrt(covariance[0, 0]), rel=1e-3)
    assert found.chi2_per_dof == pytest.approx(1.0, abs=0.25)
    assert found.goodness.outputs["w"]["d"].in_band > 0.9


@pytest.mark.parametrize(
    ("change", "noise", "says"),
    [
        ({40: 0.0}, '{column = "sd"}', "no standard deviation in column 'sd' at 0.2 s"),
        ({40: np.nan}, '{column = "sd"}', "no standard deviation in column 'sd' at 0.2 s"),
        ({}, '{column = "ds"}', "did you mean 'sd'"),
        ({}, '{colum = "sd"}', "no standard deviation; expected a finite number of at least 0, or {column"),
        ({}, '"sd"', "no standard deviation; expected a finite number of at least 0, or {column"),
        ({}, "-1", "at least 0"),
        ({}, "nan", "finite"),
    ],
)
def test_standard_deviations_that_are_none(tmp_path: Path, change: dict[int, float], noise: str, says: str) -> None:
    rows = with_deviations()
    for row, value in change.items():
        rows[row, 4] = value
    path = write(tmp_path, rows, header="time,v,w,i,sd", outputs='["w"]', experiment=f"noise = {{w = {noise}}}")
    with pytest.raises(InputError) as caught:
        load_study(path)
    assert says in str(caught.value)
