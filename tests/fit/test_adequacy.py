"""Whether the residual is of the size of the noise: verdicts, their thresholds, and what they do to the intervals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import f as f_distribution

from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.fit.adequacy import cross_correlation
from hvdc_ident.next_step import NextStep, next_phrases
from tests.fit.simulators import Closed, coloured, line, parameters, recorded

T = np.linspace(0.0, 1.0, 200)
FREE = (FitParameter("a", 0.0, -50, 50), FitParameter("b", 0.0, -50, 50))
LINE = Closed(parameters(a=0.0, b=0.0), {"y": line})


def straight(told: float | None, y: np.ndarray, t: np.ndarray = T, starts: int = 1):
    noise = {} if told is None else {"y": told}
    return fit(Problem(LINE, (recorded("e", t, noise, y=y),), FREE), starts=starts)


def white(seed: int, sigma: float = 0.1, n: int = T.size) -> np.ndarray:
    return sigma * np.random.default_rng(seed).standard_normal(n)


def test_a_right_model_with_the_right_noise_fits_in_nearly_every_sample():
    verdicts = [straight(0.1, 1 + 2 * T + white(seed)).adequacy.verdict for seed in range(60)]
    assert verdicts.count("fits") == 60


def test_correlated_noise_of_the_size_told_is_no_misfit():
    for seed in range(20):
        y = 1 + 2 * T + coloured(np.random.default_rng(seed), T.size, 0.95, 0.1)
        assert straight(0.1, y).adequacy.verdict == "fits"


@pytest.mark.parametrize("bend", [1.0, 30.0])
def test_a_bend_that_the_model_lacks_does_not_fit_and_leaves_no_interval(bend):
    """The parabola's slope at 0 is 2, the line's 2 + bend: no residual of the line tells how far off that is."""
    result = straight(0.01, 1 + 2 * T + bend * T**2 + white(1, 0.01))
    judged, estimate = result.adequacy, result.estimates["b"]
    assert judged.verdict == "does-not-fit"
    assert judged.chi2_per_dof == pytest.approx(result.chi2_per_dof)
    assert "times the stated noise" in judged.text and judged.next == (NextStep("diagnose"),)
    assert estimate.value == pytest.approx(2.0 + bend, abs=0.1)
    assert estimate.ci95 is None and estimate.std is None and "no interval" in estimate.reason


@pytest.mark.parametrize("factor", [3.0, 8.0])
def test_a_noise_told_too_large_or_too_small_is_told_with_its_factor(factor):
    y = 1 + 2 * T + white(3)
    large, small = straight(0.1 * factor, y).adequacy, straight(0.1 / factor, y).adequacy
    assert (large.verdict, small.verdict) == ("noise-overstated", "noise-understated")
    y0 = white(3) - np.polyval(np.polyfit(T, white(3), 1), T)
    actual = float(np.sqrt(y0 @ y0 / (T.size - 2)))
    for judged, times in ((large, 0.1 * factor / actual), (small, actual * factor / 0.1)):
        assert f" {times:.2g} times" in judged.text and "noise = {y = 0.1" in next_phrases(judged.next)
        assert judged.outputs["y"].noise * judged.outputs["y"].times == pytest.approx(actual, rel=1e-6)


def test_the_threshold_is_the_f_quantile_where_few_rows_or_a_guessed_noise_allow_more():
    t = np.linspace(0, 1, 5)
    size = straight(0.1, 1 + 2 * t + white(1, 0.1, 5), t).adequacy.outputs["y"]
    assert size.high == pytest.approx(f_distribution.isf(1e-3, 3, 1e9), rel=1e-6)
    e = recorded("e", T, {"y": 0.1}, {"noise_dof": {"y": 4.0}}, y=1 + 2 * T + white(1))
    result = fit(Problem(LINE, (e,), FREE), starts=1)
    assert result.adequacy.outputs["y"].high == pytest.approx(f_distribution.isf(1e-3, 198, 4.0), rel=1e-6)
    assert result.noise_source == {"y": "estimated before the event"}


def test_without_a_noise_the_rows_themselves_judge_where_they_show_white_noise():
    good, bad = straight(None, 1 + 2 * T + white(5)), straight(None, 1 + 2 * T + 3 * T**2 + white(5))
    assert good.noise_source == bad.noise_source == {"y": "misfit"}
    assert good.adequacy.verdict == "fits" and good.adequacy.chi2_per_dof is None
    assert good.adequacy.outputs["y"].noise == pytest.approx(0.1, rel=0.2)
    assert bad.adequacy.verdict == "does-not-fit" and "row-to-row noise" in bad.adequacy.text
    smooth = straight(None, 1 + 2 * T + 3 * T**2)
    assert smooth.adequacy.verdict == "not-judged" and "the fit's own residual" in smooth.adequacy.text


def test_outliers_are_no_misfit_under_a_robust_loss():
    from dataclasses import replace

    from hvdc_ident.fit.likelihood import loss

    y = 1 + 2 * T + white(2)
    y[::20] += 3.0
    problem = Problem(LINE, (recorded("e", T, {"y": 0.1}, y=y),), FREE)
    assert fit(problem, starts=1).adequacy.verdict != "fits"
    assert fit(replace(problem, loss=loss("huber")), starts=1).adequacy.verdict == "fits"


def test_the_interval_of_independent_residuals_stands_beside_one_that_correlation_widens():
    y = 1 + 2 * T + coloured(np.random.default_rng(1), T.size, 0.98, 0.1)
    estimate = straight(0.1, y).estimates["b"]
    (low, high), (inner_low, inner_high) = estimate.ci95, estimate.ci95_independent
    assert low < inner_low < inner_high < high
    assert inner_high - inner_low == pytest.approx(2 * 1.959964 * estimate.std_raw, rel=1e-5)
    assert "200 rows are worth" in estimate.reason
    assert straight(0.1, 1 + 2 * T + white(1)).estimates["b"].ci95_independent is None


def test_the_interval_of_a_positive_parameter_does_not_go_below_zero():
    from hvdc_ident.parameters import Parameter

    y = 0.02 + white(1)
    for own, search in ((Parameter(1.0, min=0.0), (-50, 50)), (Parameter(1.0), (0.0, 50.0))):
        plant = Closed({"a": own, "b": Parameter(0.0)}, {"y": line})
        free = (FitParameter("a", 1.0, *search), FitParameter("b", 0.0, -50, 50))
        a = fit(Problem(plant, (recorded("e", T, {"y": 0.1}, y=y),), free), starts=1).estimates["a"]
        assert a.ci95[0] == 0.0 < a.value < a.ci95[1]
        assert a.value - 1.96 * a.std < 0.0


def test_a_second_optimum_as_good_is_told_beside_each_estimate_that_it_moves():
    def squared(t, p):
        return p["a"] ** 2 + p["b"] * t, {"a": 2 * p["a"] + 0 * t, "b": t}

    plant = Closed(parameters(a=1.0, b=0.0), {"y": squared})
    free = (FitParameter("a", 1.0, -3, 3), FitParameter("b", 0.0, -5, 5))
    result = fit(Problem(plant, (recorded("e", T, {"y": 0.1}, y=1 + T + white(1)),), free))
    assert result.status == "two-optima"
    assert "another optimum, as good, has" in result.estimates["a"].reason
    assert result.estimates["b"].reason == ""


def test_a_record_that_stands_still_at_the_model_is_told_without_a_factor():
    still = straight(0.1, np.zeros(T.size)).adequacy
    assert still.verdict == "noise-overstated" and "the residual of y is 0" in still.text


def test_a_record_that_the_model_meets_to_its_last_digits_fits():
    judged = straight(None, 1 + 2 * T).adequacy
    assert judged.verdict == "fits" and "to 1e-06 of its range" in judged.text


def test_a_single_record_that_is_off_is_not_lost_among_others():
    """Nine records on the line and one bent away from it: together 1.6 times the noise's power, that one 7 times."""
    records = {f"e{k}": 1 + 2 * T + white(k) for k in range(9)}
    records["bent"] = 1 + 2 * T + white(9) + 0.35 * np.sin(6 * T)
    experiments = tuple(recorded(n, T, {"y": 0.1}, y=y) for n, y in records.items())
    judged = fit(Problem(LINE, experiments, FREE), starts=1).adequacy
    power = {n: s.ratio for n, s in judged.signals["y"].items()}
    assert np.mean(list(power.values())) < 2.0 < power["bent"]
    assert judged.verdict == "does-not-fit" and "the residual of y in 'bent' is" in judged.text
    assert [n for n, s in judged.signals["y"].items() if not s.follows] == ["bent"]


