"""Forms outside the catalogue, on records by scipy: told where no effect explains them, weighed beside an effect that does."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hvdc_ident import Experiment, InputSignal, Model, Trajectory, simulate
from hvdc_ident.data import Array
from hvdc_ident.discrepancy import Diagnosis, DiagnosisOptions, diagnose
from hvdc_ident.discrepancy.candidates import source_signals
from hvdc_ident.discrepancy.hypothesis import refitted
from hvdc_ident.discrepancy.moves import MOVES
from hvdc_ident.discrepancy.options import SearchContext
from hvdc_ident.discrepancy.score import P_EFFECT, same_answers
from hvdc_ident.discrepancy.search import Hypothesis, Search, Term
from hvdc_ident.discrepancy.sentences import expression, with_values
from hvdc_ident.effects import apply_effects
from hvdc_ident.fit import FitParameter
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import parse_card, write_card
from tests.discrepancy.cases import FREE, SIGMA, TIME, TRUE, corners, experiments, model
from tests.discrepancy.meters import filtered
from tests.discrepancy.refits import answered, beside, expanded, plain

Meter = Callable[[dict[str, Array]], Array]


def metered(output: str, meter: Meter) -> tuple[Experiment, ...]:
    """Records of the drive one of whose meters shows something else."""
    found, random = [], np.random.default_rng(4)
    for e in experiments():
        assert e.measured is not None
        columns = {n: np.asarray(e.measured[n]) for n in e.measured.names}
        noise = 0.1 * SIGMA[output] * random.standard_normal(TIME.size)
        columns[output] = meter(columns) + noise
        found.append(replace(e, measured=replace(e.measured, values=np.column_stack(list(columns.values())))))
    return tuple(found)


def drifting(seen: dict[str, Array]) -> Array:
    """The speed by a meter whose gain grows."""
    return seen["w"] * (1.0 + 0.04 * TIME)


def product(seen: dict[str, Array]) -> Array:
    """The torque by a meter whose gain is the speed's."""
    return seen["torque"] * (1.0 + 0.8 * (seen["w"] - 1.0))


@pytest.mark.parametrize(
    ("output", "meter", "formula", "name", "size"),
    [("w", drifting, "g*time*w", "g", 0.04), ("torque", product, "g*torque + k*torque*w", "k", 0.8)],
)
def test_what_no_effect_of_the_catalogue_explains_is_told_as_a_term(
    output: str, meter: Meter, formula: str, name: str, size: float
) -> None:
    found = diagnose(model(), metered(output, meter), FREE)
    assert found.verdict == "unnameable" and not found.effects
    assert found.fallback is not None
    told = found.fallback
    assert (told["kind"], told["at"], told["expression"]) == ("term", f"outputs.{output}", formula)
    low, high = told["coefficients"][name]["ci95"]
    assert low < size < high
    assert told["coefficients"][name]["value"] == pytest.approx(size, rel=0.1)
    assert found.remaining["adequate"] and (found.gap.shrink_holdout or 0.0) > 0.5
    assert isinstance(found.augmented, Model)
    run = simulate(found.augmented, metered(output, meter)[0].with_(measured=None), outputs=[output])
    assert np.isfinite(run[output]).all()
    assert parse_card(write_card(found.augmented)).insertion_points == found.augmented.insertion_points


def bent(seen: dict[str, Array]) -> Array:
    """The torque by a meter with an error that goes over from one side to the other where the speed passes a level."""
    return seen["torque"] + error(seen["w"])


def error(w: Array) -> Array:
    return np.asarray(0.05 * np.tanh((w - 1.1) / 0.1))


