"""The noise of records: known processes come back, and what is no noise is left out."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from hvdc_ident import Experiment, InputSignal, Trajectory
from hvdc_ident.data import Array
from hvdc_ident.discrepancy import diagnose
from hvdc_ident.fit import FitParameter
from hvdc_ident.fit.noise import ESTIMATED, MOVING, SCATTER, OutputNoise, freedom_of, noise_of, without_common
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import parse_card
from hvdc_ident.study.recordings import with_noise
from tests.discrepancy.cases import SIGMA, TIME, experiments


def test_white_noise_stands_as_given() -> None:
    found = noise_of(experiments())
    assert found["w"].std == SIGMA["w"]
    assert found["w"].source == "given"


def test_coloured_noise_is_told_from_before_the_event() -> None:
    rho = [
        n.model[0]
        for seed in range(6)
        for n in noise_of(experiments(noise="ar", seed=seed)).values()
        if len(n.model) == 1
    ]
    assert np.mean(rho) == pytest.approx(0.9, abs=0.06)


def test_noise_that_is_larger_than_given_is_seen() -> None:
    louder = [e.with_(noise={n: s / 3 for n, s in SIGMA.items()}) for e in experiments()]
    found = noise_of(louder)["torque"]
    assert found.std == pytest.approx(SIGMA["torque"], rel=0.2)
    assert (found.source, found.contradicted) == (ESTIMATED, "louder")


def test_noise_below_a_quantiser_is_read_from_its_flicker() -> None:
    found = noise_of(experiments(noise="quantised"))["w"]
    step = SIGMA["w"] * np.sqrt(12.0)
    assert found.step == pytest.approx(step, rel=1e-6)
    assert found.std == pytest.approx(step * np.sqrt(1 / 12 + 0.25**2), rel=0.2)


def test_a_sine_of_common_phase_is_no_noise_and_noise_is_no_sine() -> None:
    random = np.random.default_rng(3)
    times = [TIME[:60], TIME[:60], TIME[:75]]
    noise = [random.standard_normal(t.size) for t in times]
    tones = [3.0 * np.sin(2 * np.pi * 17.0 * t + 0.4) for t in times]
    left = without_common(times, [n + tone for n, tone in zip(noise, tones, strict=True)])
    assert np.std(np.concatenate(left)) == pytest.approx(1.0, abs=0.15)
    assert all(np.array_equal(a, b) for a, b in zip(without_common(times, noise), noise, strict=True))


def test_records_of_which_most_rows_are_missing_are_compared_at_the_rows_that_they_share() -> None:
    random = np.random.default_rng(4)
    rows = [np.arange(0, 120, 2), np.sort(random.choice(120, 90, replace=False))]
    tone = 3.0 * np.sin(2 * np.pi * 17.0 * TIME[:120] + 0.4)
    left = without_common([TIME[k] for k in rows], [tone[k] + random.standard_normal(k.size) for k in rows])
    assert len(left) == 1 and left[0].size == np.intersect1d(*rows).size
    assert np.std(left[0]) == pytest.approx(1.0, abs=0.25)


SWING = np.arange(800) * 0.01
"""Instants of a record that swings from its beginning, s; its input jumps at 4 s."""


def swung(seed: int, *, sigma: float, stated: float | None, damping: float = 0.3, late: float = 0.1) -> Experiment:
    """The swing of `motion`, read late, with white noise: an input moves half way."""
    y = motion(SWING - late, damping) + sigma * np.random.default_rng(seed).standard_normal(SWING.size)
    return Experiment(
        SWING, f"swing-{seed}", inputs=FrozenMap({"u": InputSignal.step(4.0, 0.0, 1.0)}), event=4.0,
        measured=Trajectory(SWING, y[:, None], ("y",), ("",)),
        noise=FrozenMap({} if stated is None else {"y": stated}),
    )  # fmt: skip


def motion(t: Array, damping: float) -> Array:
    """An oscillation that dies away, and a step answer from 4 s on."""
    return np.asarray(np.exp(-damping * t) * np.cos(2.0 * t) + 0.2 * np.where(t > 4.0, 1.0 - np.exp(4.0 - t), 0.0))


def run_of(record: Experiment, damping: float = 0.3) -> dict[str, dict[str, Array]]:
    """What the model without the lag makes of it."""
    return {record.name: {"y": motion(SWING, damping)}}


def test_what_moves_before_the_event_is_no_noise_whether_noise_is_stated_or_not() -> None:
    """The lag that the model lacks is in those rows: a misfit a hundred times the noise of 1e-3."""
    for seed in range(3):
        told = swung(seed, sigma=1e-3, stated=1e-3)
        found = noise_of([told], run_of(told))["y"]
        assert (found.std, found.source, found.contradicted, found.model) == (1e-3, "given", "", ())
        assert (found.rows, found.moving, found.std_error) == (0, 400, 0.0)
        untold = swung(seed, sigma=1e-3, stated=None)
        for runs in (run_of(untold), {}):
            found = noise_of([untold], runs)["y"]
            assert found.std == pytest.approx(1e-3, rel=0.15)
            assert found.std == pytest.approx(1e-3, rel=5.0 * found.std_error)
            assert found.source == SCATTER


def test_a_stated_noise_that_is_too_small_is_told_where_rows_before_the_event_move() -> None:
    record = swung(4, sigma=1e-3, stated=3e-4)
    found = noise_of([record], run_of(record))["y"]
    assert found.std == pytest.approx(1e-3, rel=0.15)
    assert (found.stated, found.contradicted) == (3e-4, "louder")


def test_rows_before_the_event_count_from_where_the_motion_has_died_away() -> None:
    record = swung(5, sigma=1e-3, stated=None, damping=6.0)
    found = noise_of([record], run_of(record, damping=6.0))["y"]
    assert found.std == pytest.approx(1e-3, rel=0.15)
    assert 50 <= found.rows < 400
    assert found.source == ESTIMATED


def test_a_noise_that_the_data_room_estimated_is_an_estimate_with_its_uncertainty() -> None:
    told = experiments(seed=1)
    estimated = [with_noise(e, {})[0] for e in told]
    assert all(set(e.noise) == set(SIGMA) for e in estimated)
    found = noise_of(estimated)["w"]
    assert found.stated is None and found.source == ESTIMATED
    assert found.std == pytest.approx(SIGMA["w"], rel=4.0 * found.std_error)
    assert found.std_error == pytest.approx(1.0 / np.sqrt(2.0 * found.rows), rel=0.05)
    assert noise_of(told)["w"].std_error == 0.0


def test_records_of_different_noise_keep_their_own() -> None:
    loud = [swung(k, sigma=s, stated=None, damping=60.0, late=0.0) for k, s in enumerate((1e-3, 1e-3, 5e-3))]
    runs = {name: run for e in loud for name, run in run_of(e, damping=60.0).items()}
    found = noise_of(loud, runs)["y"]
    assert {n: s for n, (s, _) in found.by_record.items()} == pytest.approx(
        {"swing-0": 1e-3, "swing-1": 1e-3, "swing-2": 5e-3}, rel=0.25
    )
    assert not noise_of(loud[:2], runs)["y"].by_record


def test_a_stated_noise_larger_than_the_records_stands_and_is_told() -> None:
    found = noise_of([e.with_(noise={n: 3.0 * s for n, s in SIGMA.items()}) for e in experiments()])["torque"]
    assert (found.std, found.source, found.contradicted) == (3.0 * SIGMA["torque"], "given", "quieter")
    assert found.shown == pytest.approx(SIGMA["torque"], rel=0.2)


def at_rest(seed: int, *, spikes: int = 0, step: float = 0.0, rows: int = 300) -> Experiment:
    """White noise of 1e-3 about a level before a step, and an answer to it; with spikes of 0.02, or rounded."""
    random = np.random.default_rng(seed)
    time = np.arange(3 * rows) * 0.01
    noise = 1e-3 * random.standard_normal(time.size)
    noise[random.choice(rows, spikes, replace=False)] += 0.02
    event = rows * 0.01
    y = 0.3 + random.uniform(0.0, 0.01) + noise + 0.2 * np.where(time > event, 1.0 - np.exp(event - time), 0.0)
    measured = Trajectory(time, (np.round(y / step) * step if step else y)[:, None], ("y",), ("",))
    inputs = FrozenMap({"u": InputSignal.step(event, 0.0, 1.0)})
    return Experiment(time, f"rest-{seed}", inputs=inputs, event=event, measured=measured)


@pytest.mark.parametrize("process", [{}, {"spikes": 6}, {"step": 3e-3}, {"rows": 12}])
def test_a_fit_and_a_diagnosis_take_the_same_noise_from_a_record(process: dict) -> None:
    for seed in range(3):
        record = at_rest(seed, **process)
        fitted, notes = with_noise(record, {})
        found = noise_of([record])["y"]
        assert found.std == pytest.approx(fitted.noise["y"], rel=0.1)
        assert notes["y"].source == "estimated"
        assert found.std_error == pytest.approx(1.0 / np.sqrt(2.0 * fitted.noise_dof["y"]), rel=0.6)


def test_noise_that_is_stated_row_by_row_is_not_contradicted_by_rows_whose_noise_is_small() -> None:
    """An instrument's noise grows with the signal: before the event it is a tenth of what it is after it."""
    for seed, told in ((1, ""), (2, "louder")):
        record = at_rest(seed)
        assert record.measured is not None and record.event is not None
        size = np.where(record.time < record.event, 0.1, 1.0)
        true = {"": 1e-3, "louder": 2e-3}[told] * size
        y = 0.3 + true * np.random.default_rng(seed).standard_normal(size.size)
        mean = float(np.sqrt(np.mean((1e-3 * size) ** 2)))
        stated = record.with_(
            measured=Trajectory(record.time, y[:, None], ("y",), ("",)),
            noise=FrozenMap({"y": mean}),
            noise_profile=FrozenMap({"y": 1e-3 * size / mean}),
        )
        found = noise_of([stated])["y"]
        assert found.contradicted == told
        assert found.std == pytest.approx(mean * (2.0 if told else 1.0), rel=0.15)


