"""Structural identifiability of models whose answers are published (StructuralIdentifiability.jl, tests and examples).

Dong, Goodbrake, Harrington, Pogudin, "Differential elimination for dynamical models via projections with applications to
structural identifiability", SIAM J. Appl. Algebra Geometry 7 (2023); https://github.com/SciML/StructuralIdentifiability.jl,
`test/bodies` (local_identifiability, identifiability, identifiable_functions, known_ic) and
`benchmarking/IdentifiableFunctions/results`. Initial states are unknown unless they are said to be known. The PI loop follows by hand
from its transfer function. Where the published functions are not those named here, either follow from the others.
"""

from __future__ import annotations

from typing import Any

import pytest

from hvdc_ident.expression import parse
from hvdc_ident.model import Model, Output, State
from hvdc_ident.sensitivity import StructuralResult, identifiable_subset, structural_identifiability


def _model(
    parameters: str, states: dict[str, str], outputs: dict[str, str], inputs: str = "", known: str = ""
) -> Model:
    """known: states whose start is known, at a general value."""
    starts = {n: parse(f"0.{7 + k}") for k, n in enumerate(known.split())}
    return Model(
        name="published",
        parameters=dict.fromkeys(parameters.split(), 1.3),
        inputs=dict.fromkeys(inputs.split(), 1.0),
        states={n: State(parse(e), start=starts.get(n)) for n, e in states.items()},
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

PREY = {"x0": "a*x0 - b*x0*x1 + u", "x1": "c*x1 + d*x0*x1"}
CHOLERA = _model(
    "mu bi bw a xi gam k",
    {
        "S": "mu - bi*S*I - bw*S*W - mu*S + a*R",
        "I": "bw*S*W + bi*S*I - (gam + mu)*I",
        "W": "xi*(I - W)",
        "R": "gam*I - (mu + a)*R",
    },
    {"y": "k*I"},
)
GOODWIN = {
    "x1": "-b*x1 + 1/(c + x4)",
    "x2": "alpha*x1 - beta*x2",
    "x3": "gama*x2 - delta*x3",
    "x4": "sigma*x4*(gama*x2 - delta*x3)/x3",
}
PRODUCT = _model("a1 a2 a3 a4 a5 a6 a7 a8", {"x1": "a1 + a2 + a3*a4", "x2": "a4*a5 + a6 + a7 - 8*a8"}, {"y": "x1*x2"})
THREE_IN_LINE = {
    "x1": "-a1*x1 + b1*x2",
    "x2": "-(a2 + b1)*x2 + a1*x1 + b2*x3",
    "x3": "-b2*x3 + a2*x2",
}
QUADRATIC = _model("p1 p2 p3 p4", {"x1": "p1*x1**2 + p2*x1*x2", "x2": "p3*x1**2 + p4*x1*x2"}, {"y": "x1"})
BELLMAN = _model("k1 k2 k3 k4", {"x1": "-(k1 + k2)*x1 + k3*x2 + u", "x2": "k2*x1 - (k3 + k4)*x2"}, {"y": "x1"}, "u")
SIRS = _model(
    "mu b0 b1 g nu M",
    {
        "s": "mu - mu*s - b0*(1 + b1*x1)*i*s + g*r",
        "i": "b0*(1 + b1*x1)*i*s - (nu + mu)*i",
        "r": "nu*i - (mu + g)*r",
        "x1": "-M*x2",
        "x2": "M*x1",
    },
    {"y1": "i", "y2": "r"},
)
SEIR = _model(
    "beta v psi gamma",
    {
        "S": "-beta*S*I",
        "E": "beta*S*I - v*E",
        "I": "v*E - psi*I - (1 - psi)*gamma*I",
        "R": "gamma*Q + (1 - psi)*gamma*I",
        "Q": "-gamma*Q + psi*I",
    },
    {"y": "Q"},
)
BILIRUBIN = _model(
    "k01 k21 k31 k41 k12 k13 k14",
    {
        "x1": "-(k21 + k31 + k41 + k01)*x1 + k12*x2 + k13*x3 + k14*x4 + u",
        "x2": "k21*x1 - k12*x2",
        "x3": "k31*x1 - k13*x3",
        "x4": "k41*x1 - k14*x4",
    },
    {"y": "x1"},
    "u",
)
HYDROGENATION = _model(
    "k5 k6 k7 k8 k9 k10",
    {
        "x4": "-k5*x4/(k6 + x4)",
        "x5": "k5*x4/(k6 + x4) - k7*x5/(k8 + x5 + x6)",
        "x6": "k7*x5/(k8 + x5 + x6) - k9*x6*(k10 - x6)/k10",
        "x7": "k9*x6*(k10 - x6)/k10",
    },
    {"y1": "x4", "y2": "x5"},
)
QUARANTINE = _model(
    "b g s a e Ninv",
    {
        "S": "-b*In*S*Ninv - S*Ninv*u",
        "In": "-In*g + s*Q + a*L",
        "L": "b*In*S*Ninv - a*L",
        "Q": "-e*In*g + In*g - s*Q",
    },
    {"y": "In*Ninv"},
    "u",
)
HIV = _model(
    "lm d beta a k u c q b h",
    {
        "x": "lm - d*x - beta*x*v",
        "y": "beta*x*v - a*y",
        "v": "k*y - u*v",
        "w": "c*x*y*w - c*q*y*w - b*w",
        "z": "c*q*y*w - h*z",
    },
    {"y1": "w", "y2": "z"},
)
T_CELLS = _model(
    "mu_N delta_NE mu_EE delta_EL rho_E delta_LM mu_LL mu_LE mu_M rho_P mu_P mu_PE mu_PL",
    {
        "N": "-N*mu_N - N*P*delta_NE",
        "E": "N*P*delta_NE - E**2*mu_EE - E*delta_EL + E*P*rho_E",
        "S": "S*delta_EL - S*delta_LM - S**2*mu_LL - E*S*mu_LE",
        "M": "S*delta_LM - mu_M*M",
        "P": "P**2*rho_P - P*mu_P - E*P*mu_PE - S*P*mu_PL",
    },
    {"y1": "N", "y2": "E + S", "y3": "M"},
)
AKT = _model(
    "k1a k1b kE k2a k2b k3 k4 k5a k5b k6 k7 k8 k9 a1 a2 a3",
    {
        "R": "kE*fresh - kE*R + (k1b - k1a)*B",
        "pR": "k9*B - k4*pR - k2a*pR*A + (k3 + k2b)*C",
        "C": "k2a*pR*A - (k3 + k2b)*C",
        "A": "k7*pA - k2a*pR*A + k2b*C",
        "pA": "k6*D + k3*C + k5b*D - k7*pA - k5a*pA*S",
        "S": "k8*pS + k5b*D - k5a*pA*S",
        "D": "k5a*pA*S - (k6 + k5b)*D",
        "pS": "k6*D - k8*pS",
        "B": "(k1a - k9 - k1b)*B",
    },
    {"y1": "a1*(pR + C)", "y2": "a2*(pA + D)", "y3": "a3*pS"},
    "fresh",
)
CAROTENE = _model(
    "kb kcb kco kz kb10 kob10",
    {
        "b": "-kb*b",
        "c": "-(kcb + kco)*c",
        "z": "-kz*z",
        "b10": "kco*c - kb10*b10 + kb*b",
        "o10": "kcb*c + kz*z - kob10*o10",
    },
    {"y1": "b", "y2": "b10"},
)

CASES: dict[str, tuple[Model, list[str], set[str], set[str]]] = {
    "linear": (LINEAR, ["y"], {"a"}, {"b*c"}),
    "two compartments": (COMPARTMENTS, ["y"], set(), {"a01*a12", "a01 + a12 + a21"}),
    "Michaelis-Menten": (MICHAELIS, ["y"], {"k01"}, {"k*c", "V*c"}),
    "JAK-STAT": (JAK_STAT, ["y1", "y2", "y3"], {"k3"}, {"k2/k6", "k5/k6", "k7*E", "k1*E"}),
    "PI loop": (PI_LOOP, ["y"], {"a"}, {"b*kp", "b*ki"}),
    "PI loop and its controller": (PI_LOOP, ["y", "v"], {"a", "b", "kp", "ki"}, set()),
    "predator and prey": (_model("a b c d", PREY, {"y": "x0"}, "u"), ["y"], {"a", "c", "d"}, set()),
    "predators known": (_model("a b c d", PREY, {"y": "x0"}, "u", "x1"), ["y"], {"a", "b", "c", "d"}, set()),
    "cholera": (CHOLERA, ["y"], {"mu", "bi", "bw", "a", "xi", "gam", "k"}, set()),
    "Goodwin": (
        _model("b c alpha beta gama delta sigma", GOODWIN, {"y": "x1"}),
        ["y"],
        {"b", "c", "beta", "delta", "sigma"},
        set(),
    ),
    "Goodwin, two states known": (
        _model("b c alpha beta gama delta sigma", GOODWIN, {"y": "x1"}, known="x2 x3"),
        ["y"],
        {"b", "c", "alpha", "beta", "gama", "delta", "sigma"},
        set(),
    ),
    "constants, two states known": (
        _model("a b c", {"x1": "a + x2 + x3", "x2": "b**2 + c", "x3": "-c"}, {"y": "x1"}, known="x2 x3"),
        ["y"],
        {"a", "b"},
        set(),
    ),
    "growth, its start known": (
        _model("a", {"x1": "a*x1", "x2": "x1 + 1/x1"}, {"y": "x2"}, known="x1"),
        ["y"],
        {"a"},
        set(),
    ),
    "three in line, from the first": (
        _model("a1 a2 b1 b2", {**THREE_IN_LINE, "x1": "-a1*x1 + b1*x2 + u"}, {"y": "x1"}, "u"),
        ["y"],
        {"a1", "a2", "b1", "b2"},
        set(),
    ),
    "three in line, from the last": (
        _model("a1 a2 b1 b2", {**THREE_IN_LINE, "x3": "-b2*x3 + a2*x2 + u"}, {"y": "x1"}, "u"),
        ["y"],
        set(),
        {"b1*b2", "a1 + a2 + b1 + b2", "a1*a2 + a1*b2"},
    ),
    "quadratic": (QUADRATIC, ["y"], set(), {"p1 + p4", "p1*p4 - p2*p3"}),
    "Bellman and Astrom": (BELLMAN, ["y"], set(), {"k2*k3", "k1 + k2", "k3 + k4"}),
    "forced SIRS": (SIRS, ["y1", "y2"], {"mu", "b0", "g", "nu", "M"}, set()),
    "SEIR": (SEIR, ["y"], {"beta", "v", "psi", "gamma"}, set()),
    "bilirubin": (BILIRUBIN, ["y"], set(BILIRUBIN.parameters), set()),
    "biohydrogenation": (HYDROGENATION, ["y1", "y2"], set(HYDROGENATION.parameters), set()),
    "quarantine": (QUARANTINE, ["y"], set(QUARANTINE.parameters), set()),
    "HIV": (HIV, ["y1", "y2"], {"a", "b", "d", "h", "u"}, {"lm/q", "beta*k*q", "c*q**2"}),
    "T cells": (
        T_CELLS,
        ["y1", "y2", "y3"],
        set(T_CELLS.parameters) - {"delta_NE", "rho_E", "rho_P"},
        {"delta_NE/rho_P", "rho_E/rho_P"},
    ),
    "Akt": (
        AKT,
        ["y1", "y2", "y3"],
        {"k2b", "k3", "k4", "k5b", "k6", "k7", "k8"},
        {"k1a - k1b - k9", "k2a/a3", "k5a/a3", "a1/a3", "a2/a3"},
    ),
    "beta-carotene": (CAROTENE, ["y1", "y2"], {"kb", "kb10"}, {"kcb + kco"}),
}
LARGE = ("Akt", "T cells", "HIV", "JAK-STAT")


def _answer(name: str, **options: Any) -> StructuralResult:
    model, outputs, _, _ = CASES[name]
    start = {n: "free" if s.start is None else "given" for n, s in model.states.items()}
    return structural_identifiability(model, list(model.parameters), outputs, start=start, **options)


@pytest.mark.parametrize(("name", "seed"), [(n, s) for n in CASES for s in ([0, 1, 7] if n not in LARGE else [0])])
def test_the_published_functions_are_found(name: str, seed: int) -> None:
    model, _, alone, together = CASES[name]
    result = _answer(name, seed=seed)
    assert result.status == "decided"
    assert result.method == "Taylor series at random points"
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


def test_what_has_no_simple_form_is_tied_together() -> None:
    """Of y = x1 x2 with constant slopes the product of the slopes is seen, of degree 4 in eight parameters."""
    result = structural_identifiability(PRODUCT, list(PRODUCT.parameters), ["y"], start="free")
    assert result.rank == 1 and result.identifiable == ()
    assert [c.members for c in result.combinations] == [tuple(PRODUCT.parameters)]


@pytest.mark.parametrize(
    ("move", "alone", "together"),
    [
        ("constant", set(), {"k21*b", "k1e*k21", "k1e + k12 + k21"}),
        ("ramp", {"k1e", "k12", "k21", "b"}, set()),
        ("free", {"k1e", "k12", "k21", "b"}, set()),
    ],
)
def test_an_input_that_does_not_vary_shows_less(move: str, alone: set[str], together: set[str]) -> None:
    """A. F. Villaverde, N. D. Evans, M. J. Chappell, J. R. Banga, "Input-dependent structural identifiability of nonlinear systems",
    IEEE Control Systems Letters 3 (2019) 272-277 (C2M in STRIKE-GOLDD): x1 is known at the start, x2 is not."""
    states = {"x1": "-(k1e + k12)*x1 + k21*x2 + b*u", "x2": "k12*x1 - k21*x2"}
    model = _model("k1e k12 k21 b", states, {"y": "x1"}, "u", known="x1")
    start: dict[str, Any] = {"x1": "given", "x2": "free"}
    inputs: dict[str, Any] = {"u": move}
    result = structural_identifiability(model, list(model.parameters), ["y"], inputs=inputs, start=start)
    assert set(result.identifiable) == alone
    assert {s for c in result.combinations for s in c.seen} == together
