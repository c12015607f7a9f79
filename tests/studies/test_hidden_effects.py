"""The study of hidden effects: its simulator agrees with the package without knowing it, its cases are what they claim."""

from __future__ import annotations

import ast
import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from hvdc_ident import simulate as package
from hvdc_ident.data import InputSignal, Trajectory, experiment
from hvdc_ident.discrepancy import DiagnosisOptions
from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.hypothesis import Refit, judged, refit_job, refitted
from hvdc_ident.discrepancy.nominal import nominal
from hvdc_ident.discrepancy.options import SearchContext
from hvdc_ident.effects import EffectUse, Probe, apply_effects, effects
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.simulate import ModelSimulator
from tests.discrepancy.refits import expanded
from tests.studies.study_module import STUDIES, load

sys.path.insert(0, str(STUDIES / "hidden_effects"))

from hidden import campaigns, cases, judging, noise, sizes
from hidden.diagnosing import diagnosed, experiments_of, free_of, model_of
from hidden.kinds import OF_STATES
from hidden.operators import CATALOGUE, OUTSIDE
from hidden.plants import DRIVE, STATION
from hidden.reporting import report
from hidden.simulator import STEP, Hidden, Run, Signal, simulate

pytestmark = pytest.mark.nightly

STUDY = load("hidden_effects")
ROWS = 125
TIME = np.arange(ROWS) * 4e-3
MOVES = {"Pref": ((0.0402, 0.5), (0.0402, 0.65), (0.3, 0.65), (0.4, 0.4))}
# effect: slot, from, parameters, and how far the two may be apart, in shares of what the effect does.
TOGETHER = {
    "backlash": ("Pm", "", {"width": 0.02}, 0.05),
    "conductance": ("P", "Vdc", {"g": 0.05}, 1e-4),
    "coupling": ("Pref", "Vdc", {"k": -1.0}, 1e-4),
    "deadband": ("err", "", {"width": 0.01}, 1e-3),
    "delay": ("Pm", "", {"T": 0.006}, 1e-3),
    "droop": ("Pref", "Vdc", {"k": 1.0}, 1e-4),
    "gain": ("V", "", {"k": 1.1}, 1e-4),
    "inductance": ("Iline", "", {"L": 0.002, "R": 0.1}, 1e-4),
    "lag": ("Pm", "", {"T": 0.01}, 1e-4),
    "lead-lag": ("V", "", {"T1": 0.03, "T2": 0.01}, 1e-4),
    "limit": ("current", "", {"level": 0.62}, 1e-4),
    "loss": ("P", "I", {"a": 0.01, "b": 0.02, "c": 0.03}, 1e-4),
    "offset": ("Pm", "", {"c": 0.02}, 1e-4),
    "rate-limit": ("Pref", "", {"rate": 1.5}, 0.02),  # the package's follows 0.2 ms behind
    "sample-hold": ("Pm", "", {"Ts": 0.0124, "compute": 0.0042}, 1e-4),
    "saturation": ("current", "", {"level": 1.5}, 1e-4),
    "second-order": ("order", "", {"wn": 150.0, "zeta": 0.4}, 1e-4),
    "inner-loop": ("current", "", {"wn": 120.0, "zeta": 0.5}, 1e-4),
    "window-mean": ("Pm", "", {"T": 0.02}, 1e-3),
}


def test_what_hides_the_effects_does_not_know_the_package():
    for path in sorted((STUDIES / "hidden_effects" / "hidden").glob("*.py")):
        imported = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                imported.add((node.module or "").split(".")[0])
            elif isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
        assert ("hvdc_ident" in imported) == (path.name == "diagnosing.py"), path.name


def test_every_effect_of_the_catalogue_can_be_hidden():
    """By one simulator or the other: what acts on a state's equation by the second. A dead band with a step is hidden by neither."""
    tried = {n for n, e in effects().items() if e.tried_by_default and not e.needs_expression}
    assert set(CATALOGUE) | set(OF_STATES) == tried - {"deadband-step"}
    # A loop that rests on an edge, and a start that is no rest: there the two start otherwise, for reasons.
    assert set(CATALOGUE) - set(TOGETHER) == {"quantisation", "disturbance"}