def test_an_estimate_from_correlated_rows_is_as_uncertain_as_estimates_of_it_scatter() -> None:
    """From 3 x 50 rows of a coefficient of 0.9 the standard deviation is known to some 20 %, not to the 6 % of white noise."""
    logs, errors = [], []
    for seed in range(12):
        random = np.random.default_rng(seed)
        records = []
        for k in range(3):
            e = at_rest(k, rows=50)
            y = lfilter([np.sqrt(0.19)], [1.0, -0.9], random.standard_normal(e.time.size + 200))[200:]
            measured = Trajectory(e.time, (1e-3 * y)[:, None], ("y",), ("",))
            records.append(e.with_(measured=measured))
        found = noise_of(records)["y"]
        assert found.std is not None
        logs.append(np.log(found.std / 1e-3))
        errors.append(found.std_error)
    assert np.median(errors) == pytest.approx(float(np.sqrt(np.mean(np.square(logs)))), rel=0.6)


def test_the_level_of_several_outputs_is_as_uncertain_as_estimates_of_it_scatter() -> None:
    freedoms = {"a": 40, "b": 300, "c": 0}
    noise = {o: OutputNoise(1.0, (), 0.0, 0.0, "", 0, f) for o, f in freedoms.items()}
    random = np.random.default_rng(1)
    levels = [random.chisquare(f, 40_000) / f if f else np.ones(40_000) for f in freedoms.values()]
    assert np.sqrt(2.0 / freedom_of(noise, freedoms)) == pytest.approx(float(np.std(np.mean(levels, axis=0))), rel=0.03)
    assert freedom_of(noise, ["c"]) == np.inf


