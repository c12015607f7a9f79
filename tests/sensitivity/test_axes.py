"""Where a sweep goes."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident.errors import StudyError
from hvdc_ident.sensitivity import Points, Samples, grid, latin_hypercube, listed, log_grid
from hvdc_ident.sensitivity.sweep_points import MOST_POINTS, points_of


def test_grids_and_lists():
    assert grid("a", 1, 3, 5).values[:, 0].tolist() == [1, 1.5, 2, 2.5, 3]
    values = log_grid("a", 0.1, 100, 4).values[:, 0]
    assert values[0] == 0.1 and values[-1] == 100 and np.allclose(values[1:] / values[:-1], 10)
    assert listed("a", [3, 1]).values[:, 0].tolist() == [3, 1]


@pytest.mark.parametrize("log", [(), ("a",)])
def test_a_latin_hypercube_has_one_point_in_each_slice(log):
    n = 50
    found = latin_hypercube({"a": (1, 100), "b": (-1, 1)}, n, seed=3, log=log)
    shares = np.log(found.values[:, 0]) / np.log(100) if log else (found.values[:, 0] - 1) / 99
    assert sorted((shares * n).astype(int).clip(0, n - 1)) == list(range(n))
    assert sorted(((found.values[:, 1] + 1) / 2 * n).astype(int)) == list(range(n))
    same, other = (latin_hypercube({"a": (1, 100), "b": (-1, 1)}, n, seed=s, log=log) for s in (3, 4))
    assert np.array_equal(found.values, same.values) and not np.array_equal(found.values, other.values)


def test_the_product_moves_the_last_axis_fastest_and_is_made_in_pieces():
    points = points_of([listed("a", [1, 2]), Samples(("b", "c"), np.array([[3, 4], [5, 6], [7, 8]]))])
    assert points.names == ("a", "b", "c") and len(points) == 6
    assert points.rows(0, 99).tolist() == [[1, 3, 4], [1, 5, 6], [1, 7, 8], [2, 3, 4], [2, 5, 6], [2, 7, 8]]
    assert points.rows(2, 4).tolist() == [[1, 7, 8], [2, 3, 4]]
    assert len(points_of({"a": [1, 2], "b": [3]})) == 2


@pytest.mark.parametrize(
    "make",
    [
        lambda: grid("a", 2, 1, 5),
        lambda: grid("a", 1, 2, 1),
        lambda: log_grid("a", 0, 1, 5),
        lambda: grid("a", 1, float("inf"), 5),
        lambda: listed("a", []),
        lambda: listed("a", [float("nan")]),
        lambda: points_of({}),
        lambda: points_of([listed("a", [1]), listed("a", [2])]),
        lambda: Points(tuple(grid(n, 0, 1, 1000) for n in "abc")),
        lambda: latin_hypercube({"a": (0, 1)}, 5, log=("a",)),
    ],
)
def test_what_cannot_be_swept_is_refused(make):
    assert MOST_POINTS < 1000**3
    with pytest.raises(StudyError):
        make()