@pytest.mark.parametrize("name", sorted(TOGETHER))
def test_both_simulators_agree(name):
    at, source, values, share = TOGETHER[name]
    run = [Run({n: Signal(points) for n, points in MOVES.items()})]
    plain, mine = (simulate(STATION, run, h, rows=ROWS)[:, 0] for h in ((), [Hidden(name, at, values, source)]))
    use = EffectUse(name, (at,), FrozenMap(values), source=source)
    inputs = {n: InputSignal.corners(points) for n, points in MOVES.items()}
    model = apply_effects(model_of("station"), [use])
    theirs = package(model, experiment("e", TIME, inputs), outputs=STATION.outputs).trajectory.values
    effect = np.abs(mine - plain).max(axis=0)
    assert effect.max() > 2e-3
    assert (np.abs(mine - theirs).max(axis=0) < share * effect + 2e-7).all()


AT_REST = TOGETHER | {
    "cubic": ("Pm", "", {"k": 0.2}, 0.0),
    "notch": ("Pm", "", {"k": 0.3, "wn": 40.0}, 0.0),
    "product": ("Pm", "Vdc", {"k": 2.0}, 0.0),
    "relay": ("Pm", "Vdc", {"k": 0.05, "centre": 0.98, "width": 0.1}, 0.0),
}


def test_every_effect_outside_the_catalogue_is_asked_whether_it_begins_at_rest():
    assert set(OUTSIDE) - set(AT_REST) == {"drift"}  # a gain that changes with time has no rest


@pytest.mark.parametrize("name", sorted(AT_REST))
def test_what_is_hidden_begins_at_rest(name):
    at, source, values, _ = AT_REST[name]
    run = simulate(STATION, [Run()], [Hidden(name, at, values, source)], rows=50)[:, 0]
    np.testing.assert_allclose(run, np.broadcast_to(run[0], run.shape), rtol=0, atol=1e-9)


def test_a_row_on_a_sampling_instant_is_read_before_it_by_both():
    moves = {"wref": ((0.0402, 1.0), (0.0402, 1.3))}
    values = {"Ts": 9 * STEP * (1 + sizes.LATE), "compute": 0.0}  # every ninth row meets every twentieth sample
    mine = simulate(
        DRIVE, [Run({n: Signal(p) for n, p in moves.items()})], [Hidden("sample-hold", "wm", values)], rows=ROWS
    )
    model = apply_effects(model_of("drive"), [EffectUse("sample-hold", ("wm",), FrozenMap(values))])
    inputs = {n: InputSignal.corners(p) for n, p in moves.items()}
    theirs = package(model, experiment("e", TIME, inputs), outputs=DRIVE.outputs).trajectory.values
    after = {"Ts": 9 * STEP * (1 - sizes.LATE), "compute": 0.0}
    model = apply_effects(model_of("drive"), [EffectUse("sample-hold", ("wm",), FrozenMap(after))])
    other = package(model, experiment("e", TIME, inputs), outputs=DRIVE.outputs).trajectory.values
    np.testing.assert_allclose(mine[:, 0], theirs, atol=2e-6)
    met = np.flatnonzero(np.abs(other - theirs).max(axis=1) > 1e-4)
    assert met.size > 3 and (met % 9 == 0).all(), "which comes first is seen, at those rows alone"


