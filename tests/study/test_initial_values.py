"""Recorded rest against model rest. Every record is a closed form of a first-order lag, computed here with numpy."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hvdc_ident import Model, load_model
from hvdc_ident.cli import app
from hvdc_ident.data import Array, Experiment, InputSignal, experiment, trajectory
from hvdc_ident.fit import FitParameter
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.study.conversions import Evidence, conversions, suggest_conversion
from hvdc_ident.study.initial_values import InitialValues, compare_initial_values

CARD = """schema = 1
name = "lag"
[parameters]
T = {{value = 0.3, unit = "s", min = 0.05, max = 2}}
k = {{value = 1.0, min = 0.5, max = 3000}}
Sn = {{value = 250, unit = "MVA"}}
[inputs]
u = {{value = {value}, unit = "pu"}}
[states]
x = {{derivative = "(u - x)/T"}}
[outputs]
y = {{value = "k*x - {zero}", unit = "{unit}"}}
"""
TIME = np.arange(0.0, 4.0, 0.02)
T, CANDIDATES = 0.36, (FitParameter("T", 0.3, 0.05, 2.0),)  # the plant's time constant is not the model's


def card(folder: Path, unit: str = "pu", zero: float = 0.0, value: float = 1.02) -> Model:
    (folder / "lag.toml").write_text(CARD.format(unit=unit, zero=zero, value=value))
    found = load_model(folder / "lag.toml")
    assert isinstance(found, Model)
    return found


def response(before: float, after: float, time: Array = TIME, tau: float = T, event: float = 1.0) -> Array:
    return before + (after - before) * np.where(time < event, 0.0, 1.0 - np.exp(-np.maximum(time - event, 0.0) / tau))


def record(
    factor: float = 1.0,
    shift: float = 0.0,
    *,
    zero: float = 0.0,
    levels: tuple[float, float] = (1.02, 1.1),
    units: float = 1.0,
    seconds: float = 1.0,
    noise: float = 1e-3,
    name: str = "step",
    seed: int = 0,
) -> Experiment:
    """A step of u as a recorder wrote it: the output as factor y + shift, the input in `units`, the time in `seconds`."""
    random = np.random.default_rng(seed)
    y = factor * (response(*levels) - zero + noise * random.standard_normal(TIME.size)) + shift
    u = InputSignal.step(seconds * 1.0, units * levels[0], units * levels[1])
    std = FrozenMap({"y": abs(factor) * noise}) if noise else FrozenMap()
    return experiment(
        name, seconds * TIME, {"u": u}, measured=trajectory(seconds * TIME, {"y": y}), noise=std, event=seconds * 1.0
    )


def only(found: InitialValues) -> str:
    (line,) = found.lines
    return line


@pytest.mark.parametrize("seed", range(8))
def test_nothing_is_said_where_nothing_is_wrong(tmp_path: Path, seed: int) -> None:
    found = compare_initial_values(card(tmp_path), [record(seed=seed), record(seed=seed + 100, name="b")], CANDIDATES)
    assert found.lines == [] and found.remarks == ()
    level = found.values[0]
    assert level.recorded == pytest.approx(1.02, abs=5e-4) and level.model == pytest.approx(1.02, abs=1e-9)
    assert level.suggestion is None and level.factor is None


@pytest.mark.parametrize(
    ("unit", "factor", "words"),
    [
        ("pu", -1.0, "reads -1.02, the model rests at +1.02 pu: sign?"),
        ("pu", 100.0, "in per cent?"),
        ("pu", 250.0, "in MVA of the base Sn = 250?"),
        ("pu", 3.0**0.5, "sqrt(3)"),
        ("pu", 180.0 / np.pi, "in degrees?"),
        ("MW", 1e3, "in kW?"),
        ("MW", 1e-3, "in GW?"),
        ("kV", 2.0**0.5, "sqrt(2)"),
        ("rad", 180.0 / np.pi, "in degrees?"),
        ("%", 0.01, "per unit?"),
        ("rad/s", 30.0 / np.pi, "in 1/min?"),
        ("MW", -1e3, "in kW, with the other sign?"),
    ],
)
def test_a_factor_is_named_by_what_it_is(tmp_path: Path, unit: str, factor: float, words: str) -> None:
    found = compare_initial_values(
        card(tmp_path, unit), [record(factor), record(factor, levels=(0.9, 0.7), name="b")], CANDIDATES
    )
    assert words in only(found)
    assert [level.factor for level in found.values] == pytest.approx([factor, factor])
    assert found.values[0].recorded == pytest.approx(factor * 1.02, rel=1e-3)
    assert only(found).count("step") + only(found).count(" b") >= 2  # told once, of both


def test_a_base_of_no_known_factor_scales_level_and_movement(tmp_path: Path) -> None:
    found = compare_initial_values(card(tmp_path), [record(5.54)], CANDIDATES)
    assert "a factor of 5.5" in only(found) and "level and movement" in only(found)
    assert found.values[0].factor == pytest.approx(5.54, rel=2e-3)


def test_an_offset_moves_the_level_and_not_the_movement(tmp_path: Path) -> None:
    found = compare_initial_values(card(tmp_path), [record(shift=0.05)], CANDIDATES)
    assert "offset" in only(found) and found.values[0].suggestion == "offset"
    assert found.values[0].difference == pytest.approx(0.05, abs=5e-4)
    assert found.values[0].noise_units == pytest.approx(50.0, rel=0.02)
    assert found.values[0].factor is None


def test_degrees_celsius_are_an_offset_with_a_name(tmp_path: Path) -> None:
    found = compare_initial_values(card(tmp_path, "K"), [record(1.0, -273.15, levels=(300.0, 310.0))], CANDIDATES)
    assert "in degC?" in only(found)


def test_where_the_level_is_0_the_movement_tells(tmp_path: Path) -> None:
    found = compare_initial_values(card(tmp_path, zero=1.02), [record(-1.0, zero=1.02)], CANDIDATES)
    assert "y moves -" in only(found) and only(found).endswith("sign?")
    assert found.values[0].model == pytest.approx(0.0, abs=1e-9)


def test_what_a_candidate_can_make_good_is_no_evidence(tmp_path: Path) -> None:
    gain = (*CANDIDATES, FitParameter("k", 1.0, 0.5, 3000.0))
    model = card(tmp_path, "MW")
    assert compare_initial_values(model, [record(1e3)], gain).lines == []
    assert compare_initial_values(model, [record(1.4)], gain).lines == []
    assert "sign?" in only(compare_initial_values(model, [record(-1.0)], gain))  # no bound of k reaches that
    level = compare_initial_values(model, [record(1e3)], gain).values[0]
    assert level.low == pytest.approx(0.5 * 1.02) and level.high == pytest.approx(3000 * 1.02)


def test_an_input_in_per_cent_is_told_of_the_input(tmp_path: Path) -> None:
    found = compare_initial_values(card(tmp_path), [record(units=100.0)], CANDIDATES)
    assert "input u reads 102 before the event, the model's value is 1.02: in per cent?" in only(found)
    assert found.values[0].channel == "input u"


def test_another_operating_point_is_no_mistake(tmp_path: Path) -> None:
    model = card(tmp_path)
    for levels in ((0.0102, 0.02), (102.0, 110.0), (-1.02, -1.1)):  # the record follows the input as it stands
        assert compare_initial_values(model, [record(levels=levels)], CANDIDATES).lines == []


def test_a_time_in_ms_is_told(tmp_path: Path) -> None:
    found = compare_initial_values(card(tmp_path), [record(seconds=1e3)], CANDIDATES)
    assert "is the time in ms?" in only(found) and found.values[0].channel == "time"


def test_a_slow_record_of_a_fast_model_is_no_mistake(tmp_path: Path) -> None:
    time = 60.0 * np.arange(200.0)
    u = InputSignal.step(3000.0, 1.02, 1.1)
    y = response(1.02, 1.1, time, event=3000.0) + 1e-3 * np.random.default_rng(0).standard_normal(time.size)
    e = experiment("slow", time, {"u": u}, measured=trajectory(time, {"y": y}), noise={"y": 1e-3}, event=3000.0)
    assert compare_initial_values(card(tmp_path), [e], CANDIDATES).lines == []


def test_a_record_without_rows_before_its_event_says_so(tmp_path: Path) -> None:
    e = record().with_(event=0.0)
    found = compare_initial_values(card(tmp_path), [e], CANDIDATES)
    assert found.lines == [] and "no row stands before its event" in found.remarks[0]
    assert found.values[0].recorded is None
    free = compare_initial_values(card(tmp_path), [e.with_(event=None)], CANDIDATES)
    assert "its event is not known" in free.remarks[0]


def test_rows_that_are_not_recorded_are_left_out(tmp_path: Path) -> None:
    e = record(-1.0)
    assert e.measured is not None
    y = np.where(np.arange(TIME.size) % 3 == 0, np.nan, e.measured["y"])
    assert "sign?" in only(
        compare_initial_values(card(tmp_path), [e.with_(measured=trajectory(TIME, {"y": y}))], CANDIDATES)
    )
    nothing = e.with_(measured=trajectory(TIME, {"y": np.full(TIME.size, np.nan)}))
    assert compare_initial_values(card(tmp_path), [nothing], CANDIDATES).lines == []


def test_a_model_without_a_rest_is_reported_with_its_reason(tmp_path: Path) -> None:
    (tmp_path / "m.toml").write_text(
        'schema = 1\nname = "m"\n[inputs]\nu = {value = 1.0}\n'
        '[states]\nx = {derivative = "u + x**2 + 1"}\n[outputs]\ny = "x"\n'
    )
    found = compare_initial_values(load_model(tmp_path / "m.toml"), [record()], ())
    assert "not compared with the model's rest" in only(found) and "no steady state was found" in only(found)
    assert found.values[0].model is None and found.values[0].recorded == pytest.approx(1.02, abs=5e-4)


def test_coloured_noise_alone_is_no_difference(tmp_path: Path) -> None:
    """AR(1) noise of 0.9: the mean of 50 rows scatters four times as far as white noise says."""
    model, told = card(tmp_path), 0
    for seed in range(25):
        random = np.random.default_rng(seed)
        noise = np.zeros(TIME.size)
        for k in range(1, noise.size):
            noise[k] = 0.9 * noise[k - 1] + 1e-3 * np.sqrt(1 - 0.81) * random.standard_normal()
        e = record(noise=0.0)
        y = response(1.02, 1.1) + noise
        told += len(
            compare_initial_values(
                model, [e.with_(measured=trajectory(TIME, {"y": y}), noise=FrozenMap({"y": 1e-3}))]
            ).lines
        )
    assert told == 0


def test_a_record_without_noise_is_judged_by_the_misfit(tmp_path: Path) -> None:
    model = card(tmp_path)
    assert compare_initial_values(model, [record(noise=0.0)], CANDIDATES).lines == []
    assert "sign?" in only(compare_initial_values(model, [record(-1.0, noise=0.0)], CANDIDATES))


def test_conversions_undo_what_they_do() -> None:
    for unit in ("pu", "MW", "kV", "rad", "K", "Hz", "kg", ""):
        found = conversions(unit)
        assert len({(f"{c.factor:.6g}", c.shift) for c in found}) == len(found)
        assert all(c.undone(c.factor * 0.7 + c.shift) == pytest.approx(0.7) for c in found)


@pytest.mark.parametrize(
    ("unit", "factor", "shift", "words"),
    [
        ("kV", (2.0 / 3.0) ** 0.5, 0.0, "sqrt(2/3): peak of phase for rms of line to line?"),
        ("pu", 2.0 * np.pi * 50.0, 0.0, "in rad/s of 50 Hz?"),
        ("MW", 1.0 / 250.0, 0.0, "per unit of Sn = 250 MVA?"),
        ("Hz", 1.0, 50.0, "the frequency and not its deviation from 50?"),
        ("pu", 1.0, 1.0, "the quantity itself and not its deviation from 1?"),
    ],
)
def test_ratios_of_the_table(tmp_path: Path, unit: str, factor: float, shift: float, words: str) -> None:
    zero = 1.0 if shift else 0.0  # a deviation is near 0
    found = compare_initial_values(card(tmp_path, unit, zero), [record(factor, shift, zero=zero)], CANDIDATES)
    assert words in only(found) and found.values[0].factor == pytest.approx(factor)


@pytest.mark.parametrize("wrong", [1.35, 1.6, 7.0, 0.3])
def test_a_level_that_is_off_by_itself_is_no_conversion(tmp_path: Path, wrong: float) -> None:
    """A level and a movement that are each off by another factor are the model's fault, however near one is to a ratio."""
    e = record()
    assert e.measured is not None
    y = wrong * 1.02 + 1.15 * (e.measured["y"] - 1.02)
    (value,) = compare_initial_values(card(tmp_path), [e.with_(measured=trajectory(TIME, {"y": y}))], CANDIDATES).values
    assert value.suggestion == "difference" and not value.is_mistake


