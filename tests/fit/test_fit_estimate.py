"""The verb: statuses, starts, noise, singular problems, the result's forms."""

from __future__ import annotations

import json
import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.stats import chi2

from hvdc_ident.data import InputSignal
from hvdc_ident.fit import FitParameter, Problem, fit
from tests.fit.simulators import Closed, coloured, decay, line, parameters, recorded, step_response

T = np.linspace(0.0, 3.0, 61)
RNG = np.random.default_rng


def decaying(noise=0.01, seed=1, given=True, bounds=(0.0, 5.0), **rest) -> Problem:
    simulator = Closed(parameters(a=1.0, k=1.0), {"y": decay}, **rest)
    y = 2.0 * np.exp(-1.5 * T) + noise * RNG(seed).normal(size=T.size)
    free = (FitParameter("a", 1.0, 0.1, 10), FitParameter("k", max(1.0, bounds[0]), *bounds))
    return Problem(simulator, (recorded("e", T, {"y": noise} if given else {}, y=y),), free)


def test_exact_data_give_exact_parameters_and_say_what_the_noise_is():
    t = np.linspace(0, 1, 201)
    truth = {"w": 20.0, "z": 0.35, "gain": 2.0}
    simulator = Closed(parameters(w=10.0, z=0.7, gain=1.0), {"y": step_response})
    free = (FitParameter("w", 10, 2, 100), FitParameter("z", 0.7, 0.05, 0.95), FitParameter("gain", 1, 0.1, 10))
    result = fit(Problem(simulator, (recorded("e", t, y=step_response(t, truth)[0]),), free))
    assert result.status == "converged"
    for name, value in truth.items():
        assert result.estimates[name].value == pytest.approx(value, rel=1e-6)
        assert result.estimates[name].std < 1e-5 * value
    assert result.noise_source == {"y": "misfit, at the floor of 1e-6 of the range"}
    assert result.rmse["y"]["e"] < 1e-9 < 0.1 < result.rmse_start["y"]["e"]


def test_given_noise_is_used_and_absent_noise_comes_from_the_misfit():
    known, unknown = fit(decaying()), fit(decaying(given=False))
    assert (known.noise_source["y"], unknown.noise_source["y"]) == ("given", "misfit")
    scale = math.sqrt(known.chi2_per_dof)
    assert unknown.estimates["k"].value == pytest.approx(known.estimates["k"].value, rel=1e-7)
    assert unknown.estimates["k"].std_raw == pytest.approx(scale * known.estimates["k"].std_raw, rel=1e-6)
    assert unknown.chi2_per_dof == pytest.approx(1.0, rel=1e-6)
    low, high = known.estimates["k"].ci95
    assert high - low == pytest.approx(2 * 1.959963985 * known.estimates["k"].std, rel=1e-6)


def test_noise_at_the_floor_means_deterministic_data():
    e = decaying(given=False).experiments[0]
    floor = 1e-6 * float(np.ptp(e.measured["y"]))
    problem = decaying(given=False).with_(experiments=[e.with_(noise={"y": floor})])
    assert fit(problem).noise_source == {"y": "misfit"}


def test_outputs_of_unlike_units_are_weighed_by_their_own_misfit():
    def big(t, p):
        y, g = decay(t, p)
        return 1e5 * y, {n: 1e5 * v for n, v in g.items()}

    rng = RNG(5)
    simulator = Closed(parameters(a=1.0, k=1.0), {"y": decay, "big": big})
    y = 2.0 * np.exp(-1.5 * T)
    data = {"y": y + 0.1 * rng.normal(size=T.size), "big": 1e5 * (y + 0.001 * rng.normal(size=T.size))}
    free = (FitParameter("a", 1.0, 0.1, 10), FitParameter("k", 1.0, 0, 5))
    result = fit(Problem(simulator, (recorded("e", T, **data),), free))
    assert result.status == "converged"
    assert result.sigma["e"]["y"] == pytest.approx(0.1, rel=0.3)
    assert result.sigma["e"]["big"] == pytest.approx(100, rel=0.3)
    alone = fit(Problem(simulator, (recorded("e", T, {"y": 0.1, "big": 100.0}, **data),), free))
    assert result.estimates["k"].value == pytest.approx(alone.estimates["k"].value, abs=0.3 * alone.estimates["k"].std)
    assert result.chi2_per_dof == pytest.approx(1.0, rel=0.02)