@pytest.mark.parametrize("plant", [STATION, DRIVE])
def test_both_simulators_agree_on_the_plants(plant):
    moved = {n: ((0.0402, v), (0.0402, v + plant.kicks[n]), (0.3, v), (0.4, v)) for n, v in plant.inputs.items()}
    values = {n: 1.1 * plant.parameters[n] for n in plant.fitted}
    mine = simulate(plant, [Run({n: Signal(p) for n, p in moved.items()}, values)], rows=ROWS)[:, 0]
    case = experiment("e", TIME, {n: InputSignal.corners(p) for n, p in moved.items()})
    theirs = package(model_of(plant.name), case, values, outputs=plant.outputs).trajectory.values
    np.testing.assert_allclose(mine, theirs, atol=1e-6)
    assert {n: p.value for n, p in model_of(plant.name).parameters.items()} == plant.parameters
    slots = {s for s in model_of(plant.name).insertion_points if not s.startswith("outputs.")}
    assert slots == set(plant.slots)


@pytest.mark.parametrize("excitation", campaigns.EXCITATIONS)
@pytest.mark.parametrize("plant", [STATION, DRIVE])
def test_a_plant_answers_the_same_at_half_the_step(plant, excitation):
    # To the method's fourth order: a jump that one stage of a step sees too early shows at 1e-4.
    runs = campaigns.campaign(plant, excitation, 0)
    whole, half = (simulate(plant, runs, step=h) for h in (STEP, STEP / 2))
    assert (np.abs(whole - half).max(axis=0) < 1e-8 * np.ptp(whole, axis=0)).all()


@pytest.mark.parametrize("plant, at, step", [(STATION, "Pm", 0.03), (DRIVE, "torque", 0.0236), (DRIVE, "wm", 0.03)])
def test_a_quantiser_in_a_loop_comes_to_the_same_sliding_rest(plant, at, step):
    """It lies on an edge, and the loop drives it there from both sides."""
    mine = simulate(plant, [Run()], [Hidden("quantisation", at, {"step": step})], rows=50)[:, 0].mean(axis=0)
    model = apply_effects(model_of(plant.name), [EffectUse("quantisation", (at,), FrozenMap({"step": step}))])
    watched = plant.outputs[:2]
    theirs = package(model, experiment("e", TIME[:50]), outputs=watched).trajectory.values
    assert np.ptp(theirs, axis=0).max() < 1e-6, "it is a rest"
    np.testing.assert_allclose(mine[:2], theirs.mean(axis=0), atol=1e-3)
    if at == "Pm":
        assert theirs[0, 0] == pytest.approx(0.495, abs=1e-3), "0.5 lies between two levels; P slides at the edge below"


@pytest.mark.parametrize("lead", [0.0, 1.0])
@pytest.mark.parametrize("plant", [STATION, DRIVE])
def test_a_disturbance_is_seen_the_same_however_the_record_begins(plant, lead):
    """It begins with the record, at rest; or it has been there for a second, and the plant repeats itself."""
    at, kick = ("E", "Pref") if plant is STATION else ("load", "wref")
    values = {"amplitude": 0.03, "frequency": 7.0, "phase": 2.0}
    moves = {kick: ((0.0402, plant.inputs[kick]), (0.0402, 1.1 * plant.inputs[kick]))}
    runs = [Run({n: Signal(p) for n, p in moves.items()})]
    quiet = simulate(plant, runs, rows=ROWS)[:, 0]
    record = simulate(plant, runs, [Hidden("disturbance", at, values)], rows=ROWS, lead=lead)[:, 0]
    sigma = 0.02 * np.ptp(quiet, axis=0)
    model = apply_effects(model_of(plant.name), [EffectUse("disturbance", (at,), FrozenMap(values))])
    measured = Trajectory(TIME, record, plant.outputs)
    noise = dict(zip(plant.outputs, sigma.tolist(), strict=True))
    inputs = {n: InputSignal.corners(p) for n, p in moves.items()}
    case = experiment("e", TIME, inputs, measured=measured, noise=noise)
    gain = plant.fitted[0]
    problem = Problem(ModelSimulator(model), (case,), (FitParameter(gain, plant.parameters[gain], 0.1, 10.0),))
    settled, free_start = (replace(problem, free_initial_states=u).cost(problem.start) for u in (False, True))
    assert free_start < 0.05, "no noise: nothing is left but what is not linear in the start"
    assert settled > 100 * free_start