def test_records_that_are_off_only_together_are_told_by_their_size():
    """Of few rows each no record is beyond chance; all of them are, and those with twice the noise's power do not follow."""
    t = np.linspace(0.0, 1.0, 6)
    experiments = tuple(recorded(f"e{k}", t, {"y": 0.1}, y=1 + 2 * t + white(k, 0.17, 6)) for k in range(40))
    judged = fit(Problem(LINE, experiments, FREE), starts=1).adequacy
    signals = judged.signals["y"].values()
    assert judged.verdict == "noise-understated" and judged.outputs["y"].record == ""
    assert {s.follows for s in signals} == {True, False}
    assert all(s.follows is (s.ratio <= 2.0) for s in signals if s.ratio < s.high)


def test_two_slow_signals_that_have_nothing_to_do_with_each_other_are_not_related() -> None:
    """Of independent AR(1) signals of coefficient 0.95 about one pair in twenty has p < 0.05; a copy is seen at its lag."""
    random = np.random.default_rng(11)
    slow = lfilter([1.0], [1.0, -0.95], random.standard_normal((2, 200, 400)), axis=2)
    found = [cross_correlation(r, u).p for r, u in zip(*slow, strict=True)]
    assert np.mean(np.array(found) < 0.05) < 0.1
    signal = slow[0, 0]
    led = cross_correlation(signal[:-3], signal[3:])  # the input leads by three rows
    assert led.lag == 3 and led.correlation == pytest.approx(1.0, abs=0.02) and led.p < 1e-6
