"""The paper's numbers, its experiments on the average-value link, and its two ways of fitting them.

Vanfretti, Murad, Gomez Lopez: Calibrating a VSC-HVDC Model for Dynamic Simulations Using RaPId and EMTP Simulation Data,
IEEE PESGM 2017, doi 10.1109/PESGM.2017.8274525. Gains in pu and pu/s, currents in pu of 100 MVA.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hvdc_ident.data import Array, Experiment, InputSignal, experiment
from hvdc_ident.fit import FitParameter, Problem, fit, fit_each
from hvdc_ident.fit.partial_fits import half_width, spread
from hvdc_ident.fit.residual import ResidualBlock
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model
from hvdc_ident.models import load_model
from hvdc_ident.sensitivity import normalised
from hvdc_ident.simulate import ModelSimulator, simulate
from hvdc_ident.study.examples import Campaign, Noise, recorded

REFERENCE = "vsc-hvdc-avm"  # stands in for EMTP-RV: the average-value link with 140 Hz filters on P, Q and Vdc
LINK = "vsc-hvdc-link"  # what is calibrated
GAINS = ("KIVDC", "KPVDC", "KIP", "KPP", "KIQ", "KPQ")  # in Table III's order
EVENT, END, SAMPLE = 0.1, 0.9, 5e-4  # s


@dataclass(frozen=True)
class Controller:
    """A controller: its set-point with its representative step (before, after), its output and its gains."""

    setpoint: str
    before: float
    after: float
    output: str
    gains: tuple[str, ...]


CONTROLLERS = {
    "P": Controller("Pref2", 0.4, 0.5, "Irorder2", ("KIP", "KPP")),
    "Q": Controller("Qref1", 0.0, 0.1, "Iiorder1", ("KIQ", "KPQ")),
    "Vdc": Controller("Vdcref1", 1.0, 1.019, "Irorder1", ("KPVDC", "KIVDC")),
}
OUTPUTS = tuple(c.output for c in CONTROLLERS.values())

TABLE_1 = {"KIP": 30.0, "KPP": 0.0, "KPVDC": 24.0, "KIVDC": 734.7, "KIQ": 30.0, "KPQ": 0.0}
TABLE_2 = {  # min, max, start, test value
    "KIP": (5.0, 50.0, 25.0, 5.0),
    "KPP": (0.0, 10.0, 5.0, 0.0),
    "KIQ": (10.0, 50.0, 25.0, 10.0),
    "KPQ": (0.0, 10.0, 5.0, 0.0),
    "KPVDC": (10.0, 40.0, 20.0, 10.0),
    "KIVDC": (550.0, 950.0, 750.0, 300.0),
}
TABLE_3: dict[str, dict[str, dict[str, Any]]] = {  # II: individual, n = 30; SI: simultaneous, n = 6 (inferred)
    "KIVDC": {
        "II": {"mean": 892.09, "std": 9.6029, "variance": 92.216, "ci": (888.51, 895.68)},
        "SI": {"mean": 834.19, "std": 37.501, "variance": 1406.4, "ci": (794.83, 873.54)},
    },
    "KPVDC": {
        "II": {"mean": 26.77, "std": 0.139, "variance": 0.019, "ci": (26.72, 26.82)},
        "SI": {"mean": 26.66, "std": 0.083, "variance": 0.007, "ci": (26.58, 26.75)},
    },
    "KIP": {
        "II": {"mean": 31.49, "std": 0.026, "variance": 6.7626e-4, "ci": (31.48, 31.50)},
        "SI": {"mean": 31.53, "std": 0.072, "variance": 0.005, "ci": (31.45, 31.60)},
    },
    "KPP": {
        "II": {"mean": 0.004, "std": 0.007, "variance": 5.6513e-5, "ci": (0.001, 0.007)},
        "SI": {"mean": 0.0, "std": 0.0, "variance": 0.0, "ci": None},
    },
    "KIQ": {
        "II": {"mean": 29.52, "std": 1.55, "variance": 2.41, "ci": (28.94, 30.10)},
        "SI": {"mean": 29.32, "std": 0.082, "variance": 0.006, "ci": (29.23, 29.40)},
    },
    "KPQ": {
        "II": {"mean": 0.032, "std": 0.051, "variance": 0.002, "ci": (0.013, 0.051)},
        "SI": {"mean": 0.263, "std": 0.046, "variance": 0.002, "ci": (0.21, 0.31)},
    },
}
MODES = {"II": "individual", "SI": "simultaneous"}
RUNS = {"II": 30, "SI": 6}  # the n that the printed intervals follow from
TABLE_4 = {  # RMSE in pu
    "Irorder2": {
        "upper II": 1.8302e-4,
        "upper SI": 1.8283e-4,
        "lower II": 1.8514e-4,
        "lower SI": 1.8954e-4,
        "EMTP": 9.3324e-4,
        "test": 0.0813,
    },
    "Iiorder1": {
        "upper II": 0.0017,
        "upper SI": 0.0011,
        "lower II": 0.0015,
        "lower SI": 0.0011,
        "EMTP": 0.0016,
        "test": 0.0687,
    },
    "Irorder1": {
        "upper II": 0.0049,
        "upper SI": 0.0050,
        "lower II": 0.0049,
        "lower SI": 0.0049,
        "EMTP": 0.0059,
        "test": 0.0252,
    },
}

EQUAL = 1e-3
"""Standard deviation in pu that weighs the three outputs alike in the simultaneous fits: a plain sum of squares."""


def free(names: Iterable[str]) -> tuple[FitParameter, ...]:
    """Return the fit parameters as Table II defines them."""
    return tuple(FitParameter(n, TABLE_2[n][2], TABLE_2[n][0], TABLE_2[n][1]) for n in names)


def link() -> ModelSimulator:
    """Return the model under calibration."""
    return ModelSimulator(load_model(LINK))


def recordings(count: int = 30, *, source: str = REFERENCE, at_rest: bool = True) -> tuple[Experiment, ...]:
    """Return noise-free steps and ramps of each controller, with its output and the two others recorded.

    The first ones do not depend on the count. at_rest: start at the 40 MW operating point instead of a random one.
    """
    return tuple(recorded(Campaign(source=source, count=count, noise=Noise(0.0), sample=SAMPLE, at_rest=at_rest)))


def step(kind: str, source: Model | str = REFERENCE, outputs: Sequence[str] = OUTPUTS) -> Experiment:
    """Return the representative step of a controller, recorded on a model: 0.9 s from steady state, every 0.5 ms, no noise."""
    c = CONTROLLERS[kind]
    time = np.round(np.arange(round(END / SAMPLE) + 1) * SAMPLE, 9)
    signal = InputSignal.step(EVENT, c.before, c.after)
    plain = experiment(f"{kind.lower()}-step", time, {c.setpoint: signal}, event=EVENT)
    model = load_model(source) if isinstance(source, str) else source
    return plain.with_(measured=simulate(model, plain, outputs=outputs).trajectory)


def of(kind: str, experiments: Iterable[Experiment]) -> tuple[Experiment, ...]:
    """Return the experiments in which the controller's set-point moves, with its own output only."""
    c = CONTROLLERS[kind]
    return tuple(e.with_(measured=e.measured.select([c.output])) for e in experiments if c.setpoint in e.inputs)


