"""Zeros of models with delays against closed forms."""

import numpy as np
import pytest
from scipy.special import lambertw

import hvdc_ident as hi
from hvdc_ident.linearize import LinearModel


def zeros_of(model, **channel):
    found = hi.linearize(model, **channel).zeros()
    return found[np.lexsort((found.imag, np.abs(found).round(9)))]


def near(found, reach):
    return found[np.abs(found) < reach]


def lag(outputs, delays, states=None):
    return hi.Model("lag", inputs={"u": 0.0}, states=states or {"x": "u - x"}, delays=delays, outputs=outputs)


@pytest.mark.parametrize("late", [0.001, 0.1, 2.0])
def test_a_delay_in_a_loop_adds_no_zeros_to_those_of_the_controller(late):
    """From set-point to output, PID and plant with a delay: the zeros of the PID, whatever the delay."""
    gain, ti, td, filter_ = 1.2, 1.0, 0.25, 0.01
    model = hi.Model(
        "loop",
        inputs={"r": 0.0},
        signals={"e": "r - y1", "up": f"{gain}*(e + xi/{ti}) + {gain * td}*(e - xd)/{filter_}"},
        delays={"ud": {"of": "up", "time": str(late)}},
        states={"xi": "e", "xd": f"(e - xd)/{filter_}", "y1": "y2", "y2": "3.6*ud - 1.2*y2 - 4*y1"},
        outputs={"y": "y1"},
    )
    pid = np.roots(np.polyadd(np.polymul([1, 1 / ti], [filter_, 1]), [td, 0, 0]))
    found = zeros_of(model, inputs="r", outputs="y")
    np.testing.assert_allclose(found, pid[np.argsort(pid.imag)], rtol=1e-9)


@pytest.mark.parametrize("share", [0.5, 2.0, -0.3])
@pytest.mark.parametrize("late", [1e-3, 0.5])
def test_an_echo_has_a_chain_of_zeros(share, late):
    """y = x - a x(t - T): 1 = a exp(-s T), s = (ln a + 2 pi j k)/T."""
    model = lag({"y": f"x - ({share})*late"}, {"late": {"of": "x", "time": str(late)}})
    chain = (np.log(complex(share)) + 2j * np.pi * np.arange(-3, 4)) / late
    found, want = near(zeros_of(model), 5.0 / late), near(chain, 5.0 / late)
    assert found.size == want.size > 0
    assert max(np.abs(found - w).min() for w in want) < 1e-9 / late


def test_zeros_of_a_state_less_its_past_are_those_of_lambert():
    """y = z + x(t - T) with z' = x - 3 z: 1 + (s + 3) exp(-s T) = 0, s = -3 - W(T exp(3 T)... )/T."""
    late = 0.5
    model = lag({"y": "z + late"}, {"late": {"of": "x", "time": str(late)}}, {"x": "u - x", "z": "x - 3*z"})
    # (s + 3) exp(-s T) = -1: with v = -(s + 3) T, v exp(v) = T exp(-3 T), so s = -3 - W(T exp(-3 T))/T.
    branches = np.array([-3 - lambertw(late * np.exp(-3 * late), k) / late for k in range(-6, 7)])
    found, want = near(zeros_of(model), 10.0), near(branches, 10.0)
    assert found.size == want.size > 1
    assert max(np.abs(found - w).min() for w in want) < 1e-9


def test_a_pure_delay_has_no_zeros_and_a_mean_those_of_its_length():
    """exp(-s T)/(s + 1) has none; the mean over T, (1 - exp(-s T))/(s T), has 2 pi j k/T but 0."""
    assert not zeros_of(lag({"y": "x"}, {"ud": {"of": "u", "time": "0.3"}}, {"x": "ud - x"})).size
    mean = lag({"y": "m"}, {"xd": {"of": "x", "time": "0.5"}}, {"x": "u - x", "m": "(x - xd)/0.5"})
    # The state m keeps what it starts with, beside its mean: a hidden mode at 0 is a zero of the whole, and the mean has none there.
    found = near(zeros_of(mean), 14.0)
    np.testing.assert_allclose(found, [0.0, -4j * np.pi, 4j * np.pi], atol=1e-7)


def test_only_common_zeros_of_several_outputs_count():
    """(s + 4)/((s + 1)(s + 3)) behind a delay at two outputs of the same signal: -4; at outputs of others: none."""
    states = {"x": "ud - x", "z": "x - 3*z"}
    late = {"ud": {"of": "u", "time": "0.5"}}
    np.testing.assert_allclose(zeros_of(lag({"y": "x + z", "w": "2*x + 2*z"}, late, states)), [-4.0], rtol=1e-9)
    assert not zeros_of(lag({"y": "x + z", "w": "x - z"}, late, states)).size
    assert not zeros_of(lag({"y": "0*x"}, late, states)).size


def test_zeros_of_two_inputs_and_two_outputs_are_those_of_the_determinant():
    """[1/(s+1), e^-sT/(s+1); 1/(s+2), 1/(s+2)] has the determinant (1 - e^-sT)/((s+1)(s+2)): 2 pi j k/T, 0 among them."""
    model = hi.Model(
        "two",
        inputs={"u": 0.0, "v": 0.0},
        states={"x": "u + late - x", "z": "u + v - 2*z"},
        delays={"late": {"of": "v", "time": "0.5"}},
        outputs={"y": "x", "w": "z"},
    )
    np.testing.assert_allclose(near(zeros_of(model), 14.0), [0.0, -4j * np.pi, 4j * np.pi], atol=1e-9)


def test_what_stands_as_an_approximant_is_marked():
    model = lag({"y": "x"}, {"ud": {"of": "u", "time": "0.3"}}, {"x": "ud - x"})
    found = hi.linearize(model)
    transfer = found.transfer_function()
    assert transfer.approximated == ("ud",) and transfer.zeros.size
    assert transfer.from_dict(transfer.to_dict()).approximated == ("ud",)
    assert LinearModel.from_dict(found.to_dict()).zeros().size == transfer.zeros.size
    assert hi.linearize(lag({"y": "x"}, {})).transfer_function().approximated == ()