def test_what_hangs_on_another_signal_and_is_no_formula_is_told_as_a_curve_and_put_in() -> None:
    found = diagnose(model(), metered("torque", bent), FREE)
    assert found.verdict == "unnameable" and found.fallback is not None
    told, curve = found.fallback, found.fallback["curve"]
    assert (told["kind"], told["at"], curve["over"]) == ("curve", "outputs.torque", "w")
    known = np.array([s is not None and s < 0.01 for s in curve["std"]])
    assert known.sum() >= 7 and np.all(np.diff(curve["at"]) > 0)
    # Between knots the curve is straight: a little is missing where it bends.
    off = np.array(curve["value"]) - error(np.array(curve["at"]))
    assert np.abs(off)[known].max() < 0.015
    assert isinstance(found.augmented, Model) and found.parameters_after["Ki"] == pytest.approx(TRUE["Ki"], rel=0.05)
    assert (found.gap.shrink_holdout or 0.0) > 0.5
    assert parse_card(write_card(found.augmented)).insertion_points == found.augmented.insertion_points


LEVELS, SHOWN = [0.0, 0.6, 0.9, 1.15, 3.0], [0.02, 0.62, 1.04, 1.12, 2.97]


def test_a_characteristic_comes_back_with_its_curve_and_band() -> None:
    """The meter of the speed follows a curve of its own: no polynomial, and rising."""
    records = metered("w", lambda seen: np.interp(seen["w"], LEVELS, SHOWN))
    found = diagnose(model(), records, FREE, options=DiagnosisOptions(most=1))
    assert found.verdict == "unnameable" and found.fallback is not None
    told, curve = found.fallback, found.fallback["curve"]
    assert (told["kind"], told["at"], curve["over"]) == ("curve", "outputs.w", "w")
    at, value = np.array(curve["at"]), np.array(curve["value"])
    known = np.array([s is not None and s < 0.01 for s in curve["std"]])
    assert known.sum() >= 6
    assert np.abs(at + value - np.interp(at, LEVELS, SHOWN))[known].max() < 0.03
    assert np.all(np.diff(at + value) >= -1e-12), "it rises"


MOTOR = """
schema = 1
name = "motor"
[parameters]
R = {value = 1.0, min = 0.01}
k = {value = 0.5, min = 0.01}
J = {value = 0.02, min = 0.001}
b = {value = 0.02, min = 0.0}
L = {value = 0.05, min = 0.001}
[inputs]
v = {value = 0.0}
[states]
w = {derivative = "(torque - b*w)/J"}
i = {derivative = "(v - R*i - k*w)/L"}
[signals]
torque = "k*i"
[outputs]
w = "w"
i = "i"
"""


def motor(friction: float) -> tuple[Experiment, ...]:
    """Records of a dc motor with dry friction, by an implicit method: the sign goes over within a ten-thousandth of the speed."""
    random, found = np.random.default_rng(2), []
    time = np.linspace(0.0, 3.0, 601)
    for name, role, moves in (
        ("forth", "fit", [(0.2, 1.0), (1.2, -2.0), (2.2, 1.6)]),
        ("slow", "fit", [(0.2, 0.5), (0.8, -0.8), (1.6, 1.4)]),
        ("back", "holdout", [(0.2, -0.9), (1.5, 1.7)]),
    ):
        supply = InputSignal.corners(corners(0.0, moves))

        def slopes(t: float, s: Array, supply: InputSignal = supply) -> list[float]:
            w, i = s
            brake = friction * math.tanh(w / 1e-4)
            return [(0.5 * i - 0.02 * w - brake) / 0.02, (float(supply(t)) - i - 0.5 * w) / 0.05]

        run = solve_ivp(slopes, (0.0, 3.0), [0.0, 0.0], "Radau", t_eval=time, rtol=1e-7, atol=1e-9, max_step=0.01)
        seen = run.y.T + random.standard_normal((time.size, 2)) * [5e-3, 5e-3]
        found.append(
            Experiment(
                time, name, inputs=FrozenMap({"v": supply}), measured=Trajectory(time, seen, ("w", "i"), ("", "")),
                noise=FrozenMap({"w": 5e-3, "i": 5e-3}), event=0.2, role=role,
            )
        )  # fmt: skip
    return tuple(found)


