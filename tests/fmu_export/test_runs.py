"""Exported FMUs against the engine that fits use: trajectories to solver tolerance, under importers of other makers."""

from __future__ import annotations

import numpy as np
import pytest
from fmpy import simulate_fmu

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.fmu import read_fmu
from hvdc_ident.model import parse_card
from hvdc_ident.simulate import simulate
from tests.fmu_export.cases import ZOO
from tests.fmu_export.driver import cosimulate

# No row falls on an instant at which a sampled value changes.
TIME = np.concatenate([[0.0], np.linspace(0.00057, 0.3, 211)])
STEPS = {
    "link": {"Pref2": InputSignal.corners([(0.0501, 0.4), (0.0501, 1.3), (0.17, 1.3), (0.17, 0.3)])},
    "augmented": {"Vdcref1": InputSignal.step(0.0501, 1.0, 1.03)},
    "remembering": {"Pref2": InputSignal.step(0.0501, 0.4, 0.6), "Vdcref1": InputSignal.step(0.15, 1.0, 1.02)},
    "zoo": {"u": InputSignal.corners([(0.05, 0.2), (0.05, 0.9), (0.17, 0.9), (0.17, -0.4)])},
}
RAMPS = {
    "link": {"Pref2": InputSignal.ramp(0.05, 0.4, 0.1, 1.25)},
    "augmented": {"Vdcref1": InputSignal.ramp(0.05, 1.0, 0.06, 1.03)},
    "remembering": {"Pref2": InputSignal.ramp(0.05, 0.4, 0.1, 0.7)},
    "zoo": {"u": InputSignal.ramp(0.05, 0.2, 0.2, -0.8), "d": InputSignal.ramp(0.0, -0.1, 0.3, 0.8)},
}


def engine_run(model, inputs, outputs, values=None):
    """(n, outputs) by the engine, to a tighter tolerance than what is compared with it."""
    run = simulate(model, experiment("case", TIME, inputs), values, outputs=outputs, rtol=1e-11)
    return np.column_stack([run[o] for o in outputs])


def fmi_names(names):
    """The names of the outputs in the FMU."""
    return ["outputs.u" if n == "u" else n for n in names]


def worst(found, expected):
    """The largest error in shares of each output's largest size (and 1e-3)."""
    return float((np.abs(found - expected) / (np.abs(expected).max(axis=0) + 1e-3)).max())


@pytest.mark.parametrize(
    ("name", "version"), [("link", "2.0"), ("augmented", "2.0"), ("remembering", "3.0"), ("zoo", "2.0"), ("zoo", "3.0")]
)
def test_co_simulation_of_steps(fmu, name, version):
    f = fmu(name, version)
    outputs = list(f.model.outputs)
    found = cosimulate(f, TIME, STEPS[name], fmi_names(outputs), tolerance=1e-10)
    assert worst(found, engine_run(f.model, STEPS[name], outputs)) < 1e-6


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_a_row_at_a_jump_has_what_follows_it(fmu, version):
    """A jump of an input, one that comes out of a delay, samples taken and published: as the engine has those rows."""
    f = fmu("punctual", version)
    outputs, rows = list(f.model.outputs), np.arange(65) / 256
    inputs = {"u": InputSignal.corners([(16 / 256, 0.25), (16 / 256, 2.0), (40 / 256, 2.0), (40 / 256, -1.0)])}
    run = simulate(f.model, experiment("rows", rows, inputs), outputs=outputs, rtol=1e-11)
    expected = np.column_stack([run[o] for o in outputs])
    jumps = np.abs(np.diff(expected, axis=0)) > 1e-3
    assert jumps[:, 1].sum() == 2 and jumps[:, 2].sum() > 3 and jumps[:, 3].sum() > 5
    assert worst(cosimulate(f, rows, inputs, outputs, tolerance=1e-10), expected) < 1e-8
    loaded = read_fmu(f.path, interface="co-simulation")
    found = loaded.simulate(experiment("rows", rows, inputs))
    loaded.pool.close()
    assert worst(np.column_stack([found[o] for o in outputs]), expected) < 1e-6


@pytest.mark.parametrize("name", sorted(RAMPS))
def test_co_simulation_follows_slopes_of_inputs(fmu, name):
    f = fmu(name)
    outputs = list(f.model.outputs)
    found = cosimulate(f, TIME, RAMPS[name], fmi_names(outputs), tolerance=1e-10)
    assert worst(found, engine_run(f.model, RAMPS[name], outputs)) < 1e-6


@pytest.mark.parametrize("name", ["link", "zoo"])
def test_co_simulation_at_its_own_tolerance(fmu, name):
    f = fmu(name)
    outputs = list(f.model.outputs)
    found = cosimulate(f, TIME, STEPS[name], fmi_names(outputs))
    assert worst(found, engine_run(f.model, STEPS[name], outputs)) < 1e-4  # Idc is 4096 times a difference of states


