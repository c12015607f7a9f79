"""The verbs in Python: names, numbers, arrays, tables and studies in, one screen out; wrong calls say what to do."""

from __future__ import annotations

import dataclasses
import json
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hvdc_ident as hi
from hvdc_ident.aliases import MOVED
from hvdc_ident.axes import draw_intervals
from hvdc_ident.codec import plain
from hvdc_ident.errors import InputError
from hvdc_ident.fit import Problem
from hvdc_ident.identifiability.verdicts import Verdict
from hvdc_ident.sensitivity.sweep_points import latin_hypercube, log_grid
from hvdc_ident.study.assemble import experiments_of

T, K, STEP = 0.5, 3.0, 1.0
TIME = np.linspace(0.0, 5.0, 101)
NOISE = 0.01
LAG = hi.Model(
    "lag",
    parameters={"T": {"value": 1.0, "unit": "s"}, "k": 2.0, "unseen": 1.0},
    inputs={"u": 0.0, "v": 0.0},
    states={"x": "(k*u + unseen*v - x)/T"},
    outputs={"y": "x"},
)
BOUNDS = {"T": (0.1, 10.0), "k": (0.0, 10.0), "unseen": (0.1, 5.0)}


def _plant() -> np.ndarray:
    """The step response by scipy, with noise."""
    rest, moving = TIME[TIME < STEP], TIME[TIME >= STEP]
    found = solve_ivp(lambda t, x: (K - x) / T, (STEP, TIME[-1]), [0.0], t_eval=moving, rtol=1e-10, atol=1e-12)
    return np.concatenate([np.zeros(rest.size), found.y[0]])


CLEAN = _plant()
Y = CLEAN + NOISE * np.random.default_rng(1).standard_normal(TIME.size)
U = hi.step(0.0, 1.0, at=STEP)
RECORD = hi.Experiment(TIME, "step", inputs={"u": U}, outputs={"y": Y}, noise={"y": NOISE})


@pytest.fixture(scope="module")
def report() -> Any:
    return hi.identify(LAG, RECORD, BOUNDS)


@pytest.fixture(scope="module")
def fit(report: Any) -> Any:
    return hi.fit(LAG, RECORD, BOUNDS, report=report)


@pytest.mark.parametrize("u", [U, np.where(TIME >= STEP, 1.0, 0.0), lambda t: np.where(t >= STEP, 1.0, 0.0)])
def test_an_input_may_be_a_signal_or_samples(u: Any) -> None:
    run = hi.simulate(LAG, TIME, {"T": T, "k": K}, "T", inputs={"u": u, "v": 0.0}, outputs="y")
    assert np.abs(run["y"] - CLEAN).max() < 1e-6
    s = np.clip(TIME - STEP, 0.0, None)
    assert np.abs(run.gradient("y")[:, 0] + K * s / T**2 * np.exp(-s / T)).max() < 1e-5


def test_the_fit_is_gated_and_agrees_with_scipy(report: Any, fit: Any) -> None:
    assert report.identifiable == fit.fitted == ("T", "k") and "insensitive" in fit.held["unseen"]
    for name, true in (("T", T), ("k", K)):
        low, high = fit.estimates[name].ci95
        assert low < true < high
    forced = hi.fit(LAG, RECORD, {"T": (0.1, 10.0), "unseen": (0.1, 5.0)}, force="unseen", starts=1)
    assert "unseen" in forced.fitted or forced.status == "failed"


@pytest.mark.parametrize(
    "parameters",
    [
        {"T": [0.1, 10.0], "k": 2.5},
        [("T", 0.1, 10.0), ("k", 2.5)],
        [["T", 0.1, 10.0], ["k", {"start": 2.5}]],
        (("T", (0.1, 10.0)), ("k", 2.5)),
    ],
)
def test_bounds_may_be_a_mapping_or_a_list(parameters: Any) -> None:
    found = hi.check(LAG, RECORD, parameters).to_dict()["candidates"]
    assert (found["T"]["min"], found["T"]["max"], found["k"]["start"]) == (0.1, 10.0, 2.5)


