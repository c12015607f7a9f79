"""A few of the drawn studies of `generated.py`, every warning an error: no traceback, no blank reason, strict JSON.

`python tests/hostile/generated.py --runs 200` runs as many as asked for, with a table of how each command ended.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import generated
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.hostile.plants import Plant, Seeded, recorded

pytestmark = pytest.mark.nightly

NUMBERS = (16, 36)
"""Studies that go through every command within a few seconds."""
ONCE = ((64, "identify"),)
"""Studies of which one command had ended in a traceback: a rest that no value moves, beside a jump."""
QUICK = ("check", "simulate", "export .toml", "export .mo", "export .ssv")


class Drawn:
    """Choices of hypothesis."""

    def __init__(self, data: st.DataObject) -> None:
        self.data = data

    def pick(self, options: Any) -> Any:
        return self.data.draw(st.sampled_from(options))

    def integer(self, low: int, high: int) -> int:
        return self.data.draw(st.integers(low, high))


@pytest.mark.parametrize("number", NUMBERS)
def test_every_command_ends_well_or_with_a_reason(number: int, tmp_path: Path) -> None:
    study = generated.write_study(Seeded(np.random.default_rng([37, number])), tmp_path)
    ends = [generated.run(study, command) for command in generated.COMMANDS]
    assert [(e.command, e.bug) for e in ends if e.bug] == []
    assert ends[0].code == 0, ends[0].said
    assert generated.spoilt_results(study) == []


@pytest.mark.parametrize(("number", "command"), ONCE)
def test_what_had_ended_in_a_traceback_does_not(number: int, command: str, tmp_path: Path) -> None:
    end = generated.run(generated.write_study(Seeded(np.random.default_rng([37, number])), tmp_path), command)
    assert (end.code, end.bug) == (0, ""), end.said


@settings(max_examples=8, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_a_drawn_study_is_read_simulated_and_exported(data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as folder:
        study = generated.write_study(Drawn(data), Path(folder))
        ends = [generated.run(study, command) for command in QUICK]
        assert [(e.command, e.bug) for e in ends if e.bug] == []


def test_the_plants_own_simulation_is_right() -> None:
    """A lag of 0.1 s behind a step, and a loop z = u - tanh(z), against their closed forms."""
    t = np.linspace(0.0, 1.0, 51)
    u = np.where(t >= 0.2, 1.0, 0.0)
    lag = Plant(
        {"T": 0.1}, {"u": 0.0}, {"x": "(u - x)/T"}, algebraic={"z": "u - tanh(z)"}, outputs={"y": "x", "z": "z"}
    )
    y = recorded(lag, t, {"u": u}, linear=False)
    assert np.allclose(y[:, 0], np.where(t >= 0.2, 1.0 - np.exp(-(t - 0.2) / 0.1), 0.0), atol=1e-7)
    assert np.allclose(y[:, 1] + np.tanh(y[:, 1]), u, atol=1e-10)
