"""Grids on which lines stand for a signal."""

import numpy as np
import pytest

from hvdc_ident.fmu.piecewise_linear import LINE_TOLERANCE, refined_grid

TIME = np.linspace(0.0, 10.0, 101)
NONE = np.zeros(0)
FINE = np.linspace(0.0, 10.0, 400_001)


@pytest.mark.parametrize(
    ("signal", "runs"),
    [
        (lambda t: np.exp(-t / 0.02), 4),
        (lambda t: np.sin(40.0 * t), 4),
        (lambda t: np.maximum(t - np.pi, 0.0), 6),  # a kink
        (lambda t: np.stack([np.exp(-t), np.sin(3.0 * t)], axis=1), 4),
    ],
)
def test_lines_are_within_the_tolerance_after_a_few_runs(signal, runs):
    made = []

    def run(t):
        made.append(t)
        return signal(t).reshape(t.size, -1)

    grid = refined_grid(run, TIME, NONE)
    assert (np.diff(grid) > 0).all() and grid[0] == 0.0 and grid[-1] == 10.0
    for column in signal(FINE).reshape(FINE.size, -1).T:
        lines = np.interp(FINE, grid, np.interp(grid, FINE, column))
        # An interval is looked at in its middle, where the bend about an inflection does not show.
        assert np.abs(lines - column).max() < 4.0 * LINE_TOLERANCE * np.ptp(column)
    assert len(made) <= runs


def test_a_jump_is_enclosed_to_nothing_and_a_break_is_there_twice():
    grid = refined_grid(lambda t: (t > np.e)[:, None].astype(float), TIME, np.array([5.0]))
    around = grid[np.searchsorted(grid, np.e) - 1 : np.searchsorted(grid, np.e) + 1]
    assert 0.0 < around[1] - around[0] < 3e-9
    assert np.count_nonzero(grid == 5.0) == 2 and grid.size < 800
