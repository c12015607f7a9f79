"""Co-simulation FMUs that want to be called in one way and no other, against answers in closed form."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import fmpy
import numpy as np
import pytest

from hvdc_ident import simulate
from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.errors import SimulationError
from hvdc_ident.fmu import read_fmu
from tests.fmu.c_fmu import Var, build, description, needs_compiler
from tests.fmu.c_models import LATCH_CODE, latch

pytestmark = needs_compiler

T = 0.1
TIME = np.linspace(0.0, 1.0, 41)
JUMPS = [(0.0, 0.5), (0.25, 0.5), (0.25, 2.0), (0.6, 2.0), (0.6, -1.0), (1.0, -1.0)]
RAMP = [(0.0, 0.0), (0.2, 0.0), (0.7, 3.0), (1.0, 3.0)]


def lagging(time, corners):
    """The lag of a piecewise linear input, by its exact solution over each piece: y = u - T s + (y0 - u0 + T s) e^(-t/T)."""
    signal, y = InputSignal.corners(corners), 0.0
    stops = np.unique(np.concatenate([time, [t for t, _ in corners]]))
    found = {stops[0]: y}
    for a, b in pairwise(stops):
        u0, u1 = float(signal(a)), float(signal(np.nextafter(b, a)))
        s = (u1 - u0) / (b - a)
        y = found[b] = u1 - T * s + (y - u0 + T * s) * np.exp(-(b - a) / T)
    return np.array([found[t] for t in time])


@pytest.fixture
def load(tmp_path):
    """load(model, version=2, texts=()): the FMU loaded, with texts of its description replaced."""
    loaded = []

    def load(model, version=2, texts=()):
        text = description(model, version)
        for old, new in texts:
            text = text.replace(old, new)
        path = build(model, tmp_path, version, **{"modelDescription.xml": text.encode()})
        loaded.append(read_fmu(path, interface="co-simulation"))
        return loaded[-1]

    yield load
    for model in loaded:
        model.pool.close()


def run(model, corners, time=TIME):
    return simulate(model, experiment("run", time, {"u": InputSignal.corners(corners)}))


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("kind", ["plain", "changed", "compared"])
def test_jumps_arrive_and_rows_at_them_are_after_them(load, kind, version):
    model = load(latch(kind), version)
    for _ in range(2):  # once with the trial, once with what it taught
        found = run(model, JUMPS)
        expected = lagging(TIME, JUMPS)
        assert np.abs(found["out"] - expected).max() < 1e-6
        assert np.abs(found["through"] - expected - InputSignal.corners(JUMPS)(TIME)).max() < 1e-6
        assert not found.notes


def test_two_rows_at_one_instant_have_what_was_before_the_jump_and_after_it(load):
    time = np.array([0.0, 0.25, 0.25, 0.5, 0.6, 0.6, 1.0])
    found = run(load(latch()), JUMPS, time)
    before = found["through"] - found["out"]
    assert before == pytest.approx([0.5, 0.5, 2.0, 2.0, 2.0, -1.0, -1.0], abs=1e-12)
    assert np.abs(found["out"] - lagging(time, JUMPS)).max() < 1e-5


@pytest.mark.parametrize("kind", ["plain", "changed", "compared"])
def test_ramps_arrive_on_coarse_rows_as_held_at_their_mean(load, kind):
    found = run(load(latch(kind)), RAMP)
    h, slope = TIME[1] - TIME[0], 6.0
    assert np.abs(found["out"] - lagging(TIME, RAMP)).max() < h**2 / (8 * T) * slope
    assert np.abs(found["through"] - found["out"] - InputSignal.corners(RAMP)(TIME)).max() < 1e-12


def test_where_any_reading_loses_a_jump_rows_at_it_are_before_it_and_that_is_said(load):
    found = run(load(latch("spoiled")), JUMPS)
    assert np.abs(found["out"] - lagging(TIME, JUMPS)).max() < 1e-6
    assert "rows at jumps are before them" in found.notes["outputs at jumps"]
    before = InputSignal.corners(JUMPS)(TIME - 1e-9)
    assert np.abs(found["through"] - found["out"] - before).max() < 1e-12


def test_an_output_that_never_repeats_does_not_judge(load):
    """As the time that the computation took: here nanoseconds of the system, at each reading."""
    code = """
