"""A movable effect equals the same effect put in: values and derivatives, wherever it sits and whatever it brings in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hvdc_ident import Experiment, InputSignal, Model, load_model
from hvdc_ident.data import Array
from hvdc_ident.discrepancy.candidates import CandidateEffect, candidates, entries
from hvdc_ident.discrepancy.movable import Form, movable
from hvdc_ident.effects import Probe, apply_effects, joined_sources
from hvdc_ident.errors import SimulationError, SteadyStateError
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import parse_card
from hvdc_ident.simulate import Simulation, Tolerance, simulate
from tests.discrepancy.cases import experiments as of_drive
from tests.discrepancy.cases import model as drive

CIRCLE = """
schema = 1
name = "a valve behind a pipe, and a resistance that hangs on its own current"
[parameters]
k = {value = 3.0}
T = {value = 0.05, unit = "s"}
late = {value = 0.03, unit = "s"}
r = {value = 0.4}
[inputs]
u = {value = 0.5}
v = {value = 0.2}
[states]
x = {derivative = "(arrived - x + 0.3*i) / T"}
q = {derivative = "k*(u - x - 0.2*q)"}
[algebraic]
i = {equation = "(x + v) / (1 + r*i**2)"}
[signals]
err = "u - x"
order = "q + 0.5*err"
[delays]
arrived = {of = "order", time = "late"}
[outputs]
x = "x"
i = "i"
"""
EXACT = Tolerance(rtol=1e-9, atol=1e-11, max_steps=50_000)
OUTPUTS = {"drive": ("w", "torque"), "circle": ("x", "i"), "link": ("P2", "Vdc1", "Q1")}
HUNTS = ("quantisation", "backlash")
"""Two of these in one loop turn about their edges."""


@cache
def setting(name: str) -> tuple[Model, Experiment, tuple[str, ...]]:
    """Return a model, what happens in it, and parameters whose derivatives are asked for."""
    if name == "drive":
        return drive(), of_drive()[0].with_(measured=None), ("Kp", "J")
    time = np.linspace(0.0, 0.5, 201)
    if name == "circle":
        moves = FrozenMap({"u": InputSignal.step(0.1, 0.5, 0.8), "v": InputSignal.step(0.25, 0.2, -0.1)})
        return parse_card(CIRCLE), Experiment(time, "steps", inputs=moves), ("k", "r")
    link = load_model("vsc-hvdc-link")
    return link, Experiment(time, "step", inputs=FrozenMap({"Pref2": InputSignal.step(0.1, 0.4, 0.5)})), ("KPP", "C1")


@cache
def signals(name: str) -> dict[str, tuple[Array]]:
    """Return the signal at every insertion point of a model."""
    model, experiment, _ = setting(name)
    inner = [p for p in model.insertion_points if not p.startswith("outputs.")]
    whole = simulate(model, experiment, outputs=list(dict.fromkeys([*inner, *model.outputs])))
    return {p: (np.asarray(whole[p.removeprefix("outputs.")]),) for p in model.insertion_points}


def found(name: str, effect: str) -> list[CandidateEffect]:
    """Return the candidates of a diagnosis that looks for one effect, at one place each."""
    model, experiment, _ = setting(name)
    every = candidates(model, signals(name), [experiment.time], [effect], None)
    return [c for c in every if len(c.at) == 1 and not c.still and c.probes]


def chosen(name: str, effect: str) -> list[tuple[Form, list[tuple[CandidateEffect, Probe]]]]:
    """By form a candidate at two places each by itself, and the effect at both together; of the large model a form at one place."""
    model = setting(name)[0]
    by_form: dict[Form, list[tuple[CandidateEffect, Probe]]] = {}
    for c in found(name, effect):
        for p in c.probes:
            by_form.setdefault(Form.of(model, c, p.values), []).append((c, p))
    random = np.random.default_rng([len(name), *effect.encode()])
    picked = []
    for form, columns in by_form.items():
        order = [columns[k] for k in random.permutation(len(columns))]
        first = order[0]
        if name == "link":
            return [(form, order[:3])]
        other = next(((c, p) for c, p in order if c.at != first[0].at and c.named == first[0].named), None)
        picked.append((form, [first] if other is None else [first, other]))
        if other is None or effect in HUNTS or {*first[0].at, *other[0].at} & {*first[0].sources, *other[0].sources}:
            continue  # a source of one that is the place of the other would be that before it, or behind
        one, two = first[0], other[0]
        both = replace(one, at=(*one.at, *two.at), source=joined_sources([*one.sources, *two.sources]))
        picked.append((Form.of(model, both, first[1].values), [(both, first[1])]))
    return picked


def compared(
    name: str, form: Form, columns: Sequence[tuple[CandidateEffect, Probe]]
) -> list[tuple[str, float, float, bool]]:
    """Return by candidate the differences in values and in derivatives, each over the largest of these, and whether it does anything."""
    model, experiment, gains = setting(name)
    still = simulate(model, experiment, outputs=OUTPUTS[name], tolerance=EXACT).trajectory.values
    places = [p for p in model.insertion_points if any(p in c.at for c, _ in columns)]
    sources = [s for s in model.insertion_points if any(s in c.sources for c, _ in columns)]
    moving = movable(model, form, places, sources)
    told = []
    for candidate, probe in columns:
        placed = apply_effects(model, [candidate.use(probe)])
        new = [n for n in placed.parameters if n not in model.parameters]
        own = dict(zip([n for n in form.present if n not in candidate.named], new, strict=True))
        named = {n: model.parameters[str(p)].value for n, p in candidate.named.items()}
        values = moving.placed(candidate) | moving.sized({**probe.values, **named})
        free = [n for n in probe.free if n in own]
        got = run(moving.model, experiment, values, (*gains, *(moving.names[n] for n in free)), OUTPUTS[name])
        true = run(placed, experiment, {}, (*gains, *(own[n] for n in free)), OUTPUTS[name])
        assert (got is None) == (true is None), f"{candidate.label} runs in one of the two alone"
        if got is None or true is None:
            continue
        told.append((candidate.label, *apart(got, true), not np.array_equal(true.trajectory.values, still)))
        if name == "link":
            break
    return told


def run(
    model: Model, experiment: Experiment, values: Mapping[str, float], slopes: Sequence[str], outputs: Sequence[str]
) -> Simulation | None:
    """Return a run with its derivatives; None where the model does not come to its end."""
    try:
        return simulate(model, experiment, values, slopes, outputs=outputs, tolerance=EXACT)
    except (SimulationError, SteadyStateError):
        return None


def apart(got: Simulation, true: Simulation) -> tuple[float, float]:
    """Return the differences of two runs in values and in derivatives, over the largest of these."""
    values, slopes = true.trajectory.values, true.gradients
    return (
        float(np.abs(got.trajectory.values - values).max() / np.abs(values).max()),
        float(np.abs(got.gradients - slopes).max() / np.abs(slopes).max()),
    )


CASES = [
    (name, e.name)
    for name in OUTPUTS
    for e in entries("all")
    if name == "link" or e.name != "inductance"  # it needs a resistance that it may stand beside
]


@pytest.mark.parametrize(("name", "effect"), CASES)
def test_a_movable_effect_is_the_effect_put_in(name: str, effect: str) -> None:
    told = [line for form, columns in chosen(name, effect) for line in compared(name, form, columns)]
    assert told
    for label, values, slopes, _ in told:
        assert values < 1e-5 and slopes < 1e-5, label
    assert name == "link" or any(acts for *_, acts in told), "nothing of what is compared does anything"
