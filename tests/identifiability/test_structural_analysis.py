"""The structure from numbers: models the equations' test does not reach, and simulators with differences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
import pytest

from hvdc_ident.data import Experiment, InputSignal
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.fit.simulator import sensitivity_error
from hvdc_ident.identifiability import identifiability
from hvdc_ident.identifiability.structural import held_of, structural_analysis
from hvdc_ident.model import Delay, Model, Sampled
from hvdc_ident.parameters import Parameter
from hvdc_ident.simulate import ModelSimulator
from tests.fit.simulators import Closed, Run
from tests.identifiability.cases import STEPS, closed, measured, on_model, pi_loop, product


def delayed_loop(**more):
    """The PI loop with its control delayed by Td."""
    return Model(
        name="delayed",
        parameters={"a": 0.8, "b": 1.5, "kp": 0.6, "ki": 0.3, "Td": 0.1},
        inputs={"r": 0.0},
        states={"x": "-a*x + b*late", "z": "ki*(r - x)"},
        signals={"u": "kp*(r - x) + z"},
        delays={"late": Delay("u", "Td")},
        outputs={"y": "x", "control": "u"},
        **more,
    )


def sampled_loop():
    """The PI loop with its control sampled and held."""
    return Model(
        name="sampled",
        parameters={"a": 0.8, "b": 1.5, "kp": 0.6, "ki": 0.3},
        inputs={"r": 0.0},
        states={"x": "-a*x + b*held", "z": "ki*(r - x)"},
        signals={"u": "kp*(r - x) + z"},
        sampled={"held": Sampled("u", "0.1")},
        outputs={"y": "x", "control": "u"},
    )


def problem_on(model, outputs):
    free = tuple(FitParameter(n, 1.2 * v, v / 2, v * 2) for n, v in model.values.items())
    data = on_model(model, "e", {"r": STEPS}, outputs, 1e-3, rows=121)
    return Problem(ModelSimulator(model), (data,), free)


@pytest.mark.parametrize("make", [delayed_loop, sampled_loop])
def test_delays_and_sampling_are_decided_by_numbers_and_labelled_local(make) -> None:
    model = make()
    problem = problem_on(model, ["y"])
    found = structural_analysis(model, problem)
    assert found.status == "decided" and found.method == "numerical, local" and found.local
    assert "delays or sampled parts" in found.note
    (combination,) = found.combinations
    assert set(combination.members) == {"b", "kp", "ki"} and set(combination.seen) == {"b*kp", "b*ki"}
    assert len(found.admissible) == len(problem.free) - 1 and "a" in found.admissible
    assert structural_analysis(model, problem_on(model, ["y", "control"])).combinations == ()


def test_the_report_says_local_where_it_is() -> None:
    model = delayed_loop()
    data = on_model(model, "e", {"r": STEPS}, ["y"], 1e-3, rows=121)
    report = identifiability(
        model, [data], [FitParameter(n, v, v / 2, v * 2) for n, v in model.values.items()], starts=1
    )
    assert report.parameters["ki"].reason.startswith("At every point tried, only")
    assert report.to_dict()["structural"]["method"] == "numerical, local"
    assert any("Structure decided: from the sensitivities at random points" in n for n in report.notes)


def test_numbers_and_equations_agree() -> None:
    model = pi_loop()
    problem = problem_on(model, ["y"])
    by_equations, by_numbers = structural_analysis(model, problem), structural_analysis(None, problem)
    assert by_equations.method == "Taylor series at random points" and not by_equations.local
    assert by_equations.admissible == by_numbers.admissible and len(by_numbers.admissible) == 3
    assert {c.members for c in by_equations.combinations} == {c.members for c in by_numbers.combinations}
    assert set(by_numbers.combinations[0].seen) == {"b*kp", "b*ki"}


SPRING = Model(
    name="spring",
    parameters={"k": 8.0, "m": 2.0, "d": 0.5},
    inputs={"u": 0.0},
    states={"x": "v", "v": "(k*u - d*v - k*x)/m"},
    outputs={"y": "x"},
)
PUSH = InputSignal.corners([(0, 0.0), (1, 0.0), (1, 1.0), (4, 1.0), (4, -0.5)])


@pytest.mark.parametrize("order", [*permutations("kmd")], ids="".join)
def test_both_routes_hold_the_last_listed_that_will_do(order) -> None:
    """k, m and d are seen in two ratios: any one will do to hold, however much more strongly another is seen."""
    data = on_model(SPRING, "e", {"u": PUSH}, ["y"], 1e-3, rows=121)
    free = tuple(FitParameter(n, SPRING.values[n], SPRING.values[n] / 3, SPRING.values[n] * 3) for n in order)
    problem = Problem(ModelSimulator(SPRING), (data,), free)
    by_equations, by_numbers = structural_analysis(SPRING, problem), structural_analysis(None, problem)
    assert by_equations.method == "Taylor series at random points" and by_numbers.method == "numerical, local"
    assert by_equations.admissible == by_numbers.admissible == order[:2]


def test_of_several_directions_each_takes_the_last_listed_that_leaves_the_others_one() -> None:
    """a*b and c*d seen, e and f apart: b and d are held; two that share a and b do not take both of theirs."""
    null = np.array([[1.0, -1, 0, 0, 0, 0], [0, 0, 1, -1, 0, 0]])
    assert held_of(null) == {1, 3}
    assert held_of(np.array([[1, 1, -1, -1, 0, 0], [1, -1, 0, 0, 0, 0.0]])) == {1, 3}
    assert held_of(np.array([[1.0, -1.0, 1.0]])) == {2} and held_of(np.array([[0.0, 1e-5, 0.0], [1, 0, 1e-7]])) == {
        0,
        1,
    }
    assert held_of(np.zeros((0, 3))) == frozenset()


@dataclass
class Differences:
    """A simulator whose sensitivities are central differences with a relative step, and that says how good they are."""

    inner: Closed
    step: float = 1e-4
    sensitivity_error: float = 1e-4

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        return self.inner.parameters

    def simulate(self, experiment: Experiment, values: Mapping[str, float], sensitivities: Sequence[str] = ()) -> Run:
        plain = self.inner.simulate(experiment, values)
        at = {n: p.value for n, p in self.parameters.items()} | dict(values)
        columns = []
        for n in sensitivities:
            h = self.step * max(abs(at[n]), 1e-3)
            high, low = (self.inner.simulate(experiment, {**at, n: at[n] + s * h}).trajectory["y"] for s in (1, -1))
            columns.append((high - low) / (2 * h) * (1 + 1e-5 * np.cos(50 * experiment.time + len(columns))))
        return Run(plain.trajectory, tuple(sensitivities), {"y": np.column_stack(columns) if columns else None})


def test_differences_with_their_error_stated_see_what_exact_sensitivities_see() -> None:
    """Errors of 1e-5 would pass for a direction of their own, were they not stated."""
    exact = closed(product, a=2.0, b=3.0, c=1.0)
    rough = Differences(exact)
    assert sensitivity_error(exact) == 1e-6 and sensitivity_error(rough) == 1e-4
    free = (FitParameter("a", 2, 0.5, 5), FitParameter("b", 3, 0.5, 5), FitParameter("c", 1, -5, 5))
    data = measured(exact, {"a": 2.5}, 0.01)
    found = structural_analysis(None, Problem(rough, (data,), free))
    assert found.points == 6 and found.admissible == ("a", "c") and "good to 0.0001" in found.note
    assert found.combinations[0].seen == ("a*b",)
    silent = Differences(exact, sensitivity_error=0.0)
    assert structural_analysis(None, Problem(silent, (data,), free)).combinations == ()
    report = identifiability(rough, [data], free, starts=2)
    assert {n: v.verdict for n, v in report.parameters.items()} == {
        "a": "structurally-unidentifiable",
        "b": "structurally-unidentifiable",
        "c": "identifiable",
    }


def test_points_that_cannot_be_simulated_are_counted() -> None:
    exact = closed(product, a=2.0, b=3.0, c=1.0)
    data = measured(exact, {"a": 2.5}, 0.01)
    free = (FitParameter("a", 2, 0.5, 5), FitParameter("b", 3, 0.5, 5), FitParameter("c", 1, -5, 5))
    exact.fails = lambda p: p["c"] > 0
    found = structural_analysis(None, Problem(exact, (data,), free))
    assert 0 < found.points < 5 and f"{5 - found.points} of 5 random points could not be simulated" in found.note
    assert found.combinations[0].seen == ("a*b",)
    exact.fails = lambda p: True
    nothing = structural_analysis(None, Problem(exact, (data,), free))
    assert nothing.status == "not decided" and nothing.admissible == ("a", "b", "c")
    with pytest.raises(SimulationError):
        identifiability(exact, [data], free, starts=1)


def test_time_is_not_taken_for_a_verdict(monkeypatch) -> None:
    """Where the equations' test runs out of time the numbers stand in, and the status says that nothing was decided."""
    monkeypatch.setattr("hvdc_ident.identifiability.structural.SECONDS", 0.0)
    model = pi_loop()
    found = structural_analysis(model, problem_on(model, ["y"]))
    assert found.status == "not decided" and "time limit" in found.note and found.method == "numerical, local"
    assert set(found.combinations[0].seen) == {"b*kp", "b*ki"}
