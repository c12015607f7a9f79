"""Events of model-exchange FMUs that are particular about them, against answers in closed form and FMPy's own simulation."""

from __future__ import annotations

from dataclasses import replace

import fmpy
import numpy as np
import pytest

from hvdc_ident import simulate
from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.fmu import at_point, read_fmu
from tests.fmu.c_fmu import CModel, Var, build, description, needs_compiler
from tests.fmu.c_models import BALL, COUNTER, PLAIN, response, spring

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


# --- rows at time events ---

# A counter beside a state. It sums its period, and does nothing before the instant that it has said.
STRICT = CModel(
    "strict",
    PLAIN
    + """
#define NR 5
static void start(double *r) { r[2] = 0.25; }
static void equations(double *r, double t) { r[1] = 1; r[4] = r[3]; }
static int tick(double *r, double t, double *next, int *timed) {
    if (!*timed) *next = t + r[2];
    else if (t >= *next) { r[3] += 1; *next += r[2]; }
    *timed = 1;
    return 0;
}
#define EVENT(r, t, next, timed) tick(r, t, next, timed)
""",
    (
        Var("x", 0),
        Var("der(x)", 1, more=(("derivative", "x"),)),
        Var("period", 2, "parameter", "fixed", (("start", "0.25"),)),
        Var("count", 4, "output", "discrete"),
    ),
    1,
    kinds=("ModelExchange",),
)


@pytest.mark.parametrize("model", [COUNTER, STRICT], ids=["tolerant", "strict"])
@pytest.mark.parametrize("period", [0.1, 0.3])
def test_a_row_at_a_time_event_is_after_it(fmu, model, period):
    """0.1 + 0.1 + 0.1 is more than 0.3."""
    time = np.round(period * np.arange(101), 10)
    found = simulate(fmu(model), experiment("count", time), {"period": period})
    assert np.array_equal(found["count"], np.arange(101))


def test_ten_thousand_sums_of_a_period_may_round_to_the_same_side(fmu):
    """From 4096 s on, each sum is 0.48 of a last digit too large: after 10 000 they are 4.4e-9 s late."""
    digit, sums = np.spacing(4096.0), 10_000
    period = (round(1e-3 / digit) + 0.52) * digit
    time = np.array([4096.0, 4096.0 + sums * period])
    found = simulate(fmu(STRICT), experiment("sums", time), {"period": period})
    assert found["count"].tolist() == [0, sums]


def test_fmpy_has_the_same_samples(fmu):
    model, time = fmu(COUNTER), np.round(0.1 * np.arange(11), 10)
    found = simulate(model, experiment("count", time), {"period": 0.1})["count"]
    theirs = fmpy.simulate_fmu(
        str(model.fmu.path),
        validate=False,
        stop_time=1.0,
        output_interval=0.1,
        start_values={"period": 0.1},
        output=["count"],
        record_events=False,
    )
    assert np.array_equal(found, theirs["count"])


# x' = n u, where n counts two clocks, of 0.1 s and of 0.3 s, which sum their periods.
CLOCKS = CModel(
    "clocks",
    PLAIN
    + """
#define NR 8
static void start(double *r) { r[5] = 0.1; r[6] = 0.3; }
static void equations(double *r, double t) { r[1] = r[3] * r[2]; r[4] = r[3] + r[2]; }
static int tick(double *r, double t, double *next, int *timed) {
    if (t >= r[5]) { r[3] += 1; r[5] += 0.1; }
    if (t >= r[6]) { r[3] += 1; r[6] += 0.3; }
    *timed = 1; *next = fmin(r[5], r[6]);
    return 0;
}
#define EVENT(r, t, next, timed) tick(r, t, next, timed)
""",
    (
        Var("x", 0),
        Var("der(x)", 1, more=(("derivative", "x"),)),
        Var("u", 2, "input", "continuous", (("start", "0"),)),
        Var("y", 0, "output"),
        Var("ticks", 3, "output", "discrete"),
        Var("through", 4, "output"),
    ),
    1,
    kinds=("ModelExchange",),
)


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("at", [0.3, 0.1 + 0.2])
def test_clocks_and_jumps_that_differ_by_rounding_are_at_one_instant(fmu, version, at):
    """The clocks' sums, 0.30000000000000004 and 0.3, the jump at either, two rows of 0.3: before all, and after."""
    time = np.array([0.0, 0.1, 0.2, 0.3, 0.3, 0.4, 0.6, 0.9, 1.0])
    u = InputSignal.step(at, 1.0, 3.0)
    found = simulate(fmu(CLOCKS, version), experiment("ticks", time, {"u": u}))
    assert found["ticks"].tolist() == [0, 1, 2, 2, 4, 5, 8, 12, 13]
    assert found["through"] - found["ticks"] == pytest.approx([1.0] * 4 + [3.0] * 5, abs=1e-12)
    areas = [0.0, 0.0, 0.1, 0.3, 0.3, 1.5, 4.8, 12.9, 16.5]
    assert found["y"] == pytest.approx(areas, abs=1e-7)


