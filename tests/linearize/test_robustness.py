"""The nu-gap, coprime factor margins, disk margins of several loops and norms, against published numbers."""

import control
import numpy as np
import pytest

from hvdc_ident.effects import apply_effects
from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize import (
    balanced,
    compare,
    find_operating_point,
    hinf_norm,
    linf_norm,
    loop,
    loop_margins,
    margins,
    ncf_margin,
    nu_gap,
    plant_and_controller,
)
from hvdc_ident.linearize.loops import structured_singular_value
from hvdc_ident.linearize.norms import norms
from hvdc_ident.linearize.realisation import difference
from hvdc_ident.models import load_model
from tests.linearize.helpers import linear, stable


def tf(top, bottom):
    g = control.ss(control.tf(top, bottom))
    return linear(g.A, g.B, g.C, g.D)


def gain(value):
    return linear(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[value]])


FAR = tf([100], [2, 1]), tf([100], [2, -1]), tf([100], [1, 2, 1])


@pytest.mark.parametrize(("i", "j", "want"), [(0, 1, 0.02), (0, 2, 0.8988), (1, 2, 0.8941)])
def test_gaps_of_zhou_and_doyle(i, j, want):
    """Essentials of Robust Control, 17.2: 100/(2s + 1), 100/(2s - 1), 100/(s + 1)^2; there the gap is equal."""
    found = nu_gap(FAR[i], FAR[j])
    assert found.value == pytest.approx(want, abs=5e-5) and found.winding == 0
    assert nu_gap(FAR[j], FAR[i]).value == pytest.approx(found.value, abs=1e-9)


def test_hidden_modes_do_not_wind():
    """An integrator that no input reaches, as of an angle reference, belongs to no transfer function."""
    plain = linear([[-1.0]], [[1.0]], [[1.0]])
    hidden = linear(np.diag([-1.0, 0.0, 2.0]), [[1], [0], [0]], [[1, 1, 1]])
    assert nu_gap(plain, hidden).winding == 0
    assert nu_gap(plain, hidden).value < 1e-9


def test_coprime_factor_margins_of_the_robust_control_toolbox():
    """MathWorks, ncfmargin: 4/(s - 0.001) with gains 1 and 10; (s + 2)/(s^2 + 5s + 10) with 4.4/s and its neighbour."""
    unstable = tf([4], [1, -0.001])
    assert ncf_margin(unstable, gain(1.0)).value == pytest.approx(0.7069, abs=5e-5)
    assert ncf_margin(unstable, gain(10.0)).value == pytest.approx(0.0995, abs=5e-5)
    plant, other, integrator = tf([1, 2], [1, 5, 10]), tf([1, 1], [1, 3, 10]), tf([4.4], [1, 0])
    assert ncf_margin(plant, integrator).value == pytest.approx(0.1961, abs=5e-5)
    assert nu_gap(plant, other).value == pytest.approx(0.1391, abs=1e-4)
    # A controller suits every plant nearer than its margin, and its margin falls by no more than the distance.
    assert ncf_margin(other, integrator).value >= ncf_margin(plant, integrator).value - nu_gap(plant, other).value


def test_the_margin_of_a_loop_that_is_not_stable_is_nothing():
    assert ncf_margin(tf([1], [1, -1]), gain(0.5)).value == 0.0
    with pytest.raises(LinearizationError, match="does not fit"):
        ncf_margin(stable(0), gain(1.0))


def test_the_largest_margin_of_an_integrator():
    """1/s has X = Z = 1 and 1/sqrt(2), which unit feedback attains."""
    found = tf([1], [1, 0])
    assert ncf_margin(found).value == pytest.approx(np.sqrt(0.5), rel=1e-12)
    assert ncf_margin(found, gain(1.0)).value == pytest.approx(np.sqrt(0.5), rel=1e-9)


@pytest.mark.parametrize("side", ["output", "input"])
def test_disk_margins_of_the_spinning_satellite(side):
    """MathWorks, diskmargin: each loop alone 2, both at once between 0.3754 and 0.3762 at 0 rad/s."""
    a, c, k = np.array([[0, 10], [-10, 0]]), np.array([[1, 10], [-10, 1]]), np.array([[1, -2], [0, 1]])
    model = linear(a, k, c) if side == "output" else linear(a, np.eye(2), k @ c)
    found = loop_margins(model)
    assert [m.disk.value for m in found.each.values()] == pytest.approx([2.0, 2.0], abs=1e-3)
    assert 0.3754 <= found.disk.value <= 0.3762 and found.disk.omega < 1e-3
    assert found.disk_phase == pytest.approx(21.26, abs=0.05)


def test_disk_margin_of_one_loop_of_seiler_packard_and_gahinet():
    """An Introduction to Disk Margins, 25/(s^3 + 10 s^2 + 10 s + 10): 0.46, gains 0.6273 to 1.5942."""
    found = margins(tf([25], [1, 10, 10, 10]))
    assert found.disk.value == pytest.approx(0.46, abs=5e-3)
    assert (1 / found.disk_gain, found.disk_gain) == pytest.approx((0.6273, 1.5942), abs=5e-5)
    assert found.disk.omega == pytest.approx(1.94, abs=0.03)