def test_designs_are_seeded_and_balanced():
    for part, count in cases.PARTS.items():
        assert cases.designs(part, 3) == cases.designs(part, 3) != cases.designs(part, 4)
        assert len(cases.designs(part, 3)) == count
    single = cases.designs("single", 3)
    for name in CATALOGUE:
        of = [d for d in single if d.effects == (name,)]
        assert len(of) == 17
        for key in ("size", "noise", "excitation"):
            levels = [getattr(d, key) for d in of]
            assert max(map(levels.count, set(levels))) - min(map(levels.count, set(levels))) <= 1
    clean = cases.designs("clean", 3)
    assert len({(d.effects, d.plant, d.size, d.noise) for d in cases.factorial(3)}) == (2 * 21 - 1) * 4 * 3
    assert {d.noise for d in clean} == {*noise.KINDS, *noise.WRONG, "unreached"}


LARGE = cases.Design("single", 0, "station", ("lag",), 30.0, "white", "small", False, True, 0.01, 0)


@pytest.fixture(scope="module")
def large():
    case = cases.made(LARGE, 3)
    assert case is not None
    return case


def test_a_case_is_as_large_as_it_should_be_and_made_anew_the_same(large):
    assert large.units == pytest.approx(30.0, rel=0.05)
    again = cases.made(LARGE, 3)
    assert again is not None
    np.testing.assert_array_equal(again.records, large.records)
    misfit = (large.records - large.clean) / large.sigma
    assert misfit.std() == pytest.approx(1.0, abs=0.05)
    given = experiments_of(large)
    assert [e.role for e in given] == ["fit", "fit", "holdout"]
    assert dict(given[0].noise) == pytest.approx(dict(zip(STATION.outputs, large.sigma, strict=True)))
    assert all(f.min < STATION.parameters[f.name] < f.max for f in free_of(large))


def test_a_unit_is_what_a_refit_leaves():
    base = sizes.nominal("drive", "small", 1)
    sigma = 0.01 * np.ptp(base.outputs[:, :2], axis=(0, 1))
    everything = (0, 1, 2)
    small = base.outputs[:, :2] + 0.01 * base.slopes[:, :, 0]
    assert sizes.units(base, small[:, :, None], sigma, "white", everything)[0] < 1e-9, (
        "a gain's own answer is no effect"
    )
    # Nor is it where the gains move far: a refit makes it good, a straight line from the true gains does not.
    values = {"KP": 1.7 * DRIVE.parameters["KP"], "J": 0.6 * DRIVE.parameters["J"]}
    moved = simulate(DRIVE, [Run(r.inputs, values) for r in base.runs[:2]])
    q = np.linalg.qr(base.slopes.transpose(0, 1, 3, 2).reshape(-1, 3) / np.tile(sigma, 600)[:, None])[0]
    r = ((moved - base.outputs[:, :2]) / sigma).ravel()
    assert np.linalg.norm(r - q @ (q.T @ r)) > 5 * sizes.UNIT
    assert sizes.units(base, moved[:, :, None], sigma, "white", everything)[0] < 0.05
    # Beyond the bounds a fit stops there: what it leaves is what the edge leaves.
    outside = simulate(DRIVE, [Run(r.inputs, {"KP": 8 * DRIVE.parameters["KP"]}) for r in base.runs[:2]])
    assert sizes.units(base, outside[:, :, None], sigma, "white", everything)[0] > 1.0
    odd = base.outputs[:, :2].copy()
    odd[40, 0, 0] += 5 * sigma[0]  # one row before the event: no gain can follow
    assert sizes.units(base, odd[:, :, None], sigma, "white", everything)[0] == pytest.approx(5 / sizes.UNIT, rel=1e-3)