#include <time.h>
static double nanoseconds(void) { struct timespec t; clock_gettime(CLOCK_MONOTONIC, &t); return t.tv_nsec; }
#undef AT_GET
#define AT_GET(r) (r[7] = r[9] = 0, r[13] = nanoseconds())
"""
    model = latch("changed", code, "timing")
    found = run(load(replace(model, variables=(*model.variables, Var("took", 13, "output")))), JUMPS)
    assert np.abs(found["out"] - lagging(TIME, JUMPS)).max() < 1e-6 and not found.notes
    assert np.abs(found["through"] - found["out"] - InputSignal.corners(JUMPS)(TIME)).max() < 1e-12


# A step moves it only where an input was set since it was initialised or outputs were read with one that was set.
LAZY = """
#undef INITIALIZE
#define INITIALIZE(r) (r[6] = r[4], r[9] = 0)
#define AT_SET(r, v, x) (r[9] = 1)
#define AT_GET(r) (r[7] = r[9] = 0)
#define AT_STEP(r) do { if (!r[9]) return 0; r[6] = r[4]; r[7] = 1; r[9] = 0; } while (0)
"""


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize(
    "corners",
    [
        [(0.0, 2.0), (1.0, 2.0)],
        [(0.0, 2.0), (0.6, 2.0), (0.6, -1.0), (1.0, -1.0)],
        [(0.0, 0.5), (0.25, 0.5), (0.25, 1.0), (0.275, 3.0), (0.275, 2.0), (1.0, 2.0)],  # 2 is the ramp's mean too
    ],
    ids=["constant", "jump", "mean"],
)
def test_inputs_are_set_in_every_step(load, version, corners):
    """As FMPy's simulation does, whose rows have no jump at them."""
    model = load(replace(latch(more=LAZY, name="lazy"), code=LATCH_CODE + LAZY), version)
    found = run(model, corners)["out"]
    held = 0.025**2 / (8 * T) * 80.0  # the ramp, 80/s, is held at its mean
    assert np.abs(found - lagging(TIME, corners)).max() < (held if len(corners) == 6 else 1e-6)
    if len(corners) == 2:
        constant = np.array([(0.0, 2.0), (1.0, 2.0)], dtype=[("time", float), ("u", float)])
        theirs = fmpy.simulate_fmu(
            str(model.fmu.path),
            validate=False,
            fmi_type="CoSimulation",
            stop_time=1.0,
            output_interval=0.025,
            input=constant,
            output=["out"],
        )
        assert np.abs(found - theirs["out"]).max() < 1e-9


ABLE = ' canHandleVariableCommunicationStepSize="true"'
CLAIMS = ((ABLE, f'{ABLE} canInterpolateInputs="true"'),)
FOLLOWS = """
#define SLOPE(r, v, s) (r[11] = s)
#undef AT_STEP
#define AT_STEP(r) (r[6] = r[4], r[12] = m->t, r[7] = 1)
"""


def test_slopes_that_are_followed_are_used(load):
    found = run(load(latch("plain", FOLLOWS, "follows"), texts=CLAIMS), RAMP)
    assert np.abs(found["out"] - lagging(TIME, RAMP)).max() < 1e-6 and not found.notes


@pytest.mark.parametrize(
    "does", ["(void)s", "(r[4] = 0)", "return 3"], ids=["ignores them", "loses the input", "refuses"]
)
def test_slopes_that_are_not_followed_are_not_used_and_that_is_said(load, does):
    code = f"#define SLOPE(r, v, s) {does}\n"
    model = load(latch("plain", code, "deaf"), texts=CLAIMS)
    h, slope = TIME[1] - TIME[0], 6.0
    for _ in range(2):
        found = run(model, RAMP)
        assert np.abs(found["out"] - lagging(TIME, RAMP)).max() < h**2 / (8 * T) * slope
        assert "they are held" in found.notes["ramps of inputs"]


