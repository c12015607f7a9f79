"""Every verdict, earned by a case made for it; the set to fit; what is said of the data."""

from __future__ import annotations

import json

import numpy as np
import pytest

from hvdc_ident import load_model
from hvdc_ident.data import InputSignal
from hvdc_ident.errors import InputError, SimulationError, StudyError
from hvdc_ident.fit import FitParameter
from hvdc_ident.identifiability import identifiability
from hvdc_ident.model import Model
from hvdc_ident.parameters import Parameter
from tests.fit.simulators import decay, line
from tests.identifiability.cases import (
    STEPS,
    closed,
    failing,
    line_and_nothing,
    measured,
    on_model,
    pi_loop,
    product,
    saturating,
)


def test_identifiable() -> None:
    plant = closed(decay, a=1.0, k=1.0)
    report = identifiability(
        plant,
        [measured(plant, {"a": 2, "k": 3}, 0.01)],
        [FitParameter("a", 1, 0.1, 10), FitParameter("k", 1, 0.1, 10)],
        starts=3,
    )
    assert [v.verdict for v in report.parameters.values()] == ["identifiable"] * 2
    assert report.identifiable == ("a", "k") and not report.held and not report.combinations
    k = report.parameters["k"]
    assert k.ci95[0] < 3 < k.ci95[1] and k.std == pytest.approx((k.ci95[1] - k.ci95[0]) / 3.92, rel=0.05)
    assert "It is known to ±" in k.reason and "'e'" in k.reason
    assert not report.misspecification.flag


def test_structurally_unidentifiable_by_numbers() -> None:
    plant = closed(product, a=2.0, b=3.0, c=1.0)
    free = [FitParameter("a", 2, 0.1, 20), FitParameter("b", 3, 0.1, 20), FitParameter("c", 1, -5, 5)]
    report = identifiability(plant, [measured(plant, {"a": 2.5}, 0.01)], free, starts=3)
    assert {n: v.verdict for n, v in report.parameters.items()} == {
        "a": "structurally-unidentifiable",
        "b": "structurally-unidentifiable",
        "c": "identifiable",
    }
    assert report.identifiable == ("a", "c") and report.held["b"].value == 3.0
    assert report.parameters["a"].conditional_on == ("b",)
    assert report.combinations[0].seen == ("a*b",)
    assert report.structure.method == "numerical, local"


@pytest.mark.parametrize("outputs", [["y"], ["y", "control"]])
def test_structurally_unidentifiable_on_a_loop(outputs) -> None:
    model = pi_loop()
    free = [FitParameter(n, 1.3 * v, v / 10, v * 10) for n, v in model.values.items()]
    report = identifiability(model, [on_model(model, "e", {"r": STEPS}, outputs, 1e-3)], free, starts=4)
    if outputs == ["y"]:
        assert {n for n, v in report.parameters.items() if v.verdict == "structurally-unidentifiable"} == {
            "b",
            "kp",
            "ki",
        }
        assert len(report.identifiable) == 3 and "a" in report.identifiable
        assert "b" in report.parameters["b"].reason and "b*k" in report.combinations[0].words
        assert report.structure.method == "Taylor series at random points"
        (held,) = report.held
        assert held == "ki"  # of equals the later listed
        others = [n for n in ("b", "kp", "ki") if n != held]
        assert all(report.parameters[n].conditional_on == (held,) for n in others)
    else:
        assert report.identifiable == ("a", "b", "kp", "ki")
    assert report.parameters["a"].ci95[0] < 0.8 < report.parameters["a"].ci95[1]


def test_what_the_equations_tell_apart_a_short_record_may_not() -> None:
    """x' = k (a - x) from 0 shows a and k, but up to 1e-7 s only the slope a k: x'' has not yet come into it."""
    model = Model(
        "early",
        parameters={"a": 2.0, "k": 3.0},
        states={"x": {"derivative": "k*(a - x)", "start": 0}},
        outputs={"x": "x"},
    )
    free = [FitParameter("a", 1.0, 0.1, 20, given=2.5), FitParameter("k", 1.0, 0.1, 20, given=3.0)]
    report = identifiability(model, [on_model(model, "e", {}, ["x"], 1e-10, end=1e-7)], free, starts=2)
    assert report.structure.status == "decided" and not report.structure.combinations
    (found,) = report.combinations
    assert (found.kind, found.members, found.seen, found.held) == ("practical", ("a", "k"), ("a*k",), ("k",))
    assert report.identifiable == ("a",) and report.held["k"].value == 3.0
    for v in report.parameters.values():
        assert v.verdict == "practically-unidentifiable" and v.reason.startswith(
            "In these experiments only a*k is seen."
        )
    assert report.parameters["a"].value == pytest.approx(2.0, rel=1e-3)  # a k is 6
    assert report.parameters["a"].conditional_on == ("k",)


