"""Stability of models with sampled blocks: against discrete-time closed forms and simulations."""

import numpy as np
import pytest

import hvdc_ident as hi


def loop_of(k, compute, *, delay=False, second=None):
    """x' = k (r - h), h the held value of x, taken every second; a second block adds its part."""
    sampled = {"h": {"value": "x", "period": "1.0", "compute": str(compute)}}
    back = "h"
    if second is not None:
        sampled["g"] = {"value": "x", "period": str(second), "compute": "0.25"}
        back = "0.5*h + 0.5*g"
    delays = {"late": {"of": "x", "time": "0.1"}} if delay else {}
    return hi.Model(
        name="sampled",
        parameters={"k": {"value": k}},
        inputs={"r": 0.0},
        states={"x": "k*e"},
        signals={"e": f"r - ({back})" + (" - 0.1*late" if delay else "")},
        sampled=sampled,
        delays=delays,
        outputs={"x": "x"},
    )


@pytest.mark.parametrize("k", [0.5, 1.9, 1.999, 2.001, 2.5, 3.0])
def test_a_sampled_integrator_is_stable_up_to_two(k):
    """x+ = (1 - k) x; its transfer function without aliases would stand 4.9, and a delay of half a period 3.1."""
    found = hi.linearize(loop_of(k, 0.0)).stability()
    assert (found.verdict, found.unstable) == (("stable", 0) if k < 2 else ("unstable", 1))
    assert abs(np.exp(found.rightmost)) == pytest.approx(abs(1 - k), rel=1e-9)
    assert hi.find_operating_point(loop_of(k, 0.0)).stable == (k < 2)


@pytest.mark.parametrize("k", [0.2, 0.99, 1.01, 1.5])
def test_a_compute_time_of_a_period_halves_that(k):
    """z^2 - z + k = 0."""
    found = hi.linearize(loop_of(k, 1.0)).stability()
    want = np.roots([1.0, -1.0, k])
    assert found.unstable == (np.abs(want) > 1).sum()
    assert abs(np.exp(found.rightmost)) == pytest.approx(np.abs(want).max(), rel=1e-9)


@pytest.mark.parametrize(("k", "second"), [(1.5, 2.0), (2.4, 2.0), (1.2, 1.5), (3.0, 0.5), (4.2, 0.5)])
def test_two_periods_against_the_simulation(k, second):
    model = loop_of(k, 0.0, second=second)
    found = hi.linearize(model).stability()
    t = np.linspace(0.0, 90.0, 9001)
    x = hi.simulate(model, t, inputs={"r": hi.step(0.0, 1.0, at=0.5)})["x"]
    sizes = [np.abs(x[(t > a) & (t < a + 15)] - 1.0).max() for a in (15.0, 60.0)]
    if sizes[1] > 1e-9:
        assert found.rightmost.real == pytest.approx(np.log(sizes[1] / sizes[0]) / 45.0, rel=0.15, abs=0.01)
    assert found.verdict == ("unstable" if sizes[1] > sizes[0] else "stable")


def test_sampled_blocks_beside_a_delay_are_not_judged():
    found = hi.linearize(loop_of(0.5, 0.0, delay=True)).stability()
    assert found.verdict == "not decided" and "beside delays" in found.reason
