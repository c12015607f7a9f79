"""Bad rows of a record are found, each kind by what it lacks, and a sound record has none."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident.data import bad_rows, gaps

N = 700
TIME = np.arange(N) / 60.0
ANGLES = {"theta": 2.0 * np.pi}


def record(seed: int = 1, noise: float = 1.0) -> dict[str, np.ndarray]:
    """A unit's terminals after a dip at 2 s, as a concentrator writes them."""
    rng = np.random.default_rng(seed)
    swing = np.where(TIME > 2.0, np.exp(-0.4 * (TIME - 2.0)) * np.sin(7.0 * (TIME - 2.0)), 0.0)
    dip = np.where((TIME > 2.0) & (TIME < 2.15), 1.0, 0.0)
    clean = {
        "V": 1.02 - 0.3 * dip + 0.01 * swing,
        "theta": 0.1 * swing,
        "P": 200.0 - 80.0 * dip + 60.0 * swing,
        "Q": 19.0 + 40.0 * dip - 20.0 * swing,
    }
    size = {"V": 1e-4, "theta": 5e-4, "P": 0.1, "Q": 0.1}
    digits = {"V": 6, "theta": 6, "P": 4, "Q": 4}
    return {n: np.round(v + noise * size[n] * rng.standard_normal(N), digits[n]) for n, v in clean.items()}


def stuck(r: dict[str, np.ndarray]) -> None:
    for v in r.values():
        v[300:] = v[299]


def spike(r: dict[str, np.ndarray]) -> None:
    r["P"][60] += 40.0


def filled(r: dict[str, np.ndarray]) -> None:
    r["Q"][400:430] = np.round(np.linspace(r["Q"][400], r["Q"][429], 30), 4)


def repeated(r: dict[str, np.ndarray]) -> None:
    for v in r.values():
        v[500:530] = v[440:470]


def zeros(r: dict[str, np.ndarray]) -> None:
    for name in ("V", "P", "Q"):
        r[name][250:252] = 0.0


@pytest.mark.parametrize(
    ("kind", "damage", "columns", "rows"),
    [
        ("stuck", stuck, {"V", "theta", "P", "Q"}, (300, N - 1)),
        ("zeros", zeros, {"V", "P", "Q"}, (250, 251)),
        ("mark", lambda r: r["P"].__setitem__(slice(100, 104), -9999.0), {"P"}, (100, 103)),
        ("saturated", lambda r: np.minimum(r["P"], 225.0, out=r["P"]), {"P"}, None),
        ("filled", filled, {"Q"}, (400, 429)),
        ("repeated", repeated, {"V", "theta", "P", "Q"}, (500, 529)),
        ("spike", spike, {"P"}, (60, 60)),
        (
            "angle step",
            lambda r: r["theta"].__setitem__(slice(500, None), r["theta"][500:] + 0.5),
            {"theta"},
            (499, 500),
        ),
        ("constant", lambda r: r["P"].__setitem__(slice(None), 199.8626), {"P"}, (0, N - 1)),
    ],
)
def test_a_kind_is_found_where_it_is(kind, damage, columns, rows):
    damaged = record()
    damage(damaged)
    found = bad_rows(TIME, damaged, angles=ANGLES)
    assert {b.kind for b in found} == {kind}
    assert set().union(*(b.columns for b in found)) == columns
    if rows is not None:
        slack = 1 if kind == "filled" else 0  # a line holds between its ends
        assert [abs(found[0].first - rows[0]) <= slack, abs(found[0].last - rows[1]) <= slack] == [True, True]


@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0, 10.0])
def test_a_sound_record_has_none(noise):
    assert [bad_rows(TIME, record(seed, noise), angles=ANGLES) for seed in range(5)] == [()] * 5


def test_a_limit_of_the_plant_is_no_saturation_where_nothing_has_noise():
    clean = record(noise=0.0)
    clean["P"] = np.minimum(clean["P"], 225.0)
    assert bad_rows(TIME, clean, angles=ANGLES) == ()


def test_a_whole_turn_of_an_angle_is_no_step():
    turned = record()
    turned["theta"][500:] += 2.0 * np.pi
    assert bad_rows(TIME, turned, angles=ANGLES) == ()


def test_missing_rows_are_a_gap_and_other_rates_are_none():
    (gap,) = gaps(np.delete(TIME, slice(200, 260)))
    assert (gap.kind, gap.first, gap.last) == ("gap", 199, 200)
    fast_then_slow = np.concatenate([TIME[:200], TIME[200::10]])
    assert gaps(fast_then_slow) == ()


def test_rows_that_repeat_tell_nothing_where_a_simulation_chose_its_instants():
    """A solver of variable steps writes a row again where nothing happens; a recorder that misses rows still has a clock."""
    standing = record()
    stuck(standing)
    uneven = np.cumsum(np.random.default_rng(2).uniform(0.2, 1.8, N)) / 60.0
    assert bad_rows(uneven, standing, angles=ANGLES) == ()
    kept = np.delete(np.arange(N), [100, 101, 102, 180])
    assert [b.kind for b in bad_rows(TIME[kept], {n: v[kept] for n, v in standing.items()}, angles=ANGLES)] == ["stuck"]


def test_a_number_of_nines_within_the_course_is_no_mark():
    sound = record()
    sound["P"] = np.round(999.0 + 5.0 * (sound["P"] - 200.0))
    assert np.count_nonzero(sound["P"] == 999.0) > 50 and bad_rows(TIME, sound, angles=ANGLES) == ()


def test_a_fault_that_clears_within_a_row_is_no_spike():
    sound = record()
    for name, size in (("V", -0.4), ("P", -90.0), ("Q", 60.0)):
        sound[name][60] += size
    assert bad_rows(TIME, sound, angles=ANGLES) == ()