def test_insensitive_is_confirmed_at_both_ends() -> None:
    plant = closed(line_and_nothing, a=1.0, b=1.0, c=0.0)
    free = [FitParameter("a", 0, -5, 5), FitParameter("b", 0, -5, 5), FitParameter("c", 1.0, -100, 100)]
    report = identifiability(plant, [measured(plant, {"a": 1, "b": 2}, 0.01)], free, starts=2)
    c = report.parameters["c"]
    assert c.verdict == "insensitive" and c.value == 1.0 and report.held["c"].value == 1.0
    assert "would be needed" in c.reason and report.identifiable == ("a", "b")


def test_practically_unidentifiable_where_the_profile_stays_open() -> None:
    plant = closed(saturating, a=1.0, k=20.0)
    t = np.linspace(0.2, 1.0, 41)
    free = [FitParameter("a", 1, 0.1, 10), FitParameter("k", 10, 1, 1000)]
    report = identifiability(plant, [measured(plant, {"a": 2, "k": 60}, 0.02, t=t)], free, starts=3)
    k = report.parameters["k"]
    assert k.verdict == "practically-unidentifiable" and "from above" in k.reason and k.ci95[1] is None
    assert report.identifiable == ("a",) and not report.misspecification.flag
    assert k.ci95[0] > 10.0, "its start is excluded: held there, a would answer for it"
    assert report.held["k"].value > k.ci95[0] and "at its given value, 10, the records cannot be met" in k.reason


def test_practically_unidentifiable_from_a_start_that_the_data_admit_is_held_there() -> None:
    plant = closed(saturating, a=1.0, k=20.0)
    t = np.linspace(0.2, 1.0, 41)
    free = [FitParameter("a", 1, 0.1, 10), FitParameter("k", 250, 1, 1000)]
    report = identifiability(plant, [measured(plant, {"a": 2, "k": 60}, 0.02, t=t)], free, starts=3)
    assert report.parameters["k"].verdict == "practically-unidentifiable"
    assert report.identifiable == ("a",) and report.held["k"].value == 250.0


def test_weak_is_fitted_but_has_no_std() -> None:
    plant = closed(line, a=1.0, b=1.0)
    free = [FitParameter("a", 1, 0.1, 50), FitParameter("b", 1, 0.01, 50)]
    report = identifiability(plant, [measured(plant, {"a": 5, "b": 1.5}, 2.0, t=np.linspace(0, 1, 80))], free, starts=2)
    b = report.parameters["b"]
    assert b.verdict == "weak" and b.std is None and b.relative_std is None and "known only to lie in" in b.reason
    assert report.identifiable == ("a", "b")


def test_at_bound_has_a_one_sided_limit_and_is_held() -> None:
    plant = closed(line, a=Parameter(1.0), b=Parameter(0.5, min=0.0))
    free = [FitParameter("a", 1, -5, 5), FitParameter("b", 0.5, 0.0, 5.0)]
    report = identifiability(plant, [measured(plant, {"a": 1, "b": -0.05}, 0.05)], free, starts=2)
    b = report.parameters["b"]
    assert b.verdict == "at-bound" and b.value == 0.0 and b.ci95[0] == 0.0 and 0 < b.ci95[1] < 0.1
    assert "physical bound" in b.reason and report.held["b"].value == 0.0 and report.identifiable == ("a",)


def test_the_link_at_its_bound_and_with_a_flat_gain() -> None:
    model = load_model("vsc-hvdc-link")
    step = {"Pref2": InputSignal.step(0.1, 0.4, 0.5)}
    data = on_model(model, "p", step, ["Irorder2", "Iiorder2"], 1e-4, end=0.5, rows=251)
    free = [FitParameter("KIP", 25, 5, 50), FitParameter("KPP", 0.1, 0, 2), FitParameter("KIQ2", 20, 5, 50)]
    report = identifiability(model, [data], free, starts=3)
    assert {n: v.verdict for n, v in report.parameters.items()} == {
        "KIP": "identifiable",
        "KPP": "at-bound",
        "KIQ2": "insensitive",
    }
    assert report.parameters["KPP"].value == 0.0 and report.held["KIQ2"].value == 20.0
    assert report.recommended is not None and "Qref2" in report.recommended.best.design.inputs
    assert report.recommended.half_widths_now["KIQ2"] is None and report.recommended.half_widths["KIQ2"] < 1.0
    assert "KIQ2 would get a 95 % confidence interval" in report.recommended.text