CIRCUIT = parse_card("""
schema = 1
name = "circuit"
[parameters]
R = {value = 0.8, min = 0.1}
[inputs]
u = {value = 0.0}
[states]
i = {derivative = "u - R*i - v", start = 0.0}
v = {derivative = "i", start = 2.0}
[outputs]
i = "i"
v = "v"
""")


def discharged(stated: float) -> list[Experiment]:
    """The circuit from a charged capacitor, by scipy, with the current read through a filter of 80 ms; a step at 2 s."""
    found, random = [], np.random.default_rng(2)
    t = np.arange(160) * 0.05
    for name, level in (("one", 0.5), ("two", -0.7)):

        def rates(time: float, s: Array, level: float = level) -> list[float]:
            return [(level if time >= 2.0 else 0.0) - 0.8 * s[0] - s[1], s[0], (s[0] - s[2]) / 0.08]

        run = solve_ivp(rates, (0.0, t[-1]), [0.0, 2.0, 0.0], t_eval=t, rtol=1e-9, atol=1e-11, max_step=0.01)
        y = run.y[[2, 1]].T + 1e-3 * random.standard_normal((t.size, 2))
        found.append(
            Experiment(
                t,
                name,
                inputs=FrozenMap({"u": InputSignal.step(2.0, 0.0, level)}),
                event=2.0,
                measured=Trajectory(t, y, ("i", "v"), ("A", "V")),
                noise=FrozenMap({"i": stated, "v": stated}),
            )
        )
    return found


