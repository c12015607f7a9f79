"""Effects at the ends of an FMU against the same effects on the same model written in equations."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident import simulate
from hvdc_ident.data import InputSignal, Trajectory, experiment
from hvdc_ident.discrepancy import diagnose
from hvdc_ident.discrepancy.candidates import candidates
from hvdc_ident.effects import apply_effects
from hvdc_ident.errors import ModelError, UnknownNameError
from hvdc_ident.fit import FitParameter
from hvdc_ident.fmu import Limits
from hvdc_ident.immutable import FrozenMap
from tests.fmu.c_fmu import needs_compiler
from tests.fmu.c_models import DECAY, FAULTY, TWIN, spring

pytestmark = needs_compiler

TIME = np.linspace(0.0, 4.0, 201)
RUN = experiment("run", TIME, {"u": InputSignal.corners([(0, 0.0), (1, 0.0), (1, 1.0), (2, 1.0), (2.5, -0.5)])})
CASES = [
    ([{"effect": "lag", "at": "u", "parameters": {"T": 0.2}}], ["lag_u_T"]),
    ([{"effect": "lag", "at": "y", "parameters": {"T": 0.2}}], ["lag_y_T"]),
    ([{"effect": "gain", "at": "y", "parameters": {"k": 1.1}}], ["gain_y_k"]),
    ([{"effect": "offset", "at": "u", "parameters": {"c": 0.1}}], ["offset_u_c"]),
    ([{"effect": "delay", "at": "u", "parameters": {"T": 0.13}}], ["delay_u_T"]),
    ([{"effect": "delay", "at": ["y", "twice"], "parameters": {"T": 0.13}}], ["delay_y_T"]),
    ([{"effect": "limit", "at": "u", "parameters": {"level": 0.6}}], ["limit_u_level"]),
    ([{"effect": "second-order", "at": "y", "parameters": {"wn": 20.0, "zeta": 0.5}}], ["second_order_y_wn"]),
    ([{"effect": "window-mean", "at": "y", "parameters": {"T": 0.1}}], ["window_mean_y_T"]),
    (
        [
            {"effect": "lag", "at": ["u", "y"], "parameters": {"T": 0.1}},
            {"effect": "gain", "at": "twice", "parameters": {"k": 0.9}},
        ],
        ["lag_u_T", "gain_twice_k"],
    ),
    ([{"effect": "sample-hold", "at": "u", "parameters": {"Ts": 0.11, "compute": 0.03}}], ["sample_hold_u_Ts"]),
    ([{"effect": "sample-hold", "at": "y", "parameters": {"Ts": 0.11, "compute": 0.03}}], ["sample_hold_y_Ts"]),
    ([{"effect": "backlash", "at": "u", "parameters": {"width": 0.2}}], ["backlash_u_width"]),
    ([{"effect": "backlash", "at": "y", "parameters": {"width": 0.2}}], ["backlash_y_width"]),
    ([{"effect": "rate-limit", "at": "u", "parameters": {"rate": 1.5}}], ["rate_limit_u_rate"]),
    ([{"effect": "rate-limit", "at": "y", "parameters": {"rate": 1.5}}], ["rate_limit_y_rate"]),
    ([{"effect": "quantisation", "at": "u", "parameters": {"step": 0.3}}], ["quantisation_u_step"]),
    ([{"effect": "quantisation", "at": "y", "parameters": {"step": 0.3}}], ["quantisation_y_step"]),
    ([{"effect": "coupling", "at": "y", "from": "twice", "parameters": {"k": 0.3}}], ["coupling_y_k"]),
    (
        [{"effect": "coupling", "at": ["y", "twice"], "from": ["twice", "y"], "parameters": {"k": 0.3}}],
        ["coupling_y_k"],
    ),
    ([{"effect": "term", "at": "u", "expression": "c*u**2", "parameters": {"c": 0.3}}], ["term_u_c"]),
]
EDGES = {"sample_hold_u_Ts": {"twice"}}
"""Outputs of which a sample's move moves a corner: the derivative there is one-sided, and rows see either side."""