def test_an_estimate_on_its_bound_has_a_one_sided_limit_and_no_std():
    result = fit(decaying(bounds=(1.51, 5.0)))
    estimate = result.estimates["k"]
    assert result.status == "at-bound"
    assert (estimate.value, estimate.std, estimate.method) == (1.51, None, "one-sided")
    low, high = estimate.ci95
    assert low == 1.51 < high < 1.56
    assert result.estimates["a"].std > 0


def test_the_one_sided_limit_is_where_the_profile_has_risen_enough():
    problem = Problem(
        Closed(parameters(a=1.0, b=0.1), {"y": line}),
        (recorded("e", T, {"y": 0.1}, y=1.0 - 0.01 * T + 0.1 * RNG(1).normal(size=T.size)),),
        (FitParameter("a", 1.0, -5, 5), FitParameter("b", 0.1, 0, 5)),
    )
    limit = fit(problem).estimates["b"].ci95[1]
    r0 = fit(problem).cost
    fixed = fit(Problem(problem.simulator, problem.experiments, problem.free[:1], held={"b": limit}))
    assert fixed.cost - r0 == pytest.approx(0.5 * chi2.ppf(0.90, 1), rel=1e-6)


def test_two_estimates_on_bounds_have_no_limits():
    simulator = Closed(parameters(a=1.0, b=1.0), {"y": line})
    free = (FitParameter("a", 1.0, 0.5, 2), FitParameter("b", 1.0, 0.5, 2))
    result = fit(Problem(simulator, (recorded("e", T, {"y": 1.0}, y=0 * T),), free))
    assert result.status == "at-bound"
    assert [e.ci95 for e in result.estimates.values()] == [None, None]
    assert "not independent" in result.estimates["a"].reason


def squared(t, p):
    """y = (a^2 - 1) + small * a: the optima lie near -1 and 1, one deeper by the small term."""
    a, s = p["a"], p["small"]
    return (a * a - 1) + s * a + 0 * t, {"a": 2 * a + s + 0 * t, "small": a + 0 * t}


@pytest.mark.parametrize(("y", "status"), [(0.0, "two-optima"), (5.0, "converged")])
def test_two_optima_that_are_as_good_are_said_to_be_two(y, status):
    simulator = Closed(parameters(a=1.0, small=0.0), {"y": squared})
    low = -3.0 if y == 0.0 else -1.0
    problem = Problem(simulator, (recorded("e", T, {"y": 0.1}, y=y + 0 * T),), (FitParameter("a", 0.5, low, 3.0),))
    result = fit(problem, starts=8, seed=2)
    assert result.status == status
    if status == "two-optima":
        assert abs(result.estimates["a"].value) == pytest.approx(1.0, rel=1e-6)
        ends = {round(s.end["a"], 4) for s in result.starts if s.status == "converged" and s.cost < 1}
        assert ends == {-1.0, 1.0}


def test_a_worse_optimum_is_no_rival():
    simulator = Closed(parameters(a=1.0, small=0.5), {"y": lambda t, p: doubled(t, p)})
    problem = Problem(
        simulator, (recorded("e", T, {"y": 0.1, "z": 0.1}, y=0 * T, z=1 + 0 * T),), (FitParameter("a", -1, -3, 3),)
    )
    problem.simulator.outputs["z"] = lambda t, p: (p["a"] + 0 * t, {"a": 1 + 0 * t})
    result = fit(problem)
    assert result.status == "converged"
    assert result.estimates["a"].value == pytest.approx(1.0)
    assert any(s.cost > result.cost + 100 for s in result.starts if s.status == "converged")


def doubled(t, p):
    y, g = squared(t, p | {"small": 0.0})
    return 10 * y, {"a": 10 * g["a"]}


def product(t, p):
    """y = a b (1 + t) + c t^2: of a and b only the product shows; d does nothing."""
    a, b, c = p["a"], p["b"], p["c"]
    return a * b * (1 + t) + c * t**2, {"a": b * (1 + t), "b": a * (1 + t), "c": t**2, "d": 0 * t}