def test_evidence_of_one_level_alone_names_a_conversion_that_fits_exactly() -> None:
    found = suggest_conversion([Evidence(40.0, (0.4,))], "pu")
    assert found is not None and found.reason == "in per cent?" and found.conversion.undone(40.0) == pytest.approx(0.4)
    assert suggest_conversion([Evidence(33.0, (0.4,))], "pu") is None
    assert suggest_conversion([Evidence(0.4, (0.4,))], "pu") is None


TURBINE = """schema = 1
name = "turbine"
[parameters]
T = {value = 0.3, unit = "s", min = 0.05, max = 2}
[inputs]
u = {value = 1.0}
yset = {value = 0.7, unit = "pu"}
[states]
x = {derivative = "(u*yset - x)/T"}
[outputs]
gate = {value = "x", unit = "pu"}
P = {value = "120*(x**1.5 - 0.1)", unit = "MW"}
"""


@pytest.mark.parametrize(("yset", "offset"), [(0.8, 0.0), (0.7, 0.0), (0.7, 0.1)])
def test_another_set_point_that_explains_both_outputs_is_offered(tmp_path: Path, yset: float, offset: float) -> None:
    """An offset of one output is none: the other one contradicts it."""
    (tmp_path / "turbine.toml").write_text(TURBINE)
    random = np.random.default_rng(2)
    x = yset * response(1.0, 1.02)
    seen = {
        "gate": x + offset + 2e-4 * random.standard_normal(TIME.size),
        "P": 120.0 * (x**1.5 - 0.1) + 0.05 * random.standard_normal(TIME.size),
    }
    e = experiment(
        "e", TIME, {"u": InputSignal.step(1.0, 1.0, 1.02)}, measured=trajectory(TIME, seen),
        noise=FrozenMap({"gate": 2e-4, "P": 0.05}), event=1.0,
    )  # fmt: skip
    model = load_model(tmp_path / "turbine.toml")
    found = compare_initial_values(model, [e], CANDIDATES)
    if yset == 0.7:
        assert [v.suggestion for v in found.values] == ["offset" if offset else None, None]
        return
    assert only(found).endswith("at yset = 0.8 pu and not 0.7 it rests there: values = {yset = 0.8}?")
    assert found.mistakes == found.lines and {v.channel for v in found.values} == {"input yset"}
    mended = compare_initial_values(model, [e.with_(values=FrozenMap({"yset": 0.8}))], CANDIDATES)
    assert mended.lines == []


