"""Outputs made of recorded phases, through the study file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hvdc_ident.data import trajectory
from hvdc_ident.errors import InputError
from hvdc_ident.formats import write_csv
from hvdc_ident.study.study import load_study

CARD = """schema = 1
name = "source"
[parameters]
T = {value = 0.05}
[inputs]
u = {value = 0.0, unit = "pu"}
[states]
x = {derivative = "(u - x)/T", unit = "pu"}
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
inputs = ["u"]
outputs = ["P"]
phases = [{voltage = ["va", "vb", "vc"], current = ["ia", "ib", "ic"], frequency = 50, gives = {P_MW = "p"}}]
columns = {P = {name = "P_MW", unit = "MW", base = 1000}}
noise = {P = 1e-3}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    t = np.arange(0, 0.1, 2e-4)
    signals = {"u": np.where(t >= 0.05, 1.0, 0.5)}
    for k, phase in enumerate("abc"):
        signals[f"v{phase}"] = 100.0 * np.cos(2 * np.pi * 50 * t - 2 * np.pi * k / 3)
        signals[f"i{phase}"] = 2.0 * np.cos(2 * np.pi * 50 * t - 2 * np.pi * k / 3)
    units = {n: "kV" if n.startswith("v") else "kA" for n in signals if n != "u"}
    write_csv(trajectory(t, signals, units), tmp_path / "r.csv", units=True)
    (tmp_path / "m.toml").write_text(CARD, "utf-8")
    (tmp_path / "s.toml").write_text(STUDY, "utf-8")
    return tmp_path


def test_the_power_of_the_phases_on_the_models_base(folder: Path) -> None:
    (experiment,) = load_study(folder / "s.toml").experiments
    assert experiment.measured is not None
    np.testing.assert_allclose(experiment.measured["P"], 1.5 * 100 * 2 / 1000, rtol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('"va", "vb", "vc"', '"va", "vb", "vx"', "vx"),
        ('P_MW = "p"', 'P_MW = "power"', "quantity"),
        ('P_MW = "p"', 'va = "p"', "already there|unknown|P_MW"),
        ("base = 1000", "base = 1000, scale = 2", "either scale"),
        ("frequency = 50, ", "", "frequency"),
    ],
)
def test_what_is_wrong_is_said(folder: Path, old: str, new: str, says: str) -> None:
    (folder / "s.toml").write_text(STUDY.replace(old, new), "utf-8")
    with pytest.raises(InputError, match=says):
        load_study(folder / "s.toml")