def test_dry_friction_comes_back_with_its_size() -> None:
    free = (FitParameter("R", 1.2, 0.2, 5.0), FitParameter("k", 0.45, 0.1, 2.0))
    found = diagnose(parse_card(MOTOR), motor(0.06), free)
    assert found.verdict == "unnameable" and found.fallback is not None
    told = found.fallback
    assert told["kind"] == "term" and "tanh(w/v)" in told["expression"] and "dry friction" in told["text"]
    assert told["at"] == "torque"
    low, high = told["coefficients"]["F"]["ci95"]
    assert told["coefficients"]["F"]["value"] == pytest.approx(0.06, rel=0.03) and low < high
    assert found.parameters_after["k"] == pytest.approx(0.5, rel=0.01)


def test_a_form_is_ahead_only_where_it_beats_what_the_catalogue_has() -> None:
    options = DiagnosisOptions(bootstraps=100)
    context = SearchContext(("lag", "gain"), None, FrozenMap(), options, seed=0)
    search = Search(context, plain(metered("w", drifting)), MOVES)
    for name in ("effects", "forms"):
        search.add(next(m for m in MOVES if m.name == name).make(search, search.root))
    ahead = search.forms_ahead(search.answer()[0], search.forms())
    assert expression(ahead[0].refit) == "g*time*w" and ahead[0] in search.forms()
    rival = Hypothesis(ahead[0].refit, search.root.base, (Term("gain", ("wm",), prior=ahead[0].terms[0].prior),))
    search.add([rival])
    standing = search.forms()
    assert ahead[0] in standing and not search.forms_ahead(search.answer()[0], standing), (
        "an effect of the catalogue leaves as much"
    )


def polynomials(told: str) -> list[list[float]]:
    """The coefficients of a fraction of polynomials of second order as it is told."""
    signed = told.replace(" - ", " + -").replace("(s^2", "(1 s^2").replace("(", "").replace(")", "")
    return [[float(term.split()[0]) for term in part.split(" + ")] for part in signed.split("/")]


@pytest.mark.parametrize(
    ("numerator", "denominator", "name"),
    [
        ([1.0, 4.0, 900.0], [1.0, 30.0, 900.0], "notch around 30"),
        ([1.0, 40.0, 1600.0], [1.0, 16.0, 1600.0], "resonance around 40"),
    ],
)
def test_what_passes_a_band_differently_is_told_as_a_filter(
    numerator: list[float], denominator: list[float], name: str
) -> None:
    found = diagnose(model(), filtered(numerator, denominator), FREE)
    assert found.verdict == "unnameable" and not found.effects and found.fallback is not None
    told = found.fallback
    assert (told["kind"], told["at"]) == ("filter", "outputs.torque") and name in told["text"]
    above, below = polynomials(told["expression"])
    assert above == pytest.approx(numerator, rel=0.1, abs=1.0) and below == pytest.approx(denominator, rel=0.1)
    low, high = told["coefficients"]["wn"]["ci95"]
    assert low < np.sqrt(denominator[2]) < high
    assert found.remaining["adequate"] and (found.gap.shrink_holdout or 0.0) > 0.5
    assert found.parameters_after["Ki"] == pytest.approx(TRUE["Ki"], rel=0.05)
    assert isinstance(found.augmented, Model)
    assert parse_card(write_card(found.augmented)).insertion_points == found.augmented.insertion_points


def test_a_lag_is_named_though_a_wide_filter_comes_near_it() -> None:
    found = diagnose(model(), experiments(lag=0.03), FREE, effects=["lag", "gain"], places=["wm"])
    assert found.verdict == "named" and [e.effect for e in found.effects] == ["lag"]


@pytest.mark.parametrize("late", [0.02, 0.04])
def test_what_only_delays_is_no_filter(late: float) -> None:
    """The delay itself is not among those tried: what a filter makes of it has the zeros of a delay."""
    records = experiments(meter=lambda torque: np.interp(TIME - late, TIME, torque))
    found = diagnose(model(), records, FREE, effects=["gain", "offset"], options=DiagnosisOptions(bootstraps=100))
    assert (found.fallback or {}).get("kind") != "filter"


