"""Laws found from records: against solving for every pair of terms, and on records by scipy whose meters drift or multiply."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations, pairwise
from typing import Any

import numpy as np
import pytest
from cases import FREE, SIGMA, TIME, TRUE, experiments, model
from refits import plain

from hvdc_ident import Experiment, simulate
from hvdc_ident.data import Array
from hvdc_ident.discrepancy import Diagnosis, DiagnosisOptions, diagnose, refit_jobs, rounds
from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.context import SearchContext
from hvdc_ident.discrepancy.formula import hats
from hvdc_ident.discrepancy.outside.law import Regression, _levels, law
from hvdc_ident.discrepancy.refit import Refit, RefitJob
from hvdc_ident.discrepancy.rounds import one_round
from hvdc_ident.expression import parse, symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, parse_card, write_card

Meter = Callable[[dict[str, Array]], Array]


def metered(output: str, meter: Meter) -> tuple[Experiment, ...]:
    """Records of the drive one of whose meters shows something else."""
    found, random = [], np.random.default_rng(4)
    for e in experiments():
        assert e.measured is not None
        columns = {n: np.asarray(e.measured[n]) for n in e.measured.names}
        noise = 0.1 * SIGMA[output] * random.standard_normal(TIME.size)
        columns[output] = meter(columns) + noise
        found.append(replace(e, measured=replace(e.measured, values=np.column_stack(list(columns.values())))))
    return tuple(found)


def drifting(seen: dict[str, Array]) -> Array:
    """The speed by a meter whose gain grows."""
    return seen["w"] * (1.0 + 0.04 * TIME)


def product(seen: dict[str, Array]) -> Array:
    """The torque by a meter whose gain is the speed's."""
    return seen["torque"] * (1.0 + 0.8 * (seen["w"] - 1.0))


def test_terms_are_chosen_as_by_solving_for_each() -> None:
    random = np.random.default_rng(1)
    columns = random.standard_normal((200, 30)) * np.geomspace(1e-3, 1e3, 30)
    columns[:, 7] = columns[:, 6] + 1e-9 * columns[:, 7]  # one is another again
    residual = (
        3.0 * columns[:, 4] / columns[:, 4].std() + columns[:, 21] / columns[:, 21].std() + random.standard_normal(200)
    )
    whole = Regression(columns, residual)
    chosen: list[int] = []
    gain = 0.0
    for _ in range(4):
        best, k = max((whole.solved([*chosen, k])[1], k) for k in range(30) if k not in chosen)
        if best - gain <= 12.0:
            break
        chosen, gain = [*chosen, k], best
    assert sorted(chosen) == [4, 21]
    assert whole.selected(4, 12.0) == chosen


def test_two_terms_that_explain_together_what_neither_does_are_found() -> None:
    random = np.random.default_rng(3)
    common = random.standard_normal(300)
    columns = random.standard_normal((300, 24))
    columns[:, 5] = common + 0.02 * columns[:, 5]
    columns[:, 9] = common + 0.02 * columns[:, 9]
    columns[:, 2] = columns[:, 5] - columns[:, 9] + 0.02 * columns[:, 2]  # the best by itself
    residual = 400.0 * (columns[:, 5] - columns[:, 9]) + random.standard_normal(300)
    whole = Regression(columns, residual)
    gains = {pair: whole.solved(pair)[1] for pair in combinations(range(24), 2)}
    assert max(range(24), key=lambda k: whole.solved([k])[1]) == 2
    assert sorted(whole.selected(2, 12.0)) == [5, 9] == sorted(max(gains, key=lambda pair: gains[pair]))
    assert sorted(whole.selected(2, 12.0, residual)) == [5, 9]
    assert whole.selected(2, 12.0, random.standard_normal(300)) == []


@pytest.mark.parametrize(
    ("output", "meter", "expression", "size"),
    [("w", drifting, "k1*w*time", 0.04), ("torque", product, "k1*torque*w + k2*torque", 0.8)],
)
def test_what_no_effect_of_the_catalogue_explains_is_told_as_a_law(
    output: str, meter: Meter, expression: str, size: float
) -> None:
    looks: list[str] = []
    found = diagnose(model(), metered(output, meter), FREE, progress=lambda _done, _total, text: looks.append(text))
    assert found.verdict == "unnameable" and not found.effects
    assert found.fallback is not None
    told = found.fallback
    assert (told["kind"], told["at"], told["expression"]) == ("term", f"outputs.{output}", expression)
    low, high = told["coefficients"]["k1"]["ci95"]
    assert low < size < high
    assert told["coefficients"]["k1"]["value"] == pytest.approx(size, rel=0.1)
    assert found.remaining["adequate"] and (found.gap.shrink_holdout or 0.0) > 0.5
    assert not [text for text in looks if text.startswith("round 2")]
    assert found.augmented is not None
    run = simulate(found.augmented, metered(output, meter)[0].with_(measured=None), outputs=[output])
    assert np.isfinite(run[output]).all()