# --- after completed steps ---


def stepping(model, folder, version):
    """The model as an FMU that has to be told of completed steps; FMI 2.0 says so by saying nothing."""
    text = description(model, version)
    if version == 3:
        text = text.replace("<ModelExchange ", '<ModelExchange needsCompletedIntegratorStep="true" ')
    path = build(model, folder, version, **{"modelDescription.xml": text.encode()})
    return read_fmu(path, interface="model-exchange")


@pytest.mark.parametrize("version", [2, 3])
def test_events_wanted_after_every_step_that_change_nothing_are_free(fmu, tmp_path, version):
    time = np.linspace(0.0, 5.0, 251)
    step = experiment("step", time, {"u": InputSignal.step(1.0, 0.0, 1.0)})
    wanting = replace(spring("wanting"), code=spring().code + "#define STEP_EVENT(r) 1\n")
    model = stepping(wanting, tmp_path, version)
    found, plain = simulate(model, step), simulate(fmu(spring(), version, "model-exchange"), step)
    model.pool.close()
    assert np.abs(found["y"] - response(time)).max() < 2e-7
    assert found.statistics.accepted == plain.statistics.accepted
    assert found.statistics.events == plain.statistics.events


# An angle of rate w that is turned back into -pi .. pi after a step that has left it.
ANGLE = CModel(
    "angle",
    PLAIN
    + """
#define NR 6
static void start(double *r) { r[2] = 3; }
static void equations(double *r, double t) { r[1] = r[2]; r[3] = sin(r[0]); }
#define STEP_EVENT(r) (r[0] > 3.141592653589793)
static int turned(double *r) {
    if (r[0] > 3.141592653589793) { r[0] -= 2 * 3.141592653589793; return 1; }
    return 0;
}
#define EVENT(r, t, next, timed) turned(r)
""",
    (
        Var("phi", 0),
        Var("der(phi)", 1, more=(("derivative", "phi"),)),
        Var("w", 2, "parameter", "tunable", (("start", "3"),)),
        Var("y", 3, "output"),
        Var("angle", 0, "output"),
    ),
    1,
    kinds=("ModelExchange",),
)


@pytest.mark.parametrize("version", [2, 3])
def test_an_event_after_a_step_that_changes_a_state_begins_a_new_segment(tmp_path, version):
    time = np.linspace(0.0, 20.0, 401)
    model = stepping(ANGLE, tmp_path, version)
    found = simulate(model, experiment("turn", time))
    model.pool.close()
    assert np.abs(found["y"] - np.sin(3.0 * time)).max() < 1e-6
    assert 1 <= found.statistics.events <= 10  # at 3.14 rad and after each of 9 turns; 60 rad are 9.5 turns


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


# The spring whose input changes at events alone, and which refuses what belongs into another mode.
BY_MODE = replace(
    spring("modes", own=False),
    code="#define STRICT\n#define AT_SET(r, v, x) if (v == 8 && m->mode == CONTINUOUS_TIME_MODE) return 3\n"
    + spring().code,
    variables=tuple(replace(v, variability="discrete") if v.name == "u" else v for v in spring().variables),
)


@pytest.mark.parametrize("version", [2, 3])
def test_every_call_is_made_in_the_mode_it_belongs_into(tmp_path, version):
    """A run with a jump of the input, and the derivatives at a point beside the start."""
    model = stepping(BY_MODE, tmp_path, version)
    time = np.linspace(0.0, 5.0, 251)
    found = simulate(model, experiment("step", time, {"u": InputSignal.step(1.0, 0.0, 1.0)}))
    assert np.abs(found["y"] - response(time)).max() < 2e-7
    point = at_point(model, {"u": 0.5, "k": 6.0}, np.array([0.4, 0.0]), ["twice"])
    assert point.derivatives == pytest.approx([0.0, 0.3]) and point.outputs == pytest.approx([0.25])
    model.pool.close()