@pytest.mark.parametrize(
    ("uses", "names"), CASES, ids=lambda c: "+".join(x["effect"] for x in c) if isinstance(c[0], dict) else ""
)
def test_runs_and_derivatives_agree_with_the_twin(fmu, uses, names):
    model, twin = apply_effects(fmu(spring()), uses), apply_effects(TWIN, uses)
    assert [n for n in model.parameters if n not in TWIN.parameters] == names[:1] + [
        n for n in twin.parameters if n not in TWIN.parameters
    ][1:]
    # A play lets go where its signal turns, and lags it by so little before that only tight tolerances see when.
    rtol = 1e-10 if any(u["effect"] == "backlash" for u in uses) else None
    found = simulate(model, RUN, {"d": 0.6}, ["k", *names], rtol=rtol)
    wanted = simulate(twin, RUN, {"d": 0.6}, ["k", *names], rtol=1e-10)
    for output in ("y", "twice"):
        scale = np.ptp(wanted[output])
        assert np.abs(found[output] - wanted[output]).max() < 2e-4 * scale
        for j, name in enumerate(["k", *names]):
            if output in EDGES.get(name, ()):
                continue
            a, b = found.gradient(output)[:, j], wanted.gradient(output)[:, j]
            # 2e-6 of the range: what 1e-8 of it, the run's noise, leaves of a difference where the derivative is 0
            assert np.sqrt(np.mean((a - b) ** 2)) < 5e-3 * np.sqrt(np.mean(b**2)) + 2e-6 * scale, name


@pytest.mark.parametrize("interface", ["model-exchange", "co-simulation"])
def test_a_delay_that_moves_a_jump_over_a_row_has_no_jump_in_its_derivative(fmu, interface):
    delay = [
        {"effect": "delay", "at": "u", "parameters": {"T": 0.1205}}
    ]  # at 1.12 s and 2.12 s, within a hundredth, rows
    stairs = RUN.with_(inputs={"u": InputSignal.corners([(0, 0.0), (1, 0.0), (1, 1.0), (2, 1.0), (2, -0.5)])})
    model = apply_effects(fmu(spring(), 2, interface), delay)
    found = simulate(model, stairs, {}, ["delay_u_T"], outputs=["der(v)"]).gradient("der(v)")[:, 0]
    wanted = simulate(apply_effects(TWIN, delay), stairs, {}, ["delay_u_T"], rtol=1e-10)
    y, twice = (wanted.gradient(o)[:, 0] for o in ("y", "twice"))
    exact = (-0.5 * twice / 2 - 8.0 * y) / 2.0  # of m v' = k u - d v - k x where u stands
    assert np.ptp(exact) > 10.0
    assert np.abs(found - exact).max() < 5e-3 * np.ptp(exact)


def test_effects_cost_one_run_a_parameter_once_the_steps_are_known_and_none_where_the_fmu_sees_no_change(fmu):
    uses = [
        {"effect": "lag", "at": "u", "parameters": {"T": 0.1}},
        {"effect": "gain", "at": "y", "parameters": {"k": 1.1}},
    ]
    model = apply_effects(fmu(spring(own=False), limits=Limits(workers=1)), uses)  # two would both run the FMU itself

    def runs(**values: float) -> int:
        before = model.pool.runs
        simulate(model, RUN, values, ["k", "lag_u_T", "gain_y_k"])
        return model.pool.runs - before

    runs()
    assert runs(lag_u_T=0.12) == 3  # itself, k, and T
    assert runs(lag_u_T=0.12, gain_y_k=1.2) == 0
    assert runs(lag_u_T=0.12, gain_y_k=1.2, k=8.1) == 3


def test_a_term_and_a_droop_read_the_outputs_under_the_names_of_the_fmu(fmu):
    plain = simulate(fmu(spring()), RUN)
    y, twice = plain["y"], plain["twice"]
    term = {"effect": "term", "at": "twice", "expression": "c*y*abs(twice)", "parameters": {"c": 0.3}}
    assert simulate(apply_effects(fmu(spring()), [term]), RUN)["twice"] == pytest.approx(
        twice + 0.3 * y * np.abs(twice), abs=1e-5
    )
    droop = {"effect": "droop", "at": "outputs.y", "from": "outputs.twice", "parameters": {"k": 0.2}}
    found = simulate(apply_effects(fmu(spring()), [droop]), RUN)["y"]
    assert found == pytest.approx(y - 0.2 * (twice - twice[0]), abs=1e-5)