def without(output: str, kind: str, experiments: Iterable[Experiment]) -> tuple[Experiment, ...]:
    """Return all experiments; the output is not recorded where this controller's set-point moves."""
    moved = CONTROLLERS[kind].setpoint
    return tuple(
        e.with_(measured=e.measured.select([o for o in e.outputs if o != output])) if moved in e.inputs else e
        for e in experiments
    )


def individual(
    experiments: Sequence[Experiment], *, held: Mapping[str, float] | None = None, executor: Any = None
) -> dict[str, dict[str, Any]]:
    """Return the results of `fit_each` by gain: each controller separately, on its own output, one experiment for each fit.

    held: values of the other controllers' gains; if left out, those of Table I.
    """
    found: dict[str, dict[str, Any]] = {}
    for kind, c in CONTROLLERS.items():
        others = {n: v for n, v in (held or {}).items() if n not in c.gains}
        problem = Problem(link(), of(kind, experiments), free(c.gains), held=FrozenMap(others))
        found |= fit_each(problem, executor=executor)
    return found


def simultaneous(experiments: Sequence[Experiment], *, executor: Any = None) -> dict[str, dict[str, Any]]:
    """Return the results of `fit_each` by gain: all six at once from one experiment of each controller, unweighted.

    Every recorded output is compared in every experiment, as in the paper's simultaneous set-up.
    """
    alike = [e.with_(noise=FrozenMap(dict.fromkeys(e.outputs, EQUAL))) for e in experiments]
    groups = [[e.name for e in alike if c.setpoint in e.inputs] for c in CONTROLLERS.values()]
    runs = {names[0].split("-")[1]: names for names in zip(*groups, strict=True)}
    return fit_each(Problem(link(), tuple(alike), free(GAINS)), runs=runs, executor=executor)


