"""Whitening, spectra, robust losses and priors: identities, other libraries' answers, coverage."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.optimize import least_squares
from scipy.stats import binom

from hvdc_ident.data import InputSignal, segments
from hvdc_ident.errors import StudyError, UnknownNameError
from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.fit.likelihood import LOSSES, Prior, loss
from hvdc_ident.fit.noise import models_before_event
from hvdc_ident.fit.residual import transformed
from hvdc_ident.fit.whitening import autoregression, whitened
from tests.fit.simulators import Closed, coloured, decay, line, parameters, recorded

RNG = np.random.default_rng
T = np.linspace(0.0, 1.0, 200)
LINE = Closed(parameters(a=0.0, b=0.0), {"y": line})
FREE = (FitParameter("a", 0.0, -50, 50), FitParameter("b", 0.0, -50, 50))


def ar(rng: np.random.Generator, n: int, model: tuple[float, ...], sigma: float = 1.0) -> np.ndarray:
    """AR noise after a long run-in."""
    e = sigma * rng.standard_normal(n + 500)
    x = np.zeros(e.size)
    for k in range(len(model), e.size):
        x[k] = sum(c * x[k - i] for i, c in enumerate(model, 1)) + e[k]
    return x[500:]


# --- whitening ---


@pytest.mark.parametrize("model", [(0.8,), (0.5, 0.3), (1.2, -0.5), (0.4, -0.3, 0.2)])
def test_whitening_is_the_exact_likelihood_of_stationary_noise(model):
    """The sum of squares is x' R^-1 x with R from the impulse response, an independent way to the covariance."""
    psi = np.zeros(4000)
    psi[0] = 1.0
    for k in range(1, psi.size):
        psi[k] = sum(c * psi[k - i] for i, c in enumerate(model, 1) if k >= i)
    r = np.array([psi[: psi.size - k] @ psi[k:] for k in range(30)])
    x = RNG(0).standard_normal(30)
    expected = x @ np.linalg.solve(toeplitz(r / r[0]), x)
    white = whitened(x, model)
    assert white @ white == pytest.approx(expected, rel=1e-9)
    assert whitened(np.column_stack([x, 2 * x]), model)[:, 1] == pytest.approx(2 * white)


def test_stretches_are_whitened_each_for_itself():
    x = RNG(1).standard_normal(20)
    parts = (slice(0, 12), slice(12, 20))
    white = whitened(x, (0.7,), parts)
    assert white == pytest.approx(np.concatenate([whitened(x[:12], (0.7,)), whitened(x[12:], (0.7,))]))
    t = np.concatenate([np.arange(12.0), 20 + np.arange(8.0)])
    assert segments(t, "here") == parts
    assert segments(np.array([0.0, 1.0, 1.0, 2.0]), "here") == (slice(0, 2), slice(2, 4))


def test_uneven_rows_cannot_be_whitened():
    with pytest.raises(StudyError, match=r"experiment 'e'.*evenly spaced"):
        segments(np.array([0.0, 1.0, 2.1, 3.0]), "experiment 'e'")
    t = np.array([0.0, 0.1, 0.21, 0.3, 0.4])
    problem = Problem(LINE, (recorded("e", t, {"y": 0.1}, y=t),), FREE, rho={"y": 0.5})
    with pytest.raises(StudyError, match="evenly spaced"):
        problem.residual(problem.start)


@pytest.mark.parametrize("model", [(), (0.9,), (1.2, -0.5)])
def test_the_model_and_its_order_are_read_off_the_noise(model):
    records = [ar(RNG(k), 2000, model) for k in range(3)]
    found = autoregression(records)
    assert len(found) == len(model)
    assert found == pytest.approx(model, abs=0.05)
    assert autoregression([np.zeros(5)]) == ()


def measured(rho: float, seed: int, rows: int = 400) -> Problem:
    """A line from an event on, in coloured noise that is there before it as well."""
    t = np.linspace(0.0, 2.0, rows)
    rest = {"inputs": {"u": InputSignal.step(1.0, 0.0, 1.0)}, "event": 1.0, "window": (1.0, 2.0)}
    y = np.where(t >= 1.0, 1.0 + 2.0 * t, 3.0) + coloured(RNG(seed), t.size, rho, 0.3)
    return Problem(LINE, (recorded("e", t, {"y": 0.3}, rest, y=y),), FREE)