def test_what_is_looked_for_at_the_ends_can_sit_there(fmu):
    model = fmu(spring())
    run = simulate(model, RUN)
    signals = {"u": (RUN.inputs["u"](TIME),), "y": (run["y"],), "twice": (run["twice"],)}
    found = [c for c in candidates(model, signals, [TIME], "all", None) if c.source]
    assert {(c.at, c.source) for c in found} == {(("y",), "twice"), (("twice",), "y")}
    for c in found:
        apply_effects(model, [c.use(c.probes[0])])


REFUSED = [
    ({"at": "u", "from": "y"}, "input that reads the output 'y' would close a loop around the FMU.*inputs: u"),
    ({"at": ["y", "u"], "from": "twice"}, "input that reads the output 'twice' would close a loop"),
    ({"at": "y", "from": "u"}, "output cannot read the input 'u'.*outputs: y, twice"),
    ({"at": "y", "from": "x"}, "closed inside.*no signal 'x'.*y, twice"),
    ({"effect": "term", "at": "u", "expression": "k*y", "parameters": {"k": 1.0}}, "expression: .*loop around"),
    ({"effect": "term", "at": "y", "expression": "k*u0", "parameters": {"k": 1.0}}, "no signal 'u0'"),
    ({"effect": "gain", "at": "y", "from": "twice", "parameters": {"k": 1.1}}, "at y: .*brings no other signal in"),
    ({"at": "y"}, "effect 'coupling' at y: the effect needs another signal"),
    ({"at": "y", "from": "twice", "parameters": {"k": "d"}}, "cannot share a parameter.*a number, got 'd'"),
]


@pytest.mark.parametrize(("use", "message"), REFUSED)
def test_what_an_effect_at_an_end_cannot_see_is_refused_in_the_names_of_the_fmu(fmu, use, message):
    with pytest.raises((ModelError, UnknownNameError), match=message):
        apply_effects(fmu(spring()), [{"effect": "coupling", "parameters": {"k": 0.3}, **use}])


def test_a_recording_chain_is_an_effect_at_the_output(fmu):
    chain = RUN.with_(instrument=FrozenMap({"y": FrozenMap({"window-mean": 0.1, "delay": 0.02})}))
    found, wanted = simulate(fmu(spring()), chain), simulate(TWIN, chain)
    assert np.abs(found["y"] - wanted["y"]).max() < 2e-4
    assert np.abs(found["twice"] - wanted["twice"]).max() < 1e-6


def test_an_offset_of_an_input_and_its_derivative(fmu):
    moved = RUN.with_(offsets=FrozenMap({"u": 0.05}))
    for interface in ("model-exchange", "co-simulation"):
        found, wanted = simulate(fmu(spring(), 2, interface), moved, {}, ["u"]), simulate(TWIN, moved, {}, ["u"])
        assert np.abs(found["y"] - wanted["y"]).max() < 3e-4  # co-simulation holds a ramp's mean over a row
        assert np.abs(found.gradient("y") - wanted.gradient("y")).max() < 1e-4


@pytest.mark.parametrize("own", [True, False])
def test_the_derivative_by_an_input_passes_through_the_effect_at_it(fmu, own):
    """Once: as a direction of the signals that enter, not as a constant added to them too."""
    lag = [{"effect": "lag", "at": "u", "parameters": {"T": 0.1}}]
    wanted = simulate(apply_effects(TWIN, lag), RUN, {}, ["u"]).gradient("y")
    for interface in ("model-exchange", "co-simulation"):
        plain = fmu(spring("spring" if own else "plain_spring", own), 2, interface)
        simulate(plain, RUN, {}, ["u"])  # confirms directional derivatives by the input itself
        found = simulate(apply_effects(plain, lag), RUN, {}, ["u"]).gradient("y")
        assert np.abs(found - wanted).max() < 5e-3 * np.abs(wanted).max()


