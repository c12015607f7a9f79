"""Co-simulation FMUs that take one length of communication step, and refuse any other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hvdc_ident import simulate
from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.errors import SimulationError
from hvdc_ident.fmu import read_fmu
from tests.fmu.c_fmu import build, description, needs_compiler
from tests.fmu.c_models import response, spring

pytestmark = needs_compiler

STEP = 0.02
STUBBORN = replace(
    spring("stubborn"),
    code=spring().code
    + "#define AT_STEP(r) do { if (r[15] == 0) r[15] = h; if (fabs(h - r[15]) > 1e-9 * h) return 3; } while (0)\n",
)
ABLE = ' canHandleVariableCommunicationStepSize="true"'
CURVE = 4.0 * STEP**2 / 8  # what a line over one step may be off: |y''| <= k/m = 4


def written(folder, version, stated):
    """The spring that wants steps of one length; FMI 2 says how long in its default experiment, FMI 3 in an attribute."""
    text = description(STUBBORN, version)
    if version == 2:
        text = text.replace(ABLE, "")
        default = f'<DefaultExperiment stepSize="{STEP}"/>' if stated else ""
        text = text.replace("<ModelVariables>", f"{default}<ModelVariables>")
    else:
        text = text.replace(ABLE, f' fixedInternalStepSize="{STEP}"')
    return build(STUBBORN, folder, version, **{"modelDescription.xml": text.encode()})


@pytest.fixture(scope="module")
def fixed(tmp_path_factory):
    """fixed(version=2, stated=True): the model, loaded once."""
    models = {}

    def load(version=2, stated=True):
        if (version, stated) not in models:
            path = written(tmp_path_factory.mktemp("fixed"), version, stated)
            models[version, stated] = read_fmu(path, interface="co-simulation")
        return models[version, stated]

    yield load
    for m in models.values():
        m.pool.close()


ROWS = [
    (np.linspace(0.0, 4.0, 201), 2e-7),  # the FMU's own steps
    (np.linspace(0.0, 4.0, 801), 1.1 * CURVE),  # four rows a step: joined by lines
    (np.linspace(0.0, 4.0, 41), 2e-7),  # five steps a row
    (np.array([0.0, 0.011, 0.4, 1.213, 2.0, 3.999]), 1.1 * CURVE),  # uneven; the last step passes the last row
]


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize(("rows", "tolerance"), ROWS, ids=["own", "finer", "coarser", "uneven"])
def test_steps_are_the_fmus_own(fixed, version, rows, tolerance):
    run = experiment("step", rows, {"u": InputSignal.step(1.0, 0.0, 1.0)})
    found = simulate(fixed(version), run)
    assert np.abs(found["y"] - response(rows)).max() < tolerance
    again = simulate(fixed(version), run, {"d": 0.4})
    assert np.abs(again["y"] - response(rows, d=0.4)).max() < tolerance


def test_where_no_length_is_said_the_shortest_row_is_taken(fixed):
    rows = np.array([0.0, 0.5, 1.0, 1.01, 1.5, 2.0])
    run = experiment("step", rows, {"u": InputSignal.step(1.0, 0.0, 1.0)})
    found = simulate(fixed(stated=False), run)
    assert np.abs(found["y"] - response(rows)).max() < 2e-7


def test_a_jump_within_a_step_enters_as_the_mean_over_it(fixed):
    """The area under the input is kept where the jump is in the middle; else it is off by less than half a step's."""
    rows = np.linspace(0.0, 4.0, 201)
    for at, tolerance in ((1.01, 1.1 * CURVE), (1.004, 2.0 * 0.3 * STEP)):
        run = experiment("step", rows, {"u": InputSignal.step(at, 0.0, 1.0)})
        found = simulate(fixed(), run)
        assert np.abs(found["y"] - response(rows + (1.0 - at))).max() < tolerance


def test_the_same_fmu_that_claims_any_step_is_found_out(tmp_path):
    """It takes even steps, of the shortest interval, 0.011 s; the jump within one enters as the mean over it."""
    rows, step = ROWS[3][0], 0.011
    run = experiment("step", rows, {"u": InputSignal.step(1.0, 0.0, 1.0)})
    model = read_fmu(build(STUBBORN, tmp_path), interface="co-simulation")
    for _ in range(2):
        found = simulate(model, run)
        assert np.abs(found["y"] - response(rows)).max() < 2.0 * 0.5 * step  # |y'| below 2, the jump off by half a step
        assert "refuses steps of different lengths" in found.notes["steps"]
    model.pool.close()


def test_a_step_that_even_ones_cannot_mend_is_an_error(tmp_path):
    refusing = replace(STUBBORN, name="refusing", code=spring().code + "#define AT_STEP(r) return 3\n")
    run = experiment("step", ROWS[3][0], {"u": InputSignal.step(1.0, 0.0, 1.0)})
    model = read_fmu(build(refusing, tmp_path), interface="co-simulation")
    with pytest.raises(SimulationError, match=r"experiment 'step'.*fmi2DoStep returned error"):
        simulate(model, run)
    model.pool.close()
