"""Every optimiser of the catalogue: known minima, budgets, failing runs."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident.errors import UnknownNameError
from hvdc_ident.fit import fit
from hvdc_ident.fit.optimisers import catalogue, optimiser
from tests.fit.known_minima import TABLE, T
from tests.fit.simulators import Closed, decay, parameters, recorded

CATALOGUE = catalogue()


def test_the_files_of_the_catalogue_say_what_they_are():
    assert set(CATALOGUE) >= {"trust-region", "least-squares", "l-bfgs-b"}
    assert all(m.SUMMARY and "\n" not in m.SUMMARY and m.__doc__ for m in CATALOGUE.values())
    with pytest.raises(UnknownNameError, match="did you mean 'least-squares'"):
        optimiser("least-squarse")


@pytest.mark.parametrize("known", TABLE, ids=lambda k: k.name)
@pytest.mark.parametrize("name", CATALOGUE)
def test_the_known_minimum_is_reached(name, known):
    problem = known.make()
    run = optimiser(name).run(problem, problem.start)
    assert run.status == "converged", run.message
    if known.rough:
        assert run.cost >= known.cost - 1e-9  # a local method may end in any of the minima, at none below the least
        return
    spans = np.array([u.span for u in problem.unknowns])
    away = np.abs(run.theta - np.array(known.theta)) / spans
    assert run.cost == pytest.approx(known.cost, abs=1e-6)
    assert away.max() < 1e-5
    assert run.cost == pytest.approx(problem.cost(run.theta), rel=1e-9, abs=1e-15)


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_run_keeps_to_its_evaluations_and_says_that_they_are_spent(name):
    problem = TABLE[3].make()
    problem.simulator.runs = 0
    run = CATALOGUE[name].OPTIMISER(max_evaluations=5).run(problem, problem.start)
    assert run.status == "max-evaluations"
    assert run.evaluations == problem.simulator.runs
    assert run.cost == pytest.approx(problem.cost(run.theta))
    assert "no optimum within" in run.message


@pytest.mark.parametrize("name", CATALOGUE)
def test_where_nothing_can_be_simulated_the_run_fails_without_a_number(name):
    problem = decaying(lambda p: True)
    run = optimiser(name).run(problem, problem.start)
    assert (run.status, run.cost) == ("failed", None)
    assert "the run does not reach its end" in run.message


def decaying(fails):
    simulator = Closed(parameters(a=1.0, k=1.0), {"y": decay}, fails)
    from hvdc_ident.fit import FitParameter, Problem

    free = (FitParameter("a", 1.0, 0.1, 10.0), FitParameter("k", 1.0, 0.0, 20.0))
    return Problem(simulator, (recorded("e", T, {"y": 0.1}, y=2 * np.exp(-1.5 * T)),), free)


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_region_that_cannot_be_simulated_is_walked_round(name):
    result = fit(decaying(lambda p: p["k"] > 4.0), optimiser=optimiser(name), starts=1)
    assert result.status == "converged", result.message
    assert result.estimates["k"].value == pytest.approx(1.5, rel=1e-6)
    assert result.estimates["a"].value == pytest.approx(2.0, rel=1e-6)
