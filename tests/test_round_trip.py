"""Every result comes back from its JSON as it was: `from_dict(to_dict(x))` is x, and writes the same JSON again."""

from __future__ import annotations

import importlib
import inspect
import json
import pkgutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.data import Trajectory
from hvdc_ident.discrepancy.result import DescribedForm
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.identifiability.pilot_fit import cramer_rao_bounds
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize import Margins, Reduction
from hvdc_ident.sensitivity import SweepSummary, morris, structural_identifiability
from hvdc_ident.simulate import ModelSimulator
from hvdc_ident.study import StageOptions, Summary, load_study, run_all, write_starter
from hvdc_ident.summary import Results

LINK = hi.load_model("vsc-hvdc-link")
CHANNEL: dict[str, Any] = {"inputs": "Vdcref1", "outputs": "Irorder1"}
PRODUCT = hi.Model(
    "product", parameters={"a": 1.0, "b": 2.0}, inputs={"u": 0.0}, states={"x": "a*b*u - x"}, outputs={"y": "x"}
)
TWO = hi.Model(
    "two",
    parameters={"a": 2.0, "k": 3.0},
    inputs={"u": 0.0, "w": 0.0},
    states={"x": "u + k*w - a*x"},
    outputs={"y": "x"},
)
UNSTABLE = hi.Model(  # Routh: 2 x 3 < 4 + 20
    "third",
    inputs={"r": 0.0},
    signals={"e": "r - x"},
    states={"x": "v", "v": "b", "b": "20*e - 4*x - 3*v - 2*b"},
    outputs={"y": "x"},
)
TIME = np.linspace(0.0, 0.3, 61)
MOVE = hi.step(1.0, 1.019, at=0.1)
NAMES = ("KIVDC", "KPVDC")


def recorded() -> hi.Experiment:
    """The link's own response with another gain, and a little noise."""
    run = hi.simulate(LINK, TIME, {"KIVDC": 700.0}, inputs={"Vdcref1": MOVE}, outputs="Irorder1")
    seen = run["Irorder1"] + 1e-4 * np.random.default_rng(1).standard_normal(TIME.size)
    return hi.Experiment(TIME, "e", inputs={"Vdcref1": MOVE}, outputs={"Irorder1": seen}, noise={"Irorder1": 1e-4})


def problem() -> Problem:
    free = tuple(FitParameter(n, LINK.parameters[n].value, 1.0, 2000.0) for n in NAMES)
    return Problem(ModelSimulator(LINK), (recorded(),), free)


def recommendation() -> Any:
    """What to record next where one of two inputs has not moved."""
    signals = {"u": hi.step(0.0, 1.0, at=1.0)}
    time = np.linspace(0.0, 5.0, 101)
    seen = hi.simulate(TWO, time, inputs=signals)["y"] + 1e-3 * np.random.default_rng(2).standard_normal(time.size)
    record = hi.Experiment(time, "e", inputs=signals, outputs={"y": seen}, noise={"y": 1e-3})
    found = hi.identify(TWO, record, {"a": (0.2, 20.0), "k": (0.3, 30.0)})
    assert found.recommended is not None
    return found.recommended


def linear() -> Any:
    return hi.linearize(LINK, **CHANNEL)


def other() -> Any:
    return hi.linearize(LINK, values={"KIVDC": 500.0}, **CHANNEL)


def mode() -> Any:
    found = hi.linearize(LINK, **CHANNEL, sensitivities=NAMES).modes()[0]
    assert found.sensitivity, "with derivatives"
    return found


def limit() -> Any:
    return hi.find_operating_point(LINK).limits[0]