def cluster_sandwich(blocks: Sequence[ResidualBlock]) -> tuple[Array, int]:
    """Return the covariance of the unknowns, (p, p), from the scatter of the experiments' scores, and its dof, n - 1.

    (J'J)^-1 (sum g_e g_e') (J'J)^-1 n/(n - 1), with g_e the gradient of experiment e alone at the common optimum
    (Liang and Zeger 1986); intervals use Student's t. It holds with model error and with correlated samples, for whole
    experiments are the independent units.
    """
    names = list(dict.fromkeys(b.experiment for b in blocks))
    n, p = len(names), blocks[0].jacobian.shape[1]
    scores, matrix = np.zeros((n, p)), np.zeros((p, p))
    for b in blocks:
        scores[names.index(b.experiment)] += b.jacobian.T @ b.residual
        matrix += b.jacobian.T @ b.jacobian
    scaled, d = normalised(matrix)
    inverse = np.linalg.pinv(scaled, hermitian=True) / np.outer(d, d)
    return inverse @ (scores.T @ scores) @ inverse * (n / (n - 1.0)), n - 1


def together(experiments: Sequence[Experiment]) -> dict[str, dict[str, Any]]:
    """Return by gain each controller's fit to all its experiments at once, with an interval from their scatter (t, n - 1)."""
    from scipy.stats import t

    found = {}
    for kind, c in CONTROLLERS.items():
        problem = Problem(link(), of(kind, experiments), free(c.gains))
        result = fit(problem, starts=1)
        covariance, dof = cluster_sandwich(problem.blocks(np.array([result.values[n] for n in c.gains])))
        for i, n in enumerate(c.gains):
            half = float(t.ppf(0.975, dof)) * float(np.sqrt(covariance[i, i]))
            value = result.values[n]
            found[n] = {"value": value, "ci": [value - half, value + half], "status": result.status}
    return found


def values_of(found: Mapping[str, Mapping[str, Any]]) -> dict[str, list[float]]:
    """Return the estimates by gain, in the order of the runs. Raises if a fit ended without an estimate."""
    table = {}
    for name in GAINS:
        rows = found[name]["experiments"]
        wrong = {run: r["status"] for run, r in rows.items() if r["status"] not in ("converged", "at-bound")}
        if wrong:
            raise RuntimeError(f"fits of {name} ended without an estimate: {wrong}")
        table[name] = [r["value"] for r in rows.values()]
    return table


def intervals_of_mean(values: Mapping[str, Mapping[str, list[float]]]) -> dict[str, dict[str, tuple[float, float]]]:
    """Return the 95 % interval of the mean by II or SI and gain, as the paper computes it: n = 30, and 6 for simultaneous runs."""
    ends: dict[str, dict[str, tuple[float, float]]] = {}
    for label, mode in MODES.items():
        for n in GAINS:
            s = spread(np.array(values[mode][n]))
            half = half_width(s["std"], RUNS[label])
            ends.setdefault(label, {})[n] = (s["mean"] - half, s["mean"] + half)
    return ends


def rmse(recorded: Experiment, gains: Mapping[str, float], model: Model | str = LINK) -> dict[str, float]:
    """Return the RMSE in pu of each recorded output for the model with these gains."""
    assert recorded.measured is not None
    chosen = load_model(model) if isinstance(model, str) else model
    run = simulate(chosen, recorded.with_(measured=None), gains, outputs=recorded.outputs)
    return {o: float(np.sqrt(np.mean((run[o] - recorded.measured[o]) ** 2))) for o in recorded.outputs}