def test_an_input_counted_in_another_way_is_found_by_its_level_and_the_outputs(tmp_path: Path) -> None:
    (line,) = compare_initial_values(card(tmp_path), [record(units=(2.0 / 3.0) ** 0.5)], CANDIDATES).lines
    assert "input u reads 0.8328 before the event, the model's value is 1.02: a factor of sqrt(2/3)" in line


# --- the command line and the report ---


def study(folder: Path, factor: float) -> Path:
    card(folder, "MW")
    e = record(factor)
    assert e.measured is not None
    rows = np.column_stack([TIME, e.inputs["u"](TIME), e.measured["y"]])
    np.savetxt(folder / "d.csv", rows, delimiter=",", header="time,u,y", comments="", fmt="%.9g")
    text = 'schema = 1\n[model]\nsource = "lag.toml"\n[parameters]\nT = {start = 0.3, min = 0.05, max = 2}\n'
    text += '[[experiment]]\nname = "step"\ndata = "d.csv"\ninputs = ["u"]\noutputs = ["y"]\n[fit]\nstarts = 1\n'
    (folder / "s.toml").write_text(text)
    return folder / "s.toml"


def test_every_command_says_it_first_and_keeps_it(tmp_path: Path) -> None:
    path = str(study(tmp_path, -1.0))
    said = "step: before the event y reads -1.02, the model rests at +1.02 MW: sign?"
    run = CliRunner().invoke
    assert said in run(app, ["check", path]).stdout.splitlines()
    assert run(app, ["simulate", path]).stdout.splitlines()[0] == said
    assert run(app, ["simulate", path, "--quiet"]).stdout == ""
    done = run(app, ["simulate", path, "--json"])
    (level,) = json.loads(done.stdout)["rest_levels"]
    assert said in done.stderr
    assert (level["experiment"], level["output"], level["factor"], level["suggestion"]) == ("step", "y", -1.0, "sign")
    assert level["recorded"] == pytest.approx(-1.02, abs=5e-4) and level["model"] == pytest.approx(1.02)
    assert run(app, ["report", path]).exit_code == 0
    page = (tmp_path / "s-results" / "report.html").read_text("utf-8")
    assert "Levels before the event" in page and "sign?" in page


