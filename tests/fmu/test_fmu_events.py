"""Events of model-exchange FMUs that are particular about them, against answers in closed form and FMPy's own simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from c_fmu import CModel, Var, build, description, needs_compiler
from c_models import BALL, PLAIN

from hvdc_ident import simulate
from hvdc_ident.data import experiment
from hvdc_ident.fmu import read_fmu

pytestmark = needs_compiler

# T x' = 2 s - x, where s is switched off above 1 and on below 0.5. In event mode the model looks at the indicators that
# it computed last, wherever that was.
THERMOSTAT = CModel(
    "thermostat",
    PLAIN
    + """
#define NR 8
static void start(double *r) { r[2] = 0.5; r[3] = 1; r[4] = r[5] = -1; }
static void equations(double *r, double t) { r[1] = (2 * r[3] - r[0]) / r[2]; }
#define INDICATORS(r, t, z) (z[0] = r[4] = r[0] - 1, z[1] = r[5] = 0.5 - r[0])
static int switched(double *r) { if (r[4] > 0) r[3] = 0; if (r[5] > 0) r[3] = 1; return 0; }
#define EVENT(r, t, next, timed) switched(r)
""",
    (
        Var("x", 0),
        Var("der(x)", 1, more=(("derivative", "x"),)),
        Var("T", 2, "parameter", "fixed", (("start", "0.5"),)),
        Var("y", 0, "output"),
        Var("s", 3, "output"),
    ),
    1,
    2,
    kinds=("ModelExchange",),
)


def heated(time, lag=0.5):
    """The thermostat's x: up to 1 in T ln 2, down to 0.5 in T ln 2, up again in T ln(3/2)."""
    up, down = lag * np.log(1.5), lag * np.log(2.0)
    x = np.where(time < down, 2.0 - 2.0 * np.exp(-time / lag), 0.0)
    phase = np.mod(time - down, up + down)
    cycle = np.where(phase < down, np.exp(-phase / lag), 2.0 - 1.5 * np.exp(-(phase - down) / lag))
    return np.where(time < down, x, cycle)


@pytest.mark.parametrize("version", [2, 3])
def test_event_mode_is_entered_with_the_indicators_of_the_event(fmu, version):
    time = np.linspace(0.0, 10.0, 334)
    found = simulate(fmu(THERMOSTAT, version), experiment("heat", time))
    assert np.abs(found["y"] - heated(time)).max() < 1e-6


# --- after completed steps ---


def stepping(model, folder, version):
    """The model as an FMU that has to be told of completed steps; FMI 2.0 says so by saying nothing."""
    text = description(model, version)
    if version == 3:
        text = text.replace("<ModelExchange ", '<ModelExchange needsCompletedIntegratorStep="true" ')
    path = build(model, folder, version, **{"modelDescription.xml": text.encode()})
    return read_fmu(path, interface="model-exchange")


@pytest.mark.parametrize("version", [2, 3])
def test_the_step_that_an_event_ends_is_completed_too(fmu, tmp_path, version):
    """The ball takes its velocity from the step that was completed last."""
    code = BALL.code.replace("r[1] = -r[5] * r[1]; return 1", "r[1] = -r[5] * r[7]; return 1")
    code += "#define STEP_EVENT(r) (r[7] = r[1], 0)\n"
    fall = experiment("fall", np.linspace(0.0, 2.0, 401))
    model = stepping(replace(BALL, name="remembers", code=code), tmp_path, version)
    found, expected = simulate(model, fall), simulate(fmu(BALL, version, "model-exchange"), fall)
    model.pool.close()
    assert found.statistics.events == expected.statistics.events >= 4
    assert np.abs(found["height"] - expected["height"]).max() < 1e-9