def test_python_is_told_calls_and_no_commands(tmp_path: Any) -> None:
    hi.export(LAG, tmp_path / "lag.toml")
    (tmp_path / "s.toml").write_text('schema = 1\n[model]\nsource = "lag.toml"\n')
    with pytest.raises(InputError, match=r'values="given"') as caught:
        hi.export(tmp_path / "s.toml", tmp_path / "x.toml", values="fitted")
    assert "--values" not in str(caught.value)
    (tmp_path / "step.csv").write_text("time,u\n0,1\n1,2\n")
    for name, words in (
        ("none/s.toml", "write_starter"),
        ("step.csv", r"list_signals\('.*step.csv'\)` lists its signals"),
    ):
        with pytest.raises(InputError, match=words) as caught:
            hi.load_study(tmp_path / name)
        assert "hvdc-ident" not in str(caught.value)
    with pytest.raises(InputError, match="run_all") as caught:
        hi.compare_runs(tmp_path / "none", tmp_path)
    assert "hvdc-ident" not in str(caught.value)
    told = str(hi.check(LAG, RECORD, {"T": (2.0, 3.0)}))
    assert told.splitlines()[-1].endswith("`hi.check(...)`") and "hvdc-ident" not in told


@pytest.mark.parametrize("half", [0.02, 0.9, 1.2, 3.0, 40.0, 900.0])
def test_the_axis_of_intervals_has_ticks_on_both_sides(half: float) -> None:
    plt = pytest.importorskip("matplotlib.pyplot")
    verdict = Verdict("k", "identifiable", "", 100.0, ci95=(100.0 - half, 100.0 + 1.1 * half), scale=100.0)
    axes = plt.subplots()[1]
    draw_intervals(axes, {"k": verdict})
    low, high = axes.get_xlim()
    shown = [t for t in axes.get_xticks() if low <= t <= high]
    assert 3 <= len(shown) <= 11 and shown == [-t for t in reversed(shown)]
    plt.close("all")


def test_tables_and_lists_are_the_same_data() -> None:
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"time": TIME, "u": np.where(TIME >= STEP, 1.0, 0.0), "y": Y})
    plain = hi.Experiment(TIME, inputs={"u": U}, outputs={"y": Y})
    for data in (frame, frame.set_index("time"), [plain], plain):
        (found,) = experiments_of(data, LAG)
        assert found.time.tolist() == TIME.tolist() and found.measured["y"].tolist() == Y.tolist()
        assert found.inputs["u"](TIME).tolist() == U(TIME).tolist() and found.inputs["u"].jumps.tolist() == [STEP]


def test_a_study_file_gives_what_its_parts_give(tmp_path: Any) -> None:
    hi.export(LAG, tmp_path / "lag.toml")
    rows = "".join(f"{a!r},{b!r},{c!r}\n" for a, b, c in zip(TIME.tolist(), U(TIME).tolist(), Y.tolist(), strict=True))
    (tmp_path / "a.csv").write_text("time,u,y\n" + rows)
    (tmp_path / "s.toml").write_text(
        'schema = 1\n[model]\nsource = "lag.toml"\n[parameters]\nT = {min = 0.1, max = 10}\nk = {min = 0, max = 10}\n'
        '[[experiment]]\nname = "step"\ndata = "a.csv"\ninputs = ["u"]\noutputs = ["y"]\nnoise = {y = 0.01}\n'
    )
    study = hi.load_study(tmp_path / "s.toml")
    whole = hi.fit(tmp_path / "s.toml")
    parts = hi.fit(LAG, study.experiments, {"T": (0.1, 10.0), "k": (0.0, 10.0)})
    assert dict(whole.values) == dict(parts.values)
    assert "study" in str(hi.check(study)) and hi.check(study).to_dict()["candidates"].keys() == {"T", "k"}
    assert hi.simulate(study)["y"].shape == TIME.shape
    other = hi.sweep(LAG, study, {"T": [0.25, 0.5, 1.0]}, values={"k": K})
    assert other.best("y", "step") == {"T": 0.5}


def test_one_executor_and_one_progress_serve_all(fit: Any) -> None:
    told: list[tuple[int, int, str]] = []
    with ThreadPoolExecutor(2) as pool:
        values = hi.fit(
            LAG, RECORD, ["T", "k"], executor=pool, progress=lambda done, total, text: told.append((done, total, text))
        ).values
        table = hi.sweep(
            LAG, RECORD, {"T": np.linspace(0.2, 1.0, 9)}, executor=pool, progress=lambda *x: told.append(x)
        )
    assert {n: values[n] for n in ("T", "k")} == pytest.approx({n: fit.values[n] for n in ("T", "k")}, rel=1e-6)
    assert told[-1] == (9, 9, "points") and np.isfinite(table.rmse).all()


