"""Modelica text: what it says, and the same trajectories from a Modelica compiler of another maker."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.errors import ExpressionError
from hvdc_ident.fmu.export.modelica_model import modelica, output_name
from hvdc_ident.model import Model
from hvdc_ident.models import load_model
from hvdc_ident.simulate import simulate
from tests.fmu_export import cases

CASES = {
    "link": (cases.link, "Pref2", 0.4, 0.6),
    "link in its limits": (cases.link, "Vdcref1", 1.0, 1.06),
    "augmented": (cases.augmented, "Vdcref1", 1.0, 1.03),
    "remembering": (cases.remembering, "Pref2", 0.4, 0.6),
    "zoo": (cases.zoo, "u", 0.2, 0.9),
    "average-value": (lambda: load_model("vsc-hvdc-avm"), "Pref2", 0.4, 0.6),
}


def compiled_run(model, steady, stepped, before, after):
    """Time and outputs of the model under a step, by the Modelica compiler; None where it is not installed."""
    rumoca = pytest.importorskip("rumoca", reason="the Modelica compiler rumoca is not installed")
    held = {n: repr(i.value) for n, i in model.inputs.items()}
    held[stepped] = f"if time < 0.05 then {before} else {after}"
    bench = f"model Bench\n  Plant plant({', '.join(f'{n} = {v}' for n, v in held.items())});\nend Bench;\n"
    made = rumoca.Session().loads(modelica(model, "Plant", steady) + bench, model="Bench")
    assert made.structure().is_balanced
    settings = rumoca.SimConfig(rtol=1e-8, atol=1e-10, dt=1e-3)
    run = made.simulate(t=(0.0, 0.2), config=settings)
    time = np.asarray(run.time)
    return time, {n: np.asarray(run[f"plant.{output_name(model, n)}"]) for n in model.outputs}


@pytest.mark.parametrize("name", sorted(CASES))
def test_a_modelica_compiler_simulates_the_same(name):
    make, stepped, before, after = CASES[name]
    model = make()
    # The compiler's own search for the start does not settle on the average-value link: there it gets the numbers.
    time, found = compiled_run(model, False if name == "average-value" else None, stepped, before, after)
    inputs = {stepped: InputSignal.step(0.05, before, after)}
    keep = (np.abs(time - 0.05) > 1e-6) & np.append(np.diff(time) > 0.0, True)
    time = time[keep]

    def run(shift):
        at = np.where(time > 0.0, time + shift, time)
        return simulate(model, experiment("case", at, inputs), rtol=1e-10)

    if model.sampled:  # a row at the very instant of a sample may stand on either side of it
        early, late = run(-1e-7), run(1e-7)
        settled = np.all([np.abs(early[o] - late[o]) < 1e-5 for o in model.outputs], axis=0)
        assert settled.mean() > 0.5
    else:
        settled = np.ones(time.size, dtype=bool)
    expected = run(0.0)
    for o in model.outputs:
        size = np.abs(expected[o]).max() + 1e-3
        assert np.abs(found[o][keep] - expected[o])[settled].max() < 1e-4 * size, o


def test_names_that_modelica_uses_are_quoted_and_clashes_told_apart():
    model = Model(
        name="2 words, one model",
        parameters={"end": 2.0},
        inputs={"when": 1.0},
        states={"der": "(when - der)*end"},
        outputs={"y": "der", "when": "2*when", "der": "der"},
        description='says "more"\nthan a line',
    )
    text = modelica(model)
    assert text.startswith('model M_2_words__one_model "says \\"more\\" than a line"\n')
    assert "parameter Real 'end' = 2.0;" in text and "der('der') = " in text and "output Real 'der'(" in text
    assert "when_output = (2*'when');" in text


def test_choices_are_written_with_helpers_and_without_equality_of_reals():
    model = Model(
        name="choices",
        inputs={"u": 1.0},
        outputs={"y": "clip(u + 1, -2, 2) + abs(u*3) + where(u == 2, 1, 0) + max(u, 0.5, u**2)"},
    )
    text = modelica(model)
    assert "==" not in text and "abs(" not in text and text.count("helper_1") > 2


def test_the_start_may_be_numbers():
    text = modelica(cases.link(), steady=False)
    assert "initial equation" not in text and "Vdc1(start = 1.0, fixed = true)" in text
    assert "initial equation" in modelica(cases.link())


def test_a_function_without_a_word_is_named():
    import sympy as sp

    from hvdc_ident.expression import symbol

    model = Model(name="odd", inputs={"u": 1.0}, outputs={"y": sp.besselj(0, symbol("u"))})
    with pytest.raises(ExpressionError, match="besselj"):
        modelica(model)