def test_directions_that_data_do_not_determine_have_a_reason_and_no_std():
    simulator = Closed(parameters(a=2.0, b=3.0, c=0.5, d=1.0), {"y": product})
    y = 6.0 * (1 + T) + 0.7 * T**2 + 0.01 * RNG(2).normal(size=T.size)
    free = tuple(FitParameter(n, v, 0.1, 20) for n, v in (("a", 1.0), ("b", 1.0), ("c", 1.0), ("d", 1.0)))
    result = fit(Problem(simulator, (recorded("e", T, {"y": 0.01}, y=y),), free))
    e = result.estimates
    assert result.status == "converged"
    assert (e["a"].std, e["b"].std, e["d"].std, e["d"].ci95) == (None, None, None, None)
    assert e["a"].reason == "only a combination with b is determined"
    assert e["d"].reason == "no compared output depends on it here"
    assert e["a"].value * e["b"].value == pytest.approx(6.0, rel=1e-3)
    assert e["c"].value == pytest.approx(0.7, rel=0.02)
    reference = np.linalg.inv(np.column_stack([1 + T, T**2]).T @ np.column_stack([1 + T, T**2])) * 1e-4
    assert e["c"].std_raw == pytest.approx(math.sqrt(reference[1, 1]), rel=1e-6)
    assert set(result.correlation) == {"c"}


def test_as_many_rows_as_unknowns_say_nothing_about_the_noise():
    simulator = Closed(parameters(a=1.0, b=1.0), {"y": line})
    problem = Problem(
        simulator, (recorded("e", T[:2], y=T[:2]),), (FitParameter("a", 1, -5, 5), FitParameter("b", 1.5, -5, 5))
    )
    result = fit(problem)
    assert result.chi2_per_dof is None
    assert result.estimates["a"].std is None
    assert "not more rows than unknowns" in result.estimates["a"].reason


def test_starts_that_fail_are_listed_and_the_rest_goes_on():
    result = fit(decaying(fails=lambda p: p["k"] > 2.0), starts=12)
    failed = [s for s in result.starts if s.status == "failed"]
    assert result.status == "converged"
    assert failed
    assert all(s.cost is None and "the run does not reach its end" in s.message for s in failed)
    assert result.estimates["k"].value == pytest.approx(1.5, abs=0.05)


def test_a_fit_whose_every_start_fails_has_no_numbers():
    result = fit(decaying(fails=lambda p: True))
    assert (result.status, result.cost, dict(result.estimates)) == ("failed", None, {})
    assert "the run does not reach its end" in result.message
    assert result.rmse_start == {"y": {"e": None}}
    json.dumps(result.to_dict(), allow_nan=False)


def test_a_simulator_that_fails_from_some_run_on_costs_no_more_than_the_reason():
    """As an FMU that runs once: wherever in the fit it is, the result says so or is that of the runs before."""
    sound = decaying(given=False)
    whole = fit(sound, starts=2, assess=False)
    messages = set()
    for last in range(1, sound.simulator.runs):
        worn = decaying(given=False)
        worn.simulator.fails = lambda p, s=worn.simulator, last=last: s.runs > last
        result = fit(worn, starts=2, assess=False)
        assert result.status in ("failed", "not-converged", "converged")
        if result.status == "failed":
            assert "does not reach its end" in result.message and not result.estimates
            messages.add(result.message.partition(":")[0])
        if result.status == "converged":
            assert result.estimates["k"].value == pytest.approx(whole.estimates["k"].value, rel=1e-6)
    assert messages == {"no start reached an end", "the optimum cannot be simulated again"}


def test_an_optimum_in_reach_only_through_failing_runs_is_no_optimum():
    result = fit(decaying(fails=lambda p: p["k"] > 1.2, bounds=(0.0, 1.4)), starts=4)
    assert result.status == "failed"


def test_a_fit_stopped_early_is_not_converged():
    from hvdc_ident.fit.optimisers.trust_region import TrustRegion

    assert fit(decaying(), optimiser=TrustRegion(max_evaluations=2)).status == "not-converged"


def test_the_seed_fixes_the_starts_and_an_executor_changes_nothing():
    lines = []
    one = fit(decaying(), seed=4, progress=lambda done, total, text: lines.append((done, total)))
    with ThreadPoolExecutor(2) as pool:
        two = fit(decaying(), seed=4, executor=pool)
    assert one.to_dict() == two.to_dict()
    assert lines == [(i, 8) for i in range(9)]
    assert one.starts[0].start == {"a": 1.0, "k": 1.0}
    assert one.starts[1].start != fit(decaying(), seed=5).starts[1].start


