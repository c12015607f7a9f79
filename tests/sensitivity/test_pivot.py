"""The entry of a direction that is made 1, whatever rounding does."""

import numpy as np

from hvdc_ident.sensitivity.information import leading


def test_of_entries_that_are_equal_to_rounding_the_first_leads():
    ones = np.array([0.0, 1.0, -1.0, 0.5])
    for error in (-1e-16, 0.0, 1e-15):
        assert leading(ones * np.array([1.0, 1.0, 1.0 + error, 1.0])) == 1
    assert leading(np.array([1.0, -1.0001])) == 1
