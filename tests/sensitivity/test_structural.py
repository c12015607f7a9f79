"""Structural identifiability: what is decided, what is not, and that simulation agrees."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.effects import apply_effects
from hvdc_ident.errors import InputError, UnknownNameError
from hvdc_ident.expression import parse
from hvdc_ident.model import Algebraic, Delay, Model, Output, Signal, State
from hvdc_ident.models import load_model
from hvdc_ident.sensitivity import StructuralResult, identifiable_subset, structural_identifiability
from hvdc_ident.simulate import simulate

GAINS = ("KPVDC", "KIVDC", "KPQ", "KIQ", "KPP", "KIP", "KPQ2", "KIQ2")
OUTPUTS = ("Irorder1", "Irorder2", "Iiorder1")


def make(
    states: dict[str, str | State], outputs: dict[str, str], parameters: str, inputs: str = "u", **rest: Any
) -> Model:
    return Model(
        name="small",
        parameters={n: 0.7 + 0.3 * k for k, n in enumerate(parameters.split())},
        inputs=dict.fromkeys(inputs.split(), 1.0),
        states={n: e if isinstance(e, State) else State(parse(e)) for n, e in states.items()},
        outputs={n: Output(parse(e)) for n, e in outputs.items()},
        **rest,
    )


def ask(model: Model, outputs: Any = ("y",), parameters: Any = None, **options: Any) -> StructuralResult:
    return structural_identifiability(model, parameters or list(model.parameters), outputs, **options)


def steps(*names: str) -> dict[str, Any]:
    return dict.fromkeys(names, "step")


@pytest.fixture(scope="module")
def link() -> Model:
    return load_model("vsc-hvdc-link")


# --- the shipped link ---


def test_all_gains_are_seen_where_all_set_points_step(link: Model) -> None:
    moved = steps("Vdcref1", "Qref1", "Pref2", "Qref2")
    result = ask(link, (*OUTPUTS, "Iiorder2"), GAINS, inputs=moved, time_limit=30)
    assert (result.status, result.method) == ("decided", "Taylor series at random points")
    assert result.identifiable == GAINS and not result.combinations


def test_gains_of_a_set_point_that_never_moves_are_not_seen(link: Model) -> None:
    """Station 2's reactive power rests whatever else moves: its current order divides by the voltage."""
    result = ask(link, (*OUTPUTS, "Iiorder2"), GAINS, inputs=steps("Vdcref1", "Qref1", "Pref2"), time_limit=30)
    assert result.identifiable == GAINS[:6]
    assert [c.words for c in result.combinations] == ["nothing is seen of KPQ2", "nothing is seen of KIQ2"]
    assert identifiable_subset(result) == GAINS[:6]


def test_the_engine_agrees_on_what_is_not_seen(link: Model) -> None:
    moved = {n: InputSignal.step(t, b, b + d) for n, t, b, d in (("Vdcref1", 0.1, 1.0, 0.01), ("Pref2", 0.5, 0.4, 0.1))}
    run = simulate(link, experiment("steps", np.linspace(0, 1, 201), moved), sensitivities=list(GAINS))
    seen = ask(link, OUTPUTS, GAINS, inputs=steps("Vdcref1", "Pref2"), time_limit=30).identifiable
    norms = np.concatenate([run.gradient(o) for o in OUTPUTS]).T
    for name, column in zip(GAINS, norms, strict=True):
        assert (np.abs(column).max() > 1e-8) == (name in seen), name


def test_a_constant_input_excites_nothing(link: Model) -> None:
    result = ask(link, OUTPUTS, GAINS, inputs={})
    assert result.status == "decided" and result.rank == 0
    assert result.unidentifiable == GAINS


def test_the_first_controller_from_its_own_output(link: Model) -> None:
    result = ask(link, ["Irorder1"], GAINS[:2], inputs=steps("Vdcref1"))
    assert result.identifiable == ("KPVDC", "KIVDC") and result.regime == ()
    result = ask(link, ["Irorder1"], ["KPVDC", "KIVDC", "C1", "C2", "Rdc", "Zg", "XR"], inputs=steps("Vdcref1"))
    assert len(result.identifiable) == 7


