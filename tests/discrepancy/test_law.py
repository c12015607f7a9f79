"""Laws found from records: against solving for every pair of terms, and on records by scipy whose meters drift or multiply."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from cases import FREE, SIGMA, TIME, experiments, model
from refits import plain

from hvdc_ident import Experiment, simulate
from hvdc_ident.discrepancy import Diagnosis, Options, diagnose
from hvdc_ident.discrepancy.hidden import Regression
from hvdc_ident.discrepancy.law import law
from hvdc_ident.discrepancy.rounds import one_round
from hvdc_ident.discrepancy.state import Search
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.trajectory import Array

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
    assert not [text for text in looks if text.startswith(("round 2", "round 1: from every size"))]
    assert found.augmented is not None
    run = simulate(found.augmented, metered(output, meter)[0].with_(measured=None), outputs=[output])
    assert np.isfinite(run[output]).all()


def test_a_law_is_near_only_where_it_beats_what_the_catalogue_has() -> None:
    first = plain(metered("w", drifting))
    search = Search(("lag", "gain"), None, FrozenMap(), Options(bootstraps=100), seed=0)
    found = one_round(search, first, 1)
    alone = law(search, found)
    assert alone is not None and alone.near
    beside = law(search, found, best=alone.refit)
    assert beside is None or not beside.near


def test_more_is_refitted_where_a_thorough_search_is_asked_for() -> None:
    def rough(seen: dict[str, Array]) -> Array:
        """The torque by a meter that jumps where the speed passes a level, either way by itself."""
        return seen["torque"] + 0.05 * np.tanh((seen["w"] - 1.02) / 0.01)

    records, names, done = metered("torque", rough), ["lag", "gain", "limit", "deadband"], dict[bool, Diagnosis]()
    looks: dict[bool, list[str]] = {False: [], True: []}
    for thorough in (False, True):
        done[thorough] = diagnose(
            model(), records, FREE, effects=names, options=Options(bootstraps=100, thorough=thorough),
            progress=lambda _done, _total, text, told=looks[thorough]: told.append(text),
        )  # fmt: skip
    assert any(text.startswith("round 1: from every size") for text in looks[False])
    assert not any(text.startswith("round 1: the other candidates") for text in looks[False])
    assert any(text.startswith("round 1: the other candidates") for text in looks[True])
    tried = {k: [c for c in d.candidates if c.delta_bic is not None] for k, d in done.items()}
    assert len(tried[True]) > len(tried[False])
    assert any("thorough" in note for note in done[False].notes)
    assert not any("thorough" in note for note in done[True].notes)