def test_a_sound_study_is_not_troubled(tmp_path: Path) -> None:
    path = str(study(tmp_path, 1.0))
    run = CliRunner().invoke
    assert "before the event" not in run(app, ["check", path]).stdout
    assert "before the event" not in run(app, ["simulate", path]).stdout
    assert run(app, ["report", path]).exit_code == 0
    assert "one that the model can rest at" in (tmp_path / "s-results" / "report.html").read_text("utf-8")


TWO = """schema = 1
name = "two"
[parameters]
T = {value = 0.3, unit = "s", min = 0.05, max = 2}
k = {value = 3.0}
[inputs]
u = {value = 1.02}
[states]
x = {derivative = "(u - x)/T"}
[outputs]
y = "x"
z = "5 - k*x"
"""


def two(folder: Path, first: str, second: str, slope: float = 3.0) -> InitialValues:
    """The comparison for a plant of y = x, z = 5 - slope x, its columns recorded under the names `first` and `second`."""
    (folder / "two.toml").write_text(TWO)
    random = np.random.default_rng(5)
    x = response(1.02, 1.1)
    y, z = (v + 1e-3 * random.standard_normal(TIME.size) for v in (x, 5.0 - slope * x))
    u = {"u": InputSignal.step(1.0, 1.02, 1.1)}
    std = FrozenMap({"y": 1e-3, "z": 1e-3})
    seen = trajectory(TIME, {first: y, second: z})
    return compare_initial_values(
        load_model(folder / "two.toml"), (experiment("step", TIME, u, measured=seen, noise=std, event=1.0),), CANDIDATES
    )


def test_exchanged_columns_are_named(tmp_path: Path) -> None:
    (line,) = two(tmp_path, "z", "y").lines
    assert "are the columns of z and y exchanged?" in line


def test_columns_in_their_place_are_not_called_exchanged(tmp_path: Path) -> None:
    assert not two(tmp_path, "y", "z").lines
    assert not any("exchanged" in line for line in two(tmp_path, "y", "z", slope=3.4).lines)
