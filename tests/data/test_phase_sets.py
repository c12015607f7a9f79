"""Phases found among the columns of a record, and the event of a record of phases."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from hvdc_ident.data import InputSignal, Trajectory, event_time
from hvdc_ident.data.phase_sets import phase_sets
from hvdc_ident.data.three_phase import PhaseFilter, phase_quantities
from hvdc_ident.formats import write_csv
from hvdc_ident.study import load_study

EVENT = 0.3
RATE = 10_000.0
TIME = np.arange(0.0, 1.0, 1.0 / RATE)


def waves(f: float, amplitude: np.ndarray, seed: int = 0, noise: float = 2e-3, turn: int = 1) -> list[np.ndarray]:
    """Three phases with a tenth of a percent of dc, 1 % of negative sequence, 2 % of the fifth harmonic, and noise."""
    random, lag = np.random.default_rng(seed), 2.0 * np.pi / 3.0
    angle = 2.0 * np.pi * f * TIME + 0.7
    shape = [
        np.cos(angle - turn * k * lag)
        + 0.01 * np.cos(angle + turn * k * lag)
        + 0.02 * np.cos(5 * angle + turn * k * lag)
        for k in range(3)
    ]
    return [amplitude * (x + 1e-3) + noise * amplitude[0] * random.standard_normal(TIME.size) for x in shape]


def record(columns: dict[str, np.ndarray], unit: str = "") -> Trajectory:
    return Trajectory(TIME, np.column_stack(list(columns.values())), tuple(columns), (unit,) * len(columns))


ONE = np.ones(TIME.size)


@pytest.mark.parametrize(
    "names",
    [
        "UA UB UC",
        "u1 u2 u3",
        "V_L1 V_L2 V_L3",
        "VR VS VT",
        "Ua_bus7 Ub_bus7 Uc_bus7",
        "A相电压 B相电压 C相电压",
        "UU UV UW",
    ],
)
@pytest.mark.parametrize("frequency", [50.0, 60.0])
def test_phases_are_found_by_their_names_and_their_turning(names: str, frequency: float) -> None:
    columns = dict(zip(names.split(), waves(0.99 * frequency, 325.0 * ONE), strict=True))
    (found,) = phase_sets(record({"Vdc": ONE, **columns}, "V"))
    assert (found.names, found.quantity, found.frequency) == (tuple(names.split()), "voltage", frequency)


def test_phases_in_the_other_order_of_rotation_are_put_into_it() -> None:
    columns = dict(zip(("ia", "ib", "ic"), waves(50.0, ONE, turn=-1), strict=True))
    (found,) = phase_sets(record(columns))
    assert found.names == ("ia", "ic", "ib") and found.quantity == "current"


def test_what_has_such_names_and_does_not_turn_is_none() -> None:
    a, b, c = waves(50.0, ONE)
    for columns in (
        {"V1": ONE, "V2": 2 * ONE, "V3": 3 * ONE},  # three buses
        {"VA": a, "VB": a, "VC": a},
        {"VA": a, "VB": 0 * a, "VC": 0 * a},
        {"VA": np.where(TIME < 0.1, np.nan, a), "VB": b, "VC": c},
        {"PA": a, "PB": b, "PC": c},  # neither a voltage nor a current
        {"VA": a, "VB": b},
    ):
        assert phase_sets(record(columns)) == ()


def test_the_frequency_of_a_coarse_record_is_not_told() -> None:
    columns = dict(zip(("ua", "ub", "uc"), waves(50.0, ONE), strict=True))
    coarse = record(columns).rows(np.arange(TIME.size) % 25 == 0)  # 8 samples of a cycle
    assert phase_sets(coarse) == ()


@pytest.mark.parametrize("quantity", ["p", "v", "v-rms", "id", "f"])
@pytest.mark.parametrize("seed", range(5))
def test_the_event_is_found_where_the_means_leave_their_level(quantity: str, seed: int) -> None:
    size = np.where(TIME >= EVENT, 0.8, 1.0)
    columns = dict(zip(("va", "vb", "vc"), waves(50.0, 325.0 * size, seed), strict=True))
    columns |= dict(zip(("ia", "ib", "ic"), waves(50.0, 10.0 * size, seed + 100), strict=True))
    if quantity == "f":  # 0.5 Hz faster after the event
        turned = 2.0 * np.pi * 0.5 * np.maximum(TIME - EVENT, 0.0)
        columns |= {
            f"v{p}": 325.0 * np.cos(2 * np.pi * 50 * TIME + turned - 2 * np.pi * k / 3) for k, p in enumerate("abc")
        }
    names = ["va", "vb", "vc"], ["ia", "ib", "ic"]
    made = phase_quantities(record(columns), *names, [quantity], frequency=50.0, smoothing=PhaseFilter("mean", 0.02))
    signal = InputSignal(TIME, made[quantity], np.empty(0))
    found = event_time({quantity: signal}, {quantity: 0.02})
    assert found == pytest.approx(EVENT, abs=1e-3)


def test_a_record_of_phases_without_an_event_has_none() -> None:
    """One in ten thousand means is a false alarm: of 40 records of 49 means, one in five times."""
    alarms = 0
    for seed in range(40):
        columns = dict(zip(("va", "vb", "vc"), waves(50.0, ONE, seed), strict=True))
        made = phase_quantities(
            record(columns), ["va", "vb", "vc"], None, ["v"], frequency=50.0, smoothing=PhaseFilter("mean", 0.02)
        )
        alarms += event_time({"v": InputSignal(TIME, made["v"], np.empty(0))}, {"v": 0.02}) is not None
    assert alarms <= 2  # three of them come once in two thousand times


CARD = """schema = 1
name = "plant"
[parameters]
T = {value = 0.05, unit = "s"}
[inputs]
V = {value = 1.0, unit = "pu"}
[states]
x = {derivative = "(V - x)/T", unit = "pu"}
[outputs]
P = {value = "x", unit = "pu"}
"""
STUDY = """schema = 1
name = "s"
[model]
source = "m.toml"
[[experiment]]
name = "e"
data = "r.csv"
inputs = {V = "v"}
outputs = {P = "p"}
phases = [{voltage = ["UA", "UB", "UC"], current = ["IA", "IB", "IC"], frequency = 50, gives = {p = "p", v = "v"}}]
columns = {P = {unit = "kW", base = 100000}, V = {base = 326.6}}
"""


def test_the_noise_of_a_record_of_phases_is_that_before_its_event(tmp_path: Path) -> None:
    """As far as the means before the event tell it; the true scatter is that of 1 s of another record without an event."""
    voltage = np.where(TIME >= EVENT, 0.8, 1.0)
    power = np.where(TIME >= EVENT, 0.8 + 0.2 * np.exp(-(TIME - EVENT) / 0.05), 1.0)

    def phases(voltage: np.ndarray, power: np.ndarray, seed: int) -> Trajectory:
        columns = dict(zip(("UA", "UB", "UC"), waves(50.0, 326.6 * voltage, seed), strict=True))
        columns |= dict(
            zip(("IA", "IB", "IC"), waves(50.0, power / voltage * 1e5 / (1.5 * 326.6), seed + 1), strict=True)
        )
        return Trajectory(TIME, np.column_stack(list(columns.values())), tuple(columns), ("kV",) * 3 + ("A",) * 3)

    write_csv(phases(voltage, power, 1), tmp_path / "r.csv", units=True)
    (tmp_path / "m.toml").write_text(CARD)
    (tmp_path / "s.toml").write_text(STUDY)
    (experiment,) = load_study(tmp_path / "s.toml").experiments
    assert experiment.event == pytest.approx(EVENT, abs=1e-3)
    mean = PhaseFilter("mean", 0.02)
    names = ["UA", "UB", "UC"], ["IA", "IB", "IC"]
    still = phase_quantities(phases(ONE, ONE, 11), *names, ["p"], frequency=50.0, smoothing=mean)["p"] / 1e5
    true = float(np.std(still[200:]))
    free = int(EVENT / 0.02) - 3  # means before the event, less the line that they may lie on
    low, high = np.sqrt(chi2.ppf([1e-3, 1.0 - 1e-3], free) / free)
    assert low < experiment.noise["P"] / true < high