def test_noise_before_the_event_gives_the_model():
    models = models_before_event(measured(0.8, 0, 4000).fitted_experiments, ["y"])
    assert models["y"] == pytest.approx((0.8,), abs=0.05)
    e = measured(0.8, 0).experiments[0]
    with pytest.raises(StudyError, match="no noise of 'y' before the event"):
        models_before_event([e.with_(event=None, inputs={})], ["y"])
    # where no event is told, the input's step is one
    assert models_before_event([e.with_(event=None)], ["y"]) == models_before_event([e], ["y"])


@pytest.mark.parametrize("whiten", ["pre-event", "residual"])
def test_intervals_of_a_whitened_fit_cover(whiten):
    hits = 0
    for seed in range(100):
        result = fit(measured(0.8, seed), starts=1, whiten=whiten, assess=False)
        low, high = result.estimates["b"].ci95
        hits += low <= 2.0 <= high
    assert hits >= binom.ppf(0.001, 100, 0.93)


def test_whitening_makes_better_estimates_and_says_what_it_did():
    plain, white = [], []
    for seed in range(40):
        problem = measured(0.95, seed)
        plain.append(fit(problem, starts=1, assess=False).estimates["b"].value - 2.0)
        result = fit(problem, starts=1, whiten="residual", assess=False)
        white.append(result.estimates["b"].value - 2.0)
    assert np.std(white) <= 1.05 * np.std(plain)
    assert len(result.whitening["y"]) == 1
    assert result.residual_tests["y"]["e"].ljung_box.p > 1e-3
    with pytest.raises(UnknownNameError, match="did you mean 'pre-event'"):
        fit(measured(0.9, 0), whiten="pre-evnt")


def test_rows_beside_a_step_are_left_out_where_a_guard_is_asked_for():
    problem = measured(0.0, 0)
    guarded = replace(problem, guard=0.1)
    left_out = problem.residual(problem.start)[0].size - guarded.residual(problem.start)[0].size
    t = problem.experiments[0].time
    assert left_out == int(((t >= 1.0) & (t <= 1.1)).sum())


# --- the frequency domain ---


def test_over_the_whole_band_the_spectrum_has_the_signals_squares():
    for n in (50, 51):
        x, t = RNG(2).standard_normal((n, 2)), np.arange(n) * 0.01
        s = transformed(x, t, (0.0, np.inf), "here")
        assert s.shape == x.shape
        assert s.T @ s == pytest.approx(x.T @ x)


def test_a_fit_of_spectra_over_the_whole_band_is_the_fit_in_time():
    y = 1.0 + 2.0 * T + 0.3 * RNG(3).standard_normal(T.size)
    problem = Problem(LINE, (recorded("e", T, {"y": 0.3}, y=y),), FREE)
    one, two = fit(problem, starts=1), fit(replace(problem, band=(0.0, np.inf)), starts=1)
    assert two.cost == pytest.approx(one.cost, rel=1e-9)
    for n in ("a", "b"):
        assert two.estimates[n].value == pytest.approx(one.estimates[n].value, rel=1e-6)
        assert two.estimates[n].std_raw == pytest.approx(one.estimates[n].std_raw, rel=1e-9)
    assert two.residual_tests["y"]["e"].n == T.size


def test_a_band_leaves_a_disturbance_outside_of_it_out():
    """A 20 Hz hum on a decay: the band up to 15 Hz does not see it."""
    t = np.arange(300) / 100.0
    simulator = Closed(parameters(a=1.0, k=1.0), {"y": decay})
    y = 2.0 * np.exp(-1.5 * t) + 0.5 * np.sin(2 * np.pi * 20.0 * t)
    free = (FitParameter("a", 1.0, 0.1, 10), FitParameter("k", 1.0, 0.1, 5))
    problem = Problem(simulator, (recorded("e", t, {"y": 0.01}, y=y),), free)
    whole, band = fit(problem, starts=1), fit(replace(problem, band=(0.0, 15.0)), starts=1)
    off = [abs(r.estimates["k"].value - 1.5) for r in (whole, band)]
    assert off[1] < 1e-6 < 1e-3 < off[0]
    with pytest.raises(StudyError, match="the band holds no frequency"):
        fit(replace(problem, band=(60.0, 70.0)), starts=1)