def test_a_row_on_a_jump_has_no_size():
    base = sizes.nominal("drive", "small", 1)
    sigma = 0.01 * np.ptp(base.outputs[:, :2], axis=(0, 1))
    (row,) = np.flatnonzero(sizes.on_jumps(base.runs[:1]))
    assert row == round(campaigns.EVENT / campaigns.INTERVAL)
    assert not sizes.on_jumps(sizes.nominal("drive", "rich", 1).runs[1:2]).any(), "a multisine has corners and no jump"
    odd = base.outputs[:, :2].copy()
    odd[row, 0, 0] += 50 * sigma[0]
    for kind in noise.KINDS:
        assert sizes.units(base, odd[:, :, None], sigma, kind, (0, 1, 2))[0] < 1e-9


def test_correlated_noise_is_white_across_a_row_left_out():
    e = noise.added(np.random.default_rng(0), np.zeros((60_000, 1)), np.array([0.5]), "ar", 0)[:, :, None]
    gone = np.arange(60_000)[:, None] % 3 == 1
    white = noise.whitened(e, np.array([0.5]), "ar", gone)[:, :, 0]
    assert not white[gone].any()
    kept = white[~gone]
    assert kept.std() == pytest.approx(1.0, abs=0.01)
    assert abs(np.corrcoef(kept[1:], kept[:-1])[0, 1]) < 0.01


@pytest.mark.parametrize("kind", [*noise.KINDS, *noise.WRONG])
def test_noise_is_what_it_says(kind):
    rng = np.random.default_rng(0)
    smooth = np.linspace(0.0, 300.0, 60_000)[:, None]
    e = noise.added(rng, smooth, np.array([0.5]), kind, 30_000)[:, 0] - smooth[:, 0]
    loud = {"louder-later": np.sqrt((1 + 1.5**2) / 2), "quantised": np.sqrt(1 + 12 / 16)}.get(kind, 1.0)
    assert e.std() == pytest.approx(0.5 * loud, rel=0.1)
    memory = np.corrcoef(e[1:], e[:-1])[0, 1]
    assert memory == pytest.approx(noise.RHO if kind in ("ar", "told-white") else 0.0, abs=0.05)
    if kind in noise.KINDS:
        white = noise.whitened(e[:, None], np.array([0.5]), kind)[:, 0]
        assert white.std() == pytest.approx(1.0, abs=0.05)
        assert np.corrcoef(white[1:], white[:-1])[0, 1] == pytest.approx(0.0, abs=0.05)


def told(verdict="named", found=(), ambiguity=(), plant="station", truth=("lag", "Pm", ""), **more):
    line = {"part": "single", "plant": plant, "verdict": verdict, "size": 10.0, "effects": [truth[0]]}
    named = [{"effect": e, "at": list(at), "from": s} for e, at, s in found]
    sets = [[{"effect": e, "at": list(at), "from": s} for e, at, s in g] for g in ambiguity]
    hidden = [{"effect": truth[0], "at": truth[1], "source": truth[2], "parameters": {}}]
    return line | {"found": named, "ambiguity": sets, "truth": hidden} | more


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (told(found=[("lag", ["Pm"], "")]), "right"),
        (told(found=[("lag", ["err"], "")]), "place"),
        (told(found=[("lag", ["P", "Pm"], "")]), "place"),
        (told(found=[("delay", ["Pm"], "")]), "wrong"),
        (told(found=[("delay", ["Pm"], "")], ambiguity=[[("delay", ["Pm"], ""), ("lag", ["Pm"], "")]]), "covered"),
        (told("ambiguous", ambiguity=[[("delay", ["Pm"], ""), ("lag", ["Pm"], "")]]), "covered"),
        (told("ambiguous", ambiguity=[[("delay", ["Pm"], ""), ("gain", ["Pm"], "")]]), "ambiguous"),
        (told(found=[("lag", ["Pm"], ""), ("gain", ["V"], "")]), "wrong"),
        (told("no-evidence"), "abstained"),
        (told("unnameable"), "abstained"),
        (told(failed="no steady state"), "failed"),
        (told(found=[("lag", ["Iline"], "")], truth=("inductance", "Iline", "")), "right"),
        (told(found=[("offset", ["err"], "")], truth=("offset", "Pm", "")), "right"),
        (told(found=[("gain", ["err"], "")], truth=("gain", "Pm", "")), "place"),
        (told(found=[("coupling", ["V"], "Vdc")], truth=("droop", "E", "Vdc")), "right"),
        (told(found=[("coupling", ["V"], "I")], truth=("droop", "E", "Vdc")), "place"),
    ],
)
def test_outcomes(line, expected):
    assert judging.outcome(line) == expected