def test_the_result_is_json_and_toml_of_full_precision():
    problem = Problem(
        decaying().simulator, decaying().experiments, decaying().free[1:], held={"a": 2.0}, why={"a": "insensitive"}
    )
    result = fit(problem, starts=2)
    text = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert {
        "fitted",
        "held",
        "estimates",
        "cost",
        "rmse",
        "residual_tests",
        "starts",
        "status",
        "per_experiment",
    } <= set(text)
    assert text["held"] == {"a": "insensitive"}
    assert {"value", "std", "ci95", "method", "conditional_on"} <= set(text["estimates"]["k"])
    assert text["estimates"]["k"]["value"] == result.estimates["k"].value


def test_residual_tests_tell_noise_from_a_missing_effect():
    rest = {"inputs": {"u": InputSignal.step(1.0, 0.0, 1.0)}}
    simulator = Closed(parameters(a=1.0, b=1.0), {"y": line})
    free = (FitParameter("a", 1, -5, 5), FitParameter("b", 1, -5, 5))
    t = np.linspace(0, 3, 301)
    noise = 0.1 * RNG(7).normal(size=t.size)
    clean = fit(Problem(simulator, (recorded("e", t, {"y": 0.1}, rest, y=t + noise),), free), starts=1)
    good = clean.residual_tests["y"]["e"]
    assert min(good.ljung_box.p, good.runs.p, good.inputs["u"].p) > 0.01
    wrong = t + noise + 0.6 * np.exp(-(((t - 1.0) / 0.05) ** 2) * (t > 1.0)) * (t > 1.0)
    bad = fit(Problem(simulator, (recorded("e", t, {"y": 0.1}, rest, y=wrong),), free), starts=1)
    test = bad.residual_tests["y"]["e"]
    assert test.ljung_box.p < 1e-3
    assert test.inputs["u"].p < 1e-3


def test_slow_residuals_widen_the_interval():
    y = 2.0 * np.exp(-1.5 * T) + coloured(RNG(3), T.size, 0.8, 0.02)
    problem = decaying().with_(experiments=[recorded("e", T, {"y": 0.02}, y=y)])
    result = fit(problem)
    assert result.rho["y"] > 0.4
    assert result.effective_samples["y"] < 0.5 * T.size
    assert result.estimates["a"].std > 1.2 * result.estimates["a"].std_raw


def test_a_method_that_stops_short_is_refined_before_anything_is_said():
    """A quasi-Newton method stopped after 3 evaluations is far off; the result stands at the optimum and says how it got there."""
    from hvdc_ident.fit.optimisers.l_bfgs_b import LBfgsB

    alone = LBfgsB(max_evaluations=3).run(decaying(), decaying().start)
    assert alone.status == "max-evaluations"
    result, reference = fit(decaying(), optimiser=LBfgsB(max_evaluations=3), starts=1), fit(decaying(), starts=1)
    assert result.status == "converged"
    assert result.values == pytest.approx(dict(reference.values), rel=1e-7)
    assert "then least squares lowered the cost by" in result.starts[0].message
    assert alone.cost > result.cost + 1e-6


@pytest.mark.parametrize("status", ["not-converged", "at-bound", "two-optima", "failed"])
def test_the_report_says_first_what_became_of_the_fit(status):
    from hvdc_ident.fit import FitResult
    from hvdc_ident.report.sections.gains import STATUS, _outcome

    words = _outcome(FitResult(status, "why <it> is so"))
    assert STATUS[status] in words and f"({status})" in words
    assert "why &lt;it&gt; is so" in words
    assert "converged" not in words.replace("not-converged", "").replace("did not converge", "")


def test_individual_groups_are_no_better_than_their_worst():
    from hvdc_ident.fit import Group, fit_individually
    from hvdc_ident.fit.optimisers.trust_region import TrustRegion

    simulator = Closed(parameters(a=1.0, k=1.0), {"y": decay})
    e = recorded("e", T, {"y": 0.01}, y=2.0 * np.exp(-1.5 * T))
    problem = Problem(simulator, (e,), (FitParameter("a", 1.0, 0.1, 10), FitParameter("k", 1.0, 0.0, 1.2)))
    groups = [Group(("a",)), Group(("k",))]
    assert fit_individually(problem, groups, starts=1).status == "at-bound"
    assert (
        fit_individually(problem, groups, starts=1, optimiser=TrustRegion(max_evaluations=1)).status == "not-converged"
    )
