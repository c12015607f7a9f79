"""Every result comes back from its JSON as it was: `from_dict(to_dict(x))` is x, and writes the same JSON again."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.codec import Coded
from hvdc_ident.data import Trajectory
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.identifiability.pilot_fit import cramer_rao_bounds
from hvdc_ident.sensitivity import morris, structural_identifiability
from hvdc_ident.simulate import ModelSimulator
from hvdc_ident.study import StageOptions, load_study, run_all, write_starter
from hvdc_ident.summary import Results

LINK = hi.load_model("vsc-hvdc-link")
CHANNEL: dict[str, Any] = {"inputs": "Vdcref1", "outputs": "Irorder1"}
PRODUCT = hi.Model(
    "product", parameters={"a": 1.0, "b": 2.0}, inputs={"u": 0.0}, states={"x": "a*b*u - x"}, outputs={"y": "x"}
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
}
OF_A_RUN: dict[str, Callable[[Path], Any]] = {
    "identify": lambda folder: Results(folder).objects.identified,
    "fit": lambda folder: Results(folder).objects.fit,
    "diagnose": lambda folder: Results(folder).objects.diagnosis,
    "summary": lambda folder: Results(folder).summary,
    "compare": lambda folder: hi.compare_runs(folder, folder),
}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of the study that `new` writes, with a diagnosis."""
    path = write_starter(tmp_path_factory.mktemp("new") / "s")
    path.write_text(path.read_text("utf-8") + '\n[diagnose]\neffects = ["lag"]\n', "utf-8")
    study = load_study(path)
    folder = study.folder / "r"
    run_all(study, folder, StageOptions(folder=folder))
    return folder


@pytest.mark.parametrize("name", MADE)
def test_a_result_comes_back_from_its_json(name: str) -> None:
    comes_back(MADE[name]())


@pytest.mark.parametrize("name", OF_A_RUN)
def test_a_result_of_a_study_comes_back_from_its_json(name: str, results: Path) -> None:
    comes_back(OF_A_RUN[name](results))


def comes_back(result: Any) -> None:
    data = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    again = type(result).from_dict(data)
    assert again.to_dict() == data
    same(result, again)


OWN_FORM = (hi.Simulation, hi.SweepResult, hi.linear.FrequencyResponse, Trajectory)
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


def test_every_result_with_a_json_is_tried_here_or_beside_its_own_tests() -> None:
    """A new kind of result is added to the list above."""
    tried = {
        "Trajectory",
        "Simulation",
        "Sensitivities",
        "SteadySensitivities",
        "LinearSensitivities",
        "LocalSensitivities",
    }
    tried |= {
        "SweepResult",
        "ScreeningResult",
        "StructuralResult",
        "CramerRaoBounds",
        "Mode",
        "Limit",
        "RootLocus",
        "Stability",
    }
    tried |= {
        "TransferFunction",
        "Peak",
        "NuGap",
        "ModelDistance",
        "IdentifiabilityReport",
        "Recommendation",
        "Move",
        "FitResult",
    }
    tried |= {"Diagnosis", "DescribedForm", "Judgement", "Judgements", "RunSummary", "RunComparison"}
    beside = {"Context", "DiagnosisContext", "Capabilities"}
    assert {c.__name__ for c in Coded.__subclasses__() if c.__module__.startswith("hvdc_ident.")} <= tried | beside