def test_to_dict_is_the_json() -> None:
    plant = closed(decay, a=1.0, k=1.0)
    data = [measured(plant, {"a": 2, "k": 3}, 0.01, seed=s, name=f"e{s}") for s in range(3)]
    free = [FitParameter("a", 1, 0.1, 10), FitParameter("k", 1, 0.1, 10)]
    found = identifiability(plant, data, free, starts=2).to_dict()
    wanted = "parameters identifiable combinations collinearity correlation structural misspecified experiments"
    assert {*wanted.split(), "recommended_experiment"} <= set(found)
    line = found["parameters"]["k"]
    assert {"verdict", "reason", "value", "ci95", "relative_std", "sensitivity_norm"} <= set(line)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert set(found["experiments"]) == {"e0", "e1", "e2"} and found["misspecified"] is False


def test_a_pair_has_a_common_profile_where_both_are_fitted() -> None:
    plant = closed(decay, a=1.0, k=1.0)
    data = [measured(plant, {"a": 2, "k": 3}, 0.01)]
    free = [FitParameter("a", 1, 0.1, 10), FitParameter("k", 1, 0.1, 10)]
    found = identifiability(plant, data, free, starts=2, pair=("k", "a"))
    assert found.pair is not None and found.pair.names == ("k", "a")
    middle = found.pair.rises[6, 6]
    assert abs(middle) < 1e-6 and found.pair.rises.min() >= -1e-6 and found.pair.rises[0, 0] > 1
    assert len(found.to_dict()["pair"]["rises"]) == 13


# --- bad input ---


def test_data_without_noise_say_so() -> None:
    plant = closed(decay, a=1.0, k=1.0)
    free = [FitParameter("a", 1, 0.1, 10), FitParameter("k", 1, 0.1, 10)]
    report = identifiability(plant, [measured(plant, {"a": 2, "k": 3}, 0.0)], free, starts=2)
    assert any("no noise" in n for n in report.notes) and report.identifiable == ("a", "k")
    assert "no noise" in report.parameters["k"].reason


def test_no_excitation_says_so() -> None:
    model = pi_loop()
    data = on_model(model, "still", {"r": InputSignal.constant(0.0)}, ["y"], 1e-3)
    report = identifiability(model, [data], [FitParameter("a", 1, 0.1, 10), FitParameter("kp", 1, 0.1, 10)], starts=2)
    assert report.identifiable == () and any("No input moves" in n for n in report.notes)
    for v in report.parameters.values():
        assert v.verdict in ("insensitive", "structurally-unidentifiable")


def test_more_unknowns_than_rows() -> None:
    plant = closed(line, a=1.0, b=1.0)
    data = measured(plant, {"a": 1, "b": 2}, 0.1, t=np.array([0.5]))
    report = identifiability(plant, [data], [FitParameter("a", 1, -50, 50), FitParameter("b", 1, -50, 50)], starts=2)
    assert len(report.identifiable) == 1 and any("1 measured values cannot" in n for n in report.notes)
    data = measured(plant, {"a": 1, "b": 2}, 0.1, t=np.array([0.0, 0.5]))
    report = identifiability(plant, [data], [FitParameter("a", 1, -50, 50), FitParameter("b", 1, -50, 50)], starts=2)
    assert any("2 measured values for as many unknowns" in n for n in report.notes)


def test_an_experiment_that_fails_is_named() -> None:
    plant = closed(failing, a=1.0)
    good = closed(decay, a=1.0, k=1.0)
    with pytest.raises(
        SimulationError, match="experiment 'e', at the start values: nothing can be told: the run does"
    ) as e:
        identifiability(plant, [measured(good, {}, 0.1)], [FitParameter("a", 1, 0, 2)], starts=2)
    assert "leave it out" in e.value.hint


def test_nothing_measured_and_unknown_names_are_refused() -> None:
    plant = closed(line, a=1.0, b=1.0)
    data = measured(plant, {}, 0.1)
    with pytest.raises(InputError):
        identifiability(plant, [data], [FitParameter("c", 1, 0, 2)])
    with pytest.raises(StudyError, match="nothing to fit"):
        identifiability(plant, [data.with_(measured=None)], [FitParameter("a", 1, 0, 2)])