def test_shares_have_the_limits_of_clopper_and_pearson():
    assert judging.limit_above(0, 300) == pytest.approx(1 - 0.05 ** (1 / 300))  # closed form for none
    assert judging.limit_above(5, 5) == 1.0
    assert judging.limit_above(3, 780) == pytest.approx(0.00991, abs=2e-5)  # binomial tail of 3 in 780 is 5 %


def test_results_go_on_after_a_kill(tmp_path):
    path = tmp_path / "cases.jsonl"
    path.write_text(json.dumps({"case": "single-001", "x": 1}) + "\n" + '{"case": "single-0')
    assert set(STUDY.lines(path)) == {"single-001"}
    left = list(STUDY.pending(["single", "clean"], 3, 4, {"single-001"}))
    assert [d.name for d in left] == [
        "single-000", "clean-000", "clean-001", "single-002", "clean-002", "single-003", "clean-003",
    ]  # fmt: skip
    assert all(replace(d, number=0).name.endswith("000") for d in left)


def test_the_sparse_law_finds_a_law_that_is_there():
    pytest.importorskip("pysindy", reason="the baseline needs the extra `bench`")
    from hidden.sindy import predicted

    t = np.arange(300) * 4e-3
    drivers = [np.sin(f * t)[:, None] for f in (9.0, 17.0, 5.0)]
    residuals = []
    for d in drivers:  # r' = 20 (0.1 d - r), by its own small steps
        r = np.zeros(t.size)
        for k in range(1, t.size):
            fine = np.interp(np.linspace(t[k - 1], t[k], 41), t, d[:, 0])
            r[k] = r[k - 1]
            for v in fine[:-1]:
                r[k] += 1e-4 * 20 * (0.1 * v - r[k])
        residuals.append(r[:, None])
    found, terms = predicted(residuals, drivers, t)
    assert found is not None and terms <= 3
    assert np.abs(found - residuals[-1]).max() < 0.05 * np.abs(residuals[-1]).max()


@pytest.mark.nightly
def test_a_large_effect_is_found_and_a_clean_record_is_left_alone(large):
    line = diagnosed(large)
    assert judging.outcome(line) in ("right", "covered"), line
    held = line["held_out"]
    assert held["augmented"] < 1.1 * held["oracle"] < 0.8 * held["refitted"]
    clean = cases.made(replace(LARGE, part="clean", effects=(), size=0.0), 3)
    assert clean is not None
    quiet = diagnosed(clean)
    assert quiet["verdict"] not in ("named", "ambiguous") and quiet["found"] == []
    told = judging.summary([line, quiet])
    assert told["clean"]["false_names"] == 0 and told["large"]["right_or_covered"] == 1.0
    assert json.loads(json.dumps(told)) == told and "| lag |" in report(told)


def refitted_plain(case):
    """The station without any effect, refitted to a case's records."""
    model = model_of("station")
    start, _ = nominal(
        ModelSimulator(model), experiments_of(case), free_of(case), {}, None, starts=1, seed=0, executor=None
    )
    return judged(Refit(model, (), start.problem, start.noise, start.theta))


def holding(case, hidden, excitation, variant, level, kind="white"):
    """The station's case with another effect hidden, its campaign and its noise, which nothing tells."""
    runs = sizes.nominal("station", excitation, variant).runs
    clean = simulate(STATION, runs, [hidden])
    sigma = level * np.ptp(clean, axis=(0, 1))
    random = np.random.default_rng(0)
    records = np.stack([noise.added(random, clean[:, k], sigma, kind, 50) for k in range(3)], axis=1)
    return replace(case, hidden=(hidden,), runs=runs, records=records, clean=clean, sigma=sigma, told=None)