def test_a_saturated_controller_shows_no_gain(link: Model) -> None:
    result = ask(link, ["Irorder1", "Vdc1"], GAINS[:2], inputs=steps("Vdcref1"), regime={"yv": "high"})
    assert result.identifiable == () and result.regime == ("yv: high",)


def test_design_values_are_seen(link: Model) -> None:
    physical = link.parameterised("physical")
    assert ask(physical, ["Irorder1"], ["J", "Ts"], inputs=steps("Vdcref1")).identifiable == ("J", "Ts")
    assert ask(physical, ["Irorder2"], ["J", "Ts"], inputs=steps("Pref2")).identifiable == ("Ts",)


def test_an_effect_brings_its_parameter(link: Model) -> None:
    lagged = apply_effects(link, [{"effect": "lag", "at": ["Ir1", "Ir2"], "parameters": {"T": 0.0016}}])
    new = [n for n in lagged.parameters if n not in link.parameters]
    assert ask(lagged, ["Irorder1"], [*GAINS[:2], *new], inputs=steps("Vdcref1")).identifiable == (*GAINS[:2], *new)


# --- small models ---


def test_a_parameter_that_never_enters() -> None:
    chain = make({"x": "-a*x + u", "z": "x - b*z"}, {"y": "x", "v": "z"}, "a b c")
    result = ask(chain, inputs=steps("u"))
    assert result.identifiable == ("a",)
    assert [c.words for c in result.combinations] == ["nothing is seen of b", "nothing is seen of c"]
    assert ask(chain, ["v"], inputs=steps("u")).identifiable == ("a", "b")


def test_the_start_decides() -> None:
    """x' = b u - a x from rest, seen as y = c x: the rest shows no more than the step; a known start shows c."""
    known = make({"x": State(parse("b*u - a*x"), start=parse("2"))}, {"y": "c*x"}, "a b c")
    assert ask(known, inputs=steps("u")).identifiable == ("a", "b", "c")
    assert ask(known, inputs=steps("u"), start="steady").combinations[0].seen == ("b*c",)
    assert ask(known, inputs=steps("u"), start={"x": "free"}).combinations[0].seen == ("b*c",)
    assert ask(known, inputs={}, start="steady").combinations[0].words == "only a/(b*c) is seen"


def test_a_start_that_is_a_parameter() -> None:
    model = make({"x": State(parse("-a*x"), start="free")}, {"y": "c*x"}, "a c", inputs="")
    assert "x_start" in model.parameters
    assert ask(model, parameters=["a", "c"]).combinations[0].words == "nothing is seen of c"
    result = ask(model, parameters=["a", "c", "x_start"])
    assert result.identifiable == ("a",) and result.combinations[0].seen == ("c*x_start",)


def test_an_input_that_is_zero_hides_its_gain() -> None:
    model = make({"x": "-a*x + b*u*v"}, {"y": "x"}, "a b", inputs="u v")
    assert ask(model, inputs=steps("u")).identifiable == ("a", "b")
    assert ask(model.with_values({"v": 0.0}), inputs=steps("u")).identifiable == ()


def test_a_free_integrator_has_no_single_rest() -> None:
    model = make({"x": "a*(u - w)", "w": "b*(u - w)"}, {"y": "x"}, "a b")
    assert ask(model, inputs=steps("u"), start="steady").identifiable == ("a", "b")


def test_a_state_that_rests_at_zero() -> None:
    """A phase-locked loop: its integrator rests at 0, which Newton's method gives to the last digit only."""
    signals = {"vq": Signal(parse("V*sin(u - th) - R*x*cos(th)"))}
    states = {"th": "kp*vq + w", "w": "ki*vq", "x": "(1 - x*cos(th)**2 - x)/T"}
    model = make(states, {"y": "th"}, "V kp ki T R", signals=signals)
    result = ask(model, inputs=steps("u"), start="steady")
    assert result.identifiable == ("T",)
    assert [c.words for c in result.combinations] == ["only V*ki, kp*R and ki*R are seen"]


