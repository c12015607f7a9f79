"""Curves as they are drawn: thinned without losing a peak, and poles as columns of a plane."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("nicegui", reason="the workbench needs: pip install 'hvdc_ident[app]'")

from hvdc_ident.app.plot import MOST, _short, scattered, thinned


def test_a_short_record_is_drawn_as_it_is() -> None:
    x, y = np.arange(10.0), np.arange(10.0) ** 2
    assert all((a == b).all() for a, b in zip(thinned(x, y), (x, y), strict=True))


def test_a_long_record_keeps_every_peak() -> None:
    rng = np.random.default_rng(1)
    x, y, z = np.arange(1e6), rng.normal(size=10**6), np.zeros(10**6)
    y[123_457], z[999_999] = 50.0, -7.0
    drawn_x, drawn_y, drawn_z = thinned(x, y, z)
    assert drawn_x.size == drawn_y.size == MOST and (np.diff(drawn_x) > 0).all()
    assert drawn_y.max() == 50.0 and drawn_y.min() == y.min() and drawn_z.min() == -7.0
    assert abs(drawn_x[drawn_y.argmax()] - 123_457) <= 2 * 1e6 / MOST


def test_rows_that_were_not_recorded_are_no_numbers() -> None:
    x, y = np.arange(1e4), np.full(10**4, np.nan)
    y[:5000] = 1.0
    drawn = thinned(x, y)[1]
    assert np.isfinite(drawn[: MOST // 2]).all() and np.isnan(drawn[MOST // 2 :]).all()
    assert _short(np.array([1.0, np.nan])) == [1.0, None]


def test_sets_of_poles_share_an_abscissa() -> None:
    x, one, two = scattered(np.array([-2 + 1j, -5.0]), np.array([-3 - 1j]))
    assert x.tolist() == [-5.0, -3.0, -2.0]
    assert np.array_equal(one, [0.0, np.nan, 1.0], equal_nan=True)
    assert np.array_equal(two, [np.nan, -1.0, np.nan], equal_nan=True)
