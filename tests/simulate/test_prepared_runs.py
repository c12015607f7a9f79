"""Runs of one experiment that differ by values alone go through what was prepared for the first: they are those of a fresh start."""

from dataclasses import replace

import numpy as np
import pytest

from hvdc_ident.data import Experiment, InputSignal, experiment
from hvdc_ident.errors import ModelError, UnknownNameError
from hvdc_ident.model import Model
from hvdc_ident.simulate import Tolerance, simulate
from hvdc_ident.simulate.experiment_run import _prepared

TIME = np.linspace(0.0, 1.0, 81)
PLANT = Model(
    "plant",
    parameters={"a": 3.0, "k": 2.0, "T": 0.1, "top": 0.6},
    inputs={"u": 0.0, "v": 0.1},
    states={"x": "a*(k*held - x) + v", "z": "x - z"},
    signals={"held": "min(d, top)"},
    delays={"d": {"of": "u", "time": "T"}},
    outputs={"x": "x", "y": "x + z"},
)
STEP = {"u": InputSignal.step(0.2, 0.0, 1.0)}
KINDS = {
    "inputs": experiment("inputs", TIME, STEP),
    "ramp": experiment("ramp", TIME, {"u": InputSignal.ramp(0.1, 0.0, 0.5, 1.0)}),
    "values": experiment("values", TIME, STEP).with_(values={"v": 0.4}),
    "offset": experiment("offset", TIME, STEP).with_(offsets={"u": 0.05}),
    "start": experiment("start", TIME, STEP).with_(starts={"x": 0.3}),
    "driven": experiment("driven", TIME, {"held": InputSignal.step(0.3, 0.0, 0.4)}).with_(drive=("held",)),
    "instrument": experiment("instrument", TIME, STEP).with_(instrument={"y": {"delay": 0.02}}),
}
POINTS = (
    {},
    {"a": 2.0, "k": 1.5},
    {"top": 0.3, "T": 0.2},
    {"T": 0.0},
    {"v": 0.3, "a": 4.0},
    {"T": 1e-5},
)


def outcome(model: Model, e: Experiment, values: dict[str, float], by: tuple[str, ...], tolerance: Tolerance) -> object:
    run = simulate(model, e, values, by, tolerance=tolerance, method="rosenbrock")
    return run.trajectory.values.tobytes(), run.gradients.tobytes(), run.statistics


@pytest.mark.parametrize("by", [(), ("a", "T")], ids=["alone", "with derivatives"])
@pytest.mark.parametrize("brief", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_a_run_does_not_hang_on_those_before(kind: str, brief: bool, by: tuple[str, ...]) -> None:
    e, tolerance = KINDS[kind], Tolerance(1e-6, 1e-8, brief=brief)
    fresh = []
    for values in POINTS:
        _prepared.cache_clear()
        fresh.append(outcome(PLANT, e, values, by, tolerance))
    again = [outcome(PLANT, e, values, by, tolerance) for values in POINTS]
    assert again == fresh
    assert len({told[0] for told in fresh}) > 3  # type: ignore[index]


@pytest.mark.parametrize("slides", [False, True])
def test_what_is_compiled_when_it_is_asked_for_gives_the_same_runs(slides: bool) -> None:
    """By both methods, and along the surface of a switch: a relay holds x at the moving reference."""
    relay = Model(
        "relay",
        inputs={"u": 0.0},
        states={"x": {"derivative": "where(x < u, 3, -3)", "start": "0.2"}, "z": "x - z"},
        outputs={"x": "x", "z": "z"},
    )
    e = experiment("relay", TIME, {"u": InputSignal.ramp(0.3, 0.4, 0.9, 0.8)})
    models = (PLANT, KINDS["inputs"]), *([(relay, e)] if slides else [])
    for model, record in models:
        for method in ("explicit", "rosenbrock", "nonstiff", "auto"):
            well, quick = (
                simulate(model, record, tolerance=Tolerance(1e-8, 1e-10, brief=b, slides=slides), method=method)  # type: ignore[arg-type]
                for b in (False, True)
            )
            assert quick.trajectory.values == pytest.approx(well.trajectory.values, abs=1e-7)
            assert quick.statistics.method == well.statistics.method


def test_wrong_values_are_told_after_right_ones_too() -> None:
    e = KINDS["inputs"]
    simulate(PLANT, e, {"a": 2.0})
    with pytest.raises(UnknownNameError, match="nothing"):
        simulate(PLANT, e, {"a": 2.0, "nothing": 1.0})
    with pytest.raises(ModelError, match="'k' is not finite"):
        simulate(PLANT, e, {"k": np.inf})
    assert simulate(PLANT, e, {"u": 7.0})["x"] == pytest.approx(simulate(PLANT, e)["x"])  # a signal drives it


def test_models_alike_but_for_their_origin_are_prepared_apart() -> None:
    """Of two steady states the one that is connected with the root's own is begun at."""
    root = Model(
        "two", parameters={"p": 0.0}, states={"x": {"derivative": "x - x**3 + p", "guess": 1.0}}, outputs={"x": "x"}
    )
    moved = root.with_values({"p": 0.1})
    alone = replace(moved, origin=None)
    assert moved == alone
    e = experiment("rest", TIME)
    for _ in range(2):
        for model in (moved, alone):
            assert simulate(model, e)["x"][-1] > 1.0
    hits = _prepared.cache_info().hits
    assert simulate(moved, e)["x"][0] == pytest.approx(simulate(alone, e)["x"][0])
    assert _prepared.cache_info().hits == hits + 2
