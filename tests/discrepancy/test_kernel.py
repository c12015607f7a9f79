"""The compiled sums over many answers, against NumPy's."""

import numpy as np
import pytest

from hvdc_ident.discrepancy.signatures.propagation import replaced


def test_answers_are_put_in_place_and_their_change_is_measured():
    """Some columns of many, out of order: the others stay as they are."""
    random = np.random.default_rng(0)
    whole, new = random.normal(size=(2, 5, 7)), random.normal(size=(2, 5, 3))
    columns, before = np.array([4, 0, 6]), whole.copy()
    size, moved = np.zeros(3), np.zeros(3)
    replaced(new, columns, whole, size, moved)
    expected = before.copy()
    expected[:, :, columns] = new
    assert np.array_equal(whole, expected)
    assert size == pytest.approx((new**2).sum(axis=(0, 1)))
    assert moved == pytest.approx(((new - before[:, :, columns]) ** 2).sum(axis=(0, 1)))
