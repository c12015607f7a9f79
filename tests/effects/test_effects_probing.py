"""The sizes worth trying: they fit the signal, lie inside the bounds of a refit, and make models that run."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.effects import (
    EffectUse,
    SignalScales,
    admissible_sources,
    apply_effects,
    distance_from_neutral,
    effect_model,
    effects,
    probes,
    resistance_parameters,
)
from hvdc_ident.fit.fit_parameter import FitParameter
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.models import load_model
from hvdc_ident.simulate import simulate
from tests.effects.sizes import NAMES, SIZES, place

LINK = load_model("vsc-hvdc-link")
TIME = np.linspace(0.0, 0.4, 201)
RISE = 0.4 + 0.1 * (1 - np.exp(-np.clip(TIME - 0.1, 0, None) / 0.03))
SIGNAL = SignalScales.of([TIME], [RISE])
OTHER = SignalScales.of([TIME], [1.0 + 0.02 * np.sin(40 * TIME)])


def test_a_signal_is_measured_by_its_range_and_its_quickest_change():
    assert SIGNAL.low == 0.4 and SIGNAL.high == RISE.max() and SIGNAL.rest == 0.4
    assert SIGNAL.fast == pytest.approx(0.05 * 0.03, rel=0.1)  # a twentieth of the time constant
    assert SIGNAL.slow == pytest.approx(0.08)
    assert (SIGNAL.time(0.0), SIGNAL.time(1.0)) == pytest.approx((SIGNAL.fast, SIGNAL.slow))
    step = SignalScales.of([TIME], [np.where(TIME < 0.1, -2.0, 1.0)])
    assert step.fast == pytest.approx(0.001), "half a sampling interval where the signal jumps"
    assert (step.peak, step.range, step.excursion) == (2.0, 3.0, 2e-3)
    still = SignalScales.of([TIME], [np.zeros(TIME.size)])
    assert still.peak == 1.0 and still.range > 0 and still.fast < still.slow
    joined = SignalScales.joined([SIGNAL, step])
    assert (joined.low, joined.high, joined.rest, joined.fast) == (-2.0, 1.0, 2.0, step.fast)


@pytest.mark.parametrize("name", NAMES)
def test_probes_lie_inside_the_bounds_of_their_refit(name):
    effect = effects()[name]
    tried = probes(effect, SIGNAL, OTHER)
    if effect.needs_expression:
        assert tried == ()
        return
    assert 1 <= len(tried) <= 8
    assert len({tuple(p.values.items()) for p in tried}) == len(tried)
    for p in tried:
        assert set(p.values) == set(effect.parameters) and p.free
        assert not effect.is_neutral(p.values)
        assert any(distance_from_neutral(effect, p.values).values())
        for n, (low, high) in p.free.items():
            q = effect.parameters[n]
            assert q.min <= low < p.values[n] < high <= q.max and math.isfinite(high - low)
            scale = q.min >= 0 and q.measure in ("time", "time*R", "rate", "range", "peak", "range/time", "of T2")
            if scale and q.search_factor is None:
                assert FitParameter(n, p.values[n], low, high).log, (
                    "a size of unknown order is searched by its logarithm"
                )


@pytest.mark.parametrize("name", NAMES)
def test_probes_make_models_that_run(name):
    effect = effects()[name]
    case = experiment("case", TIME, {"Pref2": InputSignal.step(0.1, 0.4, 0.5)})
    run = simulate(LINK, case, outputs=("P2_m", "Vdc2"))
    own, source = (SignalScales.of([TIME], [run[n]]) for n in ("P2_m", "Vdc2"))
    for p in probes(effect, own, source)[-1:]:
        use = p.use((place(name, "P2_m"),), "Vdc2" if effect.needs_source else "")
        model = apply_effects(LINK, [use])
        assert set(p.model_names(use)) <= set(model.parameters) - set(LINK.parameters)
        assert {model.parameters[n].value for n in p.model_names(use)} == {p.values[n] for n in p.free}
        assert np.isfinite(simulate(model, case, outputs=("P2",))["P2"]).all()


def test_a_limit_is_tried_above_what_is_there_at_rest():
    levels = [p.values["level"] for p in probes(effects()["limit"], SIGNAL)]
    assert all(SIGNAL.rest < level < SIGNAL.peak for level in levels) and levels == sorted(levels)


def test_frequencies_that_stand_out_are_tried():
    heard = SignalScales.of([TIME], [RISE], tones=(13.0, 50.0))
    tried = probes(effects()["disturbance"], heard)
    assert {round(p.values["frequency"], 9) for p in tried} == {13.0, 50.0}
    for p in tried:
        assert p.free["frequency"] == pytest.approx((p.values["frequency"] / 1.3, p.values["frequency"] * 1.3))


def test_a_loss_is_tried_part_by_part_and_whole():
    free = [tuple(p.free) for p in probes(effects()["loss"], SIGNAL, OTHER)]
    assert free == [("b",), ("c",), ("a", "b", "c")]


def test_a_given_resistance_scales_the_inductance():
    assert (
        resistance_parameters(LINK, "Idc") == ("Rdc",)
        and resistance_parameters(LINK, "P2_m") == ()
        and resistance_parameters(LINK, "Pref2") == ()
    )
    plain, scaled = (probes(effects()["inductance"], SIGNAL, given=g) for g in (None, {"R": 1 / 4096}))
    for a, b in zip(plain, scaled, strict=True):
        assert b.values["L"] == pytest.approx(a.values["L"] / 4096)
    use = scaled[0].use(("Idc",), named={"R": "Rdc"})
    assert list(scaled[0].model_names(use)) == ["inductance_Idc_L"]
    assert set(apply_effects(LINK, [use]).parameters) - set(LINK.parameters) == {"inductance_Idc_L"}


def test_clearance_is_zero_at_neutral_and_only_there():
    catalogue = effects()
    assert distance_from_neutral(catalogue["lead-lag"], {"T1": 0.003, "T2": 0.003}) == {"T1": 0.0}
    assert distance_from_neutral(catalogue["limit"], {"level": 4.0}) == {"level": 0.25}
    assert distance_from_neutral(catalogue["limit"], {"level": math.inf}) == {"level": 0.0}
    assert distance_from_neutral(catalogue["gain"], {"k": 0.75}) == {"k": -0.25}
    assert distance_from_neutral(catalogue["loss"], {"a": 0.0, "b": 0.5, "c": 0.0}) == {"b": 0.5}


@pytest.mark.parametrize("place", ["P2_m", "Pref2", "Ir2", "outputs.P2", "Vac1"])
def test_sources_close_no_circle_and_miss_none(place):
    allowed = admissible_sources(LINK, place)
    for name in (*LINK.inputs, *LINK.signals, *LINK.algebraic, *LINK.states):
        use = EffectUse("conductance", (place,), FrozenMap({"g": 0.1}), source=name)
        if name in allowed:
            apply_effects(LINK, [use])
        elif name != place.removeprefix("outputs."):  # its own signal is a gain
            with pytest.raises(Exception, match="circle"):
                apply_effects(LINK, [use])


def test_alone_it_turns_a_signal_into_what_readers_see():
    model = effect_model(EffectUse("lag", ("P2_m",), FrozenMap(SIZES["lag"])))
    assert tuple(model.inputs) == ("u",) and tuple(model.outputs) == ("y",)
    assert tuple(effect_model(EffectUse("gain", ("u",), FrozenMap({"k": 2.0}))).signals) == ("u_after_gain",)
    with_resistance = effect_model(EffectUse("inductance", ("Idc",), FrozenMap({"L": 0.1, "R": "Rdc"})))
    assert "Rdc" in with_resistance.parameters