@pytest.mark.parametrize(
    ("name", "version"), [*((n, "2.0") for n in sorted(STEPS)), ("zoo", "3.0"), ("augmented", "3.0")]
)
def test_model_exchange_under_another_solver(fmu, name, version):
    """CVODE, with its own step control and root finding; it holds inputs between its steps, so inputs are steps."""
    f = fmu(name, version)
    outputs, inputs = list(f.model.outputs), STEPS[name]
    corners = np.unique(np.concatenate([s.times for s in inputs.values()]))
    table = [(0.0, *(float(s(-1.0)) for s in inputs.values()))]
    for t in corners:
        table.append((t, *(float(s(np.nextafter(t, -1.0))) for s in inputs.values())))
        table.append((t, *(float(s(t)) for s in inputs.values())))
    table.append((1.0, *(float(s(1.0)) for s in inputs.values())))
    rest = [n for n in f.model.inputs if n not in inputs]
    rows = [(*row, *(f.model.inputs[n].value for n in rest)) for row in table]
    signals = np.array(rows, dtype=[(n, float) for n in ("time", *inputs, *rest)])
    r = simulate_fmu(
        f.folder,
        fmi_type="ModelExchange",
        stop_time=0.3,
        output_interval=0.0015,
        relative_tolerance=1e-10,
        input=signals,
        output=fmi_names(outputs),
        record_events=False,
    )
    away = np.abs(r["time"][:, None] - corners).min(axis=1) > 1e-9
    time = r["time"][away]
    run = simulate(f.model, experiment("case", time, inputs), outputs=outputs, rtol=1e-11)
    found = np.column_stack([r[n][away] for n in fmi_names(outputs)])
    expected = np.column_stack([run[o] for o in outputs])
    if name in ("zoo", "remembering"):  # a row at the very instant of a sample may stand on either side of it
        sides = [np.where(time > 0.0, time + d, time) for d in (-1e-7, 1e-7)]
        runs = [simulate(f.model, experiment("case", t, inputs), outputs=outputs, rtol=1e-11) for t in sides]
        settled = np.abs(np.column_stack([runs[0][o] - runs[1][o] for o in outputs])).max(axis=1) < 5e-6
        assert settled.mean() > 0.9
        found, expected = found[settled], expected[settled]
    assert worst(found, expected) < 2e-5


def test_a_delay_of_0_is_left_out_with_its_parameter(fmu):
    f = fmu("undelayed")
    assert "T" not in {v.name for v in f.description.modelVariables}
    outputs = list(f.model.outputs)
    found = cosimulate(f, TIME, RAMPS["zoo"], fmi_names(outputs), tolerance=1e-10)
    plain = parse_card(ZOO.replace('[delays]\nlate = {of = "x + 0.5*q", time = "T"}', '[signals]\nlate = "x + 0.5*q"'))
    assert worst(found, engine_run(plain, RAMPS["zoo"], outputs)) < 1e-6


def test_parameters_and_inputs_set_before_the_start_move_it(fmu):
    f = fmu("link")
    values, outputs = {"Rdc": 4e-4, "KPQ": 0.3, "Pref2": 0.9, "E1": 1.02}, ["Vdc2", "Q1", "Idc"]
    inputs = {"Vdcref1": InputSignal.step(0.05, 1.0, 1.02)}
    found = cosimulate(f, TIME, inputs, outputs, values, tolerance=1e-10)
    assert worst(found, engine_run(f.model, inputs, outputs, values)) < 1e-6


@pytest.mark.parametrize("name", ["link", "remembering", "zoo"])
def test_a_copied_state_continues_to_the_bit(fmu, name):
    """Get, go on, set back, go on again; and once more from the copy's bytes in another instance."""
    f = fmu(name)
    outputs = fmi_names(f.model.outputs)
    step = STEPS[name]

    def follow(run, count):
        rows = []
        for k in range(count):
            run.step(0.1 + 0.002 * k, 0.002)
            rows.append(run.get(outputs))
        return np.array(rows)

    with f.instance(True) as run, f.instance(True) as other:
        for r in (run, other):
            r.enter()
            r.raw.exitInitializationMode()
        for k in range(50):
            run.set({n: float(s(0.002 * k)) for n, s in step.items()})
            run.step(0.002 * k, 0.002)
        state = run.copy()
        first = follow(run, 40)
        run.restore(state)
        assert (follow(run, 40) == first).all()
        blob = run.raw.serializeFMUstate(state)
        again = other.raw.deSerializeFMUstate(blob)
        other.restore(again)
        assert (follow(other, 40) == first).all()
        run.raw.freeFMUstate(state)
        other.raw.freeFMUstate(again)


def test_bytes_of_another_model_are_no_state(fmu):
    a, b = fmu("link"), fmu("zoo")
    with a.instance(True) as run, b.instance(True) as other:
        run.enter()
        blob = run.raw.serializeFMUstate(run.copy())
        with pytest.raises(Exception, match="fmi2DeSerializeFMUstate"):
            other.raw.deSerializeFMUstate(blob)
        with pytest.raises(Exception, match="fmi2DeSerializeFMUstate"):
            run.raw.deSerializeFMUstate(blob[: len(blob) // 2])


@pytest.mark.parametrize("name", ["link", "remembering"])
def test_a_reset_instance_runs_as_a_new_one(fmu, name):
    f = fmu(name)
    outputs = list(f.model.outputs)
    with f.instance(True) as run:
        seen = []
        for _ in range(3):
            run.set({"Pref2": 0.7})
            run.enter(stop=0.1)
            run.raw.exitInitializationMode()
            run.set({"Pref2": 0.2})
            for k in range(50):
                run.step(0.002 * k, 0.002)
            seen.append(run.get(outputs))
            run.raw.terminate()
            run.raw.reset()
        assert (seen[0] == seen[1]).all() and (seen[1] == seen[2]).all()
