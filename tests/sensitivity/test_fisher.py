"""Information matrices and what is read from them, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import qr

from hvdc_ident.immutable import FrozenMap
from hvdc_ident.sensitivity import (
    Information,
    collinear_subsets,
    independent,
    marginal,
    null_directions,
    pivoted_order,
    rise_over_range,
)
from hvdc_ident.sensitivity.information import collinearity_index, inflation_index


def test_information_adds_up_and_tells_who_gives_it() -> None:
    a, b = np.array([[1.0, 0.0], [1.0, 0.0]]), np.array([[0.0, 3.0]])
    a, b = (j * np.array([10.0, 1.0]) for j in (a, b))
    found = Information(("p", "q"), FrozenMap({"one": a.T @ a, "two": b.T @ b}))
    assert np.allclose(found.matrix, [[200, 0], [0, 9]])
    assert found.norms["q"] == 3.0
    assert found.shares()["one"]["p"] == 1.0 and found.shares()["one"]["q"] == 0.0


def test_collinearity_of_two_columns_at_an_angle() -> None:
    c = 0.98
    gamma = collinearity_index(np.array([[4.0, 4 * c], [4 * c, 4.0]]))
    assert gamma == pytest.approx(1 / np.sqrt(1 - c))
    assert inflation_index(np.array([[4.0, 4 * c], [4 * c, 4.0]])) == pytest.approx([1 / np.sqrt(1 - c * c)] * 2)
    assert collinearity_index(np.eye(3)) == pytest.approx(1.0)
    assert collinearity_index(np.ones((2, 2))) == np.inf
    assert collinearity_index(np.diag([1.0, 0.0])) == np.inf


@pytest.mark.parametrize("p", [5, 12])
def test_the_collinear_pair_is_found_among_many(p: int) -> None:
    j = np.random.default_rng(0).normal(size=(400, p))
    j[:, 3] = j[:, 1] + 1e-3 * j[:, 3]
    found = collinear_subsets(j.T @ j, [f"p{i}" for i in range(p)])
    assert found[0].names == ("p1", "p3") and found[0].index > 100
    assert max(len(s.names) for s in found) == p


def test_pivoting_keeps_the_earlier_of_equals() -> None:
    j = np.zeros((4, 3))
    j[0, 0] = j[0, 1] = 1.0
    j[1, 2] = 1.0
    assert pivoted_order(j.T @ j)[0] == 0
    assert set(independent(j.T @ j)) == {0, 2}
    j[:, 0] = 0.0
    assert set(independent(j.T @ j)) == {1, 2}


def test_the_order_is_that_of_a_qr_with_pivoting() -> None:
    """The order by SciPy's QR of the columns; of columns as long as each other, to a thousandth, the earlier listed comes first."""
    columns = np.random.default_rng(4).standard_normal((30, 5)) * [3.0, 1.0, 10.0, 0.3, 30.0]
    assert pivoted_order(columns.T @ columns) == tuple(qr(columns, mode="r", pivoting=True)[1])
    assert pivoted_order(np.diag([1.0, 4.0, 4.003])) == (1, 2, 0)


def test_null_directions_are_sparse_and_leave_zero_columns_out() -> None:
    rng = np.random.default_rng(1)
    j = rng.normal(size=(50, 5))
    j[:, 2] = 2 * j[:, 0]
    j[:, 4] = 0.0
    null = null_directions(j)
    assert null.shape == (1, 5)
    assert null[0, 2] / null[0, 0] == pytest.approx(-0.5)
    assert np.abs(null[0, [1, 3, 4]]).max() < 1e-9
    assert null_directions(np.zeros((3, 2))).shape == (0, 2)


def test_marginal_is_the_inverse_of_the_inverse_s_block() -> None:
    a = np.random.default_rng(2).normal(size=(30, 4))
    f = a.T @ a
    assert np.allclose(marginal(f, [0, 2]), np.linalg.inv(np.linalg.inv(f)[np.ix_([0, 2], [0, 2])]))
    assert np.allclose(marginal(f, range(4)), f)


def test_rise_over_range() -> None:
    assert rise_over_range(2.0, 3.0) == 9.0