MADE: dict[str, Callable[[], Any]] = {
    "simulation": lambda: hi.simulate(LINK, TIME, inputs={"Vdcref1": MOVE}, sensitivities=NAMES),
    "trajectory": lambda: recorded().measured,
    "sensitivities": lambda: hi.sensitivities(LINK, TIME, list(NAMES), inputs={"Vdcref1": MOVE}, outputs="Irorder1"),
    "sweep": lambda: hi.sweep(LINK, recorded(), {"KIVDC": [600.0, 700.0]}, want=["rmse", "poles"]),
    "screening": lambda: morris(LINK, [recorded()], dict.fromkeys(NAMES, (10.0, 900.0)), trajectories=2),
    "structural": lambda: structural_identifiability(PRODUCT, ["a", "b"], ["y"], inputs={"u": "step"}),
    "bounds": lambda: cramer_rao_bounds(problem()),
    "mode": mode,
    "limit": limit,
    "locus": lambda: hi.linear.root_locus(LINK, "KIVDC", [500.0, 900.0]),
    "stability": lambda: linear().stability(),
    "transfer-function": lambda: linear().transfer_function("Vdcref1", "Irorder1"),
    "peak": lambda: hi.linear.linf_norm(linear()),
    "distance": lambda: hi.linear.compare(linear(), other()),
    "response": lambda: linear().bode(),
    "point": lambda: hi.find_operating_point(LINK, inputs={"Pref2": 0.5}),
    "linear-model": linear,
    "margins": lambda: hi.linear.margins(hi.linear.loop(LINK, "ev")),
    "margins-of-an-unstable-loop": lambda: hi.linear.margins(hi.linear.loop(UNSTABLE, "e")),
    "loop-margins": lambda: hi.linear.loop_margins(hi.linear.loop(LINK, ["ev", "ep"])),
    "recommendation": recommendation,
    "form": lambda: DescribedForm("term", "ev", "a term", "c*Vdc1", FrozenMap({"c": 0.1}), delta_bic=12.0),
    "sweep-summary": lambda: SweepSummary.from_dict(made("sweep").to_dict()),
    "reduction": lambda: linear().reduce(order=2),
}
OF_A_RUN: dict[str, Callable[[Path], Any]] = {
    "identify": lambda folder: Results(folder).objects.identified,
    "fit": lambda folder: Results(folder).objects.fit,
    "linear-models": lambda folder: Results(folder).linear,
    "of-a-simulation": lambda folder: Results(folder).objects.simulated,
    "of-a-fit": lambda folder: Results(folder).objects.of_fit,
    "of-a-diagnosis": lambda folder: Results(folder).objects.of_diagnosis,
    "check": lambda folder: Summary.of(load_study(folder.parent.parent / "study.toml")),
    "diagnose": lambda folder: Results(folder).objects.diagnosis,
    "summary": lambda folder: Results(folder).summary,
    "compare": lambda folder: hi.compare_runs(folder, folder),
}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of the study that `new` writes, with a diagnosis."""
    path = write_starter(tmp_path_factory.mktemp("new") / "s")
    more = (
        '\n[diagnose]\neffects = ["lag"]\n[linearize]\ninputs = ["Vdcref1"]\noutputs = ["Irorder1"]\nbreak_at = ["ev"]\n'
        'plant = {inputs = ["Irorder1"], outputs = ["Vdc1_m"]}\nreduce = {order = 2}\n'
    )
    path.write_text(path.read_text("utf-8") + more, "utf-8")
    study = load_study(path)
    folder = study.folder / "r"
    run_all(study, folder, StageOptions(folder=folder))
    return folder


@cache
def made(name: str) -> Any:
    """A result of one kind, made once."""
    return MADE[name]()


@pytest.mark.parametrize("name", MADE)
def test_a_result_comes_back_from_its_json(name: str) -> None:
    comes_back(made(name))


@pytest.mark.parametrize("name", OF_A_RUN)
def test_a_result_of_a_study_comes_back_from_its_json(name: str, results: Path) -> None:
    comes_back(OF_A_RUN[name](results))


def comes_back(result: Any) -> None:
    data = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    again = type(result).from_dict(data)
    assert again.to_dict() == data
    same(result, again)


OWN_FORM = (hi.Simulation, hi.SweepResult, hi.linear.FrequencyResponse, hi.LinearModel, Trajectory)
"""Tables whose JSON is by the names of their columns: what they keep beside these numbers is not in it."""


def same(one: Any, two: Any, where: str = "") -> None:
    """Two values are equal but for what JSON does not hold: which of the numbers that are not finite, and fields that are not stored."""
    if is_dataclass(one):
        assert type(one) is type(two), where
        for f in fields(one):
            if f.metadata.get("json", f.name) and not isinstance(one, OWN_FORM):
                same(getattr(one, f.name), getattr(two, f.name), f"{where}.{f.name}")
    elif isinstance(one, Mapping):
        assert list(one) == list(two), where
        for key in one:
            same(one[key], two[key], f"{where}.{key}")
    elif isinstance(one, np.ndarray):
        assert one.shape == two.shape, where
        np.testing.assert_array_equal(np.where(np.isfinite(one), one, 0), np.where(np.isfinite(two), two, 0), where)
    elif isinstance(one, list | tuple):
        assert len(one) == len(two), where
        for k, (a, b) in enumerate(zip(one, two, strict=True)):
            same(a, b, f"{where}.{k}")
    elif isinstance(one, float) and not np.isfinite(one):
        assert two is None or not np.isfinite(two), where
    else:
        assert one == two, where


def test_margins_that_are_read_again_say_which_are_unlimited_and_which_none_are() -> None:
    """JSON has null for both: a stable loop's are infinite, and an unstable one has none."""
    stable, unstable = (Margins.from_dict(made(n).to_dict()) for n in ("margins", "margins-of-an-unstable-loop"))
    assert (
        str(stable) == str(made("margins"))
        and not np.isnan([m.value for m in (stable.gain_margin, stable.delay)]).any()
    )
    assert (
        unstable.stable is False
        and np.isnan([unstable.gain_margin.value, unstable.disk.value, unstable.phase_margin.value]).all()
    )
    assert str(unstable) == str(made("margins-of-an-unstable-loop"))


