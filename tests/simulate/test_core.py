"""The core in C: its record is the header's, both builds give the same run, and it keeps no memory."""

from __future__ import annotations

import ctypes
import resource

import numpy as np
import pytest

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.errors import InstallationError
from hvdc_ident.model import parse_card
from hvdc_ident.models import load_model
from hvdc_ident.simulate import core, engine_of, simulate

STEP = experiment("step", np.linspace(0.0, 0.5, 501), {"Vdcref1": InputSignal.step(0.1, 1.0, 1.019)})
DELAYED = """
schema = 1
name = "delayed"
[parameters]
k = {value = 2.0}
T = {value = 0.05}
[inputs]
u = {value = 0.0}
[delays]
late = {of = "x", time = "T"}
[states]
x = {derivative = "k*(u - late)", guess = 0.0}
[outputs]
x = "x"
"""


def test_the_record_has_the_fields_of_the_header() -> None:
    assert core.library().hvdc_ident_fields() == len(core.RUN_FIELDS) == len(set(core.RUN_FIELDS))
    assert core.RUN_FIELDS[core.GIVEN][0] == "p" and core.RUN_FIELDS[core.GIVEN_INSTANTS] == (
        "start",
        "end",
        "rtol",
        "atol",
    )


def test_a_library_of_another_header_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(core, "RUN_FIELDS", (*core.RUN_FIELDS, "more"))
    core.library.cache_clear()
    with pytest.raises(InstallationError, match=r"of another version.*python build_backend.py"):
        core.library()
    core.library.cache_clear()


def test_a_package_without_the_library_says_how_it_is_built(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    monkeypatch.setattr(core, "FOLDER", tmp_path)
    core.library.cache_clear()
    with pytest.raises(InstallationError, match=r"not there; expected core-baseline.*pip install"):
        core.library()
    core.library.cache_clear()


def test_both_builds_give_the_same_run(monkeypatch: pytest.MonkeyPatch) -> None:
    link = load_model("vsc-hvdc-link")
    first = simulate(link, STEP, sensitivities=("KIVDC",), rtol=1e-11)
    monkeypatch.setattr(core, "BUILDS", {"baseline": ()})
    core.library.cache_clear()
    other = simulate(link, STEP, sensitivities=("KIVDC",), rtol=1e-11)
    core.library.cache_clear()
    assert np.allclose(first.trajectory.values, other.trajectory.values, rtol=1e-9, atol=1e-9)
    assert np.allclose(first.gradients, other.gradients, rtol=1e-7, atol=1e-9 * np.abs(first.gradients).max())


def test_a_search_without_memory_says_so() -> None:
    equations = core.SteadyEquations([0] * 4, (1, 1, 1, 1, 0), (0.0,), np.zeros(1), 1)
    equations.record[4 + 3] = 2**40  # unknowns
    with pytest.raises(MemoryError):
        equations.newton(np.zeros(2))


@pytest.mark.nightly
def test_runs_leave_no_memory_behind() -> None:
    model = parse_card(DELAYED)
    case = experiment("step", np.linspace(0.0, 2.0, 21), {"u": InputSignal.step(0.1, 0.0, 1.0)})
    assert engine_of(model, ("T",)).structure.sizes.nd == 1

    def grown(runs: int) -> int:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for _ in range(runs):
            simulate(model, case, sensitivities=("T",))
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before

    grown(1000)
    assert grown(10_000) < 2000  # KiB: a history that is not freed takes 10 KiB a run


def test_a_pointer_is_the_data_of_its_array() -> None:
    a = np.arange(3.0)
    assert ctypes.c_double.from_address(core.address(a[1:])).value == 1.0
    assert core.address(np.zeros(0)) != 0
