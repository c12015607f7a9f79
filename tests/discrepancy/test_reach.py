"""What anything at all at a slot could make good, against a regression on every addition and on records computed by scipy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cases import FREE, SIGMA, TRUE, experiments, model
from refits import plain
from scipy.linalg import block_diag

from hvdc_ident import Experiment
from hvdc_ident.discrepancy import DiagnosisOptions, diagnose
from hvdc_ident.discrepancy.latent import SHARE, Inversion, reach
from hvdc_ident.discrepancy.scores import Whitening, runs
from hvdc_ident.discrepancy.signatures.response import Along
from hvdc_ident.effects import SignalScales, effects, size_grid


@pytest.mark.parametrize("place", ["torque", "outputs.w"])
def test_reach_is_what_a_regression_on_every_addition_takes_away(place: str) -> None:
    nominal = plain(experiments(lag=0.03)).nominal()
    paths = {n: p for n, p in runs(model(), nominal).items() if isinstance(p, Along)}
    shown = []
    for e in nominal.problem.fitted_experiments:
        path = paths[e.name]
        at = np.linspace(path.time[0], path.time[-1], path.count)
        hats = np.array([np.interp(path.time, at, row) for row in np.eye(path.count)]).T
        whitening = Whitening.of([b for b in nominal.blocks if b.experiment == e.name], e, nominal)
        shown.append(whitening(path.answer([place], hats[None])[1]))
    freed = nominal.projected(block_diag(*shown))
    free = nominal.projected(nominal.residual[:, None])[:, 0]
    solution, _, rank, _ = np.linalg.lstsq(freed, free, rcond=1e-4)
    fall = float(free @ free - np.sum((free - freed @ solution) ** 2))
    found, count = Inversion.of(nominal, paths, place).reach
    assert found == pytest.approx(fall, rel=2e-3)
    assert count == pytest.approx(int(rank), abs=6)


def clipped(level: float) -> tuple[Experiment, ...]:
    """Records of the drive whose torque's meter goes no further than a level."""
    found, random = [], np.random.default_rng(2)
    for e in experiments():
        assert e.measured is not None
        columns = {n: np.asarray(e.measured[n]) for n in e.measured.names}
        torque = columns["torque"]
        held = np.sign(torque) * level + SIGMA["torque"] * random.standard_normal(torque.size)
        columns["torque"] = np.where(np.abs(torque) < level, torque, held)
        found.append(replace(e, measured=replace(e.measured, values=np.column_stack(list(columns.values())))))
    return tuple(found)


def test_what_sits_at_a_slot_is_within_its_reach_and_not_within_that_of_others() -> None:
    nominal = plain(clipped(0.6)).nominal()
    found = reach(nominal, runs(model(), nominal), model().insertion_points, None)
    assert found is not None
    assert next(iter(found.shares)) == "outputs.torque"
    assert found.shares["outputs.torque"] == pytest.approx(1.0, abs=0.1)
    assert "outputs.w" not in found.enough and found.shares["outputs.w"] < SHARE
    assert list(found.shares.values()) == sorted(found.shares.values(), reverse=True)


def test_nothing_is_told_where_it_cannot_be() -> None:
    nominal = plain(experiments(lag=0.03)).nominal()
    paths = runs(model(), nominal)
    assert reach(nominal, paths, model().insertion_points, None) is not None
    long = {n: replace(p, count=500) for n, p in paths.items() if isinstance(p, Along)}
    assert reach(nominal, long, model().insertion_points, None) is None
    closed = {**paths, "closed": object()}
    assert reach(nominal, closed, model().insertion_points, None) is None  # type: ignore[arg-type]
    quiet = plain(experiments()).nominal()
    assert reach(quiet, runs(model(), quiet), model().insertion_points, None) is None


def test_what_is_refitted_first_sits_within_reach_and_the_diagnosis_tells_of_it() -> None:
    found = diagnose(model(), clipped(0.6), FREE, options=DiagnosisOptions(fallback=False))
    slots = found.location["slots"]
    least = 0.9 * SHARE * max(slots.values())
    refitted = [c for c in found.candidates if c.delta_bic is not None and c.round == 1]
    assert refitted and all(max(slots[p] for p in c.at) > least for c in refitted)
    left_out = {c.at for c in found.candidates if c.round == 1} - {c.at for c in refitted}
    assert any(max(slots[p] for p in at) < least for at in left_out)
    assert found.verdict in ("named", "ambiguous"), found.text
    assert [(e.effect, e.at) for e in found.effects] == [("limit", ("outputs.torque",))]


@pytest.mark.parametrize("effect", ["quantisation", "sample-hold"])
def test_every_size_of_a_closer_look_lies_within_the_bounds_of_its_probe(effect: str) -> None:
    time = np.linspace(0.0, 1.0, 301)
    signal = SignalScales.of([time], [1.0 + 0.5 * np.sin(7 * time)])
    probe, sizes = size_grid(effects()[effect], signal)
    name = next(n for n, q in effects()[effect].parameters.items() if q.grid is not None)
    low, high = probe.free[name]
    assert sizes.size > 500 and low <= sizes.min() and sizes.max() <= high
    assert probe.values[name] == sizes[0]


def test_the_course_of_what_is_missing_follows_the_hidden_friction() -> None:
    """A friction that grows with the square of the speed: scipy has it, the drive has not."""
    data = experiments(drag=lambda w: TRUE["b"] * w + 0.4 * (w - 1.0) ** 2)
    nominal = plain(data).nominal()
    found = reach(nominal, runs(model(), nominal), ["drag", "outputs.w", "err"], None)
    assert found is not None and set(found.curves) <= {"drag", "outputs.w", "err"}
    time, value = found.curves["drag"]["fit-1"]
    (first,) = [e for e in data if e.name == "fit-1"]
    assert first.measured is not None
    missing = 0.4 * (np.interp(time, first.time, first.measured["w"]) - 1.0) ** 2
    means = [
        np.convolve(course, np.ones(15) / 15.0, "valid") for course in (value, missing)
    ]  # over the noise of single rows
    assert np.corrcoef(*means)[0, 1] > 0.98
    assert found.shares["drag"] == pytest.approx(1.0, abs=0.05) and found.shares["outputs.w"] < 0.5
