"""Progress of a stage: what is told of the time that is left, by clocks that the tests move."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from hvdc_ident.executor import StageProgress, finish_of, times_of


def staged(*phases: tuple[str, Sequence[float]], last: str = "") -> list[tuple[float, float | None]]:
    """(true s left, s left as told or None) after each piece of a stage, by a clock that only the pieces move.

    phases: how their texts begin, with the s of each piece.
    """
    now, told = [0.0], []
    progress = StageProgress(
        lambda done, total, _: told.append((done, total)), "stage", last, clock=lambda: now[0], limit=lambda: math.inf
    )
    whole, rows = sum(sum(times) for _, times in phases), []
    for text, times in phases:
        for done in range(len(times) + 1):
            now[0] += times[done - 1] if done else 0.0
            progress(done, len(times), text)
            finish = finish_of(0.0, now[0], *told[-1])
            rows.append((whole - now[0], None if finish is None else finish - now[0]))
    return rows


def test_pieces_that_take_alike_tell_the_time_that_is_left() -> None:
    rows = staged(("points", [1.0] * 40))
    assert [told for _, told in rows[:2]] == [None] * 2, "one piece does not tell how much pieces differ"
    for left, told in rows[2:]:
        assert told == pytest.approx(left, abs=0.05)


def test_pieces_of_which_each_takes_otherwise_tell_nothing() -> None:
    """The evaluations that eight starts of one search took, of a unit of four parameters."""
    starts = [7.0, 119.0, 10.0, 9.0, 60.0, 18.0, 8.0, 43.0]
    assert [told for _, told in staged(("search", starts))[:-1]] == [None] * len(starts)


def test_what_a_pool_hands_over_at_once_counts_together() -> None:
    bursts = [16.0 if k % 16 == 0 else 0.0 for k in range(1600)]
    for left, told in staged(("points", bursts)):
        assert told is None or told == 0.0 or 0.5 * left - 16.0 <= told <= 2.0 * left + 16.0


def test_time_is_told_in_the_last_part_alone() -> None:
    rows = staged(("search", [1.0] * 20), ("'step' alone", [3.0] * 20), last="'")
    assert all(told is None for _, told in rows[:21])
    left, told = rows[35]
    assert told is not None and left / 2.0 <= told <= 2.0 * left


@pytest.mark.parametrize(("spread", "often"), [(0.1, 0.9), (0.4, 0.3), (1.0, 0.0)])
def test_a_time_that_is_told_is_within_a_factor_of_two(spread: float, often: float) -> None:
    """Of pieces drawn at random, with log-normal times, one time in twenty at most is told that is off by more, after a tenth of them.

    often: share of the instants at which one is told, at least.
    """
    random = np.random.default_rng(7)
    told, wrong = [], []
    for _ in range(300):
        rows = staged(("points", np.exp(spread * random.standard_normal(60)).tolist()))[6:-1]
        told += [s is not None for _, s in rows]
        wrong += [s is not None and not 0.5 <= s / left <= 2.0 for left, s in rows]
    assert np.mean(told) >= often and np.mean(wrong) <= 0.05 * max(often, np.mean(told) if often else 1.0)


def test_progress_never_runs_backwards_and_ends_at_the_whole() -> None:
    random = np.random.default_rng(3)
    told: list[tuple[int, int]] = []
    now = [0.0]
    progress = StageProgress(lambda done, total, _: told.append((done, total)), "stage", clock=lambda: now[0])
    for done in range(201):
        now[0] += random.exponential() if done else 0.0
        progress(done, 200, "points")
    shares = [done for done, total in told if total > 1]
    assert shares == sorted(shares) and shares[-1] == told[-1][1]


def test_a_budget_ends_what_would_take_longer() -> None:
    now, told = [0.0], []
    progress = StageProgress(
        lambda done, total, _: told.append((done, total)), "stage", clock=lambda: now[0], limit=lambda: 30.0 - now[0]
    )
    for done in range(11):
        now[0] += 1.0 if done else 0.0
        progress(done, 1000, "points")
    assert finish_of(0.0, now[0], *told[-1]) == pytest.approx(30.0, abs=0.1)


def test_a_line_without_a_count_changes_the_text_alone() -> None:
    lines: list[tuple[int, int, str]] = []
    now = [0.0]
    progress = StageProgress(lambda *line: lines.append(line), "fit", clock=lambda: now[0])
    for done in range(17):
        now[0] += 1.0
        progress(done, 20, "search")
    progress(0, 1, "curvature")
    assert lines[-1] == (*lines[-2][:2], "fit: curvature") and lines[-1][1] > 1


@pytest.mark.parametrize(
    ("begun", "finish", "now", "words"),
    [
        (0.0, None, 65.0, "1:05"),
        (10.0, 95.2, 75.0, "1:05, about 21 s left"),
        (0.0, 3700.5, 3700.0, "1:01:40, a moment left"),
        (0.0, 3700.0, 3702.0, "1:01:42"),
        (0.0, 7800.0, 600.0, "10:00, about 2 h left"),
    ],
)
def test_the_times_beside_the_bar(begun: float, finish: float | None, now: float, words: str) -> None:
    assert times_of(begun, finish, now) == words