# --- robust losses ---


@pytest.mark.parametrize("name", LOSSES)
def test_a_losss_derivatives_are_those_of_differences_and_it_travels(name):
    found = loss(name)
    r = np.linspace(-6, 6, 97) + 0.001
    h = 1e-6
    assert found.psi(r) == pytest.approx((found.rho(r + h) - found.rho(r - h)) / (2 * h), abs=1e-6)
    assert found.slope(r) == pytest.approx((found.psi(r + h) - found.psi(r - h)) / (2 * h), abs=1e-5)
    s, jacobian = found.applied(r, np.ones((r.size, 1)))
    assert 0.5 * s**2 == pytest.approx(found.rho(r))
    assert s * jacobian[:, 0] == pytest.approx(found.psi(r), abs=1e-12)
    assert pickle.loads(pickle.dumps(found)) is found
    with pytest.raises(UnknownNameError, match="did you mean 'huber'"):
        loss("hubr")


@pytest.mark.parametrize("name", ["huber", "soft-l1", "cauchy"])
def test_a_robust_loss_has_19_in_20_of_the_efficiency_in_normal_noise(name):
    x = np.linspace(-9, 9, 200001)
    weight = np.exp(-0.5 * x**2)
    weight /= weight.sum()
    found = loss(name)
    efficiency = (weight @ found.slope(x)) ** 2 / (weight @ found.psi(x) ** 2)
    assert efficiency == pytest.approx(0.95, abs=5e-4)


