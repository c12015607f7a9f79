"""Rahman et al. 2016, spread of HIV in South Africa: the published optimum of a benchmark for parameter estimation.

Equations and data: the PEtab benchmark collection (Rahman, Vaidya, Zou, Math. Biosci. 279 (2016), doi 10.1016/j.mbs.2016.07.009).
Nine rates from 23 values of the prevalence, so that several cannot be told: only the misfit of the optimum is compared. The
chi-square of the collection's nominal values follows from the simulation published beside the data.
"""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident import Model
from hvdc_ident.data import Experiment, trajectory
from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.model import State
from hvdc_ident.simulate import ModelSimulator

CHI2 = 0.0358074215161569
YEARS = np.arange(23.0)
PREVALENCE = np.array(
    [
        0.3,
        0.6,
        1.1,
        2.0,
        3.3,
        5.0,
        7.0,
        9.2,
        11.3,
        13.2,
        14.9,
        16.2,
        17.1,
        17.8,
        18.3,
        18.5,
        18.7,
        18.8,
        18.9,
        18.9,
        18.9,
        18.8,
        18.9,
    ]
)
"""In per cent, each with a standard deviation of 1."""
PARAMETERS = {  # nominal value of the collection, and its bounds; rates in 1/year
    "b1": (427.47, 0.1, 1000.0),  # infected normal transmission rate relative
    "b2": (0.0029273, 0.0001, 1.0),  # infected moderate transmission rate
    "b3": (992.96, 0.1, 1000.0),  # infected weak transmission rate relative
    "t3": (0.0001, 0.0001, 1.0),  # infected weak treatment rate
    "w1": (0.66545, 0.0001, 1.0),  # infected normal worsen rate
    "w2": (0.0079757, 0.0001, 1.0),  # infected moderate worsen rate
    "i2": (0.13636, 0.0001, 1.0),  # treated moderate improve rate
    "i3": (0.77557, 0.0001, 1.0),  # treated weak improve rate
    "m": (1.338e-07, 1e-09, 1e-05),  # behavioural change rate
}


def epidemic() -> Model:
    """The susceptible, and the infected and treated in three states of health, in persons."""
    people = "(s + n + d + k + tn + td + tk)"
    ill = "(n + d + k + tn + td + tk)"
    force = f"b2*(b1*n + d + b3*k + 0.04*(tn + td + tk))/{people}*exp(-m*{ill})"
    equations = {
        "s": ("1032672 - force*s - 0.0288*s", 17940000.0),
        "n": ("force*s - w1*n - 0.0888*n", 16300.0),
        "d": ("w1*n - w2*d - 0.1368*d", 9000.0),
        "k": ("w2*d - t3*k - 0.3108*k", 11000.0),
        "tn": ("i2*td - 0.0408*tn", 0.0),
        "td": ("i3*tk - i2*td - 0.0528*td", 0.0),
        "tk": ("t3*k - i3*tk - 0.1752*tk", 0.0),
    }
    return Model(
        "epidemic",
        parameters={n: value for n, (value, _, _) in PARAMETERS.items()},
        signals={"force": force},
        states={n: State(e, start=str(start)) for n, (e, start) in equations.items()},
        outputs={"prevalence": f"100*(1 - s/{people})"},
    )


def problem() -> Problem:
    """All nine rates over the collection's bounds, begun at their geometric mean."""
    data = Experiment(
        YEARS,
        "South Africa",
        measured=trajectory(YEARS, {"prevalence": PREVALENCE}),
        noise={"prevalence": 1.0},
        role="fit",
    )
    free = tuple(FitParameter(n, float(np.sqrt(low * high)), low, high) for n, (_, low, high) in PARAMETERS.items())
    return Problem(ModelSimulator(epidemic()), (data,), free)


def test_the_published_values_have_the_published_misfit() -> None:
    fitted = problem()
    theta = np.array([PARAMETERS[u.name][0] for u in fitted.unknowns])
    assert 2.0 * fitted.cost(theta) == pytest.approx(CHI2, rel=1e-3)


def test_an_optimum_at_least_as_good_as_the_published_one_is_found() -> None:
    found = fit(problem(), assess=False)
    assert found.status in ("converged", "at-bound", "two-optima")
    assert 2.0 * found.cost < CHI2 * (1.0 + 1e-3)