@pytest.mark.parametrize("own", [0.1, 0.04])
@pytest.mark.parametrize("version", [2, 3])
def test_internal_steps_that_rows_do_not_suit(load, version, own):
    """A row has what the last internal step ended with; FMI 3.0 says how old that is, after a jump as before it."""
    jump = 3.0 * own
    model = load(latch("plain", f"#define INTERNAL {own}\n", "inner"), version)
    found = run(model, [(0.0, 0.0), (jump, 0.0), (jump, 1.0)], TIME)
    ended = own * np.floor(TIME / own + 1e-6)
    assert np.abs(found["out"] - (1.0 - np.exp(-np.maximum(ended - jump, 0.0) / T))).max() < 1e-6
    assert ("internal steps" in found.notes) == (version == 3)
    if version == 3:
        assert f"up to {(TIME - ended).max():.3g} s earlier" in found.notes["internal steps"]


def test_internal_steps_shorter_than_the_rows(load):
    """No two rows lie in one internal step: another run, of more rows, shows that outputs are those of its begin."""
    time = np.linspace(0.0, 1.0, 21)
    model = load(latch("plain", "#define INTERNAL 0.04\n", "shorter"), 3)
    for _ in range(2):
        found = run(model, [(0.0, 1.0)], time)
        ended = 0.04 * np.floor(time / 0.04 + 1e-6)
        assert np.abs(found["out"] - (1.0 - np.exp(-ended / T))).max() < 1e-6
        assert "up to 0.03 s earlier" in found.notes["internal steps"]


@pytest.mark.parametrize("rows", [21, 41])
@pytest.mark.parametrize("says", ["0.04 * floor(reached / 0.04 + 1e-6)", "0", "fmax(reached - 0.01, 0)"])
def test_outputs_of_a_row_are_not_called_older_because_the_fmu_says_so(load, rows, says):
    """It says where its solver was, or nothing of use, and its outputs are those of the row."""
    time = np.linspace(0.0, 1.0, rows)
    found = run(load(latch("plain", f"#define SAYS(reached) ({says})\n", "says"), 3), [(0.0, 1.0)], time)
    assert np.abs(found["out"] - (1.0 - np.exp(-time / T))).max() < 1e-6
    assert not found.notes


@pytest.mark.parametrize("version", [2, 3])
def test_steps_that_end_early_are_continued(load, version):
    """FMI 2.0 discards the step and tells how far it came, FMI 3.0 returns early: here at every multiple of 0.07 s."""
    stops = "#define STOPS_AT(t, h) fmin(t + h, 0.07 * (floor(t / 0.07 + 1e-9) + 1))\n"
    found = run(load(latch("plain", stops, "early"), version), JUMPS)
    assert np.abs(found["out"] - lagging(TIME, JUMPS)).max() < 1e-6 and not found.notes


@pytest.mark.parametrize("version", [2, 3])
def test_steps_that_never_get_on_are_given_up(load, version):
    model = load(latch("plain", "#define STOPS_AT(t, h) (t < 0.5 ? t + h : t)\n", "stuck"), version)
    with pytest.raises(SimulationError, match=r"DoStep returned discard|returned early"):
        run(model, JUMPS)


@pytest.mark.parametrize("version", [2, 3])
def test_a_run_of_no_length_has_no_stop_time(load, version):
    model = load(
        latch("plain", "#define BEGIN(t, has, end) do { if (has && end <= t) return 3; } while (0)\n", "length"),
        version,
    )
    found = run(model, [(0.0, 2.0)], np.array([0.0]))
    assert found["through"] == pytest.approx([2.0])