@pytest.mark.parametrize("start", ["1", "1e-30", "free"])
def test_information_that_is_small_is_no_less_sure(start: str) -> None:
    """y = A exp(-a t) + b c/a + B exp((c - d) t), A unknown, shows a, b*c and c - d, however small B is; at rest it is 0."""
    z = State(parse("(c - d)*z"), start=None if start == "free" else parse(start))
    model = make({"x": "-a*x + b*c", "z": z}, {"y": "z + x"}, "a b c d")
    result = ask(model, inputs={}, start={"x": "free", "z": "free" if start == "free" else "given"})
    assert result.identifiable == ("a",)
    assert [c.words for c in result.combinations] == ["only b*c and c - d are seen"]


def test_inputs_that_ramp_or_move_freely() -> None:
    model = make({"x": "-a*x + b*u"}, {"y": "c*x"}, "a b c")
    for kind in ("ramp", "free", "step"):
        result = ask(model, inputs={"u": kind})
        assert result.identifiable == ("a",) and result.combinations[0].seen == ("b*c",)
    assert ask(model, inputs={"u": "constant"}).rank == 1


def test_sums_of_products_are_found() -> None:
    model = make({"x": "-(a*b + c)*x + d*u"}, {"y": "x"}, "a b c d")
    result = ask(model, inputs=steps("u"))
    assert result.identifiable == ("d",)
    found = result.combinations[0]
    assert found.words == "only c + a*b is seen" and not found.relative
    # Along each of the two directions that are not seen, a*b + c does not change: its slopes are b, a and 1.
    unseen = np.array(found.directions)
    assert found.members == ("a", "b", "c") and np.linalg.matrix_rank(unseen) == 2
    assert unseen @ [model.values["b"], model.values["a"], 1.0] == pytest.approx([0.0, 0.0])


def test_what_has_no_simple_form_is_named_plainly() -> None:
    model = make({"x": "-a*x + b*u/(1 + c**3)"}, {"y": "x"}, "a b c")
    result = ask(model, inputs=steps("u"))
    assert result.combinations[0].words == "only one combination of b and c is seen"
    assert identifiable_subset(result) == ("a", "b")


def test_unknowns_follow_their_equations() -> None:
    algebraic = {"z": Algebraic(parse("b*u - c*z"))}
    model = make({"x": "-a*x + z"}, {"y": "x"}, "a b c", algebraic=algebraic)
    assert ask(model, inputs=steps("u")).combinations[0].words == "only one combination of b and c is seen"
    algebraic = {"z": Algebraic(parse("b*u - c*z**3"))}
    model = make({"x": "-a*x + z"}, {"y": "x"}, "a b c", algebraic=algebraic)
    assert ask(model, inputs=steps("u")).identifiable == ("a", "b", "c")


@pytest.mark.parametrize(("mode", "alone"), [("first", ("a", "b")), ("second", ("a", "b", "c")), (None, ("a", "b"))])
def test_a_minimum_shows_the_branch_it_takes(mode: str | None, alone: tuple[str, ...]) -> None:
    """With an unknown start the record before the event shows the branch of the operating point too."""
    signals = {"m": Signal(parse("where(b*u < c*u**2, b*u, c*u**2)"))}
    model = make({"x": "m - a*x"}, {"y": "x"}, "a b c", signals=signals)
    result = ask(model, inputs=steps("u"), start="free", regime={"m": mode} if mode else None)
    assert result.identifiable == alone