def test_a_lag_is_found_in_a_plant_that_does_not_start_at_rest() -> None:
    free = (FitParameter("R", 0.8, 0.2, 3.0),)
    found = diagnose(CIRCUIT, discharged(1e-3), free, effects=["lag", "gain", "offset"])
    assert [(e.effect, e.at) for e in found.effects] == [("lag", ("outputs.i",))], found.text
    size = found.effects[0].parameters["T"]
    assert size.ci95 is not None and size.ci95[0] is not None and size.ci95[1] is not None
    assert size.ci95[0] <= 0.08 <= size.ci95[1]
    assert found.noise["i"] == {
        "std": 1e-3, "ar": [], "resolution": 0.0, "source": "given", "error": 0.0, "stated": 1e-3, "contradicted": "",
    }  # fmt: skip
    assert "noisier" not in found.text


def test_a_stated_noise_that_the_records_refute_is_said_beside_the_verdict() -> None:
    free = (FitParameter("R", 0.8, 0.2, 3.0),)
    found = diagnose(CIRCUIT, discharged(2e-4), free, effects=["lag"])
    assert "The records are noisier than was stated" in found.text
    assert "i (stated 0.0002, shown 0.00" in found.text
    assert found.noise["v"]["contradicted"] == "louder"
    assert found.noise["v"]["std"] == pytest.approx(1e-3, rel=0.15)


def test_rows_before_an_event_tell_at_most_how_large_the_noise_is_where_a_recorded_input_keeps_the_model_moving() -> (
    None
):
    """The input is played back with its noise, and the recorder smooths: no rows are at rest, no steps from row to row tell."""
    random = np.random.default_rng(8)
    time = np.arange(3000) * 1e-3

    def smooth(count: int) -> Array:
        return np.asarray(np.convolve(random.standard_normal(count + 59), np.ones(60) / np.sqrt(60.0), "valid"))

    size, records, runs = 2e-3, [], {}
    for name in ("one", "two"):
        u = 1.0 + 0.004 * smooth(time.size) - 0.1 * (time >= 1.0)
        answer = np.array(lfilter([1e-3 / 0.05], [1.0, 1e-3 / 0.05 - 1.0], u - 1.0))
        measured = Trajectory(time, (answer + size * smooth(time.size))[:, None], ("y",), ("",))
        signal = InputSignal.corners(zip(time.tolist(), u.tolist(), strict=True))
        records.append(Experiment(time, name, inputs=FrozenMap({"u": signal}), measured=measured, event=1.0))
        runs[name] = {"y": 0.9 * answer}
    found = noise_of(records, runs)["y"]
    assert found.source == MOVING and found.rows == 2000 and found.moving == 2000
    assert found.std == pytest.approx(size, rel=0.25) and found.model
    assert noise_of(records, {n: {"y": 3.0 * r["y"]} for n, r in runs.items()})["y"].std > size
