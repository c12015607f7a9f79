"""Tones in what a model leaves, where rows are missing too."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from hvdc_ident.discrepancy.residual_checks import tones


@pytest.mark.parametrize("missing", [(), (50,), (50, 120, 121)])
def test_a_tone_is_found_though_rows_on_jumps_are_left_out(missing):
    time = 4e-3 * np.arange(300)
    rng = np.random.default_rng(1)
    rows = np.setdiff1d(np.arange(300), missing)
    wave = 1.5 * np.sin(2 * np.pi * 15.2 * time + 0.4) + rng.standard_normal(300)
    block = SimpleNamespace(experiment="e", rows=rows, residual=wave[rows])
    problem = SimpleNamespace(fitted_experiments=(SimpleNamespace(name="e", time=time),))
    found = tones(SimpleNamespace(blocks=(block,), problem=problem))
    assert found[0] == pytest.approx(15.2, abs=0.3)


def test_a_record_on_no_even_grid_has_none():
    time = np.sort(np.random.default_rng(2).uniform(0, 1.2, 300))
    block = SimpleNamespace(experiment="e", rows=np.arange(300), residual=np.sin(95.0 * time))
    problem = SimpleNamespace(fitted_experiments=(SimpleNamespace(name="e", time=time),))
    assert tones(SimpleNamespace(blocks=(block,), problem=problem)) == ()
