"""Every optimiser of the catalogue: known minima, budgets, failing runs, seeds, missing packages."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hvdc_ident.errors import InputError, UnknownNameError
from hvdc_ident.fit import fit
from hvdc_ident.fit.optimiser import OptimiserResult
from hvdc_ident.fit.optimisers import catalogue, is_global, need, optimiser
from tests.fit.known_minima import TABLE, T
from tests.fit.simulators import Closed, decay, parameters, recorded

CATALOGUE = catalogue()
PRECISE = {"trust-region", "least-squares", "l-bfgs-b", "nelder-mead", "dual-annealing"}
EXTRAS = {"cma-es": "cma", "particle-swarm": "pyswarms"}


def ready(name: str):
    """The optimiser; the test is skipped, and says so, where its package is not installed."""
    if name in EXTRAS:
        # Imported by the optimiser itself, which keeps the package's side effects away.
        import importlib.util

        if importlib.util.find_spec(EXTRAS[name]) is None:
            pytest.skip(f"{EXTRAS[name]} is not installed (extra 'optimisers')")
    return optimiser(name)


def test_the_catalogue_is_rapids_and_the_files_say_what_they_are():
    wanted = {"trust-region", "least-squares", "l-bfgs-b", "nelder-mead", "differential-evolution", "dual-annealing"}
    assert wanted | set(EXTRAS) == set(CATALOGUE)
    assert all(m.SUMMARY and "\n" not in m.SUMMARY and m.__doc__ for m in CATALOGUE.values())
    with pytest.raises(UnknownNameError, match="did you mean 'nelder-mead'"):
        optimiser("nelder-maed")


@pytest.mark.parametrize("known", TABLE, ids=lambda k: k.name)
@pytest.mark.parametrize("name", CATALOGUE)
def test_the_known_minimum_is_reached(name, known):
    problem = known.make()
    run = ready(name).run(problem, problem.start)
    assert run.status == "converged", run.message
    if known.rough and not is_global(optimiser(name)):
        assert run.cost >= known.cost - 1e-9  # a local method may end in any of the minima, at none below the least
        return
    spans = np.array([u.span for u in problem.unknowns])
    away = np.abs(run.theta - np.array(known.theta)) / spans
    precise = name in PRECISE
    assert run.cost == pytest.approx(known.cost, abs=1e-6 if precise else 1e-3)
    assert away.max() < (1e-5 if precise else 1e-3)
    assert run.cost == pytest.approx(problem.cost(run.theta), rel=1e-9, abs=1e-15)


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_run_keeps_to_its_evaluations_and_says_that_they_are_spent(name):
    ready(name)
    problem = TABLE[3].make()
    problem.simulator.runs = 0
    limit = 40 if name == "particle-swarm" else 5  # a swarm is counted as a whole
    run = CATALOGUE[name].OPTIMISER(max_evaluations=limit).run(problem, problem.start)
    assert run.status == "max-evaluations"
    assert run.evaluations == problem.simulator.runs
    assert run.cost == pytest.approx(problem.cost(run.theta))
    assert "no optimum within" in run.message


@pytest.mark.parametrize("name", CATALOGUE)
def test_where_nothing_can_be_simulated_the_run_fails_without_a_number(name):
    problem = decaying(lambda p: True)
    run = ready(name).run(problem, problem.start)
    assert (run.status, run.cost) == ("failed", None)
    assert "the run does not reach its end" in run.message


def decaying(fails):
    simulator = Closed(parameters(a=1.0, k=1.0), {"y": decay}, fails)
    from hvdc_ident.fit import FitParameter, Problem

    free = (FitParameter("a", 1.0, 0.1, 10.0), FitParameter("k", 1.0, 0.0, 20.0))
    return Problem(simulator, (recorded("e", T, {"y": 0.1}, y=2 * np.exp(-1.5 * T)),), free)


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_region_that_cannot_be_simulated_is_walked_round(name):
    result = fit(decaying(lambda p: p["k"] > 4.0), optimiser=ready(name), starts=1)
    assert result.status == "converged", result.message
    assert result.estimates["k"].value == pytest.approx(1.5, rel=1e-6)
    assert result.estimates["a"].value == pytest.approx(2.0, rel=1e-6)


@pytest.mark.parametrize("name", [n for n in CATALOGUE if is_global(optimiser(n))])
def test_the_seed_decides_the_run_and_leaves_the_global_generator_alone(name):
    problem = TABLE[3].make()
    ready(name)

    def run(seed: int) -> OptimiserResult:
        return replace(optimiser(name, seed), max_evaluations=40).run(problem, problem.start)

    before = np.random.get_state()[1].copy()
    one, two, other = run(1), run(1), run(2)
    assert np.array_equal(one.theta, two.theta) and one.evaluations == two.evaluations
    assert not np.array_equal(one.theta, other.theta)
    assert np.array_equal(np.random.get_state()[1], before)


@pytest.mark.parametrize(("name", "package"), EXTRAS.items())
def test_without_its_package_an_optimiser_names_the_extra(name, package, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    problem = TABLE[0].make()
    text = rf"'{name}' needs the package {package}.*hvdc_ident\[optimisers\]"
    with pytest.raises(InputError, match=text):
        optimiser(name).run(problem, problem.start)
    monkeypatch.setattr("importlib.util.find_spec", lambda wanted: None)
    with pytest.raises(InputError, match=text):
        need(name)
    need("trust-region")


def test_the_extra_lists_the_packages():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))
    extra = project["project"]["optional-dependencies"]["optimisers"]
    assert {e.split(">")[0] for e in extra} == set(EXTRAS.values())


def test_the_swarm_writes_no_file_where_it_runs_and_sets_up_no_logging(tmp_path):
    ready("particle-swarm")
    code = (
        "import logging; from tests.fit.known_minima import TABLE; from hvdc_ident.fit.optimisers import optimiser;"
        "p = TABLE[4].make(); print(optimiser('particle-swarm').run(p, p.start).status, logging.getLogger().handlers)"
    )
    root = str(Path(__file__).parents[2])
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env={"PYTHONPATH": root}, capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == "converged []"
    assert run.stderr == ""
    assert list(tmp_path.iterdir()) == []
