"""Structural identifiability of models whose answers are published (StructuralIdentifiability.jl, tests and examples).

Dong, Goodbrake, Harrington, Pogudin, "Differential elimination for dynamical models via projections with applications to
structural identifiability", SIAM J. Appl. Algebra Geometry 7 (2023); https://github.com/SciML/StructuralIdentifiability.jl,
`test/`. Initial states are unknown. The PI loop follows by hand from its transfer function.
"""

from __future__ import annotations

import pytest

from hvdc_ident.expression import parse
from hvdc_ident.model import Model, Output, State
from hvdc_ident.sensitivity import StructuralResult, identifiable_subset, structural_identifiability


def _model(parameters: str, states: dict[str, str], outputs: dict[str, str], inputs: str = "") -> Model:
    return Model(
        name="published",
        parameters=dict.fromkeys(parameters.split(), 1.3),
        inputs=dict.fromkeys(inputs.split(), 1.0),
        states={n: State(parse(e)) for n, e in states.items()},
        outputs={n: Output(parse(e)) for n, e in outputs.items()},
    )


LINEAR = _model("a b c", {"x": "a*x + b*u"}, {"y": "c*x"}, "u")
COMPARTMENTS = _model("a01 a12 a21", {"x0": "-(a01+a21)*x0 + a12*x1", "x1": "a21*x0 - a12*x1"}, {"y": "x0"})
MICHAELIS = _model("k01 V k c", {"x": "-V*x/(k+x) + k01*x"}, {"y": "c*x"})
JAK_STAT = _model(
    "k1 k2 k3 k5 k6 k7 E",
    {"x1": "-k1*x1*E", "x2": "k1*x1*E - k2*x2**2", "x3": "-k3*x3 + k2*x2**2/2", "x4": "k3*x3"},
    {"y1": "k5*(x2 + 2*x3)", "y2": "k6*(x1 + x2 + 2*x3)", "y3": "k7*E"},
)
PI_LOOP = _model(
    "a b kp ki",
    {"x": "-a*x + b*(kp*(r-x) + z)", "z": "ki*(r-x)"},
    {"y": "x", "v": "kp*(r-x) + z"},
    "r",
)

CASES = {
    "linear": (LINEAR, ["y"], {"a"}, {"b*c"}),
    "two compartments": (COMPARTMENTS, ["y"], set(), {"a01*a12", "a01 + a12 + a21"}),
    "Michaelis-Menten": (MICHAELIS, ["y"], {"k01"}, {"k*c", "V*c"}),
    "JAK-STAT": (JAK_STAT, ["y1", "y2", "y3"], {"k3"}, {"k2/k6", "k5/k6", "k7*E", "k1*E"}),
    "PI loop": (PI_LOOP, ["y"], {"a"}, {"b*kp", "b*ki"}),
    "PI loop and its controller": (PI_LOOP, ["y", "v"], {"a", "b", "kp", "ki"}, set()),
}


def _answer(name: str, **options: object) -> StructuralResult:
    model, outputs, _, _ = CASES[name]
    return structural_identifiability(model, list(model.parameters), outputs, start="free", **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", [0, 1, 7])
@pytest.mark.parametrize("name", CASES)
def test_the_published_functions_are_found(name: str, seed: int) -> None:
    model, _, alone, together = CASES[name]
    result = _answer(name, seed=seed)
    assert result.status == "decided"
    assert result.method == "prime field"
    assert set(result.identifiable) == alone
    assert {s for c in result.combinations for s in c.seen} == together
    assert result.rank == len(alone) + len(together)
    assert set(result.unidentifiable) == set(model.parameters) - alone


@pytest.mark.parametrize("name", ["linear", "PI loop", "PI loop and its controller"])
def test_a_step_shows_what_a_free_input_shows(name: str) -> None:
    model, _, alone, together = CASES[name]
    result = _answer(name, inputs=dict.fromkeys(model.inputs, "step"))
    assert set(result.identifiable) == alone
    assert {s for c in result.combinations for s in c.seen} == together


def test_as_few_as_possible_are_held() -> None:
    assert identifiable_subset(_answer("two compartments")) == ("a01", "a12")
    assert identifiable_subset(_answer("two compartments"), ["a21", "a12", "a01"]) == ("a12", "a21")
    assert identifiable_subset(_answer("PI loop")) == ("a", "b", "kp")
    assert identifiable_subset(_answer("PI loop"), ["kp", "ki", "a", "b"]) == ("a", "kp", "ki")
    assert len(identifiable_subset(_answer("JAK-STAT"))) == 5


def test_words() -> None:
    assert [c.words for c in _answer("PI loop").combinations] == ["only b*kp and b*ki are seen"]
    assert [c.words for c in _answer("linear").combinations] == ["only b*c is seen"]
    assert [c.words for c in _answer("JAK-STAT").combinations] == [
        "only k1*E and k7*E are seen",
        "only k2/k6 and k5/k6 are seen",
    ]