def test_levels_are_met_that_a_loop_slides_between(large):
    """A line current in steps of 0.064: the dc voltage rests on edges, and the search begins from fewer, wider levels."""
    case = holding(large, Hidden("quantisation", "Iline", {"step": 0.0638}), "rich", 0, 1e-3)
    before = refitted_plain(case)
    probe = Probe("quantisation", FrozenMap({"step": 0.08}), FrozenMap({"step": (1e-3, 0.5)}))
    begun = refit_job(before, CandidateEffect("quantisation", ("Iline",), (probe,)), 0, 1.0, before.theta)
    search = SearchContext(("quantisation",), ("Iline",), FrozenMap(), DiagnosisOptions(), 0)
    found = min((t.refit for t in expanded(search, before).trials), key=lambda r: r.chi2)
    assert found.sizes(found.placed[-1])["step"] == pytest.approx(0.0638, rel=1e-3)
    assert found.chi2 < 0.05 * refitted(begun).chi2


def test_a_bend_is_met_from_one_of_the_sizes_where_others_lead_nowhere(large):
    """A rate limit at an integrator in its loop: slower it bends all, faster it does nothing, and no slope leads back."""
    case = holding(large, Hidden("rate-limit", "xi", {"rate": 1.4}), "small", 3, 2e-3, "ar")
    before, options = refitted_plain(case), DiagnosisOptions()
    search = SearchContext(("rate-limit", "lag"), None, FrozenMap(), options, 0)
    found = expanded(search, before)
    best = found.trials[0].refit
    assert (best.placed[0].candidate.effect, best.placed[0].candidate.at) == ("rate-limit", ("xi",))
    assert best.sizes(best.placed[0])["rate"] == pytest.approx(1.4, rel=0.01)


def test_the_sensitivity_study_sets_a_number_wherever_it_is_used_and_sets_it_back() -> None:
    from hvdc_ident.discrepancy import conclusion, options, remainder

    study = load("hidden_effects", "sensitivity")
    by_label = {n.label: n for n in study.numbers()}
    assert {"options.TOLERANCE", "score.TIED", "options.set_bic"} <= set(by_label)
    with study.changed(by_label["options.TOLERANCE"], 0.3) as changed:
        assert options.TOLERANCE == remainder.TOLERANCE == conclusion.TOLERANCE == 0.3 and changed == DiagnosisOptions()
    assert options.TOLERANCE == remainder.TOLERANCE == conclusion.TOLERANCE == by_label["options.TOLERANCE"].value
    with study.changed(by_label["options.set_bic"], 12.0) as changed:
        assert changed == DiagnosisOptions(set_bic=12.0)
    share, count = study.Number("m", "CERTAIN", 0.95), study.Number("m", "FIELD", 5)
    assert share.times(2.0) == pytest.approx(0.9) and share.times(0.5) == pytest.approx(0.975)
    assert (count.times(0.5), count.times(2.0)) == (2, 10)


def test_the_sensitivity_table_lists_the_sensitive_numbers_first() -> None:
    study = load("hidden_effects", "sensitivity")
    base = {"number": "", "factor": 1.0, "case": "1 a", "verdict": "named", "found": ["lag"], "seconds": 2.0}
    runs = [base]
    for number in ("options.BEAM", "options.TOLERANCE"):
        runs += [base | {"number": number, "factor": f, "seconds": 3.0} for f in study.FACTORS]
    runs[-1] |= {"verdict": "ambiguous", "found": ["gain", "lag"]}
    rows = study.table(runs).splitlines()
    assert rows[2] == "| options.TOLERANCE | 0.01 | same in 1 | 1 a: named (lag) becomes ambiguous (gain, lag) | 1.5 |"
    assert rows[3] == "| options.BEAM | 2 | same in 1 | same in 1 | 1.5 |"