def test_linear_verbs_agree_with_the_mathematics(fit: Any) -> None:
    linear = hi.linearize(LAG, inputs="u", outputs="y", values=fit)
    assert linear.poles() == pytest.approx([-1.0 / fit.values["T"]])
    response = hi.bode(linear, [0.1, 1.0])
    s = 1j * np.array([0.1, 1.0])
    assert response.values[:, 0, 0] == pytest.approx(fit.values["k"] / (1 + s * fit.values["T"]))
    assert hi.find_operating_point(LAG, {"u": 2.0}).outputs["y"] == pytest.approx(4.0)
    assert hi.find_operating_point(LAG, outputs={"y": 1.0}, free="u").inputs["u"] == pytest.approx(0.5)
    found = hi.sensitivities(LAG, TIME, "k", inputs={"u": U})
    assert found.trajectories is not None


def test_every_result_is_one_screen_a_table_and_a_figure(report: Any, fit: Any) -> None:
    pytest.importorskip("pandas")
    plt = pytest.importorskip("matplotlib.pyplot")
    run = hi.simulate(LAG, RECORD)
    linear = hi.linearize(LAG, inputs="u", outputs="y")
    table = hi.sweep(LAG, RECORD, {"T": [0.5, 1.0]})
    words = {
        "insensitive": report,
        "0.5": fit,
        "y": run,
        "smallest": run.trajectory,
        "largest gain": linear.bode(),
        "no limit is active": hi.find_operating_point(LAG),
        "stable": linear,
        "RMSE": table,
        "step": RECORD,
        "unseen": LAG,
    }
    for word, result in words.items():
        text = str(result)
        assert word in text and len(text.splitlines()) < 50
        assert "<table>" in result._repr_html_() and len(repr(result).splitlines()) == 1
    for result in (report, fit, run, table, RECORD, linear.bode()):
        assert len(result.to_dataframe()) and result.plot() is not None
    assert list(fit.to_dataframe().index) == ["T", "k"]
    assert run.to_xarray()["y"].attrs["units"] == "" and linear.bode().to_xarray().shape == linear.bode().values.shape
    plt.close("all")


def test_a_result_has_its_parameters_by_name_and_comes_back_from_its_json(report: Any, fit: Any) -> None:
    assert fit.params["T"].value == fit.values["T"] and fit.params["T"].interval == fit.estimates["T"].ci95
    assert fit.params["unseen"].value == 1.0 and "insensitive" in fit.params["unseen"].reason
    assert report.params["T"].interval == report.parameters["T"].ci95
    assert fit.summary() == str(fit) and report.summary() == str(report)
    for result in (report, fit):
        data = json.loads(json.dumps(result.to_dict(), allow_nan=False))
        again = type(result).from_dict(data)
        assert again.to_dict() == data
    again = hi.fit(LAG, RECORD, BOUNDS, report=hi.IdentifiabilityReport.from_dict(report.to_dict()))
    assert dict(again.values) == pytest.approx(dict(fit.values), rel=1e-6)


def test_a_diagnosis_gives_the_intervals_of_the_parameters_beside_what_it_put_in() -> None:
    """A late plant: the interval of T holds the plant's, which that of a fit without the delay misses."""
    late = hi.apply_effects(LAG, [{"effect": "delay", "at": "y", "parameters": {"T": 0.3}}])
    random = np.random.default_rng(1)

    def record(name: str, after: float) -> hi.Experiment:
        step = {"u": hi.step(0.0, after, at=STEP)}
        y = hi.simulate(late, TIME, {"T": T, "k": K}, inputs=step)["y"] + NOISE * random.standard_normal(TIME.size)
        return hi.Experiment(TIME, name, inputs=step, outputs={"y": y}, noise={"y": NOISE})

    bounds = {n: BOUNDS[n] for n in ("T", "k")}
    found = hi.diagnose(LAG, [record("up", 1.0), record("down", -0.5)], bounds, effects=["delay"])
    low, high = found.params["T"].interval
    assert low < T < high and found.params["T"].value == found.parameters_after["T"] and found.params["T"].unit == "s"
    assert high - low < 0.1 * T and not low < found.parameters_refitted["T"] < high
    nothing = hi.diagnose(LAG, RECORD, bounds, effects=["delay"])
    assert nothing.params["T"].value == nothing.parameters_after["T"] and nothing.params["T"].interval is None


