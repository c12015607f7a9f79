"""What to measure next: the prediction holds when the experiment is made, the ranking is the criteria's, the words say it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from hvdc_ident.data import InputSignal, trajectory
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.fit.simulator import inputs_of
from hvdc_ident.identifiability import IdentifiabilityReport, identifiability
from hvdc_ident.identifiability.experiment_design import (
    ExperimentDesign,
    Move,
    Recommendation,
    half_widths,
    optimality,
    recommend,
    single_input_designs,
    two_step_designs,
)
from hvdc_ident.identifiability.pilot_fit import pilot_fit
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model
from hvdc_ident.parameters import Input
from hvdc_ident.simulate import ModelSimulator
from tests.fit.simulators import line
from tests.identifiability.cases import closed, measured, on_model, pi_loop

FREE = [FitParameter("a", 0.9, 0.1, 8), FitParameter("k", 1.2, 0.1, 15)]


def two_inputs():
    """A lag a of u, and a second channel that alone shows k."""
    return Model(
        name="two",
        parameters={"a": 0.8, "k": 1.5},
        inputs={"u": 0.0, "w": 0.0},
        states={"x": "-a*x + u", "z": "k*(w - z)"},
        outputs={"y": "x + z", "only": "z"},
    )


def report_of(model, signals, outputs=("y",), free=FREE):
    return identifiability(model, [on_model(model, "e", signals, list(outputs), 1e-3)], free, starts=2)


def test_the_input_that_shows_what_is_not_seen_is_recommended() -> None:
    report = report_of(two_inputs(), {"u": InputSignal.step(1.0, 0.0, 1.0)})
    found = report.recommended
    assert found is not None and "w" in found.best.design.inputs
    assert found.now.directions == 1 and found.best.criteria.directions == 2
    assert found.half_widths_now["k"] is None and found.half_widths["k"] is not None
    assert "k would get a 95 % confidence interval of ±" in found.text and "(now none)" in found.text


def test_under_a_misfit_no_interval_of_95_percent_is_predicted() -> None:
    """The record bends where the model does not: what it lacks moves the estimates by what no residual tells."""
    model = two_inputs()
    record = on_model(model, "e", {"u": InputSignal.step(1.0, 0.0, 1.0)}, ["y"], 1e-3)
    bent = record.measured["y"] + 0.05 * np.sin(3.0 * record.time)
    lacking = record.with_(measured=trajectory(record.time, {"y": bent}))
    found = identifiability(model, [lacking], FREE, starts=2).recommended
    assert ": if nothing else is missing, k would be known to ±" in found.text and "95 %" not in found.text
    told = found.to_dict()
    assert set(told["predicted_ci95"].values()) == {None} and told["predicted_half_width"]["k"] > 0


def test_the_predicted_interval_is_what_the_experiment_gives() -> None:
    """Made as advised, the recommended experiment gives the half-width that was predicted (k is held at its true value)."""
    model = two_inputs()
    free = [FREE[0], FitParameter("k", 1.5, 0.1, 15)]
    first = on_model(model, "e", {"u": InputSignal.step(1.0, 0.0, 1.0)}, ["y"], 1e-3)
    report = identifiability(model, [first], free, starts=2)
    design = report.recommended.best.design
    made = design.experiment(first)
    second = on_model(model, "made", dict(made.inputs), list(report.recommended.best.record), 1e-3, seed=5)
    after = identifiability(model, [first, second], free, starts=2)
    for n in ("a", "k"):
        low, high = after.parameters[n].ci95
        assert 0.5 * (high - low) == pytest.approx(report.recommended.half_widths[n], rel=0.15)


def test_a_signal_is_recommended_where_only_it_tells_a_combination_apart() -> None:
    model = pi_loop()
    free = [FitParameter(n, 1.3 * v, v / 10, v * 10) for n, v in model.values.items()]
    found = report_of(model, {"r": InputSignal.step(1.0, 0.0, 1.0)}, free=free).recommended
    assert found.best.new == ("control",) and found.best.criteria.directions == 4 > found.now.directions
    assert "recording control besides" in found.text
    assert all(found.half_widths[n] is not None for n in model.values)


def test_the_best_narrows_the_widest_interval_most_of_all_that_were_tried() -> None:
    """Against every design weighed anew by the inverse of its information, with sensitivities from the engine."""
    model, noise = two_inputs(), 0.05
    signals = {"u": InputSignal.step(1.0, 0.0, 0.5), "w": InputSignal.step(2.0, 0.0, 0.1)}
    data = on_model(model, "e", signals, ["y"], noise)
    problem = Problem(ModelSimulator(model), (data,), tuple(FREE))
    optimum, _ = pilot_fit(problem, starts=1)
    found = recommend(optimum, inputs_of(problem.simulator, [data]), {}, thresholds={"a": 1.92, "k": 1.92})
    assert isinstance(found, Recommendation)
    base = optimum.information.matrix
    widest = int(np.argmax(np.diag(np.linalg.inv(base))))
    assert found.aim == optimum.names[widest] == "k"
    units = dict.fromkeys(model.inputs, "")
    singles = list(single_input_designs([data], {"u": 0.0, "w": 0.0}, units, data))
    assert {t.kind for t in singles} == {"step", "ramp", "multisine"} and len(singles) == 10
    steps = [t for t in singles if t.kind == "step"]
    designs = [*singles, *two_step_designs(steps, singles, data)]
    variances, determinants = [], []
    for design in designs:
        run = ModelSimulator(model).simulate(design.experiment(data), problem.values(optimum.theta), optimum.names)
        columns = {o: run.gradient(o) * optimum.slope / noise for o in ("y", "only")}
        same = base + columns["y"].T @ columns["y"]
        for after in (same, same + columns["only"].T @ columns["only"]):
            variances.append(np.linalg.inv(after)[widest, widest])
            determinants.append(float(np.linalg.slogdet(after)[1]))
    half = np.sqrt(2.0 * 1.92 * min(variances)) * optimum.slope[widest]
    assert found.half_widths["k"] == pytest.approx(half, rel=0.05)  # it is the least to two digits
    assert found.by_determinant.criteria.log_determinant >= max(determinants) - 1e-6
    widths = [r.half_width for r in (found.best, *found.others)]
    assert all(a <= 1.05 * b for a, b in pairwise(widths))
    assert len({(r.design.kind, frozenset(r.design.inputs)) for r in found.others}) == len(found.others)


def test_only_what_a_person_can_set_is_moved() -> None:
    model = two_inputs()
    record = on_model(model, "e", {"u": InputSignal.step(1.0, 0.0, 1.0)}, ["y"], 1e-3)

    def advised(**settable: bool) -> IdentifiabilityReport:
        inputs = {n: Input(settable=settable[n]) for n in model.inputs}
        return identifiability(replace(model, inputs=FrozenMap(inputs)), [record], FREE, starts=2)

    only_w = advised(u=False, w=True).recommended
    assert {i for r in (only_w.best, only_w.by_determinant, *only_w.others) for i in r.design.inputs} == {"w"}
    nothing = advised(u=False, w=False)
    assert nothing.recommended is None
    assert nothing.not_recommended == "No experiment is advised: none of u and w can be set by a person."
    only_u = advised(u=True, w=False)  # k shows through w alone
    assert only_u.recommended is None or only_u.recommended.best.new


def test_an_experiment_that_tells_no_more_than_a_repetition_is_not_advised() -> None:
    """One input, which was moved as far as any design moves it but by half: made once more, the record tells as much."""
    model = Model(name="one", parameters={"a": 0.8}, inputs={"u": 0.0}, states={"x": "-a*x + u"}, outputs={"y": "x"})
    free, noise = [FREE[0]], 0.2
    signals = {"u": InputSignal.step(1.0, 0.0, 1.0)}
    once = on_model(model, "e", signals, ["y"], noise)
    report = identifiability(model, [once], free, starts=2)
    found = report.recommended
    assert found is not None and abs(found.best.design.moves[0].after) == 2.0  # twice the step tells four times as much
    half = report.parameters["a"].ci95
    assert found.half_widths_now["a"] == pytest.approx(0.5 * (half[1] - half[0]))  # the width that the verdict shows
    narrow = identifiability(model, [on_model(model, "e", signals, ["y"], 1e-4)], free, starts=2)
    assert narrow.recommended is None and narrow.not_recommended == ""  # known to 0.01 %: nothing is left to know


def test_designs_are_the_signals_they_say() -> None:
    data = on_model(two_inputs(), "e", {"u": InputSignal.step(1.0, 0.0, 0.5)}, ["y"], 1e-3).with_(event=1.0)
    ramp = Move("u", "ramp", 1.0, 1.5, 1.0, 2.0)
    assert float(ramp.signal(6.0)(np.array(2.0))) == pytest.approx(1.25)
    sines = Move("u", "multisine", 1.0, 1.5, 1.0, 2.5)
    signal = sines.signal(6.0)
    assert signal.values.max() <= 1.5 and signal.values.min() >= 0.5 and float(signal(0.5)) == 1.0
    assert np.abs(signal.values - 1.0).max() == pytest.approx(0.5)
    one = signal.values[1:][: 320 * 2].reshape(2, 320)  # two periods of the slowest
    spectrum = np.abs(np.fft.rfft(one[0] - 1.0))
    assert set(np.argsort(spectrum)[-5:]) == {1, 2, 4, 8, 16} and np.allclose(one[0], one[1], atol=1e-9)
    both = ExperimentDesign((Move("u", "step", 0.0, 0.5, 1.0), Move("w", "step", 0.0, -0.1, 3.5)))
    assert both.kind == "step + step"
    assert both.text({"u": "V"}) == "Step u from 0 to 0.5 V and, 2.5 s later, step w from 0 to -0.1"
    made = both.experiment(data)
    assert made.event == 1.0 and not made.outputs and set(made.inputs) == {"u", "w"}
    moved = {
        t.inputs[0]: t.moves[0].after for t in single_input_designs([data], {"u": 0.0, "w": 2.0, "v": 0.0}, {}, data)
    }
    assert moved["w"] == pytest.approx(2.1) and moved["v"] == pytest.approx(0.1)


def test_a_simulator_without_inputs_has_nothing_to_recommend() -> None:
    plant = closed(line, a=0.0, b=0.0)
    data = measured(plant, {"a": 1, "b": 2}, 0.1)
    assert inputs_of(plant, [data]) == {}
    report = identifiability(plant, [data], [FitParameter("a", 1, -50, 50), FitParameter("b", 1, -50, 50)], starts=1)
    assert report.recommended is None and report.to_dict()["recommended_experiment"] is None


def test_a_simulator_that_names_no_inputs_is_moved_where_experiments_moved_it() -> None:
    data = on_model(two_inputs(), "e", {"u": InputSignal.step(1.0, 0.25, 0.5)}, ["y"], 1e-3)
    assert {n: i.value for n, i in inputs_of(closed(line, a=0.0, b=0.0), [data]).items()} == {"u": 0.25}


def test_optimality_and_half_widths_of_a_known_matrix() -> None:
    m = np.diag([4.0, 100.0, 0.0])
    found = optimality(m, 1e-6)
    assert (found.directions, found.smallest_eigenvalue) == (2, 4.0) and found.log_determinant == pytest.approx(
        np.log(400)
    )
    widths = half_widths(m, np.array([1.0, 2.0, 3.0]), "abc", 1e-6)
    assert widths["a"] == pytest.approx(0.5) and widths["b"] == pytest.approx(0.2) and widths["c"] is None