def dirty(seed: int) -> Problem:
    """A line with one sample in ten far off."""
    rng = RNG(seed)
    y = 1.0 + 2.0 * T + 0.1 * rng.standard_normal(T.size)
    y[rng.choice(T.size, T.size // 10, replace=False)] += rng.uniform(1.0, 4.0, T.size // 10)
    return Problem(LINE, (recorded("e", T, {"y": 0.1}, y=y),), FREE)


@pytest.mark.parametrize(("name", "other"), [("huber", "huber"), ("soft-l1", "soft_l1"), ("cauchy", "cauchy")])
def test_the_robust_optimum_is_scipys(name, other):
    problem = dirty(0)
    y = problem.experiments[0].measured["y"]
    scale = {"huber": 1.345, "soft-l1": 1.287, "cauchy": 2.385}[name]
    best = least_squares(
        lambda p: (y - p[0] - p[1] * T) / 0.1, [1.0, 2.0], loss=other, f_scale=scale, xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    result = fit(replace(problem, loss=loss(name)), starts=1)
    assert result.status == "converged"
    assert result.loss == name
    assert [result.values["a"], result.values["b"]] == pytest.approx(best.x, rel=1e-5)
    assert result.cost == pytest.approx(best.cost, rel=1e-7)
    assert abs(result.values["a"] - 1.0) < 0.3 * abs(fit(problem, starts=1).values["a"] - 1.0)


def test_intervals_under_a_robust_loss_cover():
    """Symmetric outliers, so that the estimate is not biased; the noise is given for the clean part."""
    hits = 0
    for seed in range(120):
        rng = RNG(seed)
        noise = 0.1 * rng.standard_normal(T.size)
        bad = rng.choice(T.size, T.size // 10, replace=False)
        noise[bad] += rng.choice([-1.0, 1.0], bad.size) * rng.uniform(0.5, 2.0, bad.size)
        problem = Problem(LINE, (recorded("e", T, {"y": 0.1}, y=1.0 + 2.0 * T + noise),), FREE, loss=loss("huber"))
        low, high = fit(problem, starts=1, assess=False).estimates["b"].ci95
        hits += low <= 2.0 <= high
    assert binom.ppf(0.001, 120, 0.95) <= hits <= binom.ppf(0.9995, 120, 0.95)


def test_outliers_do_not_pass_for_noise_where_the_noise_is_unknown():
    problem = dirty(1)
    unknown = problem.with_(experiments=[problem.experiments[0].with_(noise={})])
    robust = fit(replace(unknown, loss=loss("huber")), starts=1)
    assert robust.sigma["e"]["y"] == pytest.approx(0.1, rel=0.35)
    assert fit(unknown, starts=1).sigma["e"]["y"] > 0.4


# --- priors ---


def test_a_prior_joins_the_data_by_their_weights():
    """The mean of a constant: posterior mean and standard deviation of two normal distributions."""

    def constant(t, p):
        return p["a"] + 0 * t, {"a": 1 + 0 * t}

    y = 3.0 + 0.5 * RNG(0).standard_normal(50)
    problem = Problem(
        Closed(parameters(a=0.0), {"y": constant}),
        (recorded("e", np.arange(50.0), {"y": 0.5}, y=y),),
        (FitParameter("a", 0.0, -10, 10),),
        priors={"a": Prior(2.0, 0.1)},
    )
    result = fit(problem, starts=1)
    weight = 50 / 0.25, 1 / 0.01
    assert result.values["a"] == pytest.approx((weight[0] * y.mean() + weight[1] * 2.0) / sum(weight), rel=1e-9)
    assert result.estimates["a"].std_raw == pytest.approx(sum(weight) ** -0.5, rel=1e-9)
    squares = float(np.sum((y - result.values["a"]) ** 2)) / 0.25
    assert result.cost == pytest.approx(0.5 * squares + 0.5 * ((result.values["a"] - 2.0) / 0.1) ** 2, rel=1e-9)


def test_a_prior_may_be_of_a_nuisance_and_has_to_name_an_unknown():
    t = np.linspace(0.0, 3.0, 61)
    simulator = Closed(parameters(a=1.0, k=1.0), {"y": decay})
    e = recorded("e", t, {"y": 0.1}, {"nuisance": ("a",)}, y=2.0 * np.exp(-1.5 * t))
    problem = Problem(simulator, (e,), (FitParameter("k", 1.0, 0.1, 5),), priors={"e:a": Prior(2.5, 1e-6)})
    assert fit(problem, starts=1).nuisance["e"]["a"].value == pytest.approx(2.5, abs=1e-4)
    with pytest.raises(UnknownNameError, match="did you mean 'k'"):
        replace(problem, priors={"kk": Prior(0.0, 1.0)})
    with pytest.raises(StudyError, match="standard deviation above 0"):
        Prior(1.0, 0.0)


# --- noise that was estimated ---


def test_noise_estimated_from_few_samples_widens_the_intervals_as_students_t():
    y = 1.0 + 2.0 * T + 0.3 * RNG(5).standard_normal(T.size)
    e = recorded("e", T, {"y": 0.3}, y=y)
    exact = fit(Problem(LINE, (e,), FREE), starts=1)
    few = fit(Problem(LINE, (e.with_(noise_dof={"y": 8.0}),), FREE), starts=1)
    width = [r.estimates["b"].ci95[1] - r.estimates["b"].ci95[0] for r in (exact, few)]
    assert width[1] / width[0] == pytest.approx(2.306004135 / 1.959963985, rel=1e-9)  # t(8) over normal, 0.975
    assert (exact.dof, few.dof) == (None, 8.0)
    assert few.adequacy.outputs["y"].high > exact.adequacy.outputs["y"].high  # F against chi-square


def test_a_record_that_moves_before_its_event_is_no_noise_to_whiten_with():
    t = np.arange(300) * 0.01
    e = recorded("e", t, {"y": 0.01}, {"event": 2.0}, y=np.exp(-0.7 * t) + 0.01 * RNG(5).standard_normal(t.size))
    with pytest.raises(StudyError, match=r"at least 20 rows before the event, at rest.*got 0 rows"):
        models_before_event([e], ["y"])