def test_tables_and_linear_results_come_back_from_their_json_too() -> None:
    run = hi.simulate(LAG, RECORD, sensitivities=["T", "k"])
    linear = hi.linearize(LAG, inputs="u", outputs="y")
    one = hi.sweep(LAG, RECORD, {"T": [0.5, 1.0, 0.0]}, want=["rmse", "poles"])
    two = hi.sweep(LAG, None, [log_grid("T", 0.5, 2.0, 3), latin_hypercube({"k": (1.0, 2.0), "unseen": (0.5, 2.0)}, 4)])
    shown = hi.sweep(LAG, parameters={"k": [1.0, 2.0]}, want="bode")
    assert one.failed and two.points.shape == (3, 4)
    for result in (run, run.trajectory, linear.bode(), one, two, shown):
        data = json.loads(json.dumps(plain(result), allow_nan=False))
        assert plain(type(result).from_dict(data)) == data
    again = hi.SweepResult.from_dict(one.to_dict() | {"model": "lag"})
    assert str(again) == str(one) and again.best("y", "step") == one.best("y", "step")
    assert hi.SweepResult.from_dict(two.to_dict()).points.shape == (3, 4)
    assert hi.LinearModel.from_dict(linear.to_dict()).poles() == pytest.approx(linear.poles())
    with pytest.raises(InputError, match="not the JSON of"):
        hi.Simulation.from_dict({"time": [0.0], "signals": {"y": ["a"]}, "units": {}})


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (lambda: hi.sweep(LAG, {"T": [0.5, 1.0]}, RECORD), lambda: hi.sweep(LAG, RECORD, {"T": [0.5, 1.0]}), "sweep"),
        (lambda: hi.sweep(LAG, {"T": [0.5]}, data=RECORD), lambda: hi.sweep(LAG, RECORD, {"T": [0.5]}), "sweep"),
        (
            lambda: hi.simulate(LAG, RECORD, parameters={"T": 0.7}).trajectory,
            lambda: hi.simulate(LAG, RECORD, {"T": 0.7}).trajectory,
            r"simulate\(values=...\)",
        ),
        (
            lambda: hi.linearize(LAG, inputs="u", parameters={"T": 0.7}),
            lambda: hi.linearize(LAG, inputs="u", values={"T": 0.7}),
            r"linearize\(values=...\)",
        ),
        (lambda: hi.h2_norm, lambda: hi.linear.h2_norm, r"hvdc_ident\.linear\.h2_norm"),
        (lambda: hi.morris, lambda: hi.sensitivity.morris, r"hvdc_ident\.sensitivity\.morris"),
    ],
)
def test_a_form_of_the_last_release_does_the_same_and_names_the_new_one(old: Any, new: Any, message: str) -> None:
    with pytest.warns(DeprecationWarning, match=message) as told:
        before = old()
    assert all(w.filename == __file__ for w in told), "the warning points at the caller's line"
    now = new()
    assert before is now or before.to_dict() == now.to_dict()


def test_every_name_of_the_last_release_is_somewhere() -> None:
    for name in " ".join(MOVED.values()).split():
        with pytest.warns(DeprecationWarning):
            assert getattr(hi, name) is not None


def test_a_problem_is_fitted_as_it_stands() -> None:
    from hvdc_ident.fit import FitParameter
    from hvdc_ident.simulate import ModelSimulator

    problem = Problem(
        ModelSimulator(LAG), (RECORD,), (FitParameter("T", 1.0, 0.1, 10.0), FitParameter("k", 2.0, 0.0, 10.0))
    )
    assert hi.fit(problem, starts=1).values["T"] == pytest.approx(T, rel=0.02)


def test_signals_are_what_they_say() -> None:
    ramp = hi.ramp(1.0, 2.0, start=1.0, end=3.0)
    assert ramp([0.0, 2.0, 5.0]).tolist() == [1.0, 1.5, 2.0]
    f, n = np.array([2.0, 5.0, 7.0]), np.arange(1, 4)
    u = hi.multisine(0.5, 0.1, f, start=0.5, end=1.5)
    t = np.linspace(0.51, 1.49, 500)
    wave = np.sin(2 * np.pi * f[:, None] * (t - 0.5) - np.pi * (n * (n - 1))[:, None] / 3)
    begin = np.sin(-np.pi * n * (n - 1) / 3).sum()
    assert np.abs(u(t) - (0.5 + 0.1 * (wave.sum(axis=0) - begin))).max() < 3 * 0.1 * 0.0031
    assert u(0.0) == u(2.0) == 0.5