def test_a_point_that_is_read_again_knows_what_only_its_model_tells() -> None:
    point = made("point")
    again = hi.OperatingPoint.from_dict(json.loads(json.dumps(point.to_dict())))
    assert point.stable is True and again.stable is True and again.model is None
    assert again.notes == point.notes and again.active_limits == point.active_limits and str(again) == str(point)
    np.testing.assert_array_equal(again.w, point.w)


def test_the_error_of_a_reduction_is_that_of_the_reduction_that_was_written() -> None:
    again = Reduction.from_dict(made("reduction").to_dict())
    assert again.error.value == pytest.approx(made("reduction").error.value, rel=1e-9) and again.error.value > 0.0


def kinds() -> Iterator[type]:
    """Every class of the package that can be written as JSON."""
    for found in pkgutil.walk_packages(hi.__path__, "hvdc_ident."):
        module = importlib.import_module(found.name)
        yield from (
            c
            for c in vars(module).values()
            if inspect.isclass(c) and c.__module__ == found.name and hasattr(c, "to_dict")
        )


NO_RESULTS = {
    "Coded": "what results are made from",
    "EffectUse": "a line of a study file, which EffectUse.of reads",
    "NewStudy": "what was written is the study file, which load_study reads",
}


def test_every_class_with_a_json_reads_it_back() -> None:
    assert {c.__name__ for c in kinds() if not hasattr(c, "from_dict")} == set(NO_RESULTS) - {"Coded"}


def test_every_result_is_tried_here_or_beside_its_own_tests(results: Path) -> None:
    tried: set[str] = set()
    for result in (*map(made, MADE), *(make(results) for make in OF_A_RUN.values())):
        tried |= {type(part).__name__ for part in parts(result)}
    beside = {
        "Capabilities": "tests/fmu",
        "SteadySensitivities": "tests/sensitivity",
    }
    missing = {c.__name__ for c in kinds()} - tried - set(beside) - set(NO_RESULTS)
    assert not missing, f"results that nothing reads back: {sorted(missing)}"


def parts(value: Any) -> Iterator[Any]:
    """A value and all that its fields hold."""
    if is_dataclass(value):
        yield value
        for f in fields(value):
            yield from parts(getattr(value, f.name))
    elif isinstance(value, Mapping | list | tuple):
        for inner in value.values() if isinstance(value, Mapping) else value:
            yield from parts(inner)
