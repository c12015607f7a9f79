"""Effects that parameters may stand for, and places that imply other values of the parameters.

Records are made here from closed forms, or by scipy from transfer functions; what they should say follows from algebra.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import lsim

from hvdc_ident import Experiment, InputSignal, Trajectory
from hvdc_ident.data import Array
from hvdc_ident.discrepancy import Diagnosis, diagnose
from hvdc_ident.discrepancy.options import CERTAIN
from hvdc_ident.discrepancy.result import EffectSize
from hvdc_ident.discrepancy.score import apart, nearest
from hvdc_ident.fit import FitParameter
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import parse_card


def stepped(time: Array, steps: Sequence[tuple[float, float]]) -> tuple[InputSignal, Array]:
    """An input that jumps by so much at each time, as a signal and at the rows."""
    points, level, rows = [(0.0, 0.0)], 0.0, np.zeros(time.size)
    for t, change in steps:
        points += [(t, level), (t, level + change)]
        level += change
        rows[time >= t] = level
    return InputSignal.corners(points), rows


def record(time: Array, inputs: dict[str, InputSignal], outputs: dict[str, Array], noise: float) -> Experiment:
    random = np.random.default_rng(3)
    values = np.column_stack([y + noise * random.standard_normal(time.size) for y in outputs.values()])
    measured = Trajectory(time, values, tuple(outputs), ("",) * len(outputs))
    told = FrozenMap(dict.fromkeys(outputs, noise))
    return Experiment(time, "steps", inputs=FrozenMap(inputs), measured=measured, noise=told, event=1.0, role="fit")


ROOM = """
schema = 1
name = "heated-room"
[parameters]
G = {value = 2.0, unit = "W/K", min = 0.1}
C = {value = 0.01, unit = "J/K"}
B = {value = 0.01, unit = "W/K"}
[inputs]
heat = {value = 0.0}
outside = {value = 0.0}
[states]
T = {derivative = "(heat - G*T + B*outside)/C", guess = 0.0}
[outputs]
T = "T"
"""


def test_an_effect_that_a_parameter_takes_up_nearly_all_of_is_told_with_its_own_values() -> None:
    """The heat is 0.8 of what is recorded. A conductance of 2.5 instead of 2 takes up all of that but its part in what comes from
    outside, and with 1.25 times that from outside it explains the records as well: 0.8/2 is 1/2.5, and 1/2 is 1.25/2.5."""
    time = np.round(np.arange(240) * 0.1, 9)
    heat, p = stepped(time, [(1.0, 4.0), (7.0, -2.5), (13.0, 3.0)])
    outside, cold = stepped(time, [(4.0, 6.0), (10.0, -9.0), (17.0, 5.0)])

    def settled(g: float, of_heat: float, of_outside: float) -> Array:
        """(n,) the temperature by the exact solution from row to row, inputs held."""
        found, decay = np.zeros(time.size), np.exp(-g * 0.1 / 0.01)
        goal = (of_heat * p + 0.01 * of_outside * cold) / g
        for k in range(1, time.size):
            found[k] = goal[k - 1] + (found[k - 1] - goal[k - 1]) * decay
        return found

    told = record(time, {"heat": heat, "outside": outside}, {"T": settled(2.0, 0.8, 1.0)}, 0.001)
    free = [FitParameter("G", 2.0, 0.5, 8.0, given=2.0)]
    found = diagnose(parse_card(ROOM), [told], free, effects=["gain", "offset", "lag"], seed=1)

    assert told.measured is not None
    y = told.measured.values[:, 0]
    still = np.r_[True, (np.diff(p) == 0) & (np.diff(cold) == 0)]  # no recorder tells which side of a jump a row shows

    def chi2(model: Callable[[Array], Array], begin: Sequence[float]) -> float:
        return float(2.0 * least_squares(lambda x: ((model(x) - y) / 0.001)[still], begin).cost)

    alone = chi2(lambda x: settled(x[0], 1.0, 1.0), [2.0])
    true, other = (
        chi2(lambda x: settled(x[0], x[1], 1.0), [2.0, 1.0]),
        chi2(lambda x: settled(x[0], 1.0, x[1]), [2.0, 1.0]),
    )
    assert alone - true > 30.0, "the parameter alone leaves a trace"
    assert abs(true - other) < 0.1, "and between the jumps it is settled, where another effect is the same"

    (line,) = [c for c in found.candidates if (c.effect, c.at) == ("gain", ("heat",))]
    assert line.status == "refitted"
    (group,) = found.ambiguity
    members = {(r.effect, r.at[0]): r for r in group}
    truth = members["gain", "heat"]
    assert truth.parameters["k"] == pytest.approx(0.8, abs=0.02) and truth.values["G"].value == pytest.approx(
        2.0, abs=0.04
    )
    assert (
        all(p.probability < CERTAIN for f in found.findings for p in f.places if f.effect == "gain")
        and ("gain", "outside") in members
    )
    assert found.values_by_place["G"][0].at == ("heat",), "the values nearest to the given ones come first"
    assert found.values_by_place["G"][-1].value == pytest.approx(2.5, abs=0.03)


TANK = """
schema = 1
name = "tank"
[parameters]
K = {value = 2.0, unit = "m", min = 0.1}
tau = {value = 0.5}
[inputs]
q = {value = 0.0}
[states]
h = {derivative = "(K*q - h)/tau", guess = 0.0}
[outputs]
h = "h"
"""


def test_an_effect_that_a_parameter_takes_up_wholly_is_told_beside_its_value() -> None:
    """K q with a gain of 0.8 at q is 0.8 K q: which of both is off no record tells."""
    time = np.round(np.arange(200) * 0.02, 9)
    flow, q = stepped(time, [(1.0, 1.0), (3.0, -0.6)])
    _, h, _ = lsim(([1.6], [0.5, 1.0]), q, time, interp=False)
    free = [FitParameter("K", 2.0, 0.5, 6.0, given=2.0)]
    found = diagnose(
        parse_card(TANK), [record(time, {"q": flow}, {"h": h}, 0.002)], free, effects=["gain", "lag"], seed=1
    )
    assert found.verdict == "no-evidence" and found.parameters_after["K"] == pytest.approx(1.6, abs=0.01)
    (one,) = [s for s in found.stand_ins if s.at == ("q",)]
    assert one.effect == "gain" and one.parameters["k"] == pytest.approx(found.parameters_after["K"] / 2.0, rel=1e-6)
    assert one.values == {"K": 2.0} and one.delta_bic == pytest.approx(0.0, abs=1e-3)
    assert "No effect is missing" not in found.text
    assert f"q is {one.parameters['k']:.4g} times what the model has (with K as given)" in found.text
    assert found.to_dict()["stand_ins"][0]["effect"] == "gain"


LOOPS = """
schema = 1
name = "positioner"
[parameters]
Ta = {value = 0.25, unit = "s", min = 0.01}
Kb = {value = 2.0, min = 0.1}
[inputs]
u = {value = 0.0}
[states]
a = {derivative = "(u - a)/Ta"}
b = {derivative = "(Kb*u - b)/0.2"}
[outputs]
ya = "a"
yb = "b"
"""
INSIDE = {"Ta": 0.3, "T": 0.25 * 0.05 / 0.3}
"""A lag of 50 ms behind 1/(1 + 0.25 s) is 1/(1 + (0.25 + 0.05) s + 0.25 0.05 s^2), and so is 1/(1 + Ta s (1 + T s))."""


def positioner(given: float) -> Diagnosis:
    time = np.round(np.arange(300) * 0.01, 9)
    moved, u = stepped(time, [(1.0, 1.0), (1.8, -0.7)])
    outputs = {"ya": lsim(([1.0], [0.25 * 0.05, 0.3, 1.0]), u, time, interp=False)[1]}
    outputs["yb"] = lsim(([3.0], [0.2, 1.0]), u, time, interp=False)[1]
    free = [FitParameter("Ta", given, 0.02, 3.0, given=given), FitParameter("Kb", 2.0, 0.2, 9.0, given=2.0)]
    records = [record(time, {"u": moved}, outputs, 0.002)]
    return diagnose(parse_card(LOOPS), records, free, effects=["lag", "gain"], seed=1)


@pytest.mark.parametrize(("given", "first", "second"), [(0.25, "ya", "a"), (0.31, "a", "ya"), (0.05, "ya", "a")])
def test_places_that_are_one_transfer_function_are_told_with_the_values_that_each_implies(
    given: float, first: str, second: str
) -> None:
    found = positioner(given)
    # Of two lags in a row, which one the model has is told by its given value.
    true = {"ya": {"Ta": 0.05, "T": 0.25} if given == 0.05 else {"Ta": 0.25, "T": 0.05}, "a": INSIDE}
    assert found.verdict == "ambiguous"
    (told,) = found.findings
    assert told.effect == "lag" and told.probability > CERTAIN
    assert [p.at for p in told.places] == [(first,), (second,)]
    for place in told.places:
        at = place.at[0]
        assert place.probability == pytest.approx(0.5, abs=0.02) and place.effect == "lag"
        for name, size in {**place.parameters, **place.values}.items():
            if name != "Kb":
                assert size.value == pytest.approx(true[at][name], rel=0.03) and size.unit == "s"
        assert place.values["Kb"].value == pytest.approx(3.0, rel=1e-3)
    by_place = found.values_by_place["Ta"]
    assert [(v.effect, v.at) for v in by_place] == [("lag", (first,)), ("lag", (second,))]
    assert "Kb" not in found.values_by_place, "it is the same wherever the lag is"
    assert found.effects[0].at == (first,) and found.parameters_after["Ta"] == by_place[0].value
    assert f"the lag is at {first}, " in found.text and f"if it is at {second}" in found.text
    assert "nor" not in told.text and f"from {second}, where T is" in told.text and "Ta is" in told.text
    lines = {h.effects: h for h in found.hypotheses}
    assert lines["lag at a",].values["Ta"] == pytest.approx(0.3, rel=0.03)
    assert lines["lag at ya",].parameters[0]["T"] == pytest.approx(true["ya"]["T"], rel=0.03)
    card = next(iter(found.files.values()))
    assert "Ta depends on what is missing where" in card


def test_places_with_the_same_values_are_named_as_before() -> None:
    size = FrozenMap({"K": EffectSize(2.0, (1.9, 2.1), "")})
    near = FrozenMap({"K": EffectSize(2.1, (2.0, 2.2), "")})
    far = FrozenMap({"K": EffectSize(3.0, (2.9, 3.1), "")})
    unknown = FrozenMap({"K": EffectSize(9.0, None, "")})
    assert apart(size, near) == () and apart(size, far) == ("K",) and apart(size, unknown) == ()
    off = {id(size): 0.5, id(near): 0.1, id(far): 0.2, id(unknown): 0.0}
    assert nearest(size, [size, near, far, unknown], lambda v: v, lambda v: off[id(v)]) is far
    assert nearest(size, [size, near], lambda v: v, lambda v: off[id(v)]) is size
