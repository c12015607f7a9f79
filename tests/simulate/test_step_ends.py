"""An output wanted exactly where a step ends."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.model import parse_card
from hvdc_ident.simulate import simulate

CARD = """
schema = 1
name = "lag"
[parameters]
k = {value = 1.0}
[inputs]
u = {value = 0.0}
[states]
x = {derivative = "1 + u - k*x"}
[outputs]
y = "x"
"""


@pytest.mark.parametrize("method", ["explicit", "rosenbrock"])
@pytest.mark.parametrize(("first", "k"), [(0.01, 1.0), (0.02, 0.5)])  # the first step is just as long as this
def test_the_output_there_is_that_of_the_end_of_the_step(method, first, k):
    time = np.array([0.0, first, 2 * first, 1.0])
    step = experiment("step", time, {"u": InputSignal.step(0.0, 0.0, 1.0)})
    found = simulate(parse_card(CARD), step, {"k": k}, ["k"], method=method)
    assert np.allclose(found["y"], (2 - np.exp(-k * time)) / k, atol=1e-7)
    slope = -(2 - np.exp(-k * time)) / k**2 + time * np.exp(-k * time) / k
    assert np.allclose(found.gradient("y")[:, 0], slope, atol=1e-6)