@pytest.mark.parametrize(
    ("derivative", "output", "words"),
    [
        ("-a*x + b*tanh(c*u - d*x)", "x", []),
        ("-a*x + u", "b*exp(c*d*x)", ["only c*d is seen"]),
        ("-a*sqrt(b*x) + c*u", "d*x", None),
        ("u - a*x - b*sin(c*x)*d", "x", ["only b*d is seen"]),
        ("u - a*x**b", "c*x*d", ["only c*d is seen"]),
        ("a*u - b*log(x)", "atan(c*x)*d", None),
    ],
)
def test_functions_beyond_fractions(derivative: str, output: str, words: list[str] | None) -> None:
    """The exact way and the numeric one agree; where a function's value has no exact counterpart only the latter is left."""
    model = make({"x": State(parse(derivative), guess=1.0)}, {"y": output}, "a b c d")
    results = [ask(model, inputs={"u": "free"}, start=start) for start in ("free", "steady")]
    assert {r.status for r in results} == {"decided"}
    if words is not None:
        assert [c.words for c in results[0].combinations] == words


def test_moving_along_a_null_direction_changes_no_output() -> None:
    model = make({"x": "-a*x + b*(k*(u-x) + z)", "z": "c*(u-x)"}, {"y": "x"}, "a b c k")
    combination = ask(model, inputs=steps("u")).combinations[0]
    assert set(combination.seen) == {"b*c", "b*k"} and combination.relative
    run = experiment("step", np.linspace(0, 5, 101), {"u": InputSignal.step(0.5, 1.0, 1.3)})
    moved = {n: model.values[n] * 2.0**d for n, d in zip(combination.members, combination.directions[0], strict=True)}
    assert np.allclose(simulate(model, run)["y"], simulate(model.with_values(moved), run)["y"], atol=1e-6)
    other = model.with_values({"b": 2 * model.values["b"]})
    assert not np.allclose(simulate(model, run)["y"], simulate(other, run)["y"], atol=1e-3)


# --- what is not decided, and what is wrong ---


def test_the_time_limit_says_so(link: Model) -> None:
    result = ask(link, OUTPUTS, GAINS, inputs=steps("Vdcref1"), time_limit=0.0)
    assert result.status == "not decided" and "time limit" in result.reason
    assert result.identifiable == result.unidentifiable == result.combinations == ()
    assert identifiable_subset(result) == GAINS
    assert str(result).startswith("not decided")


def test_a_delay_is_not_decided() -> None:
    delays = {"d": Delay(parse("x"), parse("b"))}
    model = make({"x": "u - a*d"}, {"y": "x"}, "a b", delays=delays)
    result = ask(model, inputs=steps("u"))
    assert result.status == "not decided" and "delays" in result.reason


def test_answers_do_not_depend_on_the_seed_and_are_plain_values() -> None:
    model = make({"x": "-a*x + b*u"}, {"y": "c*x"}, "a b c")
    found = [ask(model, inputs=steps("u"), seed=s).to_dict() for s in range(5)]
    assert all(f == found[0] for f in found)
    assert found[0]["combinations"][0]["directions"] == [[1.0, -1.0]]


def test_wrong_names_and_classes_are_refused() -> None:
    limited = {"m": Signal(parse("clip(u, -1, 1)"))}
    model = make({"x": "-a*x + m"}, {"y": "x"}, "a", signals=limited)
    with pytest.raises(UnknownNameError, match="no parameter 'b'"):
        ask(model, parameters=["b"])
    with pytest.raises(UnknownNameError, match="no output or signal 'q'"):
        ask(model, ["q"])
    with pytest.raises(UnknownNameError, match="no input 'v'"):
        ask(model, inputs=steps("v"))
    with pytest.raises(InputError, match="no class 'jump'"):
        ask(model, inputs={"u": "jump"})
    with pytest.raises(UnknownNameError, match="no state 'q'"):
        ask(model, start={"q": "free"})
    with pytest.raises(InputError, match="cannot start 'given'"):
        ask(model, start="given")
    with pytest.raises(InputError, match="no mode 'up'"):
        ask(model, regime={"m": "up"})
    with pytest.raises(InputError, match="not limited"):
        ask(model, regime={"x": "high"})
    with pytest.raises(UnknownNameError, match="no parameter 'b'"):
        identifiable_subset(ask(model), ["b"])