def bent(seen: dict[str, Array]) -> Array:
    """The torque by a meter with an error that goes over from one side to the other where the speed passes a level."""
    return seen["torque"] + error(seen["w"])


def error(w: Array) -> Array:
    return 0.05 * np.tanh((w - 1.1) / 0.1)


def test_what_hangs_on_one_signal_and_is_no_formula_is_told_as_a_curve_and_put_in() -> None:
    found = diagnose(model(), metered("torque", bent), FREE)
    assert found.verdict == "unnameable" and found.fallback is not None
    told, curve = found.fallback, found.fallback["curve"]
    assert (told["kind"], told["at"], curve["over"]) == ("curve", "outputs.torque", "w")
    at, value, std = (np.array(curve[n]) for n in ("at", "value", "std"))
    known = std < 0.01
    assert known.sum() >= 8 and np.all(np.diff(at) > 0)
    # Between knots the curve is straight: a little is missing where it bends.
    assert np.abs(value - error(at))[known].max() < 0.01
    assert isinstance(found.augmented, Model) and found.parameters_after["Ki"] == pytest.approx(TRUE["Ki"], rel=0.05)
    assert (found.gap.shrink_holdout or 0.0) > 0.5
    assert parse_card(write_card(found.augmented)).insertion_points == found.augmented.insertion_points


@pytest.mark.parametrize("peak", range(4))
def test_a_hat_is_what_its_text_says(peak: int) -> None:
    levels = np.array([-0.5, 0.1, 0.4, 1.5])
    hat = hats("s", levels)[peak]
    s = np.linspace(-1.0, 2.0, 301)
    told = parse(hat.text)
    shown = np.array([float(told.subs({symbol("s"): v})) for v in s])
    assert shown == pytest.approx(np.interp(s, levels, np.eye(4)[peak]), abs=1e-12)
    assert hat([s]) == pytest.approx(shown, abs=1e-12)


def test_levels_lie_where_the_signal_travels_and_a_signal_that_steps_gives_none() -> None:
    there = np.concatenate([np.zeros(50), np.linspace(0.0, 1.0, 20), np.linspace(1.0, 0.9, 30)])
    levels = _levels([there, there[:60]])
    travelled = [np.abs(np.diff(np.clip(u, a, b))).sum() for a, b in pairwise(levels) for u in (there, there[:60])]
    shares = np.array(travelled).reshape(-1, 2).sum(axis=1)
    assert shares == pytest.approx(shares.mean() * np.ones(shares.size), rel=1e-6)
    assert levels[0] == 0.0 and levels[-1] == 1.0


def test_a_law_is_near_only_where_it_beats_what_the_catalogue_has() -> None:
    first = plain(metered("w", drifting))
    search = SearchContext(("lag", "gain"), None, FrozenMap(), DiagnosisOptions(bootstraps=100), seed=0)
    found = one_round(search, first, 1)
    alone = law(search, found)
    assert alone is not None and alone.near
    beside = law(search, found, best=alone.refit)
    assert beside is None or not beside.near


def rough(seen: dict[str, Array]) -> Array:
    """The torque by a meter that jumps where the speed passes a level, either way by itself."""
    return seen["torque"] + 0.05 * np.tanh((seen["w"] - 1.02) / 0.01)


def test_more_is_refitted_where_a_thorough_search_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rounds, "OF_EFFECT", 1)
    begun: list[str] = []
    plain = refit_jobs.job

    def counted(before: Refit, candidate: CandidateEffect, *given: Any) -> RefitJob:
        begun.append(candidate.label)
        return plain(before, candidate, *given)

    monkeypatch.setattr("hvdc_ident.discrepancy.stand.job", counted)
    records, names, done = metered("torque", rough), ["lag", "gain", "limit", "deadband"], dict[bool, Diagnosis]()
    count: dict[bool, int] = {}
    for thorough in (False, True):
        options = DiagnosisOptions(bootstraps=100, thorough=thorough)
        begun.clear()
        done[thorough] = diagnose(model(), records, FREE, effects=names, options=options)
        count[thorough] = len(set(begun))
    assert count[True] > 2 * count[False]
    assert any("thorough" in note for note in done[False].notes)
    assert not any("thorough" in note for note in done[True].notes)


def test_a_budget_ends_the_search_and_what_was_not_tried_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rounds, "OF_EFFECT", 1)
    options = DiagnosisOptions(bootstraps=100, budget=1e-6)
    found = diagnose(
        model(), metered("torque", rough), FREE, effects=["lag", "gain", "limit", "deadband"], options=options
    )
    assert any("The budget ended before" in note for note in found.notes)
    assert len({line.round for line in found.candidates}) == 1
    # The verdict so far is of the one that was refitted; the others say why they were not.
    status = [line.status for line in found.candidates]
    assert status.count("refitted") >= 1 and any("the budget ended" in s for s in status)