def test_neutral_effects_leave_the_model_as_it_is(fmu):
    model = fmu(spring())
    assert apply_effects(model, [{"effect": "lag", "at": "u", "parameters": {"T": 0.0}}]) is model


def test_two_of_a_kind_have_names_of_their_own(fmu):
    twice = [{"effect": "gain", "at": "y", "parameters": {"k": 1.1}}] * 2
    model = apply_effects(fmu(spring()), twice)
    assert [n for n in model.parameters if n.startswith("gain")] == ["gain_y_k", "gain_y_2_k"]
    plain = simulate(fmu(spring()), RUN)["y"]
    assert simulate(model, RUN)["y"] == pytest.approx(1.21 * plain, abs=1e-5)


def test_places_that_are_none(fmu):
    with pytest.raises(UnknownNameError, match="closed inside: no insertion point 'x'"):
        apply_effects(fmu(FAULTY), [{"effect": "lag", "at": "x"}])
    with pytest.raises(UnknownNameError, match="no effect 'lagg'"):
        apply_effects(fmu(spring()), [{"effect": "lagg", "at": "y"}])
    with pytest.raises((ModelError, UnknownNameError)):
        apply_effects(fmu(spring()), [{"effect": "lag", "at": "y", "parameters": {"TT": 1.0}}])


@pytest.mark.parametrize("interface", ["model-exchange", "co-simulation"])
def test_effects_at_the_outputs_of_an_fmu_without_inputs(fmu, interface):
    """y = exp(-a t), through a lag T that begins at rest at y(0), and a gain k after it: in closed form."""
    plain, time, a, lag = fmu(DECAY, 2, interface), np.linspace(0.0, 4.0, 201), 1.5, 0.2
    assert plain.insertion_points == ("y",) and not plain.inputs
    uses = [
        {"effect": "lag", "at": "y", "parameters": {"T": lag}},
        {"effect": "gain", "at": "y", "parameters": {"k": 1.3}},
    ]
    model = apply_effects(plain, uses)

    def wanted(a, lag):
        share = 1.0 / (1.0 - a * lag)
        return 1.3 * ((1.0 - share) * np.exp(-time / lag) + share * np.exp(-a * time))

    names = ["a", "lag_y_T", "gain_y_k"]
    run = simulate(model, experiment("free", time), {"a": a}, names)
    assert np.abs(run["y"] - wanted(a, lag)).max() < 1e-5
    h = 1e-5
    columns = [
        (wanted(a + h, lag) - wanted(a - h, lag)) / (2 * h),
        (wanted(a, lag + h) - wanted(a, lag - h)) / (2 * h),
        wanted(a, lag) / 1.3,
    ]
    for j, column in enumerate(columns):
        assert np.abs(run.gradient("y")[:, j] - column).max() < 1e-3, names[j]
    with pytest.raises(UnknownNameError, match="no insertion point 'u'"):
        apply_effects(plain, [{"effect": "lag", "at": "u", "parameters": {"T": lag}}])


def test_an_effect_at_the_output_of_an_fmu_without_inputs_is_named(fmu):
    """The record decays with a = 1.5 from 1.3 instead of 1: a gain of 1.3, with the parameter of the decay free."""
    time = np.linspace(0.0, 4.0, 101)
    y = 1.3 * np.exp(-1.5 * time) + 1e-3 * np.random.default_rng(2).standard_normal(time.size)
    record = experiment("e", time, measured=Trajectory(time, y[:, None], ("y",), ("",)), noise={"y": 1e-3}, event=0.0)
    free = [FitParameter("a", 1.0, 0.1, 5.0)]
    found = diagnose(fmu(DECAY, 2, "model-exchange"), [record], free, effects=["gain", "lag"])
    assert found.verdict == "named"
    (effect,) = found.effects
    assert effect.effect == "gain" and effect.parameters["k"].value == pytest.approx(1.3, abs=5e-3)
