"""What the tab Explore asks of the package, against the same asked by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.app.desk import opened
from hvdc_ident.app.setting import InputCourse, Setting, effects_with_sizes, near, span_of, with_effects
from hvdc_ident.errors import InputError

LINK = hi.load_model("vsc-hvdc-link")


def test_a_setting_runs_the_model_with_its_values_and_courses() -> None:
    setting = Setting.of(LINK).with_value("KIVDC", 900.0).with_course("Pref2", InputCourse("ramp", 0.4, 0.1, 0.2, 0.3))
    ran = setting.run()
    steps = {"Vdcref1": hi.step(1.0, 1.02, at=0.1), "Pref2": hi.ramp(0.4, 0.5, start=0.2, end=0.5)}
    expected = hi.simulate(LINK, np.linspace(0.0, 1.0, 1001), {"KIVDC": 900.0}, inputs=steps)
    for name in setting.outputs:
        np.testing.assert_allclose(ran[name], expected[name], rtol=1e-9, atol=1e-12)


def test_the_linear_model_stands_at_the_levels_before_the_event() -> None:
    setting = Setting.of(LINK).with_course("Pref2", InputCourse("step", 0.5, 0.2)).with_value("KPVDC", 30.0)
    point = setting.point()
    assert point.outputs["P2"] == pytest.approx(0.5, abs=1e-9)
    expected = hi.linearize(LINK, hi.find_operating_point(LINK, {"Pref2": 0.5}, values={"KPVDC": 30.0}))
    np.testing.assert_allclose(np.sort_complex(setting.poles(point)), np.sort_complex(expected.poles()), rtol=1e-8)


def test_the_margins_are_those_of_the_opened_loop() -> None:
    setting = Setting.of(LINK)
    assert setting.margins(setting.point()) == ""
    opened_at = replace(setting, opened="Irorder1")
    assert opened_at.margins(setting.point()) == str(
        hi.linear.margins(hi.linear.loop(LINK, "Irorder1", setting.point()))
    )


def test_an_impedance_is_seen_at_a_port() -> None:
    dc = hi.linear.Port(source="Iload1", voltage="Vdc1", current="-Iload1")
    setting = replace(Setting.of(LINK), port=dc)
    omega = np.array([1.0, 10.0, 100.0])
    seen = setting.response(setting.point(), omega)
    np.testing.assert_allclose(seen.values, hi.linear.port_impedance(LINK, dc, omega, setting.point()).values)


def test_sensitivities_are_the_derivatives_by_the_parameters() -> None:
    setting = replace(Setting.of(LINK), outputs=("Irorder1",))
    found = setting.sensitivities()["KIVDC"]["Irorder1"]
    h = 1e-4
    up, down = (setting.with_value("KIVDC", 734.7 * (1 + s * h)).run()["Irorder1"] for s in (1, -1))
    assert found == pytest.approx(float(np.sqrt(np.mean(((up - down) / (2 * h)) ** 2))), rel=1e-4)


def test_an_effect_brings_its_size_as_a_parameter_and_takes_it_along() -> None:
    lag = {"effect": "lag", "at": "Ir1", "parameters": {"T": 0.002}}
    setting = with_effects(Setting.of(LINK).with_value("KIVDC", 900.0), [lag])
    (name,) = set(setting.model.parameters) - set(LINK.parameters)
    slower = setting.with_value(name, 0.05)
    change = [
        np.abs(s.run()["Irorder1"] - Setting.of(LINK).with_value("KIVDC", 900.0).run()["Irorder1"]).max()
        for s in (setting, slower)
    ]
    assert 0 < change[0] < change[1]
    assert effects_with_sizes(slower) == [{**lag, "parameters": {"T": 0.05}}]
    without = with_effects(slower, [])
    assert without.model is LINK and dict(without.values) == {"KIVDC": 900.0}


def test_one_of_two_effects_is_taken_out_and_the_other_keeps_its_size() -> None:
    uses = [{"effect": "lag", "at": place, "parameters": {"T": 0.002}} for place in ("Ir1", "Ir2")]
    both = with_effects(Setting.of(LINK), uses).with_value("lag_Ir1_T", 0.01).with_value("lag_Ir2_T", 0.03)
    second = with_effects(both, both.effects[1:])
    assert set(second.model.parameters) - set(LINK.parameters) == {"lag_Ir2_T"} and dict(second.values) == {
        "lag_Ir2_T": 0.03
    }
    alone = with_effects(Setting.of(LINK), [uses[1]]).with_value("lag_Ir2_T", 0.03)
    np.testing.assert_array_equal(second.run()["Irorder1"], alone.run()["Irorder1"])


@pytest.mark.parametrize(
    ("name", "stated", "expected"),
    [("KIVDC", {}, (146.94, 3673.5)), ("KPQ", {}, (-1.0, 1.0)), ("KIVDC", {"KIVDC": (250.0, 1500.0)}, (250.0, 1500.0))],
)
def test_a_slider_spans_what_the_study_states_or_a_factor_of_five(
    name: str, stated: dict[str, tuple[float, float]], expected: tuple[float, float]
) -> None:
    low, high = span_of(LINK, name, stated)
    if name == "KPQ":  # 0 with a lower bound of 0
        assert (low, high) == (0.0, 1.0)
    else:
        assert (low, high) == pytest.approx(expected)


def test_poles_far_from_the_slowest_are_left_out_of_the_picture() -> None:
    poles = np.array([-1.0, -2.0 + 3.0j, -2.0 - 3.0j, -4e4, 0.0])
    assert near(poles).tolist() == [-1.0, -2.0 + 3.0j, -2.0 - 3.0j, 0.0]
    assert near(np.empty(0, complex)).size == 0


def test_a_swing_is_shown_beside_slow_poles_and_an_integrators_rounding() -> None:
    swing = [-1.0 + 14.0j, -1.0 - 14.0j]
    poles = np.array([3e-15, -0.1, *swing, -12.0, -9.0 + 6.0j, -9.0 - 6.0j, -40.0, -2.0 + 90.0j, -2.0 - 90.0j])
    assert near(poles).tolist() == [3e-15, -0.1, *swing, -12.0, -9.0 + 6.0j, -9.0 - 6.0j]


def test_the_response_is_of_what_the_experiment_moves_and_records() -> None:
    t = np.linspace(0.0, 1.0, 11)
    moved = {"Vdcref1": 1.0, "Pref2": hi.step(0.5, 0.6, at=0.3)}
    record = hi.Experiment(t, "test", inputs=moved, outputs={"P2": np.zeros(11)}, values={"Qref1": 0.1})
    setting = Setting.of(LINK, record)
    assert setting.channel == ("Pref2", "P2") and setting.outputs == ("P2",) and setting.end == 1.0
    levels = {"Vdcref1": 1.0, "Pref2": 0.5, "Qref1": 0.1}
    expected = hi.find_operating_point(LINK, levels)
    assert setting.point().outputs["Q1"] == pytest.approx(expected.outputs["Q1"], abs=1e-9)
    point = hi.find_operating_point(LINK, levels, values={"KIP": 60.0})
    changed = hi.bode(
        hi.linearize(LINK, point, values={"KIP": 60.0}, inputs="Pref2", outputs="P2"), np.array([30.0])
    ).values
    faster = setting.with_value("KIP", 60.0)
    np.testing.assert_allclose(faster.response(faster.point(), np.array([30.0])).values, changed, rtol=1e-9)
    assert abs(changed - setting.response(setting.point(), np.array([30.0])).values).max() > 0.01
    assert setting.response_text == "From Pref2 to P2, at the start of test; 0 dB is 1 pu/pu."


def test_sizes_of_effects_are_called_by_what_they_are_of() -> None:
    setting = with_effects(Setting.of(LINK), [{"effect": "lag", "at": ["Ir1", "Ir2"], "parameters": {"T": 0.002}}])
    assert dict(setting.titles) == dict.fromkeys(
        set(setting.model.parameters) - set(LINK.parameters), "T of the lag at Ir1 and Ir2"
    )


def test_a_card_a_study_and_a_shipped_model_are_opened(tmp_path: Path) -> None:
    card = tmp_path / "motor.toml"
    card.write_text(
        'schema = 1\nname = "motor"\n[parameters]\nb = {value = 0.5}\n[inputs]\nv = {value = 0.0}\n[states]\nw = {derivative = "v - b*w"}\n'
        '[outputs]\nw = "w"\n',
        "utf-8",
    )
    assert list(opened(str(card)).model.parameters) == ["b"] and opened(str(card)).study is None
    assert opened().model.name == "vsc-hvdc-link" and opened("vsc-hvdc-avm").model.name == "vsc-hvdc-avm"
    study = tmp_path / "study.toml"
    study.write_text(
        f'schema = 1\nname = "s"\n[model]\nsource = "{card.name}"\n[parameters]\nb = {{start = 0.4, min = 0.1, max = 2}}\n',
        "utf-8",
    )
    desk = opened(str(study))
    assert desk.study is not None and desk.spans["b"] == (0.1, 2.0)
    with pytest.raises(InputError):
        opened(str(tmp_path / "nothing.toml"))


def test_a_study_that_cannot_be_read_says_why_and_is_read_once_it_is_mended(tmp_path: Path) -> None:
    file = tmp_path / "vsc-hvdc-link-study" / "study.toml"
    desk = replace(opened(), file=file)
    assert desk.renewed() is desk
    file.parent.mkdir()
    file.write_text('schema = 1\nname = "s"\n[model]\nsource = "vsc-hvdc-lonk"\n', "utf-8")
    assert "vsc-hvdc-lonk" in desk.renewed().why and desk.renewed().study is None
    file.write_text('schema = 1\nname = "s"\n[model]\nsource = "vsc-hvdc-link"\n', "utf-8")
    assert desk.renewed().study is not None and desk.renewed().why == ""
