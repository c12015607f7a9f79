"""Bruno et al. 2016, cleavage of carotenoids: the published optimum of a benchmark for parameter estimation.

Equations and data: the PEtab benchmark collection (Bruno, Koschmieder, Wuest, Schaub, Fehling-Kaschek, Timmer, Beyer, Al-Babili,
J. Exp. Botany 67 (2016), doi 10.1093/jxb/erw356). Six experiments, each begun with one substance, whose amount is estimated. The
nominal values of the collection are given to 15 digits; their chi-square follows from the simulation published beside the data.
"""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident import Model
from hvdc_ident.data import Experiment, trajectory
from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import State
from hvdc_ident.simulate import ModelSimulator

CHI2 = 65.11132145540188
"""Of the 77 measured values against the simulation published with them."""
PUBLISHED = {
    "init_b10_1": 4.22228991356159,
    "init_bcar1": 4.44029572277168,
    "init_bcar2": 3.30171980495163,
    "init_bcry_1": 5.21693865661801,
    "init_ohb10_1": 1.73724675926262,
    "init_zea_1": 2.95812301577671,
    "k5": 0.003086673219173,
    "kb1": 0.016628409992721,
    "kb2": 0.005843831819271,
    "kc1": 0.001678825242274,
    "kc2": 0.006975989070463,
    "kc4": 0.006082700899195,
    "szea": 0.516831766210391,
}
RATES = ("k5", "kb1", "kb2", "kc1", "kc2", "kc4")
CONDITIONS = {  # substance, its amount, and which of the rates act: 0 not, 1 as they are, z times szea
    1: ("b10", "init_b10_1", "001101"),
    2: ("bcar", "init_bcar1", "111000"),
    3: ("bcar", "init_bcar2", "zzzzzz"),
    4: ("bcry", "init_bcry_1", "101111"),
    5: ("ohb10", "init_ohb10_1", "001001"),
    6: ("zea", "init_zea_1", "z0000z"),
}
EARLY, LATE = (0.0, 5.0, 15.0, 30.0, 60.0, 90.0, 120.0, 180.0), (0.0, 15.0, 30.0, 45.0, 60.0, 90.0, 120.0, 180.0)
"""Minutes: conditions 1 and 5, and the others."""
DATA = {  # by condition and substance: amounts in nmol, and their standard deviations
    (1, "b10"): (
        (3.973385, 3.976118, 3.12959, 3.131418, 3.105543, 2.279702, 1.321613),
        (0.406451, 0.406728, 0.320749, 0.320935, 0.31831, 0.234682, 0.138555),
    ),
    (2, "bcar"): (
        (3.83496, 2.68932, 2.12541, 1.55414, 0.90185, 0.62496, 0.30276),
        (0.251006, 0.179664, 0.145321, 0.111703, 0.076761, 0.064455, 0.054089),
    ),
    (2, "b10"): (
        (0.87947, 1.61775, 2.0221, 2.51711, 2.24951, 2.46923, 2.09599),
        (0.110017, 0.194075, 0.240978, 0.298703, 0.267467, 0.29311, 0.249578),
    ),
    (3, "bcar"): (
        (2.792, 2.51, 2.101, 1.917, 1.598, 1.135, 0.824),
        (0.161073, 0.146065, 0.124582, 0.115071, 0.098916, 0.076702, 0.063285),
    ),
    (3, "b10"): (
        (0.573, 0.849, 0.968, 1.212, 1.411, 1.612, 2.168),
        (0.066702, 0.092359, 0.10382, 0.127709, 0.147436, 0.167498, 0.223405),
    ),
    (4, "bcry"): (
        (4.804181, 3.874252, 3.687507, 2.905136, 2.471236, 2.243992, 0.922679),
        (0.43054, 0.353484, 0.338201, 0.275261, 0.241465, 0.224241, 0.137702),
    ),
    (4, "b10"): (
        (0.186897, 0.238582, 0.268357, 0.377915, 0.332696, 0.410503, 0.487949),
        (0.043179, 0.046576, 0.048771, 0.057968, 0.053988, 0.060963, 0.068419),
    ),
    (4, "ohb10"): (
        (0.750567, 0.957066, 1.058638, 1.40061, 1.342636, 1.652208, 2.005941),
        (0.146042, 0.185626, 0.205133, 0.270906, 0.259748, 0.319353, 0.387509),
    ),
    (5, "ohb10"): (
        (2.187219, 1.490176, 1.243819, 1.100679, 1.142316, 0.794621, 0.696621),
        (0.365852, 0.249545, 0.208483, 0.184647, 0.191578, 0.13378, 0.117543),
    ),
    (6, "ohb10"): (
        (0.098, 0.1573, 0.165, 0.23, 0.374, 0.445, 0.46),
        (0.023108, 0.030931, 0.032031, 0.041749, 0.064588, 0.076127, 0.090733),
    ),
    (6, "zea"): (
        (2.761, 2.93, 2.842, 2.763, 2.581, 2.449, 2.128),
        (0.172674, 0.183243, 0.17774, 0.172799, 0.161417, 0.153161, 0.133086),
    ),
}