@pytest.mark.parametrize("seed", range(4))
def test_the_structured_singular_value_is_attained(seed):
    """For up to three factors the bound is mu: the largest spectral radius over factors of size 1."""
    rng = np.random.default_rng(seed)
    n = 2 + seed % 2
    m = rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n))
    angles = np.linspace(0, 2 * np.pi, 181)
    turns = np.stack(np.meshgrid(*[angles] * (n - 1), indexing="ij"), axis=-1).reshape(-1, n - 1)
    factors = np.exp(1j * np.concatenate([np.zeros((len(turns), 1)), turns], axis=1))
    attained = np.abs(np.linalg.eigvals(factors[:, :, None] * m)).max()
    assert attained <= structured_singular_value(m) * (1 + 1e-9)
    assert structured_singular_value(m) == pytest.approx(attained, rel=2e-3)


def test_a_coupling_that_goes_one_way_is_scaled_away():
    assert structured_singular_value(np.array([[0.5, 30.0], [0.0, 0.25]])) == pytest.approx(0.5)


def test_loops_of_the_link_opened_together_are_those_opened_alone():
    link = load_model("vsc-hvdc-link")
    point = find_operating_point(link)
    both = loop_margins(loop(link, ["Irorder1", "Irorder2"], point))
    for name, found in both.each.items():
        alone = margins(loop(link, name, point))
        assert found.phase_margin.value == pytest.approx(alone.phase_margin.value, rel=1e-6)
        assert found.disk.value == pytest.approx(alone.disk.value, rel=1e-6)
    assert both.stable and both.disk.value <= min(m.disk.value for m in both.each.values()) * (1 + 1e-6)
    np.testing.assert_allclose(
        np.sort_complex(loop(link, ["Irorder1", "Irorder2"], point).closed_poles())[:4],
        np.sort_complex(loop(link, "Irorder1", point).closed_poles())[:4],
        rtol=1e-6, atol=1e-6,
    )  # fmt: skip


def test_plant_and_controller_of_the_link():
    """The dc-voltage controller is KPVDC + KIVDC/s behind its measurement, and closes the loop that `loop` opens."""
    link = load_model("vsc-hvdc-link")
    plant, controller = plant_and_controller(link, ["Irorder1"], ["Vdc1_m"])
    w = np.array([3.0, 30.0, 300.0])
    own = controller.response(w)[:, 0, 0]
    np.testing.assert_allclose(np.abs(own), np.abs(24.0 + 734.7 / (1j * w)), rtol=1e-9)
    whole = loop(link, "Irorder1").open.response(w)[:, 0, 0]
    np.testing.assert_allclose(plant.response(w)[:, 0, 0] * own, whole, rtol=1e-9)
    assert 0 < ncf_margin(plant, controller).value < ncf_margin(plant).value
    with pytest.raises(LinearizationError, match="does not part"):
        plant_and_controller(link, ["Irorder1"], ["Vdc1"])


def test_the_l_infinity_norm_needs_no_stability():
    """All-pass times 5: the peak of 1/(s^2 -+ 0.2 s + 4) is at the same place for either sign."""
    unstable, damped = tf([1, 0], [1, -0.2, 4]), tf([1, 0], [1, 0.2, 4])
    assert linf_norm(unstable).value == pytest.approx(hinf_norm(damped).value, rel=1e-9) == pytest.approx(5.0)
    assert linf_norm(unstable).omega == pytest.approx(2.0, rel=1e-6)
    with pytest.raises(LinearizationError, match="imaginary axis"):
        linf_norm(tf([1], [1, 0, 4]))
    found = norms(unstable)
    assert found["hinf"] is None and "unstable" in found["hinf_reason"] and found["linf"]["value"] == pytest.approx(5.0)


@pytest.mark.parametrize("match_dc", [False, True])
@pytest.mark.parametrize("order", [2, 3, 5])
def test_balanced_reduction_matches_the_dc_gain_and_keeps_what_is_not_stable(order, match_dc):
    whole = stable(7, n=6)
    a = np.block([[np.array([[0.4]]), np.full((1, 6), 0.3)], [np.zeros((6, 1)), whole.A]])
    model = linear(a, np.vstack([[[1.0, 0.5]], whole.B]), np.hstack([[[1.0], [2.0]], whole.C]))
    found = balanced(model, order, match_dc=match_dc)
    assert found.kept == 1 and len(found.model.state_names) == order
    assert found.model.poles().real.max() == pytest.approx(0.4)
    assert linf_norm(difference(model, found.model)).value <= found.bound * (1 + 1e-6)
    at_rest = np.abs(found.model.response([0.0]) - model.response([0.0])).max()
    assert (at_rest < 1e-9) == match_dc