def test_what_acts_at_the_same_times_in_every_experiment_is_a_disturbance() -> None:
    """The torque that acts has a knock of its own in every record: no effect of a signal, and nothing periodic."""

    def knock(seen: dict[str, Array]) -> Array:
        return (
            seen["torque"] + 0.1 * np.exp(-(((TIME - 0.45) / 0.1) ** 2)) - 0.08 * np.exp(-(((TIME - 0.9) / 0.08) ** 2))
        )

    found = diagnose(model(), metered("torque", knock), FREE, effects=["lag", "gain"])
    assert found.verdict == "unnameable" and found.fallback is not None
    told = found.fallback
    assert (told["kind"], told["at"], told["curve"]["over"]) == ("disturbance", "outputs.torque", "time")
    at, value = np.array(told["curve"]["at"]), np.array(told["curve"]["value"])
    assert at[np.argmax(value)] == pytest.approx(0.45, abs=0.06) and at[np.argmin(value)] == pytest.approx(
        0.9, abs=0.06
    )


def bending(third: float, level: float, options: DiagnosisOptions | None = None) -> Diagnosis:
    """The drive whose drag bends: by a third order, or towards a level; looked for are the bends of the catalogue."""

    def drag(w: float) -> float:
        u = TRUE["b"] * w
        return level * math.tanh(u / level) if math.isfinite(level) else u + third * u**3

    effects = ("saturation", "limit", "deadband", "loss")
    return diagnose(model(), experiments(drag=drag), FREE, effects=effects, places=["drag"], options=options)


def test_a_bend_of_third_order_is_not_called_a_saturation_alone() -> None:
    found = bending(-0.25, math.inf)
    assert found.verdict == "ambiguous"
    (group,) = found.ambiguity
    formulas = {r.expression: r.parameters for r in group if r.effect == "term"}
    assert "c*drag**3" in formulas
    assert formulas["c*drag**3"]["c"] == pytest.approx(-0.25, rel=0.1)
    assert "term" in found.separating_experiment["text"]
    (told,) = found.to_dict()["ambiguity"]
    assert all(("expression" in r) == (r["effect"] == "term") for r in told)


def test_a_saturation_that_bends_far_is_told_from_every_formula() -> None:
    found = bending(0.0, 0.2)
    assert found.verdict == "named"
    assert found.effects[0].effect == "saturation"
    assert found.effects[0].parameters["level"].value == pytest.approx(0.2, rel=0.02)


def test_a_formula_that_explains_more_is_told_instead() -> None:
    found = bending(2.0, math.inf)  # the other way than anything in the catalogue bends at one slot
    assert found.verdict == "unnameable"
    assert found.fallback is not None
    assert found.fallback["kind"] == "term"
    assert "drag" in found.fallback["expression"]


def test_no_formula_is_tried_where_none_is_asked_for() -> None:
    found = bending(-0.25, math.inf, DiagnosisOptions(fallback=False))
    assert found.verdict == "named"
    assert found.effects[0].effect == "saturation"


def shown(changed: Model, still: str) -> tuple[Experiment, ...]:
    """Records of a changed drive, with noise, in which one input stands still and the other moves."""
    rest, moved = {"ref": 1.0, "load": 0.3}, []
    for e, change in zip(experiments(), (0.3, -0.25, 0.2), strict=True):
        moves = {n: InputSignal.step(0.3, v, v + change * (n != still)) for n, v in rest.items()}
        moved.append(replace(e, inputs=FrozenMap(moves)))
    return answered(changed, moved, seed=3)