def cleavage() -> Model:
    """The model; states are shares of the amount that an experiment began with, switches are inputs."""
    equations = {
        "bcar": "-r_kb1*bcar",
        "b10": "r_kb1*bcar - r_kb2*b10 + r_kc1*bcry",
        "bcry": "-(r_kc1 + r_kc2)*bcry",
        "ohb10": "r_kc2*bcry - r_kc4*ohb10 + r_k5*zea",
        "zea": "-r_k5*zea",
    }
    amount = " + ".join(f"from{i}*{name}" for i, (_, name, _) in CONDITIONS.items())
    rates = {f"r_{n}": f"{n}*on_{n}*(1 - slowed + slowed*szea)" for n in RATES}
    switches = [*(f"on_{n}" for n in RATES), "slowed", *(f"from{i}" for i in CONDITIONS)]
    return Model(
        "carotenoids",
        parameters=dict(PUBLISHED),
        inputs=dict.fromkeys(switches, 0.0),
        signals={**rates, "amount": amount},
        states={n: State(e, start="0") for n, e in equations.items()},
        outputs={f"o{n}": f"amount*{n}" for n in equations},
    )


def measured(number: int) -> Experiment:
    """Return the experiment of one condition."""
    substance, _, acting = CONDITIONS[number]
    time = np.array(EARLY if number in (1, 5) else LATE)
    values, noise, profile = {}, {}, {}
    for (condition, name), (amounts, stds) in DATA.items():
        if condition == number:
            size = float(np.sqrt(np.mean(np.square(stds))))
            values[f"o{name}"] = np.array([np.nan, *amounts])
            noise[f"o{name}"], profile[f"o{name}"] = size, np.array([1.0, *np.array(stds) / size])
    switches = {f"on_{n}": float(a != "0") for n, a in zip(RATES, acting, strict=True)}
    return Experiment(
        time,
        f"condition {number}",
        inputs={**switches, "slowed": float("z" in acting), f"from{number}": 1.0},
        measured=trajectory(time, values),
        noise=FrozenMap(noise),
        noise_profile=FrozenMap(profile),
        starts=FrozenMap({substance: 1.0}),
        role="fit",
    )


def problem() -> Problem:
    """All unknowns over the eight decades of the collection, begun in their middle."""
    free = tuple(FitParameter(n, 0.1, 1e-5, 1e3) for n in PUBLISHED)
    return Problem(ModelSimulator(cleavage()), tuple(measured(i) for i in CONDITIONS), free)


def test_the_published_values_have_the_published_misfit() -> None:
    fitted = problem()
    theta = np.array([PUBLISHED[u.name] for u in fitted.unknowns])
    assert 2.0 * fitted.cost(theta) == pytest.approx(CHI2, rel=1e-5)


def test_the_published_optimum_is_found_from_the_middle_of_eight_decades() -> None:
    found = fit(problem(), assess=False)
    assert found.status == "converged" and found.search_doubt == ""
    assert 2.0 * found.cost == pytest.approx(CHI2, rel=1e-5)
    assert {n: found.values[n] for n in PUBLISHED} == pytest.approx(PUBLISHED, rel=1e-4)