def test_an_integrator_stays_and_the_error_is_that_of_the_rest():
    """Model minus reduced model has the integrator twice, which cancels only but for rounding."""
    rest = stable(11, n=4, m=1, o=1)
    model = linear(
        np.block([[rest.A, np.zeros((4, 1))], [np.ones((1, 4)), np.zeros((1, 1))]]),
        np.vstack([rest.B, [[1.0]]]), np.hstack([rest.C, [[1.0]]]),
    )  # fmt: skip
    found = balanced(model, 3)
    assert found.kept == 1 and found.error.value <= found.bound * (1 + 1e-9)
    w = np.logspace(-2, 3, 2001)
    apart = np.abs(model.response(w) - found.model.response(w)).max()
    assert apart == pytest.approx(found.error.value, rel=1e-2)


def test_balanced_reduction_against_python_control():
    """Its `model_reduction` with matched dc gain, of the balanced model itself: the states are the last ones."""
    model = stable(3, n=4, m=1, o=1)
    full = balanced(model, 4).model.to_control()
    want = control.model_reduction(full, elim_states=[2, 3], method="matchdc")
    found = balanced(model, 2, match_dc=True).model
    w = np.logspace(-2, 2, 9)
    np.testing.assert_allclose(found.response(w)[:, 0, 0], np.squeeze(want(1j * w)), rtol=1e-8)


def test_scaled_channels_count_in_other_units():
    model = stable(2).scaled({"u0": 10.0, "y1": 0.5})
    w = np.array([0.3, 4.0])
    np.testing.assert_allclose(model.response(w), stable(2).response(w) * np.array([[10, 1], [20, 2]]), rtol=1e-12)
    delayed = apply_effects(
        load_model("vsc-hvdc-link"), [{"effect": "delay", "at": ["Irorder1"], "parameters": {"T": 0.002}}]
    )
    from hvdc_ident.linearize import linearize

    plain = linearize(delayed, inputs="Vdcref1", outputs="Vdc1")
    np.testing.assert_allclose(plain.scaled({"Vdc1": 0.01}).response(w), 100 * plain.response(w), rtol=1e-12)


def test_a_comparison_says_what_it_found():
    first, second = tf([1, 2], [1, 5, 10]), tf([1, 1], [1, 3, 10])
    found = compare(first, second)
    assert found.nu_gap.value == pytest.approx(0.1391, abs=1e-4)
    assert found.difference.value == pytest.approx(linf_norm(difference(first, second)).value)
    assert "nu-gap 0.139" in str(found) and found.to_dict()["winding"] == 0
    with pytest.raises(LinearizationError, match="other inputs"):
        compare(first, stable(0))


# --- trimming ---


def test_trimmed_points_free_the_inputs_that_set_the_outputs():
    link = load_model("vsc-hvdc-link")
    both = find_operating_point(link, inputs={"E1": 1.02}, outputs={"P2": 0.5, "Q2": 0.1})
    assert (both.outputs["P2"], both.outputs["Q2"]) == pytest.approx((0.5, 0.1))
    assert both.inputs["E1"] == 1.02 and both.inputs["Pref2"] == pytest.approx(0.5)
    chosen = find_operating_point(link, outputs={"P1": 0.3}, free=["Pref2"])
    assert chosen.outputs["P1"] == pytest.approx(0.3)


def test_a_trim_that_several_inputs_could_make_asks_which():
    from hvdc_ident.errors import SteadyStateError, UnknownNameError

    link = load_model("vsc-hvdc-link")
    with pytest.raises(SteadyStateError, match=r"Pref2 moves P1 by -1.*free=\['Iload1'\]|free=\['Pref2'\]"):
        find_operating_point(link, outputs={"P1": 0.3})
    with pytest.raises(UnknownNameError):
        find_operating_point(link, inputs={"P2": 0.5})


@pytest.mark.parametrize(
    "asked, rule", [(("torque", "w"), "d(w) = 0.4 d(torque)"), (("w", "i", "sum"), "d(sum) = d(w) - d(i)")]
)
def test_outputs_that_one_input_moves_together_are_named_with_what_to_leave_out(asked, rule):
    """At rest b w = torque, whatever the voltage; and `sum` is made of two others that two inputs set freely."""
    from hvdc_ident import Model
    from hvdc_ident.errors import SteadyStateError

    motor = Model(
        name="motor",
        parameters={"b": 2.5, "k": 0.5, "R": 1.0},
        inputs={"v": 1.0, "load": 0.0},
        states={"w": "k*i - b*w - load"},
        signals={"i": "(v - k*w)/R"},
        outputs={"w": "w", "i": "i", "torque": "k*i - load", "sum": "w - i"},
    )
    with pytest.raises(SteadyStateError) as refused:
        find_operating_point(motor, outputs=dict.fromkeys(asked, 0.1))
    message = str(refused.value)
    assert rule in message.replace("1 d(", "d(") and "cannot all be set" in message
    assert "leave out " in message and all(name in message.split("leave out ")[1] for name in asked)
    # What is left can be set.
    found = find_operating_point(motor, outputs={"w": 0.1, "i": 0.3})
    assert (found.outputs["w"], found.outputs["i"]) == pytest.approx((0.1, 0.3))
