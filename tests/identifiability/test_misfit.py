"""A model that is wrong must not close the gate: what the noise would let be told is not judged, and free for a diagnosis."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hvdc_ident.data import InputSignal
from hvdc_ident.discrepancy import diagnose
from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.identifiability import gate, gated_fit, identifiability
from hvdc_ident.model import Model
from hvdc_ident.parameters import Parameter
from hvdc_ident.study.stages.identify import lines_of
from hvdc_ident.text import times_text
from tests.fit.simulators import recorded
from tests.identifiability.cases import closed

T = np.linspace(0.0, 1.0, 201)
NOISE = 1e-3


def curves(t, p):
    """y = a + b t + c t^2/20 + d t^3/1e5."""
    columns = {"a": np.ones_like(t), "b": t, "c": t**2 / 20, "d": t**3 / 1e5}
    return sum(p[n] * column for n, column in columns.items()), columns


PLANT = closed(curves, a=1.0, b=1.0, c=0.0, d=0.0)
FREE = (
    FitParameter("a", 1, -5, 5),
    FitParameter("b", 1, -5, 5),
    FitParameter("c", 0.0, -1, 1),
    FitParameter("d", 0.0, -1, 1),
)


def report_on(hidden):
    """The report where a tone of that height is in the record and not in the model."""
    y = (
        1.0
        + 2.0 * T
        + 0.4 * T**2 / 20
        + hidden * np.sin(40.0 * T)
        + NOISE * np.random.default_rng(1).normal(size=T.size)
    )
    data = recorded("e", T, {"y": NOISE}, y=y)
    return data, identifiability(PLANT, [data], FREE, starts=2)


def test_what_only_the_misfit_hides_is_not_judged_and_free_for_a_diagnosis() -> None:
    data, report = report_on(0.05)
    c = report.parameters["c"]
    assert c.verdict == "not-judged" and report.not_judged == ("c",)
    times = np.sqrt(report.pilot.chi2_per_dof)
    assert f"misses these records by {times_text(times)} the noise; diagnose first" in c.reason
    # the half-width of white noise, from the normal equations
    columns = np.column_stack([np.ones_like(T), T, T**2 / 20])
    half = 1.96 * NOISE * np.sqrt(np.linalg.inv(columns.T @ columns)[2, 2])
    assert float(c.reason.rsplit("±", 1)[1].rstrip(".")) == pytest.approx(half, rel=2e-3)
    assert report.parameters["d"].verdict == "insensitive", "which noise alone would hide too"
    told = report.to_dict()
    assert told["not_judged"] == ["c"] and told["parameters"]["c"]["verdict"] == "not-judged"
    assert gate(report).fitted == ("a", "b") and gate(report, diagnosis=True).fitted == ("a", "b", "c")
    found = gated_fit(Problem(PLANT, (data,), FREE), report, partial(fit, starts=1))
    assert found.fitted == ("a", "b") and "not-judged, held at 0" in found.held["c"]


def test_without_the_misfit_it_is_judged() -> None:
    _, report = report_on(0.0)
    assert report.not_judged == () and report.parameters["c"].verdict == "identifiable"
    assert report.parameters["d"].verdict == "insensitive"


# --- a machine whose governor has a deadband that the model lacks: worked out by scipy ---

H, D, R, TG, TT, BAND = 4.0, 1.2, 0.05, 0.2, 0.5, 0.002
SECONDS = np.linspace(0.0, 20.0, 251)
MACHINE = Model(
    name="machine",
    parameters={
        "H": Parameter(4.0, "s", 0.5, 20.0),
        "D": Parameter(1.0, "", 0.1, 3.0),
        "R": Parameter(0.05, "", 0.005, 0.5),
    },
    inputs={"load": 0.6},
    states={"w": "(Pm - load - D*w)/(2*H)", "gate": "(0.6 - e/R - gate)/0.2", "Pm": "(gate - Pm)/0.5"},
    signals={"e": "w"},
    outputs={"w": "w", "Pm": "Pm"},
)


def machine_record(name, steps, role="fit"):
    """Frequency and power after steps of the load, (instant, level) each."""
    levels = [0.6, *(v for _, v in steps)]
    corners = [c for (t, after), before in zip(steps, levels, strict=False) for c in ((t, before), (t, after))]
    load = InputSignal.corners([(0.0, 0.6), *corners])
    sides = [0.0, *(t for t, _ in steps), SECONDS[-1]]
    state, rows = np.array([0.0, 0.6, 0.6]), np.zeros((SECONDS.size, 3))
    for begin, end, level in zip(sides[:-1], sides[1:], levels, strict=True):

        def rates(_, x, level=level):
            e = np.sign(x[0]) * max(abs(x[0]) - BAND, 0.0)
            return [(x[2] - level - D * x[0]) / (2 * H), (0.6 - e / R - x[1]) / TG, (x[1] - x[2]) / TT]

        run = solve_ivp(rates, (begin, end), state, rtol=1e-9, atol=1e-12, max_step=0.05, dense_output=True)
        inside = (begin <= SECONDS) & (end >= SECONDS)
        rows[inside], state = run.sol(SECONDS[inside]).T, run.y[:, -1]
    rng = np.random.default_rng(len(name))
    w, power = rows[:, 0] + 1e-5 * rng.normal(size=SECONDS.size), rows[:, 2] + 1e-4 * rng.normal(size=SECONDS.size)
    seen = recorded(name, SECONDS, {"w": 1e-5, "Pm": 1e-4}, w=w, Pm=power)
    return seen.with_(inputs={"load": load}, role=role, event=1.0)


def test_a_damping_that_the_misfit_hides_is_right_beside_the_effect_that_is_named() -> None:
    data = [
        machine_record("up", [(1.0, 0.65), (10.0, 0.55)]),
        machine_record("down", [(1.0, 0.56)]),
        machine_record("other", [(1.0, 0.68), (12.0, 0.63)], role="holdout"),
    ]
    free = [FitParameter("H", 5.0, 0.5, 20), FitParameter("D", 2.0, 0.1, 3), FitParameter("R", 0.06, 0.005, 0.5)]
    report = identifiability(MACHINE, data, free, starts=2)
    assert "D" in report.not_judged
    found = diagnose(MACHINE, data, free, effects=["deadband", "gain", "coupling"], report=report)
    assert found.verdict == "named"
    (effect,) = found.effects
    assert effect.effect == "deadband" and effect.at == ("e",)
    assert found.parameters_after["D"] == pytest.approx(D, rel=1e-2)
    assert found.parameters_after["H"] == pytest.approx(H, rel=1e-3)
    assert found.parameters_after["R"] == pytest.approx(R, rel=1e-3)


def test_a_misfit_is_told_first_and_beside_every_interval() -> None:
    line = {"verdict": "identifiable", "reason": "known", "value": 1.5, "ci95": [1.0, 2.0]}
    data = {
        "parameters": {"a": {**line, "name": "a"}, "b": {**line, "name": "b", "verdict": "insensitive", "ci95": None}},
        "misspecification": {"signs": ["the residuals are 40 times the noise"]},
        "pilot": {"chi2_per_dof": 1600.0},
        "notes": [],
        "recommended_experiment": None,
    }
    first, a, b = lines_of(data)
    assert first.startswith("The model does not explain these data: the residuals are 40 times the noise.")
    assert a.endswith("(chi2/dof 1.6e+03)") and "chi2" not in b
    assert "chi2" not in "".join(lines_of({**data, "misspecification": {}}))


@pytest.mark.parametrize("high", [3.0, 50.0])
def test_a_weak_verdict_that_the_misfit_makes_says_so_and_takes_no_bound_for_a_finding(high) -> None:
    plant = closed(lambda t, p: (p["k"] * t, {"k": t}), k=Parameter(1.0, min=0.1, max=high))
    y = 2.0 * T + 0.2 * np.sin(12.0 * T) + NOISE * np.random.default_rng(1).normal(size=T.size)
    report = identifiability(
        plant, [recorded("e", T, {"y": NOISE}, y=y)], [FitParameter("k", 1.0, 0.1, high)], starts=2
    )
    k = report.parameters["k"]
    assert k.verdict == "weak" and k.ci95 is None and k.reason.startswith("If nothing else is missing, ")
    assert k.profile.ci95[0] == 0.1
    whole = k.profile.ci95[1] == high
    assert whole == (high == 3.0)
    assert ("do not narrow its physical bounds" if whole else "the lower end is its physical bound") in k.reason
    half = 1.96 * NOISE / np.sqrt(T @ T)  # of white noise, from the normal equation
    assert float(k.reason.split("±")[-1].split(";")[0]) == pytest.approx(half, rel=2e-3)
