"""Curves as they are drawn: thinned without losing a peak, and poles as columns of a plane."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("nicegui", reason="the workbench needs: pip install 'hvdc_ident[app]'")

from nicegui.json import dumps

from hvdc_ident.app.plot import ROWS_DRAWN, _short, focused, scattered, sketch, thinned


def test_a_short_record_is_drawn_as_it_is() -> None:
    x, y = np.arange(10.0), np.arange(10.0) ** 2
    assert all((a == b).all() for a, b in zip(thinned(x, y), (x, y), strict=True))


def test_a_long_record_keeps_every_peak() -> None:
    rng = np.random.default_rng(1)
    x, y, z = np.arange(1e6), rng.normal(size=10**6), np.zeros(10**6)
    y[123_457], z[999_999] = 50.0, -7.0
    drawn_x, drawn_y, drawn_z = thinned(x, y, z)
    assert drawn_x.size == drawn_y.size == ROWS_DRAWN and (np.diff(drawn_x) > 0).all()
    assert drawn_y.max() == 50.0 and drawn_y.min() == y.min() and drawn_z.min() == -7.0
    assert abs(drawn_x[drawn_y.argmax()] - 123_457) <= 2 * 1e6 / ROWS_DRAWN


def test_rows_that_were_not_recorded_are_no_numbers() -> None:
    x, y = np.arange(1e4), np.full(10**4, np.nan)
    y[:5000] = 1.0
    drawn = thinned(x, y)[1]
    assert np.isfinite(drawn[: ROWS_DRAWN // 2]).all() and np.isnan(drawn[ROWS_DRAWN // 2 :]).all()
    assert dumps({"args": [_short(np.array([0.1, np.nan, np.inf]))]}) == '{"args":[[0.1,null,null]]}'


def test_sets_of_poles_share_an_abscissa() -> None:
    x, one, two = scattered(np.array([-2 + 1j, -5.0]), np.array([-3 - 1j]))
    assert x.tolist() == [-5.0, -3.0, -2.0]
    assert np.array_equal(one, [0.0, np.nan, 1.0], equal_nan=True)
    assert np.array_equal(two, [np.nan, -1.0, np.nan], equal_nan=True)


def test_what_is_looked_at_is_drawn_closely_and_the_rest_coarsely() -> None:
    x = np.arange(1e6)
    y = np.sin(x)
    y[500_123], y[7] = 9.0, -9.0
    drawn_x, drawn_y = focused(x, 500_000.0, 502_000.0, y)
    inside = (drawn_x >= 500_000) & (drawn_x <= 502_000)
    np.testing.assert_array_equal(drawn_x[inside], np.arange(500_000.0, 502_001.0))
    np.testing.assert_array_equal(drawn_y[inside], y[500_000:502_001])
    assert drawn_x.size < 2 * ROWS_DRAWN and (np.diff(drawn_x) > 0).all() and drawn_y.min() == -9.0
    assert drawn_x[0] == 0.0 and drawn_x[-1] > x[-1] * (1.0 - 16.0 / ROWS_DRAWN)


def test_a_view_beside_the_record_draws_it_all_the_same() -> None:
    x = np.arange(10.0)
    for low, high in ((-5.0, -1.0), (20.0, 30.0), (-1.0, 30.0), (3.2, 3.4)):
        assert focused(x, low, high, x)[0].tolist() == x.tolist()


def test_a_sketch_leaves_gaps_open() -> None:
    drawn = sketch(np.arange(5.0), np.array([0.0, 1.0, np.nan, 1.0, 0.0]), 40, 24)
    assert 'd="M0.0 22.0L10.0 2.0M30.0 2.0L40.0 22.0"' in drawn
    assert "NaN" not in sketch(np.arange(3.0), np.full(3, np.nan), 40, 24).replace("nan", "NaN")
