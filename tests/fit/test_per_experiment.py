"""Statistics over runs: what a run sees, what the spread says of it, and the published intervals they reproduce."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from hvdc_ident.errors import InputError
from hvdc_ident.fit import fit, fit_each
from hvdc_ident.fit.partial_fits import half_width, spread
from tests.fit.test_interval_coverage import pair

PUBLISHED = [  # std, n, width of the interval: Vanfretti, Murad, Gomez Lopez 2017, Table III; n = 6 is inferred
    (9.6029, 30, 895.68 - 888.51),
    (1.55, 30, 30.10 - 28.94),
    (0.139, 30, 26.82 - 26.72),
    (37.501, 6, 873.54 - 794.83),
    (0.082, 6, 29.40 - 29.23),
    (0.072, 6, 31.60 - 31.45),
]


@pytest.mark.parametrize(("std", "n", "width"), PUBLISHED)
def test_the_published_intervals_are_those_of_the_mean(std, n, width):
    assert 2 * half_width(std, n) == pytest.approx(width, abs=0.011)


def test_the_spread_of_known_values():
    found = spread(np.array([1.0, 2.0, 4.0, 5.0]))
    assert (found["n"], found["mean"], found["variance"]) == (4, 3.0, pytest.approx(10.0 / 3.0))
    assert found["cv"] == pytest.approx(np.sqrt(10.0 / 3.0) / 3.0)
    low, high = found["ci95"]
    assert (high - low) / 2 == pytest.approx(np.sqrt(5.0) * half_width(found["std"], 4))
    assert spread(np.array([7.0])) == {"n": 1, "mean": 7.0} | dict.fromkeys(
        ("std", "variance", "cv", "ci95", "ci95_of_mean")
    )
    assert spread(np.array([]))["mean"] is None
    assert spread(np.array([-1.0, 1.0]))["cv"] is None  # a mean of 0 has none


def test_a_run_sees_the_experiments_it_names():
    problem = pair()
    both = fit_each(problem, runs={"both": ("e0", "e1"), "one": ("e0",)})
    alone = fit_each(problem)
    for name, e in fit(problem, starts=1).estimates.items():
        assert both[name]["experiments"]["both"]["value"] == pytest.approx(e.value, rel=1e-9)
        assert both[name]["experiments"]["one"] == alone[name]["experiments"]["e0"]
        assert both[name]["on_bound"] == 0


def test_an_executor_changes_nothing():
    with ThreadPoolExecutor(2) as pool:
        assert fit_each(pair(), executor=pool) == fit_each(pair())


@pytest.mark.parametrize(("runs", "message"), [({"a": ("e7",)}, "no fitted experiment 'e7'"), ({"a": ()}, "run 'a'")])
def test_runs_that_do_not_fit_are_refused(runs, message):
    with pytest.raises(InputError, match=message):
        fit_each(pair(), runs=runs)


def test_an_estimate_on_its_bound_is_counted_not_averaged():
    problem = pair()
    tight = [f if f.name != "k" else type(f)("k", start=f.start, min=f.start, max=f.start + 1e-3) for f in problem.free]
    found = fit_each(type(problem)(problem.simulator, problem.experiments, tuple(tight)))["k"]
    assert (found["n"], found["on_bound"]) == (0, 2)
    assert found["mean"] is None