def test_a_form_outside_the_catalogue_is_as_likely_as_an_effect() -> None:
    """A bend at one of two places has half of what a saturation has at both, and one that brings a signal in shares that with them all."""
    there = apply_effects(model(), [{"effect": "saturation", "at": ["drag"], "parameters": {"level": 0.25}}])
    search = SearchContext(("saturation",), ("drag", "torque"), FrozenMap(), DiagnosisOptions(bootstraps=100), seed=0)
    found = expanded(search, plain(answered(there, experiments(), seed=0)))
    assert [c.at for c in found.candidates] == [("drag",), ("torque",)]
    slots, signals = len(found.signals), len(source_signals(model(), found.signals))
    assert found.prior("saturation") == P_EFFECT / 2
    assert found.prior("polynomial") == pytest.approx(P_EFFECT / slots)
    assert found.prior("product") == pytest.approx(P_EFFECT / slots / signals)


def test_what_bends_a_signal_that_never_moves_is_told_with_the_gain_there() -> None:
    clipped = {"effect": "limit", "at": "load", "parameters": {"level": 0.25}}
    bends = ("gain", "limit", "saturation", "deadband")
    found = diagnose(
        model(), shown(apply_effects(model(), [clipped]), still="load"), FREE, effects=bends, places=["load"]
    )
    assert found.verdict == "named"
    assert {r.effect for r in found.ambiguity[0]} == set(bends)
    more = {"effect": "gain", "at": "load", "parameters": {"k": 1.2}}
    found = diagnose(model(), shown(apply_effects(model(), [more]), still="load"), FREE, effects=bends, places=["load"])
    assert found.verdict == "named" and not found.ambiguity, "none of them adds"


def leaking(source: str) -> Diagnosis:
    """The drive whose load loses a twentieth of a signal; looked for are losses there."""
    leak = {"effect": "conductance", "at": "load", "from": source, "parameters": {"g": 0.05}}
    records = answered(apply_effects(model(), [leak]), experiments(), seed=5)
    return diagnose(model(), records, FREE, effects=("conductance", "loss"), places=["load"])


def test_a_leak_is_named_beside_the_forms() -> None:
    found = leaking("ref")
    assert found.verdict == "named" and found.findings[0].same_as[0] in ("conductance", "loss")
    assert found.findings[0].parameters["g"].value == pytest.approx(0.05, rel=0.1)


def test_a_leak_that_a_stated_value_explains_as_well_is_told_beside_that() -> None:
    """A load that loses g w is a friction that is less by g."""
    found = leaking("w")
    assert found.verdict == "ambiguous"
    told = {f.effect: f.parameters for f in found.findings}
    assert set(told) in ({"parameter", "conductance"}, {"parameter", "loss"})
    assert told["parameter"]["b"].value == pytest.approx(TRUE["b"] - 0.05, rel=0.01)
    assert told.get("conductance", told.get("loss", {}))["g"].value == pytest.approx(0.05, rel=0.1)


@pytest.mark.parametrize(("change", "same"), [(0.02, True), (0.6, False)])
def test_a_bend_of_a_signal_that_hardly_moves_is_its_own_tangent(change: float, same: bool) -> None:
    """The cube of a set-point of 1 moves three times as much as that, and bends only where it moves far."""
    levels = corners(1.0, [(0.3, change), (0.7, -1.5 * change)])
    moved = FrozenMap({"ref": InputSignal.corners(levels), "load": InputSignal.constant(0.3)})
    cubed = apply_effects(model(), [{"effect": "polynomial", "at": ["ref"], "parameters": {"c": 0.1}}])
    before = plain(answered(cubed, [replace(e, inputs=moved) for e in experiments()], seed=5))
    cube = refitted(beside(before, "polynomial", "ref", {"b": 0.0, "c": 0.1}, {"c": (-3.0, 3.0)}))
    linear = refitted(beside(before, "conductance", "err", {"g": -0.3}, {"g": (-3.0, 3.0)}, source="ref"))
    assert cube.sizes(cube.placed[-1])["c"] == pytest.approx(0.1, rel=0.5 if same else 0.1)
    assert same_answers(linear, cube, before) == same


def test_a_formula_with_its_values_is_written_in_four_digits() -> None:
    assert with_values("k*load*w", {"k": 0.123456}) == "0.1235*load*w"
    assert with_values("", {}) == ""