WRONG: list[tuple[str, Any]] = [
    ("no model", lambda: hi.fit(3, RECORD, "T")),
    ("no parameter 'TT'.*'T'", lambda: hi.fit(LAG, RECORD, "TT")),
    ("fit needs data.*hi.Experiment", lambda: hi.fit(LAG)),
    ("fit needs parameters; expected some of T, k", lambda: hi.fit(LAG, RECORD)),
    ("wrong order", lambda: hi.fit(LAG, RECORD, {"T": (10.0, 1.0)})),
    (r"no bounds; expected \(min, max\)", lambda: hi.fit(LAG, RECORD, {"T": "a"})),
    ("is an input, not a parameter", lambda: hi.fit(LAG, RECORD, "u")),
    (r'no parameter; expected names like "k".*got 3', lambda: hi.fit(LAG, RECORD, 3)),
    (r"no parameter; expected .*got \('T',\)", lambda: hi.fit(LAG, RECORD, [("T",)])),
    ("no bounds", lambda: hi.fit(LAG, RECORD, {"T": [0.1, 1.0, 10.0]})),
    ("parameter 'T' stands there twice", lambda: hi.fit(LAG, RECORD, ["T", ("T", 0.1, 10.0)])),
    ("no data; expected", lambda: hi.fit(LAG, TIME, "T")),
    ("unknown key 'start'.*'starts'", lambda: hi.fit(LAG, RECORD, "T", start=3)),
    ("no optimiser 'lm'", lambda: hi.fit(LAG, RECORD, "T", optimiser="lm")),
    ("no executor", lambda: hi.fit(LAG, RECORD, "T", executor="x")),
    ("no effect 'lagg'.*'lag'", lambda: hi.diagnose(LAG, RECORD, "T", effects="lagg")),
    ("over what time", lambda: hi.simulate(LAG)),
    ("inputs are given by name", lambda: hi.simulate(LAG, TIME, inputs="u")),
    ("no parameter or input 'w'", lambda: hi.simulate(LAG, TIME, {"w": 1.0})),
    ("no output or signal 'z'", lambda: hi.simulate(LAG, TIME, outputs="z")),
    ("no input 'uu'.*'u'", lambda: hi.linearize(LAG, inputs="uu")),
    ("no output 'x'", lambda: hi.fit(LAG, hi.Experiment(TIME, inputs={"u": U}, outputs={"x": Y}), "T")),
    ("begins with its times.*name='x'", lambda: hi.Experiment("x", TIME)),
    ("not as many as the times", lambda: hi.Experiment(TIME, outputs={"y": Y[1:]})),
    ("noise is not given by output", lambda: hi.Experiment(TIME, noise=0.1)),
    ("no parameter to sweep", lambda: hi.sweep(LAG, data=RECORD)),
]


@pytest.mark.parametrize(("message", "call"), WRONG, ids=[m[:25] for m, _ in WRONG])
def test_a_wrong_call_says_what_to_do(message: str, call: Any) -> None:
    with pytest.raises(InputError, match=message):
        call()


def test_an_experiment_is_copied_with_all_it_has() -> None:
    full = RECORD.with_(window=(0.0, 4.0), role="holdout", nuisance=("time-shift",), instrument={"y": {"delay": 0.1}})
    copy = dataclasses.replace(full)
    for f in dataclasses.fields(full):
        ours, theirs = getattr(copy, f.name), getattr(full, f.name)
        assert ours is theirs or np.all(ours == theirs)


def test_a_fit_with_nothing_to_estimate_says_what_to_try_in_python() -> None:
    still = hi.Experiment(
        TIME, inputs={"u": 0.0}, outputs={"y": NOISE * np.random.default_rng(2).standard_normal(TIME.size)}
    )
    message = str(hi.fit(LAG, still, {"k": (0.1, 10.0)}))
    assert 'force=["NAME"]' in message and "`hi.identify(...)`" in message and "--" not in message
